"""New jobs and sweeps. A point of a sweep that some job has already shares it."""

import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from ..jobs.states import Job, NewJob, State, older_revision
from .changes import retried, set_columns
from .keys import known, remember, reused
from .records import (
    MADE_BY,
    OLD_CASE,
    WHOLE,
    Key,
    KeyReusedError,
    NewPoint,
    SweepRecord,
    by_seq,
    compact,
    find_job,
    find_sweep,
    record,
)
from .schema import events, idempotency, jobs, sweep_jobs, sweeps
from .writer import Share, Transaction, Writer

MOST_TAGS = 50  # of a job


@dataclass(frozen=True)
class _Submission:
    """A job to be queued."""

    job: NewJob
    key: Key | None


class Submissions(Writer):
    """Part of the store."""

    def submit(self, job: NewJob, key: Key | None = None) -> "Future[Job]":
        """Queue a job. With a key that came before, the job it made then. Raises `KeyReusedError`."""
        return self.put(Share(_submit, _Submission(job, key), Future()))

    def reuse(
        self, job: NewJob, key: Key | None = None, shared: bool = True, recompute: bool = False
    ) -> "Future[Job]":
        """The job that there is of this case, or a new one; `shared`, `recompute` and what is tried again as in
        `submit_sweep`.
        """

        def effect(t: Transaction) -> Job:
            if (before := known(t, key)) is not None:
                return find_job(t.connection, before)
            mine = () if shared else (jobs.c.owner.is_not_distinct_from(job.owner),)
            seq = _jobs_of_points(t, [NewPoint(job, {})], recompute, mine)[job.identity]
            found = by_seq(t.connection, seq)
            remember(t, key, found.id)
            return found

        return self.write(effect)

    def rerun(self, identifier: str, owner: str | None, key: Key | None = None) -> "Future[Job]":
        """Queue the case of a job once more, from its start, as a job of its own."""

        def effect(t: Transaction) -> Job:
            if (before := known(t, key)) is not None:
                return find_job(t.connection, before)
            old = find_job(t.connection, identifier)
            asked = {name: getattr(old, name) for name in ("case", "identity", "name", "ranks", "priority", "tags")}
            [job] = _insert(t, [NewJob(**asked, time_limit=old.time_limit, owner=owner, origin=old.id)])
            remember(t, key, job.id)
            return job

        return self.write(effect)

    def submit_sweep(
        self, name: str, definition: str, points: Sequence[NewPoint], duplicates: int = 0, key: Key | None = None,
        owner: str | None = None, shared: bool = True, recompute: bool = False,
    ) -> "Future[SweepRecord]":  # fmt: skip
        """Queue the points of a sweep that no job has yet; jobs of the same case that were not done are tried again.

        shared: whether jobs of other owners count. recompute: what another revision of the solver computed does not.
        """

        def effect(t: Transaction) -> SweepRecord:
            if (before := known(t, key)) is not None:
                return find_sweep(t.connection, before)
            row = _insert_sweep(t, name, definition, duplicates, owner)
            seq, identifier = row["seq"], row["id"]
            mine = () if shared else (jobs.c.owner.is_not_distinct_from(owner),)
            numbers = _jobs_of_points(t, points, recompute, mine)
            members = [(numbers[point.job.identity], point.job.name, dict(point.parameters)) for point in points]
            t.note("sweep", **row, points=members)
            rows = [
                {"sweep": seq, "position": i, "job": job, "name": label, "parameters": compact(parameters)}
                for i, (job, label, parameters) in enumerate(members)
            ]
            t.add(sweep_jobs, rows)
            remember(t, key, identifier)
            return find_sweep(t.connection, identifier)

        return self.write(effect)


# --- pieces of transactions -------------------------------------------------------------------------------


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
            places.append(reused(key))
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
        else find_job(t.connection, place)
        for place in places
    ]  # fmt: skip


def _insert(t: Transaction, new: Sequence[NewJob]) -> list[Job]:
    """Queue jobs. The id is the beginning of the identity, with a number where a case comes again."""
    now, made = time.time(), list[dict[str, Any]]()
    base = times_before(t, [job.identity for job in new])
    for job in new:
        base[job.identity] = again = base.get(job.identity, 0) + 1
        made.append(
            {"id": job.identity[:WHOLE] + (f"-{again}" if again > 1 else ""), "name": job.name,
             "identity": job.identity,
             "state": State.QUEUED.value, "priority": job.priority, "ranks": job.ranks, "tags": job.tags,
             "time_limit": job.time_limit, "attempt": 0, "failures": 0, "retrying": False, "stopping": False,
             "created": now, "result": {}, "case": job.case, "owner": job.owner, "origin": job.origin}
        )  # fmt: skip
    if not made:
        return []
    t.add(jobs, [{**row, "tags": compact(row["tags"]), "result": "{}"} for row in made])
    [(last,)] = t.ask("SELECT max(seq) FROM jobs")
    numbers = range(last - len(made) + 1, last + 1)
    t.add(events, [{"job": seq, "at": now, "state": "queued"} for seq in numbers])
    for seq, row in zip(numbers, made, strict=True):
        t.note("job", seq=seq, **row)
    t.durable = True
    empty = {"message": None, "started": None, "ended": None, "core_seconds": None, "state": State.QUEUED}
    return [Job(**{**row, **empty, "seq": seq}) for seq, row in zip(numbers, made, strict=True)]


def times_before(t: Transaction, which: Sequence[str]) -> dict[str, int]:
    """How many jobs each identity has had, those that are gone too."""
    found: dict[str, int] = {}
    for k in range(0, len(which), 500):
        part = which[k : k + 500]
        marks = ", ".join("?" * len(part))
        for table in ("jobs", "removed"):
            query = f"SELECT identity, count(*) FROM {table} WHERE identity IN ({marks}) GROUP BY identity"
            for identity, count in t.ask(query, part):
                found[identity] = found.get(identity, 0) + count
    return found


def existing(
    connection: Connection, which: Sequence[str], recompute: bool = False, *among: sa.ColumnElement[bool]
) -> dict[str, int]:
    """The seq of a job of each identity that has one of use: one that is done, or on its way; of equals the newest."""
    best: dict[str, tuple[int, int]] = {}
    asked = jobs.c.seq, jobs.c.identity, jobs.c.state, jobs.c.retrying, MADE_BY, OLD_CASE
    for k in range(0, len(which), 500):
        same = jobs.c.identity.in_(which[k : k + 500])
        for row in connection.execute(sa.select(*asked).where(same, *among)):
            rank = _use(State(row.state), row.retrying, row.revision, row.case, recompute), row.seq
            best[row.identity] = max(best.get(row.identity, (0, 0)), rank)
    return {identity: seq for identity, (use, seq) in best.items() if use}


def _use(state: State, retrying: bool, revision: int | None, case: str | None, recompute: bool) -> int:
    """Of what use a job is to whoever wants its case computed: 0 none, 3 all.

    What another revision computed stands in, unless it is to be computed anew; where it failed, this one may not.
    """
    going = retrying or state is State.QUEUED or state.active
    if older_revision(revision, case) is not None:
        return 0 if recompute or not (going or state is State.SUCCEEDED) else 2
    return 3 if state is State.SUCCEEDED else 2 if going else 1


def _jobs_of_points(
    t: Transaction, points: Sequence[NewPoint], recompute: bool, among: Sequence[sa.ColumnElement[bool]]
) -> dict[str, int]:
    """The seq of a job for each point's identity: an old one where there is one, tried again if it did not get done.

    Whoever queued the old one may have wished for less: it gets the priority, the time and the ranks asked for now.
    """
    asked = {point.job.identity: point.job for point in points}
    numbers = existing(t.connection, list(asked), recompute, *among)
    old = list(numbers.values())
    undone = jobs.c.state.in_([State.ERROR, State.LOST, State.CANCELLED, State.TIMED_OUT]) & ~jobs.c.retrying
    waiting = (jobs.c.state == State.QUEUED) | jobs.c.retrying
    urgent = max((job.priority for job in asked.values()), default=0)
    modest = waiting & ((jobs.c.priority < urgent) | jobs.c.time_limit.is_not(None))
    small = (jobs.c.state == State.FAILED) & (jobs.c.ranks < max((job.ranks for job in asked.values()), default=1))
    if any(job.tags for job in asked.values()):
        _tag(t, old, asked)
    for k in range(0, len(old), 500):
        query = sa.select(jobs).where(jobs.c.seq.in_(old[k : k + 500]), undone | modest | small)
        for row in t.run(query).all():
            job, more = record(row), _more(row, asked[row.identity])
            if job.state is State.QUEUED or job.retrying:
                if more:
                    set_columns(t, job, **more)
            elif job.state is not State.FAILED:
                retried(t, job, **more)
            elif job.ranks < asked[job.identity].ranks:  # it may have been short of memory, which goes with the ranks
                retried(t, job, **more, ranks=asked[job.identity].ranks)
    missing: dict[str, NewJob] = {}
    for point in points:
        if point.job.identity not in numbers:
            missing.setdefault(point.job.identity, point.job)
    new = _insert(t, list(missing.values()))
    return numbers | {job.identity: job.seq for job in new}


def _tag(t: Transaction, old: Sequence[int], asked: dict[str, NewJob]) -> None:
    """Give shared jobs the tags that are asked for now, too: they are looked for by them."""
    for k in range(0, len(old), 500):
        for row in t.run(sa.select(jobs).where(jobs.c.seq.in_(old[k : k + 500]))).all():
            tags = list(dict.fromkeys([*row.tags, *asked[row.identity].tags]))
            if len(row.tags) < len(tags) <= MOST_TAGS:
                set_columns(t, record(row), tags=tags)


def _more(job: Any, asked: NewJob) -> dict[str, Any]:
    """What a job lacks of the priority and the time that are asked for."""
    more: dict[str, Any] = {}
    if asked.priority > job.priority:
        more["priority"] = asked.priority
    if job.time_limit is not None and (asked.time_limit is None or asked.time_limit > job.time_limit):
        more["time_limit"] = asked.time_limit
    return more


def _insert_sweep(t: Transaction, name: str, definition: str, duplicates: int, owner: str | None) -> dict[str, Any]:
    seq = t.last_number("sweeps") + 1
    row = {"seq": seq, "id": f"s{seq}", "name": name, "definition": definition, "duplicates": duplicates}
    row |= {"created": time.time(), "owner": owner}
    t.run(sweeps.insert(), [row])
    t.durable = True
    return row
