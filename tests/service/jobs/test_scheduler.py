"""Who gets cores, and when: the choice by itself, and an engine that starts real processes on real cores."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st
from serving import ended, in_state, new_job, settings, submit, until

from frit.service.jobs.backends.local import LocalBackend, choose
from frit.service.jobs.engine import Engine, EngineError
from frit.service.jobs.scheduler import Scheduler
from frit.service.jobs.states import State, Waiting
from frit.service.settings import own_cores

queues = st.lists(st.integers(1, 9), max_size=20).map(lambda found: [Waiting(k, r) for k, r in enumerate(found)])


# --- the choice -------------------------------------------------------------------------------------------


@given(queue=queues, free=st.integers(0, 8), more=st.integers(0, 4), overtake=st.booleans())
def test_a_choice_fits_and_keeps_the_order(
    queue: list[Waiting], free: int, more: int, overtake: bool
) -> None:
    total, ranks, asked = free + more, {job.seq: job.ranks for job in queue}, list[int]()

    def ask(seq: int) -> bool:
        asked.append(seq)
        return overtake

    chosen = choose(queue, free, total, ask)
    assert sum(ranks[seq] for seq in chosen) <= free
    assert chosen == sorted(set(chosen))
    # Only the first that did not fit is asked about; before it everybody that could ever run was taken.
    possible = [job.seq for job in queue if job.ranks <= total]
    left = [seq for seq in possible if seq not in chosen]
    assert asked == left[:1]
    if left and not overtake:
        assert all(seq < left[0] for seq in chosen)
    if overtake:  # nobody that would still fit is left
        spare = free - sum(ranks[seq] for seq in chosen)
        assert all(ranks[seq] > spare for seq in left)


def test_a_job_larger_than_all_cores_blocks_nobody() -> None:
    assert choose([Waiting(1, 3), Waiting(2, 1), Waiting(3, 2)], 2, 2, lambda _: False) == [2]


# --- an engine --------------------------------------------------------------------------------------------


def calls(engine: Engine, identifier: str) -> list[tuple[int, list[int], float]]:
    """Of the stand-in: pid, processors, monotonic time."""
    lines = (engine.run_directory(identifier) / "calls").read_text().splitlines()
    found = []
    for line in lines:
        pid, rest = line.split(" ", 1)
        cores, clock = rest.rsplit(" ", 1)
        found.append((int(pid), [int(core) for core in cores.strip("[]").split(",")], float(clock)))
    return found


@pytest.mark.usefixtures("standing_in")
def test_two_jobs_of_one_rank_run_side_by_side_each_on_its_own_core(tmp_path: Path) -> None:
    if len(own_cores()) < 2:
        pytest.skip("one processor only")

    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            jobs = await submit(engine, new_job("sleep 30", 0.0), new_job("sleep 30", 0.1), new_job("sleep 0", 0.2))
            for job in jobs[:2]:
                await until(engine, lambda job=job: (engine.run_directory(job.id) / "calls").exists())  # type: ignore[misc]
            (_, first, _), (_, second, _) = (calls(engine, job.id)[0] for job in jobs[:2])
            assert len(first) == len(second) == 1
            assert first != second
            assert [list(engine.store.attempts(job.id)[0].cores) for job in jobs[:2]] == [first, second]
            assert engine.store.job(jobs[2].id).state is State.QUEUED
            await engine.cancel(jobs[0].id)
            assert [job.state for job in await ended(engine, jobs[0], jobs[2])] == ["cancelled", "succeeded"]
            assert calls(engine, jobs[2].id)[0][1] == first  # the core that became free
            await engine.cancel(jobs[1].id)
            await ended(engine, jobs[1])

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_priority_comes_before_age(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (running,) = await submit(engine, new_job("sleep 30"))
            await in_state(engine, running, State.RUNNING)
            waiting = [new_job("sleep 0", 0.01 * k, priority=p) for k, p in enumerate((0, 0, 5, 5, -1), start=1)]
            jobs = await submit(engine, *waiting)
            await engine.cancel(running.id)
            await ended(engine, *jobs)
            order = sorted(jobs, key=lambda job: calls(engine, job.id)[0][2])
            assert [jobs.index(job) for job in order] == [2, 3, 0, 1, 4]

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize(("patience", "starved"), [(0.0, False), (1000.0, True)])
def test_small_jobs_overtake_a_large_one_for_a_while_only(tmp_path: Path, patience: float, starved: bool) -> None:
    """Cores 2. One small job runs, a large one waits, more small ones come: they go first while there is patience."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", patience=patience)) as engine:
            (holder,) = await submit(engine, new_job("sleep 30"))
            await in_state(engine, holder, State.RUNNING)
            (large,) = await submit(engine, new_job("sleep 0", 0.5, ranks=2))
            small = await submit(engine, *(new_job("sleep 0", 0.01 * k) for k in range(1, 4)))
            if starved:
                await ended(engine, *small)
                assert engine.store.job(large.id).state is State.QUEUED
            await engine.cancel(holder.id)
            await ended(engine, large, *small)
            first = calls(engine, large.id)[0][2]
            assert all((calls(engine, job.id)[0][2] < first) == starved for job in small)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_tick_costs_one_query(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (running,) = await submit(engine, new_job("sleep 30"))
            await in_state(engine, running, State.RUNNING)
            await submit(engine, *(new_job("sleep 0", 0.001 * k) for k in range(1, 50)))
            statements: list[str] = []
            for database in (engine.store._reader, engine.store._engine):
                sa.event.listen(database, "before_cursor_execute", lambda *a: statements.append(a[2]))
            ask = engine.store._ask

            def asked(query: str, values: Sequence[Any] = ()) -> list[Any]:
                statements.append(query)
                return ask(query, values)

            engine.store._ask = asked  # type: ignore[method-assign]
            own = engine.scheduler  # another one beside it, which nobody runs
            cores = LocalBackend(1)
            idle = Scheduler(own.settings, engine.store, engine.notifier, cores, own.follower)
            cores.spare = set()
            await idle.tick()
            assert statements == []
            cores.spare = {0}
            with (
                patch.object(engine.store, "claim", side_effect=LookupError("asked for a claim")),
                pytest.raises(LookupError),
            ):
                await idle.tick()
            assert [text.split()[0] for text in statements] == ["SELECT"]
            await engine.cancel(running.id)

    asyncio.run(main())


def test_one_service_per_data_folder(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data")):
            with pytest.raises(EngineError, match=r"data = .*: in use by process \d+"):
                async with Engine(settings(tmp_path / "data")):
                    pass
        async with Engine(settings(tmp_path / "data")):
            pass  # free again

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_no_job_starts_while_the_disk_is_nearly_full(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", free_disk=10**18)) as engine:
            (job,) = await submit(engine, new_job("sleep 0"))
            await until(engine, lambda: engine.trouble() is not None)
            assert "bytes free, no job is started below" in str(engine.trouble())
            assert engine.store.job(job.id).state is State.QUEUED
        async with Engine(settings(tmp_path / "data")) as engine:
            assert (await ended(engine, job))[0].state is State.SUCCEEDED
            assert engine.trouble() is None

    asyncio.run(main())
