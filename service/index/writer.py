"""The only owner of transactions: each begins and ends here.

One thread writes, over one connection, which is also the only one that moves the write-ahead log into the database.
It takes all that waits for it into one transaction, each piece in a savepoint of its own, and answers once that is
on the disk: what is acknowledged is durable, and many requests share one flush. Readers' connections cannot write.
"""

import json
import queue
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Engine
from sqlalchemy.exc import DBAPIError

from .journal import Journal
from .records import StoreError, compact

BATCH = 256  # pieces of work in one transaction, at most
BUSY = 5.0  # seconds to wait for a lock that another program holds
TROUBLE = {  # primary codes of SQLite's that tell of the database and its disk, not of one statement
    sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_FULL, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PROTOCOL,
    sqlite3.SQLITE_NOTADB,
}  # fmt: skip
T = TypeVar("T")


@dataclass
class Transaction:
    """What one piece of work sees: the connection, and the journal lines it wants written with the commit."""

    connection: Connection
    lines: list[str] = field(default_factory=list)
    durable: bool = False  # whether somebody is told of something that only the lines keep when the database is lost

    def run(self, statement: sa.Executable, rows: Any = None) -> sa.CursorResult[Any]:
        """Execute; `rows` for many at once."""
        return cast("sa.CursorResult[Any]", self.connection.execute(statement, rows))

    def ask(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """What is asked all the time: no layer between it and SQLite."""
        found: list[tuple[Any, ...]] = self.raw.execute(query, values).fetchall()
        return found

    def add(self, table: sa.Table, rows: Sequence[Mapping[str, Any]]) -> None:
        """Insert rows that all have the same columns, as SQLite keeps them."""
        if rows:
            self.raw.executemany(_addition(table.name, tuple(rows[0])), rows)

    def change(self, table: sa.Table, which: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
        """Change the rows that have these values in the columns `which`; all change the same other columns."""
        if rows:
            self.raw.executemany(_change(table.name, tuple(rows[0]), tuple(which)), rows)

    def last_number(self, table: str, least: int = 0) -> int:
        """The largest number that a row of the table has had, gone or not; from now on at least `least`."""
        row = "SELECT 1 FROM sqlite_sequence WHERE name = ?1"
        self.ask(f"INSERT INTO sqlite_sequence (name, seq) SELECT ?1, 0 WHERE NOT EXISTS ({row})", (table,))
        change = "UPDATE sqlite_sequence SET seq = max(seq, ?2) WHERE name = ?1 RETURNING seq"
        [(number,)] = self.ask(change, (table, least))
        return int(number)

    @property
    def raw(self) -> sqlite3.Connection:
        """SQLite's own connection."""
        return cast("sqlite3.Connection", self.connection.connection.dbapi_connection)

    def note(self, kind: str, **line: Any) -> None:
        """A line of the journal: what a lost index is rebuilt from."""
        self.lines.append(json.dumps({"kind": kind, **line}) + "\n")


@lru_cache
def _addition(table: str, columns: tuple[str, ...]) -> str:
    names, values = ", ".join(f'"{name}"' for name in columns), ", ".join(f":{name}" for name in columns)
    return f"INSERT INTO {table} ({names}) VALUES ({values})"


@lru_cache
def _change(table: str, columns: tuple[str, ...], which: tuple[str, ...]) -> str:
    changed = ", ".join(f'"{name}" = :{name}' for name in columns if name not in which)
    return f"UPDATE {table} SET {changed} WHERE {' AND '.join(f'{name} = :{name}' for name in which)}"


@dataclass
class Work:
    """Something to be done in a savepoint of its own."""

    effect: Callable[[Transaction], Any]
    answer: Future[Any]


@dataclass(frozen=True)
class Share:
    """Work that is done for many at once: `effect` takes all that have it, and answers each; an error is one's own."""

    effect: Callable[[Transaction, Sequence[Any]], Sequence[Any]]
    wanted: Any
    answer: Future[Any]


_Piece = tuple[Sequence[Work | Share], Callable[[Transaction], Sequence[Any]]]


class Writer:
    """Takes work from any thread. `write` gives a future, done once the change is durable."""

    def __init__(self, path: Path, journal: Journal, writable: bool) -> None:
        """Raises `StoreError`. writable: False for a look beside the service that writes; only one can write."""
        self.path, self.journal = path, journal
        self._engine = make_engine(path, writer=True)
        if writable:
            try:
                self._engine.connect().close()  # the log must be there before the first reader is
            except DBAPIError as error:
                raise StoreError(f"{self.path}: {words_of(error)}") from error
        self._waiting: queue.SimpleQueue[Work | Share | None] = queue.SimpleQueue()
        self._door = threading.Lock()
        self.listeners: list[Callable[[], None]] = []  # called in the writer's thread after each commit
        self._thread = threading.Thread(target=self._write, name="frit-store", daemon=True)
        self._closed = not writable
        if writable:
            self._thread.start()

    def close(self) -> None:
        """Finish what waits, and close."""
        with self._door:
            if not self._closed:
                self._closed = True
                self._waiting.put(None)
        if self._thread.is_alive():
            self._thread.join()
        self._engine.dispose()

    def write(self, effect: "Callable[[Transaction], T]") -> "Future[T]":
        """Have the effect done in a transaction; the future is done when it is durable."""
        return self.put(Work(effect, Future()))

    def put(self, work: "Work | Share") -> "Future[Any]":
        """Have it done with all else that waits."""
        with self._door:
            if self._closed:
                raise StoreError(f"{self.path}: closed, or opened for reading only")
            self._waiting.put(work)
        return work.answer

    def _write(self) -> None:
        while (work := self._waiting.get()) is not None:
            batch: list[Work | Share | None] = [work]
            while len(batch) < BATCH and not self._waiting.empty():
                batch.append(self._waiting.get())
            self._commit([work for work in batch if work is not None])
            if batch[-1] is None:
                return

    def _commit(self, batch: Sequence[Work | Share]) -> None:
        batch = [work for work in batch if work.answer.set_running_or_notify_cancel()]  # nobody waits for the others
        answers: list[tuple[Work | Share, Any]] = []
        done: list[Transaction] = []
        pieces = _pieces(batch)
        try:
            with self._engine.connect() as connection, self.journal.appending() as write, connection.begin():
                while pieces:
                    works, effect = pieces.pop(0)
                    transaction = Transaction(connection)
                    try:
                        with _savepoint(transaction.raw):
                            results = effect(transaction)
                        answers += zip(works, results, strict=True)
                        done.append(transaction)
                    except Exception as error:
                        if _spoils_all(connection, error):
                            raise
                        if len(works) == 1:
                            answers.append((works[0], error))
                        else:  # one of them is bad, the others are not
                            pieces += [piece for work in works for piece in _pieces([work])]
                write("".join(line for transaction in done for line in transaction.lines), any(t.durable for t in done))
        except Exception as error:
            trouble = StoreError(f"{self.path}: {words_of(error)}")
            trouble.__cause__ = error
            for piece in batch:
                piece.answer.set_exception(trouble)
            return
        for piece, answer in answers:
            if isinstance(answer, Exception):
                piece.answer.set_exception(answer)
            else:
                piece.answer.set_result(answer)
        for listener in self.listeners:
            listener()


# --- pieces of transactions -------------------------------------------------------------------------------


def _pieces(batch: "Sequence[Work | Share]") -> "list[_Piece]":
    """What is done in a savepoint each: first all that is done for many at once, then everything else by itself."""
    shares: dict[Any, list[Share]] = {}
    for work in batch:
        if isinstance(work, Share):
            shares.setdefault(work.effect, []).append(work)
    together: list[_Piece] = [(share, _shared(share)) for share in shares.values()]
    return together + [([work], _alone(work)) for work in batch if isinstance(work, Work)]


def _shared(share: Sequence[Share]) -> "Callable[[Transaction], Sequence[Any]]":
    return lambda t: share[0].effect(t, [work.wanted for work in share])


def _alone(work: Work) -> "Callable[[Transaction], list[Any]]":
    return lambda t: [work.effect(t)]


@contextmanager
def _savepoint(connection: sqlite3.Connection) -> Iterator[None]:
    """What the block did is undone where it ends badly, as far as there is a transaction left."""
    connection.execute("SAVEPOINT piece")
    try:
        yield
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK TO piece")
            connection.execute("RELEASE piece")
        raise
    connection.execute("RELEASE piece")


def _spoils_all(connection: Connection, error: Exception) -> bool:
    """Whether an error ended the whole transaction, or tells of trouble with the database that others will have too."""
    raw = connection.connection.dbapi_connection
    return code_of(error) in TROUBLE or not getattr(raw, "in_transaction", False)


# --- engines ----------------------------------------------------------------------------------------------


def make_engine(path: Path, writer: bool) -> Engine:
    """SQLite in WAL mode. The writer's transactions are immediate and flushed to the disk before they count."""
    engine = sa.create_engine(
        f"sqlite:///{path}", poolclass=sa.pool.QueuePool, pool_size=1 if writer else 8,
        max_overflow=0 if writer else 24,
        connect_args={"check_same_thread": False, "timeout": BUSY}, json_serializer=compact,
    )  # fmt: skip

    @sa.event.listens_for(engine, "connect")
    def _prepare(connection: sqlite3.Connection, _: object) -> None:
        connection.isolation_level = None  # BEGIN is ours
        if writer:
            _keep_a_log(connection)
        own = ("synchronous = FULL",) if writer else ("query_only = ON", "wal_autocheckpoint = 0")
        for pragma in (*own, "foreign_keys = ON", "mmap_size = 0"):
            connection.execute(f"PRAGMA {pragma}")

    @sa.event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writer else "BEGIN")

    return engine


def _keep_a_log(connection: sqlite3.Connection) -> None:
    """WAL mode. For this switch alone SQLite does not wait where another program writes."""
    last = time.monotonic() + BUSY
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            if code_of(error) != sqlite3.SQLITE_BUSY or time.monotonic() > last:
                raise
        time.sleep(0.01)


def code_of(error: BaseException) -> int | None:
    """SQLite's primary code."""
    code = getattr(getattr(error, "orig", error), "sqlite_errorcode", None)
    return None if code is None else int(code) & 0xFF


def words_of(error: BaseException) -> str:
    """What went wrong first: SQLite's word, or the system's; not of the savepoint that was lost by it."""
    first = error
    while code_of(first) not in TROUBLE and first.__context__ is not None:
        first = first.__context__
    told = first if code_of(first) in TROUBLE else error
    return str(getattr(told, "orig", None) or told)
