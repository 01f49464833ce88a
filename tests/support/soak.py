"""A sweep of small real runs, while service, runners, mpiruns and ranks are killed at random moments.

The service has its five attempts. Kills come faster than solvers start, and five in a row before a job gets further end
it, as the service promises: a job that has broken `SPARED` times in a row is no victim until it has got further.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from frit.service.index.store import Store
from frit.service.jobs.processes import start_of
from frit.service.jobs.runner import advanced
from frit.service.jobs.states import Job, NewJob, State
from frit.solver.case import parse_case
from frit.solver.durable import read_json

TREE = ("runner", "mpirun", "rank")
VICTIMS = ("service", *TREE, *TREE)
SPARED = 3  # two below the five, because a kill may come while another's end is being recorded

# The engine alone, as `frit serve` and `frit sweep run` have it inside; killed and started again by the soak.
SERVICE = """
import asyncio, sys
from frit.service.jobs.engine import Engine
from frit.service.settings import Settings

async def main():
    async with Engine(Settings(data=sys.argv[1], cores=2, backoff=0.05, backoff_limit=0.2, poll=0.2)):
        await asyncio.Event().wait()

asyncio.run(main())
"""


def new_jobs(count: int, steps: int, ranks: int = 1) -> list[NewJob]:
    """Different pairs of discs; a checkpoint whenever a fifth of a second has passed."""
    made = []
    for k in range(count):
        case = parse_case(
            {
                "name": f"pair {k}",
                "domain": {"size": [22.0, 13.0]},
                "nodes": {"spacing": 1.0},
                "particles": {"centres": [[6.5, 6.2], [15.4 + 0.01 * k, 6.8]], "radii": [5.0, 4.0]},
                "time": {"integrator": "rk2", "end": steps * 1e-4, "step": 1e-4},
                "output": {
                    "history_every": steps * 2e-6,
                    "snapshots": [0.0, steps * 1e-4],
                    "checkpoint_every": 0.2,
                },
            }
        )
        made.append(NewJob(json.dumps(json.loads(case.resolved_json())), case.identity(), case.name, ranks))
    return made


def submit(data: Path, jobs: list[NewJob]) -> None:
    """Queue the jobs while no service runs."""
    data.mkdir(parents=True, exist_ok=True)
    store = Store(data)
    for answer in [store.submit(job) for job in jobs]:
        answer.result()
    store.close()


class Service:
    """The service as a process that may be killed."""

    def __init__(self, data: Path) -> None:
        self.data = data
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, or start it again."""
        with open(self.data / "service.log", "ab") as log:
            command = [sys.executable, "-P", "-W", "error", "-c", SERVICE, str(self.data)]
            self.process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)

    def kill(self) -> None:
        """kill -9."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


@contextmanager
def service(data: Path) -> Iterator[Service]:
    """A service for the length of a block; what is left of it, and of its jobs, is killed."""
    running = Service(data)
    running.start()
    try:
        yield running
    finally:
        running.kill()
        for process in of_data(data):
            with suppress(psutil.Error):
                process.kill()


def of_data(data: Path) -> list[psutil.Process]:
    """All processes of runs in this data folder: mpirun and everything below it, wherever it hangs."""
    found, mark = [], f"FRIT_RUN={data.absolute()}/"
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if mark in Path(f"/proc/{process.pid}/environ").read_text(errors="replace"):
                found.append(process)
    return found


def runners(data: Path, spared: Collection[str] = ()) -> list[int]:
    """Pids of living runners of other jobs; one that has ended and waits for its parent's notice lives no more."""
    living = []
    for record in [read_json(path) for path in data.glob("runs/*/attempt.json") if path.parent.name not in spared]:
        with suppress(psutil.Error):
            same = start_of(record["pid"]) == record["pid_start"]
            if same and psutil.Process(record["pid"]).status() != psutil.STATUS_ZOMBIE:
                living.append(int(record["pid"]))
    return living


def of_kind(kind: str, data: Path, spared: Collection[str]) -> list[int]:
    """Pids of the mpiruns, or of the ranks, of other jobs."""
    pids = []
    for process in of_data(data):
        with suppress(psutil.Error):
            line, job = process.cmdline(), Path(process.environ()["FRIT_RUN"]).name
            first = Path(line[0]).name if line else ""
            is_rank = "frit.solver" in line and first.startswith("python")
            if job not in spared and (is_rank if kind == "rank" else first.startswith("mpirun")):
                pids.append(process.pid)
    return pids


def kill_one(kind: str, running: Service, random_: random.Random) -> str | None:
    """Kill a victim of this kind, or of another where it is not there; which kind. None: nobody is there."""
    if kind == "service":
        running.kill()
        return kind
    spared = [job.id for job in jobs_of(running.data) if is_spared(job, running.data / "runs" / job.id)]
    for other in [kind, *random_.sample(TREE, len(TREE))]:
        pids = runners(running.data, spared) if other == "runner" else of_kind(other, running.data, spared)
        if pids:
            with suppress(ProcessLookupError):
                os.kill(random_.choice(pids), signal.SIGKILL)
                return other
    return None


def is_spared(job: Job, directory: Path) -> bool:
    """Whether it has broken too often in a row, and has got no further in its present attempt either."""
    return job.failures >= SPARED and not advanced(directory, job.attempt)


def disturb(running: Service, kills: int, seconds: float, seed: int) -> Counter[str]:
    """Kill `kills` times, within about `seconds` if it can be; or until all jobs are done. A killed service is started
    again.

    Victims of all kinds come in turn, at random; where there is none, one is waited for, and no work is done meanwhile.
    """
    random_, counts = random.Random(seed), Counter[str]()
    began = time.monotonic()
    for moment in sorted(random_.uniform(0.0, seconds) for _ in range(kills)):
        time.sleep(max(0.0, began + moment - time.monotonic()))
        kind = random_.choice(VICTIMS)
        while (killed := kill_one(kind, running, random_)) is None:
            if all_done(running.data):
                return counts
            time.sleep(0.05)
        counts[killed] += 1
        if killed == "service":
            time.sleep(random_.uniform(0.0, seconds / kills))
            running.start()
    return counts


def jobs_of(data: Path) -> list[Job]:
    """All jobs, first to last, seen from outside while the service may be writing."""
    store = Store(data, writable=False)
    try:
        return store.jobs(limit=100_000)[::-1]
    finally:
        store.close()


def all_done(data: Path) -> bool:
    """Whether every job is final."""
    return all(job.final for job in jobs_of(data))


def wait(data: Path, seconds: float) -> None:
    """Until all jobs are final. Raises TimeoutError: that is a hang."""
    deadline = time.monotonic() + seconds
    while not all_done(data):
        if time.monotonic() > deadline:
            states = Counter(job.state for job in jobs_of(data))
            raise TimeoutError(f"{dict(states)} after {seconds} s; {(data / 'service.log').read_text()[-2000:]}")
        time.sleep(0.2)


def successes(data: Path) -> dict[str, int]:
    """How often each job has come to `succeeded`."""
    store = Store(data, writable=False)
    try:
        names = [job.id for job in store.jobs(limit=100_000)]
        return {name: sum(event.state is State.SUCCEEDED for event in store.events(name)) for name in names}
    finally:
        store.close()


def histories(data: Path) -> dict[str, list[dict[str, Any]]]:
    """By the job's name, from the index, which must say what the file says; without the wall time."""
    store = Store(data, writable=False)
    found = {}
    try:
        for job in store.jobs(limit=100_000):
            rows = [json.loads(line) for _, line in store.history(job.id)]
            lines = (data / "runs" / job.id / "history.jsonl").read_text().splitlines()
            assert rows == [json.loads(line) for line in lines]
            found[job.name] = [{key: value for key, value in row.items() if key != "wall_time"} for row in rows]
    finally:
        store.close()
    return found


def run_undisturbed(data: Path, jobs: list[NewJob], seconds: float) -> float:
    """The same jobs, left alone: how long they take."""
    submit(data, jobs)
    with service(data):
        began = time.monotonic()
        wait(data, seconds)
        return time.monotonic() - began


@dataclass(frozen=True)
class Report:
    """How a soak went: kills by kind, attempts of each job, seconds left alone and under fire."""

    killed: Counter[str]
    attempts: list[int]
    calm: float
    wild: float

    def __str__(self) -> str:
        kinds = ", ".join(f"{number} {kind}" for kind, number in sorted(self.killed.items()))
        return (
            f"{self.killed.total()} kills ({kinds}) over {len(self.attempts)} jobs: each succeeded once, after "
            f"{min(self.attempts)} to {max(self.attempts)} attempts, {sum(self.attempts)} in all; "
            f"{self.calm:.0f} s undisturbed, {self.wild:.0f} s under fire"
        )


def soak(folder: Path, count: int, kills: int, steps: int) -> Report:
    """Run the same jobs calmly and under fire. Every job must succeed exactly once, with the history of the calm run,
    and no process be left.

    The kills fall within nine tenths of the time that the calm jobs took, on this machine: there is always a victim.
    """
    jobs = new_jobs(count, steps)
    run_undisturbed(folder / "warm", new_jobs(1, 20), seconds=300.0)  # compiled, or read from disk
    calm = run_undisturbed(folder / "calm", jobs, seconds=3600.0)
    submit(folder / "wild", jobs)
    with service(folder / "wild") as running:
        began = time.monotonic()
        killed = disturb(running, kills, 0.9 * calm, seed=7)
        wait(folder / "wild", seconds=3600.0)
        wild = time.monotonic() - began
        assert not of_data(folder / "wild")
        assert not runners(folder / "wild")
    ended = jobs_of(folder / "wild")
    assert Counter(job.state for job in ended) == {State.SUCCEEDED: count}, [job.message for job in ended]
    assert set(successes(folder / "wild").values()) == {1}
    assert histories(folder / "wild") == histories(folder / "calm")
    assert killed.total() == kills, killed
    return Report(killed, [job.attempt for job in ended], calm, wild)
