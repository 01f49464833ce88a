"""What the service bears, printed and not asserted: `python tests/benchmarks/bench_service.py [NAME ...]`."""

import asyncio
import http.client
import json
import multiprocessing
import os
import random
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import closing
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import httpx2
from asking import PACKING, Process
from soak import of_data, soak

from frit.service.index.records import NewPoint
from frit.service.index.store import Store
from frit.service.jobs.engine import Engine
from frit.service.jobs.states import Job, NewJob, State
from frit.service.settings import Settings
from frit.solver.case import parse_case
from frit.solver.variations import case_text, identity, written
from frit.sweeps.definition import parse_sweep
from frit.sweeps.expand import expand

JOBS = 100_000
POSTS, CONNECTIONS = 5000, 32
TREE = parse_case(PACKING)
TEXTS = {name: written(table) for name, table in TREE.tables().items()}


def new_job(number: int, dice: random.Random) -> NewJob:
    """Of a packing whose mean radius is anything from 8 to 12 nm; the identity is made up."""
    text = case_text("pack", TEXTS).replace('"mean_radius": 8.0', f'"mean_radius": {8 + 4 * dice.random()}')
    made_up = f"{number:016x}{identity(TEXTS)[16:]}"
    return NewJob(text, made_up, f"pack {number}", priority=dice.randrange(3))


# --- submissions ------------------------------------------------------------------------------------------


def load(port: int, posts: int, connections: int, answers: Any) -> None:
    """In a process of its own: that many POSTs over that many kept connections, one at a time on each."""
    async def one(count: int, body: bytes) -> list[float]:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        lines = ("Host: 127.0.0.1", "Content-Type: application/json", f"Content-Length: {len(body)}", "", "")
        head = "\r\n".join(("POST /v1/jobs HTTP/1.1", *lines))
        times = []
        for _ in range(count):
            start = time.perf_counter()
            writer.write(head.encode() + body)
            answer = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
            await reader.readexactly(int(answer.partition("content-length: ")[2].partition("\r\n")[0]))
            assert answer.startswith("http/1.1 201"), answer
            times.append(time.perf_counter() - start)
        writer.close()
        return times

    async def all_of_them() -> list[float]:
        body = json.dumps({"case": PACKING}).encode()
        found = await asyncio.gather(*(one(posts // connections, body) for _ in range(connections)))
        return [seconds for times in found for seconds in times]

    start = time.perf_counter()
    times = sorted(asyncio.run(all_of_them()))
    answers.put((len(times) / (time.perf_counter() - start), times))


def submissions() -> None:
    """POST /v1/jobs per second on one worker."""
    with tempfile.TemporaryDirectory() as folder:
        server = Process(Path(folder), free_disk=1 << 62)
        server.start()
        try:
            for _ in range(2):
                answers: Any = multiprocessing.Queue()
                sender = multiprocessing.Process(target=load, args=(server.port, POSTS, CONNECTIONS, answers))
                sender.start()
                rate, times = answers.get()
                sender.join()
                print(f"POST /v1/jobs: {rate:.0f} per second; half within {times[len(times) // 2] * 1e3:.1f} ms,"
                      f" 99 % within {times[len(times) * 99 // 100] * 1e3:.1f} ms")  # fmt: skip
        finally:
            server.end()


# --- sweeps -----------------------------------------------------------------------------------------------


def sweeps() -> None:
    """A sweep of 10 000 points, expanded and stored."""
    density, seeds = {"linspace": [0.4, 0.7, 100]}, list(range(100))
    drawn = {
        "particles.packing_density": (0.4, 0.7), "particles.mean_radius": (7.0, 9.0), "model.D_surf": (1.0, 8.0),
        "model.k": (50.0, 150.0), "time.end": (0.5, 2.0),
    }  # fmt: skip
    ranges = {key: {"low": low, "high": high} for key, (low, high) in drawn.items()}
    definitions: dict[str, dict[str, Any]] = {
        "grid of density and seed": {"axes": {"particles.packing_density": density, "particles.seed": seeds}},
        "grid of density and k": {"axes": {"particles.packing_density": density, "model.k": {"linspace": [1, 9, 100]}}},
        "sobol over three tables": {"axes": ranges, "sample": {"method": "sobol", "points": 10_000}},
    }
    for name, definition in definitions.items():
        sweep = parse_sweep({"name": name, "base": PACKING, **definition})
        for _ in range(3):
            start = time.perf_counter()
            expansion = expand(sweep)
            expanded = time.perf_counter() - start
            with tempfile.TemporaryDirectory() as folder, closing(Store(Path(folder))) as store:
                start = time.perf_counter()
                points = [NewPoint(NewJob(p.case, p.identity, p.name), p.parameters) for p in expansion.points]
                store.submit_sweep(name, sweep.resolved_json(), points).result()
                stored = time.perf_counter() - start
            both = f"expanded {expanded:.2f} s, stored {stored:.2f} s, together {expanded + stored:.2f} s"
            print(f"{len(points)} points, {name}: {both}")


# --- pages ------------------------------------------------------------------------------------------------


def filled(folder: Path) -> None:
    """An index of many jobs, nine in ten of them ended with a result."""
    dice, store, start = random.Random(2), Store(folder), time.perf_counter()
    made: list[Future[Job]] = [store.submit(new_job(number, dice)) for number in range(JOBS)]
    wait(made)
    print(f"{JOBS} jobs stored in {time.perf_counter() - start:.1f} s")
    store.close()
    with closing(sqlite3.connect(folder / "frit.db")) as connection, connection:
        rows = [
            (json.dumps({"time": 1.0, "vacancy_ratio": dice.random(), "free_energy": 840.0, "wall_time": 3.0}), seq + 1)
            for seq in range(JOBS) if seq % 10
        ]  # fmt: skip
        connection.executemany("UPDATE jobs SET state = 'succeeded', result = ? WHERE seq = ?", rows)


def pages() -> None:
    """GET /v1/jobs: a page of 50 of 100 000 jobs, over HTTP."""
    queries = {
        "plain": "", "state": "state=queued", "many by radius": "particles.mean_radius.ge=9",
        "few by radius": "particles.mean_radius.ge=11.999", "many by result": "result.vacancy_ratio.le=0.5",
        "few by result": "result.vacancy_ratio.le=0.0005",
        "state and result": "state=succeeded&result.vacancy_ratio.le=0.01",
        "order by result": "order=result.vacancy_ratio&state=succeeded",
        "order by radius": "order=-particles.mean_radius",
        "order by name": "order=name", "tag nobody has": "tag=x", "other key, nobody": "model.k=3",
        "other key, all": "model.k.ge=3", "other key, none not": "model.k.ne=100", "order by that key": "order=model.k",
        "order by end": "order=-ended", "order by priority": "order=-priority", "name": "name.ne=x",
        "two keys": "model.k=3&priority=1", "order, few queued": "order=name&state=failed",
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        filled(Path(folder))
        server = Process(Path(folder), free_disk=1 << 62)
        server.start()
        try:
            with closing(http.client.HTTPConnection("127.0.0.1", server.port)) as connection:
                for query in queries.values():  # once, so that the indices are made that are missing
                    connection.request("GET", f"/v1/jobs?{query}")
                    connection.getresponse().read()
                httpx2.post(f"{server.url}/v1/jobs", json={"case": PACKING}, timeout=60.0)  # answered after them
                for name, query in queries.items():
                    times, found = asked(connection, f"/v1/jobs?{query}")
                    middle, worst = times[len(times) // 2] * 1e3, times[-1] * 1e3
                    print(f"page of {found:2d}, {name:22}{middle:8.1f} ms (worst {worst:.1f})")
        finally:
            server.end()


def asked(connection: http.client.HTTPConnection, path: str) -> tuple[list[float], int]:
    """Sorted times of the same question asked eleven times, and the jobs on the page."""
    times, found = [], 0
    for _ in range(11):
        start = time.perf_counter()
        connection.request("GET", path)
        body = connection.getresponse().read()
        times.append(time.perf_counter() - start)
        found = len(json.loads(body)["jobs"])
    return sorted(times), found


# --- jobs that do nothing ---------------------------------------------------------------------------------

STAND_IN = """#!/bin/sh
[ "$1" = --version ] && exit
for word; do [ "$before" = --out ] && break; before=$word; done
%s
printf '{"state": "done"}' > "$word/run.json"
"""


def stand_in(folder: Path, work: str) -> None:
    """In the place of mpirun and the solver: a shell script that records the end of a run."""
    program = folder / "stand-in"
    program.write_text(STAND_IN % work)
    program.chmod(0o755)
    os.environ["FRIT_MPIRUN"] = str(program)


def no_op(count: int = 500, cores: int = 16) -> None:
    """No-op jobs per second through the local backend: claim, runner, stand-in, exit record, index."""

    async def run(folder: Path) -> float:
        async with Engine(Settings(data=folder / "data", cores=cores, free_disk=0)) as engine:
            engine.scheduler.open, dice = False, random.Random(4)
            made = [engine.store.submit(new_job(number, dice)) for number in range(count)]
            await asyncio.gather(*map(asyncio.wrap_future, made))
            start, engine.scheduler.open = time.perf_counter(), True
            engine.notifier.notify()
            while engine.store.count(State.SUCCEEDED) < count:
                await asyncio.sleep(0.05)
            return time.perf_counter() - start

    with tempfile.TemporaryDirectory() as folder:
        stand_in(Path(folder), "")
        print(f"no-op jobs: {count / asyncio.run(run(Path(folder))):.0f} per second on {cores} slots")


def restart(queued: int = 10_000) -> None:
    """From the start of the process to /readyz, with that many jobs queued."""
    with tempfile.TemporaryDirectory() as folder:
        stand_in(Path(folder), "sleep 600")
        store, dice = Store(Path(folder)), random.Random(3)
        wait([store.submit(new_job(number, dice)) for number in range(queued)])
        store.close()
        for _ in range(3):
            server = Process(Path(folder), free_disk=0)
            start = time.perf_counter()
            server.start()
            while httpx2.get(f"{server.url}/readyz").status_code != 200:
                time.sleep(0.01)
            print(f"ready {time.perf_counter() - start:.2f} s after the start, {queued} jobs queued")
            server.end()
        for process in of_data(Path(folder)):  # what the stand-ins left running
            process.kill()


def long_soak() -> None:
    """A thousand kills, as test_soak.py has three hundred; an error where it does not go well. Not among all."""
    with tempfile.TemporaryDirectory() as folder:
        print(soak(Path(folder), count=100, kills=1000, steps=3000))


BENCHES: dict[str, Callable[[], None]] = {
    "submissions": submissions, "sweeps": sweeps, "pages": pages, "no-op": no_op, "restart": restart,
    "soak": long_soak,
}  # fmt: skip

if __name__ == "__main__":
    for name in sys.argv[1:] or [name for name in BENCHES if name != "soak"]:
        BENCHES[name]()
