"""The engine of the service: one per data folder, with or without HTTP around it."""

import asyncio
import errno
import os
import shutil
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from frit.solver.characters import visible
from frit.solver.durable import make_private, write_whole

from ..index.changes import May
from ..index.migrations import IndexVersionError
from ..index.records import Key, NewPoint, StoreError, SweepRecord
from ..index.removals import Removed
from ..index.results import Follower
from ..index.store import Store
from ..settings import Settings
from .backends.local import LocalBackend
from .backends.protocol import Backend
from .notifier import Notifier
from .processes import try_lock
from .scheduler import Scheduler
from .states import Job, NewJob

if TYPE_CHECKING:
    from frit.sweeps.definition import Sweep
    from frit.sweeps.expand import Expansion


SELDOM = 20.0  # times as long as it takes pass between two lists of runs
LONGEST = 60.0  # seconds between two looks whether the list of runs has changed


class EngineError(RuntimeError):
    """The data folder cannot be used; the message says why."""


class Engine:
    """Index, scheduler and follower of a data folder, for the length of an `async with`. Runners outlive it."""

    store: Store
    notifier: Notifier
    scheduler: Scheduler

    def __init__(self, settings: Settings, backend: Backend | None = None) -> None:
        """backend: where jobs run; the cores of this machine unless told."""
        self.settings = settings
        self._backend = backend
        self._settling = set[asyncio.Task[None]]()
        self._stack = AsyncExitStack()
        self._listed = ""  # what the list of runs said last

    async def __aenter__(self) -> Self:
        """Raises `EngineError`."""
        async with AsyncExitStack() as stack:
            stack.callback(os.close, take(self.settings.data))
            try:
                self.store = await asyncio.to_thread(Store, self.settings.data)
            except (IndexVersionError, StoreError) as error:
                raise EngineError(str(error)) from error
            stack.callback(self.store.close)
            self.notifier = Notifier()
            self.store.listeners.append(self.notifier.notify)
            backend = self._backend or LocalBackend(self.settings.cores, self.settings.patience)
            self._follower = Follower(self.store, self.settings.runs)
            self.scheduler = Scheduler(self.settings, self.store, self.notifier, backend, self._follower)
            stack.push_async_callback(self._ended)
            stack.push_async_callback(self.scheduler.close)
            await self._settle(await asyncio.to_thread(self.store.unsettled))
            await self.scheduler.adopt()
            loops = [asyncio.create_task(work) for work in (self.scheduler.run(), self._tell())]
            stack.callback(self._list)
            for loop in loops:
                stack.callback(loop.cancel)
            self._stack = stack.pop_all()
        return self

    async def _tell(self) -> None:
        """Keep the list of runs up to date; where there are many, not at every change."""
        while True:
            seen, began = self.notifier.count, time.monotonic()
            await asyncio.to_thread(self._list)
            await asyncio.sleep(SELDOM * (time.monotonic() - began) + 1.0)
            await self.notifier.wait(LONGEST, seen)

    def _list(self) -> None:
        """`runs/INDEX.tsv` tells a person which folder is what; nobody else reads it."""
        with suppress(OSError, StoreError):
            rows = [("id", "name", "sweep", "state"), *self.store.listing()]
            text = "".join("\t".join(visible(field) for field in row) + "\n" for row in rows)
            if text != self._listed:
                write_whole(self.settings.runs / "INDEX.tsv", text.encode(), durable=False)
                self._listed = text

    async def _ended(self) -> None:
        """Removals under way come to their end."""
        await asyncio.gather(*self._settling, return_exceptions=True)

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def cancel(self, identifier: str, key: Key | None = None) -> Job:
        """End a job: at once where it has no cores, else its runner is told. A key that came before changes nothing.

        Raises `TransitionError`, `NotFoundError`, `KeyReusedError`.
        """
        job = await asyncio.wrap_future(self.store.cancel(identifier, key))
        if job.stopping:
            await self.scheduler.stop(job, "cancelled")
        return job

    async def cancel_sweep(self, identifier: str, may: May, key: Key | None = None) -> None:
        """The same for all jobs of a sweep that have not ended and that who asks may change."""
        for job in await asyncio.wrap_future(self.store.cancel_sweep(identifier, may, key)):
            if job.stopping:
                await self.scheduler.stop(job, "cancelled")

    async def remove(self, identifiers: Sequence[str]) -> None:
        """Delete jobs that have ended, with their run directories: all of them, or none, for good.

        Raises `NotFoundError`, `TransitionError`, `InUseError`.
        """
        await self._settle(await asyncio.wrap_future(self.store.remove(identifiers)))

    async def remove_sweep(self, identifier: str) -> None:
        """Delete a sweep and the jobs that it alone refers to. Raises as `remove` does."""
        await self._settle(await asyncio.wrap_future(self.store.remove_sweep(identifier)))

    async def _settle(self, gone: list[Removed]) -> None:
        """Do what remains of removals, whether or not somebody still waits for that."""
        if gone:
            settling = asyncio.create_task(self._settled(gone))
            self._settling.add(settling)
            settling.add_done_callback(self._settling.discard)
            await asyncio.shield(settling)

    async def _settled(self, gone: list[Removed]) -> None:
        await asyncio.wrap_future(self.store.mourn(gone))
        done = [each for each in gone if await asyncio.to_thread(self._cleared, each)]
        await asyncio.wrap_future(self.store.settle(done))

    def _cleared(self, gone: Removed) -> bool:
        """Delete its directory; what cannot be deleted now is tried again by the next service."""
        directory = self.run_directory(gone.id)
        if gone.kind == "job":
            shutil.rmtree(directory, ignore_errors=True)
        return gone.kind != "job" or not os.path.lexists(directory)

    async def submit_sweep(
        self, sweep: "Sweep", expansion: "Expansion", key: Key | None = None, recompute: bool = False
    ) -> SweepRecord:
        """Queue what is missing of a sweep; recompute: also what another revision of the solver computed."""
        points = [
            NewPoint(NewJob(p.case, p.identity, p.name, sweep.ranks, sweep.priority, sweep.tags), p.parameters)
            for p in expansion.points
        ]
        made = self.store.submit_sweep(
            sweep.name, sweep.resolved_json(), points, expansion.duplicates, key, recompute=recompute
        )
        return await asyncio.wrap_future(made)

    def trouble(self) -> str | None:
        """Why no job can be started or recorded now; None: all is well."""
        return self.scheduler.trouble

    def progress(self, identifier: str) -> dict[str, Any] | None:
        """The last progress line of a running job."""
        return self._follower.progress(identifier)

    def run_directory(self, identifier: str) -> Path:
        """Where a job's files are."""
        return self.settings.runs / identifier


def take(data: Path) -> int:
    """Make the data folder and lock it for this process."""
    try:
        make_private(data)
        (data / "runs").mkdir(exist_ok=True)
        lock = try_lock(data / "lock")
        if lock is not None:
            sign(lock)
    except OSError as error:
        reasons = {errno.EROFS: "it is read-only", errno.EACCES: "this user may not write there"}
        reason = reasons.get(error.errno or 0, error.strerror)
        raise EngineError(f"data = {data}: cannot be used: {reason}") from error
    if lock is None:
        owner = (data / "lock").read_text().strip()
        raise EngineError(f"data = {data}: in use by process {owner}: one service per data folder")
    return lock


def sign(lock: int) -> None:
    """Write into the lock who holds it; where that fails, it is let go."""
    try:
        os.ftruncate(lock, 0)
        os.write(lock, f"{os.getpid()}\n".encode())
    except OSError:
        os.close(lock)
        raise
