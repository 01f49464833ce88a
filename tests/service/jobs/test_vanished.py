"""A run folder that is deleted under its job: it is lost for good, its cores are free, and no process is left."""

import asyncio
import os
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil
import pytest
from serving import ended, in_state, new_job, settings, submit, until
from soak import of_data

from frit.service.http.metrics import Jobs
from frit.service.index.store import Store
from frit.service.jobs.backends import local
from frit.service.jobs.backends.local import LocalBackend
from frit.service.jobs.backends.protocol import Handle
from frit.service.jobs.engine import Engine
from frit.service.jobs.processes import boot, start_of, try_lock
from frit.service.jobs.runner import Order
from frit.service.jobs.states import Exit, Job, State
from frit.solver.durable import read_json

REASON = "its run folder was deleted, moved away or replaced while it had cores"


def moved_away(directory: Path) -> None:
    directory.rename(directory.with_name("elsewhere"))


def replaced_by_an_empty_one(directory: Path) -> None:
    moved_away(directory)
    directory.mkdir()


def replaced_by_a_file(directory: Path) -> None:
    moved_away(directory)
    directory.touch()


def replaced_by_a_copy(directory: Path) -> None:
    """In which nobody runs; what a copy of the folder's own lock would say is that the job may go on there."""
    moved_away(directory)
    shutil.copytree(directory.with_name("elsewhere"), directory)


WAYS = [shutil.rmtree, moved_away, replaced_by_an_empty_one, replaced_by_a_file]


async def runs(engine: Engine, job: Job) -> None:
    """Wait until the stand-in runs."""
    await until(engine, lambda: (engine.run_directory(job.id) / "calls").exists())
    await in_state(engine, job, State.RUNNING)


def lives(pid: int) -> bool:
    with suppress(psutil.NoSuchProcess):
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    return False


def runner_of(engine: Engine, job: Job) -> int:
    return int(read_json(engine.run_directory(job.id) / "attempt.json")["pid"])


async def is_lost_for_good(engine: Engine, job: Job, runner: int) -> None:
    """And the next job gets its core."""
    (job,) = await ended(engine, job)
    assert (job.state, job.message, job.attempt, job.retrying) == (State.LOST, REASON, 1, False)
    assert not lives(runner)
    assert not of_data(engine.settings.data)
    await until(engine, lambda: engine.scheduler.backend.free == 1)
    (after,) = await ended(engine, *await submit(engine, new_job("sleep 0", 0.2)))
    assert after.state is State.SUCCEEDED
    assert engine.trouble() is None


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("vanish", WAYS)
def test_under_a_running_job(tmp_path: Path, vanish: Callable[[Path], None]) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (job,) = await submit(engine, new_job("deaf 100"))
            await runs(engine, job)
            runner = runner_of(engine, job)
            vanish(engine.run_directory(job.id))
            await is_lost_for_good(engine, job, runner)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("vanish", WAYS)
def test_while_no_service_looks(tmp_path: Path, vanish: Callable[[Path], None]) -> None:
    """Its runner ends by itself; the next service finds out why."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (job,) = await submit(engine, new_job("deaf 100"))
            await runs(engine, job)
            runner = runner_of(engine, job)
        vanish(engine.run_directory(job.id))
        while lives(runner) or of_data(tmp_path / "data"):
            await asyncio.sleep(0.1)
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            await is_lost_for_good(engine, job, runner)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("restarted", [False, True])
def test_under_a_runner_that_hears_nothing(tmp_path: Path, restarted: bool) -> None:
    """The service ends a runner that hangs, and what it has started; also one that knows it from the index alone."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (job,) = await submit(engine, new_job("deaf 100"))
            await runs(engine, job)
            runner = runner_of(engine, job)
            os.kill(runner, signal.SIGSTOP)
            if not restarted:
                shutil.rmtree(engine.run_directory(job.id))
                return await is_lost_for_good(engine, job, runner)
        shutil.rmtree(engine.run_directory(job.id))
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            await is_lost_for_good(engine, job, runner)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_copy_that_took_the_place_is_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its lock is free while the runner lives."""
    monkeypatch.setattr(local, "LEAVING", 0.5)

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (job,) = await submit(engine, new_job("deaf 100"))
            await runs(engine, job)
            runner = runner_of(engine, job)
            os.kill(runner, signal.SIGSTOP)
            replaced_by_a_copy(engine.run_directory(job.id))
            await is_lost_for_good(engine, job, runner)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("when", ["before", "after"])
def test_under_a_starting_job(tmp_path: Path, when: str) -> None:
    """Before its runner is forked, and before it has recorded itself."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            backend, pids = engine.scheduler.backend, list[int]()
            start = backend.start

            async def cut(order: Order) -> Handle | None:
                if when == "before":
                    shutil.rmtree(order.directory)
                if (handle := await start(order)) is not None:
                    pids.append(handle["pid"])
                if when == "after":
                    os.kill(pids[0], signal.SIGSTOP)
                    shutil.rmtree(order.directory, ignore_errors=True)
                    shutil.rmtree(order.directory, ignore_errors=True)
                    os.kill(pids[0], signal.SIGCONT)
                return handle

            with patch.object(backend, "start", cut):
                (job,) = await ended(engine, *await submit(engine, new_job("deaf 100")))
            await is_lost_for_good(engine, job, pids[0] if pids else 0)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_queued_job_gets_a_new_folder(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (job,) = await submit(engine, new_job("once"))
            pause = engine.scheduler._pause

            async def cut(job: Job) -> None:
                shutil.rmtree(engine.run_directory(job.id))
                await pause(job)

            with patch.object(engine.scheduler, "_pause", cut):
                await until(engine, lambda: engine.store.job(job.id).attempt > 2)
            (job,) = await ended(engine, job)
            assert job.state is State.SUCCEEDED

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_cancelled_job_is_cancelled_all_the_same(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (job,) = await submit(engine, new_job("deaf 100"))
            await runs(engine, job)
            shutil.rmtree(engine.run_directory(job.id))
            await engine.cancel(job.id)
            (job,) = await ended(engine, job)
            assert (job.state, job.message) == (State.CANCELLED, REASON)
            assert not of_data(tmp_path / "data")
            assert not engine.run_directory(job.id).exists()

    asyncio.run(main())


def test_a_reused_pid_is_never_hit(tmp_path: Path) -> None:
    """The process is another's, as its start tells."""
    pid = os.getpid()
    other = local.Process(pid, (start_of(pid) or 0) - 1, boot())
    another = local.Process(pid, start_of(pid) or 0, "another boot")
    asyncio.run(LocalBackend(1).clear(tmp_path / "run", other._asdict()))
    asyncio.run(LocalBackend(1).clear(tmp_path / "run", another._asdict()))


# --- watches that fail ------------------------------------------------------------------------------------


def cores(engine: Engine) -> dict[str, float]:
    """What /metrics says of them."""
    families = {family.name: family.samples[0].value for family in Jobs(lambda: engine).collect() if family.samples}
    return {name: families[f"frit_cores{name}"] for name in ("", "_busy", "_stuck")}


@pytest.mark.usefixtures("standing_in")
def test_a_watch_that_fails_is_told_and_begun_anew(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            failing = True
            ended_ = engine.scheduler.backend.ended

            async def cut(*arguments: Any) -> Exit | None:
                if failing:
                    raise RuntimeError("no such luck")
                return await ended_(*arguments)

            with patch.object(engine.scheduler.backend, "ended", cut):
                (job,) = await submit(engine, new_job("sleep 3"))
                await until(engine, lambda: engine.trouble() is not None)
                began = time.monotonic()
                while time.monotonic() - began < 3.0:  # it is told all the time, whatever else goes well
                    assert engine.trouble() == f"job {job.id}: its watch has failed: RuntimeError: no such luck"
                    assert cores(engine) == {"": 1.0, "_busy": 1.0, "_stuck": 1.0}
                    await asyncio.sleep(0.02)
                failing = False
                (job,) = await ended(engine, job)
            assert (job.state, job.attempt) == (State.SUCCEEDED, 1)
            await until(engine, lambda: engine.trouble() is None)
            assert cores(engine) == {"": 1.0, "_busy": 0.0, "_stuck": 0.0}

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_start_that_fails_counts_as_an_attempt(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1, attempts=2)) as engine:
            start = engine.scheduler.backend.start

            async def cut(order: Order) -> Handle | None:
                if "says-no" in (Path(order.directory) / "submitted.json").read_text():
                    raise TypeError("of all things")
                return await start(order)

            with patch.object(engine.scheduler.backend, "start", cut):
                jobs = await submit(engine, new_job("says-no"), new_job("sleep 0"))
                jobs = await ended(engine, *jobs)
            assert [job.state for job in jobs] == [State.ERROR, State.SUCCEEDED]
            assert jobs[0].message == "its start failed: TypeError: of all things"
            assert engine.scheduler.backend.free == 1

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_job_that_is_no_more_in_the_index_gives_its_cores_back(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (job,) = await submit(engine, new_job("sleep 100"))
            await runs(engine, job)

            def forget(store: Store) -> None:
                store.write(lambda t: t.raw.execute("PRAGMA defer_foreign_keys = ON")).result()
                for table in ("attempts", "events", "jobs"):
                    column = "seq" if table == "jobs" else "job"
                    query = f"DELETE FROM {table} WHERE {column} = {job.seq}"
                    store.write(lambda t, query=query: t.raw.execute(query)).result()  # type: ignore[misc]

            await asyncio.to_thread(forget, engine.store)
            os.kill(runner_of(engine, job), signal.SIGKILL)
            await until(engine, lambda: engine.scheduler.backend.free == 1)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_what_cannot_be_read_holds_no_cores(tmp_path: Path) -> None:
    """A folder in the place of the history: an error of the system, and one that will not pass."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1)) as engine:
            (job,) = await submit(engine, new_job("sleep 0.5"))
            await runs(engine, job)
            (engine.run_directory(job.id) / "history.jsonl").mkdir()
            (job,) = await ended(engine, job)
            assert job.state is State.SUCCEEDED
            assert engine.scheduler.backend.free == 1

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_lock_that_somebody_else_holds_keeps_no_cores(tmp_path: Path) -> None:
    """The runner has recorded itself and lives no more: that is enough."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", cores=1, attempts=1)) as engine:
            (job,) = await submit(engine, new_job("sleep 100"))
            await runs(engine, job)
            path = engine.run_directory(job.id) / "runner.lock"
            os.kill(runner_of(engine, job), signal.SIGKILL)
            while (lock := try_lock(path)) is None:  # before the service gets it
                time.sleep(0.001)
            try:
                (job,) = await ended(engine, job)
            finally:
                os.close(lock)
            assert job.state is State.LOST

    asyncio.run(main())


def test_a_disk_that_goes_away_and_comes_back_loses_no_job(tmp_path: Path, standing_in: None) -> None:
    """All run folders are gone at once: that is no deletion, and nothing is begun anew beside them."""

    async def story() -> None:
        async with Engine(settings(tmp_path, attempts=50)) as engine:
            (job,) = await submit(engine, new_job("sleep 1"))
            await runs(engine, job)
            before = runner_of(engine, job)
            engine.settings.runs.rename(tmp_path / "unplugged")
            await until(engine, lambda: not lives(before))
            await until(engine, lambda: engine.store.job(job.id).failures > 1)
            assert not engine.settings.runs.exists()
            (tmp_path / "unplugged").rename(engine.settings.runs)
            (job,) = await ended(engine, job)
            assert job.state is State.SUCCEEDED
            assert not of_data(engine.settings.data)

    asyncio.run(story())
