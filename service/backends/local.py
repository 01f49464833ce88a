"""Runners on this machine: started through a nursery, followed by their processes, found again by their locks."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..files import boot, read_json, start_of, try_lock
from ..jobs import Exit
from ..runner import Order, read_exit

LOOK_AGAIN = 0.05  # seconds between two looks at a runner whose process is not known yet


class BackendError(RuntimeError):
    """No runner was started; the message says why."""


class LocalBackend:
    """Belongs to one event loop."""

    def __init__(self) -> None:
        self._nursery: tuple[subprocess.Popen[bytes], socket.socket] | None = None
        self._starting = asyncio.Lock()

    async def start(self, order: Order) -> int:
        """The pid of a new runner, which holds the lock of its run directory from its first moment on.

        Raises `BackendError`; then there is no runner.
        """
        lock = try_lock(Path(order.directory) / "runner.lock")
        if lock is None:
            raise BackendError(f"{order.directory}: a runner is there already")
        try:
            async with self._starting:
                return await self._fork(order, lock)
        except (OSError, EOFError) as error:
            self.close()
            raise BackendError(f"the nursery of runners: {error}") from error
        finally:
            os.close(lock)

    async def _fork(self, order: Order, lock: int) -> int:
        if self._nursery is None or self._nursery[0].poll() is not None:
            self.close()
            self._nursery = await asyncio.to_thread(open_nursery)
        orders = self._nursery[1]
        socket.send_fds(orders, [json.dumps(asdict(order)).encode()], [lock])
        answer = await asyncio.get_running_loop().sock_recv(orders, 32)
        if not answer:
            raise EOFError("it has died")
        return int(answer)

    async def recorded(self, directory: Path, attempt: int) -> dict[str, Any] | None:
        """Wait until the attempt's runner has recorded itself; the record, None where it ended before."""
        while (record := read_json(directory / "attempt.json")).get("attempt") != attempt:
            if (lock := try_lock(directory / "runner.lock")) is not None:
                os.close(lock)
                return None
            await asyncio.sleep(LOOK_AGAIN)
        return record

    async def ended(self, directory: Path, attempt: int, pid: int | None = None) -> Exit | None:
        """Wait for the end of the attempt's runner; its exit record, None where it left none.

        pid: the process that `start` has just told of.
        """
        process = None if pid is None else opened(pid)
        while (lock := try_lock(directory / "runner.lock")) is None:  # it lives, and so the pid was not reused
            await gone(process or runner_of(directory, attempt))
            process = None
        if process is not None:
            os.close(process)
        os.close(lock)
        return read_exit(directory, attempt)

    def tell(self, directory: Path, attempt: int, number: signal.Signals) -> None:
        """Send the attempt's runner a signal, if it lives; a reused pid is never hit."""
        if (process := runner_of(directory, attempt)) is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(process, number)
            os.close(process)

    def close(self) -> None:
        """Let the nursery end; the runners go on."""
        if self._nursery is not None:
            process, orders = self._nursery
            orders.close()
            process.wait()
            self._nursery = None


def open_nursery() -> tuple[subprocess.Popen[bytes], socket.socket]:
    """The process that runners are forked from, and the socket for its orders."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        command = [sys.executable, "-P", "-m", "frit.service.runner", str(theirs.fileno())]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()], start_new_session=True
        )
    ours.setblocking(False)
    return process, ours


def runner_of(directory: Path, attempt: int) -> int | None:
    """A descriptor of the process that recorded itself as the runner of this attempt; None: it is not there (yet)."""
    record = read_json(directory / "attempt.json")
    if record.get("attempt") != attempt or record.get("boot") != boot():
        return None
    if (process := opened(record["pid"])) is None:
        return None
    if start_of(record["pid"]) != record["pid_start"]:
        os.close(process)
        return None
    return process


def opened(pid: int) -> int | None:
    """A descriptor of a process, if there is one."""
    try:
        return os.pidfd_open(pid)
    except ProcessLookupError:
        return None


async def gone(process: int | None) -> None:
    """Wait until a process has ended; a moment where it is not known."""
    if process is None:
        return await asyncio.sleep(LOOK_AGAIN)
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(process, ended.set)
    try:
        await ended.wait()
    finally:
        loop.remove_reader(process)
        os.close(process)
