"""Start the solver under MPI, follow it, stop it, judge its end. Knows no terminal and no database."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

from frit.solver.durable import stamp, write_json
from frit.solver.ended import ENDS, read_run

from .child import Child

# An outer MPI or Slurm step, which the ranks would join (PMI covers PMIX), and what makes Python write
# a printed line in two parts, between which another rank's may get. No rank needs a token.
SCRUBBED = ("PMI", "OMPI_COMM", "SLURM_STEP", "HYDI_", "MPI_LOCAL", "PYTHONUNBUFFERED", "FRIT_TOKEN")
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
AS_ROOT = ("OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM")
OPEN_MPI = dict.fromkeys(AS_ROOT, "1") | {"OMPI_MCA_pml": "ob1", "OMPI_MCA_btl": "self,sm"}


class LaunchError(RuntimeError):
    """Nothing was started: there is no mpirun."""


@dataclass(frozen=True)
class Outcome:
    """`state` is one of ENDS; `errors` is the last that mpirun and the ranks said outside log.txt.

    retry: the machinery broke, not the case; the same run may go better again.
    """

    state: str
    message: str | None
    returncode: int
    errors: str
    retry: bool = False


def solver_arguments() -> list[str]:
    """-P: a user's own `frit/` in the working folder is not picked up."""
    return [sys.executable, "-P", "-m", "frit.solver"]


def find_mpirun() -> str:
    """FRIT_MPIRUN, where it is set; else the one pip put beside this interpreter comes before the system's."""
    if chosen := os.environ.get("FRIT_MPIRUN"):
        if shutil.which(chosen) is None:
            raise LaunchError(f"FRIT_MPIRUN = {chosen}: must be a program that can be run")
        return chosen
    beside = Path(sys.executable).parent
    path = os.pathsep.join([str(beside), os.environ.get("PATH", os.defpath)])
    if (found := shutil.which("mpirun", path=path)) is None:
        raise LaunchError(f"no mpirun in {beside} nor on PATH: pip install mpich")
    return found


def is_open_mpi(mpirun: str) -> bool:
    """mpich's hydra answers `HYDRA build details`. Asked once, until the program is another."""
    return _is_open_mpi(mpirun, stamp(Path(mpirun)))


@cache
def _is_open_mpi(mpirun: str, _: tuple[int, int] | None) -> bool:
    shown = subprocess.run([mpirun, "--version"], capture_output=True, text=True, check=False)
    return "Open MPI" in shown.stdout or "OpenRTE" in shown.stdout


def mpirun_command(ranks: int, arguments: Sequence[str]) -> list[str]:
    """The whole command line; `arguments` are the solver's."""
    mpirun = find_mpirun()
    extra = ["--oversubscribe", "--bind-to", "none"] if is_open_mpi(mpirun) else []
    return [mpirun, *extra, "-n", str(ranks), *solver_arguments(), *arguments]


def clean_environment(environ: Mapping[str, str]) -> dict[str, str]:
    """Without what is SCRUBBED; one thread a rank unless set."""
    kept = {key: value for key, value in environ.items() if not key.startswith(SCRUBBED)}
    return dict.fromkeys(THREADS, "1") | kept


class Launch:
    """One mpirun tree in a session of its own: a terminal's Ctrl-C reaches only its parent.

    Iterate over the progress, then wait(); leaving the `with` block kills what is left. If the parent is
    killed -9 the tree may go on; the solver's own lock then keeps others out of the directory.
    """

    def __init__(
        self,
        ranks: int,
        arguments: Sequence[str],
        directory: Path,
        marks: Mapping[str, str] | None = None,
        first: Callable[[], None] | None = None,
        adopts: bool = False,
    ) -> None:
        """marks: more for the environment of the tree; first: called in mpirun's process before it is mpirun.

        adopts: whether orphans come to this process (PR_SET_CHILD_SUBREAPER), and nothing else it starts lives.
        """
        command = mpirun_command(ranks, arguments)
        environment = (OPEN_MPI if is_open_mpi(command[0]) else {}) | clean_environment(os.environ)
        # mpich gives each rank a session of its own: only a mark finds those whose mpirun is gone.
        environment |= {"FRIT_LAUNCH": os.urandom(16).hex(), **(marks or {})}
        self._mark = f"FRIT_LAUNCH={environment['FRIT_LAUNCH']}"
        self.directory, self.stopping, self._adopts = directory, False, adopts
        self.marches = False  # whether the ranks have said that they step: only then can there be a new checkpoint
        self.compiled = 0.0  # seconds that went into compiling, which is done once on a machine
        self._spoken: deque[str] = deque(maxlen=40)
        self._last_resort: threading.Timer | None = None
        directory.mkdir(parents=True, exist_ok=True)
        self._record_before = stamp(directory / "run.json")
        self._process = Child(command, environment, first)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.alive:
            self.kill()
            self._process.wait()
            self._sweep_up()
            self._settle("interrupted", "killed")
        if self._last_resort is not None:
            self._last_resort.cancel()
        self._process.close()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Progress as rank 0 prints it, until mpirun ends; what else is said is kept for the Outcome."""
        for line in self._process.lines(self._sweep_up):
            progress = None
            with suppress(json.JSONDecodeError):
                progress = json.loads(line)
            if isinstance(progress, dict):
                self.marches |= "time" in progress
                self.compiled = progress.get("compiled", self.compiled)
                yield progress
            elif line.strip():
                self._spoken.append(line.rstrip())

    @property
    def alive(self) -> bool:
        """Whether mpirun still runs."""
        return self._process.returncode is None

    def checkpoint(self) -> None:
        """Ask the ranks for a checkpoint now."""
        self._process.send(signal.SIGUSR1)

    def stop(self, grace: float) -> None:
        """Ask for a checkpoint and the end; kill after `grace` seconds. Returns at once, counts once."""
        if not self.stopping:
            self.stopping = True
            self._process.send(signal.SIGTERM)
            self._last_resort = threading.Timer(grace, self.kill)
            self._last_resort.daemon = True
            self._last_resort.start()

    def kill(self) -> bool:
        """Kill mpirun and whatever carries the mark; true if any did."""
        self._process.send(signal.SIGKILL)
        return kill_marked(self._mark)

    def wait(self) -> Outcome:
        """What run.json says, if it was written since the start, once the whole tree is gone."""
        outcome = self._outcome()
        self._settle(outcome.state, outcome.message)
        return outcome

    def _settle(self, state: str, message: str | None) -> None:
        """run.json of a run that was killed: it does not stay `running`."""
        record = read_run(self.directory)
        if record.get("state") == "running" and stamp(self.directory / "run.json") != self._record_before:
            with suppress(OSError):
                write_json(self.directory / "run.json", record | {"state": state, "message": message})

    def _outcome(self) -> Outcome:
        for _ in self:
            pass
        record, code, spoken = read_run(self.directory), self._process.wait(), "\n".join(self._spoken)
        fresh = stamp(self.directory / "run.json") != self._record_before
        if fresh and record.get("state") in ENDS:
            return Outcome(record["state"], record.get("message"), code, spoken, record.get("retry", False))
        if self.stopping and (self.directory / "checkpoint.h5").exists():
            return Outcome("interrupted", "no new checkpoint was written; the last one stands", code, spoken)
        if self.stopping:
            return Outcome("interrupted", "stopped before the first checkpoint was written", code, "", retry=True)
        if code == 2:  # another's directory: the solver said so on stderr and left run.json alone
            return Outcome("refused", None, code, spoken, retry=True)
        message = f"mpirun ended with status {code} and no word of the solver"
        return Outcome("failed", message, code, spoken, retry=True)

    def _sweep_up(self) -> None:
        """mpirun's end is the end of all: no orphan stays."""
        for _ in range(100):
            if (self._adopts and childless()) or not self.kill():
                break
            time.sleep(0.01)


def childless() -> bool:
    """Whether no child of this process lives; those that have ended are taken leave of."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        return True
    return False


def kill_marked(mark: str) -> bool:
    """Kill every process with `mark`, NAME=VALUE, in its environment (found on Linux); true if there were any."""
    found, entry = False, b"\0" + mark.encode() + b"\0"
    for name in os.listdir("/proc"):
        if name.isdigit():
            with suppress(OSError):  # not ours, or gone meanwhile
                with open(f"/proc/{name}/environ", "rb", buffering=0) as file:
                    environment = file.read()
                if entry in b"\0" + environment:
                    os.kill(int(name), signal.SIGKILL)
                    found = True
    return found
