"""Particles in text files: CSV of x,y[,z],radius, and the `.cloud` files of finite-element sintering codes.

Columns are separated by commas, semicolons or white space. Blank lines, lines that start with # and a first line with
the names of the columns (`r` will do for `radius`) are skipped.
"""

import math
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from .arrays import Floats

NANOMETRES = {"nm": 1.0, "um": 1e3, "mm": 1e6, "m": 1e9}  # in a unit


class ParticleFileError(ValueError):
    """A file that holds no particles; `problems` has a line per wrong line."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(problems))


def read(path: str | Path, dim: int, units: str = "nm") -> tuple[Floats, Floats]:
    """Centres (n, dim) and radii (n,), nm, of a file whose lengths are in `units`."""
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise ParticleFileError([f"cannot be read: {error}"]) from error
    table = {n: _cells(line) for n, line in enumerate(lines, start=1)}
    table = {n: cells for n, cells in table.items() if cells != [""] and not cells[0].startswith("#")}
    names = [*"xyz"[:dim], "radius"]
    if table and [{"r": "radius"}.get(cell.lower(), cell.lower()) for cell in table[min(table)]] == names:
        del table[min(table)]
    wrong = [text for n, cells in table.items() for text in _wrong_cells(n, cells, names)]
    if wrong or not table:
        raise ParticleFileError(wrong or ["holds no particles"])
    rows = np.array([list(map(float, cells)) for cells in table.values()]) * NANOMETRES[units]
    return rows[:, :-1], rows[:, -1]


def write(path: Path, centres: Floats, radii: Floats) -> None:
    """A CSV that `read` turns into the same numbers; a reader sees all of it or nothing."""
    header = ",".join([*"xyz"[: centres.shape[1]], "radius"])
    rows = (",".join(map(repr, row)) for row in np.column_stack([centres, radii]).tolist())
    beside = path.with_name(f"{path.name}.{os.getpid()}.new")
    beside.write_text("\n".join([header, *rows]) + "\n")
    os.replace(beside, path)


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
            yield f"line {line}, column {column} ({name}) is {cell!r}, must be {allowed}"
