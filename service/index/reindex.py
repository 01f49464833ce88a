"""A lost index is made again from the data folder: its journal tells what was asked and decided, the run directories
what came of it.

The journal's lines are applied one after the other; what a crash kept out of it is read from the run directories and
added to it. A runner that lives is left to the next service, which adopts it. Tokens are in neither.
"""

import json
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa

from frit.solver.case import CaseError, parse_case
from frit.solver.durable import flush, read_json

from ..jobs.engine import take
from ..jobs.processes import try_lock
from ..jobs.runner import read_exit
from ..jobs.states import State
from .journal import Journal
from .results import Reader, size_of
from .schema import attempts, events, idempotency, jobs, removed, sweep_jobs, sweeps
from .store import Store
from .writer import Transaction

T = TypeVar("T")
Row = dict[str, Any]
FRESH: Row = {
    "state": State.QUEUED, "message": None, "attempt": 0, "failures": 0, "retrying": False, "stopping": False,
    "started": None, "ended": None, "core_seconds": None, "result": {}, "owner": None, "origin": None, "bytes": None,
}  # fmt: skip
PROCESS = {"pid": "pid", "pid_start": "start", "boot": "boot"}
CLAIMED: Row = dict.fromkeys(("ended", "state", "message", "core_seconds", "handle"))


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """What was made: jobs by state, where the old database is, and what could not be understood."""

    states: dict[str, int]
    sweeps: int
    aside: Path | None
    problems: list[str]


def rebuild(data: Path, attempts_limit: int) -> Rebuilt:
    """Make frit.db of a data folder again. Raises `EngineError` where a service uses the folder, `StoreError`."""
    lock = take(data)
    try:
        return _rebuild(data.absolute(), attempts_limit)
    finally:
        os.close(lock)


def _rebuild(data: Path, attempts_limit: int) -> Rebuilt:
    folder, journal = data / "reindex.new", data / "submitted.jsonl"
    shutil.rmtree(folder, ignore_errors=True)
    book = Book()
    book.read(journal)
    added = "".join(json.dumps(line) + "\n" for line in book.find(data / "runs"))
    store = Store(folder)
    try:
        done(store.write(book.insert))
        for seq, row in book.jobs.items():
            book.take_in(store, seq, data / "runs" / row["id"], attempts_limit)
        states = {state: count for state, count in store.counts().items() if count}
    finally:
        store.close()
    with suppress(FileNotFoundError):  # the ends that no journal told
        added += store.journal.path.read_text()
    if added:
        Journal(journal).append(added)
    aside = swap(folder / "frit.db", data / "frit.db")
    shutil.rmtree(folder)
    return Rebuilt(states, len(book.sweeps), aside, book.problems)


@dataclass
class Book:
    """The rows to be, by their numbers."""

    jobs: dict[int, Row] = field(default_factory=dict)
    attempts: dict[tuple[int, int], Row] = field(default_factory=dict)
    events: list[Row] = field(default_factory=list)
    sweeps: dict[int, Row] = field(default_factory=dict)
    keys: dict[str, Row] = field(default_factory=dict)
    gone: dict[tuple[str, int], Row] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    _state: dict[int, str] = field(default_factory=dict)  # of each job's last event

    # --- the journal --------------------------------------------------------------------------------------

    def read(self, journal: Path) -> None:
        """Apply all lines; one that was torn by a crash, or makes no sense, is a problem and no more."""
        if not journal.exists():
            self.problems.append(f"{journal}: is not there: sweeps and jobs that never ran are lost")
            return
        with open(journal, encoding="utf-8", errors="replace") as file:
            for number, text in enumerate(file, 1):
                if text.strip():
                    try:
                        self.apply(json.loads(text))
                    except (ValueError, LookupError, TypeError, AttributeError) as error:
                        self.problems.append(f"{journal}: line {number} was passed over: {error!r}")

    def apply(self, line: Row) -> None:
        """One line. What a crash let the journal have and the database not came again: the later line counts."""
        line = dict(line)
        match line.pop("kind"):
            case "job":
                self._add(line)
            case "set":
                self._set(self.jobs[line["job"]], line["values"], line["event"])
            case "attempt":
                where = (line["job"], line["number"])
                if "pid" in line:  # as it was written before backends had handles
                    line["handle"] = {name: line.pop(key) for key, name in PROCESS.items()}
                self.attempts[where] = self.attempts.get(where, CLAIMED) | line
            case "sweep":
                self.sweeps[line["seq"]] = whole(sweeps, {"owner": None, **line}) | {"points": line["points"]}
            case "key":
                self.keys[line["key"]] = whole(idempotency, line)
            case "gone":
                self._lose(line)
            case kind:
                raise ValueError(f"kind = {kind!r}")

    def _lose(self, line: Row) -> None:
        """Somebody wanted it gone, and was told that it is."""
        what, seq = line.pop("what"), line["seq"]
        if what == "sweep":
            self.sweeps.pop(seq, None)
        elif self.jobs.pop(seq, None) is not None:
            self._forget(seq)
        known = self.gone.get((what, seq), {"event": -1 - len(self.gone)})  # a crash may have it told twice
        self.gone[what, seq] = whole(removed, {**line, "kind": what, "event": known["event"], "done": True})

    def _forget(self, seq: int) -> None:
        self.events = [event for event in self.events if event["job"] != seq]
        self.attempts = {where: attempt for where, attempt in self.attempts.items() if where[0] != seq}

    def _add(self, row: Row) -> None:
        seq, row = row["seq"], whole(jobs, FRESH | row)
        if seq in self.jobs:
            self._forget(seq)
        self.jobs[seq] = row
        self._tell(seq, row["created"], State.QUEUED, None)

    def _set(self, row: Row, values: Row, event: float | None) -> None:
        row |= values
        if event is not None and self._state[row["seq"]] != row["state"]:
            self._tell(row["seq"], event, row["state"], row["message"])

    def _tell(self, seq: int, at: float, state: str, message: str | None) -> None:
        self._state[seq] = state
        self.events.append({"job": seq, "at": at, "state": state, "message": message})

    # --- the run directories ------------------------------------------------------------------------------

    def find(self, runs: Path) -> Iterator[Row]:
        """Lines that the journal lacks: jobs and attempts that only the run directories know, applied."""
        for unknown in (self._unknown_jobs, self._unknown_attempts):
            for line in unknown(runs):
                self.apply(line)
                yield line

    def _unknown_jobs(self, runs: Path) -> Iterator[Row]:
        known = {row["id"] for row in self.jobs.values()}
        lost = {row["id"] for row in self.gone.values()} - known
        found = []
        for directory in sorted(path for path in runs.glob("*") if path.is_dir()):
            if directory.name in lost:  # a crash came before all of it was deleted
                shutil.rmtree(directory, ignore_errors=True)
            elif directory.name not in known:
                try:
                    found.append(job_of(directory))
                except (OSError, ValueError, LookupError, CaseError) as error:
                    self.problems.append(f"{directory}: not understood as the run directory of a job: {error!r}")
        taken = {*self.jobs, *(seq for kind, seq in self.gone if kind == "job")}
        for row in sorted(found, key=lambda row: (row["created"], row["id"])):
            if row["seq"] is None or row["seq"] in taken:
                row["seq"] = max(taken, default=0) + 1
            taken.add(row["seq"])
            yield {"kind": "job", **row}

    def _unknown_attempts(self, runs: Path) -> Iterator[Row]:
        for seq, row in self.jobs.items():
            yield from self._unknown_attempt(seq, row, read_json(runs / row["id"] / "attempt.json"))

    def _unknown_attempt(self, seq: int, row: Row, record: Row) -> Iterator[Row]:
        """Of the attempt whose runner recorded itself last: that it was claimed, that it was started."""
        number, at = record.get("attempt", 0), record.get("started")
        state = row["state"]
        if number > row["attempt"]:
            state = State.STARTING
            values = {"state": state, "message": None, "attempt": number, "retrying": False, "ended": None}
            yield {"kind": "set", "job": seq, "event": at, "values": {**values, "started": row["started"] or at}}
            yield {"kind": "attempt", "job": seq, "number": number, "cores": record["cores"], "claimed": at}
        if number and number >= row["attempt"] and state == State.STARTING:
            handle = {name: record[key] for key, name in PROCESS.items()}
            yield {"kind": "attempt", "job": seq, "number": number, "handle": handle}
            yield {"kind": "set", "job": seq, "event": at, "values": {"state": State.RUNNING, "message": None}}

    # --- the new index ------------------------------------------------------------------------------------

    def insert(self, t: Transaction) -> None:
        """All rows, in a transaction."""
        members = [
            {"sweep": seq, "position": k, "job": job, "name": name, "parameters": parameters}
            for seq, sweep in self.sweeps.items()
            for k, (job, name, parameters) in enumerate(sweep["points"])
        ]
        lost = [row for row in members if row["job"] not in self.jobs and ("job", row["job"]) not in self.gone]
        self.problems += [f"sweep s{row['sweep']}: the job of point {row['position']} is lost" for row in lost]
        plain = [whole(sweeps, row) for row in self.sweeps.values()]
        for table, rows in (
            (sweeps, plain),
            (jobs, list(self.jobs.values())),
            (sweep_jobs, [row for row in members if row["job"] in self.jobs]),
            (attempts, [row for row in self.attempts.values() if row["job"] in self.jobs and "cores" in row]),
            (events, self.events),
            (idempotency, list(self.keys.values())),
            (removed, list(self.gone.values())),
        ):
            if rows:
                t.run(table.insert(), rows)
        for table, kind in ((jobs, "job"), (sweeps, "sweep")):  # no number is given twice
            t.last_number(table.name, max((seq for what, seq in self.gone if what == kind), default=0))

    def take_in(self, store: Store, seq: int, directory: Path, attempts_limit: int) -> None:
        """What a run directory holds: history, snapshots, the end that was not told, the last values."""
        if not directory.is_dir():
            return
        row = self.jobs[seq]
        reader = Reader(directory, row["case"])
        try:
            rows, times = reader.news()
            done(store.ingest(seq, rows, times))
            state = self._end(store, row, directory, attempts_limit)
            if not state.active and (result := reader.result()):
                done(store.set_result(seq, result))
        except (ValueError, LookupError, TypeError) as error:
            self.problems.append(f"{directory}: {error!r}")

    def _end(self, store: Store, row: Row, directory: Path, attempts_limit: int) -> State:
        """The state, after an exit record of the present attempt that nobody had read, if its runner has gone."""
        state = State(row["state"])
        if not state.active or (end := read_exit(directory, row["attempt"])) is None:
            return state
        if (lock := try_lock(directory / "runner.lock")) is None:
            return state
        os.close(lock)
        return done(store.finish(row["id"], end, attempts_limit, size=size_of(directory))).state


def whole(table: sa.Table, row: Row) -> Row:
    """The row, without what is no column; `LookupError` where one is missing."""
    names = [column.name for column in table.columns]
    if missing := [name for name in names if name not in row]:
        raise LookupError(f"no {', '.join(missing)}")
    return {name: row[name] for name in names}


def job_of(directory: Path) -> Row:
    """The job of a run directory, from what the scheduler wrote there before its first attempt."""
    record = json.loads((directory / "job.json").read_text())
    case = (directory / "submitted.json").read_text()
    keys = ("name", "ranks", "priority", "tags", "time_limit", "created")
    identity = record.get("identity") or parse_case(json.loads(case), kept=True).identity()
    row = {"seq": record.get("seq"), "id": directory.name, "identity": identity, "case": case}
    row |= {key: record.get(key) for key in ("owner", "origin")}
    return row | {key: record[key] for key in keys}


def swap(new: Path, path: Path) -> Path | None:
    """Put the new database in the place of the old one, which is kept with its log: where."""
    aside = free_name(path) if path.exists() else None
    if aside is not None:
        os.link(path, aside)
    for end in ("-wal", "-shm"):  # never beside a database that they do not belong to
        with suppress(FileNotFoundError):
            if aside is not None:
                os.replace(f"{path}{end}", f"{aside}{end}")
            else:
                os.unlink(f"{path}{end}")
    os.replace(new, path)
    flush(path.parent)
    return aside


def free_name(path: Path) -> Path:
    """frit.db.aside-1, or the next number."""
    number = 1
    while (name := path.with_name(f"{path.name}.aside-{number}")).exists():
        number += 1
    return name


def done(answer: "Future[T]") -> T:
    """What a write gave."""
    return answer.result()
