"""Runners on this machine: started through a fork server, followed by their processes, found again by their locks."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from frit.solver.durable import read_json

from ...settings import own_cores
from ..launch import kill_marked
from ..processes import boot, start_of, try_lock
from ..runner import LOCK, Order, read_exit, run_mark
from ..states import Exit, Waiting
from .protocol import BackendError, FolderError, Handle

LOOK_AGAIN = 0.05  # seconds between two looks at a runner whose process is not known yet
LOOK_EVERY = 2.0  # seconds between two looks at the folder of a runner that lives
LEAVING = 2.0  # seconds after which a process that has let go its lock has ended
CLEARING = 5.0  # seconds for what was killed to be gone
GONE = (FileNotFoundError, NotADirectoryError)


class Process(NamedTuple):
    """A process that no later one is taken for."""

    pid: int
    start: int
    boot: str


def choose(queue: Sequence[Waiting], free: int, total: int, overtake: Callable[[int], bool]) -> list[int]:
    """Which jobs of the queue, by priority and age, get some of the `free` of all `total` cores now.

    In order, as long as they fit. `overtake` is asked about the first that does not fit: whether smaller ones behind
    it may go first; if not, cores are kept until they suffice. A job with more ranks than there are cores at all waits
    for another service and blocks nobody.
    """
    chosen: list[int] = []
    blocked = False
    for seq, ranks, _ in queue:
        if ranks <= free:
            chosen.append(seq)
            free -= ranks
        elif ranks <= total and not blocked:
            blocked = True
            if not overtake(seq):
                break
    return chosen


class LocalBackend:
    """The cores of this process, given to jobs one by one; see `Backend`."""

    def __init__(self, cores: int, patience: float = 0.0) -> None:
        """patience: seconds for which smaller jobs may overtake the first that waits for more cores."""
        own = own_cores()
        self.cores = [own[k % len(own)] for k in range(cores)]
        self.patience = patience
        self.spare = set(range(cores))  # numbers of self.cores
        self.held: dict[str, set[int]] = {}  # the same, by job
        self._first: tuple[int, float] | None = None  # the job that waits for cores, and since when
        self._fork_server: tuple[subprocess.Popen[bytes], socket.socket] | None = None
        self._starting = asyncio.Lock()

    # --- cores --------------------------------------------------------------------------------------------

    @property
    def total(self) -> int:
        """All cores."""
        return len(self.cores)

    @property
    def free(self) -> int:
        """Cores that no job has."""
        return len(self.spare)

    def may_start(self, queue: Sequence[Waiting]) -> list[tuple[int, tuple[int, ...]]]:
        """In order, as far as there are cores; see `choose`."""
        free, ranks = sorted(self.spare), {job.seq: job.ranks for job in queue}
        choices = []
        for seq in choose(queue, len(free), self.total, self._overtake):
            choices.append((seq, tuple(self.cores[k] for k in free[: ranks[seq]])))
            free = free[ranks[seq] :]
        return choices

    def _overtake(self, first: int) -> bool:
        """Whether the first job that does not fit may be overtaken: for a while since it became the first."""
        if self._first is None or self._first[0] != first:
            self._first = (first, time.monotonic())
        return time.monotonic() - self._first[1] < self.patience

    def hold(self, job: str, ranks: int, cores: Sequence[int]) -> tuple[int, ...]:
        """Of processors that an earlier service gave, those that this one has not do not count."""
        taken: set[int] = set()
        for core in cores:
            number = next((k for k in sorted(self.spare - taken) if self.cores[k] == core), None)
            taken |= set() if number is None else {number}
        self.spare -= taken
        self.held[job] = taken
        return tuple(self.cores[k] for k in sorted(taken))

    def release(self, job: str) -> None:
        """They are spare again."""
        self.spare |= self.held.pop(job, set())

    # --- runners ------------------------------------------------------------------------------------------

    async def start(self, order: Order) -> Handle | None:
        """A new runner, which holds the lock of its run directory from its first moment on."""
        pid = await self._start(order)
        started = start_of(pid)
        return None if started is None else Process(pid, started, boot())._asdict()

    async def _start(self, order: Order) -> int:
        try:
            lock = try_lock(Path(order.directory) / LOCK)
        except GONE as error:
            raise FolderError from error
        if lock is None:
            raise BackendError(f"{order.directory}: a runner is there already")
        try:
            async with self._starting:
                return await self._fork(order, lock)
        except (OSError, EOFError) as error:
            self.close()
            raise BackendError(f"the fork server of runners: {error}") from error
        finally:
            os.close(lock)

    async def _fork(self, order: Order, lock: int) -> int:
        if self._fork_server is None or self._fork_server[0].poll() is not None:
            self.close()
            self._fork_server = await asyncio.to_thread(open_fork_server)
        orders = self._fork_server[1]
        socket.send_fds(orders, [json.dumps(asdict(order)).encode()], [lock])
        answer = await asyncio.get_running_loop().sock_recv(orders, 32)
        if not answer:
            raise EOFError("it has died")
        return int(answer)

    async def find(self, directory: Path, attempt: int) -> Handle | None:
        """By the record that it writes; None where it ended before."""
        while (record := read_json(directory / "attempt.json")).get("attempt") != attempt:
            if (lock := lock_again(directory)) is not None:
                os.close(lock)
                return None
            await asyncio.sleep(LOOK_AGAIN)
        return recorded(record)._asdict()

    async def ended(
        self, directory: Path, attempt: int, handle: Handle | None = None, alive: Callable[[], None] = lambda: None
    ) -> Exit | None:
        """It has ended when its lock is free. Raises `FolderError` within seconds after the folder has gone."""
        process = None if handle is None else opened_again(Process(**handle))
        while (lock := lock_again(directory)) is None:  # it lives, and so the pid was not reused
            alive()
            if process is None:
                process = runner_of(directory, attempt)
            if process is not None:
                process = await gone(process, LOOK_EVERY)
            elif read_json(directory / "attempt.json").get("attempt") == attempt:
                return read_exit(directory, attempt)  # it has ended, and somebody else holds the lock
            else:
                await asyncio.sleep(LOOK_AGAIN)
        os.close(lock)
        if process is not None:
            os.close(process)
        process = runner_of(directory, attempt)
        if process is not None and (process := await gone(process, LEAVING)) is not None:
            os.close(process)
            raise FolderError  # this is a copy, in which nobody runs
        return read_exit(directory, attempt)

    async def clear(self, directory: Path, handle: Handle | None) -> None:
        """Kill it, and all that carries the mark of the folder."""
        if handle is not None and (process := opened_again(Process(**handle))) is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(process, signal.SIGKILL)
            if (process := await gone(process, CLEARING)) is not None:
                os.close(process)
        loop = asyncio.get_running_loop()
        deadline = loop.time() + CLEARING
        while await asyncio.to_thread(kill_marked, run_mark(directory)) and loop.time() < deadline:
            await asyncio.sleep(LOOK_AGAIN)

    def tell(self, directory: Path, attempt: int, number: signal.Signals) -> None:
        """A reused pid is never hit."""
        if (process := runner_of(directory, attempt)) is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(process, number)
            os.close(process)

    def close(self) -> None:
        """Let the fork server end; the runners go on."""
        if self._fork_server is not None:
            process, orders = self._fork_server
            orders.close()
            process.wait()
            self._fork_server = None


def open_fork_server() -> tuple[subprocess.Popen[bytes], socket.socket]:
    """The process that runners are forked from, and the socket for its orders."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        command = [sys.executable, "-P", "-m", "frit.service.jobs.runner", str(theirs.fileno())]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()], start_new_session=True
        )
    ours.setblocking(False)
    return process, ours


def runner_of(directory: Path, attempt: int) -> int | None:
    """A descriptor of the process that recorded itself as the runner of this attempt; None: it is not there (yet)."""
    record = read_json(directory / "attempt.json")
    if record.get("attempt") != attempt:
        return None
    return opened_again(recorded(record))


def recorded(record: Mapping[str, Any]) -> Process:
    """Who a runner says it is."""
    return Process(record["pid"], record["pid_start"], record["boot"])


def opened_again(runner: Process) -> int | None:
    """A descriptor of a process that was seen before, if it lives; never of another that has its pid now."""
    if runner.boot != boot() or (process := opened(runner.pid)) is None:
        return None
    if start_of(runner.pid) != runner.start:
        os.close(process)
        return None
    return process


def opened(pid: int) -> int | None:
    """A descriptor of a process, if there is one."""
    try:
        return os.pidfd_open(pid)
    except ProcessLookupError:
        return None


def lock_again(directory: Path) -> int | None:
    """The lock of a directory in which a runner was started; see `try_lock`. Raises `FolderError`."""
    try:
        return try_lock(directory / LOCK, make=False)
    except GONE as error:
        raise FolderError from error


async def gone(process: int, seconds: float) -> int | None:
    """The process again, if it has not ended within that time."""
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(process, ended.set)
    try:
        async with asyncio.timeout(seconds):
            await ended.wait()
    except TimeoutError:
        return process
    except BaseException:
        loop.remove_reader(process)
        os.close(process)
        raise
    finally:
        loop.remove_reader(process)
    os.close(process)
    return None
