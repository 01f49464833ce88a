"""The real solver under the real mpirun: tiny cases, signals, kills, and what a run directory holds.

Processes carry a mark in their environment, so that one which outlives its mpirun is seen. Waiting has no limit but
`TIMEOUT`, which is there for hangs: nothing is measured by a clock.
"""

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
import psutil
import zarr

from frit.service.jobs.launch import OPEN_MPI, clean_environment, is_open_mpi, mpirun_command, solver_arguments
from frit.solver.arrays import Array

Case = dict[str, dict[str, Any]]

TIMEOUT = 240.0  # seconds

# Two touching discs that are alike in nothing, so that no value is decided by a tie; 100 steps.
PAIR: Case = {
    "domain": {"size": [22.0, 13.0]},
    "nodes": {"spacing": 1.0},
    "particles": {"centres": [[6.5, 6.2], [15.4, 6.8]], "radii": [5.0, 4.0]},
    "time": {"integrator": "rk2", "end": 0.01, "step": 1e-4},
    "output": {"history_every": 0.001, "snapshots": [0.0, 0.0035, 0.01]},
}

# Two discs between two walls: rho exceeds this rho_0 in their contact, which drives them apart and into the walls.
PRESSED: Case = {
    "domain": {"size": [16.0, 10.0]},
    "nodes": {"spacing": 1.0},
    "particles": {"centres": [[4.0, 5.0], [12.0, 5.0]], "radii": [4.0, 4.0]},
    "model": {"rho_0": 0.5},
    "time": {"end": 0.3},
    "output": {"history_every": 0.05},
}

def on_mesh(case: Case) -> Case:
    """The case on a triangular lattice, or a body-centred one: nodes and points of a mesh."""
    return case | {"nodes": {"source": "triangular", "spacing": 1.0}}


# The solver waits for a signal after the given steps; see `held_at` and `until_held`.
HELD = """
import sys, time
from frit.solver import __main__ as solver

after_step, steps = solver.Recorder.after_step, {steps}

def hold(self, scheme, state, integrator):
    if state.step in steps:
        (self.directory / f"{self.ranks.rank}.{state.step}").touch()
        while not (self.requests.checkpoint or self.requests.end):
            time.sleep(0.005)
    return after_step(self, scheme, state, integrator)

solver.Recorder.after_step = hold
sys.exit(solver.main())
"""


class Tree:
    """An mpirun and all that it starts; leaving the `with` block kills what is left."""

    def __init__(self, ranks: int, *arguments: str | Path, script: str | None = None) -> None:
        """script: Python source to run in the place of `-m frit.solver`."""
        program = solver_arguments() if script is None else [sys.executable, "-P", "-c", script]
        command = mpirun_command(ranks, [])[: -len(solver_arguments())] + program
        environment = (OPEN_MPI if is_open_mpi(command[0]) else {}) | clean_environment(os.environ)
        self.mark = uuid.uuid4().hex
        self.process = subprocess.Popen(
            [*command, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment | {"FRIT_TEST_MARK": self.mark},
            start_new_session=True,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        if self.process.stdout:
            self.process.stdout.close()

    def ended(self) -> tuple[int, str]:
        """The exit status of mpirun and all that was printed, once it has ended."""
        printed, _ = self.process.communicate(timeout=TIMEOUT)
        return self.process.returncode, printed

    def alive(self) -> list[int]:
        """Processes that carry the mark; a zombie carries nothing."""
        found = []
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.environ().get("FRIT_TEST_MARK") == self.mark:
                    found.append(process.pid)
        return found

    def gone(self) -> bool:
        """Whether nobody is left; who is about to end gets the time for it."""
        deadline = time.monotonic() + 20.0
        while self.alive() and time.monotonic() < deadline:
            time.sleep(0.02)
        return not self.alive()

    def kill(self) -> None:
        """kill -9, until nobody is left who could start another."""
        while pids := self.alive():
            for pid in pids:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        self.process.wait(TIMEOUT)

    def until(self, happened: Callable[[], bool]) -> None:
        """Wait while it runs; an end before that is an error."""
        deadline = time.monotonic() + TIMEOUT
        while not happened():
            assert self.process.poll() is None, f"ended before: {self.ended()}"
            assert time.monotonic() < deadline
            time.sleep(0.005)


def write_case(directory: Path, case: Case) -> Path:
    """As a JSON file beside the run directory; the checkpoint stays for those who compare its fields."""
    path = directory.with_suffix(".json")
    path.write_text(json.dumps({**case, "output": {"keep_checkpoint": True, **case.get("output", {})}}))
    return path


def launch(case: Case, directory: Path, ranks: int = 1, script: str | None = None) -> Tree:
    """A fresh run."""
    return Tree(ranks, write_case(directory, case), "--out", directory, script=script)


def solve(case: Case, directory: Path, ranks: int = 1, script: str | None = None) -> Path:
    """Run to the end, which must be a good one."""
    with launch(case, directory, ranks, script) as tree:
        finish(tree, directory)
    return directory


def resume(directory: Path, ranks: int = 1) -> Path:
    """Go on to the end, which must be a good one."""
    with Tree(ranks, "--resume", directory) as tree:
        finish(tree, directory)
    return directory


def finish(tree: Tree, directory: Path) -> None:
    """Wait for a good end."""
    status, printed = tree.ended()
    assert status == 0, printed
    assert record(directory)["state"] == "succeeded"


def held_at(*steps: int) -> str:
    """The solver's script, which waits for a signal after these steps."""
    return HELD.replace("{steps}", str(steps))


def until_held(tree: Tree, directory: Path, ranks: int, where: object) -> None:
    """Wait until all ranks wait: the file "<rank>.<step>" in the run directory tells that they do."""
    tree.until(lambda: all((directory / f"{rank}.{where}").exists() for rank in range(ranks)))


def interrupted(
    case: Case, directory: Path, ranks: int = 1, step: int = 17, number: signal.Signals = signal.SIGTERM
) -> Path:
    """A run that got a signal after the step, and ended as it should."""
    with launch(case, directory, ranks, held_at(step)) as tree:
        until_held(tree, directory, ranks, step)
        tree.process.send_signal(number)
        _, printed = tree.ended()
        assert tree.gone()
    assert record(directory)["state"] == "interrupted", printed
    return directory


# --- what a run directory holds


def record(directory: Path) -> dict[str, Any]:
    """run.json; empty before it is there."""
    path = directory / "run.json"
    return dict(json.loads(path.read_text())) if path.exists() else {}


def history(directory: Path) -> list[dict[str, Any]]:
    """The complete rows so far."""
    path = directory / "history.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


def columns(directory: Path) -> dict[str, Array]:
    """The history but for wall_time, by column; None becomes NaN."""
    rows = history(directory)
    return {key: np.array([row[key] for row in rows], dtype=float) for key in rows[0] if key != "wall_time"}


def final_fields(directory: Path) -> dict[str, Array]:
    """The fields of checkpoint.h5, and where they belong: by slots, or by windows."""
    names = {"u", "owner", "slot_of", "y", "window_low", "window_size", "window_begin", "window_end"}
    with h5py.File(directory / "checkpoint.h5") as file:
        return {name: np.asarray(file[name]) for name in file if name in names}


def snapshots(directory: Path) -> dict[str, Array]:
    """All arrays of snapshots.zarr as a reader sees them."""
    group = zarr.open_group(directory / "snapshots.zarr", mode="r")
    return {name: np.asarray(array) for name, array in group.arrays()}


def different(a: Path, b: Path, tolerance: float) -> dict[str, float]:
    """What differs by more than the tolerance between two runs: the largest difference over the largest value.

    Columns of the history but for wall_time, fields of the checkpoint, arrays of the snapshots: these have 32 bits, of
    which the last may be rounded either way.
    """
    found = {}
    for read in (columns, final_fields, snapshots):
        left, right = read(a), read(b)
        assert left.keys() == right.keys()
        for name in left:
            allowed = max(tolerance, 2.0**-23) if left[name].dtype == np.float32 and tolerance else tolerance
            if (change := relative(left[name], right[name])) > allowed:
                found[f"{read.__name__} {name}"] = change
    return found


def relative(a: Array, b: Array) -> float:
    """max |a - b| / max |a|; infinite where the shapes or the missing values differ."""
    if a.shape != b.shape or not np.array_equal(np.isnan(a), np.isnan(b)):
        return np.inf
    known = ~np.isnan(a)
    scale = np.abs(a[known]).max(initial=0.0)
    return float(np.abs(a[known].astype(float) - b[known]).max(initial=0.0) / (scale or 1.0))
