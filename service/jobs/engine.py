"""The engine of the service: one per data folder, with or without HTTP around it."""

import asyncio
import errno
import os
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from frit.solver.durable import make_private

from ..http.security import check_address
from ..http.uploads import Shelf
from ..index.migrations import IndexVersionError
from ..index.records import Key, NewPoint, StoreError, SweepRecord
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

TIDY = 3600.0  # seconds between two looks for uploads that nothing uses


class EngineError(RuntimeError):
    """The data folder cannot be used; the message says why."""


class Engine:
    """Index, scheduler and follower of a data folder, for the length of an `async with`. Runners outlive it."""

    store: Store
    notifier: Notifier
    scheduler: Scheduler
    shelf: Shelf

    def __init__(self, settings: Settings, backend: Backend | None = None) -> None:
        """backend: where jobs run; the cores of this machine unless told."""
        self.settings = settings
        self._backend = backend
        self._stack = AsyncExitStack()

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
            stack.push_async_callback(self.scheduler.close)
            await self.scheduler.adopt()
            loop = asyncio.create_task(self.scheduler.run())
            stack.callback(loop.cancel)
            self.shelf = Shelf(self.settings)
            stack.callback(self.shelf.close)
            tidying = asyncio.create_task(self._tidy())
            stack.callback(tidying.cancel)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def _tidy(self) -> None:
        """Remove, every hour, uploads that nothing uses."""
        while True:
            with suppress(OSError, StoreError):  # it will go better the next time
                await asyncio.to_thread(self._tidy_once)
            await asyncio.sleep(TIDY)

    def _tidy_once(self) -> None:
        """Nothing while there are more run directories than jobs: a lost index does not know what they use."""
        with os.scandir(self.settings.runs) as folders:
            runs = sum(1 for _ in folders)
        if runs <= sum(self.store.counts().values()):
            self.shelf.tidy(self.store.files_used())

    async def cancel(self, identifier: str, key: Key | None = None) -> Job:
        """End a job: at once where it has no cores, else its runner is told. A key that came before changes nothing.

        Raises `TransitionError`, `NotFoundError`, `KeyReusedError`.
        """
        job = await asyncio.wrap_future(self.store.cancel(identifier, key))
        if job.stopping:
            await self.scheduler.stop(job, "cancelled")
        return job

    async def submit_sweep(self, sweep: "Sweep", expansion: "Expansion", key: Key | None = None) -> SweepRecord:
        """Queue what is missing of a sweep."""
        points = [
            NewPoint(NewJob(p.case, p.identity, p.name, sweep.ranks, sweep.priority, sweep.tags), p.parameters)
            for p in expansion.points
        ]
        made = self.store.submit_sweep(sweep.name, sweep.resolved_json(), points, expansion.duplicates, key)
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


def check(settings: Settings) -> str | None:
    """Say early why a service cannot be started, or answers nobody. Raises `EngineError`, `AddressError`."""
    lock = take(settings.data)
    try:
        store = Store(settings.data)
        try:
            return check_address(settings, store)
        finally:
            store.close()
    except (IndexVersionError, StoreError) as error:
        raise EngineError(str(error)) from error
    finally:
        os.close(lock)


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
