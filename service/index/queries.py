"""Questions to the index. None can change it, and each sees one moment of it."""

import re
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection
from sqlalchemy.exc import DBAPIError

from ..jobs.states import Job, State, Waiting
from . import keys
from .records import (
    BRIEF,
    Attempt,
    Event,
    Key,
    StoreError,
    SweepPoint,
    SweepRecord,
    Token,
    attempts_of,
    by_seq,
    find_job,
    find_sweep,
    record,
)
from .schema import events, history, jobs, snapshots, sweep_jobs, sweeps
from .submissions import existing
from .writer import Transaction, make_engine, words_of

FEW = 2000  # jobs that are sorted rather than walked along
UPLOADED = re.compile(r"\b[0-9a-f]{64}\.[a-z]+")  # the name of an uploaded file


class Queries:
    """Part of the store. All methods raise `StoreError` where the index cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = make_engine(path, writer=False)

    def close(self) -> None:
        """Close the connections."""
        self._reader.dispose()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that sees one moment of the database and cannot change it. Raises `StoreError`."""
        try:
            with self._reader.connect() as connection:
                yield connection
        except (DBAPIError, sa.exc.TimeoutError) as error:
            raise StoreError(f"{self.path}: {words_of(error)}") from error

    def job(self, identifier: str) -> Job:
        """By its id, or by the first characters of it where they suffice. Raises `NotFoundError`."""
        with self.reading() as connection:
            return find_job(connection, identifier)

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
            return [record(row) for row in connection.execute(query if where is None else query.where(where))]

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
            records = {row.seq: record(row) for row in rows}
        return [(records[seq], at) for seq, at in places]

    def queued(self, limit: int) -> list[Waiting]:
        """The first jobs in the queue: by priority, then by age."""
        query = "SELECT seq, ranks, owner FROM jobs WHERE state = ? ORDER BY priority DESC, seq LIMIT ?"
        return [Waiting(*row) for row in self._ask(query, (State.QUEUED, limit))]

    def unfinished(self) -> tuple[list[tuple[Job, Attempt]], list[Job]]:
        """Jobs that have cores with their present attempt, and jobs that wait for another attempt."""
        active = jobs.c.state.in_([State.STARTING, State.RUNNING])
        with self.reading() as connection:
            held = [record(row) for row in connection.execute(sa.select(jobs).where(active))]
            waiting = [
                record(row)
                for row in connection.execute(
                    sa.select(jobs).where(jobs.c.state.in_([State.ERROR, State.LOST]), jobs.c.retrying)
                )
            ]
            return [(job, attempts_of(connection, job)[-1]) for job in held], waiting

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
            return attempts_of(connection, find_job(connection, identifier))

    def events(self, identifier: str, since: int = 0) -> list[Event]:
        """Changes of a job's state after event number `since`."""
        with self.reading() as connection:
            seq = find_job(connection, identifier).seq
            query = sa.select(events).where(events.c.job == seq, events.c.seq > since).order_by(events.c.seq)
            return [Event(row.seq, row.at, State(row.state), row.message) for row in connection.execute(query)]

    def history(self, identifier: str, since: int = 0, limit: int | None = None) -> list[tuple[int, str]]:
        """History rows (number, JSON) from number `since` on."""
        with self.reading() as connection:
            seq = find_job(connection, identifier).seq
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
            seq = find_job(connection, identifier).seq
            query = sa.select(snapshots).where(snapshots.c.job == seq).order_by(snapshots.c.number)
            return [(row.number, row.time) for row in connection.execute(query)]

    def sweep(self, identifier: str) -> SweepRecord:
        """By its id, or by its name: then the newest of that name. Raises `NotFoundError`."""
        with self.reading() as connection:
            return find_sweep(connection, identifier)

    def sweeps(self, before: int | None = None, limit: int = 50) -> list[SweepRecord]:
        """Newest first; `before`: only those with a smaller seq."""
        query = sa.select(sweeps.c.id).order_by(sweeps.c.seq.desc()).limit(limit)
        with self.reading() as connection:
            if before is not None:
                query = query.where(sweeps.c.seq < before)
            return [find_sweep(connection, row.id) for row in connection.execute(query)]

    def sweep_points(self, identifier: str) -> list[SweepPoint]:
        """The jobs of a sweep in its own order."""
        with self.reading() as connection:
            seq = find_sweep(connection, identifier).seq
            named = sa.select(jobs, sweep_jobs.c.position, sweep_jobs.c.name.label("label"), sweep_jobs.c.parameters)
            query = named.join_from(sweep_jobs, jobs).where(sweep_jobs.c.sweep == seq).order_by(sweep_jobs.c.position)
            return [
                SweepPoint(row.position, row.label, row.parameters, record(row)) for row in connection.execute(query)
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

    def identities(self, which: Sequence[str]) -> dict[str, Job]:
        """Of these identities, the newest job each has."""
        with self.reading() as connection:
            return {identity: by_seq(connection, seq) for identity, seq in existing(connection, which).items()}

    def known(self, key: Key) -> str | None:
        """The id of what a key made before. Raises `KeyReusedError`."""
        with self.reading() as connection:
            return keys.known(Transaction(connection), key)

    def measured(self, limit: int = 1000) -> list[tuple[str, float]]:
        """The case and the core-seconds of the last jobs that succeeded at the first attempt."""
        fits = (jobs.c.state == State.SUCCEEDED) & (jobs.c.attempt == 1) & jobs.c.core_seconds.is_not(None)
        query = sa.select(jobs.c.case, jobs.c.core_seconds).where(fits).order_by(jobs.c.seq.desc()).limit(limit)
        with self.reading() as connection:
            return [(row.case, row.core_seconds) for row in connection.execute(query)]

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
