"""A full disk, a read-only folder, a foreign lock, a clock that jumps: a clear state meanwhile, and nothing is lost."""

import asyncio
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from engines import finished, job, runs_of, settings, stand_in, submit, until
from indexing import is_whole
from launching import PAIR
from places import SUPPORT

from frit.service.index import writer as writer_module
from frit.service.index.records import StoreError
from frit.service.jobs.engine import Engine, EngineError
from frit.service.jobs.processes import try_lock
from frit.service.jobs.states import Job, State

ROOM = 2_000_000  # bytes that must be free for a job to be started
LIBRARIES = Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1")


def numbered(number: int) -> dict[str, object]:
    """A case of its own."""
    return {**PAIR, "model": {"A": 16.0 + number / 100}}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A small one."""
    path = tmp_path / "disk"
    path.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(path)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"needs the right to mount a tmpfs (root): {mounted.stderr.strip()}")
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


def fill(disk: Path) -> Path:
    """To the last byte."""
    filler = disk / "filler"
    with open(filler, "ab", buffering=0) as file:
        for size in (65536, 4096, 1):
            while True:
                try:
                    file.write(b"x" * size)
                except OSError:
                    break
    assert shutil.disk_usage(disk).free == 0
    return filler


async def submit_until_refused(engine: Engine) -> tuple[list[Job], str]:
    """What was accepted before the disk had no room at all, and the refusal."""
    accepted = []
    for number in range(100, 400):
        try:
            accepted.append(await submit(engine, job(numbered(number), "x" * 2000)))
        except StoreError as error:
            return accepted, str(error)
    raise AssertionError("300 jobs found room on a full disk")


def states_of(engine: Engine) -> set[State]:
    """All that the jobs have been through."""
    return {event.state for each in engine.store.jobs(limit=1000) for event in engine.store.events(each.id)}


def unlocked(path: Path) -> bool:
    """Whether its holder has gone."""
    lock = try_lock(path)
    if lock is not None:
        os.close(lock)
    return lock is not None


# --- disk -------------------------------------------------------------------------------------------------


def test_on_a_full_disk_nothing_is_lost_and_all_goes_on_once_there_is_room(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = stand_in(tmp_path / "bin")
    hold = script.with_name("hold")
    hold.touch()
    monkeypatch.setenv("FRIT_MPIRUN", str(script))

    async def serve() -> None:
        async with Engine(settings(disk, free_disk=ROOM)) as engine:
            made = [await submit(engine, job(numbered(k), f"job {k}")) for k in range(3)]
            await until(lambda: engine.store.count(State.RUNNING) == 2)
            filler = fill(disk)
            accepted, refusal = await submit_until_refused(engine)
            assert "full" in refusal or "No space left" in refusal
            assert len(engine.store.jobs(limit=1000)) == 3 + len(accepted)
            await until(lambda: f"{ROOM}" in (engine.trouble() or ""))
            hold.unlink()  # two runs end without room for their records
            await until(lambda: engine.store.count(State.RUNNING) < 2 or bool(engine.trouble()))
            assert engine.store.job(made[2].id).state is State.QUEUED
            assert states_of(engine) <= {State.QUEUED, State.STARTING, State.RUNNING, State.ERROR}
            filler.unlink()
            await until(lambda: finished(engine))
            assert {each.id for each in engine.store.jobs(limit=1000)} == {each.id for each in made + accepted}
            assert engine.store.count(State.SUCCEEDED) == 3 + len(accepted)
            assert states_of(engine).isdisjoint({State.LOST, State.FAILED})
            await until(lambda: engine.trouble() is None)

    asyncio.run(serve())
    assert is_whole(disk / "frit.db")


def test_a_solver_without_room_is_tried_again_from_its_checkpoint(disk: Path) -> None:
    output = {**PAIR.get("output", {}), "history_change": 0.0}
    case = {**PAIR, "time": {**PAIR["time"], "end": 0.2}, "output": output}

    async def serve() -> None:
        async with Engine(settings(disk, free_disk=ROOM)) as engine:
            made = await submit(engine, job(case, "pair"))
            directory = engine.run_directory(made.id)
            await until(lambda: len(engine.store.history(made.id)) > 3 and (directory / "checkpoint.h5").exists())
            filler = fill(disk)
            await until(lambda: unlocked(directory / "lock"))  # by the solver
            filler.unlink()
            await until(lambda: finished(engine))
            assert engine.store.attempts(made.id)[0].state == State.ERROR
            over = engine.store.job(made.id)
            assert over.state is State.SUCCEEDED, over.message
            assert states_of(engine).isdisjoint({State.LOST, State.FAILED})
            assert len(engine.store.history(made.id)) == 201

    asyncio.run(serve())


def test_a_read_only_data_folder_is_named(disk: Path) -> None:
    async def serve() -> None:
        async with Engine(settings(disk / "data")) as engine:
            await submit(engine, job({**PAIR}, "waits", ranks=3))

    asyncio.run(serve())
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    with pytest.raises(EngineError, match=rf"^data = {disk}/data: cannot be used: it is read-only$"):
        asyncio.run(serve())
    subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
    asyncio.run(serve())


# --- lock -------------------------------------------------------------------------------------------------

HOLDER = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None, timeout=60)
connection.execute("BEGIN " + sys.argv[2])
print("held", flush=True)
sys.stdin.readline()
"""


@contextmanager
def held_by_another(path: Path, how: str) -> Iterator[None]:
    """Another program has the database locked."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), how], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdin is not None
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        yield
        holder.stdin.close()


@pytest.mark.parametrize("how", ["IMMEDIATE", "EXCLUSIVE"])
def test_a_foreign_lock_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    script = stand_in(tmp_path / "bin")
    hold = script.with_name("hold")
    hold.touch()
    monkeypatch.setenv("FRIT_MPIRUN", str(script))
    monkeypatch.setattr(writer_module, "BUSY", 0.2)

    async def serve() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            made = await submit(engine, job(numbered(0), "runs"))
            await until(lambda: engine.store.count(State.RUNNING) == 1)
            with held_by_another(engine.store.path, how):
                with pytest.raises(StoreError, match="locked"):
                    await submit(engine, job(numbered(1), "refused"))
                hold.unlink()
                await until((engine.run_directory(made.id) / "exit.json").exists)
                await until(lambda: "locked" in (engine.trouble() or ""))
                assert engine.store.job(made.id).state is State.RUNNING  # not recorded yet, and readable
            await until(lambda: finished(engine))
            await until(lambda: engine.trouble() is None)
            after = await submit(engine, job(numbered(2), "after"))
            await until(lambda: finished(engine))
            assert [engine.store.job(each.id).state for each in (made, after)] == [State.SUCCEEDED] * 2
            assert len(engine.store.jobs()) == 2

    asyncio.run(serve())


# --- clock ------------------------------------------------------------------------------------------------


def test_a_clock_that_jumps_changes_nothing(tmp_path: Path) -> None:
    library = next(iter(LIBRARIES), None)
    if library is None:
        assert os.environ.get("FRIT_REQUIRE_ALL") != "1", "needs libfaketime: apt-get install faketime"
        pytest.skip("needs libfaketime: apt-get install faketime")
    (tmp_path / "clock").write_text("+0\n")
    fake = {
        "LD_PRELOAD": str(library), "FAKETIME_TIMESTAMP_FILE": str(tmp_path / "clock"), "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1", "NO_FAKE_STAT": "1", "FAKETIME_DISABLE_SHM": "1",
        "FRIT_MPIRUN": str(stand_in(tmp_path / "bin")), "PYTHONPATH": str(SUPPORT),
    }  # fmt: skip
    ended = subprocess.run(
        [sys.executable, __file__, str(tmp_path)], env=os.environ | fake, capture_output=True, text=True, check=False,
        timeout=240,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr + ended.stdout


def jump(folder: Path, to: str) -> None:
    """Set the clock; real programs see it at once."""
    before = time.time()
    beside = folder / "clock.new"
    beside.write_text(f"{to}\n")
    beside.replace(folder / "clock")
    assert abs(time.time() - before) > 80_000.0


async def under_a_jumping_clock(folder: Path) -> None:
    """Queue, time limits, pauses and adoption, while the clock goes a year ahead and to a day ago."""
    data, hold = folder / "data", folder / "bin" / "hold"
    hold.touch()
    async with Engine(settings(data, cores=1)) as engine:
        first = await submit(engine, job(numbered(0), "first", time_limit=100_000.0))
        made = [first, await submit(engine, job(numbered(1), "second"))]
        await until(lambda: runs_of(engine.run_directory(first.id)) == 1)
        jump(folder, "+365d")
        made.append(await submit(engine, job(numbered(2), "third")))
        jump(folder, "-1d")
        made.append(await submit(engine, job(numbered(3), "fourth")))
        await asyncio.sleep(0.3)
        assert engine.store.job(first.id).state is State.RUNNING  # its limit of a day is not over
    jump(folder, "+365d")
    async with Engine(settings(data, cores=1)) as engine:  # adopted, under another clock than it was started under
        await until(lambda: engine.store.job(first.id).state is State.RUNNING)
        jump(folder, "-1d")
        hold.unlink()
        await until(lambda: finished(engine))
        assert [engine.store.job(each.id).state for each in made] == [State.SUCCEEDED] * 4
        assert (folder / "bin" / "order.txt").read_text().split() == [each.id for each in made]
        hold.touch()
        limited = await submit(engine, job(numbered(4), "limited", time_limit=0.5))
        await until(lambda: runs_of(engine.run_directory(limited.id)) == 1)
        jump(folder, "+0")
        jump(folder, "-1d")
        await until(lambda: engine.store.job(limited.id).state is State.TIMED_OUT)
        hold.unlink()
        hold.with_name("break").touch()
        broken = await submit(engine, job(numbered(5), "broken"))
        await until(lambda: engine.store.job(broken.id).attempt == 1)
        jump(folder, "+365d")
        jump(folder, "-1d")
        await until(lambda: finished(engine))
        assert engine.store.job(broken.id).state is State.SUCCEEDED
        assert [event.state for event in engine.store.events(broken.id)].count(State.ERROR) == 1
        assert engine.trouble() is None


if __name__ == "__main__":
    asyncio.run(under_a_jumping_clock(Path(sys.argv[1])))
