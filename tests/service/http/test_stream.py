"""Many who follow jobs: the service answers others meanwhile."""

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest
from indexing import done, new, opened

from frit.service.http.stream import events
from frit.service.index.store import Store
from frit.service.jobs.notifier import Notifier
from frit.service.settings import Settings

LOOK = 0.005  # seconds of the processor that a look of these tests takes


class Slow:
    """What a follower needs of an engine; every look at the index keeps the loop waiting."""

    def __init__(self, store: Store, folder: Path) -> None:
        self.store, self.notifier, self.settings = store, Notifier(), Settings(data=folder)

    def progress(self, _: str) -> dict[str, Any] | None:
        """None yet."""
        return None


def admitted() -> bool:
    """Always, after some work."""
    time.sleep(LOOK)
    return True


async def longest_wait(store: Store, folder: Path, job: str, followers: int) -> tuple[float, int]:
    """The longest time in which the loop answered nobody, seconds, and how many events came, in a second."""
    engine, came = Slow(store, folder), 0

    async def follow() -> None:
        nonlocal came
        async for _ in events(engine, job, None, admitted):  # type: ignore[arg-type]
            came += 1

    tasks = [asyncio.create_task(follow()) for _ in range(followers)]
    longest, end = 0.0, time.monotonic() + 1.0
    while (now := time.monotonic()) < end:
        engine.notifier.notify()
        await asyncio.sleep(0.001)
        longest = max(longest, time.monotonic() - now)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return longest, came


def test_a_hundred_followers_leave_the_loop_to_others(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        job = done(store.submit(new(1)))
        longest, came = asyncio.run(longest_wait(store, tmp_path, job.id, 100))
    assert longest < 20 * LOOK  # were all looks taken at once: 100
    assert came > 10


@pytest.mark.parametrize("passes", range(6))
def test_a_follower_that_is_woken_and_cancelled_at_once_ends(passes: int) -> None:
    async def try_it() -> bool:
        notifier = Notifier()

        async def follow() -> None:
            while True:
                await notifier.wait(60.0)

        task = asyncio.create_task(follow())
        await asyncio.sleep(0.01)
        notifier.notify()
        for _ in range(passes):
            await asyncio.sleep(0)
        task.cancel()
        await asyncio.wait([task], timeout=0.5)
        ended = task.cancelled()
        task.cancel()
        return ended

    assert asyncio.run(try_it())
