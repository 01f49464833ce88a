"""Which job gets which cores, and when; and one watch per job that has them."""

import asyncio
import logging
import os
import shutil
import signal
import time
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

from .backends.local import BackendError, LocalBackend
from .files import boot, start_of, write_json
from .hub import Hub
from .jobs import Exit, Job, Move, State
from .results import Follower
from .runner import Order
from .settings import Settings, own_cores
from .store import Store, StoreError

AHEAD = 256  # jobs of the queue that one tick looks at
TICK = 1.0  # seconds between two ticks when nothing happens
AGAIN = 1.0  # seconds before a piece of work that the index refused is tried again

logger = logging.getLogger("frit.scheduler")


def choose(queue: Sequence[tuple[int, int]], free: int, total: int, overtake: Callable[[int], bool]) -> list[int]:
    """Which jobs of the queue, (seq, ranks) by priority and age, get some of the `free` of all `total` cores now.

    In order, as long as they fit. `overtake` is asked about the first that does not fit: whether smaller ones behind
    it may go first; if not, cores are kept until they suffice. A job with more ranks than there are cores at all waits
    for another service and blocks nobody.
    """
    chosen: list[int] = []
    blocked = False
    for seq, ranks in queue:
        if ranks <= free:
            chosen.append(seq)
            free -= ranks
        elif ranks <= total and not blocked:
            blocked = True
            if not overtake(seq):
                break
    return chosen


class Scheduler:
    """Belongs to one event loop, as its store's hub does."""

    def __init__(self, settings: Settings, store: Store, hub: Hub, backend: LocalBackend, follower: Follower) -> None:
        self.settings, self.store, self.hub = settings, store, hub
        self.backend, self.follower = backend, follower
        own = own_cores()
        self.cores = [own[k % len(own)] for k in range(settings.cores)]
        self.free = set(range(settings.cores))  # numbers of self.cores
        self.running: dict[str, Job] = {}  # with cores, by id
        self.trouble: str | None = "starting up"
        self.open = True  # whether to start jobs
        self._tasks: set[asyncio.Task[None]] = set()
        self._births: set[asyncio.Task[int]] = set()  # of runners
        self._first: tuple[int, float] | None = None  # the job that waits for cores, and since when

    # --- the loop -----------------------------------------------------------------------------------------

    async def adopt(self) -> None:
        """Take over what an earlier service has left: running jobs, unread exit records, pauses."""
        held, waiting = await asyncio.to_thread(self.store.unfinished)
        for job, attempt in held:
            cores = self._cores_again(attempt.cores)
            self.running[job.id] = job
            self.follower.follow(job)
            self._spawn(self._adopt(job, cores))
        for job in waiting:
            self._spawn(self._pause(job))
        self.trouble = None

    async def run(self) -> None:
        """Tick when something has happened, and once in a while; trouble with the index passes or is shown."""
        self._spawn(self._follow())
        while True:
            seen = self.hub.count
            try:
                await self.tick()
                self.trouble = self._disk()
            except (StoreError, OSError) as error:
                self._complain(str(error))
            except Exception as error:  # not foreseen: the next tick may go better, and all running jobs depend on it
                logger.exception("a tick has failed")
                self.trouble = f"{type(error).__name__}: {error}"
            await self.hub.wait(TICK, seen)

    async def tick(self) -> None:
        """Give free cores to the jobs whose turn it is: one query, and one transaction if there are any."""
        if not (self.free and self.open) or self._disk() is not None:
            return
        choices, free = [], sorted(self.free)
        queue = self._ahead(len(free))
        ranks = dict(queue)
        for seq in choose(queue, len(free), len(self.cores), self._overtake):
            choices.append((seq, free[: ranks[seq]]))
            free = free[ranks[seq] :]
        if not choices:
            return
        claim = self.store.claim([(seq, tuple(self.cores[k] for k in numbers)) for seq, numbers in choices])
        given = dict(choices)
        for job in await asyncio.wrap_future(claim):
            self.free -= set(given[job.seq])
            self.running[job.id] = job
            self._spawn(self._start(job, set(given[job.seq])))

    def _ahead(self, free: int) -> list[tuple[int, int]]:
        """(seq, ranks) of the first in the queue: as many as there are cores free where those fit, else `AHEAD`."""
        queue = self.store.queued(free)
        return queue if sum(ranks for _, ranks in queue) <= free or len(queue) < free else self.store.queued(AHEAD)

    def _overtake(self, first: int) -> bool:
        """Whether the first job that does not fit may be overtaken: for a while since it became the first."""
        if self._first is None or self._first[0] != first:
            self._first = (first, time.monotonic())
        return time.monotonic() - self._first[1] < self.settings.patience

    async def stop(self, job: Job, reason: str) -> None:
        """Tell a job's runner to checkpoint and end; `reason` is one of runner.STOPS."""
        directory = self.settings.runs / job.id
        request = {"attempt": job.attempt, "stop": reason}
        try:
            await asyncio.to_thread(directory.mkdir, parents=True, exist_ok=True)  # its runner may be on the way up
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
            await self.hub.wait(TICK)

    async def close(self) -> None:
        """Leave; the runners go on, those on the way up too."""
        self.open = False
        await asyncio.gather(*self._births, return_exceptions=True)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.backend.close()

    # --- one job ------------------------------------------------------------------------------------------

    async def _start(self, job: Job, cores: set[int]) -> None:
        directory = self.settings.runs / job.id
        order = Order(
            job.attempt, str(directory), job.ranks, tuple(self.cores[k] for k in sorted(cores)), job.time_limit,
            self.settings.grace,
        )  # fmt: skip
        self.follower.follow(job)
        try:
            birth = asyncio.create_task(self._bear(job, order))
            self._births.add(birth)
            birth.add_done_callback(self._births.discard)
            pid = await asyncio.shield(birth)
        except (BackendError, OSError) as error:
            logger.warning("job %s: %s", job.id, error)
            record = await self.backend.recorded(directory, job.attempt) if directory.is_dir() else None
            if record is None:
                return await self._end(job, cores, Exit(job.attempt, Move.BREAK, str(error), time.time()))
            pid = int(record["pid"])  # it was forked all the same: only the answer was lost
        beside = None
        if (started := start_of(pid)) is not None:
            beside = self._spawn(self._started(job, pid, started, boot()))
        await self._watch(job, cores, pid, beside)

    async def _bear(self, job: Job, order: Order) -> int:
        """Not to be cut short: a claimed job gets its runner."""
        await asyncio.to_thread(make_directory, Path(order.directory), job)
        return await self.backend.start(order)

    async def _started(self, job: Job, pid: int, pid_start: int, boot_id: str) -> None:
        recorded = await self._insist(lambda: self.store.start(job.id, job.attempt, pid, pid_start, boot_id))
        if recorded.attempt == job.attempt and job.id in self.running:
            self.running[job.id] = recorded
            if recorded.stopping:  # the wish came before there was a runner to tell
                await self.stop(recorded, "cancelled")

    async def _adopt(self, job: Job, cores: set[int]) -> None:
        """Watch a runner that an earlier service has started, unless it did not come to that."""
        directory = self.settings.runs / job.id
        directory.mkdir(parents=True, exist_ok=True)
        record = await self.backend.recorded(directory, job.attempt)
        if record is None and job.state is State.STARTING:
            message = "the service ended before it had started a runner"
            return await self._end(job, cores, Exit(job.attempt, Move.RELEASE, message, time.time()))
        if record is not None:
            await self._started(job, record["pid"], record["pid_start"], record["boot"])
        await self._watch(job, cores)

    async def _watch(
        self, job: Job, cores: set[int], pid: int | None = None, beside: asyncio.Task[None] | None = None
    ) -> None:
        """To the end of the job's runner, which may have come already; `beside`: what has to be told before that."""
        directory = self.settings.runs / job.id
        end = await self.backend.ended(directory, job.attempt, pid)
        if beside is not None:
            await asyncio.wait([beside])
        if end is None:
            end = Exit(job.attempt, Move.LOSE, "the runner vanished without an exit record", time.time())
        await self._end(job, cores, end)

    async def _end(self, job: Job, cores: set[int], end: Exit) -> None:
        """Into the index with it, history first, and its cores back."""
        result: dict[str, Any] = {}
        while True:
            try:
                result = await self.follower.finish(job)
                break
            except (StoreError, OSError) as error:
                self._complain(f"job {job.id}: {error}")
                await asyncio.sleep(AGAIN)
            except Exception as error:  # a damaged file: the job has ended all the same
                logger.warning("job %s: %s: %s", job.id, type(error).__name__, error)
                break
        limit = self.settings.attempts
        ended = await self._insist(lambda: self.store.finish(job.id, end, limit, result or None))
        self.running.pop(job.id, None)
        self.free |= cores
        if ended.retrying:
            self._spawn(self._pause(ended))
        self.hub.notify()

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
                self.hub.notify()
            except (StoreError, OSError, ValueError) as error:
                self._complain(str(error))
            await asyncio.sleep(self.settings.poll)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.error("a watch has ended by itself", exc_info=error)
            self.trouble = f"{type(error).__name__}: {error}"

    def _complain(self, text: str) -> None:
        if self.trouble != text:
            logger.warning("%s", text)
        self.trouble = text

    def _disk(self) -> str | None:
        free = shutil.disk_usage(self.settings.data).free
        if free >= self.settings.free_disk:
            return None
        return f"{self.settings.data}: {free} bytes free, no job is started below {self.settings.free_disk}"

    def _cores_again(self, cores: Sequence[int]) -> set[int]:
        """The numbers of cores that an adopted job has; what this service was not given it does not count."""
        taken: set[int] = set()
        for core in cores:
            number = next((k for k in sorted(self.free - taken) if self.cores[k] == core), None)
            taken |= set() if number is None else {number}
        self.free -= taken
        return taken


def make_directory(directory: Path, job: Job) -> None:
    """The run directory as a runner expects it: the case, and who asked for what."""
    directory.mkdir(parents=True, exist_ok=True)
    submitted = directory / "submitted.json"
    if not submitted.exists():
        beside = submitted.with_name("submitted.json.new")
        beside.write_text(job.case)
        os.replace(beside, submitted)
    keys = ("seq", "id", "identity", "name", "ranks", "priority", "tags", "time_limit", "created")
    record = {key: getattr(job, key) for key in keys}
    write_json(directory / "job.json", record, durable=False)
