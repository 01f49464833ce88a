"""An engine on a data folder, with the real solver or a stand-in that does what a file tells it to."""

import asyncio
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from frit.service.jobs.engine import Engine
from frit.service.jobs.states import Job, NewJob
from frit.service.settings import Settings
from frit.solver.case import parse_case

TIMEOUT = 120.0  # seconds; for hangs

# mpirun's place: waits while the file `hold` is beside the script, then says that the run is done; ends without a word,
# once, where the file `break` is beside it.
STAND_IN = """#!/bin/sh
[ "$1" = --version ] && exit
for word; do
    case "$before" in --out|--resume) directory=$word ;; esac
    before=$word
done
here=$(dirname "$0")
echo started >> "$directory/started.txt"
basename "$directory" >> "$here/order.txt"
rm "$here/break" 2> /dev/null && exit 1
while [ -e "$here/hold" ]; do sleep 0.02; done
echo '{"state": "done"}' > "$directory/run.json.new" && mv "$directory/run.json.new" "$directory/run.json"
"""


def stand_in(folder: Path) -> Path:
    """The script, for FRIT_MPIRUN; `hold` beside it keeps all runs waiting."""
    folder.mkdir(exist_ok=True)
    path = folder / "mpirun"
    path.write_text(STAND_IN)
    path.chmod(0o755)
    return path


def settings(data: Path, **changes: Any) -> Settings:
    """Quick, and at ease with a small disk."""
    quick = {"cores": 2, "poll": 0.05, "backoff": 0.05, "grace": 5.0, "free_disk": 0}
    return Settings(**{"data": data, **quick, **changes})


def job(case: dict[str, Any], name: str, **changes: Any) -> NewJob:
    """A case as the service takes it."""
    whole = parse_case({**case, "name": name})
    return NewJob(case=whole.resolved_json(), identity=whole.identity(), name=name, **changes)


async def submit(engine: Engine, new: NewJob) -> Job:
    """Once it is durable."""
    return await asyncio.wrap_future(engine.store.submit(new))


async def until(happened: Callable[[], bool]) -> None:
    """Wait."""
    deadline = time.monotonic() + TIMEOUT
    while not happened():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.02)


def finished(engine: Engine) -> bool:
    """Whether nothing more happens by itself, and all is taken in."""
    return all(job.final for job in engine.store.jobs(limit=1000)) and not engine.scheduler.running


def runs_of(directory: Path) -> int:
    """How often a stand-in was started there."""
    path = directory / "started.txt"
    return len(path.read_text().splitlines()) if path.exists() else 0


def end_runner(directory: Path) -> None:
    """kill -9 the runner of a run directory and wait for its end."""
    process = psutil.Process(json.loads((directory / "attempt.json").read_text())["pid"])
    os.kill(process.pid, 9)
    process.wait(TIMEOUT)
