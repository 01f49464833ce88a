"""Which jobs are put before the backend, and when; and one watch per job that it has started.

What cores and processes are, the backend knows.
"""

import asyncio
import logging
import shutil
import signal
import time
from collections import Counter
from collections.abc import Coroutine, Iterator, Sequence
from pathlib import Path
from typing import Any

from frit.solver.durable import write_json, write_whole

from ..index.records import Attempt, NotFoundError, StoreError
from ..index.results import Follower, size_of
from ..index.store import Store
from ..settings import Settings
from .backends.protocol import Backend, BackendError, FolderError, Handle
from .notifier import Notifier
from .runner import Order, advanced
from .states import Exit, Job, Move, State, Waiting, one_sentence

AHEAD = 256  # jobs of the queue that one tick looks at
TICK = 1.0  # seconds between two ticks when nothing happens
AGAIN = 1.0  # seconds before a piece of work that the index refused, or that failed, is tried again
READINGS = 5  # times that what a job has left behind is read in vain before it ends without

logger = logging.getLogger("frit.scheduler")


class Scheduler:
    """Belongs to one event loop, as its store's notifier does."""

    def __init__(
        self, settings: Settings, store: Store, notifier: Notifier, backend: Backend, follower: Follower
    ) -> None:
        self.settings, self.store, self.notifier = settings, store, notifier
        self.backend, self.follower = backend, follower
        self.running: dict[str, Job] = {}  # with cores, by id
        self.stuck: dict[str, str] = {}  # jobs whose watch has failed, and how: nobody knows whether they live
        self.open = True  # whether to start jobs
        self._said: str | None = "starting up"
        self._closing = False
        self._tasks: set[asyncio.Task[None]] = set()
        self._births: set[asyncio.Task[Handle | None]] = set()  # of runners

    @property
    def trouble(self) -> str | None:
        """Why no job can be started or recorded now, or cores are held by what may not live; None: all is well."""
        stuck = [f"job {job}: its watch has failed: {reason}" for job, reason in self.stuck.items()]
        return "; ".join(stuck[:3]) or self._said

    def stuck_cores(self) -> int:
        """How many cores are held by jobs of which nobody knows whether they live."""
        return sum(self.running[job].ranks for job in self.stuck if job in self.running)

    # --- the loop -----------------------------------------------------------------------------------------

    async def adopt(self) -> None:
        """Take over what an earlier service has left: running jobs, unread exit records, pauses."""
        held, waiting = await asyncio.to_thread(self.store.unfinished)
        for job, attempt in held:
            self.backend.hold(job.id, job.ranks, attempt.cores)
            self.running[job.id] = job
            self.follower.follow(job)
            message = "the service ended before it had started a runner"
            self._attend(job, self._adopt(job, attempt, Exit(job.attempt, Move.RELEASE, message, time.time())))
        for job in waiting:
            self._spawn(self._pause(job))
        self._said = None

    async def run(self) -> None:
        """Tick when something has happened, and once in a while; trouble with the index passes or is shown."""
        self._spawn(self._follow())
        while True:
            seen = self.notifier.count
            try:
                await self.tick()
                self._said = self._disk()
            except (StoreError, OSError) as error:
                self._complain(str(error))
            except Exception as error:  # not foreseen: the next tick may go better, and all running jobs depend on it
                logger.exception("a tick has failed")
                self._said = f"{type(error).__name__}: {error}"
            await self.notifier.wait(TICK, seen)

    async def tick(self) -> None:
        """Start the jobs whose turn it is: one query, and one transaction if there are any."""
        if not (self.backend.free and self.open) or self._disk() is not None:
            return
        choices = self.backend.may_start(self._ahead(self.backend.free))
        if not choices:
            return
        cores = dict(choices)
        for job in await asyncio.wrap_future(self.store.claim(choices)):
            self.running[job.id] = job
            self._attend(job, self._start(job, self.backend.hold(job.id, job.ranks, cores[job.seq])))

    def _ahead(self, free: int) -> list[Waiting]:
        """The first in the queue: as many as there are cores free where those fit, else `AHEAD`."""
        most, cores = self.settings.quota_cores, Counter[str | None]()
        for job in self.running.values():
            cores[job.owner] += job.ranks
        full = [owner for owner in cores if owner is not None and most is not None and cores[owner] >= most]
        queue = self.store.queued(free, full)
        if sum(job.ranks for job in queue) > free and len(queue) == free:
            queue = self.store.queued(AHEAD, full)
        return queue if most is None else [*within(queue, cores, most)]

    async def stop(self, job: Job, reason: str) -> None:
        """Tell a job's runner to checkpoint and end; `reason` is one of runner.STOPS."""
        directory = self.settings.runs / job.id
        request = {"attempt": job.attempt, "stop": reason}
        try:
            if job.state is State.STARTING:  # its runner may be on the way up
                await asyncio.to_thread(directory.mkdir, exist_ok=True)
            await asyncio.to_thread(write_json, directory / "request.json", request)
        except OSError as error:  # a full disk: it is released then, and the index knows what else was wanted
            self._complain(f"job {job.id}: {error}")
        self.backend.tell(directory, job.attempt, signal.SIGTERM)

    async def release(self) -> None:
        """Start nothing more, have all running jobs write a checkpoint and end, and wait for them; they stay queued."""
        self.open = False
        while self.running:
            for job in list(self.running.values()):
                if job.stopping:
                    continue
                try:
                    await self.stop(job, "released")
                except OSError:  # a full disk, or no folder yet: a runner that finds no word takes TERM for this one
                    self.backend.tell(self.settings.runs / job.id, job.attempt, signal.SIGTERM)
            await self.notifier.wait(TICK)

    async def close(self) -> None:
        """Leave; the runners go on, those on the way up too."""
        self.open, self._closing = False, True
        await asyncio.gather(*self._births, return_exceptions=True)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.backend.close()

    # --- one job ------------------------------------------------------------------------------------------

    async def _start(self, job: Job, cores: tuple[int, ...]) -> None:
        directory = self.settings.runs / job.id
        order = Order(
            job.attempt, str(directory), job.ranks, cores, job.time_limit, self.settings.grace,
            self.settings.memory_limit,
        )  # fmt: skip
        self.follower.follow(job)
        try:
            birth = asyncio.create_task(self._bear(job, order))
            self._births.add(birth)
            birth.add_done_callback(self._births.discard)
            handle = await asyncio.shield(birth)
        except FolderError as error:
            return await self._lose(job, error)
        except (BackendError, OSError) as error:
            logger.warning("job %s: %s", job.id, error)
            handle = await self._find(job)
            if handle is None:  # else it was started all the same: only the answer was lost
                return await self._end(job, Exit(job.attempt, Move.BREAK, one_sentence(str(error)), time.time()))
        beside = None if handle is None else self._spawn(self._started(job, handle))
        await self._watch(job, handle, beside)

    async def _bear(self, job: Job, order: Order) -> Handle | None:
        """Not to be cut short: a claimed job gets its runner."""
        await asyncio.to_thread(make_directory, Path(order.directory), job)
        return await self.backend.start(order)

    async def _find(self, job: Job) -> Handle | None:
        """The attempt's runner; None where there is none, or no folder."""
        try:
            return await self.backend.find(self.settings.runs / job.id, job.attempt)
        except FolderError:
            return None

    async def _started(self, job: Job, handle: Handle) -> None:
        recorded = await self._insist(lambda: self.store.start(job.id, job.attempt, handle))
        if recorded.attempt == job.attempt and job.id in self.running:
            self.running[job.id] = recorded
            if recorded.stopping:  # the wish came before there was a runner to tell
                await self.stop(recorded, "cancelled")

    async def _adopt(self, job: Job, attempt: Attempt, unborn: Exit) -> None:
        """Watch a runner that was started before; `unborn`: what is said where it did not come to that."""
        found, known = await self._find(job), attempt.handle
        if found is None and job.state is State.STARTING:
            await self.backend.clear(self.settings.runs / job.id, known)  # of one whose folder is gone
            return await self._end(job, unborn)
        if found is not None:
            await self._started(job, found)
        await self._watch(job, found or known)

    async def _watch(self, job: Job, handle: Handle | None = None, beside: asyncio.Task[None] | None = None) -> None:
        """To the end of the job's runner, which may have come already; `beside`: what has to be told before that."""
        directory = self.settings.runs / job.id
        try:
            end = await self.backend.ended(directory, job.attempt, handle, lambda: self._well(job))
        except FolderError as error:
            return await self._lose(job, error, handle)
        if beside is not None:
            await asyncio.wait([beside])
        if end is None:
            message, further = "the runner vanished without an exit record", advanced(directory, job.attempt)
            end = Exit(job.attempt, Move.LOSE, message, time.time(), advanced=further)
        await self._end(job, end)

    async def _lose(self, job: Job, error: FolderError, handle: Handle | None = None) -> None:
        """For good: there is nothing left to go on with, and nobody is to compute into the void.

        Where the folder of all runs is gone too, a disk is: its jobs may go on once it is back.
        """
        await self.backend.clear(self.settings.runs / job.id, handle)
        again = not self.settings.runs.is_dir()
        await self._end(job, Exit(job.attempt, Move.LOSE, str(error), time.time(), again=again))

    async def _end(self, job: Job, end: Exit) -> None:
        """Into the index with it, history first, and its cores back."""
        result = await self._results(job)
        size = await asyncio.to_thread(size_of, self.settings.runs / job.id)
        limit = self.settings.attempts
        try:
            ended = await self._insist(lambda: self.store.finish(job.id, end, limit, result or None, size))
        except NotFoundError as error:  # taken out of the index under the service: it has ended all the same
            logger.warning("%s", error)
            ended = None
        self._give_back(job)
        if ended is not None and ended.retrying:
            self._spawn(self._pause(ended))
        self.notifier.notify()

    async def _results(self, job: Job) -> dict[str, Any]:
        """Take in the last of what a job has left; what it is found by. What cannot be read is told, and no more."""
        failures = 0
        while True:
            try:
                return await self.follower.finish(job)
            except StoreError as error:
                self._complain(f"job {job.id}: {error}")
            except OSError as error:
                self._complain(f"job {job.id}: {error}")
                failures += 1
            except Exception as error:  # a damaged file: the job has ended all the same
                logger.warning("job %s: %s: %s", job.id, type(error).__name__, error)
                return {}
            if failures == READINGS:
                return {}
            await asyncio.sleep(AGAIN)

    def _give_back(self, job: Job) -> None:
        """Free what a job that has ended had."""
        self.running.pop(job.id, None)
        self.backend.release(job.id)
        self._well(job)

    async def _pause(self, job: Job) -> None:
        """Between two attempts; measured by a clock that does not jump."""
        await asyncio.sleep(self.settings.pause(job.failures))
        await self._insist(lambda: self.store.requeue(job.id, job.attempt))

    async def _insist(self, write: Any) -> Any:
        """Have it written; trouble with the index passes or is shown."""
        while True:
            try:
                return await asyncio.wrap_future(write())
            except StoreError as error:
                self._complain(str(error))
                await asyncio.sleep(AGAIN)

    # --- helpers ------------------------------------------------------------------------------------------

    async def _follow(self) -> None:
        while True:
            try:
                await self.follower.look({identifier: job.seq for identifier, job in self.running.items()})
                self.notifier.notify()
            except StoreError as error:
                self._complain(str(error))
            except Exception as error:  # not foreseen: all running jobs depend on the next look
                logger.exception("what jobs have written could not be taken in")
                self._complain(f"{type(error).__name__}: {error}")
            await asyncio.sleep(self.settings.poll)

    def _attend(self, job: Job, work: Coroutine[Any, Any, None]) -> None:
        """Have work bring a job to its end; where it fails itself, that is told, and the job watched again."""
        self._spawn(work).add_done_callback(lambda task: self._unattended(job, task))

    def _unattended(self, job: Job, task: asyncio.Task[None]) -> None:
        """Its work is over, but is the job?"""
        if self._closing or job.id not in self.running or self.running[job.id].attempt != job.attempt:
            return
        error = None if task.cancelled() else task.exception()
        self.stuck[job.id] = "it was cut short" if error is None else f"{type(error).__name__}: {error}"
        self._attend(job, self._again(job))

    async def _again(self, job: Job) -> None:
        """Watch a job whose watch has failed; where there was no runner yet, that will be found."""
        await asyncio.sleep(AGAIN)
        attempt = (await asyncio.to_thread(self.store.attempts, job.id))[-1]
        broken = Exit(job.attempt, Move.BREAK, one_sentence(f"its start failed: {self.stuck.get(job.id)}"), time.time())
        await self._adopt(self.running[job.id], attempt, broken)

    def _well(self, job: Job) -> None:
        """It is known again whether the job lives."""
        if self.stuck.pop(job.id, None) is not None:
            logger.warning("job %s: is watched again", job.id)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.error("a watch has ended by itself", exc_info=error)
            self._said = f"{type(error).__name__}: {error}"

    def _complain(self, text: str) -> None:
        if self._said != text:
            logger.warning("%s", text)
        self._said = text

    def _disk(self) -> str | None:
        free = shutil.disk_usage(self.settings.data).free
        if free >= self.settings.free_disk:
            return None
        return f"{self.settings.data}: {free} bytes free, no job is started below {self.settings.free_disk}"


def within(queue: Sequence[Waiting], cores: Counter[str | None], most: int) -> Iterator[Waiting]:
    """Those that leave their owner within that many cores, `cores` being what each has now."""
    for job in queue:
        if job.owner is None or cores[job.owner] + job.ranks <= most:
            cores[job.owner] += job.ranks
            yield job


def make_directory(directory: Path, job: Job) -> None:
    """The run directory as a runner expects it: the case, and who asked for what."""
    directory.mkdir(exist_ok=True)  # not its parent: where that is gone, a disk is
    submitted = directory / "submitted.json"
    if not submitted.exists():
        write_whole(submitted, job.case.encode(), durable=False)
    keys = ("seq", "id", "identity", "name", "ranks", "priority", "tags", "time_limit", "created", "owner", "origin")
    record = {key: getattr(job, key) for key in keys}
    write_json(directory / "job.json", record, durable=False)
