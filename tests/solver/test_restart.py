"""A run that was stopped, killed or moved to other ranks ends as one that nobody touched."""

import json
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from launching import (
    PAIR,
    Case,
    Tree,
    different,
    finish,
    held_at,
    history,
    interrupted,
    launch,
    on_mesh,
    record,
    resume,
    solve,
    until_held,
    write_case,
)

# Sums of the same terms, but a loop that starts at another address may add them in another order.
SAME = 1e-12

ADAPTIVE = PAIR | {
    "time": {"integrator": "adaptive", "end": 0.3},
    "output": {"history_every": 0.01, "snapshots": [0.0, 0.17, 0.3]},
}
CASES: dict[str, Case] = {
    "rk2": PAIR,
    "adaptive": ADAPTIVE,
    # Nothing is switched off: rates and contacts' stiffness are carried over from step to step.
    "rk2 on a mesh": on_mesh(PAIR),
    "adaptive on a mesh": on_mesh(ADAPTIVE),
    "carried": ADAPTIVE | {"activation": {"enabled": False, "few_order_parameters": False}},
}

# The solver waits before there is a mesh, as `launching.held_at` does later, until all signals it may get have come.
STARTING = """
import sys, time
from pathlib import Path
from frit.solver import __main__ as solver

make_setup, Requests = solver.make_setup, solver.Requests

class Seen(Requests):
    def __init__(self):
        super().__init__()
        Seen.one = self

def hold(case, ranks, rows):
    Path(sys.argv[sys.argv.index("--out") + 1], f"{ranks.rank}.start").touch()
    while not (Seen.one.checkpoint and Seen.one.end):
        time.sleep(0.005)
    return make_setup(case, ranks, rows)

solver.Requests, solver.make_setup = Seen, hold
sys.exit(solver.main())
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Every case, undisturbed, on one rank."""
    folder = tmp_path_factory.mktemp("whole")
    return {name: solve(case, folder / name) for name, case in CASES.items()}


def checkpoint_step(directory: Path) -> int:
    with h5py.File(directory / "checkpoint.h5") as file:
        return int(file.attrs["step"])


@pytest.mark.parametrize("name", CASES)
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path: Path, whole: dict[str, Path], name: str) -> None:
    directory = interrupted(CASES[name], tmp_path / "run")
    rows, all_rows = history(directory), history(whole[name])
    assert rows[-1]["step"] <= 17 == checkpoint_step(directory)
    assert len(rows) < len(all_rows)
    assert different(whole[name], resume(directory), SAME) == {}


@pytest.mark.parametrize("name", ["rk2", "carried"])
def test_a_resumed_run_is_the_uninterrupted_one_on_two_ranks(tmp_path: Path, name: str) -> None:
    together = solve(CASES[name], tmp_path / "whole", ranks=2)
    directory = interrupted(CASES[name], tmp_path / "run", ranks=2)
    assert different(together, resume(directory, ranks=2), SAME) == {}


@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1)])
def test_another_number_of_ranks_goes_on(tmp_path: Path, whole: dict[str, Path], before: int, after: int) -> None:
    """Agrees as runs on different ranks do, see test_ranks.py; the chunks of the snapshots stay as they were."""
    directory = resume(interrupted(PAIR, tmp_path / "run", before), after)
    assert record(directory)["ranks"] == after
    assert different(whole["rk2"], directory, 1e-10) == {}


@pytest.mark.parametrize("name", ["adaptive", "adaptive on a mesh"])
def test_a_checkpoint_is_the_same_whoever_writes_it(tmp_path: Path, whole: dict[str, Path], name: str) -> None:
    """Bit by bit: three ranks each read their part of a finished run, and write it again."""

    def content() -> dict[str, Any]:
        with h5py.File(directory / "checkpoint.h5") as file:
            fields = {name: (str(field.dtype), field.shape, field[...].tobytes()) for name, field in file.items()}
            return fields | {name: value for name, value in file.attrs.items() if name != "notes"}

    directory = tmp_path / "run"
    shutil.copytree(whole[name], directory)
    written = (directory / "checkpoint.h5").stat().st_mtime_ns
    before = content()
    resume(directory, ranks=3)
    assert content() == before
    assert (directory / "checkpoint.h5").stat().st_mtime_ns > written


def test_usr1_writes_a_checkpoint_and_the_run_goes_on(tmp_path: Path, whole: dict[str, Path]) -> None:
    directory = tmp_path / "run"
    with launch(PAIR, directory, script=held_at(20, 60)) as tree:
        until_held(tree, directory, 1, 20)
        assert checkpoint_step(directory) == 0
        tree.process.send_signal(signal.SIGUSR1)
        until_held(tree, directory, 1, 60)
        assert checkpoint_step(directory) == 20
        assert record(directory)["state"] == "running"
        tree.process.send_signal(signal.SIGUSR1)
        finish(tree, directory)
    assert checkpoint_step(directory) == 100
    assert different(whole["rk2"], directory, SAME) == {}


@pytest.mark.parametrize(
    ("number", "ranks"), [(signal.SIGINT, 1), (signal.SIGINT, 2), (signal.SIGTERM, 2)], ids=["INT-1", "INT-2", "TERM-2"]
)
def test_int_and_term_end_with_a_checkpoint(tmp_path: Path, number: signal.Signals, ranks: int) -> None:
    directory = interrupted(PAIR, tmp_path / "run", ranks, step=20, number=number)
    assert checkpoint_step(directory) == 20
    assert "checkpoint at t = 0.002" in record(directory)["message"]
    assert [row["step"] for row in history(directory) if row["step"] % 10 == 0] == [0, 10, 20]


def test_progress_of_a_resumed_run_makes_nothing_up(tmp_path: Path) -> None:
    """What the last history row would tell is unknown until there is one."""
    directory = interrupted(PAIR, tmp_path / "run")
    with Tree(1, "--resume", directory, "--progress") as tree:
        _, printed = tree.ended()
    first = next(line for line in map(json.loads, printed.splitlines()) if "step" in line)
    assert (first["step"], first["end"], first["vacancy_ratio"], first["live_fraction"]) == (18, 0.01, None, None)
    assert first["evaluations_per_second"] > 0.0
    assert first["remaining"] > 0.0


def test_signals_before_the_first_step_are_heard(tmp_path: Path, whole: dict[str, Path]) -> None:
    """A checkpoint asked for is no reason to die, and after an end asked for the run begins anew."""
    directory = tmp_path / "run"
    with launch(PAIR, directory, ranks=2, script=STARTING) as tree:
        until_held(tree, directory, 2, "start")
        tree.process.send_signal(signal.SIGUSR1)
        tree.process.send_signal(signal.SIGTERM)
        _, printed = tree.ended()
    assert record(directory)["state"] == "interrupted", printed
    assert not (directory / "checkpoint.h5").exists()
    assert different(whole["rk2"], resume(directory), 1e-10) == {}


def test_a_checkpoint_with_slots_to_spare_goes_on(tmp_path: Path, whole: dict[str, Path]) -> None:
    """Slots that were needed once are dealt out anew: the fields must follow their particles."""
    directory = interrupted(on_mesh(PAIR), tmp_path / "run")
    with h5py.File(directory / "checkpoint.h5", "r+") as file:
        for name in ("u", "reference"):
            u = np.zeros((len(file[name]), 16))
            u[:, [0, 1, 9]] = file[name][:, :3]
            del file[name]
            file[name] = u
        for name in ("owner", "reference_owner"):
            owner = np.full((len(u), 9), -1, dtype=np.int32)
            owner[:, [0, 8]] = file[name][...]
            del file[name]
            file[name] = owner
        file["slot_of"][...] = file["reference_slot_of"][...] = [0, 8]
    assert different(whole["rk2 on a mesh"], resume(directory), SAME) == {}


# A frit of before: nodes along the space-filling curve, and a checkpoint that says so.
OLDER = """
import sys
from frit.solver import __main__ as solver, checkpoint

make_setup, checkpoint.FORMAT = solver.make_setup, 2
solver.make_setup = lambda case, ranks, rows: make_setup(case, ranks, False)
"""


@pytest.mark.parametrize("number", [1, 2])
def test_the_checkpoint_of_an_older_frit_goes_on(tmp_path: Path, number: int) -> None:
    """With its own numbers of the nodes: rows, fields and snapshots are those of an older frit that nobody stopped."""
    case = on_mesh(PAIR)
    whole = solve(case, tmp_path / "whole", script=OLDER + "sys.exit(solver.main())")
    directory = tmp_path / "run"
    with launch(case, directory, script=OLDER + held_at(17)) as tree:
        until_held(tree, directory, 1, 17)
        tree.process.send_signal(signal.SIGTERM)
        tree.ended()
    with h5py.File(directory / "checkpoint.h5", "r+") as file:
        assert file.attrs["format"] == 2
        file.attrs["format"] = number
        if number == 1:
            del file["motion"]
    assert different(whole, resume(directory), SAME) == {}


def test_a_finished_run_stays_as_it_is(tmp_path: Path, whole: dict[str, Path]) -> None:
    directory = tmp_path / "run"
    shutil.copytree(whole["adaptive"], directory)
    torn = [directory / name for name in ("run.json.99.new", "checkpoint.h5.new", "snapshots.zarr/rho/0.99.partial")]
    for path in torn:  # of an earlier, killed run
        path.touch()
    assert different(whole["adaptive"], resume(directory), 0.0) == {}
    assert not any(path.exists() for path in torn)


def rows_so_far(directory: Path) -> int:
    """Complete rows of the history."""
    path = directory / "history.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


@pytest.mark.parametrize("kills", [5, pytest.param(20, marks=pytest.mark.slow)])
def test_kill_9_at_any_moment_leaves_no_trace(tmp_path: Path, kills: int) -> None:
    """Every kill is at a moment of its own: while Python starts, in a step, or while rows, chunks, a checkpoint or
    run.json are being written. All but those at the start wait until the run has got on by some of its 200 rows."""
    case = PAIR | {
        "time": {"integrator": "rk2", "end": 0.2, "step": 1e-4},
        "output": {"history_every": 0.001, "snapshots": {"every": 0.005}, "checkpoint_every": 0.05},
    }
    undisturbed = solve(case, tmp_path / "whole")
    row = history(undisturbed)[-1]["wall_time"] / 200
    directory, random = tmp_path / "run", np.random.default_rng(kills)
    path = write_case(directory, case)
    for number in range(kills):
        goes_on = (directory / "checkpoint.h5").exists()
        with Tree(1, "--resume", directory) if goes_on else Tree(1, path, "--out", directory) as tree:
            if number % 4 == 3:
                time.sleep(random.uniform(0.0, 1.0))
            else:
                aim = rows_so_far(directory) + random.integers(1, 200 // kills)
                while tree.process.poll() is None and rows_so_far(directory) < aim:
                    time.sleep(0.2 * row)
                time.sleep(random.uniform(0.0, 2.0 * row))
            tree.kill()
    assert record(directory)["resumed"], "no kill hit the run itself"
    resume(directory)
    assert different(undisturbed, directory, SAME) == {}
    assert [*directory.rglob("*.partial"), *directory.rglob("*.new")] == []
