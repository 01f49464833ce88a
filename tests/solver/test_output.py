"""The run directory: what it holds, when a reader sees it, and whose it is."""

import json
import signal
import stat
from collections.abc import Callable
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from launching import (
    PAIR as CHANGING,
)
from launching import (
    Case,
    Tree,
    different,
    held_at,
    history,
    launch,
    record,
    relative,
    snapshots,
    solve,
    until_held,
    write_case,
)

from frit.solver import field, output
from frit.solver.case import load_case, parse_case
from frit.solver.output import History, Snapshots
from frit.solver.partition import Collector, Ranks
from frit.solver.setup import MeshSetup, make_setup

ROW = [
    "time", "step", "vacancy_ratio", "solid_mass", "free_energy", "live_fraction", "evaluated_fraction",
    "rho_min", "rho_max", "particles", "volumes", "evaluations", "wall_time", "pack_porosity",
]  # fmt: skip
# Rows at multiples alone: those where the vacancy ratio moves are in test_change_rows.py.
PAIR = CHANGING | {"output": CHANGING["output"] | {"history_change": 0.0}}
KEEPING = PAIR | {"output": PAIR["output"] | {"keep_checkpoint": True}}
OF_A_PAIR = ["neck_length", "centre_distance"]
TRIPLE = PAIR | {
    "domain": {"size": [21.0, 18.0]},
    "particles": {"centres": [[5.8, 5.5], [14.2, 6.1], [9.6, 12.8]], "radii": [4.4, 4.1, 3.8]},
    "time": {"integrator": "rk2", "end": 0.002, "step": 1e-4},
    "output": {"history_every": 0.0007, "history_change": 0.0, "snapshots": {"every": 0.0006}},
}

# Chunks of 37 nodes: both ranks write several, and the last one is not full.
SMALL_CHUNKS = """
import sys
from frit.solver import __main__ as solver
solver.output.BLOCK = 37
sys.exit(solver.main())
"""


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return solve(PAIR, tmp_path_factory.mktemp("output") / "pair")


@pytest.fixture(scope="module")
def triple(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return solve(TRIPLE, tmp_path_factory.mktemp("output") / "triple")


# --- what is there --------------------------------------------------------------------------------------


def test_the_directory_holds_what_is_promised(pair: Path) -> None:
    promised = {"case.json", "run.json", "history.jsonl", "snapshots.zarr", "checkpoint.h5", "log.txt"}
    assert {path.name for path in pair.iterdir()} == promised


def test_a_row_of_a_pair(pair: Path) -> None:
    rows = history(pair)
    assert all(list(row) == ROW + OF_A_PAIR for row in rows)
    assert [row["time"] for row in rows] == [k * 0.001 for k in range(10)] + [0.01]
    assert [row["step"] for row in rows] == list(range(0, 101, 10))
    assert [row["evaluations"] for row in rows] == list(range(0, 201, 20))
    last = rows[-1]
    assert (last["particles"], len(last["volumes"])) == (2, 2)
    assert 0.0 < last["live_fraction"] <= 1.0
    assert 0.0 < last["vacancy_ratio"] < 0.3
    assert -0.05 < last["rho_min"] < 0.01 < 0.99 < last["rho_max"] < 1.1
    assert 0.0 < last["neck_length"] < 8.0  # at most the smaller disc's diameter
    assert last["centre_distance"] == pytest.approx(8.9, abs=0.5)
    assert all(a["wall_time"] <= b["wall_time"] for a, b in pairwise(rows))


def test_neck_and_distance_are_of_two_particles_only(triple: Path) -> None:
    rows = history(triple)
    assert all(list(row) == ROW for row in rows)
    assert len(rows[0]["volumes"]) == rows[0]["particles"] == 3


def test_rows_come_at_multiples_and_at_the_end(triple: Path) -> None:
    """Not only at the ends of equal steps: 0.0007 is no multiple of 0.002, the end of the run."""
    assert [row["time"] for row in history(triple)] == [0.0, 0.0007, 2 * 0.0007, 0.002]


def test_case_json_is_the_whole_case(pair: Path) -> None:
    tree = json.loads((pair / "case.json").read_text())
    case = parse_case(tree)
    assert case == parse_case(KEEPING) == load_case(pair / "case.json")
    assert case.identity() == record(pair)["case"]
    assert json.loads(case.resolved_json()) == tree
    assert tree["model"]["kappa_rho"] == 10.0
    assert tree["activation"] == {"enabled": True, "eps_rho": 1e-5, "eps_eta": 1e-5, "few_order_parameters": True}
    assert tree["output"]["checkpoint_every"] == 60.0
    # 80 % of the box around the discs, about its centre.
    box = [[1.5 + 1.79, 1.2 + 1.0], [19.4 - 1.79, 11.2 - 1.0]]
    np.testing.assert_allclose(tree["output"]["vacancy_box"], box, rtol=1e-12)


def test_run_json_says_who_what_when(pair: Path) -> None:
    told = record(pair)
    assert {key: told[key] for key in ("state", "message", "name", "ranks", "resumed")} == {
        "state": "succeeded",
        "message": None,
        "name": "untitled",
        "ranks": 1,
        "resumed": [],
    }
    assert told["seeds"] == {"particles": None}
    assert isinstance(told["host"], str)
    assert {"python", "mpi", "frit", "numpy", "numba", "scipy", "mpi4py", "h5py", "zarr"} <= set(told["versions"])
    assert told["versions"]["numpy"] == np.__version__
    start, end = (datetime.fromisoformat(told[key]) for key in ("start", "end"))
    assert start.tzinfo is not None
    assert start <= end


def test_log_tells_what_happens(pair: Path) -> None:
    """From start to end; compiling is told only where it came to that."""
    told = [line.split(maxsplit=1)[1] for line in (pair / "log.txt").read_text().splitlines()]
    order = ["start: ", "set-up", "steps", "succeeded"]
    places = [next(i for i, line in enumerate(told) if line.startswith(words)) for words in order]
    assert places == sorted(places)
    assert places[-1] == len(told) - 1


# --- snapshots ------------------------------------------------------------------------------------------


def test_snapshots_are_a_zarr_group_that_explains_itself(pair: Path) -> None:
    group = zarr.open_group(pair / "snapshots.zarr", mode="r")
    assert group.metadata.zarr_format == 3
    assert group.attrs["length_unit"] == "nm"
    count = 0
    expected: dict[str, tuple[str, tuple[str, ...], str]] = {
        "nodes": ("float64", ("node", "axis"), "nm"),
        "time": ("float64", ("time",), "1"),
        "rho": ("float32", ("time", "node"), "1"),
        "eta_squared": ("float32", ("time", "node"), "1"),
        "particle": ("int32", ("time", "node"), "1"),
    }
    for name, array in group.arrays():
        metadata: Any = array.metadata
        assert (str(array.dtype), metadata.dimension_names, array.attrs["units"]) == expected[name]
        assert array.attrs["long_name"]
        count += 1
    assert count == len(expected)


def test_snapshots_hold_the_fields_at_the_times_asked_for(pair: Path) -> None:
    found = snapshots(pair)
    assert found["time"].tolist() == [0.0, 0.0035, 0.01]
    nodes = make_setup(parse_case(PAIR), Ranks()).positions()
    np.testing.assert_array_equal(found["nodes"], nodes)
    assert all(found[name].shape == (3, len(nodes)) for name in ("rho", "eta_squared", "particle"))
    assert (found["particle"] >= -1).all()
    assert (found["particle"] <= 1).all()
    # At t = 0 a node with rho >= 1/2 belongs to the disc that it lies in.
    solid = found["rho"][0] >= 0.5
    assert ((found["particle"][0] >= 0) == solid).all()
    away = [np.linalg.norm(nodes - c, axis=1) - r for c, r in zip([[6.5, 6.2], [15.4, 6.8]], [5, 4], strict=True)]
    assert (found["particle"][0][solid] == np.argmin(away, axis=0)[solid]).all()
    # sum eta^2 is 1 in a particle and 0 outside: the tails of the profile, exp(-2 d / xi), at 4 nm, which the functions
    # smooth: means over a variance s^2 = 1 / (2 gamma) nm^2 along each axis multiply exp(2 r) by
    # exp((4 + 2 / r) s^2 / 2), which is 2.3 where r, the distance from the middle of a disc, is 1 nm.
    assert found["eta_squared"][0][np.min(away, axis=0) < -4.0] == pytest.approx(1.0, abs=2.3 * 2 * np.exp(-8.0))
    assert found["eta_squared"][0][np.min(away, axis=0) > 4.0] == pytest.approx(0.0, abs=np.exp(-8.0))


def test_snapshot_times_may_be_regular(triple: Path) -> None:
    assert snapshots(triple)["time"].tolist() == [0.0, 0.0006, 2 * 0.0006, 3 * 0.0006]


@pytest.mark.parametrize("source", ["lattice", "triangular"])
def test_two_ranks_write_the_snapshots_of_one(tmp_path: Path, pair: Path, source: str) -> None:
    case = PAIR | {"nodes": {"source": source, "spacing": 1.0}}
    alone = pair if source == "lattice" else solve(case, tmp_path / "alone")
    together = solve(case, tmp_path / "run", ranks=2, script=SMALL_CHUNKS)
    chunks = zarr.open_array(together / "snapshots.zarr", path="rho", mode="r")
    assert chunks.chunks == (1, 37)
    assert chunks.shape[1] % 37 != 0
    assert different(alone, together, 1e-10) == {}  # see test_ranks.py


@pytest.fixture
def writer(tmp_path: Path, ranks: Ranks) -> tuple[Snapshots, output.Fields]:
    """Snapshots of the pair, made by this process, and the fields at time 0."""
    case = parse_case(PAIR)
    setup = make_setup(case, ranks)
    scheme, state, _ = setup.start()
    collector = Collector(setup.share(scheme), 100)
    fields = setup.fields(scheme, state, scheme.at(state, scheme.vector(state)), collector)
    assert fields is not None
    return Snapshots(tmp_path, case, setup.positions, collector, fresh=True), fields


def seen(path: Path) -> set[int]:
    """The lengths that a reader sees."""
    return {array.shape[0] for name, array in zarr.open_group(path, mode="r").arrays() if name != "nodes"}


@pytest.mark.parametrize("moment", ["_publish", "consolidate"])
def test_a_snapshot_is_invisible_until_it_is_complete(
    writer: tuple[Snapshots, output.Fields], monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """After the chunks are written, and after the arrays have grown, a reader still sees what was there before."""
    snapshot, fields = writer
    owner: Any = Snapshots if moment == "_publish" else output
    real: Callable[..., None] = getattr(owner, moment)
    before = []

    def look(*arguments: Any) -> None:
        before.append(seen(snapshot.path))
        real(*arguments)

    monkeypatch.setattr(owner, moment, look)
    for number in range(3):
        snapshot.write(number, 0.5 * number, fields)
        assert seen(snapshot.path) == {number + 1}
    assert before == [{0}, {1}, {2}]
    found = zarr.open_group(snapshot.path, mode="r")
    assert np.asarray(found["time"]).tolist() == [0.0, 0.5, 1.0]
    for name, values in fields._asdict().items():
        kept = np.asarray(found[name])
        np.testing.assert_array_equal(kept[2], values.astype(kept.dtype))


@pytest.mark.parametrize("source", ["lattice", "triangular"])
def test_a_snapshot_holds_the_field_not_the_coefficients(ranks: Ranks, source: str) -> None:
    case = parse_case(PAIR | {"nodes": {"source": source, "spacing": 1.0}})
    setup = make_setup(case, ranks)
    scheme, state, _ = setup.start()
    fields = setup.fields(scheme, state, scheme.at(state, scheme.vector(state)), Collector(setup.share(scheme), 100))
    assert fields is not None
    if isinstance(setup, MeshSetup):
        coefficients = state.rho
        exact = field.at(case, setup.mesh, setup.mesh.nodes, state.u)[:, 0]
    else:
        coefficients = scheme.lattice.values(state.y).ravel()
        x, y = (axis.at(axis.nodes) for axis in (scheme.lattice.axes[2], scheme.lattice.axes[0]))
        exact = (y @ scheme.lattice.values(state.y)[:, 0] @ x.T).ravel()
    np.testing.assert_allclose(fields.rho, exact, rtol=0, atol=1e-13)
    assert np.abs(exact - coefficients).max() > 0.01


@pytest.mark.parametrize("moment", ["_publish", "consolidate"])
def test_a_snapshot_cut_short_is_written_again(
    writer: tuple[Snapshots, output.Fields], monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """As a resumed run does. Cut short just before it becomes visible it is stored, but nobody sees it yet."""

    def cut(*_: Any) -> None:
        raise KeyboardInterrupt

    snapshot, fields = writer
    with monkeypatch.context() as patch:
        patch.setattr(Snapshots if moment == "_publish" else output, moment, cut)
        with pytest.raises(KeyboardInterrupt):
            snapshot.write(0, 0.0, fields)
    assert seen(snapshot.path) == {0}
    snapshot.write(0, 0.0, fields)
    snapshot.write(0, 0.0, fields)
    assert seen(snapshot.path) == {1}


def test_a_snapshot_out_of_turn_gives_way_to_those_that_were_asked_for(
    writer: tuple[Snapshots, output.Fields],
) -> None:
    """That of a failure comes behind those before it; a resumed run, which gets farther, writes over it."""
    snapshot, fields = writer
    snapshot.write(0, 0.0, fields)
    for time in (0.003, 0.0034):
        assert snapshot.next(time) == 1
        snapshot.write(snapshot.next(time), time, fields)
        group = zarr.open_group(snapshot.path, mode="r")
        assert np.asarray(group["time"]).tolist() == [0.0, time]
    snapshot.write(1, 0.0035, fields._replace(rho=0.5 * fields.rho))
    group = zarr.open_group(snapshot.path, mode="r")
    assert np.asarray(group["time"]).tolist() == [0.0, 0.0035]
    np.testing.assert_allclose(np.asarray(group["rho"])[1], 0.5 * np.asarray(group["rho"])[0], rtol=1e-13)


def test_values_at_half_belong_to_the_particle() -> None:
    """rho = 1/2 is solid: the owner is the particle with the largest eta, wherever its slot is."""
    u = np.zeros((3, 8))
    u[:, :3] = [[0.5, 0.2, 0.3], [0.49, 0.2, 0.3], [0.9, 0.8, 0.1]]
    owner = np.array([[4, 7], [4, 7], [7, 4]], dtype=np.int32)
    fields = output.fields_of(u, owner)
    assert fields.particle.tolist() == [7, -1, 7]
    assert relative(np.array([0.13, 0.13, 0.65]), fields.eta_squared) < 1e-15


# --- the history's file ---------------------------------------------------------------------------------


def test_history_drops_what_came_after_the_checkpoint(tmp_path: Path) -> None:
    """And a torn last line, which may even look complete."""
    first = History(tmp_path)
    for step in range(4):
        first.append({"time": 0.1 * step, "step": step})
    first.close()
    with open(tmp_path / "history.jsonl", "a") as file:
        file.write('{"time": 0.15}')
    again = History(tmp_path, after=0.1)
    assert [row["step"] for row in history(tmp_path)] == [0, 1]
    again.append({"time": 0.2, "step": 2})
    assert [row["step"] for row in history(tmp_path)] == [0, 1, 2]
    again.close()
    History(tmp_path).close()
    assert history(tmp_path) == []


def test_history_refuses_what_json_cannot_say(tmp_path: Path) -> None:
    rows = History(tmp_path)
    with pytest.raises(ValueError, match="JSON"):
        rows.append({"time": np.nan})
    rows.close()
    assert (tmp_path / "history.jsonl").read_text() == ""


# --- whose directory it is ------------------------------------------------------------------------------


def content(directory: Path) -> dict[Path, bytes]:
    files = (path for path in directory.rglob("*") if stat.S_ISREG(path.stat().st_mode))
    return {path: path.read_bytes() for path in files}


def refused(*arguments: str | Path, ranks: int = 1) -> str:
    """What a solver says that ends with 2."""
    with Tree(ranks, *arguments) as tree:
        status, printed = tree.ended()
        assert tree.gone()
    assert status == 2, printed
    return printed


def test_a_second_solver_is_refused_and_touches_nothing(tmp_path: Path) -> None:
    """Fresh or resumed, on any number of ranks, and even with a case that is refused itself."""
    directory = tmp_path / "run"
    wrong: Case = PAIR | {"time": {"end": -1.0}}
    with launch(PAIR, directory, script=held_at(50)) as tree:
        until_held(tree, directory, 1, 50)
        before = content(directory)
        assert "another process is running here" in refused("--resume", directory)
        assert "another process is running here" in refused(directory.with_suffix(".json"), "--out", directory, ranks=2)
        assert "another process is running here" in refused(write_case(tmp_path / "wrong", wrong), "--out", directory)
        assert content(directory) == before
        tree.process.send_signal(signal.SIGTERM)
        tree.ended()
    assert record(directory)["state"] == "interrupted"

    before = content(directory)
    assert "go on with --resume" in refused(directory.with_suffix(".json"), "--out", directory)
    assert content(directory) == before


def test_resuming_nothing_is_refused(tmp_path: Path) -> None:
    assert "no such folder" in refused("--resume", tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    (tmp_path / "empty").mkdir()
    assert "no checkpoint.h5 to resume from" in refused("--resume", tmp_path / "empty", ranks=2)


@pytest.mark.parametrize(
    "arguments", [[], ["case.toml"], ["--out", "x"], ["case.toml", "--resume", "x"], ["--out", "x", "--resume", "x"]]
)
def test_wrong_arguments_are_refused(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from frit.solver.__main__ import read_arguments

    monkeypatch.setattr("sys.argv", ["frit.solver", *arguments])
    with pytest.raises(SystemExit, match="2"):
        read_arguments()
    assert "give either CASE --out DIR or --resume DIR" in capsys.readouterr().err
