"""Small jobs for an index, and looks into its files past the store."""

import json
import sqlite3
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from alembic.config import Config

from frit.service.index import migrations
from frit.service.index.records import NewPoint
from frit.service.index.store import Store
from frit.service.jobs.states import Exit, Job, Move, NewJob

T = TypeVar("T")
LIMIT = 3  # attempts in a row


def done(answer: "Future[T]") -> T:
    """What a write gave, once it is durable."""
    return answer.result(60.0)


def new(number: int, **changes: Any) -> NewJob:
    """A job whose identity is its number."""
    case = json.dumps({"particles": {"mean_radius": float(number)}})
    return NewJob(**{"case": case, "identity": f"{number:08x}" * 8, "name": f"job {number}", **changes})


def points(*numbers: int) -> list[NewPoint]:
    """Points of a sweep."""
    return [NewPoint(new(number), {"particles.mean_radius": float(number)}) for number in numbers]


@contextmanager
def opened(folder: Path) -> Iterator[Store]:
    """A store, closed in the end."""
    store = Store(folder)
    try:
        yield store
    finally:
        store.close()


def claim(store: Store, job: Job) -> Job:
    """Give a queued job core 0."""
    (claimed,) = done(store.claim([(job.seq, (0,))]))
    return claimed


def started(store: Store, job: Job) -> Job:
    """Give a queued job a core and a runner."""
    claimed = claim(store, job)
    return done(store.start(claimed.id, claimed.attempt, {"pid": 4711}))


def ended(store: Store, job: Job, move: Move, message: str | None = None) -> Job:
    """The present attempt ends."""
    return done(store.finish(job.id, Exit(job.attempt, move, message, 2000.0, 10.0), LIMIT))


def attempted(store: Store, job: Job, move: Move) -> Job:
    """A whole attempt."""
    return ended(store, started(store, job), move)


def rows(path: Path, table: str) -> list[dict[str, Any]]:
    """All rows of a table of a database file, read by plain sqlite3."""
    with closing(sqlite3.connect(path)) as connection:
        connection.row_factory = sqlite3.Row
        return [dict(row) for row in connection.execute(f"SELECT * FROM {table}")]


def is_whole(path: Path) -> bool:
    """What SQLite itself says of its file."""
    with closing(sqlite3.connect(path)) as connection:
        sound = connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        return sound and connection.execute("PRAGMA foreign_key_check").fetchall() == []


def lines(path: Path) -> list[dict[str, Any]]:
    """Of the journal; every one must be whole."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def use(folder: Path) -> None:
    """Let frit take its migrations from a folder."""
    plain = migrations.configuration

    def configuration(path: Path) -> Config:
        config = plain(path)
        config.set_main_option("script_location", str(folder))
        return config

    migrations.configuration = configuration
