"""The runner: one process per job, which starts mpirun, watches over it and writes down how it ended.

It has a session of its own and outlives the service. From its birth it holds the lock on `runner.lock` in the run
directory, which it inherits: whoever can take that lock knows that no runner is there, even after a reused pid or a
crash at any moment. It leaves

    attempt.json   who it is: attempt, pid, start of the process, boot, cores; the checkpoint it began from
    exit.json      how the attempt ended; not there where the runner was killed

and obeys `request.json` when it gets TERM: a reason to stop. It ends all that it started, and itself without a record,
once the folder is gone from its place: what is there then is not its own.

Runners are forked from a process that has all of Python that they need (`fork_server`): a start costs two milliseconds,
and the service itself never forks.
"""

import gc
import json
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NoReturn

from frit.solver.durable import read_json, stamp, write_json
from frit.solver.ended import SUCCEEDED, read_run

from .child import die_with, prctl
from .launch import Launch, LaunchError, Outcome, find_mpirun, is_open_mpi, kill_marked
from .memory import memory_below
from .processes import boot, is_at, remove_torn, start_of, try_lock
from .states import Exit, Move, one_sentence

LONGEST = 65_536  # bytes of an order
PROGRESS_EVERY = 0.5  # seconds between two writes of progress.json
LOOK_EVERY = 1.0  # seconds between two looks at the folder, and at the memory that the ranks take
NOTHING_TO_KEEP = 5.0  # seconds from a wish to stop to KILL where no rank steps yet, and so no checkpoint can come
STUBBORN = 60.0  # seconds for which a record that cannot be written (a full disk) is tried again
LOCK = "runner.lock"
PR_SET_CHILD_SUBREAPER = 36
STOPS = {"cancelled": Move.STOP, "timed_out": Move.TIME_OUT, "released": Move.RELEASE}


@dataclass(frozen=True, slots=True)
class Order:
    """What a runner is to do; `directory` holds the case as submitted.json."""

    attempt: int
    directory: str
    ranks: int
    cores: tuple[int, ...]
    time_limit: float | None
    grace: float
    memory_limit: int  # bytes, of each rank


# --- the fork server --------------------------------------------------------------------------------------


def fork_server(orders: socket.socket) -> None:
    """Fork a runner for each order (JSON, and the lock's descriptor), answer with its pid; until the socket ends."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them
    gc.disable()  # what is looked through is copied in every runner
    gc.freeze()
    while True:
        message, handles, _, _ = socket.recv_fds(orders, LONGEST, 1)
        if not message:
            return
        with suppress(LaunchError, OSError):  # the runner says so itself
            is_open_mpi(find_mpirun())
        if (pid := os.fork()) == 0:
            orders.close()
            born(Order(**json.loads(message)), handles[0])
        for handle in handles:
            os.close(handle)
        with suppress(OSError):  # the service has gone: this was its last order
            orders.send(str(pid).encode())


def born(order: Order, lock: int) -> NoReturn:
    """The life of a runner; `lock` stays open to its end."""
    status = 1
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        adopts = prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) == 0
        log = os.open(Path(order.directory) / "runner.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        for descriptor in (1, 2):
            os.dup2(log, descriptor)
        os.close(log)
        os.set_inheritable(lock, False)
        Runner(order, lock, adopts).run()
        with suppress(OSError):
            if not (said := Path(order.directory) / "runner.log").stat().st_size:
                said.unlink()
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(OSError, ValueError):
            sys.stderr.flush()
        os._exit(status)


# --- one job ----------------------------------------------------------------------------------------------


class Runner:
    """One attempt at one job. `adopts`: whether the orphans of what it starts come to it."""

    def __init__(self, order: Order, lock: int, adopts: bool) -> None:
        """lock: a descriptor of the locked `runner.lock`."""
        self.order, self.lock, self.directory, self.adopts = order, lock, Path(order.directory), adopts
        self.mark = run_mark(self.directory)
        self.began = time.monotonic()
        self.launch: Launch | None = None
        self.reason: str | None = None  # why to stop, once there is one
        self.greedy: str | None = None  # how the ranks took more memory than they may, once they have
        self.shown = -PROGRESS_EVERY
        signal.signal(signal.SIGTERM, lambda *_: self.stop(None))
        signal.signal(signal.SIGUSR1, lambda *_: self.checkpoint())

    def run(self) -> None:
        """From the record of the start to that of the end. Raises `FileNotFoundError` where the folder is gone."""
        order, pid = self.order, os.getpid()
        record: dict[str, Any] = {"attempt": order.attempt, "pid": pid, "pid_start": start_of(pid), "boot": boot()}
        record |= {"cores": order.cores, "started": time.time(), "checkpoint": checkpoint_in(self.directory)}
        self.write("attempt.json", record, durable=False)  # it tells of a process of this boot
        try:
            move, message = self.attempt()
        except Exception as error:
            log(traceback.format_exc())
            move, message = Move.BREAK, f"runner: {type(error).__name__}: {error}"
        compiled = 0.0 if self.launch is None else self.launch.compiled
        seconds = max(0.0, time.monotonic() - self.began - compiled) * order.ranks
        further = advanced(self.directory, order.attempt)
        end = Exit(order.attempt, move, message and one_sentence(message), time.time(), seconds, further)
        self.write("exit.json", asdict(end))

    def attempt(self) -> tuple[Move, str | None]:
        """Run mpirun to its end; what came of it."""
        if self.order.attempt > 1:
            self.clear()
        if self.asked() is not None:
            self.stop(None)
        if self.reason is not None:
            return STOPS[self.reason], "stopped before mpirun was started"
        if read_run(self.directory).get("state") == SUCCEEDED:  # only the word of the runner before was lost
            return Move.SUCCEED, None
        os.sched_setaffinity(0, self.order.cores)
        try:
            launch = Launch(
                self.order.ranks, self.arguments(), self.directory, self.marks(), die_with(os.getpid(), signal.SIGKILL),
                self.adopts,
            )
        except (LaunchError, OSError) as error:
            return Move.BREAK, str(error)
        with launch:
            self.launch = launch
            if self.reason is not None:  # it came between the question and the launch
                self.descend()
            if self.order.time_limit is not None:
                timer(self.order.time_limit, lambda: self.stop("timed_out"))
            threading.Thread(target=self.look_after, daemon=True).start()
            for progress in launch:
                self.show(progress)
            outcome = launch.wait()
        if outcome.retry and outcome.errors:
            log(outcome.errors)  # which may name paths
        if self.greedy is not None and outcome.state != SUCCEEDED:
            return Move.FAIL, self.greedy
        return judge(outcome, self.reason)

    def look_after(self) -> None:
        """Kill all ranks where the folder has gone, or where they take more memory than they may."""
        launch, allowed = self.launch, self.order.memory_limit * self.order.ranks
        assert launch is not None  # narrows the type
        while launch.alive:
            taken = 0
            with suppress(OSError):  # no handle is free, say: the next look may go better
                taken = memory_below(os.getpid(), allowed)
            if taken > allowed:
                self.greedy = (
                    f"its ranks took {taken / 1e9:.2f} GB of memory, more than the {allowed / 1e9:.2f} GB that "
                    f"{self.order.ranks} may (FRIT_MEMORY_LIMIT for each)"
                )
            if taken > allowed or not self.at_home():
                launch.kill()
            time.sleep(LOOK_EVERY)

    def at_home(self) -> bool:
        """Whether the run folder is still the one that this runner was started in."""
        return is_at(self.lock, self.directory / LOCK)

    def arguments(self) -> list[str]:
        """Of the solver."""
        if (self.directory / "checkpoint.h5").exists():
            return ["--resume", str(self.directory), "--progress"]
        return [str(self.directory / "submitted.json"), "--out", str(self.directory), "--progress"]

    def marks(self) -> dict[str, str]:
        """By which a later runner finds what this one may leave behind; and where meshes of strangers are."""
        name, value = self.mark.split("=", 1)
        return {name: value, "FRIT_UPLOADS": str(self.directory.parent.parent / "files")}

    def clear(self) -> None:
        """End what an earlier attempt left behind, before its solver can get in this one's way."""
        while kill_marked(self.mark):
            time.sleep(0.01)
        remove_torn(self.directory)
        deadline = time.monotonic() + 10.0
        while (lock := try_lock(self.directory / "lock")) is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{self.directory}: another process is running here")
            time.sleep(0.01)
        os.close(lock)

    def asked(self) -> str | None:
        """Why this attempt is to stop, if somebody wrote that down."""
        request = read_json(self.directory / "request.json")
        return str(request["stop"]) if request.get("attempt") == self.order.attempt else None

    def stop(self, reason: str | None) -> None:
        """Begin the ladder, once; without a reason, the one that is written down, or: stop for now."""
        if self.reason is None:
            self.reason = reason or self.asked() or "released"
            if self.launch is not None:
                self.descend()

    def checkpoint(self) -> None:
        """Pass the wish on, once there are ranks."""
        if self.launch is not None:
            self.launch.checkpoint()

    def descend(self) -> None:
        """USR1, a grace for the checkpoint; TERM, a grace for the end; KILL.

        Where no rank steps, and so there is nothing new to keep: TERM, `NOTHING_TO_KEEP`, KILL.
        """
        threading.Thread(target=self._descend, daemon=True).start()

    def _descend(self) -> None:
        launch, grace = self.launch, self.order.grace
        assert launch is not None  # narrows the type: there is no ladder without a launch
        if launch.marches:
            before = checkpoint_in(self.directory)
            launch.checkpoint()
            await_(lambda: checkpoint_in(self.directory) != before or not launch.alive, grace)
            launch.stop(grace)
        else:
            launch.stop(grace)
            if not await_(lambda: launch.marches or not launch.alive, min(grace, NOTHING_TO_KEEP)):
                launch.kill()

    def show(self, progress: dict[str, Any]) -> None:
        """Keep the solver's last progress line where the service finds it."""
        clock = time.monotonic()
        if clock - self.shown >= PROGRESS_EVERY or "phase" in progress:
            self.shown = clock
            with suppress(OSError):  # a full disk does not end a run that can go on
                write_json(self.directory / "progress.json", progress, durable=False)

    def write(self, name: str, tree: dict[str, Any], durable: bool = True) -> None:
        """A record without which the attempt counts as lost; a full disk may get room again."""
        deadline = time.monotonic() + STUBBORN
        while True:
            try:
                if not self.at_home():
                    raise FileNotFoundError(f"{self.directory}: is gone, or another stands in its place")
                return write_json(self.directory / name, tree, durable)
            except OSError:
                if time.monotonic() > deadline or not self.at_home():
                    raise
                time.sleep(LOOK_EVERY)


def judge(outcome: Outcome, reason: str | None) -> tuple[Move, str | None]:
    """What an outcome means for the job, stopped for this reason (None: nobody asked)."""
    if outcome.state == SUCCEEDED:
        return Move.SUCCEED, None
    if reason is not None and (outcome.state == "interrupted" or outcome.retry):
        return STOPS[reason], outcome.message
    if outcome.state == "interrupted":
        return Move.RELEASE, outcome.message
    if outcome.state == "refused" and outcome.retry:
        return Move.BREAK, "another process is running in the run folder"
    return (Move.BREAK if outcome.retry else Move.FAIL), outcome.message


def read_exit(directory: Path, attempt: int) -> Exit | None:
    """The exit record of an attempt, if it is there."""
    record = read_json(directory / "exit.json")
    if record.get("attempt") != attempt:
        return None
    try:
        return Exit(**{**record, "move": Move(record["move"])})
    except (LookupError, TypeError, ValueError):  # damaged: as good as none
        return None


def log(text: str) -> None:
    """Into runner.log, if the disk has room."""
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def checkpoint_in(directory: Path) -> list[int] | None:
    """Differs, once there is another checkpoint, from what it was before; as JSON keeps it."""
    found = stamp(directory / "checkpoint.h5")
    return None if found is None else list(found)


def advanced(directory: Path, attempt: int) -> bool:
    """Whether an attempt has left a checkpoint that is not the one it began from."""
    record, now = read_json(directory / "attempt.json"), checkpoint_in(directory)
    return now is not None and record.get("attempt") == attempt and record.get("checkpoint", now) != now


def run_mark(directory: Path) -> str:
    """NAME=VALUE in the environment of all that a runner starts in a run directory."""
    return f"FRIT_RUN={directory}"


def await_(happened: Callable[[], bool], seconds: float) -> bool:
    """Whether it happened within that time."""
    deadline = time.monotonic() + seconds
    while not happened():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def timer(seconds: float, call: Callable[[], None]) -> None:
    """Call after that time on a thread that ends with the process."""
    waiting = threading.Timer(seconds, call)
    waiting.daemon = True
    waiting.start()


if __name__ == "__main__":
    fork_server(socket.socket(fileno=int(sys.argv[1])))
