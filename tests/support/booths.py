"""A second backend, as small as one can be: jobs are coroutines of this process, in numbered booths."""

import asyncio
import json
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from frit.service.jobs.backends.protocol import BackendError, Handle
from frit.service.jobs.runner import Order
from frit.service.jobs.states import Exit, Move, Waiting


class Booths:
    """A job sleeps as long as its name says (`sleep 0.1`); `refuse` is told once that there is no booth."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.taken: dict[str, int] = {}  # ranks by job
        self.acts: dict[str, asyncio.Event] = {}  # by ticket: set when somebody asks for its end
        self.ends: dict[str, Exit] = {}
        self.refused: set[str] = set()
        self.started: list[Order] = []
        self._going = set[asyncio.Task[None]]()

    @property
    def free(self) -> int:
        return self.total - sum(self.taken.values())

    def may_start(self, queue: Sequence[Waiting]) -> list[tuple[int, tuple[int, ...]]]:
        """The first only, and only if it fits: as simple as a queue can be."""
        return [(job.seq, ()) for job in queue[:1] if job.ranks <= self.free]

    def hold(self, job: str, ranks: int, cores: Sequence[int]) -> tuple[int, ...]:
        self.taken[job] = ranks
        return tuple(cores)

    def release(self, job: str) -> None:
        del self.taken[job]

    async def start(self, order: Order) -> Handle | None:
        name = json.loads((Path(order.directory) / "submitted.json").read_text())["name"]
        what, _, seconds = name.partition(" ")
        if what == "refuse" and name not in self.refused:
            self.refused.add(name)
            raise BackendError("all booths are closed")
        ticket = self._ticket(Path(order.directory), order.attempt)
        self.acts[ticket] = asyncio.Event()
        self.started.append(order)
        task = asyncio.create_task(self._act(ticket, order, float(seconds)))
        self._going.add(task)
        return {"ticket": ticket}

    async def _act(self, ticket: str, order: Order, seconds: float) -> None:
        move = Move.STOP
        try:
            async with asyncio.timeout(seconds):
                await self.acts[ticket].wait()
        except TimeoutError:
            move = Move.SUCCEED
        self.ends[ticket] = Exit(order.attempt, move, None, time.time(), seconds * order.ranks)

    async def find(self, directory: Path, attempt: int) -> Handle | None:
        ticket = self._ticket(directory, attempt)
        return {"ticket": ticket} if ticket in self.acts else None

    async def ended(
        self, directory: Path, attempt: int, handle: Handle | None, alive: Callable[[], None]
    ) -> Exit | None:
        assert handle is None or handle["ticket"] == self._ticket(directory, attempt)  # as the index kept it
        while (end := self.ends.get(self._ticket(directory, attempt))) is None:
            alive()
            await asyncio.sleep(0.005)
        return end

    async def clear(self, directory: Path, handle: Handle | None) -> None:
        if handle is not None:
            self.acts[handle["ticket"]].set()

    def tell(self, directory: Path, attempt: int, number: signal.Signals) -> None:
        self.acts[self._ticket(directory, attempt)].set()

    def close(self) -> None:
        pass

    @staticmethod
    def _ticket(directory: Path, attempt: int) -> str:
        return f"{directory.name} {attempt}"
