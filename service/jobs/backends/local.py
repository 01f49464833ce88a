"""Runners on this machine: started through a fork server, followed by their processes, found again by their locks."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from frit.solver.durable import read_json

from ..launch import kill_marked
from ..processes import boot, start_of, try_lock
from ..runner import LOCK, Order, read_exit, run_mark
from ..states import Exit

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


class BackendError(RuntimeError):
    """No runner was started; the message says why."""


class FolderError(RuntimeError):
    """The folder of a run is gone, or another stands in its place; a runner may still live."""

    def __init__(self) -> None:
        super().__init__("its run folder was deleted, moved away or replaced while it had cores")


class LocalBackend:
    """Belongs to one event loop."""

    def __init__(self) -> None:
        self._fork_server: tuple[subprocess.Popen[bytes], socket.socket] | None = None
        self._starting = asyncio.Lock()

    async def start(self, order: Order) -> int:
        """The pid of a new runner, which holds the lock of its run directory from its first moment on.

        Raises `BackendError`, `FolderError`; then there is no runner.
        """
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

    async def recorded(self, directory: Path, attempt: int) -> dict[str, Any] | None:
        """Wait until the attempt's runner has recorded itself; the record, None where it ended before.

        Raises `FolderError`.
        """
        while (record := read_json(directory / "attempt.json")).get("attempt") != attempt:
            if (lock := lock_again(directory)) is not None:
                os.close(lock)
                return None
            await asyncio.sleep(LOOK_AGAIN)
        return record

    async def ended(
        self, directory: Path, attempt: int, pid: int | None = None, seen: Callable[[], None] = lambda: None
    ) -> Exit | None:
        """Wait for the end of the attempt's runner; its exit record, None where it left none.

        pid: the process that `start` has just told of; seen: called after every look at a runner that lives. Raises
        `FolderError`, within seconds after the folder has gone.
        """
        process = None if pid is None else opened(pid)
        while (lock := lock_again(directory)) is None:  # it lives, and so the pid was not reused
            seen()
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

    async def clear(self, directory: Path, runner: Process | None) -> None:
        """Kill the runner, and all that runners have started in a folder that may be gone."""
        if runner is not None and (process := opened_again(runner)) is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(process, signal.SIGKILL)
            if (process := await gone(process, CLEARING)) is not None:
                os.close(process)
        loop = asyncio.get_running_loop()
        deadline = loop.time() + CLEARING
        while await asyncio.to_thread(kill_marked, run_mark(directory)) and loop.time() < deadline:
            await asyncio.sleep(LOOK_AGAIN)

    def tell(self, directory: Path, attempt: int, number: signal.Signals) -> None:
        """Send the attempt's runner a signal, if it lives; a reused pid is never hit."""
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
    return opened_again(Process(record["pid"], record["pid_start"], record["boot"]))


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
