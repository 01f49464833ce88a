"""Questions to the index. None can change it, and each sees one moment of it."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from ..jobs.states import Job, State, Waiting
from . import keys
from .records import (
    BRIEF,
    Attempt,
    Event,
    Key,
    News,
    Token,
    Usage,
    attempts_of,
    by_seq,
    find_job,
    record,
)
from .removals import Removed, removed_rows
from .schema import events, history, jobs, removed, snapshots
from .submissions import existing
from .sweep_queries import SweepQueries
from .writer import Transaction

FEW = 2000  # jobs that are sorted rather than walked along
UPLOADED = re.compile(r"\b[0-9a-f]{64}\.[a-z]+")  # the name of an uploaded file


class Queries(SweepQueries):
    """Part of the store. All methods raise `StoreError` where the index cannot be read."""

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

    def queued(self, limit: int, without: Sequence[str] = ()) -> list[Waiting]:
        """The first jobs in the queue, but for those of some owners: by priority, then by age."""
        others = f"AND ifnull(owner, '') NOT IN ({', '.join('?' * len(without))}) " if without else ""
        query = f"SELECT seq, ranks, owner FROM jobs WHERE state = ? {others}ORDER BY priority DESC, seq LIMIT ?"
        return [Waiting(*row) for row in self._ask(query, (State.QUEUED, *without, limit))]

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

    def identities(self, which: Sequence[str], recompute: bool = False) -> dict[str, Job]:
        """Of these identities, the job of each that a sweep would share; `recompute` as in `submit_sweep`."""
        with self.reading() as connection:
            found = existing(connection, which, recompute)
            return {identity: by_seq(connection, seq) for identity, seq in found.items()}

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

    def unsettled(self) -> list[Removed]:
        """What is gone, but not all of it: a service ended in the middle."""
        with self.reading() as connection:
            return removed_rows(connection.execute(sa.select(removed).where(~removed.c.done)).all())

    def news(self, since: int, limit: int, owner: str | None = None) -> list[News]:
        """What has happened to any job after event number `since`; owner: to the jobs of this one."""
        told = sa.select(events.c.seq, jobs.c.id, jobs.c.name, events.c.at, events.c.state, events.c.message)
        told = told.join_from(events, jobs).where(events.c.seq > since)
        nothing = sa.null()
        gone = sa.select(removed.c.event, removed.c.id, nothing, removed.c.at, removed.c.kind, nothing)
        gone = gone.where(removed.c.event > since)
        if owner is not None:
            told, gone = told.where(jobs.c.owner == owner), gone.where(removed.c.owner == owner)
        with self.reading() as connection:
            rows = [*connection.execute(told.order_by(events.c.seq).limit(limit))]
            rows += connection.execute(gone.order_by(removed.c.event).limit(limit))
        return sorted((News(*row) for row in rows), key=lambda news: news.seq)[:limit]

    def last_event(self) -> int:
        """The number of the newest event."""
        [(last,)] = self._ask("SELECT ifnull((SELECT seq FROM sqlite_sequence WHERE name = 'events'), 0)")
        return int(last)

    def usage(self, owner: str) -> Usage:
        """What the jobs of an owner take, and have taken."""
        query = (
            "SELECT count(*) FILTER (WHERE state = 'queued'), "
            "ifnull(sum(ranks) FILTER (WHERE state IN ('starting', 'running')), 0), "
            "ifnull(sum(core_seconds), 0.0) + (SELECT ifnull(sum(core_seconds), 0.0) FROM removed WHERE owner = ?1), "
            "ifnull(sum(bytes), 0) FROM jobs WHERE owner = ?1"
        )
        [row] = self._ask(query, (owner,))
        return Usage(*row)

    def active_tokens(self) -> dict[str, Token]:
        """The tokens that count now, by hash."""
        rows = self._ask("SELECT hash, name, scope, created FROM tokens WHERE revoked IS NULL")
        return {hashed: Token(name, scope, created, None) for hashed, name, scope, created in rows}

    def had_tokens(self) -> bool:
        """Whether a token was ever made, also one that is revoked by now."""
        return bool(self._ask("SELECT 1 FROM tokens LIMIT 1"))

