"""What the commands share: refusals, cells of tables, progress in words."""

import sys
from collections.abc import Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
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


def show_table(rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows as a table; columns in which nobody has anything are left out."""
    keys = [key for key in (rows[0] if rows else {}) if any(row.get(key) is not None for row in rows)]
    table = Table(box=None, pad_edge=False)
    for key in keys:
        table.add_column(key.replace("_", " "), overflow="fold")
    for row in rows:
        table.add_row(*(cell(row.get(key)) for key in keys))
    Console(width=None if sys.stdout.isatty() else 200, markup=False).print(table)


def cell(value: object) -> str:
    """Of a table; nothing in it moves the terminal."""
    return "-" if value is None else f"{value:.6g}" if isinstance(value, float) else visible(str(value))


def in_words(progress: dict[str, Any]) -> str:
    """A progress line; what rank 0 does not know yet is a dash."""

    def word(key: str, form: str) -> str:
        value = progress.get(key)
        return "-" if value is None else format(value, form)

    seconds = progress.get("remaining")
    left = "-" if seconds is None else timedelta(seconds=round(seconds))
    return (
        f"t {word('time', '.4g')}/{word('end', '.4g')} step {word('step', 'd')}"
        f" {word('evaluations_per_second', '.3g')} ev/s live {word('live_fraction', '.0%')}"
        f" vacancy {word('vacancy_ratio', '.4f')} {left} left"
    )
