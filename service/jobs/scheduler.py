"""Which job gets which cores, and when; and one watch per job that has them."""

import asyncio
import logging
import shutil
import signal
import time
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

from frit.solver.durable import write_json, write_whole

from ..index.records import Attempt, NotFoundError, StoreError
from ..index.results import Follower
from ..index.store import Store
from ..settings import Settings, own_cores
from .backends.local import BackendError, FolderError, LocalBackend, Process
from .notifier import Notifier
from .processes import boot, start_of
from .runner import Order, advanced
from .states import Exit, Job, Move, State, one_sentence

AHEAD = 256  # jobs of the queue that one tick looks at
TICK = 1.0  # seconds between two ticks when nothing happens
AGAIN = 1.0  # seconds before a piece of work that the index refused, or that failed, is tried again
READINGS = 5  # times that what a job has left behind is read in vain before it ends without

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
    """Belongs to one event loop, as its store's notifier does."""

    def __init__(
        self, settings: Settings, store: Store, notifier: Notifier, backend: LocalBackend, follower: Follower
    ) -> None:
        self.settings, self.store, self.notifier = settings, store, notifier
        self.backend, self.follower = backend, follower
        own = own_cores()
        self.cores = [own[k % len(own)] for k in range(settings.cores)]
        self.free = set(range(settings.cores))  # numbers of self.cores
        self.running: dict[str, Job] = {}  # with cores, by id
        self.held: dict[str, set[int]] = {}  # the cores of those
        self.stuck: dict[str, str] = {}  # jobs whose watch has failed, and how: nobody knows whether they live
        self.open = True  # whether to start jobs
        self._said: str | None = "starting up"
        self._closing = False
        self._tasks: set[asyncio.Task[None]] = set()
        self._births: set[asyncio.Task[int]] = set()  # of runners
        self._first: tuple[int, float] | None = None  # the job that waits for cores, and since when

    @property
    def trouble(self) -> str | None:
        """Why no job can be started or recorded now, or cores are held by what may not live; None: all is well."""
        stuck = [f"job {job}: its watch has failed: {reason}" for job, reason in self.stuck.items()]
        return "; ".join(stuck[:3]) or self._said

    def stuck_cores(self) -> int:
        """How many cores are held by jobs of which nobody knows whether they live."""
        return sum(len(self.held.get(job, ())) for job in self.stuck)

    # --- the loop -----------------------------------------------------------------------------------------

    async def adopt(self) -> None:
        """Take over what an earlier service has left: running jobs, unread exit records, pauses."""
        held, waiting = await asyncio.to_thread(self.store.unfinished)
        for job, attempt in held:
            cores = self._cores_again(attempt.cores)
            self.running[job.id], self.held[job.id] = job, cores
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
            self.held[job.id] = set(given[job.seq])
            self.free -= self.held[job.id]
            self.running[job.id] = job
            self._attend(job, self._start(job))

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

    async def _start(self, job: Job) -> None:
        directory = self.settings.runs / job.id
        order = Order(
            job.attempt, str(directory), job.ranks, tuple(self.cores[k] for k in sorted(self.held[job.id])),
            job.time_limit, self.settings.grace, self.settings.memory_limit,
        )  # fmt: skip
        self.follower.follow(job)
        try:
            birth = asyncio.create_task(self._bear(job, order))
            self._births.add(birth)
            birth.add_done_callback(self._births.discard)
            pid = await asyncio.shield(birth)
        except FolderError as error:
            return await self._lose(job, error)
        except (BackendError, OSError) as error:
            logger.warning("job %s: %s", job.id, error)
            record = await self._recorded(job)
            if record is None:
                return await self._end(job, Exit(job.attempt, Move.BREAK, one_sentence(str(error)), time.time()))
            pid = int(record["pid"])  # it was forked all the same: only the answer was lost
        process, beside = None, None
        if (started := start_of(pid)) is not None:
            process = Process(pid, started, boot())
            beside = self._spawn(self._started(job, process))
        await self._watch(job, process, beside)

    async def _bear(self, job: Job, order: Order) -> int:
        """Not to be cut short: a claimed job gets its runner."""
        await asyncio.to_thread(make_directory, Path(order.directory), job)
        return await self.backend.start(order)

    async def _recorded(self, job: Job) -> dict[str, Any] | None:
        """What the attempt's runner has recorded of itself; None where there is none, or no folder."""
        try:
            return await self.backend.recorded(self.settings.runs / job.id, job.attempt)
        except FolderError:
            return None

    async def _started(self, job: Job, process: Process) -> None:
        recorded = await self._insist(lambda: self.store.start(job.id, job.attempt, *process))
        if recorded.attempt == job.attempt and job.id in self.running:
            self.running[job.id] = recorded
            if recorded.stopping:  # the wish came before there was a runner to tell
                await self.stop(recorded, "cancelled")

    async def _adopt(self, job: Job, attempt: Attempt, unborn: Exit) -> None:
        """Watch a runner that was started before; `unborn`: what is said where it did not come to that."""
        record, process = await self._recorded(job), process_of(attempt)
        if record is None and job.state is State.STARTING:
            await self.backend.clear(self.settings.runs / job.id, process)  # of one whose folder is gone
            return await self._end(job, unborn)
        if record is not None:
            process = Process(record["pid"], record["pid_start"], record["boot"])
            await self._started(job, process)
        await self._watch(job, process)

    async def _watch(self, job: Job, process: Process | None = None, beside: asyncio.Task[None] | None = None) -> None:
        """To the end of the job's runner, which may have come already; `beside`: what has to be told before that."""
        directory = self.settings.runs / job.id
        pid = None if process is None or beside is None else process.pid
        try:
            end = await self.backend.ended(directory, job.attempt, pid, lambda: self._well(job))
        except FolderError as error:
            return await self._lose(job, error, process)
        if beside is not None:
            await asyncio.wait([beside])
        if end is None:
            message, further = "the runner vanished without an exit record", advanced(directory, job.attempt)
            end = Exit(job.attempt, Move.LOSE, message, time.time(), advanced=further)
        await self._end(job, end)

    async def _lose(self, job: Job, error: FolderError, process: Process | None = None) -> None:
        """For good: there is nothing left to go on with, and nobody is to compute into the void.

        Where the folder of all runs is gone too, a disk is: its jobs may go on once it is back.
        """
        await self.backend.clear(self.settings.runs / job.id, process)
        again = not self.settings.runs.is_dir()
        await self._end(job, Exit(job.attempt, Move.LOSE, str(error), time.time(), again=again))

    async def _end(self, job: Job, end: Exit) -> None:
        """Into the index with it, history first, and its cores back."""
        result = await self._results(job)
        limit = self.settings.attempts
        try:
            ended = await self._insist(lambda: self.store.finish(job.id, end, limit, result or None))
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
        self.free |= self.held.pop(job.id, set())
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
        if self._closing or self.running.get(job.id, job).attempt != job.attempt or job.id not in self.held:
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
    directory.mkdir(exist_ok=True)  # not its parent: where that is gone, a disk is
    submitted = directory / "submitted.json"
    if not submitted.exists():
        write_whole(submitted, job.case.encode(), durable=False)
    keys = ("seq", "id", "identity", "name", "ranks", "priority", "tags", "time_limit", "created")
    record = {key: getattr(job, key) for key in keys}
    write_json(directory / "job.json", record, durable=False)


def process_of(attempt: Attempt) -> Process | None:
    """The runner of an attempt, as the index has it; None before that was told."""
    if attempt.pid is None or attempt.pid_start is None or attempt.boot is None:
        return None
    return Process(attempt.pid, attempt.pid_start, attempt.boot)
