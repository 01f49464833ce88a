"""Engines in tests: with the real solver on tiny cases, and with a stand-in where only the machinery matters."""

import asyncio
import json
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from frit.service.jobs.engine import Engine
from frit.service.jobs.states import Job, NewJob, State
from frit.service.settings import Settings
from frit.solver.case import parse_case

TIMEOUT = 120.0  # seconds; for hangs alone

# In the place of mpirun. The name of the case says what to do.
STAND_IN = f"""#!{sys.executable} -S
import json, os, signal, sys, time
if "--version" in sys.argv:
    print("HYDRA build details")
    sys.exit()
resumed = "--resume" in sys.argv
directory = sys.argv[sys.argv.index("--resume" if resumed else "--out") + 1]
with open(os.path.join(directory, "submitted.json")) as file:
    what, *rest = json.load(file)["name"].replace(":", " ").split()  # a sweep's points: "sleep 1: D_surf=2"
with open(os.path.join(directory, "calls"), "a") as file:
    file.write(f"{{os.getpid()}} {{sorted(os.sched_getaffinity(0))}} {{time.monotonic()}}\\n")

def record(state, message=None, retry=False):
    with open(os.path.join(directory, "run.new"), "w") as file:
        json.dump({{"state": state, "message": message, "retry": retry}}, file)
    os.replace(os.path.join(directory, "run.new"), os.path.join(directory, "run.json"))

def checkpoint(*_):
    with open(os.path.join(directory, "checkpoint.h5"), "w") as file:
        file.write(str(time.monotonic()))

def end(*_):
    checkpoint()
    record("interrupted", "checkpoint at t = 1")
    os._exit(0)

signal.signal(signal.SIGUSR1, checkpoint)
signal.signal(signal.SIGTERM, end)
if what == "stumbles":  # gets further each time, and is done at the last
    with open(os.path.join(directory, "calls")) as file:
        calls = len(file.readlines())
    if calls < int(rest[0]):
        checkpoint()
        if rest[1:] == ["slowly"]:
            time.sleep(1000)
        os.kill(os.getpid(), signal.SIGKILL)
if what in ("deaf", "marching"):
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
if what == "crash":
    os.kill(os.getpid(), signal.SIGSEGV)
if what == "says-no":
    record("failed", "fields left [-0.5, 1.5]")
    sys.exit(1)
if what == "disk":
    record("failed", "OSError: no space", True)
    sys.exit(1)
if what == "once" and not resumed and not os.path.exists(os.path.join(directory, "checkpoint.h5")):
    checkpoint()
    os.kill(os.getpid(), signal.SIGKILL)
if what == "marching":
    checkpoint()
    print(json.dumps({{"time": 0.0}}), flush=True)
if what in ("sleep", "deaf", "marching"):
    stop = time.monotonic() + float(rest[0])
    while time.monotonic() < stop:
        time.sleep(0.005)
record("succeeded")
"""

PAIR: dict[str, Any] = {
    "domain": {"size": [22.0, 13.0]},
    "nodes": {"spacing": 1.0},
    "particles": {"centres": [[6.5, 6.2], [15.4, 6.8]], "radii": [5.0, 4.0]},
    "time": {"integrator": "rk2", "end": 0.01, "step": 1e-4},
    "output": {"history_every": 0.001, "snapshots": [0.0, 0.01]},
}


def stand_in(folder: Path) -> str:
    """A program for FRIT_MPIRUN."""
    program = folder / "stand-in"
    program.write_text(STAND_IN)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    return str(program)


def new_job(name: str, shift: float = 0.0, steps: int = 100, **asked: Any) -> NewJob:
    """A pair of discs whose case is told from others' by the shift."""
    tree = json.loads(json.dumps(PAIR))
    tree["name"] = name
    tree["particles"]["centres"][1][0] += shift
    tree["time"]["end"] = steps * 1e-4
    tree["output"] = {"history_every": steps * 1e-5, "snapshots": [0.0, steps * 1e-4], "checkpoint_every": 0.2}
    case = parse_case(tree)
    return NewJob(json.dumps(json.loads(case.resolved_json())), case.identity(), name, **asked)


def settings(data: Path, **changes: Any) -> Settings:
    """Quick to try again, and to look."""
    quick = {"cores": 2, "backoff": 0.05, "backoff_limit": 0.1, "poll": 0.1, "grace": 20.0, "free_disk": 0}
    return Settings(data=data, **{**quick, **changes})


async def submit(engine: Engine, *jobs: NewJob) -> list[Job]:
    """Queue them, in order."""
    return [await asyncio.wrap_future(engine.store.submit(job)) for job in jobs]


async def until(engine: Engine, condition: Callable[[], bool]) -> None:
    """Wait for a condition on the index; TimeoutError is a hang."""
    async with asyncio.timeout(TIMEOUT):
        while not condition():
            await engine.notifier.wait(0.1)


async def ended(engine: Engine, *jobs: Job) -> list[Job]:
    """The jobs, once they are all final."""
    await until(engine, lambda: all(engine.store.job(job.id).final for job in jobs))
    return [engine.store.job(job.id) for job in jobs]


async def in_state(engine: Engine, job: Job, state: State) -> Job:
    """The job, once it is in the state."""
    await until(engine, lambda: engine.store.job(job.id).state is state)
    return engine.store.job(job.id)
