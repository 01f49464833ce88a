"""The scheduler knows nothing of processes and cores: a backend without either does what it asks."""

import ast
import asyncio
import inspect
from pathlib import Path
from unittest.mock import patch

import pytest
from booths import Booths
from serving import ended, in_state, new_job, settings, submit, until

from frit.service.jobs import scheduler
from frit.service.jobs.backends.protocol import Backend
from frit.service.jobs.engine import Engine
from frit.service.jobs.states import State


def test_jobs_run_where_there_are_no_processes(tmp_path: Path) -> None:
    """No process is started or looked at; as many at once as there are booths."""

    async def main() -> None:
        booths = Booths(3)
        checked: Backend = booths
        async with Engine(settings(tmp_path / "data", cores=1), checked) as engine:
            asked = [new_job(f"sleep 0.{k}", 0.1 * k, ranks=1 + k % 2) for k in range(1, 7)]
            jobs = await ended(engine, *await submit(engine, *asked))
            assert [job.state for job in jobs] == [State.SUCCEEDED] * 6
            assert [job.core_seconds for job in jobs] == pytest.approx([0.1 * k * (1 + k % 2) for k in range(1, 7)])
            assert (booths.free, len(booths.started)) == (3, 6)
            for job in jobs:
                assert engine.store.attempts(job.id)[0].handle == {"ticket": f"{job.id} 1"}
                names = {path.name for path in engine.run_directory(job.id).iterdir()}
                assert names == {"submitted.json", "job.json"}

    with (
        patch("os.pidfd_open", side_effect=AssertionError("a process is opened")),
        patch("subprocess.Popen", side_effect=AssertionError("a process is started")),
    ):
        asyncio.run(main())


def test_a_later_service_finds_them_again(tmp_path: Path) -> None:
    async def main() -> None:
        booths = Booths(1)
        async with Engine(settings(tmp_path / "data"), booths) as engine:
            (job,) = await submit(engine, new_job("sleep 0.8"))
            await in_state(engine, job, State.RUNNING)
        assert booths.free == 0
        booths.taken.clear()  # the next one is told by the index alone what is held
        async with Engine(settings(tmp_path / "data"), booths) as engine:
            assert booths.taken == {job.id: 1}
            (job,) = await ended(engine, job)
            assert (job.state, job.attempt, len(booths.started)) == (State.SUCCEEDED, 1, 1)

    asyncio.run(main())


def test_one_is_cancelled_and_one_that_could_not_be_started_is_tried_again(tmp_path: Path) -> None:
    async def main() -> None:
        booths = Booths(2)
        async with Engine(settings(tmp_path / "data"), booths) as engine:
            long, odd = await submit(engine, new_job("sleep 1000"), new_job("refuse 0", 0.1))
            await in_state(engine, long, State.RUNNING)
            await engine.cancel(long.id)
            long, odd = await ended(engine, long, odd)
            assert (long.state, long.attempt) == (State.CANCELLED, 1)
            assert (odd.state, odd.attempt) == (State.SUCCEEDED, 2)
            assert engine.store.attempts(odd.id)[0].message == "all booths are closed"
            await until(engine, lambda: booths.free == 2)

    asyncio.run(main())


def test_the_scheduler_imports_nothing_of_processes() -> None:
    tree = ast.parse(inspect.getsource(scheduler))
    imported = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert not {name.split(".")[-1] for name in imported} & {"os", "processes", "local", "subprocess", "psutil"}
    assert "backends.protocol" in imported
