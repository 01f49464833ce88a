"""Wakes whoever waits for something to happen: a commit of the index, a line of progress, the end of a runner."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

SHARE = 0.3  # of the loop's time, for looks that followers take, however many there are


class Notifier:
    """Belongs to one event loop; `notify` may be called from any thread."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        self.count = 0  # of notifications
        self._turn = asyncio.Lock()

    def notify(self) -> None:
        """Something has happened."""
        with suppress(RuntimeError):  # the loop has ended meanwhile: nobody waits any more
            self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        self.count += 1
        self._changed.set()
        self._changed = asyncio.Event()

    async def wait(self, seconds: float, seen: int | None = None) -> bool:
        """Until the next notification; False where none comes in that time.

        seen: the count before a look at things; what has come since counts as the next.
        """
        if seen is not None and seen != self.count:
            return True
        try:
            async with asyncio.timeout(seconds):  # `wait_for` of Python 3.11 may lose a cancellation
                await self._changed.wait()
        except TimeoutError:
            return False
        return True

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """One look at a time, and pauses between them: a notification wakes all followers at once.

        What is within may not wait for anything.
        """
        async with self._turn:
            began = self._loop.time()
            yield
            await asyncio.sleep((self._loop.time() - began) * (1 / SHARE - 1))
