"""The index: what is acknowledged is durable, counts once and harms nobody else, whoever asks and whatever breaks."""

import asyncio
import json
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from indexing import LIMIT, attempted, claim, done, ended, is_whole, lines, new, opened, points, started
from places import SUPPORT

from frit.service.index import writer as writer_module
from frit.service.index.records import Key, KeyReusedError, NewPoint, NotFoundError, StoreError
from frit.service.index.schema import jobs as table
from frit.service.index.store import Store
from frit.service.index.writer import Transaction
from frit.service.jobs.notifier import Notifier
from frit.service.jobs.states import Exit, Job, Move, State, TransitionError


@pytest.fixture(scope="session")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An index that was just made."""
    folder = tmp_path_factory.mktemp("empty")
    Store(folder).close()
    return folder / "frit.db"


@pytest.fixture
def store(tmp_path: Path, empty: Path) -> Iterator[Store]:
    """An index, which must be sound in the end."""
    shutil.copy(empty, tmp_path)
    with opened(tmp_path) as store:
        yield store
    assert is_whole(tmp_path / "frit.db")
    lines(tmp_path / "submitted.jsonl")


def held(store: Store) -> tuple[threading.Event, "Future[None]"]:
    """Keep the writer busy until the event: what is asked meanwhile shares one transaction."""
    go = threading.Event()
    begun = threading.Event()

    def wait(_: Transaction) -> None:
        begun.set()
        assert go.wait(60.0)

    answer = store.write(wait)
    assert begun.wait(60.0)
    return go, answer


# --- durability -------------------------------------------------------------------------------------------

KILLED = """
import os, signal, sys
from pathlib import Path
from indexing import done, new, opened, points

with opened(Path(sys.argv[1])) as store:
    job = done(store.submit(new(1, name="kept", priority=3, tags=("a", "b"))))
    done(store.submit_sweep("s", "{}", points(1, 2)))
    print(job.id, flush=True)
    for k in range(3, 10_000):  # killed somewhere in here, or by itself
        print(done(store.submit(new(k))).id, flush=True)
        if k == 40:
            os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_was_acknowledged_before_kill_9_is_there(tmp_path: Path) -> None:
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    killed = subprocess.run(command, cwd=SUPPORT, capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    told = killed.stdout.split()
    assert len(told) == 39
    noted = {line["id"] for line in lines(tmp_path / "submitted.jsonl") if line["kind"] == "job"}
    assert set(told) <= noted
    with opened(tmp_path) as store:
        kept = [store.job(identifier) for identifier in told]
        assert all(job.state is State.QUEUED for job in kept)
        assert (kept[0].name, kept[0].priority, kept[0].tags) == ("kept", 3, ("a", "b"))
        assert store.sweep("s").points == 2
    assert is_whole(tmp_path / "frit.db")


def test_the_writer_flushes_and_has_a_log(store: Store) -> None:
    def ask(t: Transaction) -> list[Any]:
        names = ("journal_mode", "synchronous", "foreign_keys", "mmap_size")
        return [t.connection.exec_driver_sql(f"PRAGMA {name}").scalar_one() for name in names]

    assert done(store.write(ask)) == ["wal", 2, 1, 0]


def test_readers_cannot_write(store: Store) -> None:
    with store.reading() as connection, pytest.raises(sa.exc.OperationalError, match="readonly"):
        connection.execute(table.update().values(name="x"))
    with store.reading() as connection, pytest.raises(sa.exc.OperationalError, match="readonly"):
        connection.exec_driver_sql("CREATE TABLE t (x)")


def test_a_reader_sees_one_moment(store: Store) -> None:
    count = sa.select(sa.func.count()).select_from(table)
    with store.reading() as connection:
        before = connection.execute(count).scalar_one()
        done(store.submit(new(1)))
        assert connection.execute(count).scalar_one() == before == 0
    assert store.count(State.QUEUED) == 1


def test_nothing_is_taken_once_it_is_closed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    go, _ = held(store)
    last = store.submit(new(1))
    closing_ = threading.Thread(target=store.close)
    closing_.start()
    while not store._closed:
        time.sleep(0.001)
    with pytest.raises(StoreError, match="closed"):
        store.submit(new(2))
    go.set()
    assert done(last).state is State.QUEUED  # what waited is finished
    closing_.join()
    store.close()  # twice is once


# --- many at once -----------------------------------------------------------------------------------------


def test_many_writers_share_transactions_and_each_gets_its_own_answer(store: Store) -> None:
    commits: list[None] = []
    store.listeners.append(lambda: commits.append(None))
    with ThreadPoolExecutor(16) as pool:
        made = list(pool.map(lambda k: done(store.submit(new(k))), range(400)))
    assert [job.name for job in made] == [f"job {k}" for k in range(400)]
    assert sorted(job.seq for job in made) == list(range(1, 401))
    assert len(commits) < 400
    assert {line["seq"] for line in lines(store.journal.path)} == set(range(1, 401))


BAD = {
    "an error of its own": (lambda t: 1 / 0, ZeroDivisionError),
    "a constraint": (lambda t: t.run(table.update().values(identity=None)), sa.exc.IntegrityError),
    "not JSON": (lambda t: t.run(table.update().values(case="{")), sa.exc.OperationalError),
    "nonsense": (lambda t: t.connection.exec_driver_sql("SELEC 1"), sa.exc.OperationalError),
    "no such thing": (lambda t: t.run(table.update().values(result={"x": float("nan")})), sa.exc.StatementError),
}


@pytest.mark.parametrize("which", BAD)
def test_a_bad_piece_of_work_harms_no_other(store: Store, which: str) -> None:
    bad, kind = BAD[which]
    done(store.submit(new(0)))
    go, _ = held(store)
    before, wrong, after = store.submit(new(1)), store.write(bad), store.submit(new(2))
    go.set()
    assert (done(before).seq, done(after).seq) == (2, 3)
    with pytest.raises(kind):
        done(wrong)
    assert store.job(new(0).identity[:16]) == done(store.write(lambda t: store.job(new(0).identity[:16])))


def test_what_a_bad_piece_of_work_did_is_undone_and_not_noted(store: Store) -> None:
    def half(t: Transaction) -> None:
        t.run(table.update().values(name="half"))
        t.note("job", seq=99)
        raise ValueError("no")

    done(store.submit(new(0)))
    go, _ = held(store)
    wrong, good = store.write(half), store.submit(new(1))
    go.set()
    done(good)
    with pytest.raises(ValueError, match=r"^no$"):
        done(wrong)
    assert store.job(new(0).identity[:16]).name == "job 0"
    assert [line["seq"] for line in lines(store.journal.path)] == [1, 2]


def test_who_does_not_wait_any_more_is_not_served_and_stops_nobody(store: Store) -> None:
    go, first = held(store)

    async def give_up() -> None:
        waiting = asyncio.ensure_future(asyncio.wrap_future(store.submit(new(1))))
        await asyncio.sleep(0)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting

    asyncio.run(give_up())
    last = store.submit(new(2))
    go.set()
    done(first)
    assert done(last).name == "job 2"
    assert [job.name for job in store.jobs()] == ["job 2"]


def test_a_listener_whose_loop_is_closed_stops_nobody(store: Store) -> None:
    async def make() -> Notifier:
        return Notifier()

    store.listeners.append(asyncio.run(make()).notify)
    assert done(store.submit(new(1))).seq == 1
    assert done(store.submit(new(2))).seq == 2


def test_claims_are_exclusive(store: Store) -> None:
    made = [done(answer) for answer in [store.submit(new(k)) for k in range(100)]]
    choices = [(job.seq, (0,)) for job in made]

    def grab(_: int) -> list[int]:
        return [job.seq for k in range(0, 100, 7) for job in done(store.claim(choices[k : k + 9]))]

    with ThreadPoolExecutor(8) as pool:
        got = list(pool.map(grab, range(8)))
    assert sorted(seq for some in got for seq in some) == [job.seq for job in made]
    assert all(len(store.attempts(job.id)) == 1 for job in made)


# --- trouble ----------------------------------------------------------------------------------------------


def test_where_the_journal_cannot_be_written_nothing_is_done(store: Store) -> None:
    first = done(store.submit(new(1)))
    before = store.journal.path.read_bytes()
    store.journal.path.unlink()
    store.journal.path.mkdir()
    with pytest.raises(StoreError, match="directory"):
        done(store.submit(new(2)))
    store.journal.path.rmdir()
    store.journal.path.write_bytes(before)
    assert [job.id for job in store.jobs()] == [first.id]
    assert done(store.submit(new(2))).seq == 2
    assert [line["seq"] for line in lines(store.journal.path)] == [1, 2]


def test_where_the_database_cannot_be_written_the_journal_is_as_before(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    done(store.submit(new(1)))
    before = store.journal.path.read_bytes()
    refused: list[None] = []

    @sa.event.listens_for(store._engine, "commit")
    def fail(_: object) -> None:
        if not refused:
            refused.append(None)
            raise sqlite3.OperationalError("disk I/O error")

    with pytest.raises(StoreError, match="disk I/O error"):
        done(store.submit(new(2)))
    assert store.journal.path.read_bytes() == before
    assert [job.seq for job in store.jobs()] == [1]
    assert done(store.submit(new(2))).seq == 2


def test_a_line_torn_by_a_crash_spoils_no_other(store: Store) -> None:
    done(store.submit(new(1)))
    with open(store.journal.path, "a") as file:
        file.write('{"kind": "job", "se')
    done(store.submit(new(2)))
    first, torn, second = store.journal.path.read_text().splitlines()
    assert (json.loads(first)["seq"], json.loads(second)["seq"]) == (1, 2)
    assert torn == '{"kind": "job", "se'
    store.journal.path.write_text(first + "\n" + second + "\n")


def test_a_foreign_lock_is_waited_for_and_then_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module, "BUSY", 0.2)
    with opened(tmp_path) as store:
        done(store.submit(new(1)))
        with closing(sqlite3.connect(store.path, isolation_level=None)) as foreign:
            foreign.execute("BEGIN IMMEDIATE")
            with pytest.raises(StoreError, match=r"frit\.db: database is locked"):
                done(store.submit(new(2)))
            assert [job.seq for job in store.jobs()] == [1]  # readers do not wait
            waiting = store.submit(new(3))
            foreign.execute("ROLLBACK")
            assert done(waiting).seq == 2
        assert len(lines(store.journal.path)) == 2


# --- the life of a job ------------------------------------------------------------------------------------


def test_a_job_is_as_it_was_submitted(store: Store) -> None:
    job = done(store.submit(new(5, ranks=2, priority=-1, tags=("x",), time_limit=60.0)))
    assert job == store.job(job.id) == store.job(job.id[:5])
    assert (job.ranks, job.priority, job.tags, job.time_limit) == (2, -1, ("x",), 60.0)
    assert (job.id, job.state, job.attempt, job.final) == (new(5).identity[:16], State.QUEUED, 0, False)
    assert json.loads(job.case) == {"particles": {"mean_radius": 5.0}}


def test_the_same_case_again_is_another_job_with_a_number(store: Store) -> None:
    ids = [done(store.submit(new(5))).id for _ in range(3)]
    assert ids == [ids[0], f"{ids[0]}-2", f"{ids[0]}-3"]
    with pytest.raises(NotFoundError, match="several"):
        store.job(ids[0][:8])


def test_start_and_finish_told_twice_count_once(store: Store) -> None:
    job = claim(store, done(store.submit(new(1))))
    for _ in range(2):
        running = done(store.start(job.id, 1, {"pid": 11}))
    assert running.state is State.RUNNING
    for _ in range(2):
        over = ended(store, job, Move.SUCCEED)
    assert (over.state, over.core_seconds, over.ended) == (State.SUCCEEDED, 10.0, 2000.0)
    assert ended(store, job, Move.BREAK).state is State.SUCCEEDED
    assert [event.state for event in store.events(job.id)] == ["queued", "starting", "running", "succeeded"]
    (attempt,) = store.attempts(job.id)
    assert (attempt.handle, attempt.cores) == ({"pid": 11}, (0,))
    assert (attempt.state, attempt.ended, attempt.core_seconds) == ("succeeded", 2000.0, 10.0)


def test_word_of_another_attempt_is_ignored(store: Store) -> None:
    job = claim(store, done(store.submit(new(1))))
    for attempt in (0, 2):
        assert done(store.start(job.id, attempt, {"pid": 1})).state is State.STARTING
        assert done(store.finish(job.id, Exit(attempt, Move.SUCCEED, None, 1.0), LIMIT)).state is State.STARTING
    assert not done(store.requeue(job.id, 0)).retrying


@pytest.mark.parametrize("move", [Move.BREAK, Move.LOSE])
def test_broken_attempts_are_followed_by_others_until_there_are_too_many(store: Store, move: Move) -> None:
    job = done(store.submit(new(1)))
    for k in range(1, LIMIT + 1):
        job = attempted(store, job, move)
        assert (job.failures, job.retrying, job.attempt) == (k, k < LIMIT, k)
        assert done(store.requeue(job.id, job.attempt - 1)) == job  # another attempt's pause
        job = done(store.requeue(job.id, job.attempt))
    assert job.state in (State.ERROR, State.LOST)
    assert job.final
    again = done(store.retry(job.id))
    assert (again.state, again.failures, again.retrying, again.ended) == (State.QUEUED, 0, False, None)
    assert attempted(store, again, move).retrying


def test_a_release_counts_as_no_failure_and_forgives(store: Store) -> None:
    job = attempted(store, done(store.submit(new(1))), Move.BREAK)
    job = attempted(store, done(store.requeue(job.id, 1)), Move.RELEASE)
    assert (job.state, job.failures, job.ended, job.core_seconds) == (State.QUEUED, 0, None, 20.0)


@pytest.mark.parametrize("move", [Move.BREAK, Move.LOSE, Move.RELEASE, Move.STOP])
@pytest.mark.parametrize("running", [False, True])
def test_an_unwanted_job_is_cancelled_however_its_attempt_ends(store: Store, move: Move, running: bool) -> None:
    job = (started if running else claim)(store, done(store.submit(new(1))))
    marked = done(store.cancel(job.id))
    assert (marked.state, marked.stopping) == (job.state, True)
    over = ended(store, job, move)
    assert (over.state, over.stopping, over.retrying, over.failures) == (State.CANCELLED, False, False, 0)
    assert done(store.cancel(job.id)) == over


@pytest.mark.parametrize(
    ("move", "state"),
    [(Move.SUCCEED, "succeeded"), (Move.FAIL, "failed"), (Move.TIME_OUT, "timed_out")],
)
def test_an_end_that_came_first_stands(store: Store, move: Move, state: str) -> None:
    job = started(store, done(store.submit(new(1))))
    done(store.cancel(job.id))
    over = ended(store, job, move)
    assert (over.state, over.stopping) == (state, False)


def test_cancel_without_cores_is_at_once(store: Store) -> None:
    queued = done(store.submit(new(1)))
    over = done(store.cancel(queued.id))
    assert (over.state, over.stopping) == (State.CANCELLED, False)
    assert over.ended is not None
    waiting = attempted(store, done(store.submit(new(2))), Move.BREAK)
    over = done(store.cancel(waiting.id))
    assert (over.state, over.retrying) == (State.CANCELLED, False)
    assert done(store.requeue(waiting.id, 1)).state is State.CANCELLED  # its pause is over too late


@pytest.mark.parametrize("move", [Move.SUCCEED, Move.FAIL, Move.TIME_OUT])
def test_what_is_over_is_not_cancelled(store: Store, move: Move) -> None:
    job = attempted(store, done(store.submit(new(1))), move)
    with pytest.raises(TransitionError, match=rf"state = '{job.state.value}': cancel is possible only from"):
        done(store.cancel(job.id))


def test_what_broke_for_good_is_not_cancelled(store: Store) -> None:
    job = done(store.submit(new(1)))
    for _ in range(LIMIT):
        job = done(store.requeue(job.id, attempted(store, job, Move.BREAK).attempt))
    with pytest.raises(TransitionError):
        done(store.cancel(job.id))


@pytest.mark.parametrize("state", ["queued", "starting", "running", "succeeded"])
def test_what_goes_on_or_went_well_is_not_retried(store: Store, state: str) -> None:
    job = done(store.submit(new(1)))
    if state == "starting":
        claim(store, job)
    elif state != "queued":
        started(store, job)
    if state == "succeeded":
        ended(store, store.job(job.id), Move.SUCCEED)
    with pytest.raises(TransitionError, match="retry is possible only from"):
        done(store.retry(job.id))


def test_no_such_job(store: Store) -> None:
    for ask in (store.cancel, store.retry, lambda i: store.requeue(i, 1), lambda i: store.start(i, 1, {})):
        with pytest.raises(NotFoundError, match="'nobody'"):
            done(ask("nobody"))
    for look in (store.job, store.attempts, store.events, store.history, store.snapshots, store.sweep):
        with pytest.raises(NotFoundError):
            look("nobody")


# --- the queue and looks ----------------------------------------------------------------------------------


def test_the_queue_is_by_priority_then_age(store: Store) -> None:
    for k, priority in enumerate([0, 5, 0, -1, 5]):
        done(store.submit(new(k, priority=priority, ranks=k + 1)))
    assert [job.seq for job in store.queued(10)] == [2, 5, 1, 3, 4]
    assert [job.ranks for job in store.queued(2)] == [2, 5]
    claim(store, store.job(new(1).identity[:16]))
    assert [job.seq for job in store.queued(1)] == [5]


def test_the_queue_is_read_from_its_index(store: Store) -> None:
    query = "SELECT seq, ranks FROM jobs WHERE state = 'queued' ORDER BY priority DESC, seq LIMIT 9"
    with store.reading() as connection:
        plan = " ".join(str(row) for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {query}"))
    assert "ix_jobs_queue" in plan
    assert "TEMP B-TREE" not in plan


def test_what_an_earlier_service_left(store: Store) -> None:
    _, up, busy, pausing, over = (done(store.submit(new(k))) for k in range(5))
    claim(store, up)
    started(store, busy)
    attempted(store, pausing, Move.LOSE)
    attempted(store, over, Move.FAIL)
    active, waiting = store.unfinished()
    assert {(job.id, attempt.number, (attempt.handle or {}).get("pid")) for job, attempt in active} == {
        (up.id, 1, None), (busy.id, 1, 4711)
    }  # fmt: skip
    assert [job.id for job in waiting] == [pausing.id]
    present = (State.QUEUED, State.STARTING, State.RUNNING, State.LOST, State.FAILED)
    assert store.counts() == {state: int(state in present) for state in State}
    assert store.count(State.QUEUED, State.LOST) == 2


def test_pages_hold_every_job_once(store: Store) -> None:
    made = [done(answer).seq for answer in [store.submit(new(k)) for k in range(23)]]
    found: list[Job] = []
    while page := store.jobs(None if not found else table.c.seq < found[-1].seq, limit=5):
        done(store.submit(new(100 + len(found))))  # what comes meanwhile does not move the pages
        found += page
    assert [job.seq for job in found] == made[::-1]


def test_a_page_comes_with_the_values_it_is_ordered_by(store: Store) -> None:
    for k in (3, 1, 2):
        done(store.submit(new(k)))
    radius = sa.func.json_extract(table.c.case, "$.particles.mean_radius")
    page = store.page(sa.true(), [radius.desc()], 2, radius)
    assert [(job.name, value) for job, value in page] == [("job 3", 3.0), ("job 2", 2.0)]


def test_events_are_told_from_a_number_on(store: Store) -> None:
    job = attempted(store, done(store.submit(new(1))), Move.FAIL)
    every = store.events(job.id)
    assert [event.state for event in every] == ["queued", "starting", "running", "failed"]
    assert store.events(job.id, since=every[1].seq) == every[2:]


def test_history_written_again_replaces_what_was_there(store: Store) -> None:
    job = done(store.submit(new(1)))
    row = '{"time": %s, "vacancy_ratio": 0.5, "by": "%s"}'
    done(store.ingest(job.seq, [(k, row % (k, "first")) for k in range(6)], [(0, 0.0), (1, 2.5)]))
    done(store.ingest(job.seq, [(k, row % (k, "second")) for k in range(3)], [(1, 2.5)]))
    done(store.ingest(job.seq, [(3, row % (3, "second"))], []))
    kept = [json.loads(line) for _, line in store.history(job.id)]
    assert [(row["time"], row["by"]) for row in kept] == [(k, "second") for k in range(4)]
    assert [number for number, _ in store.history(job.id, since=1, limit=2)] == [1, 2]
    assert store.snapshots(job.id) == [(0, 0.0), (1, 2.5)]


# --- keys -------------------------------------------------------------------------------------------------


def test_a_key_makes_one_job_and_tells_another_request(store: Store) -> None:
    key = Key("me POST /jobs", "k", "f")
    job = done(store.submit(new(1), key))
    assert done(store.submit(new(1), key)).id == job.id
    assert done(store.submit(new(1), Key("you POST /jobs", "k", "g"))).id == f"{job.id}-2"
    with pytest.raises(KeyReusedError, match="'k'"):
        done(store.submit(new(2), Key("me POST /jobs", "k", "other")))
    assert len(store.jobs()) == 2


def test_a_key_at_the_same_moment_makes_one_job(store: Store) -> None:
    with ThreadPoolExecutor(16) as pool:
        got = list(pool.map(lambda _: done(store.submit(new(1), Key("s", "k", "f"))).id, range(64)))
    assert len(set(got)) == len(store.jobs()) == 1


def test_a_key_makes_one_sweep(store: Store) -> None:
    key = Key("s", "k", "f")
    first = done(store.submit_sweep("a", "{}", points(1, 2), key=key))
    assert done(store.submit_sweep("a", "{}", points(1, 2), key=key)) == first
    assert [sweep.id for sweep in store.sweeps()] == ["s1"]


def test_a_key_cancels_and_retries_once(store: Store) -> None:
    job = done(store.submit(new(1)))
    done(store.cancel(job.id, Key("s", "c", "f")))
    done(store.retry(job.id, Key("s", "r", "f")))
    assert done(store.cancel(job.id, Key("s", "c", "f"))).state is State.QUEUED
    assert done(store.retry(job.id, Key("s", "r", "f"))).state is State.QUEUED


# --- sweeps -----------------------------------------------------------------------------------------------


def test_a_sweep_queues_its_points_in_order(store: Store) -> None:
    sweep = done(store.submit_sweep("a", '{"x": 1}', points(3, 1, 2), duplicates=4))
    assert (sweep.id, sweep.name, sweep.definition, sweep.duplicates) == ("s1", "a", '{"x": 1}', 4)
    assert (sweep.points, sweep.states) == (3, {"queued": 3})
    found = store.sweep_points("s1")
    assert [(p.position, p.name, p.parameters["particles.mean_radius"]) for p in found] == [
        (0, "job 3", 3.0), (1, "job 1", 1.0), (2, "job 2", 2.0)
    ]  # fmt: skip
    assert [point.job.seq for point in found] == [1, 2, 3]
    assert store.sweep("a") == store.sweep("s1") == sweep


def test_an_extended_sweep_runs_only_what_is_missing(store: Store) -> None:
    done(store.submit_sweep("a", "{}", points(1, 2)))
    states = {1: Move.SUCCEED, 2: Move.FAIL}
    for number, move in states.items():
        attempted(store, store.job(new(number).identity[:16]), move)
    done(store.submit(new(3)))
    sweep = done(store.submit_sweep("a", "{}", points(3, 2, 1, 4)))
    assert sweep.states == {"succeeded": 1, "failed": 1, "queued": 2}
    assert [point.job.name for point in store.sweep_points(sweep.id)] == ["job 3", "job 2", "job 1", "job 4"]
    assert len(store.jobs()) == 4
    assert store.sweep("s1").points == 2
    assert store.sweep("a").id == "s2"  # the newest of that name


@pytest.mark.parametrize("move", [Move.STOP, Move.TIME_OUT, Move.BREAK, Move.LOSE])
def test_a_sweep_submitted_again_tries_again_what_did_not_get_done(store: Store, move: Move) -> None:
    done(store.submit_sweep("a", "{}", points(1)))
    job = store.job(new(1).identity[:16])
    for _ in range(LIMIT):
        job = attempted(store, job, move)
        job = done(store.requeue(job.id, job.attempt))
        if job.final:
            break
    again = done(store.submit_sweep("a", "{}", points(1)))
    assert again.states == {"queued": 1}
    assert (store.job(job.id).failures, len(store.jobs())) == (0, 1)


def test_a_sweep_leaves_alone_what_is_under_way(store: Store) -> None:
    done(store.submit_sweep("a", "{}", points(1, 2)))
    running = started(store, store.job(new(1).identity[:16]))
    pausing = attempted(store, store.job(new(2).identity[:16]), Move.BREAK)
    done(store.submit_sweep("a", "{}", points(1, 2)))
    assert store.job(running.id) == running
    assert store.job(pausing.id) == pausing


@pytest.mark.parametrize("move", [None, Move.TIME_OUT, Move.STOP])
def test_a_job_that_a_sweep_shares_gets_the_time_and_priority_of_the_sweep(store: Store, move: Move | None) -> None:
    job = done(store.submit(new(1, time_limit=1e-3, priority=-5)))
    if move is not None:
        attempted(store, job, move)
    sweep = done(store.submit_sweep("a", "{}", points(1)))
    assert sweep.states == {"queued": 1}
    (shared,) = store.jobs()
    assert (shared.id, shared.time_limit, shared.priority) == (job.id, None, 0)
    done(store.submit_sweep("a", "{}", [NewPoint(new(1, time_limit=9.0, priority=-9), {})]))
    assert store.job(job.id) == shared  # nothing is taken away from whoever asked for more


@pytest.mark.parametrize(("ranks", "state"), [(1, "failed"), (2, "queued")])
def test_a_job_that_failed_on_few_ranks_is_tried_on_more(store: Store, ranks: int, state: str) -> None:
    job = attempted(store, done(store.submit(new(1))), Move.FAIL)
    done(store.submit_sweep("a", "{}", [NewPoint(new(1, ranks=ranks), {})]))
    assert (store.job(job.id).state, store.job(job.id).ranks) == (state, ranks)


def test_a_case_that_succeeded_once_is_not_computed_again(store: Store) -> None:
    first = attempted(store, done(store.submit(new(1))), Move.SUCCEED)
    second = done(store.submit(new(1)))
    done(store.cancel(second.id))
    done(store.submit_sweep("a", "{}", points(1)))
    (point,) = store.sweep_points("a")
    assert point.job.id == first.id
    assert store.job(second.id).state is State.CANCELLED
    assert store.identities([new(1).identity, new(2).identity]) == {new(1).identity: first}


def test_a_case_that_is_on_its_way_is_not_begun_a_second_time(store: Store) -> None:
    """Although a newer job of it was cancelled, which a sweep would try again if there were no other."""
    first, second = done(store.submit(new(1))), done(store.submit(new(1)))
    done(store.cancel(second.id))
    done(store.submit_sweep("a", "{}", points(1)))
    (point,) = store.sweep_points("a")
    assert point.job.id == first.id
    assert store.job(second.id).state is State.CANCELLED


def test_points_of_the_same_case_share_a_job(store: Store) -> None:
    sweep = done(store.submit_sweep("a", "{}", points(1, 2, 1)))
    assert [point.job.seq for point in store.sweep_points(sweep.id)] == [1, 2, 1]
    assert len(store.jobs()) == 2


def test_a_page_moves_no_lists_of_particles(store: Store) -> None:
    """Five hundred cases of megabytes each would be in memory at once."""
    particles = {"centres": [[1.0, 2.0]] * 9, "radii": [1.0] * 9, "sizes": [], "shape": "ball"}
    case = json.dumps({"name": "e\u00e9", "particles": particles, "time": {"end": 1e-7, "step": None}})
    whole = done(store.submit(new(1, case=case)))
    ((job, _),) = store.page(sa.true(), [table.c.seq], 2)
    assert json.loads(job.case) == json.loads(case) | {"particles": {"shape": "ball"}}
    assert store.job(whole.id).case == case


def test_sweeps_come_newest_first_in_pages(store: Store) -> None:
    for k in range(5):
        done(store.submit_sweep(f"n{k}", "{}", []))
    first = store.sweeps(limit=2)
    assert [sweep.id for sweep in first] == ["s5", "s4"]
    assert [sweep.id for sweep in store.sweeps(before=first[-1].seq)] == ["s3", "s2", "s1"]


def test_a_large_sweep_is_one_piece_of_work(store: Store) -> None:
    sweep = done(store.submit_sweep("a", "{}", points(*range(1500))))
    assert sweep.states == {"queued": 1500}
    assert done(store.submit_sweep("a", "{}", points(*range(1501)))).states == {"queued": 1501}
    assert len(store.jobs(limit=2000)) == 1501
    assert len(store.identities([new(k).identity for k in range(1501)])) == 1501
