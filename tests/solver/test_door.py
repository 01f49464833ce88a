"""A run in this process: the same march as under mpirun, with arrays out; whoever listens may end it."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from launching import PAIR, history, snapshots, solve

from frit.solver import CaseError, Moment, SimulationError, load_case, measure, simulate
from frit.solver.door import looks

README = Path(__file__).parents[2] / "solver/README.md"
EXAMPLES = re.findall(r"^```python\n(.*?)^```", README.read_text(), re.M | re.S)
SHORT: dict[str, Any] = PAIR | {"time": {"end": 0.1}, "output": {
    "history_every": 0.02, "history_change": 0.0, "snapshots": [0.0, 0.05, 0.1],
}}  # fmt: skip


def at_row(number: int, act: Any) -> Any:
    """An observer that acts at one row of the history."""
    seen: list[float] = []

    def observe(moment: Moment) -> bool | None:
        seen.append(moment.time)
        return act(moment) if len(seen) == number else None

    return observe


def test_the_package_is_imported_at_once() -> None:
    heavy = "numba", "mpi4py", "numpy", "pydantic", "scipy"
    ask = f"import sys, frit.solver; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-P", "-c", ask], capture_output=True, text=True).stdout == "[]\n"


def test_it_is_the_march_of_the_ranks(tmp_path: Path) -> None:
    """To the last bit that is stored: rows, snapshots and where they are."""
    directory = solve(PAIR, tmp_path / "run")
    result = simulate(load_case(tmp_path / "run.json"))
    assert result.ended == "succeeded"
    drop = {"wall_time": None}
    assert [row | drop for row in result.rows] == [row | drop for row in history(directory)]
    for name, stored in snapshots(directory).items():
        np.testing.assert_array_equal(getattr(result.snapshots, name).astype(stored.dtype), stored)


@pytest.mark.parametrize("source", ["lattice", "triangular", "gmsh", "linear"])
def test_any_nodes_will_do(source: str, request: pytest.FixtureRequest) -> None:
    if source == "gmsh":
        request.getfixturevalue("gmsh")
    changes: dict[str, Any] = {"nodes": {"source": source, "spacing": 1.0}}
    result = simulate(SHORT | ({"shape_functions": {"kind": "linear"}} if source == "linear" else changes))
    seen, last = result.snapshots, result.final
    assert (result.ended, result.notes, seen.time.tolist(), last.time) == ("succeeded", [], [0.0, 0.05, 0.1], 0.1)
    assert seen.rho.shape == seen.particle.shape == seen.eta_squared.shape == (3, len(seen.nodes))
    np.testing.assert_array_equal(last.rho, seen.rho[-1])
    np.testing.assert_array_equal(last.particle, seen.particle[-1])
    etas = np.stack([last.eta(0), last.eta(1)])
    np.testing.assert_allclose((etas**2).sum(axis=0), last.eta_squared, atol=1e-12)
    assert ((etas.argmax(axis=0) == last.particle) | (last.rho < 0.5)).all()
    if source in ("lattice", "linear"):
        assert seen.grid == (14, 23)
        np.testing.assert_allclose(seen.nodes.reshape(14, 23, 2)[3, 5], [5.0, 3.0], atol=1e-12)
    else:
        assert seen.grid is None
    with pytest.raises(IndexError, match=r"particle = 2: must be one of 0 \.\.\. 1"):
        last.eta(2)


def test_the_history_is_arrays_and_a_table() -> None:
    result = simulate(SHORT)
    frame, columns = pd.DataFrame(result.rows), result.history
    assert columns["time"] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08, 0.1])
    assert columns["volumes"].shape == (6, 2)
    assert frame["neck_length"].tolist() == columns["neck_length"].tolist()
    alone = simulate(SHORT | {"particles": {"centres": [[6.5, 6.2]], "radii": [5.0]}})
    assert "neck_length" not in alone.history


def test_an_observer_ends_the_run_and_sees_each_row() -> None:
    kept: list[Moment] = []

    def watch(moment: Moment) -> bool:
        kept.append(moment)
        assert moment.rho.max() > 0.9
        assert moment.row["time"] == moment.time
        return moment.time > 0.03

    result = simulate(SHORT, observer=watch)
    assert (result.ended, len(result.rows), len(kept)) == ("stopped", 3, 3)
    assert 0.04 <= result.final.time < 0.1
    with pytest.raises(RuntimeError, match=r"t = 0\.04 has passed"):
        kept[-1].eta(0)


def test_measures_are_those_of_the_history_and_of_any_box() -> None:
    for changes in ({}, {"nodes": {"source": "triangular", "spacing": 1.0}}):
        result = simulate(SHORT | changes)
        last = measure(result.final)
        assert last.keys() == result.rows[-1].keys() - {"wall_time"}
        for name, value in last.items():  # windows may have been fitted since: round-off
            assert value == pytest.approx(result.rows[-1][name], rel=1e-12)
        whole = measure(result.final, vacancy_box=((0.0, 0.0), (22.0, 13.0)))
        assert 22.0 * 13.0 * (1.0 - whole["vacancy_ratio"]) == pytest.approx(last["solid_mass"], rel=2e-3)
        with pytest.raises(CaseError, match=r"output\.vacancy_box .* must be inside the domain"):
            measure(result.final, vacancy_box=((0.0, 0.0), (22.0, 14.0)))


def test_ctrl_c_gives_what_there_is() -> None:
    def once(moment: Moment) -> None:
        signal.raise_signal(signal.SIGINT)

    def twice(moment: Moment) -> None:
        once(moment)
        once(moment)

    before = signal.getsignal(signal.SIGINT)
    result = simulate(SHORT, observer=at_row(2, once))
    assert result.ended == "interrupted"
    assert 2 <= len(result.rows) < 6
    assert result.final.rho.max() > 0.9
    with pytest.raises(KeyboardInterrupt):
        simulate(SHORT, observer=at_row(2, twice))
    assert signal.getsignal(signal.SIGINT) is before


def test_an_error_brings_what_was_computed() -> None:
    wrong = SHORT | {"time": {"integrator": "rk2", "end": 10.0, "step": 0.5}, "output": {"history_every": 0.5}}
    with np.errstate(all="ignore"), pytest.raises(SimulationError, match=r"step 1, at \(.* likely cause") as error:
        simulate(wrong)
    assert (error.value.result.ended, len(error.value.result.rows)) == ("failed", 1)
    with pytest.raises(ZeroDivisionError):
        simulate(SHORT, observer=lambda moment: bool(1 / 0))


def test_refusals_name_the_value() -> None:
    with pytest.raises(CaseError, match=r"time\.end = -1\.0: must be greater than 0"):
        simulate(SHORT | {"time": {"end": -1.0}})
    with pytest.raises(CaseError, match=r"none\.toml: cannot be read"):
        simulate("none.toml")


def test_what_a_user_should_know_is_a_warning() -> None:
    wide = SHORT | {"nodes": {"source": "gmsh", "spacing": 1.0}, "shape_functions": {"width": 2.5}}
    with pytest.warns(UserWarning, match="width"):
        result = simulate(wide, observer=lambda moment: True)
    assert len(result.notes) == 1


def test_packings_are_packed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRIT_CACHE_DIR", str(tmp_path))
    box = [[1.0, 1.0], [21.0, 12.0]]
    particles = {"source": "packing", "mean_radius": 3.0, "count": 4, "seed": 1, "container": box}
    result = simulate(SHORT | {"particles": particles}, observer=lambda moment: True)
    assert len(result.case.particles.radii) == 4
    assert result.history["volumes"].shape == (1, 4)


def test_a_bar_is_shown_to_those_who_look(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate(SHORT)
    assert capsys.readouterr() == ("", "")
    monkeypatch.setenv("COLUMNS", "60")
    simulate(SHORT, progress=True)
    said = capsys.readouterr().err
    assert max(map(len, said.split("\r"))) == 60  # with the end of the line
    assert said.startswith("\rpreparing")
    assert "100%, t = 0.1 of 0.1, step " in said
    assert said.endswith("\n")
    state = SimpleNamespace(time=2.5, step=12, evaluations=99)
    line = looks(state, {"vacancy_ratio": 0.25}, 10.0, 30.0)
    assert line == "[######..................]  25%, t = 2.5 of 10, step 12, vacancy ratio 0.2500, 1:30 left"


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    names: dict[str, Any] = {}
    for example in EXAMPLES[:3]:
        exec(example, names)
    said = capsys.readouterr().out
    assert "stopped" in said
    assert names["result"].rows[-1]["neck_length"] > 7.0
    assert os.listdir() == ["two.png"]
