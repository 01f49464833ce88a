"""What the commands share: refusals, cells of tables, progress in words."""

from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

SweepFile = Annotated[Path, typer.Argument(metavar="FILE", exists=True, dir_okay=False, help="TOML or JSON.")]


def refuse(*lines: str) -> NoReturn:
    """Say on stderr what is wrong with the input, and leave with 2."""
    for line in lines:
        typer.echo(line, err=True)
    raise typer.Exit(2)


def cell(value: object) -> str:
    """Of a table."""
    return "-" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


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
