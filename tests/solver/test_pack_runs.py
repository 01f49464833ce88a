"""Packings in runs and on disk: the cache, `frit pack`, what a run directory keeps, resuming."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from launching import TIMEOUT, different, history, interrupted, launch, record, resume, solve

from frit.service.jobs.launch import is_open_mpi, mpirun_command
from frit.solver import pack_store, particle_file
from frit.solver.case import parse_case
from frit.solver.packing import Packing, request

PACK: dict[str, dict[str, Any]] = {
    "domain": {"size": [40.0, 30.0]},
    "nodes": {"spacing": 1.0},
    "particles": {
        "source": "packing", "mean_radius": 5.0, "std_radius": 0.4, "packing_density": 0.6, "seed": 2,
        "container": [[1.0, 1.0], [39.0, 29.0]],
    },
    "time": {"integrator": "rk2", "end": 0.01, "step": 1e-4},
    "output": {"history_every": 0.001, "snapshots": [0.0, 0.0035, 0.01]},
}  # fmt: skip
REALISED = {
    "method", "seed", "count", "mean_radius", "std_radius", "packing_density", "vacancy_box_density", "coordination",
}  # fmt: skip


def changed(**particles: Any) -> dict[str, Any]:
    return PACK | {"particles": PACK["particles"] | particles}


@pytest.fixture(autouse=True)
def _own_packings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A packing cache that no other test has filled; compiled code stays where it is."""
    monkeypatch.setattr(pack_store, "cache_root", lambda: tmp_path / "cache")


def test_the_cache_is_by_what_decides_the_packing() -> None:
    key = pack_store.key(request(parse_case(PACK)))
    same = PACK | {"model": {"A": 8.0}, "name": "other", "nodes": {"spacing": 0.5}}
    assert pack_store.key(request(parse_case(same))) == key
    assert pack_store.key(request(parse_case(changed(interface_width=2.0)))) == key
    for other in (changed(seed=3), changed(std_radius=0.5), changed(mean_radius=5.1), changed(packing_density=0.61)):
        assert pack_store.key(request(parse_case(other))) != key
    box = PACK | {"output": {"vacancy_box": [[5.0, 5.0], [30.0, 25.0]]}}
    assert pack_store.key(request(parse_case(box))) != key
    poured = {"particles": {**PACK["particles"], "packing_density": None, "count": 8}}  # no box decides it
    assert pack_store.key(request(parse_case(PACK | poured))) == pack_store.key(request(parse_case(box | poured)))


def test_a_cached_packing_is_taken_and_a_damaged_one_is_made_again(tmp_path: Path) -> None:
    case = parse_case(PACK)
    first = pack_store.packed(case)
    [path] = (tmp_path / "cache/packings").iterdir()
    shifted = Packing(first.centres + 0.25, first.radii, first.realised)
    pack_store.write(path, shifted)
    assert np.array_equal(pack_store.packed(case).centres, shifted.centres)
    whole = path.read_text()
    for damaged in (whole[: len(whole) // 2], whole.replace("5", "6", 1), "", "{}", "[]"):
        path.write_text(damaged)
        assert np.array_equal(pack_store.packed(case).centres, first.centres)
        assert path.read_text() != damaged
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_run_keeps_its_packing(tmp_path: Path) -> None:
    """On one rank or two: the same particles; case.json is the case as asked; run.json tells what was realised."""
    one, two = solve(PACK, tmp_path / "one"), solve(PACK, tmp_path / "two", ranks=2)
    assert (one / "particles.csv").read_bytes() == (two / "particles.csv").read_bytes()
    assert different(one, two, 1e-10) == {}
    asked = json.loads((one / "case.json").read_text())
    assert asked["particles"]["source"] == "packing"
    assert record(one)["case"] == parse_case(PACK).identity() == parse_case(asked).identity()
    realised = record(one)["packing"]
    assert set(realised) >= REALISED
    centres, radii = particle_file.read(one / "particles.csv", 2)
    assert realised["count"] == len(radii) == history(one)[0]["particles"]
    assert realised["mean_radius"] == pytest.approx(5.0)
    assert realised["std_radius"] == pytest.approx(0.4)
    assert abs(realised["vacancy_box_density"] - 0.6) <= 0.005
    assert centres.shape == (len(radii), 2)


def test_a_run_goes_on_with_the_particles_it_has(tmp_path: Path) -> None:
    """Resuming ends like an undisturbed run, and reads particles.csv: it does not pack."""
    whole = solve(PACK, tmp_path / "whole")
    cut = interrupted(PACK, tmp_path / "cut")
    before = record(cut)["packing"]
    resumed = resume(cut)
    assert different(whole, resumed, 1e-10) == {}
    assert record(resumed)["packing"] == before
    assert record(resumed)["resumed"]


# The solver packs and packs: each trial is found wanting, and the first one tells that it was made.
PACKING = """
import sys
from pathlib import Path
from frit.solver import __main__ as solver, pack_store
from frit.solver.packing import make

def pack(wanted):
    while True:
        make(wanted)
        Path(sys.argv[sys.argv.index("--out") + 1], "packing").touch()

pack_store.make = pack
sys.exit(solver.main())
"""


@pytest.mark.parametrize(("ranks", "number"), [(1, signal.SIGTERM), (1, signal.SIGINT), (2, signal.SIGTERM)])
def test_a_signal_ends_the_packing(tmp_path: Path, ranks: int, number: signal.Signals) -> None:
    """Status 130 and a state; nothing to resume, but the directory can be run in again."""
    directory, case = tmp_path / "run", changed(seed=130)  # no other test's: never in the cache
    with launch(case, directory, ranks, PACKING) as tree:
        tree.until(lambda: (directory / "packing").exists())
        tree.process.send_signal(number)
        status, printed = tree.ended()
        assert tree.gone()
    assert record(directory)["state"] == "interrupted", printed
    assert record(directory)["message"] == "stopped before the first step"
    assert status == 130 or is_open_mpi(mpirun_command(1, [])[0]), printed
    assert not (directory / "particles.csv").exists()
    solve(PACK, directory)


def test_frit_pack_writes_particles_and_a_picture_and_tells_about_them(tmp_path: Path) -> None:
    (tmp_path / "case.json").write_text(json.dumps(PACK))
    status, out, err = frit(tmp_path, "pack", "case.json", "--out", "p.csv")
    assert (status, err) == (0, "")
    _, radii = particle_file.read(tmp_path / "p.csv", 2)
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    for words in ("vacancy box density", "radius, nm", "height, nm", "contacts", "p.csv, p.png"):
        assert words in out
    status, out, err = frit(tmp_path, "pack", "case.json", "--out", "q.csv", "--picture", "here.svg", "--json")
    assert (status, err) == (0, "")
    assert (tmp_path / "here.svg").exists()
    assert (tmp_path / "q.csv").read_bytes() == (tmp_path / "p.csv").read_bytes()
    report = json.loads(out)
    assert set(report["packing"]) >= REALISED
    assert sum(report["coordination"]) == sum(report["radii"]["counts"]) == len(radii)
    assert np.mean(report["profile"]["solid_fraction"]) == pytest.approx(report["packing"]["packing_density"])


def test_frit_pack_refuses_what_cannot_be_packed(tmp_path: Path) -> None:
    (tmp_path / "dense.json").write_text(json.dumps(changed(packing_density=0.95)))
    (tmp_path / "list.json").write_text(json.dumps(PACK | {"particles": {"centres": [[20, 15]], "radii": [5]}}))
    status, out, err = frit(tmp_path, "pack", "dense.json", "--out", "p.csv")
    assert (status, out) == (2, "")
    assert "particles.packing_density = 0.95: cannot be reached" in err
    status, _, err = frit(tmp_path, "pack", "list.json", "--out", "p.csv")
    assert status == 2
    assert "particles.source = 'list': must be 'packing'" in err
    assert not (tmp_path / "p.csv").exists()


def frit(folder: Path, *arguments: str) -> tuple[int, str, str]:
    command = [sys.executable, "-P", "-c", "from frit.service.cli.main import main; main()", *arguments]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    return ended.returncode, ended.stdout, ended.stderr
