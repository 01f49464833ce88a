"""`mpirun -n N python -P -m frit.solver CASE --out DIR` runs a case, `... --resume DIR` goes on with one, or begins it
anew where it was killed before its first checkpoint.

Signals: USR1 writes a checkpoint, TERM and INT write one and end the run. The end is told by run.json (`state`:
running, succeeded, failed, interrupted, refused), because MPI libraries differ in the exit codes they pass on.
"""

import argparse
import json
import os
import platform
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from . import checkpoint, output
from .arrays import Floats
from .case import Case, CaseError, load_case
from .checkpoint import CheckpointError
from .ended import SUCCEEDED, read_run
from .failure import comes_again, told
from .geometry import MeshError
from .integrators import Integrator
from .pack_store import place
from .particle_file import ParticleFileError
from .partition import Collector, Ranks, mpi_library
from .revision import recorded, revision_of
from .run import Ending, RunError, has_moved, piled_up, run
from .setup import Setup, make_setup
from .shape import ShapeError
from .system import Progress, System
from .telling import Teller, add_to_log

REFUSALS = (CaseError, MeshError, ShapeError, CheckpointError, ParticleFileError, output.DirectoryError)
PROGRESS_EVERY = 0.25  # seconds between two progress lines
SPOKEN = 0.2  # seconds before an abort in which mpirun passes on what was said: some lose the last lines
ANEW = "it was stopped before its first checkpoint: begun anew from case.json"
MIXED = "begun by revision {before} of the solver, gone on with by revision {now}: it counts as of the older one"
EXIT_STATUS = {SUCCEEDED: 0, "failed": 1, "refused": 2, "interrupted": 130}


def main() -> int:
    """Run; any exception on one rank is written down and ends all ranks."""
    arguments = read_arguments()
    requests, ranks = Requests(), Ranks.world()
    directory = Path(arguments.resume or arguments.out)
    teller = Teller(directory, ranks.root, arguments.progress)
    try:
        state, message = execute(arguments, ranks, requests, teller)
    except BaseException as error:
        return give_up(error, ranks, directory)
    profile = [entry[0] for entry in ranks.everyones(np.array([ranks.watch.read()], dtype=object))]
    if ranks.root:
        record_end(directory, state, message, profile=profile)
        if state == SUCCEEDED:
            clear(directory)
    return EXIT_STATUS[state]


def read_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="frit.solver", description="Run one case under MPI.")
    parser.add_argument("case", nargs="?", help="case file (TOML or JSON)")
    parser.add_argument("--out", help="run directory to make")
    parser.add_argument("--resume", metavar="DIR", help="run directory to go on with")
    parser.add_argument("--progress", action="store_true", help="print progress as JSON lines")
    arguments = parser.parse_args()
    if len({arguments.resume is None, arguments.case is not None, arguments.out is not None}) > 1:
        parser.error("give either CASE --out DIR or --resume DIR")
    return arguments


class Requests:
    """What signals have asked for: a checkpoint (USR1), or the end (TERM, INT). Heard from the start of `main`."""

    def __init__(self) -> None:
        self.checkpoint = self.end = False
        self.early: Callable[[], NoReturn] | None = None  # ends a run that has nothing to keep yet
        for number in (signal.SIGUSR1, signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: object) -> None:
        if number == signal.SIGUSR1:
            self.checkpoint = True
        else:
            self.end = True
            if self.early is not None:
                self.early()


def leave(directory: Path, root: bool, fresh: bool) -> NoReturn:
    """End this process, and so all ranks, before the first step: at once, as compiling would take its time.

    Rank 0 writes that down, or another one where it waits for the others.
    """
    if not root:
        time.sleep(SPOKEN)
    if root or output.read_state(directory) != "interrupted":
        begun = fresh and (directory / checkpoint.NAME).exists()
        kept = "checkpoint at t = 0" if begun else "stopped before the first step"
        record_end(directory, "interrupted", kept)
    os._exit(EXIT_STATUS["interrupted"])


def execute(
    arguments: argparse.Namespace, ranks: Ranks, requests: Requests, teller: Teller
) -> tuple[str, str | None]:
    """The whole run: how it ended, and a message where it did not end well."""
    directory = teller.directory
    asked, fresh = ranks.from_root(open_directory(arguments, directory) if ranks.root else None)
    teller.owned, requests.early = True, lambda: leave(directory, ranks.root, fresh)
    if requests.end:
        leave(directory, ranks.root, fresh)
    teller.phase("start" if fresh else "resumed", f"{asked.name}, {ranks.size} ranks")
    if asked.particles.source == "packing" and fresh:
        teller.phase("packing")
    case, packing = ranks.from_root(place(asked, directory, fresh) if ranks.root else None)
    teller.phase("set-up")
    rows = fresh or ranks.from_root(checkpoint.by_rows(directory) if ranks.root else None)
    setup, identity = make_setup(case, ranks, rows), asked.identity()
    kept = None if fresh else setup.read(directory, identity)
    scheme, state, integrator = setup.start(kept)
    if ranks.root:
        record_start(directory, asked, ranks.size, fresh, packing)
        teller.log(f"{setup.nodes} nodes")
        if fresh and arguments.resume is not None:
            record_note(directory, ANEW)
        for remark in setup.remarks() if fresh else ():
            record_note(directory, remark)
    while True:
        wall_time = kept.wall_time if kept else None
        recorder = Recorder(directory, setup, scheme, state, identity, wall_time, requests, teller)
        try:
            ending = run(scheme, state, integrator, recorder)
            if ending is not Ending.DONE or case.output.keep_checkpoint:
                recorder.checkpoint(scheme, state, integrator)
        except (RunError, FloatingPointError) as error:
            recorder.keep(scheme, state)
            checkpoint_time = f"the last good checkpoint is at t = {recorder.checkpoint_time:.6g}"
            return "failed", f"{error}; {checkpoint_time}, the last snapshot at {state.time:.6g}"
        finally:
            recorder.close()
        if ending is Ending.DONE:
            return SUCCEEDED, None
        if ending is Ending.STOPPED:
            return "interrupted", f"checkpoint at t = {state.time:.6g}"
        del scheme, state, recorder  # the mesh is divided anew: the run goes on from the checkpoint
        ranks.watch.enter("set-up")
        kept = setup.read(directory, identity)
        scheme, state, integrator = setup.start(kept)


def open_directory(arguments: argparse.Namespace, directory: Path) -> tuple[Case, bool]:
    """Rank 0: lock the run directory, and write or read its case; whether the run is a fresh one.

    Whoever has not the lock writes nothing there.
    """
    resumed = arguments.resume is not None
    if not resumed:
        directory.mkdir(parents=True, exist_ok=True)
    elif not directory.is_dir():
        raise output.DirectoryError(f"{directory}: no such folder")
    output.lock(directory)
    kept, path = (directory / checkpoint.NAME).exists(), directory / "case.json"
    if kept and not resumed:
        raise output.DirectoryError(f"{directory}: holds a run already; go on with --resume")
    if resumed and not (kept or path.exists()):
        raise CheckpointError(f"{directory}: no {checkpoint.NAME} to resume from, and no {path.name} to begin with")
    output.remove_torn(directory)
    if resumed and not kept and read_run(directory).get("state") == SUCCEEDED:
        raise output.DirectoryError(f"{directory}: has come to its end already; there is nothing to go on with")
    if resumed:
        return load_case(path, kept=True), not kept
    case = load_case(arguments.case)
    output.write_text(path, case.resolved_json())
    return case, True


class Recorder:
    """Listens to the run: history, snapshots, checkpoints, progress. All methods are collective."""

    def __init__(
        self,
        directory: Path,
        setup: Setup,
        system: System,
        state: Progress,
        identity: str,
        wall_time: float | None,
        requests: Requests,
        teller: Teller,
    ) -> None:
        """identity: of the case as asked; wall_time: seconds that a resumed run has taken before, None: a fresh run."""
        case, self.ranks, self.identity = system.case, system.ranks, identity
        fresh = wall_time is None
        self.directory, self.setup, self.requests, self.teller = directory, setup, requests, teller
        self.began = time.monotonic() - (wall_time or 0.0)
        self.collector = Collector(setup.share(system), output.block_size(directory, setup.nodes, self.ranks, fresh))
        self.observables = setup.rows(system, state)
        self.rows = output.History(directory, state.time if state.step else None) if self.ranks.root else None
        self.snapshots = output.Snapshots(directory, case, setup.positions, self.collector, fresh)
        self.checkpoint_time, self.checkpoint_clock = state.time, -np.inf if fresh else time.monotonic()
        self.latest: dict[str, Any] = {}  # history row
        ends = self.rows.vacancy_ratios() if self.rows is not None else None
        self.ratios: tuple[float, float] | None = self.ranks.from_root(ends)  # vacancy: of the first and the last row
        self.noted = False  # that a particle is pressed against a wall
        self.shown, self.started = -np.inf, (time.monotonic(), state.time, state.evaluations)

    def history(self, system: System, state: Progress, u: Floats, time_: float) -> None:
        """Append a row."""
        if not self.noted and (note := piled_up(system, state)):
            self.noted = True
            if self.ranks.root:
                record_note(self.directory, note)
        row = self.observables.row(system, state, u, time_, self._wall_time())
        self.latest = row
        ratio = row["vacancy_ratio"]
        self.ratios = (ratio if self.ratios is None else self.ratios[0], ratio)
        if self.rows is not None:
            self.rows.append(row)

    def snapshot(self, number: int, system: System, state: Progress, u: Floats, time_: float) -> None:
        """Write a snapshot."""
        self.snapshots.write(number, time_, self.setup.fields(system, state, u, self.collector))

    def keep(self, system: System, state: Progress) -> None:
        """Write the state of a failure in the place of the next snapshot; a resumed run, which gets farther, does so
        again."""
        u = system.at(state, system.vector(state))
        self.snapshot(self.snapshots.next(state.time), system, state, u, state.time)

    def after_step(self, system: System, state: Progress, integrator: Integrator) -> bool:
        """A row where the vacancy ratio has moved; a checkpoint when it is time or somebody asks; True when somebody
        asks for the end.
        """
        if state.step and self.requests.early is not None:
            self.requests.early = None
            self.teller.phase("steps", f"compiled for {c:.1f} s" if (c := self.teller.compiled) else "")
        due = time.monotonic() - self.checkpoint_clock >= system.case.output.checkpoint_every
        moved = has_moved(system, state, self.observables, self.ratios)
        wanted = [due and self.ranks.root, self.requests.checkpoint, self.requests.end, moved]
        due, asked, stop, moved = self.ranks.max(np.array(wanted, dtype=float)) > 0.0
        if moved:
            self.history(system, state, system.at(state, integrator.y), state.time)
        self._show(system, state)
        if (due or asked) and not stop:
            self.checkpoint(system, state, integrator)
        return bool(stop)

    def checkpoint(self, system: System, state: Progress, integrator: Integrator) -> None:
        """Make the state durable, and the rows before it."""
        if self.rows is not None:
            self.rows.sync()
        notes = {
            "identity": self.identity, "memory": integrator.memory, "wall_time": self._wall_time(),
        }  # fmt: skip
        self.setup.keep(self.directory, system, state, self.collector, notes)
        self.checkpoint_time, self.checkpoint_clock = state.time, time.monotonic()
        self.teller.log(f"checkpoint at t = {state.time:.6g}")
        self.requests.checkpoint = False

    def close(self) -> None:
        """Close the history."""
        if self.rows is not None:
            self.rows.close()

    def _wall_time(self) -> float:
        return time.monotonic() - self.began

    def _show(self, system: System, state: Progress) -> None:
        """Print a progress line, at most four a second."""
        clock = time.monotonic()
        if not (self.ranks.root and state.step) or self.requests.end or clock - self.shown < PROGRESS_EVERY:
            return
        self.shown = clock
        began, time_0, evaluations_0 = self.started
        elapsed, end = max(clock - began, 1e-9), system.case.time.end
        speed = (state.time - time_0) / elapsed
        line = {
            "time": state.time, "end": end, "step": state.step, "evaluations": state.evaluations,
            "evaluations_per_second": (state.evaluations - evaluations_0) / elapsed,
            "live_fraction": self.latest.get("live_fraction"),
            "vacancy_ratio": self.latest.get("vacancy_ratio"),
            "remaining": (end - state.time) / speed if speed > 0.0 else None,
            "compiled": round(self.teller.compiled, 3),
        }  # fmt: skip
        self.teller.show(line)
        self.teller.steps(line)


def record_start(
    directory: Path, case: Case, ranks: int, fresh: bool, packing: dict[str, Any] | None = None
) -> None:
    """run.json: what runs here, with which versions and packing, since when. A resumed run keeps the first start, and
    the oldest revision of the results that had a part in it.
    """
    path = directory / "run.json"
    before = json.loads(path.read_text()) if path.exists() and not fresh else {}
    now, begun = revision_of(case.tree()), recorded(before)
    record = {
        "state": "running",
        "message": None,
        "retry": False,
        "case": case.identity(),
        "revision": now if begun is None else min(begun, now),
        "name": case.name,
        "ranks": ranks,
        "host": socket.gethostname(),
        "seeds": {"particles": case.particles.seed},
        "packing": packing or before.get("packing"),
        "notes": before.get("notes", []),
        "versions": versions(),
        "start": before.get("start", output.now()),
        "resumed": [*before.get("resumed", []), *([] if fresh else [output.now()])],
        "end": None,
    }
    output.write_json(path, record)
    if begun is not None and begun != now:
        record_note(directory, MIXED.format(before=begun, now=now))


def record_end(
    directory: Path, state: str, message: str | None, retry: bool = False, profile: Sequence[Any] = ()
) -> None:
    """How it ended, into run.json; the message into log.txt too.

    retry: the machinery broke, not the case; profile: per rank the seconds of each phase, see `profile.Stopwatch`.
    """
    path = directory / "run.json"
    record: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    record |= {"state": state, "message": message, "retry": retry, "end": output.now(), "profile": list(profile)}
    output.write_json(path, record)
    add_to_log(directory, f"{state}{': ' + message if message else ''}")
    if message:
        print(f"{state}: {message}", file=sys.stderr, flush=True)


def clear(directory: Path) -> None:
    """After the end of the case: nothing goes on from the checkpoint, and nobody needs the lock."""
    if not load_case(directory / "case.json").output.keep_checkpoint:
        (directory / checkpoint.NAME).unlink(missing_ok=True)
    (directory / output.LOCK).unlink(missing_ok=True)


def record_note(directory: Path, note: str) -> None:
    """What a user should know of a run that goes on, into run.json and log.txt."""
    path = directory / "run.json"
    record: dict[str, Any] = json.loads(path.read_text())
    output.write_json(path, record | {"notes": [*record["notes"], note]})
    add_to_log(directory, f"note: {note}")


def versions() -> dict[str, str]:
    """What computed the results."""
    found = {"python": platform.python_version(), "mpi": mpi_library()}
    for name in ("frit", "numpy", "numba", "scipy", "mpi4py", "h5py", "zarr"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def give_up(error: BaseException, ranks: Ranks, directory: Path) -> int:
    """Write down what went wrong on this rank, and end all ranks, even where it cannot be written down."""
    refused = isinstance(error, REFUSALS)
    where = f"rank {ranks.rank}: " if ranks.size > 1 and not refused else ""
    message = str(error) if refused else f"{where}{told(error)}"
    state = "refused" if refused else "failed"
    try:
        if isinstance(error, output.DirectoryError):
            print(f"refused: {message}", file=sys.stderr, flush=True)  # the directory is not ours to write into
            return EXIT_STATUS[state]
        if not refused:
            traceback.print_exception(error)
            with open(directory / "log.txt", "a") as log:
                log.write(where + "".join(traceback.format_exception(error)))
        record_end(directory, state, message, retry=not (refused or comes_again(error)))
    finally:
        if ranks.size > 1:
            time.sleep(SPOKEN)
            ranks.abort(EXIT_STATUS[state])
    return EXIT_STATUS[state]


if __name__ == "__main__":
    sys.exit(main())
