"""What is in the index, as it travels through the service; how a row becomes a record; how one is found."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from frit.solver.revision import REVISION

from ..jobs.states import Job, NewJob, State
from .schema import attempts, jobs, sweep_jobs, sweeps


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
    owner: str | None
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


class News(NamedTuple):
    """Something that happened to a job; `state` is `job` or `sweep` where that is gone."""

    seq: int
    id: str
    name: str | None
    at: float
    state: str
    message: str | None


class Compared(NamedTuple):
    """A job of a sweep among others."""

    seq: int
    id: str
    name: str
    state: State
    parameters: dict[str, Any]
    older: int | None  # see `states.Job.older`
    message: str | None
    porosity: float | None  # of the pack's own box, in the last history row


class Usage(NamedTuple):
    """What somebody's jobs take now and have taken."""

    queued: int
    cores: int
    core_seconds: float
    bytes: int


@dataclass(frozen=True, slots=True)
class Attempt:
    """One try at a job: the cores it had, and its runner once that has recorded itself."""

    job: str
    number: int
    cores: tuple[int, ...]
    claimed: float
    ended: float | None
    state: str | None
    message: str | None
    core_seconds: float | None
    handle: dict[str, Any] | None  # the backend's own


@dataclass(frozen=True, slots=True)
class Token:
    """A token as it is kept: never the secret itself."""

    name: str
    scope: str
    created: float
    revoked: float | None


# --- rows ------------------------------------------------------------------------------------------------


compact = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode

NAMES = [column.name for column in jobs.c]
COLUMNS = ", ".join(f'"{name}"' for name in NAMES)
LISTS = ("$.particles.centres", "$.particles.radii", "$.particles.sizes")  # most of a large case
WITHOUT = sa.func.json_remove(jobs.c.case, *LISTS).label("case")
MADE_BY = sa.func.json_extract(jobs.c.result, "$.revision").label("revision")
POROSITY = sa.func.json_extract(jobs.c.result, "$.pack_porosity").label("porosity")
OLD_CASE = sa.case((MADE_BY != REVISION, WITHOUT)).label("case")  # where the revision does not tell all
BRIEF = [WITHOUT if column.name == "case" else column for column in jobs.c]


def record(row: Row[Any]) -> Job:
    """A job from a row of SQLAlchemy's."""
    values = row._mapping
    return Job(
        seq=values["seq"], id=values["id"], name=values["name"], identity=values["identity"],
        state=State(values["state"]), message=values["message"], priority=values["priority"], ranks=values["ranks"],
        tags=tuple(values["tags"]), time_limit=values["time_limit"], attempt=values["attempt"],
        failures=values["failures"], retrying=values["retrying"], stopping=values["stopping"],
        created=values["created"], started=values["started"], ended=values["ended"],
        core_seconds=values["core_seconds"], result=values["result"], case=values["case"],
        owner=values["owner"], origin=values["origin"], bytes=values["bytes"],
    )  # fmt: skip


def unpacked(values: dict[str, Any]) -> Job:
    """A job from what SQLite keeps."""
    values |= {"state": State(values["state"]), "tags": tuple(json.loads(values["tags"]))}
    values |= {"retrying": bool(values["retrying"]), "stopping": bool(values["stopping"])}
    return Job(**{**values, "result": json.loads(values["result"])})


WHOLE = 16  # characters of an identity that an id begins with


# --- finding ---------------------------------------------------------------------------------------------


def by_seq(connection: Connection, seq: int) -> Job:
    """Of a number that there is."""
    return record(connection.execute(sa.select(jobs).where(jobs.c.seq == seq)).one())


def find_job(connection: Connection, identifier: str) -> Job:
    """By its id, or by the first characters of it where they suffice. Raises `NotFoundError`."""
    row = connection.execute(sa.select(jobs).where(jobs.c.id == identifier)).first()
    if row is None and 4 <= len(identifier) < WHOLE:  # a whole id is nobody else's beginning, once its job is gone
        near = sa.select(jobs).where(jobs.c.id > identifier, jobs.c.id < identifier + "\uffff").limit(2)
        found = connection.execute(near).all()
        row = found[0] if len(found) == 1 else None
    if row is None:
        raise NotFoundError(f"job {identifier!r}: there is none, or several begin so")
    return record(row)


def attempts_of(connection: Connection, job: Job) -> list[Attempt]:
    """First to last."""
    query = sa.select(attempts).where(attempts.c.job == job.seq).order_by(attempts.c.number)
    return [
        Attempt(job.id, row.number, tuple(row.cores), row.claimed, row.ended, row.state, row.message,
                row.core_seconds, row.handle)
        for row in connection.execute(query)
    ]  # fmt: skip


def find_sweep(connection: Connection, identifier: str) -> SweepRecord:
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
        row.seq, row.id, row.name, row.definition, row.duplicates, row.created, row.owner, sum(states.values()), states
    )
