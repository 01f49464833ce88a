"""The index against a plain Python model under random sequences of what can happen; and its journal against itself."""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, multiple, rule
from indexing import LIMIT, done, is_whole, new, points, rows

from frit.service.index.reindex import rebuild
from frit.service.index.store import Store
from frit.service.jobs.states import Exit, Move, TransitionError

NUMBERS = st.integers(0, 4)
ENDS = {
    "succeed": "succeeded", "fail": "failed", "time_out": "timed_out", "stop": "cancelled", "release": "queued",
    "break": "error", "lose": "lost",
}  # fmt: skip
TABLES = ["sweeps", "jobs", "sweep_jobs", "attempts", "events"]


@dataclass
class Model:
    """What is to be known of a job."""

    number: int
    state: str = "queued"
    attempt: int = 0
    failures: int = 0
    retrying: bool = False
    stopping: bool = False

    def go(self, state: str, **changes: Any) -> None:
        self.state, self.retrying = state, False
        for name, value in changes.items():
            setattr(self, name, value)


GOING = ("queued", "starting", "running")


class Index(RuleBasedStateMachine):
    """Every rule is told to the store and to the model."""

    ids = Bundle("ids")

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        shutil.copy(EMPTY[0], self.folder / "frit.db")
        self.store = Store(self.folder)
        self.jobs: dict[str, Model] = {}
        self.sweeps: list[list[str]] = []

    def add(self, number: int) -> str:
        again = sum(job.number == number for job in self.jobs.values())
        identifier = new(number).identity[:16] + (f"-{again + 1}" if again else "")
        self.jobs[identifier] = Model(number)
        return identifier

    @initialize(target=ids)
    def begin(self) -> Any:
        return multiple(*(self.submit_number(number) for number in range(3)))

    @rule(target=ids, number=NUMBERS)
    def submit(self, number: int) -> str:
        return self.submit_number(number)

    def submit_number(self, number: int) -> str:
        expected = self.add(number)
        assert done(self.store.submit(new(number))).id == expected
        return expected

    @rule(target=ids, numbers=st.lists(NUMBERS, max_size=6))
    def sweep(self, numbers: list[int]) -> Any:
        before, members = set(self.jobs), []
        for number in numbers:
            same = [i for i, job in self.jobs.items() if job.number == number]
            good = [i for i in same if self.jobs[i].state == "succeeded"]
            going = [i for i in same if self.jobs[i].retrying or self.jobs[i].state in GOING]
            one = (good or going or same or [self.add(number)])[-1]
            job = self.jobs[one]
            if job.state in ("error", "lost", "cancelled", "timed_out") and not job.retrying:
                job.go("queued", failures=0)
            members.append(one)
        self.sweeps.append(members)
        done(self.store.submit_sweep("s", "{}", points(*numbers)))
        return multiple(*(set(self.jobs) - before))

    @rule(one=ids)
    def claim(self, one: str) -> None:
        job = self.jobs[one]
        claimed = done(self.store.claim([(self.store.job(one).seq, (0,))]))
        assert bool(claimed) == (job.state == "queued")
        if claimed:
            job.go("starting", attempt=job.attempt + 1)

    @rule(one=ids, moves=st.lists(st.sampled_from(sorted(ENDS)), min_size=1, max_size=4))
    def whole_attempts(self, one: str, moves: list[str]) -> None:
        for move in moves:
            self.requeue(one, 0)
            self.claim(one)
            self.start(one, 0)
            self.finish(one, move, 0)

    @rule(one=ids, late=st.sampled_from([0, 0, 0, 1]))
    def start(self, one: str, late: int) -> None:
        job = self.jobs[one]
        done(self.store.start(one, job.attempt - late, {"pid": 1}))
        if job.state == "starting" and not late:
            job.go("running")

    @rule(one=ids, move=st.sampled_from(sorted(ENDS)), late=st.sampled_from([0, 0, 0, 1]))
    def finish(self, one: str, move: str, late: int) -> None:
        job = self.jobs[one]
        done(self.store.finish(one, Exit(job.attempt - late, Move(move), None, 1.0, 1.0), LIMIT))
        if late or job.state not in ("starting", "running"):
            return
        broke = move in ("break", "lose") and not job.stopping
        unwanted = job.stopping and move in ("break", "lose", "release")
        failures = job.failures + 1 if broke else 0
        job.go("cancelled" if unwanted else ENDS[move], failures=failures, stopping=False)
        job.retrying = broke and failures < LIMIT

    @rule(one=ids, late=st.sampled_from([0, 0, 1]))
    def requeue(self, one: str, late: int) -> None:
        job = self.jobs[one]
        done(self.store.requeue(one, job.attempt - late))
        if job.retrying and not late:
            job.go("queued")

    @rule(one=ids)
    def cancel(self, one: str) -> None:
        job = self.jobs[one]
        if job.state in ("succeeded", "failed", "timed_out") or (
            job.state in ("error", "lost") and not job.retrying
        ):
            with pytest.raises(TransitionError):
                done(self.store.cancel(one))
            return
        done(self.store.cancel(one))
        if job.state in ("starting", "running"):
            job.stopping = True
        else:
            job.go("cancelled")

    @rule(one=ids)
    def retry(self, one: str) -> None:
        job = self.jobs[one]
        if job.state in ("queued", "starting", "running", "succeeded"):
            with pytest.raises(TransitionError):
                done(self.store.retry(one))
        else:
            done(self.store.retry(one))
            job.go("queued", failures=0)

    @rule()
    def open_again(self) -> None:
        self.store.close()
        self.store = Store(self.folder)

    @invariant()
    def they_agree(self) -> None:
        found = {
            job.id: Model(int(job.identity[:8], 16), job.state, job.attempt, job.failures, job.retrying, job.stopping)
            for job in self.store.jobs(limit=1000)
        }
        assert found == self.jobs
        sweeps = [sweep.id for sweep in reversed(self.store.sweeps(limit=1000))]
        assert [[point.job.id for point in self.store.sweep_points(each)] for each in sweeps] == self.sweeps

    def teardown(self) -> None:
        self.store.close()
        path = self.folder / "frit.db"
        before = {table: rows(path, table) for table in TABLES}
        made = rebuild(self.folder, LIMIT)
        after = {table: rows(path, table) for table in TABLES}
        for each in (before, after):
            each["attempts"].sort(key=lambda row: (row["job"], row["number"]))
        assert made.problems == ([] if before["jobs"] or before["sweeps"] else made.problems)
        assert after == before
        assert is_whole(path)
        shutil.rmtree(self.folder)


EMPTY: list[Path] = []


@pytest.fixture(autouse=True, scope="module")
def _empty(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("empty")
    Store(folder).close()
    EMPTY[:] = [folder / "frit.db"]


TestIndex = Index.TestCase
TestIndex.settings = settings(
    max_examples=10, stateful_step_count=25, deadline=None, suppress_health_check=[HealthCheck.too_slow],
    phases=[Phase.generate],  # each step flushes the disk: a failure is shown as it was found
)  # fmt: skip
