"""A wish to stop where there is nothing to keep yet, and ranks that take more memory than they may."""

import asyncio
import json
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from serving import ended, in_state, new_job, settings, submit, until
from soak import of_data

from frit.service.jobs.engine import Engine
from frit.service.jobs.memory import LEAST, limits_of, memory_below, memory_per_core
from frit.service.jobs.runner import NOTHING_TO_KEEP
from frit.service.jobs.states import Job, NewJob, State
from frit.solver.case import parse_case

GRACE = 1000.0  # seconds: who waits for one of these hangs


def with_many_nodes(source: str, spacing: float, **asked: Any) -> NewJob:
    """More than are made in a moment."""
    tree = {
        "name": source,
        "domain": {"size": [400.0, 400.0]},
        "nodes": {"source": source, "spacing": spacing},
        "particles": {"centres": [[200.0, 200.0]], "radii": [20.0]},
        "time": {"end": 1.0},
    }
    case = parse_case(tree)
    return NewJob(json.dumps(json.loads(case.resolved_json())), case.identity(), source, **asked)


async def meshing(engine: Engine, job: Job) -> None:
    """Wait until the solver has read its case, and has begun with the mesh."""
    await until(engine, lambda: (engine.run_directory(job.id) / "case.json").exists())
    await until(engine, lambda: any("gmsh" in m.path for p in of_data(engine.settings.data) for m in maps(p)))


def maps(process: psutil.Process) -> list[Any]:
    try:
        return list(process.memory_maps())
    except psutil.Error:
        return []


@pytest.mark.parametrize("hears", [True, False])
@pytest.mark.parametrize("wish", ["cancelled", "timed_out", "released"])
def test_a_job_that_makes_its_mesh_is_not_waited_for(tmp_path: Path, wish: str, hears: bool) -> None:
    """Neither for its first checkpoint nor, where it hears nothing, for its end."""
    states = {"cancelled": State.CANCELLED, "timed_out": State.TIMED_OUT, "released": State.QUEUED}

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", grace=GRACE)) as engine:
            limit = 4.0 if wish == "timed_out" else None
            (job,) = await submit(engine, with_many_nodes("gmsh", 0.5, time_limit=limit))
            await meshing(engine, job)
            for process in () if hears else of_data(tmp_path / "data"):
                if "frit.solver" in process.cmdline()[:5]:
                    process.suspend()
            if wish == "cancelled":
                await engine.cancel(job.id)
            if wish == "released":
                await engine.scheduler.release()
            await in_state(engine, job, states[wish])
            job = engine.store.job(job.id)
            assert (job.attempt, job.failures, job.retrying) == (1, 0, False)
            assert not (engine.run_directory(job.id) / "checkpoint.h5").exists()
            assert not of_data(tmp_path / "data")

    asyncio.run(main())


@pytest.mark.usefixtures("standing_in")
@pytest.mark.parametrize(("name", "waits"), [("deaf 1000", False), ("marching 8", True)])
def test_only_ranks_that_step_get_their_grace(tmp_path: Path, name: str, waits: bool) -> None:
    """What steps and does not answer may yet write a checkpoint: it is left to itself, and is done in the end."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", grace=GRACE)) as engine:
            (job,) = await submit(engine, new_job(name))
            seen = "progress.json" if waits else "calls"
            await until(engine, lambda: (engine.run_directory(job.id) / seen).exists())
            began = time.monotonic()
            await engine.cancel(job.id)
            (job,) = await ended(engine, job)
            assert job.state is (State.SUCCEEDED if waits else State.CANCELLED)
            assert time.monotonic() - began > NOTHING_TO_KEEP

    asyncio.run(main())


# --- memory -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ranks", [1, 2])
def test_ranks_that_take_more_memory_than_they_may_have_failed(tmp_path: Path, ranks: int) -> None:
    """All ranks of a job together; it is not tried again, and says how much it took of how much."""

    async def main() -> None:
        async with Engine(settings(tmp_path / "data", memory_limit=400_000_000)) as engine:
            (job,) = await ended(engine, *await submit(engine, with_many_nodes("lattice", 0.2, ranks=ranks)))
            assert (job.state, job.attempt) == (State.FAILED, 1), job.message
            words = (job.message or "").split()
            assert " ".join(words[:3]) == "its ranks took"
            assert 0.4 * ranks < float(words[3]) < 20.0
            allowed = f"more than the {0.4 * ranks:.2f} GB that {ranks} may (FRIT_MEMORY_LIMIT for each)"
            assert " ".join(words[3:]).endswith(allowed)
            assert not of_data(tmp_path / "data")

    asyncio.run(main())


def test_memory_that_is_shared_counts_once() -> None:
    """If that decides. This process has no child at first."""
    assert memory_below(psutil.Process().pid, 0) == 0
    parent = psutil.Popen([sys.executable, "-c", SHARING])
    try:
        while len(parent.children()) < 3 or memory_below(parent.pid, 10**12) < 600_000_000:
            time.sleep(0.01)
            assert parent.poll() is None
        assert 50_000_000 < memory_below(parent.pid, 0) < 300_000_000
    finally:
        for child in parent.children():
            child.kill()
        parent.kill()
        parent.wait()


SHARING = """
import mmap, os, time
memory = mmap.mmap(-1, 200_000_000)
memory.write(b"x" * 200_000_000)
for _ in range(3):
    if os.fork() == 0:
        sum(memory[k] for k in range(0, 200_000_000, 4096))
        time.sleep(1000)
time.sleep(1000)
"""


def test_a_container_has_what_its_group_and_those_above_may_take(tmp_path: Path) -> None:
    """Version 2, and version 1, whose answer for no limit is a large number."""
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "memory" / "c").mkdir(parents=True)
    (tmp_path / "a" / "memory.max").write_text("3000\n")
    (tmp_path / "a" / "b" / "memory.max").write_text("max\n")
    (tmp_path / "memory" / "c" / "memory.limit_in_bytes").write_text("4000\n")
    groups = tmp_path / "cgroup"
    groups.write_text("5:pids:/\n4:memory:/c\n0::/a/b\n")
    assert sorted(limits_of(groups, tmp_path)) == [3000, 4000]
    assert limits_of(tmp_path / "none", tmp_path) == []
    assert LEAST <= memory_per_core() <= max(LEAST, psutil.virtual_memory().total)
