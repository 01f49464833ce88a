"""The only file that opens the database: every transaction begins and ends here.

One thread writes, over one connection, which is also the only one that moves the write-ahead log into the database.
It takes all that waits for it into one transaction, each piece in a savepoint of its own, and answers once that is
on the disk: what is acknowledged is durable, and many requests share one flush. Readers' connections cannot write.
"""

import json
import os
import queue
import re
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Engine, Row
from sqlalchemy.exc import DBAPIError

from frit.solver.revision import REVISION, revision_of

from . import migrations
from .files import flush_folder
from .jobs import Exit, Job, Move, NewJob, State, TransitionError, after
from .schema import attempts, events, history, idempotency, jobs, snapshots, sweep_jobs, sweeps

BATCH = 256  # pieces of work in one transaction, at most
ASKED = 16  # indices that questions have made, at most
FEW = 2000  # jobs that are sorted rather than walked along
BUSY = 5.0  # seconds to wait for a lock that another program holds
UPLOADED = re.compile(r"\b[0-9a-f]{64}\.[a-z]+")  # the name of an uploaded file
TROUBLE = {  # primary codes of SQLite's that tell of the database and its disk, not of one statement
    sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_FULL, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PROTOCOL,
    sqlite3.SQLITE_NOTADB,
}  # fmt: skip
T = TypeVar("T")


class StoreError(RuntimeError):
    """The index cannot be used now; nothing was changed. The message says why."""


class NotFoundError(LookupError):
    """There is no such job, sweep or token."""


class KeyReusedError(ValueError):
    """An idempotency key that came before, with another request."""


@dataclass(frozen=True, slots=True)
class Key:
    """An idempotency key: `scope` keeps one user's and one route's keys apart, `fingerprint` tells the request."""

    scope: str
    value: str
    fingerprint: str


@dataclass(frozen=True, slots=True)
class SweepRecord:
    """A sweep: `states` counts its jobs; of its points `duplicates` were the same case as an earlier one."""

    seq: int
    id: str
    name: str
    definition: str
    duplicates: int
    created: float
    points: int
    states: dict[str, int]


@dataclass(frozen=True, slots=True)
class SweepPoint:
    """A job in a sweep: its place, its name there, and the values of the sweep's axes."""

    position: int
    name: str
    parameters: dict[str, Any]
    job: Job


@dataclass(frozen=True, slots=True)
class NewPoint:
    """A point of a sweep to be submitted."""

    job: NewJob
    parameters: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Event:
    """A change of state; `seq` grows."""

    seq: int
    at: float
    state: State
    message: str | None


@dataclass(frozen=True, slots=True)
class Attempt:
    """One try at a job: the cores it had, and its runner's process once that has recorded itself."""

    job: str
    number: int
    cores: tuple[int, ...]
    claimed: float
    pid: int | None
    pid_start: int | None
    boot: str | None
    ended: float | None
    state: str | None
    message: str | None
    core_seconds: float | None


@dataclass(frozen=True, slots=True)
class Token:
    """A token as it is kept: never the secret itself."""

    name: str
    scope: str
    created: float
    revoked: float | None


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
class _Work:
    effect: Callable[[Transaction], Any]
    answer: Future[Any]


@dataclass(frozen=True)
class _Share:
    """Work that is done for many at once: `effect` takes all that have it, and answers each; an error is one's own."""

    effect: Callable[[Transaction, Sequence[Any]], Sequence[Any]]
    wanted: Any
    answer: Future[Any]


_Piece = tuple[Sequence[_Work | _Share], Callable[[Transaction], Sequence[Any]]]


@dataclass(frozen=True)
class _Submission:
    """A job to be queued."""

    job: NewJob
    key: Key | None


@dataclass(frozen=True)
class _Start:
    """An attempt whose runner has recorded itself."""

    job: str
    attempt: int
    process: Mapping[str, Any]


@dataclass(frozen=True)
class _End:
    """An attempt that has ended."""

    job: str
    end: Exit
    attempts_limit: int
    result: Mapping[str, Any] | None


class Store:
    """The index of one data folder. Methods that change it give a future, done once the change is durable."""

    def __init__(self, folder: Path, writable: bool = True) -> None:
        """Open an up-to-date index; make it where there is none. Raises `IndexVersionError`, `StoreError`.

        writable: False for a look beside the service that writes; there can be one writer only.
        """
        self.path = folder.absolute() / "frit.db"
        self.journal = folder.absolute() / "submitted.jsonl"
        migrations.prepare(self.path)
        self._writer = _engine(self.path, writer=True)
        self._reader = _engine(self.path, writer=False)
        if writable:
            try:
                self._writer.connect().close()  # the log must be there before the first reader is
            except DBAPIError as error:
                raise StoreError(f"{self.path}: {_words(error)}") from error
        self._waiting: queue.SimpleQueue[_Work | _Share | None] = queue.SimpleQueue()
        self._door = threading.Lock()
        self._asking = threading.RLock()
        made = self._ask("SELECT name FROM sqlite_master WHERE type = 'index' AND name GLOB 'asked_*'")
        self._asked = {name.removeprefix("asked_"): True for (name,) in made}  # whether made; the newest last
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
        self._writer.dispose()
        self._reader.dispose()

    # --- the writer ---------------------------------------------------------------------------------------

    def write(self, effect: "Callable[[Transaction], T]") -> "Future[T]":
        """Have the effect done in a transaction; the future is done when it is durable."""
        return self._put(_Work(effect, Future()))

    def _put(self, work: "_Work | _Share") -> "Future[Any]":
        with self._door:
            if self._closed:
                raise StoreError(f"{self.path}: closed, or opened for reading only")
            self._waiting.put(work)
        return work.answer

    def _write(self) -> None:
        while (work := self._waiting.get()) is not None:
            batch: list[_Work | _Share | None] = [work]
            while len(batch) < BATCH and not self._waiting.empty():
                batch.append(self._waiting.get())
            self._commit([work for work in batch if work is not None])
            if batch[-1] is None:
                return

    def _commit(self, batch: Sequence[_Work | _Share]) -> None:
        batch = [work for work in batch if work.answer.set_running_or_notify_cancel()]  # nobody waits for the others
        answers: list[tuple[_Work | _Share, Any]] = []
        done: list[Transaction] = []
        pieces = _pieces(batch)
        try:
            with self._writer.connect() as connection, self._journalled() as write, connection.begin():
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
            trouble = StoreError(f"{self.path}: {_words(error)}")
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

    @contextmanager
    def _journalled(self) -> Iterator[Callable[[str, bool], None]]:
        """Append to the journal; what was appended is taken back where the block ends badly.

        A crash in between leaves lines that the database does not have, of what nobody was told.
        """
        before: list[int] = []

        def write(text: str, durable: bool) -> None:
            if not text:
                return
            fresh = not self.journal.exists()
            with open(self.journal, "a+b", buffering=0) as file:
                size = file.seek(0, os.SEEK_END)
                before.append(size)
                torn = size > 0 and os.pread(file.fileno(), 1, size - 1) != b"\n"  # by a crash: not to spoil a line
                data = memoryview((b"\n" if torn else b"") + text.encode())
                while data:
                    data = data[file.write(data) :]
                if durable:
                    os.fsync(file.fileno())
            if fresh:
                flush_folder(self.journal.parent)

        try:
            yield write
        except BaseException:
            if before:
                with suppress(OSError):
                    os.truncate(self.journal, before[0])
            raise

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that sees one moment of the database and cannot change it. Raises `StoreError`."""
        try:
            with self._reader.connect() as connection:
                yield connection
        except (DBAPIError, sa.exc.TimeoutError) as error:
            raise StoreError(f"{self.path}: {_words(error)}") from error

    # --- submitting ---------------------------------------------------------------------------------------

    def submit(self, job: NewJob, key: Key | None = None) -> "Future[Job]":
        """Queue a job. With a key that came before, the job it made then. Raises `KeyReusedError`."""
        return self._put(_Share(_submit, _Submission(job, key), Future()))

    def submit_sweep(
        self, name: str, definition: str, points: Sequence[NewPoint], duplicates: int = 0, key: Key | None = None,
        recompute: bool = False,
    ) -> "Future[SweepRecord]":  # fmt: skip
        """Queue the points of a sweep that no job has yet; jobs of the same case that were not done are tried again.

        recompute: what another revision of the solver computed does not count.
        """

        def effect(t: Transaction) -> SweepRecord:
            if (known := _known(t, key)) is not None:
                return _sweep(t.connection, known)
            row = _insert_sweep(t, name, definition, duplicates)
            seq, identifier = row["seq"], row["id"]
            numbers = _jobs_of_points(t, points, recompute)
            members = [(numbers[point.job.identity], point.job.name, dict(point.parameters)) for point in points]
            t.note("sweep", **row, points=members)
            rows = [
                {"sweep": seq, "position": i, "job": job, "name": label, "parameters": _compact(parameters)}
                for i, (job, label, parameters) in enumerate(members)
            ]
            t.add(sweep_jobs, rows)
            _remember(t, key, identifier)
            return _sweep(t.connection, identifier)

        return self.write(effect)

    # --- what happens to a job ----------------------------------------------------------------------------

    def claim(self, choices: Sequence[tuple[int, tuple[int, ...]]]) -> "Future[list[Job]]":
        """Give queued jobs (by seq) their cores. One that is not queued any more is left out."""

        def effect(t: Transaction) -> list[Job]:
            cores, now, rows, moves = dict(choices), time.time(), list[dict[str, Any]](), _Moves(t)
            for job in _all_with(t, "seq", list(cores)):
                if job.state is State.QUEUED:
                    number, started = job.attempt + 1, job.started or now
                    moves.add(job, Move.CLAIM, None, attempt=number, started=started, ended=None)
                    row = {"job": job.seq, "number": number, "cores": list(cores[job.seq]), "claimed": now}
                    t.note("attempt", **row)
                    rows.append({**row, "cores": _compact(row["cores"])})
            t.add(attempts, rows)
            return moves.made()

        return self.write(effect)

    def start(self, identifier: str, attempt: int, pid: int, pid_start: int, boot: str) -> "Future[Job]":
        """The runner of an attempt has recorded itself. Told twice it counts once."""
        process = {"pid": pid, "pid_start": pid_start, "boot": boot}
        return self._put(_Share(_start, _Start(identifier, attempt, process), Future()))

    def finish(
        self, identifier: str, end: Exit, attempts_limit: int, result: Mapping[str, Any] | None = None
    ) -> "Future[Job]":
        """An attempt has ended. Told twice, or of an attempt that is not the present one, it counts once.

        result: the scalars by which the job is found from now on; None: those it has.
        """
        return self._put(_Share(_finish, _End(identifier, end, attempts_limit, result), Future()))

    def requeue(self, identifier: str, attempt: int) -> "Future[Job]":
        """The pause after a broken attempt is over."""

        def effect(t: Transaction) -> Job:
            job = _job(t.connection, identifier)
            if job.attempt != attempt or not job.retrying:
                return job
            return _move(t, job, Move.REQUEUE, job.message, retrying=False)

        return self.write(effect)

    def cancel(self, identifier: str, key: Key | None = None) -> "Future[Job]":
        """End a job: at once where it has no cores, else it is marked and its runner must be told.

        Raises `TransitionError` where it has ended already. With a key that came before nothing more is done.
        """

        def effect(t: Transaction) -> Job:
            if (known := _known(t, key)) is not None:
                return _job(t.connection, known)
            job = _job(t.connection, identifier)
            _remember(t, key, job.id)
            if job.state is State.CANCELLED:
                return job
            if job.state.active:
                _set(t, job, stopping=True)
                t.durable = True
                return _by_seq(t.connection, job.seq)
            if job.state in (State.ERROR, State.LOST) and not job.retrying:
                raise TransitionError(job.state, Move.CANCEL)
            t.durable = True
            return _move(t, job, Move.CANCEL, None, retrying=False, ended=time.time())

        return self.write(effect)

    def retry(self, identifier: str, key: Key | None = None) -> "Future[Job]":
        """Queue a job that ended without success again; it goes on from its checkpoint. Raises `TransitionError`.

        With a key that came before nothing more is done.
        """

        def effect(t: Transaction) -> Job:
            if (known := _known(t, key)) is not None:
                return _job(t.connection, known)
            job = _retry(t, _job(t.connection, identifier))
            _remember(t, key, job.id)
            return job

        return self.write(effect)

    def ingest(self, seq: int, rows: Sequence[tuple[int, str]], times: Sequence[tuple[int, float]]) -> "Future[None]":
        """History rows (number, JSON line) and times of complete snapshots (number, time) of a job.

        Of a history that was cut back, what came after the first of these rows is forgotten.
        """

        def effect(t: Transaction) -> None:
            if rows:
                trees = [json.loads(line) for _, line in rows]
                values = [
                    {"job": seq, "row": number, "time": tree["time"], "vacancy_ratio": tree.get("vacancy_ratio"),
                     "data": line}
                    for (number, line), tree in zip(rows, trees, strict=True)
                ]  # fmt: skip
                t.run(history.delete().where(history.c.job == seq, history.c.row >= rows[0][0]))
                t.run(history.insert(), values)
            if times:
                values = [{"job": seq, "number": number, "time": at} for number, at in times]
                t.run(snapshots.insert().prefix_with("OR REPLACE"), values)

        return self.write(effect)

    def set_result(self, seq: int, result: Mapping[str, Any]) -> "Future[None]":
        """The scalars by which finished jobs are found."""

        return self.write(lambda t: _set_results(t, {seq: result}))

    # --- looking ------------------------------------------------------------------------------------------

    def job(self, identifier: str) -> Job:
        """By its id, or by the first characters of it where they suffice. Raises `NotFoundError`."""
        with self.reading() as connection:
            return _job(connection, identifier)

    def files_used(self) -> set[str]:
        """Names of the uploads that a job or the definition of a sweep has a path to."""
        with self.reading() as connection:
            cases = connection.exec_driver_sql("SELECT DISTINCT json_extract(\"case\", '$.nodes.path') FROM jobs")
            paths = [Path(path).name for (path,) in cases if path]
            texts = connection.exec_driver_sql("SELECT definition FROM sweeps WHERE instr(definition, '/files/')")
            return {*paths, *(name for (text,) in texts for name in UPLOADED.findall(text))}

    def jobs(
        self, where: sa.ColumnElement[bool] | None = None, order: Sequence[Any] = (), limit: int = 50
    ) -> list[Job]:
        """Jobs that fit, newest first unless told otherwise."""
        query = sa.select(jobs).order_by(*(order or (jobs.c.seq.desc(),))).limit(limit)
        with self.reading() as connection:
            return [_record(row) for row in connection.execute(query if where is None else query.where(where))]

    def page(
        self, where: sa.ColumnElement[bool], order: Sequence[Any], limit: int,
        value: sa.ColumnElement[Any] | None = None, few: Sequence[sa.ColumnElement[bool]] = (),
        near: sa.Select[Any] | None = None,
    ) -> list[tuple[Job, Any]]:  # fmt: skip
        """Jobs that fit, in order, each with the value it is ordered by.

        The jobs are chosen first and read afterwards: sorting moves numbers, not cases; of these, particles that are
        listed one by one are left out. `few`: parts of the filter, and
        at last all of it, that indices have in another order; so where few jobs fit one they are found by it and
        sorted, and where many do, a walk along the order meets enough of them soon. `near`: the beginning of such a
        walk; where that is not enough, all that fit are sorted.
        """
        with self.reading() as connection:
            for part in (*few, where) if few or near is not None else ():
                found = connection.execute(sa.select(jobs.c.seq).where(part).limit(FEW + 1)).scalars().all()
                if len(found) <= FEW:
                    where = jobs.c.seq.in_(found) & where
                    near = None
                    break
            chosen = sa.select(jobs.c.seq, sa.null() if value is None else value).order_by(*order).limit(limit)
            places: Sequence[Any] = []
            if near is not None:
                places = connection.execute(chosen.where(where, jobs.c.seq.in_(near))).all()
            if len(places) < limit:
                places = connection.execute(chosen.where(where)).all()
            rows = connection.execute(sa.select(*BRIEF).where(jobs.c.seq.in_([seq for seq, _ in places])))
            records = {row.seq: _record(row) for row in rows}
        return [(records[seq], at) for seq, at in places]

    def indexed(self, key: str, expression: str) -> bool:
        """Whether an index of jobs has what a list is filtered or ordered by.

        If not, one is made, for those who ask again; of too many the one that was not asked for longest goes. Few jobs
        need none.
        """
        with self._asking:
            made = self._asked.pop(key, None)
            if made is None:
                if self._closed or self._ask("SELECT count(*) FROM (SELECT 1 FROM jobs LIMIT ?)", (FEW,))[0][0] < FEW:
                    return False
                gone = [name for name, _ in zip(self._asked, range(len(self._asked) + 1 - ASKED), strict=False)]
                for name in gone:
                    del self._asked[name]
                self._asked[key] = False
                with suppress(StoreError):
                    self.write(lambda t: _change_indices(t, key, expression, gone)).add_done_callback(
                        lambda done: self._found(key, done.exception() is None)
                    )
            else:
                self._asked[key] = made
            return self._asked.get(key, False)

    def _found(self, key: str, made: bool) -> None:
        with self._asking:
            if made and key in self._asked:
                self._asked[key] = True
            elif not made:
                self._asked.pop(key, None)

    def queued(self, limit: int) -> list[tuple[int, int]]:
        """(seq, ranks) of the first jobs in the queue: by priority, then by age."""
        query = "SELECT seq, ranks FROM jobs WHERE state = ? ORDER BY priority DESC, seq LIMIT ?"
        return self._ask(query, (State.QUEUED, limit))

    def unfinished(self) -> tuple[list[tuple[Job, Attempt]], list[Job]]:
        """Jobs that have cores with their present attempt, and jobs that wait for another attempt."""
        active = jobs.c.state.in_([State.STARTING, State.RUNNING])
        with self.reading() as connection:
            held = [_record(row) for row in connection.execute(sa.select(jobs).where(active))]
            waiting = [
                _record(row)
                for row in connection.execute(
                    sa.select(jobs).where(jobs.c.state.in_([State.ERROR, State.LOST]), jobs.c.retrying)
                )
            ]
            return [(job, _attempts(connection, job)[-1]) for job in held], waiting

    def count(self, *states: State) -> int:
        """Number of jobs in these states."""
        with self.reading() as connection:
            query = sa.select(sa.func.count()).select_from(jobs).where(jobs.c.state.in_(states))
            return int(connection.execute(query).scalar_one())

    def counts(self) -> dict[str, int]:
        """Number of jobs by state."""
        with self.reading() as connection:
            found = connection.execute(sa.select(jobs.c.state, sa.func.count()).group_by(jobs.c.state)).all()
        return {state: dict((s, n) for s, n in found).get(state, 0) for state in State}

    def attempts(self, identifier: str) -> list[Attempt]:
        """All attempts at a job, first to last."""
        with self.reading() as connection:
            return _attempts(connection, _job(connection, identifier))

    def events(self, identifier: str, since: int = 0) -> list[Event]:
        """Changes of a job's state after event number `since`."""
        with self.reading() as connection:
            seq = _job(connection, identifier).seq
            query = sa.select(events).where(events.c.job == seq, events.c.seq > since).order_by(events.c.seq)
            return [Event(row.seq, row.at, State(row.state), row.message) for row in connection.execute(query)]

    def history(self, identifier: str, since: int = 0, limit: int | None = None) -> list[tuple[int, str]]:
        """History rows (number, JSON) from number `since` on."""
        with self.reading() as connection:
            seq = _job(connection, identifier).seq
            query = sa.select(history.c.row, history.c.data).where(history.c.job == seq, history.c.row >= since)
            return [(row.row, row.data) for row in connection.execute(query.order_by(history.c.row).limit(limit))]

    def columns(self, seq: int) -> list[str]:
        """Names of the scalars in the history rows of a job, in the order in which they come."""
        query = (
            "SELECT key FROM history, json_each(history.data) WHERE job = ? AND type NOT IN ('array', 'object') "
            "GROUP BY key ORDER BY min(row), min(json_each.id)"
        )
        return [key for (key,) in self._ask(query, (seq,))]

    def snapshots(self, identifier: str) -> list[tuple[int, float]]:
        """(number, time) of the complete snapshots."""
        with self.reading() as connection:
            seq = _job(connection, identifier).seq
            query = sa.select(snapshots).where(snapshots.c.job == seq).order_by(snapshots.c.number)
            return [(row.number, row.time) for row in connection.execute(query)]

    def sweep(self, identifier: str) -> SweepRecord:
        """By its id, or by its name: then the newest of that name. Raises `NotFoundError`."""
        with self.reading() as connection:
            return _sweep(connection, identifier)

    def sweeps(self, before: int | None = None, limit: int = 50) -> list[SweepRecord]:
        """Newest first; `before`: only those with a smaller seq."""
        query = sa.select(sweeps.c.id).order_by(sweeps.c.seq.desc()).limit(limit)
        with self.reading() as connection:
            if before is not None:
                query = query.where(sweeps.c.seq < before)
            return [_sweep(connection, row.id) for row in connection.execute(query)]

    def sweep_points(self, identifier: str) -> list[SweepPoint]:
        """The jobs of a sweep in its own order."""
        with self.reading() as connection:
            seq = _sweep(connection, identifier).seq
            named = sa.select(jobs, sweep_jobs.c.position, sweep_jobs.c.name.label("label"), sweep_jobs.c.parameters)
            query = named.join_from(sweep_jobs, jobs).where(sweep_jobs.c.sweep == seq).order_by(sweep_jobs.c.position)
            return [
                SweepPoint(row.position, row.label, row.parameters, _record(row)) for row in connection.execute(query)
            ]

    def new_in_sweeps(self, which: Sequence[int]) -> dict[int, int]:
        """How many jobs of each sweep (by seq) were made with it."""
        query = (
            sa.select(sweep_jobs.c.sweep, sa.func.count()).join_from(sweep_jobs, jobs).join(sweeps)
            .where(sweep_jobs.c.sweep.in_(which), jobs.c.created >= sweeps.c.created).group_by(sweep_jobs.c.sweep)
        )  # fmt: skip
        with self.reading() as connection:
            found = {seq: n for seq, n in connection.execute(query)}
        return {seq: found.get(seq, 0) for seq in which}

    def curves(self, sweep: int, observable: str) -> dict[int, list[tuple[float, float | None]]]:
        """(time, value) of an observable along the history of each job (by seq) of a sweep (by seq)."""
        value = sa.func.json_extract(history.c.data, f"$.{observable}")
        mine = sa.select(sweep_jobs.c.job).where(sweep_jobs.c.sweep == sweep)
        query = sa.select(history.c.job, history.c.time, value).where(history.c.job.in_(mine))
        found: dict[int, list[tuple[float, float | None]]] = {}
        with self.reading() as connection:
            for job, at, number in connection.execute(query.order_by(history.c.job, history.c.row)):
                found.setdefault(job, []).append((at, number))
        return found

    def observables(self, sweep: int) -> list[str]:
        """Names of the scalars in the history rows of a sweep's jobs, as the first row of each has them."""
        mine = sa.select(sweep_jobs.c.job).where(sweep_jobs.c.sweep == sweep)
        each = sa.func.json_each(history.c.data).table_valued("key", "type")
        query = (
            sa.select(each.c.key).distinct().select_from(history).join(each, sa.true())
            .where(history.c.job.in_(mine), history.c.row == 0, each.c.type.in_(["integer", "real", "null"]))
        )  # fmt: skip
        with self.reading() as connection:
            return [row.key for row in connection.execute(query)]

    def identities(self, which: Sequence[str], recompute: bool = False) -> dict[str, Job]:
        """Of these identities, the job of each that a sweep would share; `recompute` as in `submit_sweep`."""
        with self.reading() as connection:
            found = _existing(connection, which, recompute)
            return {identity: _by_seq(connection, seq) for identity, seq in found.items()}

    def known(self, key: Key) -> str | None:
        """The id of what a key made before. Raises `KeyReusedError`."""
        with self.reading() as connection:
            return _known(Transaction(connection), key)

    def measured(self, limit: int = 1000) -> list[tuple[str, float]]:
        """The case and the core-seconds of the last jobs that succeeded at the first attempt."""
        fits = (jobs.c.state == State.SUCCEEDED) & (jobs.c.attempt == 1) & jobs.c.core_seconds.is_not(None)
        query = sa.select(jobs.c.case, jobs.c.core_seconds).where(fits).order_by(jobs.c.seq.desc()).limit(limit)
        with self.reading() as connection:
            return [(row.case, row.core_seconds) for row in connection.execute(query)]

    # --- tokens -------------------------------------------------------------------------------------------

    def active_tokens(self) -> dict[str, Token]:
        """The tokens that count now, by hash."""
        rows = self._ask("SELECT hash, name, scope, created FROM tokens WHERE revoked IS NULL")
        return {hashed: Token(name, scope, created, None) for hashed, name, scope, created in rows}

    def had_tokens(self) -> bool:
        """Whether a token was ever made, also one that is revoked by now."""
        return bool(self._ask("SELECT 1 FROM tokens LIMIT 1"))

    def _ask(self, query: str, values: Sequence[Any] = ()) -> list[Any]:
        """What is asked all the time: no layer between it and SQLite."""
        try:
            connection = self._reader.raw_connection()
            try:
                found: list[Any] = connection.cursor().execute(query, values).fetchall()
                return found
            finally:
                connection.close()
        except (DBAPIError, sqlite3.Error, sa.exc.TimeoutError) as error:
            raise StoreError(f"{self.path}: {error}") from error


# --- engines ----------------------------------------------------------------------------------------------


def _engine(path: Path, writer: bool) -> Engine:
    """SQLite in WAL mode. The writer's transactions are immediate and flushed to the disk before they count."""
    engine = sa.create_engine(
        f"sqlite:///{path}", poolclass=sa.pool.QueuePool, pool_size=1 if writer else 8,
        max_overflow=0 if writer else 24,
        connect_args={"check_same_thread": False, "timeout": BUSY}, json_serializer=_compact,
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
            if _code(error) != sqlite3.SQLITE_BUSY or time.monotonic() > last:
                raise
        time.sleep(0.01)


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


_compact = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


def _spoils_all(connection: Connection, error: Exception) -> bool:
    """Whether an error ended the whole transaction, or tells of trouble with the database that others will have too."""
    raw = connection.connection.dbapi_connection
    return _code(error) in TROUBLE or not getattr(raw, "in_transaction", False)


def _code(error: BaseException) -> int | None:
    """SQLite's primary code."""
    code = getattr(getattr(error, "orig", error), "sqlite_errorcode", None)
    return None if code is None else int(code) & 0xFF


def _words(error: BaseException) -> str:
    """What went wrong first: SQLite's word, or the system's; not of the savepoint that was lost by it."""
    first = error
    while _code(first) not in TROUBLE and first.__context__ is not None:
        first = first.__context__
    told = first if _code(first) in TROUBLE else error
    return str(getattr(told, "orig", None) or told)


# --- pieces of transactions -------------------------------------------------------------------------------


def _record(row: Row[Any]) -> Job:
    values = row._mapping
    return Job(
        seq=values["seq"], id=values["id"], name=values["name"], identity=values["identity"],
        state=State(values["state"]), message=values["message"], priority=values["priority"], ranks=values["ranks"],
        tags=tuple(values["tags"]), time_limit=values["time_limit"], attempt=values["attempt"],
        failures=values["failures"], retrying=values["retrying"], stopping=values["stopping"],
        created=values["created"], started=values["started"], ended=values["ended"],
        core_seconds=values["core_seconds"], result=values["result"], case=values["case"],
    )  # fmt: skip


def _all_with(t: Transaction, column: str, values: Sequence[Any]) -> list[Job]:
    """Jobs that have one of the values in the column; SQLite takes some thousands of them."""
    query = f"SELECT {COLUMNS} FROM jobs WHERE {column} IN ({', '.join('?' * len(values))})"
    return [_unpacked(dict(zip(NAMES, row, strict=True))) for row in t.ask(query, values)]


NAMES = [column.name for column in jobs.c]
COLUMNS = ", ".join(f'"{name}"' for name in NAMES)
LISTS = ("$.particles.centres", "$.particles.radii", "$.particles.sizes")  # most of a large case
WITHOUT = sa.func.json_remove(jobs.c.case, *LISTS).label("case")
BRIEF = [WITHOUT if column.name == "case" else column for column in jobs.c]
MADE_BY = sa.func.json_extract(jobs.c.result, "$.revision").label("revision")
USEFUL = [  # what tells whether a job is of use to a sweep; the case where the revision does not tell all
    jobs.c.seq, jobs.c.identity, jobs.c.state, jobs.c.retrying, MADE_BY,
    sa.case((MADE_BY != REVISION, WITHOUT)).label("case"),
]  # fmt: skip


def _unpacked(values: dict[str, Any]) -> Job:
    """A job from what SQLite keeps."""
    values |= {"state": State(values["state"]), "tags": tuple(json.loads(values["tags"]))}
    values |= {"retrying": bool(values["retrying"]), "stopping": bool(values["stopping"])}
    return Job(**{**values, "result": json.loads(values["result"])})


def _by_seq(connection: Connection, seq: int) -> Job:
    return _record(connection.execute(sa.select(jobs).where(jobs.c.seq == seq)).one())


def _job(connection: Connection, identifier: str) -> Job:
    row = connection.execute(sa.select(jobs).where(jobs.c.id == identifier)).first()
    if row is None and len(identifier) >= 4:
        near = sa.select(jobs).where(jobs.c.id > identifier, jobs.c.id < identifier + "\uffff").limit(2)
        found = connection.execute(near).all()
        row = found[0] if len(found) == 1 else None
    if row is None:
        raise NotFoundError(f"job {identifier!r}: there is none, or several begin so")
    return _record(row)


def _attempts(connection: Connection, job: Job) -> list[Attempt]:
    query = sa.select(attempts).where(attempts.c.job == job.seq).order_by(attempts.c.number)
    return [
        Attempt(job.id, row.number, tuple(row.cores), row.claimed, row.pid, row.pid_start, row.boot, row.ended,
                row.state, row.message, row.core_seconds)
        for row in connection.execute(query)
    ]  # fmt: skip


def _move(t: Transaction, job: Job, move: Move, message: str | None, **values: Any) -> Job:
    """Change a job's state and tell it as an event."""
    state, now = after(job.state, move), time.time()
    _set(t, job, event=now, state=state, message=message, **values)
    t.run(events.insert(), [{"job": job.seq, "at": now, "state": state, "message": message}])
    return replace(job, state=state, message=message, **values)


class _Moves:
    """Many jobs' moves in a few statements; all set the same columns. A job may come again: it is as it was left."""

    def __init__(self, t: Transaction) -> None:
        self.transaction, self.now = t, time.time()
        self.jobs: list[Job] = []
        self.changes: list[dict[str, Any]] = []

    def add(self, job: Job, move: Move, message: str | None, **values: Any) -> Job:
        """As `_move` does; to be written by `made`."""
        change = {"state": after(job.state, move), "message": message, **values}
        self.changes.append({"seq": job.seq, **change})
        self.transaction.note("set", job=job.seq, event=self.now, values=change)
        self.jobs.append(replace(job, **change))
        return self.jobs[-1]

    def made(self) -> list[Job]:
        """Write them; the jobs as they are now."""
        self.transaction.change(jobs, ["seq"], self.changes)
        told = [{"job": j.seq, "at": self.now, "state": j.state, "message": j.message} for j in self.jobs]
        self.transaction.add(events, told)
        return self.jobs


def _start(t: Transaction, wanted: Sequence[_Start]) -> list[Job | NotFoundError]:
    known, moves, rows = _known_jobs(t, [start.job for start in wanted]), _Moves(t), list[dict[str, Any]]()
    for start in wanted:
        job = known[start.job]
        if isinstance(job, Job) and (job.attempt, job.state) == (start.attempt, State.STARTING):
            rows.append(_of_attempt(t, job, start.process))
            known[start.job] = moves.add(job, Move.START, None)
    return _moved(t, rows, moves, [known[start.job] for start in wanted])


def _finish(t: Transaction, wanted: Sequence[_End]) -> list[Job | NotFoundError]:
    known, moves, rows = _known_jobs(t, [each.job for each in wanted]), _Moves(t), list[dict[str, Any]]()
    results: dict[int, Mapping[str, Any]] = {}
    for each in wanted:
        job, end = known[each.job], each.end
        if not isinstance(job, Job) or job.attempt != end.attempt or not job.state.active:
            continue
        broke, move = end.move in (Move.BREAK, Move.LOSE), end.move
        if job.stopping and move in (Move.BREAK, Move.LOSE, Move.RELEASE):  # nobody wants it any more
            broke, move = False, Move.STOP
        state, failures = after(job.state, move), job.failures + 1 if broke and not end.advanced else 0
        ended = {"ended": end.ended, "state": state, "message": end.message, "core_seconds": end.core_seconds}
        rows.append(_of_attempt(t, job, ended))
        if each.result is not None:
            results[job.seq] = each.result
        known[each.job] = moves.add(
            job, move, end.message, failures=failures, retrying=broke and end.again and failures < each.attempts_limit,
            stopping=False, ended=None if state is State.QUEUED else end.ended,
            core_seconds=(job.core_seconds or 0.0) + end.core_seconds,
        )  # fmt: skip
    _set_results(t, results)
    return _moved(t, rows, moves, [known[each.job] for each in wanted])


def _moved(
    t: Transaction, rows: Sequence[Mapping[str, Any]], moves: _Moves, answers: "list[Job | NotFoundError]"
) -> "list[Job | NotFoundError]":
    t.change(attempts, ["job", "number"], rows)
    moves.made()
    return answers


def _of_attempt(t: Transaction, job: Job, values: Mapping[str, Any]) -> dict[str, Any]:
    """The change of a job's present attempt."""
    row = {"job": job.seq, "number": job.attempt, **values}
    t.note("attempt", **row)
    return row


def _set_results(t: Transaction, results: Mapping[int, Mapping[str, Any]]) -> None:
    t.change(jobs, ["seq"], [{"seq": seq, "result": _compact(result)} for seq, result in results.items()])


def _known_jobs(t: Transaction, identifiers: Sequence[str]) -> "dict[str, Job | NotFoundError]":
    """The job of each id or beginning of one."""
    known: dict[str, Job | NotFoundError] = {job.id: job for job in _all_with(t, "id", identifiers)}
    for identifier in identifiers:
        if identifier not in known:
            try:
                known[identifier] = _job(t.connection, identifier)
            except NotFoundError as error:
                known[identifier] = error
    return known


def _set(t: Transaction, job: Job, event: float | None = None, **values: Any) -> None:
    """Change columns of a job; `event`: when that made an event."""
    t.run(jobs.update().where(jobs.c.seq == job.seq).values(values))
    t.note("set", job=job.seq, event=event, values=values)


def _retry(t: Transaction, job: Job, **values: Any) -> Job:
    """A new life: what broke before does not count. `values`: of other columns."""
    t.durable = True
    return _move(t, job, Move.RETRY, None, retrying=False, failures=0, ended=None, **values)


def _submit(t: Transaction, wanted: Sequence[_Submission]) -> list[Job | KeyReusedError]:
    """Queue all that no key has brought before: a few statements, however many there are."""
    texts = {f"{key.scope} {key.value}" for submission in wanted if (key := submission.key) is not None}
    # by key: the fingerprint of its request, and the job's id or its place among the new ones
    seen: dict[str, tuple[str, str | int]] = {}
    if texts:
        query = sa.select(idempotency).where(idempotency.c.key.in_(texts))
        seen = {row.key: (row.fingerprint, row.resource) for row in t.run(query)}
    new: list[NewJob] = []
    places: list[str | int | KeyReusedError] = []
    for submission in wanted:
        key = submission.key
        text = "" if key is None else f"{key.scope} {key.value}"
        fingerprint, place = seen.get(text, (None, None))
        if key is not None and fingerprint is not None and fingerprint != key.fingerprint:
            places.append(_reused(key))
            continue
        if place is None:
            place = len(new)
            new.append(submission.job)
            if key is not None:
                seen[text] = key.fingerprint, place
        places.append(place)
    made = _insert(t, new)
    rows = [
        {"key": text, "fingerprint": fingerprint, "resource": made[place].id, "created": time.time()}
        for text, (fingerprint, place) in seen.items()
        if isinstance(place, int)
    ]
    if rows:
        t.run(idempotency.insert(), rows)
    return [
        place if isinstance(place, KeyReusedError) else made[place] if isinstance(place, int)
        else _job(t.connection, place)
        for place in places
    ]  # fmt: skip


def _pieces(batch: "Sequence[_Work | _Share]") -> "list[_Piece]":
    """What is done in a savepoint each: first all that is done for many at once, then everything else by itself."""
    shares: dict[Any, list[_Share]] = {}
    for work in batch:
        if isinstance(work, _Share):
            shares.setdefault(work.effect, []).append(work)
    together: list[_Piece] = [(share, _shared(share)) for share in shares.values()]
    return together + [([work], _alone(work)) for work in batch if isinstance(work, _Work)]


def _shared(share: Sequence[_Share]) -> "Callable[[Transaction], Sequence[Any]]":
    return lambda t: share[0].effect(t, [work.wanted for work in share])


def _alone(work: _Work) -> "Callable[[Transaction], list[Any]]":
    return lambda t: [work.effect(t)]


def _reused(key: Key) -> KeyReusedError:
    return KeyReusedError(f"Idempotency-Key {key.value!r}: came before, with another request")


def _insert(t: Transaction, new: Sequence[NewJob]) -> list[Job]:
    """Queue jobs. The id is the beginning of the identity, with a number where a case comes again."""
    now, made = time.time(), list[dict[str, Any]]()
    base = _existing_ids(t, [job.identity for job in new])
    for job in new:
        base[job.identity] = again = base.get(job.identity, 0) + 1
        made.append(
            {"id": job.identity[:16] + (f"-{again}" if again > 1 else ""), "name": job.name, "identity": job.identity,
             "state": State.QUEUED.value, "priority": job.priority, "ranks": job.ranks, "tags": job.tags,
             "time_limit": job.time_limit, "attempt": 0, "failures": 0, "retrying": False, "stopping": False,
             "created": now, "result": {}, "case": job.case}
        )  # fmt: skip
    if not made:
        return []
    t.add(jobs, [{**row, "tags": _compact(row["tags"]), "result": "{}"} for row in made])
    [(last,)] = t.ask("SELECT max(seq) FROM jobs")
    numbers = range(last - len(made) + 1, last + 1)
    t.add(events, [{"job": seq, "at": now, "state": "queued"} for seq in numbers])
    for seq, row in zip(numbers, made, strict=True):
        t.note("job", seq=seq, **row)
    t.durable = True
    empty = {"message": None, "started": None, "ended": None, "core_seconds": None, "state": State.QUEUED}
    return [Job(**{**row, **empty, "seq": seq}) for seq, row in zip(numbers, made, strict=True)]


def _existing_ids(t: Transaction, which: Sequence[str]) -> dict[str, int]:
    """How many jobs each identity has had."""
    found: dict[str, int] = {}
    for k in range(0, len(which), 500):
        part = which[k : k + 500]
        marks = ", ".join("?" * len(part))
        query = f"SELECT identity, count(*) FROM jobs WHERE identity IN ({marks}) GROUP BY identity"
        found |= dict(t.ask(query, part))
    return found


def _existing(connection: Connection, which: Sequence[str], recompute: bool = False) -> dict[str, int]:
    """The seq of a job of each identity that has one of use: one that is done, or on its way; of equals the newest."""
    best: dict[str, tuple[int, int]] = {}
    for k in range(0, len(which), 500):
        for row in connection.execute(sa.select(*USEFUL).where(jobs.c.identity.in_(which[k : k + 500]))):
            rank = _use(State(row.state), row.retrying, row.revision, row.case, recompute), row.seq
            best[row.identity] = max(best.get(row.identity, (0, 0)), rank)
    return {identity: seq for identity, (use, seq) in best.items() if use}


def _use(state: State, retrying: bool, revision: int | None, case: str | None, recompute: bool) -> int:
    """Of what use a job is to whoever wants its case computed: 0 none, 3 all.

    What another revision computed stands in, unless it is to be computed anew; where it failed, this one may not.
    """
    going = retrying or state is State.QUEUED or state.active
    if case is not None and revision != revision_of(json.loads(case)):
        return 0 if recompute or not (going or state is State.SUCCEEDED) else 2
    return 3 if state is State.SUCCEEDED else 2 if going else 1


def _jobs_of_points(t: Transaction, points: Sequence[NewPoint], recompute: bool = False) -> dict[str, int]:
    """The seq of a job for each point's identity: an old one where there is one, tried again if it did not get done.

    Whoever queued the old one may have wished for less: it gets the priority, the time and the ranks asked for now.
    """
    asked = {point.job.identity: point.job for point in points}
    numbers = _existing(t.connection, list(asked), recompute)
    old = list(numbers.values())
    undone = jobs.c.state.in_([State.ERROR, State.LOST, State.CANCELLED, State.TIMED_OUT]) & ~jobs.c.retrying
    waiting = (jobs.c.state == State.QUEUED) | jobs.c.retrying
    urgent = max((job.priority for job in asked.values()), default=0)
    modest = waiting & ((jobs.c.priority < urgent) | jobs.c.time_limit.is_not(None))
    small = (jobs.c.state == State.FAILED) & (jobs.c.ranks < max((job.ranks for job in asked.values()), default=1))
    for k in range(0, len(old), 500):
        query = sa.select(jobs).where(jobs.c.seq.in_(old[k : k + 500]), undone | modest | small)
        for row in t.run(query).all():
            job, more = _record(row), _more(row, asked[row.identity])
            if job.state is State.QUEUED or job.retrying:
                if more:
                    _set(t, job, **more)
            elif job.state is not State.FAILED:
                _retry(t, job, **more)
            elif job.ranks < asked[job.identity].ranks:  # it may have been short of memory, which goes with the ranks
                _retry(t, job, **more, ranks=asked[job.identity].ranks)
    missing: dict[str, NewJob] = {}
    for point in points:
        if point.job.identity not in numbers:
            missing.setdefault(point.job.identity, point.job)
    new = _insert(t, list(missing.values()))
    return numbers | {job.identity: job.seq for job in new}


def _more(job: Any, asked: NewJob) -> dict[str, Any]:
    """What a job lacks of the priority and the time that are asked for."""
    more: dict[str, Any] = {}
    if asked.priority > job.priority:
        more["priority"] = asked.priority
    if job.time_limit is not None and (asked.time_limit is None or asked.time_limit > job.time_limit):
        more["time_limit"] = asked.time_limit
    return more


def _insert_sweep(t: Transaction, name: str, definition: str, duplicates: int) -> dict[str, Any]:
    seq = t.run(sa.select(sa.func.coalesce(sa.func.max(sweeps.c.seq), 0))).scalar_one() + 1
    row = {"seq": seq, "id": f"s{seq}", "name": name, "definition": definition, "duplicates": duplicates}
    row["created"] = time.time()
    t.run(sweeps.insert(), [row])
    t.durable = True
    return row


def _sweep(connection: Connection, identifier: str) -> SweepRecord:
    """By id first, then by name."""
    for column in (sweeps.c.id, sweeps.c.name):
        query = sa.select(sweeps).where(column == identifier).order_by(sweeps.c.seq.desc()).limit(1)
        if (row := connection.execute(query).first()) is not None:
            break
    else:
        raise NotFoundError(f"sweep {identifier!r}: there is none")
    grouped = sa.select(jobs.c.state, sa.func.count()).join_from(sweep_jobs, jobs).group_by(jobs.c.state)
    states = {state: n for state, n in connection.execute(grouped.where(sweep_jobs.c.sweep == row.seq))}
    return SweepRecord(
        row.seq, row.id, row.name, row.definition, row.duplicates, row.created, sum(states.values()), states
    )


def _change_indices(t: Transaction, key: str, expression: str, gone: Sequence[str]) -> None:
    for name in gone:
        t.raw.execute(f'DROP INDEX IF EXISTS "asked_{name}"')
    t.raw.execute(f'CREATE INDEX IF NOT EXISTS "asked_{key}" ON jobs ({expression})')


def _known(t: Transaction, key: Key | None) -> str | None:
    """What a key made before; `KeyReusedError` where it came with another request."""
    if key is None:
        return None
    query = sa.select(idempotency).where(idempotency.c.key == f"{key.scope} {key.value}")
    if (row := t.run(query).first()) is None:
        return None
    if row.fingerprint != key.fingerprint:
        raise _reused(key)
    return str(row.resource)


def _remember(t: Transaction, key: Key | None, resource: str) -> None:
    if key is not None:
        named = {"key": f"{key.scope} {key.value}", "fingerprint": key.fingerprint, "resource": resource}
        row = {**named, "created": time.time()}
        t.run(idempotency.insert(), [row])
        t.note("key", **row)
