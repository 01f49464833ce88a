"""Particles in text files: CSV of x,y[,z],radius, and the `.cloud` files of finite-element sintering codes.

Columns are separated by commas, semicolons or white space. Blank lines, lines that start with # and a first line with
the names of the columns (`r` will do for `radius`) are skipped.
"""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from .arrays import Floats
from .durable import write_whole

NANOMETRES = {"nm": 1.0, "um": 1e3, "mm": 1e6, "m": 1e9}  # in a unit
MOST_WRONG, MOST_COUNTED = 50, 1000  # wrong cells that are told, and counted
SHOWN = 40  # characters of a wrong cell


class ParticleFileError(ValueError):
    """A file that holds no particles; `problems` has a line per wrong line, of the first, `more` counts the others."""

    def __init__(self, problems: Sequence[str], more: int = 0) -> None:
        self.problems, self.more = tuple(problems), more
        super().__init__("; ".join([*problems, *([f"and {more} more"] if more else [])]))


def read(path: str | Path, dim: int, units: str = "nm", most: int | None = None) -> tuple[Floats, Floats]:
    """Centres (n, dim) and radii (n,), nm, of a file whose lengths are in `units`.

    most: particles beyond which it is refused without reading on.
    """
    try:
        with open(path, encoding="utf-8-sig") as file:
            rows = _rows(file, [*"xyz"[:dim], "radius"], most)
    except (OSError, ValueError) as error:
        if isinstance(error, ParticleFileError):
            raise
        raise ParticleFileError([f"cannot be read: {error}"]) from error
    table = np.array(rows) * NANOMETRES[units]
    return table[:, :-1], table[:, -1]


def _rows(lines: Iterable[str], names: Sequence[str], most: int | None) -> list[list[float]]:
    """The numbers of all lines. What is wrong is told up to MOST_WRONG lines, and counted."""
    rows: list[list[float]] = []
    wrong: list[str] = []
    first, bad = True, 0
    for number, line in enumerate(lines, start=1):
        cells = _cells(line)
        if cells == [""] or cells[0].startswith("#"):
            continue
        heading, first = first and [{"r": "radius"}.get(cell.lower(), cell.lower()) for cell in cells] == names, False
        if heading:
            continue
        if found := [*_wrong_cells(number, cells, names)]:
            wrong, bad = (wrong + found)[:MOST_WRONG], bad + len(found)
        elif not bad:
            rows.append([float(cell) for cell in cells])
        if most is not None and len(rows) > most:
            raise ParticleFileError([f"holds more than {most} particles"])
        if bad >= MOST_COUNTED:
            break
    if wrong or not rows:
        raise ParticleFileError(wrong or ["holds no particles"], bad - len(wrong))
    return rows


def write(path: Path, centres: Floats, radii: Floats) -> None:
    """A CSV that `read` turns into the same numbers; a reader sees all of it or nothing."""
    header = ",".join([*"xyz"[: centres.shape[1]], "radius"])
    rows = (",".join(map(repr, row)) for row in np.column_stack([centres, radii]).tolist())
    write_whole(path, ("\n".join([header, *rows]) + "\n").encode(), durable=False)


def _cells(line: str) -> list[str]:
    mark = next((mark for mark in ",;" if mark in line), None)
    return [cell.strip() for cell in line.split(mark)] if mark else re.split(r"\s+", line.strip())


def _wrong_cells(line: int, cells: Sequence[str], names: Sequence[str]) -> Iterator[str]:
    if len(cells) != len(names):
        yield f"line {line} has {len(cells)} columns, must have {len(names)}: {','.join(names)}"
        return
    for column, (cell, name) in enumerate(zip(cells, names, strict=True), start=1):
        try:
            good = 0 < float(cell) < math.inf if name == "radius" else math.isfinite(float(cell))
        except ValueError:
            good = False
        if not good:
            allowed = "a number greater than 0" if name == "radius" else "a number"
            yield f"line {line}, column {column} ({name}) is {_short(cell)!r}, must be {allowed}"


def _short(cell: str) -> str:
    return cell if len(cell) <= SHOWN else cell[: SHOWN - 3] + "..."
