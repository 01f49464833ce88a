"""An attempt that got further than the checkpoint it began from does not count: who sees that, and when."""

import asyncio
import os
import signal
from pathlib import Path

import pytest
from indexing import LIMIT, done, new, started
from serving import ended, new_job, settings, submit, until

from frit.service.index.reindex import rebuild
from frit.service.index.store import Store
from frit.service.jobs.engine import Engine
from frit.service.jobs.runner import advanced, checkpoint_in
from frit.service.jobs.states import Exit, Job, Move, State
from frit.solver.durable import read_json, write_json


def test_only_another_checkpoint_of_that_attempt_is_progress(tmp_path: Path) -> None:
    def began(attempt: int) -> None:
        write_json(tmp_path / "attempt.json", {"attempt": attempt, "checkpoint": checkpoint_in(tmp_path)})

    assert not advanced(tmp_path, 1)  # killed before it had recorded itself
    began(1)
    assert not advanced(tmp_path, 1)
    (tmp_path / "checkpoint.h5").write_text("0")
    assert advanced(tmp_path, 1)  # the first there is
    assert not advanced(tmp_path, 2)
    began(2)
    assert not advanced(tmp_path, 2)
    beside = tmp_path / "new"
    beside.write_text("1")
    beside.replace(tmp_path / "checkpoint.h5")
    assert advanced(tmp_path, 2)
    (tmp_path / "checkpoint.h5").unlink()
    assert not advanced(tmp_path, 2)
    write_json(tmp_path / "attempt.json", {"attempt": 2})  # of an older frit, which did not write it down
    beside.write_text("1")
    beside.replace(tmp_path / "checkpoint.h5")
    assert not advanced(tmp_path, 2)


@pytest.mark.parametrize("move", [Move.BREAK, Move.LOSE])
def test_progress_begins_the_count_anew(tmp_path: Path, move: Move) -> None:
    store = Store(tmp_path)
    job = done(store.submit(new(1)))
    for advanced_, failures in ((False, 1), (False, 2), (True, 0), (True, 0), (False, 1)):
        job = started(store, job)
        job = done(store.finish(job.id, Exit(job.attempt, move, None, 1.0, advanced=advanced_), LIMIT))
        assert (job.failures, job.retrying) == (failures, True)
        job = done(store.requeue(job.id, job.attempt))
    job = started(store, job)
    job = done(store.finish(job.id, Exit(job.attempt, move, None, 1.0, advanced=True, again=False), LIMIT))
    assert (job.retrying, job.final) == (False, True)
    store.close()


def test_an_index_that_is_made_anew_knows_it(tmp_path: Path) -> None:
    """From the exit record that nobody had read."""
    store = Store(tmp_path)
    job = done(store.submit(new(1)))
    for _ in range(2):
        job = started(store, job)
        job = done(store.finish(job.id, Exit(job.attempt, Move.BREAK, None, 1.0), LIMIT))
        job = done(store.requeue(job.id, job.attempt))
    assert job.failures == 2
    job = started(store, job)
    store.close()
    directory = tmp_path / "runs" / job.id
    directory.mkdir(parents=True)
    end = {"attempt": 3, "move": "break", "message": None, "ended": 5.0, "advanced": True}
    write_json(directory / "exit.json", end)
    rebuild(tmp_path, LIMIT)
    store = Store(tmp_path)
    job = store.job(job.id)
    assert (job.state, job.failures, job.retrying) == (State.ERROR, 0, True)
    store.close()


@pytest.mark.usefixtures("standing_in")
def test_a_job_that_breaks_often_and_gets_further_each_time_succeeds(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", attempts=2)) as engine:
            (job,) = await ended(engine, *await submit(engine, new_job("stumbles 6")))
            assert (job.state, job.attempt, job.failures) == (State.SUCCEEDED, 6, 0)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("restarted", [False, True])
def test_so_does_one_whose_runners_vanish(tmp_path: Path, restarted: bool) -> None:
    """Also where no service was there to see it."""

    async def further(engine: Engine, job: Job, attempt: int) -> None:
        await until(engine, lambda: advanced(engine.run_directory(job.id), attempt))

    def lose(engine: Engine, job: Job) -> None:
        os.kill(int(read_json(engine.run_directory(job.id) / "attempt.json")["pid"]), signal.SIGKILL)

    async def main() -> None:
        (tmp_path / "data").mkdir()
        store = Store(tmp_path / "data")
        job = store.submit(new_job("stumbles 5 slowly")).result()
        store.close()
        if restarted:
            for attempt in range(1, 5):
                async with Engine(settings(tmp_path / "data", attempts=2)) as engine:
                    await further(engine, job, attempt)
                    await engine.scheduler.close()
                    lose(engine, job)
        async with Engine(settings(tmp_path / "data", attempts=2)) as engine:
            for attempt in range(1, 1 if restarted else 5):
                await further(engine, job, attempt)
                lose(engine, job)
            (job,) = await ended(engine, job)
            assert (job.state, job.attempt, job.failures) == (State.SUCCEEDED, 5, 0)
            assert [a.state for a in engine.store.attempts(job.id)] == ["lost"] * 4 + ["succeeded"]

    asyncio.run(main())
