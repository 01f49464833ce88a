"""What the READMEs show works, word for word: cases and sweeps in the real reader, commands and scripts in their order.

The solver behind the commands is a stand-in, which writes what a run of the case would leave; pictures, tables and
answers are made of that by the real code.
"""

import json
import math
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from asking import listening
from typer.testing import CliRunner

from frit.service.cli.main import app
from frit.solver.case import load_case, parse_case
from frit.solver.output import consolidate, create_group
from frit.sweeps.definition import load_sweep
from frit.sweeps.expand import expand

ROOT = Path(__file__).resolve().parents[1]
while not (ROOT / "pyproject.toml").exists():
    ROOT = ROOT.parent

FENCED = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
# In the place of mpirun: `template` holds a run that is copied to where the command wants one.
STAND_IN = """#!{python}
import json, pathlib, shutil, sys
if "--version" in sys.argv:
    print("HYDRA build details")
    sys.exit()
if "--out" not in sys.argv:
    sys.exit("only fresh runs are stood in for")
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
case = sys.argv[sys.argv.index("--out") - 1]
out.mkdir(parents=True, exist_ok=True)
for path in pathlib.Path({template!r}).iterdir():
    copy = shutil.copytree if path.is_dir() else shutil.copy
    copy(path, out / path.name)
if case.endswith(".json"):
    shutil.copy(case, out / "case.json")
(out / "run.json").write_text(json.dumps({{"state": "succeeded", "message": None, "ranks": 1, "start": "0"}}))
"""


def blocks(file: str, kind: str) -> list[str]:
    """Code of that kind in a README."""
    text = (ROOT / file).read_text(encoding="utf-8")
    return [code for found, code in FENCED.findall(text) if found == kind]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where the READMEs' files are, with a stand-in for mpirun."""
    made = tmp_path_factory.mktemp("readme")
    for file in ("README.md", "sweeps/README.md"):
        for code in blocks(file, "toml"):
            if name := re.match(r"# (\S+\.toml)\n", code):
                (made / name[1]).write_text(code)
    template = write_template(made)
    program = made / "stand-in"
    program.write_text(STAND_IN.format(python=sys.executable, template=str(template)))
    program.chmod(0o755)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FRIT_MPIRUN", str(program))
        patch.setenv("FRIT_FREE_DISK", "0")
        patch.chdir(made)
        yield made


def write_template(folder: Path) -> Path:
    """A run of two.toml: shrinking discs at its snapshot times, a vacancy ratio that falls."""
    template, case = folder / "template", load_case(folder / "two.toml")
    template.mkdir()
    (template / "case.json").write_text(case.resolved_json())
    rows = [
        {"time": t, "step": int(10 * t), "vacancy_ratio": 0.15 + 0.1 * math.exp(-t), "particles": 2}
        for t in np.linspace(0, 10, 41).tolist()
    ]
    (template / "history.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    nodes = np.stack(np.meshgrid(np.arange(0, 101.0), np.arange(0, 61.0)), axis=-1).reshape(-1, 2)
    store = template / "snapshots.zarr"
    create_group(store, case, len(nodes), len(nodes))
    gap = np.linalg.norm(nodes[:, None] - [[30.0, 30.0], [70.0, 30.0]], axis=-1) - 20.0
    eta = 0.5 * (1 - np.tanh(gap))
    fields = {"rho": eta.max(axis=1), "eta_squared": (eta**2).sum(axis=1), "particle": gap.argmin(axis=1)}
    fields["particle"][gap.min(axis=1) > 0] = -1
    times = np.array(case.output.snapshot_times(case.time.end))
    zarr.open_array(store, path="nodes", mode="r+")[:] = nodes
    for name, values in (*fields.items(), ("time", times)):
        array = zarr.open_array(store, path=name, mode="r+")
        array.resize((len(times), *array.shape[1:]))
        array[:] = values if name == "time" else np.tile(values, (len(times), 1))
    consolidate(store)
    return template


def commands(file: str, section: str) -> list[str]:
    """Lines `frit ...` of a section, without their comments."""
    text = (ROOT / file).read_text(encoding="utf-8")
    part = re.search(rf"^## {re.escape(section)}\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    assert part is not None, f"{file} has no section {section}"
    found = [code for kind, code in FENCED.findall(part[1]) if not kind]
    lines = [line.partition(" #")[0].strip() for line in "".join(found).splitlines()]
    return [line for line in lines if line.startswith("frit ")]


def test_every_case_and_sweep_is_accepted(folder: Path) -> None:
    assert load_case(folder / "two.toml").output.snapshot_times(10.0) == (0.0, 2.5, 5.0, 7.5, 10.0)
    assert load_case(folder / "case.toml").particles.source == "packing"
    assert len(expand(load_sweep(folder / "density.toml")).points) == 36
    drawn = expand(load_sweep(folder / "hypercube.toml"))
    assert len({point.parameters["particles.packing_density"] for point in drawn.points}) == 16
    named = {code.splitlines()[0] for file in ("README.md", "sweeps/README.md") for code in blocks(file, "toml")}
    assert named == {f"# {name}.toml" for name in ("two", "case", "density", "hypercube")}, "none is left out"
    for path in sorted((ROOT / "sweeps").glob("*/*.toml")):
        load_case(path)
    expand(load_sweep(ROOT / "sweeps" / "quick.toml"))


def test_commands_and_then_scripts_do_what_they_say(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for file, section in (
        ("README.md", "Run a case"), ("README.md", "Packings and sweeps"), ("sweeps/README.md", "A sweep file"),
    ):  # fmt: skip
        run_commands(folder, file, section)
    for file in ("README.md", "sweeps/README.md"):
        run_scripts(folder, file, monkeypatch)


def run_commands(folder: Path, file: str, section: str) -> None:
    lines = commands(file, section)
    assert len(lines) >= 3
    for line in lines:
        done = CliRunner().invoke(app, shlex.split(line)[1:])
        assert done.exit_code == 0, f"{line}\n{done.output}\n{done.exception!r}"
        assert "note: there is no snapshot near" not in done.output, f"{line}: the case stores what is drawn"
        for name in re.findall(r"--out (\S+)", line):
            assert (folder / name).stat().st_size > 1000, line
    if section == "Packings and sweeps":
        assert "lowest vacancy ratio: " in done.output


def run_scripts(folder: Path, file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the place of the service's address, that of one which listens here."""
    codes = blocks(file, "python")
    assert codes
    with listening(folder / "served", free_disk=0) as url:
        monkeypatch.setenv("FRIT_URL", url)
        for code in codes:
            names: dict[str, Any] = {}
            exec(compile(code.replace("http://127.0.0.1:8000", url), file, "exec"), names)
            if "c" in names:
                names["c"].close()


def test_examples_of_the_interface_are_cases() -> None:
    from frit.service.http.views import EXAMPLE_CASE

    assert parse_case(EXAMPLE_CASE).name == "two equal discs"
