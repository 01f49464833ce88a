"""frit's own mesh file: what an uploaded mesh is turned into, and all that the ranks of a service read.

A line `frit mesh 1`; a line of JSON with the shapes of the arrays; the arrays one after the other, little-endian:
nodes (float64), triangles and tetrahedra (int64 node numbers). It refers to nothing and has one form per mesh.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .arrays import Floats, Integers

MAGIC = b"frit mesh 1\n"
SUFFIX = ".fritmesh"
LONGEST = 200  # bytes of the line of shapes
KINDS = {"triangle": 3, "tetra": 4}  # corners by meshio's names


class MeshFileError(ValueError):
    """Not such a file, or a damaged one; the message says why, without the path."""


@dataclass(frozen=True, eq=False)
class Contents:
    """What such a file holds."""

    nodes: Floats  # (n, 2 or 3)
    cells: Mapping[str, Integers]  # by kind, each (p, corners); all kinds are there


@dataclass(frozen=True)
class Shapes:
    """How much such a file holds."""

    nodes: int
    columns: int
    cells: Mapping[str, int]
    start: int  # of the arrays

    @property
    def size(self) -> int:
        """Bytes of the file."""
        numbers = self.nodes * self.columns + sum(KINDS[kind] * count for kind, count in self.cells.items())
        return self.start + 8 * numbers


def write(path: Path | str, contents: Contents) -> None:
    """The same mesh gives the same bytes, durable when this returns."""
    shapes = [*contents.nodes.shape, *(len(contents.cells[kind]) for kind in KINDS)]
    with open(path, "wb") as file:
        file.write(MAGIC + json.dumps(shapes).encode() + b"\n")
        file.write(np.ascontiguousarray(contents.nodes + 0.0, dtype="<f8").tobytes())
        for kind in KINDS:
            file.write(np.ascontiguousarray(contents.cells[kind], dtype="<i8").tobytes())
        file.flush()
        os.fsync(file.fileno())


def is_own(path: Path | str) -> bool:
    """Whether a file begins as such a one. Raises `OSError`."""
    with open(path, "rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def shapes(path: Path | str) -> Shapes:
    """How much is in the file, without reading it. Raises `MeshFileError`, `OSError`."""
    with open(path, "rb") as file:
        head = file.read(len(MAGIC) + LONGEST)
        size = os.fstat(file.fileno()).st_size
    line, end, _ = head.removeprefix(MAGIC).partition(b"\n")
    try:
        nodes, columns, *counts = (int(number) for number in json.loads(line))
        cells = dict(zip(KINDS, counts, strict=True))
    except (TypeError, ValueError):
        end = b""
    if not (end and head.startswith(MAGIC)):
        raise MeshFileError("is not a mesh file of frit")
    found = Shapes(nodes, columns, cells, len(MAGIC) + len(line) + 1)
    if columns not in (2, 3) or min(nodes, *cells.values()) < 0 or found.size != size:
        raise MeshFileError("is a damaged mesh file of frit")
    return found


def read(path: Path | str) -> Contents:
    """All that is in the file. Raises `MeshFileError`, `OSError`."""
    found = shapes(path)
    with open(path, "rb") as file:
        file.seek(found.start)
        nodes = np.fromfile(file, "<f8", found.nodes * found.columns).reshape(found.nodes, found.columns)
        cells = {
            kind: np.fromfile(file, "<i8", count * KINDS[kind]).reshape(count, KINDS[kind])
            for kind, count in found.cells.items()
        }
    return Contents(nodes, cells)
