"""`frit reindex`: a deleted or damaged index comes back as it was, and nothing is run again."""

import asyncio
import json
import os
from pathlib import Path
from typing import Any

import pytest
from engines import end_runner, finished, job, runs_of, settings, stand_in, submit, until
from indexing import LIMIT, attempted, claim, done, is_whole, lines, new, opened, points, rows, started
from launching import PAIR
from typer.testing import CliRunner

from frit.service.cli import main as cli
from frit.service.index.records import Key, NewPoint
from frit.service.index.reindex import rebuild
from frit.service.jobs.engine import Engine, EngineError, take
from frit.service.jobs.states import Move, NewJob, State
from frit.solver.durable import write_json

TABLES = ["sweeps", "jobs", "sweep_jobs", "attempts", "history", "snapshots", "events", "idempotency"]


def content(data: Path) -> dict[str, Any]:
    """Every row of every table but tokens, by number; JSON as what it means."""
    found = {table: [plain(row) for row in rows(data / "frit.db", table)] for table in TABLES}
    for table, number in (("history", "row"), ("snapshots", "number"), ("attempts", "number")):
        found[table].sort(key=lambda row: (row["job"], row[number]))
    return found


def plain(row: dict[str, Any]) -> dict[str, Any]:
    return {key: json.loads(value) if key in ("tags", "result", "cores", "parameters") else value
            for key, value in row.items()}  # fmt: skip


def lose(data: Path) -> None:
    for path in data.glob("frit.db*"):
        path.unlink()


# --- real runs --------------------------------------------------------------------------------------------


def pair(name: str, **time: Any) -> NewJob:
    case = {**PAIR, "time": {**PAIR["time"], **time}}
    return job(case, name, **({"ranks": 3, "priority": -3, "tags": ("x", "y")} if name == "unwanted" else {}))


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A data folder in which jobs and a sweep have run, and what its index held."""
    data = tmp_path_factory.mktemp("served")

    async def serve() -> None:
        async with Engine(settings(data)) as engine:
            first = await submit(engine, pair("first"))
            await submit(engine, pair("diverges", step=2.0, end=40.0))
            unwanted = await submit(engine, pair("unwanted", step=9e-5))
            steps = [NewPoint(pair(f"step {step}", step=step), {"time.step": step}) for step in (5e-5, 1e-4, 8e-5)]
            key = Key("s", "k", "f")
            await asyncio.wrap_future(engine.store.submit_sweep("steps", '{"name": "steps"}', steps, 1, key))
            await engine.cancel(unwanted.id)
            await until(lambda: finished(engine))
            assert engine.store.job(first.id).state is State.SUCCEEDED
            await submit(engine, job(PAIR, "too wide", ranks=3, priority=5))  # stays in the queue

    asyncio.run(serve())
    return data, content(data)


def test_the_runs_were_what_the_test_needs(served: tuple[Path, dict[str, Any]]) -> None:
    _, before = served
    assert [row["state"] for row in before["jobs"]] == [
        "succeeded", "failed", "cancelled", "succeeded", "succeeded", "queued"
    ]  # fmt: skip
    assert all(before.values())
    assert before["jobs"][0]["result"]["time"] == pytest.approx(0.01)


@pytest.mark.parametrize("how", ["deleted", "damaged"])
def test_a_lost_index_comes_back_as_it_was_and_nothing_runs_again(
    served: tuple[Path, dict[str, Any]], how: str
) -> None:
    data, before = served
    for old in data.glob("frit.db.aside*"):
        old.unlink()
    damaged = b"not a database any more" * 1000
    if how == "deleted":
        lose(data)
    else:
        (data / "frit.db").write_bytes(damaged)
        with pytest.raises(EngineError, match=f"not a database: .*: `frit reindex --data {data}`"):
            asyncio.run(opened_again(data))
    printed = CliRunner().invoke(cli.app, ["reindex", "--data", str(data)])
    assert printed.exit_code == 0, printed.output
    assert f"{data}/frit.db: 6 jobs, 1 sweeps" in printed.stdout
    assert "succeeded   3" in printed.stdout
    assert content(data) == before
    assert is_whole(data / "frit.db")
    aside = data / "frit.db.aside-1"
    assert (aside.read_bytes() == damaged) if how == "damaged" else not aside.exists()
    assert not (data / "reindex.new").exists()
    asyncio.run(opened_again(data))
    assert content(data) == before


async def opened_again(data: Path) -> None:
    """An engine for a while, which finds nothing to do."""
    async with Engine(settings(data)) as engine:
        for _ in range(5):
            await engine.notifier.wait(0.1)
            assert not engine.scheduler.running
        assert engine.trouble() is None


def test_without_the_journal_what_has_run_comes_back(served: tuple[Path, dict[str, Any]]) -> None:
    data, before = served
    journal, index = data / "submitted.jsonl", (data / "frit.db").read_bytes()
    kept = journal.read_bytes()
    try:
        journal.unlink()
        lose(data)
        made = rebuild(data, 5)
        assert made.states == {"succeeded": 3, "failed": 1}
        assert "submitted.jsonl: is not there" in made.problems[0]
        after = content(data)
        ran = [row for row in before["jobs"] if row["state"] in made.states]
        for row, old in zip(after["jobs"], ran, strict=True):
            assert row.pop("started") == pytest.approx(old["started"], abs=30.0)  # the claim's time is lost
            assert row == {key: value for key, value in old.items() if key != "started"}
        assert (after["history"], after["snapshots"]) == (before["history"], before["snapshots"])
        lose(data)  # the new journal is as good as the old one
        assert rebuild(data, 5).problems == []
        again = content(data)
        assert [row["state"] for row in again["jobs"]] == [row["state"] for row in after["jobs"]]
        assert again["attempts"] == after["attempts"]
    finally:
        journal.write_bytes(kept)
        lose(data)
        (data / "frit.db").write_bytes(index)


# --- every state ------------------------------------------------------------------------------------------


def every_state(data: Path) -> None:
    """An index with everything that can be said in it, and no run directory at all."""
    with opened(data) as store:
        made = [done(store.submit(new(k, priority=k % 3, tags=("t",), time_limit=9.5))) for k in range(12)]
        moves = [Move.SUCCEED, Move.FAIL, Move.STOP, Move.TIME_OUT, Move.RELEASE, Move.BREAK, Move.LOSE]
        for each, move in zip(made, moves, strict=False):
            attempted(store, each, move)
        for _ in range(LIMIT):  # broken for good
            done(store.requeue(made[7].id, attempted(store, store.job(made[7].id), Move.BREAK).attempt))
        done(store.cancel(made[8].id))
        done(store.retry(made[8].id, Key("s", "again", "f")))
        done(store.cancel(made[11].id))
        claim(store, made[9])
        started(store, made[10])
        done(store.cancel(made[10].id))
        done(store.submit_sweep("a", '{"x": 1}', points(2, 40, 2, 0, 41), 3))
        done(store.submit_sweep("a", '{"x": 2}', points(41, 42)))
        assert set(store.counts()) == set(State)


def test_every_state_comes_back_from_the_journal(tmp_path: Path) -> None:
    every_state(tmp_path)
    before = content(tmp_path)
    assert {row["state"] for row in before["jobs"]} == set(State)
    lose(tmp_path)
    made = rebuild(tmp_path, LIMIT)
    assert (made.problems, made.sweeps, made.aside) == ([], 2, None)
    assert content(tmp_path) == before


def test_numbers_go_on_where_they_were(tmp_path: Path) -> None:
    every_state(tmp_path)
    lose(tmp_path)
    rebuild(tmp_path, LIMIT)
    with opened(tmp_path) as store:
        assert done(store.submit(new(0))).id == f"{new(0).identity[:16]}-2"
        assert done(store.submit_sweep("b", "{}", [])).id == "s3"
        assert done(store.retry(new(8).identity[:16], Key("s", "again", "f"))).state is State.QUEUED
    before = content(tmp_path)
    lose(tmp_path)
    rebuild(tmp_path, LIMIT)
    assert content(tmp_path) == before


def test_lines_that_make_no_sense_are_told_and_passed_over(tmp_path: Path) -> None:
    every_state(tmp_path)
    before = content(tmp_path)
    journal = tmp_path / "submitted.jsonl"
    whole = journal.read_text()
    nonsense = ['{"kind": "job", "seq": 99}', "{", "\0\0\0", "7", '{"kind": "song"}', '{"kind": "set", "job": 77}']
    journal.write_text("".join(f"{line}\n" for line in nonsense) + whole + '{"kind": "job", "se')
    lose(tmp_path)
    made = rebuild(tmp_path, LIMIT)
    assert [f"line {k}" in problem for k, problem in enumerate(made.problems[:6], 1)] == [True] * 6
    assert len(made.problems) == 7
    assert content(tmp_path) == before
    with opened(tmp_path) as store:
        done(store.submit(new(77)))
    assert json.loads(journal.read_text().splitlines()[-1])["kind"] == "job"


def test_what_a_crash_let_only_the_journal_have_does_not_count(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        done(store.submit(new(1)))
    before, lost = (tmp_path / "frit.db").read_bytes(), new(2)
    with opened(tmp_path) as store:
        done(store.submit(lost))
    lose(tmp_path)
    (tmp_path / "frit.db").write_bytes(before)  # as after a kill between the journal and the commit
    with opened(tmp_path) as store:
        attempted(store, done(store.submit(new(3))), Move.SUCCEED)
    expected = content(tmp_path)
    assert [line["name"] for line in lines(tmp_path / "submitted.jsonl") if line["kind"] == "job"][1:] == [
        "job 2", "job 3"
    ]  # fmt: skip
    lose(tmp_path)
    rebuild(tmp_path, LIMIT)
    assert content(tmp_path) == expected


def test_an_end_that_nobody_has_read_is_taken_in(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        running = started(store, done(store.submit(new(1))))
    directory = tmp_path / "runs" / running.id
    directory.mkdir(parents=True)
    end = {"attempt": 1, "move": "fail", "message": "no", "ended": 5.0, "core_seconds": 2.0}
    write_json(directory / "exit.json", end)
    lose(tmp_path)
    assert rebuild(tmp_path, LIMIT).states == {"failed": 1}
    with opened(tmp_path) as store:
        over = store.job(running.id)
        assert (over.message, over.ended, over.core_seconds) == ("no", 5.0, 2.0)
    lose(tmp_path)
    (directory / "exit.json").unlink()
    assert rebuild(tmp_path, LIMIT).states == {"failed": 1}  # the journal has it now


# --- runners that live ------------------------------------------------------------------------------------


def test_a_runner_that_lives_is_adopted_and_one_that_was_killed_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, script = tmp_path / "data", stand_in(tmp_path / "bin")
    hold = script.with_name("hold")
    hold.touch()
    monkeypatch.setenv("FRIT_MPIRUN", str(script))

    async def leave() -> list[str]:
        async with Engine(settings(data)) as engine:
            made = [await submit(engine, job(PAIR, name)) for name in ("lives", "dies", "waits")]
            await until(lambda: all(runs_of(engine.run_directory(each.id)) for each in made[:2]))
            await until(lambda: engine.store.count(State.RUNNING) == 2)
            return [each.id for each in made]

    async def go_on() -> None:
        async with Engine(settings(data)) as engine:
            await until(lambda: engine.store.counts()["starting"] == 0)
            assert engine.store.job(lives).state is State.RUNNING
            hold.unlink()
            await until(lambda: finished(engine))

    lives, dies, waits = asyncio.run(leave())
    end_runner(data / "runs" / dies)
    lose(data)
    assert rebuild(data, 5).states == {"running": 2, "queued": 1}
    asyncio.run(go_on())
    with opened(data) as store:
        assert store.counts() | {"succeeded": 0} == dict.fromkeys(State, 0)
        assert [store.job(each).attempt for each in (lives, dies, waits)] == [1, 2, 1]
    assert [runs_of(data / "runs" / each) for each in (lives, dies, waits)] == [1, 2, 1]


def test_it_is_refused_while_a_service_holds_the_folder(tmp_path: Path) -> None:
    every_state(tmp_path)
    before = (tmp_path / "frit.db").read_bytes()
    lock = take(tmp_path)
    printed = CliRunner().invoke(cli.app, ["reindex", "--data", str(tmp_path)])
    os.close(lock)
    assert printed.exit_code == 2
    assert f"in use by process {os.getpid()}" in printed.output
    assert (tmp_path / "frit.db").read_bytes() == before
    assert not list(tmp_path.glob("frit.db.aside*"))


def test_the_old_index_is_kept_with_its_log_under_a_name_of_its_own(tmp_path: Path) -> None:
    every_state(tmp_path)
    asides = [rebuild(tmp_path, LIMIT).aside for _ in range(2)]
    assert asides == [tmp_path / "frit.db.aside-1", tmp_path / "frit.db.aside-2"]
    (tmp_path / "frit.db-wal").write_bytes(b"left by a crash")
    assert rebuild(tmp_path, LIMIT).problems == []
    assert (tmp_path / "frit.db.aside-3-wal").read_bytes() == b"left by a crash"
    assert is_whole(tmp_path / "frit.db")


def test_the_counts_as_json(tmp_path: Path) -> None:
    every_state(tmp_path)
    printed = CliRunner().invoke(cli.app, ["reindex", "--data", str(tmp_path), "--json"])
    told = json.loads(printed.stdout)
    assert (told["jobs"], told["sweeps"], told["problems"]) == (15, 2, [])
    assert told["aside"] == str(tmp_path / "frit.db.aside-1")
