"""What happens to jobs once they are queued. Every method gives a future, done once the change is durable."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

import sqlalchemy as sa

from ..jobs.states import Exit, Job, Move, State, TransitionError, after
from .keys import known, remember
from .records import COLUMNS, NAMES, Key, NotFoundError, by_seq, compact, find_job, find_sweep, record, unpacked
from .schema import attempts, events, history, jobs, snapshots, sweep_jobs
from .writer import Share, Transaction, Writer


@dataclass(frozen=True)
class _Start:
    """An attempt whose runner has recorded itself."""

    job: str
    attempt: int
    handle: Mapping[str, Any]


@dataclass(frozen=True)
class _End:
    """An attempt that has ended."""

    job: str
    end: Exit
    attempts_limit: int
    result: Mapping[str, Any] | None
    size: int | None


May = Callable[[str | None], bool]
"""Whether who asks may change what this owner has."""


class Changes(Writer):
    """Part of the store."""

    def claim(self, choices: Sequence[tuple[int, tuple[int, ...]]]) -> "Future[list[Job]]":
        """Give queued jobs (by seq) their cores. One that is not queued any more is left out."""

        def effect(t: Transaction) -> list[Job]:
            cores, now, rows, moves = dict(choices), time.time(), list[dict[str, Any]](), Moves(t)
            for job in all_with(t, "seq", list(cores)):
                if job.state is State.QUEUED:
                    number, started = job.attempt + 1, job.started or now
                    moves.add(job, Move.CLAIM, None, attempt=number, started=started, ended=None)
                    row = {"job": job.seq, "number": number, "cores": list(cores[job.seq]), "claimed": now}
                    t.note("attempt", **row)
                    rows.append({**row, "cores": compact(row["cores"])})
            t.add(attempts, rows)
            return moves.made()

        return self.write(effect)

    def start(self, identifier: str, attempt: int, handle: Mapping[str, Any]) -> "Future[Job]":
        """The runner of an attempt has recorded itself. Told twice it counts once."""
        return self.put(Share(_start, _Start(identifier, attempt, handle), Future()))

    def finish(
        self, identifier: str, end: Exit, attempts_limit: int, result: Mapping[str, Any] | None = None,
        size: int | None = None,
    ) -> "Future[Job]":  # fmt: skip
        """An attempt has ended. Told twice, or of an attempt that is not the present one, it counts once.

        result: the scalars by which the job is found from now on; None: those it has. size: bytes of its directory.
        """
        return self.put(Share(_finish, _End(identifier, end, attempts_limit, result, size), Future()))

    def requeue(self, identifier: str, attempt: int) -> "Future[Job]":
        """The pause after a broken attempt is over."""

        def effect(t: Transaction) -> Job:
            job = find_job(t.connection, identifier)
            if job.attempt != attempt or not job.retrying:
                return job
            return move_to(t, job, Move.REQUEUE, job.message, retrying=False)

        return self.write(effect)

    def cancel(self, identifier: str, key: Key | None = None) -> "Future[Job]":
        """End a job: at once where it has no cores, else it is marked and its runner must be told.

        Raises `TransitionError` where it has ended already. With a key that came before nothing more is done.
        """

        def effect(t: Transaction) -> Job:
            if (before := known(t, key)) is not None:
                return find_job(t.connection, before)
            job = find_job(t.connection, identifier)
            remember(t, key, job.id)
            return job if job.state is State.CANCELLED else _cancelled(t, job)

        return self.write(effect)

    def cancel_sweep(self, identifier: str, may: May, key: Key | None = None) -> "Future[list[Job]]":
        """As `cancel`, of all jobs of a sweep that have not ended and that who asks may change; these."""
        return self.write(lambda t: [_cancelled(t, job) for job in _members(t, identifier, may, key) if not job.final])

    def retry_sweep(self, identifier: str, may: May, key: Key | None = None) -> "Future[list[Job]]":
        """As `retry`, of all jobs of a sweep that have ended without success and that who asks may change; these."""

        def effect(t: Transaction) -> list[Job]:
            members = _members(t, identifier, may, key)
            return [retried(t, job) for job in members if job.final and job.state is not State.SUCCEEDED]

        return self.write(effect)

    def change(self, identifier: str, values: Mapping[str, Any]) -> "Future[Job]":
        """Give a job another name, other tags or another priority."""

        def effect(t: Transaction) -> Job:
            job = find_job(t.connection, identifier)
            if values:
                set_columns(t, job, **values)
                t.durable = True
            return by_seq(t.connection, job.seq)

        return self.write(effect)

    def retry(self, identifier: str, key: Key | None = None) -> "Future[Job]":
        """Queue a job that ended without success again; it goes on from its checkpoint. Raises `TransitionError`.

        With a key that came before nothing more is done.
        """

        def effect(t: Transaction) -> Job:
            if (before := known(t, key)) is not None:
                return find_job(t.connection, before)
            job = retried(t, find_job(t.connection, identifier))
            remember(t, key, job.id)
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

        return self.write(lambda t: set_results(t, {seq: result}))


# --- pieces of transactions -------------------------------------------------------------------------------


def move_to(t: Transaction, job: Job, move: Move, message: str | None, **values: Any) -> Job:
    """Change a job's state and tell it as an event."""
    state, now = after(job.state, move), time.time()
    set_columns(t, job, event=now, state=state, message=message, **values)
    t.run(events.insert(), [{"job": job.seq, "at": now, "state": state, "message": message}])
    return replace(job, state=state, message=message, **values)


class Moves:
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
    known, moves, rows = known_jobs(t, [start.job for start in wanted]), Moves(t), list[dict[str, Any]]()
    for start in wanted:
        job = known[start.job]
        if isinstance(job, Job) and (job.attempt, job.state) == (start.attempt, State.STARTING):
            rows.append({**_of_attempt(t, job, {"handle": start.handle}), "handle": compact(start.handle)})
            known[start.job] = moves.add(job, Move.START, None)
    return _moved(t, rows, moves, [known[start.job] for start in wanted])


def _finish(t: Transaction, wanted: Sequence[_End]) -> list[Job | NotFoundError]:
    known, moves, rows = known_jobs(t, [each.job for each in wanted]), Moves(t), list[dict[str, Any]]()
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
            bytes=job.bytes if each.size is None else each.size,
        )  # fmt: skip
    set_results(t, results)
    return _moved(t, rows, moves, [known[each.job] for each in wanted])


def _moved(
    t: Transaction, rows: Sequence[Mapping[str, Any]], moves: Moves, answers: "list[Job | NotFoundError]"
) -> "list[Job | NotFoundError]":
    t.change(attempts, ["job", "number"], rows)
    moves.made()
    return answers


def _of_attempt(t: Transaction, job: Job, values: Mapping[str, Any]) -> dict[str, Any]:
    """The change of a job's present attempt."""
    row = {"job": job.seq, "number": job.attempt, **values}
    t.note("attempt", **row)
    return row


def set_results(t: Transaction, results: Mapping[int, Mapping[str, Any]]) -> None:
    """By seq: the scalars by which a job is found."""
    t.change(jobs, ["seq"], [{"seq": seq, "result": compact(result)} for seq, result in results.items()])


def all_with(t: Transaction, column: str, values: Sequence[Any]) -> list[Job]:
    """Jobs that have one of the values in the column; SQLite takes some thousands of them."""
    query = f"SELECT {COLUMNS} FROM jobs WHERE {column} IN ({', '.join('?' * len(values))})"
    return [unpacked(dict(zip(NAMES, row, strict=True))) for row in t.ask(query, values)]


def known_jobs(t: Transaction, identifiers: Sequence[str]) -> "dict[str, Job | NotFoundError]":
    """The job of each id or beginning of one."""
    known: dict[str, Job | NotFoundError] = {job.id: job for job in all_with(t, "id", identifiers)}
    for identifier in identifiers:
        if identifier not in known:
            try:
                known[identifier] = find_job(t.connection, identifier)
            except NotFoundError as error:
                known[identifier] = error
    return known


def set_columns(t: Transaction, job: Job, event: float | None = None, **values: Any) -> None:
    """Change columns of a job; `event`: when that made an event."""
    t.run(jobs.update().where(jobs.c.seq == job.seq).values(values))
    t.note("set", job=job.seq, event=event, values=values)


def _cancelled(t: Transaction, job: Job) -> Job:
    """At once where it has no cores, else it is marked."""
    if job.state in (State.ERROR, State.LOST) and not job.retrying:
        raise TransitionError(job.state, Move.CANCEL)
    t.durable = True
    if job.state.active:
        set_columns(t, job, stopping=True)
        return by_seq(t.connection, job.seq)
    return move_to(t, job, Move.CANCEL, None, retrying=False, ended=time.time())


def _members(t: Transaction, identifier: str, may: May, key: Key | None) -> list[Job]:
    """The jobs of a sweep that may be changed; none where the key came before."""
    if known(t, key) is not None:
        return []
    remember(t, key, identifier)
    mine = sa.select(sweep_jobs.c.job).where(sweep_jobs.c.sweep == find_sweep(t.connection, identifier).seq)
    return [job for row in t.run(sa.select(jobs).where(jobs.c.seq.in_(mine))) if may((job := record(row)).owner)]


def retried(t: Transaction, job: Job, **values: Any) -> Job:
    """A new life: what broke before does not count. `values`: of other columns."""
    t.durable = True
    return move_to(t, job, Move.RETRY, None, retrying=False, failures=0, ended=None, **values)
