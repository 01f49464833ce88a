"""What a run tells while it goes on: lines of log.txt, and progress as JSON lines on stdout. Rank 0 alone speaks."""

import json
import time
from pathlib import Path
from typing import Any

from numba.core import event

from .output import now

EVERY = 5.0  # seconds between two lines of steps in log.txt; later a hundredth of the time since the start
COMPILING = "compiling, once"


class Teller(event.Listener):
    """Also listens to numba, which tells what it compiles, not what it finds compiled."""

    def __init__(self, directory: Path, speaks: bool, progress: bool) -> None:
        """speaks: whether this is rank 0; progress: whether to print."""
        self.directory, self.speaks, self.progress = directory, speaks, speaks and progress
        self.owned = False  # whether the directory is ours to write into
        self.compiled = 0.0  # seconds
        self._depth, self._since, self._said = 0, 0.0, False
        self._began = self._logged = time.monotonic()
        event.register("numba:compile", self)  # type: ignore[no-untyped-call]

    def log(self, line: str) -> None:
        """A line of log.txt, with the time of day."""
        if self.speaks and self.owned:
            add_to_log(self.directory, line)

    def phase(self, name: str, words: str = "") -> None:
        """Something else begins: in the log and as progress."""
        self.log(f"{name}{': ' if words else ''}{words}")
        self.show({"phase": name, "compiled": round(self.compiled, 3)})

    def show(self, line: dict[str, Any]) -> None:
        """A line of progress."""
        if self.progress:
            print(json.dumps(line), flush=True)

    def steps(self, line: dict[str, Any]) -> None:
        """In the log, every few seconds."""
        clock = time.monotonic()
        if clock - self._logged >= max(EVERY, 0.01 * (clock - self._began)):
            self._logged = clock
            vacancy = line["vacancy_ratio"]
            shown = "" if vacancy is None else f", vacancy ratio {vacancy:.4f}"
            self.log(f"step {line['step']}: t = {line['time']:.4g} of {line['end']:g}{shown}")

    def on_start(self, _: object) -> None:
        """numba begins with a function, which may call others."""
        if self._depth == 0:
            self._since = time.monotonic()
            if not self._said:
                self._said = True
                self.phase(COMPILING)
        self._depth += 1

    def on_end(self, _: object) -> None:
        """It has it."""
        self._depth -= 1
        if self._depth == 0:
            self.compiled += time.monotonic() - self._since


def add_to_log(directory: Path, line: str) -> None:
    """A line of log.txt, with the time of day."""
    with open(directory / "log.txt", "a") as log:
        log.write(f"{now()} {line}\n")
