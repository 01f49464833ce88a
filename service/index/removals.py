"""What is to be gone: jobs and sweeps that have ended are taken out of the index, and stay out of the next one.

It is done in steps, each of which may be the last before a crash:

    1  `remove`   the rows go, and `removed` tells that they have: from here on the job is gone for good
    2  `mourn`    the journal gets a line (`gone`), by which a rebuilt index knows it too
    3             whoever asked deletes the run directory
    4  `settle`   `removed` tells that nothing is left to do

A service begins with the steps that an earlier one has left (`unsettled`).
"""

import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ..jobs.states import Job, Move, TransitionError
from .records import by_seq, find_job, find_sweep
from .schema import attempts, events, history, job_tags, jobs, removed, snapshots, sweep_jobs, sweeps
from .writer import Transaction, Writer


class InUseError(ValueError):
    """A job that somebody else's sweep refers to."""


@dataclass(frozen=True, slots=True)
class Removed:
    """A job or sweep that is gone; `event` has the place of its removal among all events."""

    event: int
    kind: str
    seq: int
    id: str
    identity: str | None
    owner: str | None
    at: float
    core_seconds: float | None


class Removals(Writer):
    """Part of the store."""

    def remove(self, identifiers: Sequence[str]) -> "Future[list[Removed]]":
        """Take jobs that have ended out of the index: all of them or none.

        Raises `NotFoundError`, `TransitionError` for one that has not ended, `InUseError`.
        """
        return self.write(lambda t: [_remove(t, find_job(t.connection, identifier)) for identifier in identifiers])

    def remove_sweep(self, identifier: str) -> "Future[list[Removed]]":
        """A sweep, and the jobs that were made with it for its owner and that no other sweep refers to."""

        def effect(t: Transaction) -> list[Removed]:
            sweep = find_sweep(t.connection, identifier)
            mine = sa.select(sweep_jobs.c.job).where(sweep_jobs.c.sweep == sweep.seq)
            others = sa.select(sweep_jobs.c.job).where(sweep_jobs.c.sweep != sweep.seq)
            made = (jobs.c.created >= sweep.created) & jobs.c.owner.is_not_distinct_from(sweep.owner)
            query = sa.select(jobs.c.seq).where(jobs.c.seq.in_(mine), jobs.c.seq.not_in(others), made)
            members = t.run(query).scalars().all()
            t.run(sweep_jobs.delete().where(sweep_jobs.c.sweep == sweep.seq))
            gone = [_remove(t, by_seq(t.connection, seq)) for seq in members]
            t.run(sweeps.delete().where(sweeps.c.seq == sweep.seq))
            return [_record(t, "sweep", sweep.seq, sweep.id, owner=sweep.owner), *gone]

        return self.write(effect)

    def mourn(self, gone: Sequence[Removed]) -> "Future[None]":
        """Have the journal know, before the directories are deleted."""

        def effect(t: Transaction) -> None:
            for each in gone:
                t.note(
                    "gone", what=each.kind, seq=each.seq, id=each.id, identity=each.identity, owner=each.owner,
                    at=each.at, core_seconds=each.core_seconds,
                )  # fmt: skip
            t.durable = True

        return self.write(effect)

    def settle(self, gone: Sequence[Removed]) -> "Future[None]":
        """Nothing is left of these."""
        rows = [{"event": each.event, "done": True} for each in gone]
        return self.write(lambda t: t.change(removed, ["event"], rows))


def removed_rows(rows: Sequence[Any]) -> list[Removed]:
    """Records of rows of `removed`."""
    names = ("event", "kind", "seq", "id", "identity", "owner", "at", "core_seconds")
    return [Removed(**{name: getattr(row, name) for name in names}) for row in rows]


def _remove(t: Transaction, job: Job) -> Removed:
    if not job.final:
        raise TransitionError(job.state, Move.DELETE)
    query = (
        sa.select(sweeps.c.id).join_from(sweep_jobs, sweeps)
        .where(sweep_jobs.c.job == job.seq, sweeps.c.owner.is_distinct_from(job.owner)).limit(1)
    )  # fmt: skip
    if (user := t.run(query).scalar()) is not None:
        raise InUseError(f"job {job.id}: sweep {user}, which is somebody else's, refers to it")
    gone = _record(t, "job", job.seq, job.id, job.identity, job.owner, job.core_seconds)
    for table in (sweep_jobs, attempts, history, snapshots, events, job_tags):
        t.run(table.delete().where(table.c.job == job.seq))
    t.run(jobs.delete().where(jobs.c.seq == job.seq))
    return gone


def _record(
    t: Transaction, kind: str, seq: int, identifier: str, identity: str | None = None, owner: str | None = None,
    core_seconds: float | None = None,
) -> Removed:  # fmt: skip
    """A number of the events' own, and a row of what is gone."""
    event = t.last_number("events", t.last_number("events") + 1)
    gone = Removed(event, kind, seq, identifier, identity, owner, time.time(), core_seconds)
    values = {name: getattr(gone, name) for name in Removed.__dataclass_fields__}
    t.run(removed.insert(), [{**values, "done": False}])
    return gone
