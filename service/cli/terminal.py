"""What the commands share: refusals, cells of tables, progress in words."""

import sys
import threading
from collections.abc import Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from time import monotonic
from typing import Annotated, Any, NoReturn, Self

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from frit.solver.characters import visible

SweepFile = Annotated[Path, typer.Argument(metavar="FILE", exists=True, dir_okay=False, help="TOML or JSON.")]

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
DataFolder = Annotated[
    Path, typer.Option("--data", metavar="DIR", file_okay=False, envvar="FRIT_DATA", help="Data folder.")
]
Recompute = Annotated[
    bool, typer.Option("--recompute", help="Compute anew what an older revision of the solver computed.")
]


def must_be_there(data: Path) -> None:
    """Refuse a data folder that somebody named and that is not there; the default one may not have been made yet."""
    if not data.is_dir() and data != Path("data"):
        refuse(f"--data {data}: there is no such folder")


def of_older(revisions: Sequence[int | None]) -> str | None:
    """A sentence on the jobs that an older revision of the solver computed; None stands for each of the others."""
    found = [revision for revision in revisions if revision is not None]
    if not found:
        return None
    which = ", ".join(map(str, sorted(set(found))))
    many = f"{len(found)} of {len(revisions)} jobs were computed by an older revision of the solver ({which})"
    return f"{many}, whose results differ: --recompute, with the sweep's file, computes them anew."


def refuse(*lines: str) -> NoReturn:
    """Say on stderr what is wrong with the input, and leave with 2."""
    for line in lines:
        typer.echo(visible(line, keep="\n"), err=True)
    raise typer.Exit(2)


def fail(*lines: str) -> NoReturn:
    """Say on stderr what went wrong, and leave with 1."""
    for line in lines:
        typer.echo(visible(line, keep="\n"), err=True)
    raise typer.Exit(1)


WIDTH = 100  # characters of a table where no terminal says
PROSE = ("name", "message", "reason", "states")  # columns that may be cut


def show_table(rows: Sequence[Mapping[str, Any]], none: str | None = None) -> None:
    """Rows as a table; columns in which nobody has anything are left out. none: what is said where there are no rows.

    What does not fit is cut in the middle of prose, never of an id or a number.
    """
    if rows or none is None:
        console, table = Console(width=None if sys.stdout.isatty() else WIDTH, markup=False), table_of(rows)
        least = console.measure(table, options=console.options.update(width=10 * WIDTH)).minimum
        console.width = max(console.width, least)
        console.print(table)
    else:
        typer.echo(none)


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The table of `show_table`."""
    keys = [key for key in (rows[0] if rows else {}) if any(row.get(key) is not None for row in rows)]
    table = Table(box=None, pad_edge=False)
    for key in keys:
        table.add_column(key.replace("_", " "), no_wrap=key not in PROSE, overflow="fold")
    for row in rows:
        table.add_row(*(cut(key, cell(row.get(key))) for key in keys))
    return table


def cut(key: str, text: str) -> str:
    """Prose with its middle left out where it is long: both its ends tell something."""
    most = WIDTH // 2 if key == "message" else WIDTH // 3
    return text if key not in PROSE or len(text) <= most else f"{text[: most // 2]} … {text[-(most // 2) :]}"


def cell(value: object) -> str:
    """Of a table; nothing in it moves the terminal."""
    return "-" if value is None else f"{value:.6g}" if isinstance(value, float) else visible(str(value))


def in_words(progress: Mapping[str, Any]) -> str:
    """A progress line; what rank 0 does not know yet is a dash."""

    def word(key: str, form: str) -> str:
        value = progress.get(key)
        return "-" if value is None else format(value, form)

    if "phase" in progress:
        return str(progress["phase"])
    return (
        f"t {word('time', '.4g')}/{word('end', '.4g')} step {word('step', 'd')}"
        f" {word('evaluations_per_second', '.3g')} ev/s live {word('live_fraction', '.0%')}"
        f" vacancy {word('vacancy_ratio', '.4f')} {duration(progress.get('remaining'))} left"
    )


def duration(seconds: float | None) -> str:
    """1:02:03, or a dash."""
    return "-" if seconds is None else str(timedelta(seconds=round(seconds)))


def part(progress: Mapping[str, Any] | None) -> float:
    """How much of a run is done, between 0 and 1."""
    found = progress or {}
    return min(1.0, found["time"] / found["end"]) if found.get("end") and "time" in found else 0.0


class Shown:
    """Progress on stderr: a bar where somebody sees it, elsewhere a line a minute. A context manager."""

    EVERY = 60.0  # seconds

    def __init__(self) -> None:
        self.seen = sys.stdout.isatty() and sys.stderr.isatty()
        text = TextColumn("{task.description}", markup=False)
        self._bar = Progress(BarColumn(bar_width=12), text, console=Console(stderr=True), disable=not self.seen)
        self._task, self._words = self._bar.add_task("starting", total=None), "starting"
        self._began, self._first, self._over = monotonic(), 0.0, threading.Event()

    def __enter__(self) -> Self:
        self._bar.start()
        if not self.seen:
            threading.Thread(target=self._speak, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._bar.stop()

    def _speak(self) -> None:
        while not self._over.wait(self.EVERY):
            typer.echo(self._words, err=True)

    def tell(self, words: str, done: float | None = None, total: float | None = None) -> None:
        """What there is to say now."""
        self._words = words
        self._bar.update(self._task, completed=done, total=total, description=words)

    def tell_all(self, states: Mapping[str, int], running: Sequence[Mapping[str, Any] | None], ended: int) -> None:
        """Of a sweep: how many jobs are in which state, the progress of those that run, and how many have ended."""
        total = sum(states.values())
        done = ended + sum(map(part, running))
        self._first = self._first or done
        gained, elapsed = done - self._first, monotonic() - self._began
        left = (total - done) / gained * elapsed if gained > 0 else None
        said = ", ".join(f"{n} {state}" for state, n in states.items())
        phases = sorted({str(each["phase"]) for each in running if each and "phase" in each})
        self.tell(f"{ended} of {total} done ({', '.join([said, *phases])}) {duration(left)} left", done, total)
