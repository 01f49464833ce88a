"""Runners: what an end means, the ladder of signals, and lives that go on when others end."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil
import pytest
from places import SUPPORT
from serving import ended, in_state, new_job, settings, submit, until
from soak import of_data

from frit.service.index.store import Store
from frit.service.jobs.backends.local import LocalBackend
from frit.service.jobs.backends.protocol import BackendError
from frit.service.jobs.engine import Engine
from frit.service.jobs.launch import Outcome
from frit.service.jobs.processes import start_of
from frit.service.jobs.runner import Order, judge, read_exit
from frit.service.jobs.states import Job, Move, State
from frit.solver.durable import read_json, write_json


@pytest.mark.parametrize(
    ("outcome", "reason", "move"),
    [
        (Outcome("succeeded", None, 0, ""), None, Move.SUCCEED),
        (Outcome("succeeded", None, 0, ""), "cancelled", Move.SUCCEED),  # it was quicker than the wish
        (Outcome("interrupted", "checkpoint at t = 1", 130, ""), "cancelled", Move.STOP),
        (Outcome("interrupted", "checkpoint at t = 1", 130, ""), "timed_out", Move.TIME_OUT),
        (Outcome("interrupted", "checkpoint at t = 1", 130, ""), "released", Move.RELEASE),
        (Outcome("interrupted", "checkpoint at t = 1", 130, ""), None, Move.RELEASE),  # a signal from elsewhere
        (Outcome("failed", "fields left", 1, ""), None, Move.FAIL),
        (Outcome("failed", "fields left", 1, ""), "cancelled", Move.FAIL),
        (Outcome("refused", "radii", 2, ""), None, Move.FAIL),
        (Outcome("failed", "OSError", 1, "trace", True), None, Move.BREAK),
        (Outcome("failed", "stopped before the first checkpoint", 1, "", True), "cancelled", Move.STOP),
        (Outcome("failed", "mpirun ended with status -9", -9, "", True), "timed_out", Move.TIME_OUT),
        (Outcome("refused", None, 2, "another process", True), None, Move.BREAK),
    ],
)
def test_what_an_outcome_means(outcome: Outcome, reason: str | None, move: Move) -> None:
    assert judge(outcome, reason)[0] is move


def runner_pid(engine: Engine, job: Job) -> int:
    record = read_json(engine.run_directory(job.id) / "attempt.json")
    assert start_of(record["pid"]) == record["pid_start"]
    return int(record["pid"])


async def computing(engine: Engine, job: Job) -> None:
    """Wait until the solver has written a checkpoint."""
    await until(engine, lambda: (engine.run_directory(job.id) / "checkpoint.h5").exists())


def rows(engine: Engine, job: Job) -> list[dict[str, Any]]:
    """The history from the index, without the wall time."""
    found = [json.loads(line) for _, line in engine.store.history(job.id)]
    return [{key: value for key, value in row.items() if key != "wall_time"} for row in found]


# --- with the real solver ---------------------------------------------------------------------------------


def test_a_cancelled_job_keeps_a_checkpoint_and_goes_on_from_it(tmp_path: Path) -> None:
    """Cancelled, tried again, cut short by its time limit, tried again: the history is that of a run left alone."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            (calm,) = await ended(engine, *await submit(engine, new_job("calm", steps=1500)))
            (job,) = await submit(engine, new_job("moved", steps=1500, time_limit=600.0))
            await computing(engine, job)
            await engine.cancel(job.id)
            (job,) = await ended(engine, job)
            assert (job.state, job.attempt) == (State.CANCELLED, 1)
            assert (job.message or "").startswith("checkpoint at t = ")
            assert not of_data(tmp_path / "data")
            await asyncio.wrap_future(engine.store.retry(job.id))
            (job,) = await ended(engine, job)
            assert (job.state, job.attempt) == (State.SUCCEEDED, 2)
            assert rows(engine, job) == rows(engine, calm)
            assert [number for number, _ in engine.store.snapshots(job.id)] == [0, 1]
            assert job.result["time"] == pytest.approx(0.15)
            assert read_json(engine.run_directory(job.id) / "run.json")["resumed"] != []

    asyncio.run(main())


def test_a_time_limit_leaves_a_checkpoint(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            (job,) = await submit(engine, new_job("long", steps=100_000, time_limit=6.0))
            (job,) = await ended(engine, job)
            assert job.state is State.TIMED_OUT
            assert (engine.run_directory(job.id) / "checkpoint.h5").exists()

    asyncio.run(main())


def test_what_the_solver_refuses_or_gives_up_is_not_tried_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            job = new_job("blows up", steps=1000)
            tree = json.loads(job.case)
            tree["time"]["step"] = 0.1
            (job_,) = await submit(engine, type(job)(json.dumps(tree), "0" * 64, "blows up"))
            (job_,) = await ended(engine, job_)
            assert (job_.state, job_.attempt) == (State.FAILED, 1)
            assert "likely cause: the time step is too long" in (job_.message or "")

    asyncio.run(main())


def test_killed_ranks_mpirun_and_runners_are_tried_again_from_the_checkpoint(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            (job,) = await submit(engine, new_job("hunted", steps=6000))
            for attempt, victim in enumerate(("frit.solver", "mpirun", "runner"), start=1):
                await until(engine, lambda n=attempt: engine.store.job(job.id).attempt == n)  # type: ignore[misc]
                await in_state(engine, job, State.RUNNING)
                before = (engine.run_directory(job.id) / "run.json").exists() and attempt > 1
                await computing(engine, job)
                resumed = lambda n=attempt: len(  # noqa: E731
                    read_json(engine.run_directory(job.id) / "run.json").get("resumed", [])
                ) >= n - 1
                await until(engine, resumed)
                assert before or attempt == 1
                if victim == "runner":
                    pid = runner_pid(engine, job)
                else:
                    tree = of_data(tmp_path / "data")
                    pid = next(p.pid for p in tree if any(victim in word for word in p.cmdline()[:5]))
                os.kill(pid, signal.SIGKILL)
                await until(engine, lambda n=attempt: engine.store.job(job.id).attempt > n)  # type: ignore[misc]
            (job,) = await ended(engine, job)
            assert (job.state, job.attempt) == (State.SUCCEEDED, 4)
            states = [event.state for event in engine.store.events(job.id)]
            assert states.count(State.SUCCEEDED) == 1
            assert {State.ERROR, State.LOST} <= set(states)
            assert not of_data(tmp_path / "data")

    asyncio.run(main())


# --- with a stand-in --------------------------------------------------------------------------------------


@pytest.mark.usefixtures("standing_in")
def test_the_ladder_ends_in_kill(tmp_path: Path) -> None:
    """A tree that hears neither USR1 nor TERM is killed after two graces."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", grace=0.3)) as engine:
            (job,) = await submit(engine, new_job("deaf 60"))
            await until(engine, lambda: (engine.run_directory(job.id) / "calls").exists())
            await engine.cancel(job.id)
            (job,) = await ended(engine, job)
            assert job.state is State.CANCELLED
            assert not of_data(tmp_path / "data")

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("name", ["crash", "disk"])
def test_what_breaks_is_tried_again_until_attempts_run_out(tmp_path: Path, name: str) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", attempts=3)) as engine:
            (job,) = await ended(engine, *await submit(engine, new_job(name)))
            assert (job.state, job.attempt, job.failures, job.retrying) == (State.ERROR, 3, 3, False)
            states = [str(event.state) for event in engine.store.events(job.id)]
            assert states == ["queued", *["starting", "running", "error", "queued"] * 2, "starting", "running", "error"]
            await asyncio.wrap_future(engine.store.retry(job.id))
            await until(engine, lambda: engine.store.job(job.id).attempt > 3)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_failures_count_only_in_a_row(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", attempts=2)) as engine:
            (job,) = await ended(engine, *await submit(engine, new_job("once")))
            assert (job.state, job.attempt, job.failures) == (State.SUCCEEDED, 2, 0)

    asyncio.run(main())


ENGINE = """
import asyncio, sys
sys.path.insert(0, sys.argv[2])
from serving import settings
from frit.service.jobs.engine import Engine

async def main():
    async with Engine(settings(sys.argv[1])):
        print("ready", flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_runners_outlive_the_service_and_are_adopted(tmp_path: Path, how: signal.Signals) -> None:
    """One still runs, one ends while nobody looks: the next service takes up both, and neither is run again."""
    data = tmp_path / "data"
    command = [sys.executable, "-P", "-c", ENGINE, str(data), str(SUPPORT)]

    async def after(jobs: list[Job], pid: int) -> None:
        async with Engine(settings(data)) as engine:
            (short,) = await ended(engine, jobs[1])
            assert (short.state, short.attempt) == (State.SUCCEEDED, 1)
            long = engine.store.job(jobs[0].id)
            assert (long.state, long.attempt, runner_pid(engine, long)) == (State.RUNNING, 1, pid)
            async with asyncio.timeout(120.0):  # for hangs; a core is free an instant after its job has ended
                while engine.scheduler.backend.free != 1:
                    await asyncio.sleep(0.005)
            await engine.cancel(long.id)
            (long,) = await ended(engine, long)
            assert long.state is State.CANCELLED
            assert len((engine.run_directory(long.id) / "calls").read_text().splitlines()) == 1
            assert [a.number for a in engine.store.attempts(long.id)] == [1]

    data.mkdir()
    store = Store(data)
    jobs = [store.submit(job).result() for job in (new_job("sleep 30"), new_job("sleep 1.0", 0.1))]
    store.close()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    with process.stdout:
        process.stdout.readline()
        directories = [data / "runs" / job.id for job in jobs]
        while not all((directory / "calls").exists() for directory in directories):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(how)
        process.wait()
    pid = int(read_json(directories[0] / "attempt.json")["pid"])
    assert psutil.pid_exists(pid)
    while not (directories[1] / "exit.json").exists():
        assert psutil.pid_exists(pid)
        time.sleep(0.01)
    asyncio.run(after(jobs, pid))


@pytest.mark.usefixtures("standing_in")
def test_a_job_claimed_by_a_service_that_died_at_once_is_started_by_the_next(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            (job,) = await ended(engine, job_)
            assert (job.state, job.attempt, job.failures) == (State.SUCCEEDED, 2, 0)
            assert len((engine.run_directory(job.id) / "calls").read_text().splitlines()) == 1

    (tmp_path / "data").mkdir()
    store = Store(tmp_path / "data")
    job_ = store.submit(new_job("sleep 0")).result()
    store.claim([(job_.seq, (0,))]).result()
    store.close()
    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_run_whose_end_was_not_told_is_not_run_again(tmp_path: Path) -> None:
    """The solver had finished when the runner was killed."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            (job,) = await submit(engine, new_job("sleep 30"))
            await until(engine, lambda: (engine.run_directory(job.id) / "calls").exists())
            write_json(engine.run_directory(job.id) / "run.json", {"state": "done"})
            os.kill(runner_pid(engine, job), signal.SIGKILL)
            (job,) = await ended(engine, job)
            assert (job.state, job.attempt) == (State.SUCCEEDED, 2)
            assert len((engine.run_directory(job.id) / "calls").read_text().splitlines()) == 1

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_one_runner_per_run_directory_and_a_fork_server_that_may_die(tmp_path: Path) -> None:
    async def main() -> None:
        backend = LocalBackend(2)
        orders = []
        for k in range(2):
            directory = tmp_path / f"run{k}"
            directory.mkdir()
            (directory / "submitted.json").write_text(json.dumps({"name": "sleep 30"}))
            orders.append(Order(1, str(directory), 1, (os.sched_getaffinity(0).pop(),), None, 5.0, 10**10))
        pid = ((await backend.start(orders[0])) or {})["pid"]
        with pytest.raises(BackendError, match="a runner is there already"):
            await backend.start(orders[0])
        assert backend._fork_server is not None
        backend._fork_server[0].kill()
        backend._fork_server[0].wait()
        assert psutil.pid_exists(pid)
        other = ((await backend.start(orders[1])) or {})["pid"]  # by a new fork server
        for order in orders:
            directory = Path(order.directory)
            assert (await backend.find(directory, 1) or {})["pid"] in (pid, other)
            while not (directory / "calls").exists():
                await asyncio.sleep(0.01)
            write_json(directory / "request.json", {"attempt": 1, "stop": "cancelled"})
            backend.tell(directory, 2, signal.SIGTERM)  # of another attempt: nobody hears it
            backend.tell(directory, 1, signal.SIGTERM)
            end = await backend.ended(directory, 1)
            assert end is not None
            assert end.move is Move.STOP
            assert read_exit(directory, 2) is None
        backend.close()

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_a_runner_whose_birth_was_not_told_is_watched(tmp_path: Path) -> None:
    """The fork server is killed after the fork and before its answer."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", attempts=1)) as engine:
            backend = engine.scheduler.backend
            assert isinstance(backend, LocalBackend)
            fork = backend._fork

            async def mute(order: Order, lock: int) -> int:
                await fork(order, lock)
                raise EOFError("it has died")

            with patch.object(backend, "_fork", mute):
                (job,) = await ended(engine, *await submit(engine, new_job("sleep 0.2")))
            assert (job.state, job.attempt) == (State.SUCCEEDED, 1)

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
def test_release_writes_checkpoints_and_keeps_jobs_queued(tmp_path: Path) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            jobs = await submit(engine, *(new_job("sleep 30", 0.01 * k) for k in range(3)))
            for job in jobs[:2]:
                await until(engine, lambda job=job: (engine.run_directory(job.id) / "calls").exists())  # type: ignore[misc]
            await engine.scheduler.release()
            assert [engine.store.job(job.id).state for job in jobs] == [State.QUEUED] * 3
            assert all((engine.run_directory(job.id) / "checkpoint.h5").exists() for job in jobs[:2])
            assert not of_data(tmp_path / "data")

    asyncio.run(main())
