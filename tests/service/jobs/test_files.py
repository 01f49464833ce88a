"""Small files that many write at once, and what is left of one whose writer was killed."""

import asyncio
import json
import os
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from serving import ended, new_job, settings, submit, until

from frit.service.index import tokens
from frit.service.jobs.engine import Engine, take
from frit.service.jobs.processes import is_at, remove_torn
from frit.service.jobs.states import State
from frit.solver.durable import read_json, write_json


def test_many_threads_write_one_file(tmp_path: Path) -> None:
    """Each by a name of its own beside it; one of them stands."""
    path = tmp_path / "request.json"

    def write(number: int) -> None:
        for _ in range(50):
            write_json(path, {"number": number, "filler": "x" * 10_000}, durable=False)
            assert len(json.loads(path.read_bytes())["filler"]) == 10_000

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(8)))
    assert read_json(path)["number"] in range(8)
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_data_folder_is_its_owners_alone(tmp_path: Path) -> None:
    """Cases, results and locks of members are for who has a token, not for everybody on the machine."""
    os.close(take(tmp_path / "a" / "served"))
    tokens.create(tmp_path / "b" / "tokens", "me", "read")
    for folder in (tmp_path / "a" / "served", tmp_path / "b" / "tokens"):
        assert folder.stat().st_mode & 0o777 == 0o700
    opened = tmp_path / "opened"
    opened.mkdir()
    opened.chmod(0o750)
    os.close(take(opened))
    assert opened.stat().st_mode & 0o777 == 0o750  # whoever made it so has reasons


def test_what_a_killed_writer_left_is_removed(tmp_path: Path) -> None:
    """Not what a process that lives is writing, nor a file of another kind."""
    with subprocess.Popen(["true"]) as process:
        process.wait()
    left = tmp_path / f"exit.json.{process.pid}.3.new"
    others = [tmp_path / f"request.json.{os.getpid()}.3.new", tmp_path / "checkpoint.h5.new", tmp_path / "a.b.c.new"]
    for path in (left, *others):
        path.touch()
    remove_torn(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(others)


def test_an_open_file_knows_whether_it_has_its_name_still(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "lock"
    path.parent.mkdir()
    path.touch()
    with open(path) as file:
        assert is_at(file.fileno(), path)
        path.parent.rename(tmp_path / "elsewhere")
        assert not is_at(file.fileno(), path)
        path.parent.symlink_to(tmp_path / "elsewhere")  # it was moved to another disk, say
        assert is_at(file.fileno(), path)
        path.parent.unlink()
        path.parent.mkdir()
        path.touch()
        assert not is_at(file.fileno(), path)
        path.unlink()
        path.parent.rmdir()
        path.parent.touch()
        assert not is_at(file.fileno(), path)


@pytest.mark.usefixtures("standing_in")
def test_many_cancel_one_job_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            (job,) = await submit(engine, new_job("sleep 100"))
            await until(engine, lambda: (engine.run_directory(job.id) / "calls").exists())
            await asyncio.gather(*(engine.cancel(job.id) for _ in range(32)))
            (job,) = await ended(engine, job)
            assert job.state is State.CANCELLED
            assert list(engine.run_directory(job.id).glob("*.new")) == []

    asyncio.run(main())
    assert caplog.messages == []
