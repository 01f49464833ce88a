"""From run directories into the index: history rows as they are written, snapshots once complete, the last values."""

import asyncio
import json
import logging
import math
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frit.solver.case import Case, parse_case
from frit.solver.durable import read_json
from frit.solver.revision import recorded

from ..jobs.states import Job
from .store import Store

logger = logging.getLogger("frit.results")


@dataclass
class Place:
    """How far a run directory has been read: complete history lines, their bytes, complete snapshots."""

    rows: int = 0
    size: int = 0
    snapshots: int = 0


class Reader:
    """Reads what one run has added; a resumed run that writes its last rows again is read from the start."""

    def __init__(self, directory: Path, case: str) -> None:
        self.directory, self.place = directory, Place()
        self._case = case
        self._times: tuple[float, ...] | None = None
        self.sound = True  # False: what it wrote cannot be read
        self._file = -1  # inode: a resumed run replaces the history by a new file

    def news(self) -> tuple[list[tuple[int, str]], list[tuple[int, float]]]:
        """New history rows (number, line) and snapshots (number, time)."""
        return self._rows(), self._snapshots()

    def _rows(self) -> list[tuple[int, str]]:
        place = self.place
        try:
            with open(self.directory / "history.jsonl", "rb") as file:
                status = os.fstat(file.fileno())  # of what was opened: the name may mean another file by now
                if status.st_ino != self._file or status.st_size < place.size:
                    self._file, place.rows, place.size = status.st_ino, 0, 0
                file.seek(place.size)
                added = file.read()
        except (FileNotFoundError, NotADirectoryError):
            return []
        whole = added[: added.rfind(b"\n") + 1]
        lines = whole.decode().splitlines()
        rows = list(enumerate(lines, place.rows))
        for number, line in rows:
            check_row(self.directory / "history.jsonl", number, line)
        place.rows, place.size = place.rows + len(lines), place.size + len(whole)
        return rows

    def _snapshots(self) -> list[tuple[int, float]]:
        """What the group's consolidated metadata shows: the one file that makes a snapshot visible."""
        group = read_json(self.directory / "snapshots.zarr" / "zarr.json")
        stored = (group.get("consolidated_metadata") or {}).get("metadata", {}).get("time", {})
        count = int((stored.get("shape") or [0])[0])
        if count <= self.place.snapshots:
            return []
        if self._times is None:
            case: Case = parse_case(json.loads(self._case), kept=True)
            self._times = case.output.snapshot_times(case.time.end)
        first, self.place.snapshots = self.place.snapshots, count
        return list(enumerate(self._times))[first:count]

    def result(self) -> dict[str, Any]:
        """The scalars of the last history row, what a packing realised, and the revision that computed it all."""
        lines = (self.directory / "history.jsonl").read_bytes().split(b"\n") if self.place.rows else []
        if len(lines) > 1:
            check_row(self.directory / "history.jsonl", len(lines) - 2, lines[-2].decode())
        last: dict[str, Any] = json.loads(lines[-2]) if len(lines) > 1 else {}
        scalars = {key: value for key, value in last.items() if isinstance(value, int | float)}
        record = read_json(self.directory / "run.json")
        more = {"packing": record.get("packing"), "revision": recorded(record)}
        return scalars | {key: value for key, value in more.items() if value}


def check_row(path: Path, number: int, line: str) -> None:
    """Raise `ValueError` where a line is no row, as a crash of the machine can leave it."""
    try:
        row = json.loads(line, parse_constant=float)
        sound = isinstance(row, dict) and math.isfinite(row["time"])
    except (ValueError, LookupError, TypeError):
        sound = False
    if not sound:
        raise ValueError(f"{path}: row {number} is damaged: {line[:80]!r}")


def size_of(directory: Path) -> int:
    """Bytes of all files in a run directory, as far as they can be seen."""
    size = 0
    for folder, _, names in os.walk(directory):
        for name in names:
            with suppress(OSError):
                size += os.lstat(os.path.join(folder, name)).st_size
    return size


class Follower:
    """Brings what the running jobs have written into the index, over and over."""

    def __init__(self, store: Store, runs: Path) -> None:
        self.store, self.runs = store, runs
        self._readers: dict[str, Reader] = {}
        self._progress: dict[str, dict[str, Any]] = {}

    def follow(self, job: Job) -> None:
        """Begin with a job."""
        self._readers[job.id] = Reader(self.runs / job.id, job.case)

    def progress(self, identifier: str) -> dict[str, Any] | None:
        """The last progress line of a running job."""
        return self._progress.get(identifier)

    async def look(self, jobs: Mapping[str, int]) -> None:
        """Take in what these jobs (id: seq) have added."""
        for identifier, seq in jobs.items():
            if (reader := self._readers.get(identifier)) is not None and reader.sound:
                try:
                    rows, snapshots = await asyncio.to_thread(reader.news)
                    progress = await asyncio.to_thread(read_json, self.runs / identifier / "progress.json")
                except OSError as error:  # it may pass; the others are not kept waiting
                    logger.warning("job %s: %s", identifier, error)
                    continue
                except Exception:  # told at the end of the job
                    reader.sound = False
                    continue
                if progress:
                    self._progress[identifier] = progress
                if rows or snapshots:
                    await asyncio.wrap_future(self.store.ingest(seq, rows, snapshots))

    async def finish(self, job: Job) -> dict[str, Any]:
        """Take in the last of a job; what it is found by."""
        reader = self._readers.pop(job.id, None) or Reader(self.runs / job.id, job.case)
        self._progress.pop(job.id, None)
        (rows, snapshots), result = await asyncio.to_thread(lambda: (reader.news(), reader.result()))
        if rows or snapshots:
            await asyncio.wrap_future(self.store.ingest(job.seq, rows, snapshots))
        return result
