"""What is deleted is there whole or gone for good, whenever the service is killed, and after `frit reindex` too."""

import asyncio
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import httpx2
import pytest
from asking import Process
from indexing import attempted, done, lines, new, opened, points, rows
from places import SUPPORT
from requesting import case
from serving import ended, new_job, settings, stand_in, submit

from frit.service.index.reindex import rebuild
from frit.service.index.removals import InUseError
from frit.service.jobs.engine import Engine
from frit.service.jobs.states import Move, State

CHILD = """
import asyncio, os, shutil, signal, sys
from pathlib import Path
from serving import settings
from frit.service.index import removals
from frit.service.index.store import Store
from frit.service.jobs import engine
from frit.service.jobs.engine import Engine

def killed(*arguments, **more):
    os.kill(os.getpid(), signal.SIGKILL)

def half(directory, **more):
    os.unlink(next(Path(directory).glob("exit.json")))
    killed()

point = sys.argv[2]
if point == "in the transaction":
    removals._record = killed
elif point == "rows gone":
    Store.mourn = killed
elif point == "journal knows":
    Engine._cleared = killed
elif point == "half the folder":
    engine.shutil.rmtree = half
elif point == "folder gone":
    Store.settle = killed

async def main():
    async with Engine(settings(Path(sys.argv[1]))) as running:
        await running.remove(sys.argv[3:])
asyncio.run(main())
"""
POINTS = ["in the transaction", "rows gone", "journal knows", "half the folder", "folder gone"]


async def two_ended(data: Path) -> list[str]:
    async with Engine(settings(data)) as engine:
        jobs = await ended(engine, *await submit(engine, new_job("sleep 0"), new_job("sleep 0", 0.1)))
        assert [job.state for job in jobs] == [State.SUCCEEDED] * 2
        return [job.id for job in jobs]


def killed_at(point: str, data: Path, *jobs: str) -> None:
    command = [sys.executable, "-c", CHILD, str(data), point, *jobs]
    child = subprocess.run(command, cwd=SUPPORT, capture_output=True, text=True, timeout=120, check=False)
    assert child.returncode == -signal.SIGKILL, child.stderr


def there(data: Path) -> dict[str, bool]:
    """The jobs of the index, and whether their folders are whole; no folder is there without a job."""
    found = {row["id"]: (data / "runs" / row["id"] / "exit.json").exists() for row in rows(data / "frit.db", "jobs")}
    assert {path.name for path in (data / "runs").iterdir() if path.is_dir()} <= found.keys()
    return found


async def served(data: Path) -> None:
    async with Engine(settings(data)):
        pass


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("point", POINTS)
def test_a_service_that_is_killed_in_the_middle(tmp_path: Path, point: str) -> None:
    """The next one finishes what was begun; a job that it has not begun with is whole."""
    data = tmp_path / "data"
    job, other = asyncio.run(two_ended(data))
    killed_at(point, data, job)
    asyncio.run(served(data))
    expected = {job: True, other: True} if point == POINTS[0] else {other: True}
    assert there(data) == expected
    assert all(row["done"] for row in rows(data / "frit.db", "removed"))
    made = rebuild(data, 3)
    assert made.problems == []
    assert there(data) == expected


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize("point", POINTS)
def test_an_index_that_is_lost_after_that(tmp_path: Path, point: str) -> None:
    """As long as the journal does not know, the job comes back whole: nobody was told that it is gone."""
    data = tmp_path / "data"
    job, other = asyncio.run(two_ended(data))
    killed_at(point, data, job)
    for path in data.glob("frit.db*"):
        path.unlink()
    assert rebuild(data, 3).problems == []
    assert there(data) == ({job: True, other: True} if point in POINTS[:2] else {other: True})
    rebuild(data, 3)
    assert there(data).keys() == ({job, other} if point in POINTS[:2] else {other})


def test_kills_at_any_moment_leave_whole_jobs_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRIT_MPIRUN", stand_in(tmp_path))
    data, dice = tmp_path / "data", random.Random(7)
    server, acknowledged, everybody = Process(data), set[str](), set[str]()
    for round_ in range(8):
        server.start()
        with httpx2.Client(base_url=server.url, timeout=60.0) as client:
            bodies = [{"case": case("sleep 0", 0.01 * (10 * round_ + k))} for k in range(4)]
            jobs = [client.post("/v1/jobs", json=body).json()["id"] for body in bodies]
            everybody.update(jobs)
            while not all(client.get(f"/v1/jobs/{job}").json()["final"] for job in jobs):
                time.sleep(0.02)

            def delete(job: str, client: httpx2.Client = client) -> None:
                with suppress(httpx2.TransportError):
                    if client.delete(f"/v1/jobs/{job}").status_code == 204:
                        acknowledged.add(job)

            threads = [threading.Thread(target=delete, args=(job,)) for job in jobs]
            for thread in threads:
                thread.start()
            time.sleep(dice.uniform(0.0, 0.3))
            server.end(signal.SIGKILL)
            for thread in threads:
                thread.join()
    server.start()
    server.end()
    left = there(data)
    assert all(left.values())
    assert left.keys() <= everybody - acknowledged
    assert acknowledged, "some kill came after an answer"
    assert rebuild(data, 3).problems == []
    assert there(data) == left


def test_nothing_that_is_gone_gives_its_numbers_away(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        jobs = [done(store.submit(new(k))) for k in range(2)]
        sweep = done(store.submit_sweep("s", "{}", points(5)))
        for job in store.jobs():
            attempted(store, job, Move.SUCCEED)
        [gone] = done(store.remove([jobs[1].id]))
        done(store.mourn([gone, *done(store.remove_sweep(sweep.id))]))
    (tmp_path / "frit.db").unlink()
    shutil.rmtree(tmp_path / "runs", ignore_errors=True)
    rebuild(tmp_path, 3)
    with opened(tmp_path) as store:
        assert done(store.submit(new(1))).id == f"{jobs[1].id}-2"
        assert {job.seq for job in store.jobs()} == {1, 4}
        assert done(store.submit_sweep("s", "{}", [])).id == "s2"
        assert store.usage("nobody") == (0, 0, 0.0, 0)


def test_what_somebody_elses_sweep_refers_to_stays(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        job = done(store.submit(new(1, owner="me")))
        attempted(store, job, Move.SUCCEED)
        done(store.submit_sweep("mine", "{}", points(1), owner="me"))
        sweep = done(store.submit_sweep("yours", "{}", points(1), owner="you"))
        with pytest.raises(InUseError, match=f"job {job.id}: sweep {sweep.id}, which is somebody else's"):
            done(store.remove([job.id]))
        assert store.job(job.id).state is State.SUCCEEDED
        done(store.remove_sweep(sweep.id))
        assert store.job(job.id).state is State.SUCCEEDED  # it was not made with that sweep
        done(store.remove([job.id]))
        assert store.jobs() == []
        assert store.sweep("mine").points == 0


def test_all_of_several_or_none(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        over, queued = (done(store.submit(new(k))) for k in range(2))
        attempted(store, over, Move.SUCCEED)
        with pytest.raises(ValueError, match="state = 'queued': delete is possible only from succeeded"):
            done(store.remove([over.id, queued.id]))
        assert len(store.jobs()) == 2
        assert store.unsettled() == []
        assert [line["kind"] for line in lines(store.journal.path)].count("gone") == 0
