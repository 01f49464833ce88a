"""Meshes: nodes, simplex cells and one material point per cell, numbered so that neighbours lie near in memory.

The points integrate (Huang et al. 2023, equations 17-29): x_p is the barycentre of cell p, w_p its volume; `points`
puts a lattice of points in their place. Lattices, gmsh and mesh files all end in `_build`.
"""

import ctypes
import io
import math
import os
import signal
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from . import mesh_file
from .arrays import Codes, Floats, Integers, Numbers

if TYPE_CHECKING:
    from .case import Nodes

GMSH_LIBRARIES = "apt-get install libglu1-mesa libgl1 libxrender1 libxcursor1 libxft2 libxinerama1 libgomp1"
GMSH_OPTIONS = {"General.Terminal": 0, "General.NumThreads": 1, "Mesh.RandomSeed": 1, "Mesh.Algorithm": 6}
CELL_KIND = {2: "triangle", 3: "tetra"}  # the name of a cell in meshio
FLAT = 1e-14  # a cell has no volume when |volume| <= FLAT * (longest edge)^dim
OUTSIDE = 1e-6  # how far a node of a file may lie outside the domain, in units of the domain's size
BLOCK = 1 << 17  # cells measured at a time: keeps the scratch arrays small
_gmsh_lock = threading.Lock()  # gmsh has one state per process


class MeshError(ValueError):
    """The mesh cannot be built or used; the message says which node or cell, numbered from 0, and why."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """n nodes, simplex cells and p material points in dim = 2 or 3 dimensions; lengths in nm."""

    nodes: Floats  # (n, dim)
    cells: Numbers  # (c, dim + 1) node numbers, positively oriented
    points: Floats  # (p, dim) x_p: barycentres of the cells, or a lattice of their own
    weights: Floats  # (p,) w_p: volumes of the cells, or equal parts of the domain, nm^dim
    spacing: Floats  # (p,) nodal spacing around each point
    width: float  # h of the shape functions
    in_cells: bool  # whether point p is the barycentre of cell p


def make_mesh(nodes: "Nodes", size: Sequence[float], rows: bool = True, integrates: bool = True) -> Mesh:
    """The mesh that the case asks for, in the box [0, size]; rows: how to number the nodes of a lattice.

    integrates: whether its cells are integrated over; else nodes of a file that coincide are merged, and cells may be
    flat.
    """
    if nodes.source == "file" and nodes.path is not None:
        return file_mesh(nodes.path, size, integrates)
    if nodes.source != "file" and nodes.spacing is not None:
        if nodes.source == "gmsh":
            return gmsh_mesh(size, nodes.spacing)
        return (square if nodes.source == "lattice" else lattice)(size, nodes.spacing, rows)
    raise MeshError(f"nodes: source {nodes.source}, spacing {nodes.spacing}, path {nodes.path}: one missing")


def lattice(size: Sequence[float], spacing: float, rows: bool = True) -> Mesh:
    """Equilateral triangular (2-D) or body-centred cubic (3-D) nodes, nearest neighbours at `spacing`.

    Each axis is stretched by at most half a cell so that the lattice fills the box. The walls are flat: they
    halve the triangles or tetrahedra that they cut. Nodes are numbered along x, then y, then z: `blocks` lives on
    that. rows False: along the space-filling curve, as frit did before (checkpoints of that time need it).
    """
    box = _checked_box(size, spacing)
    pitch = (spacing, spacing * math.sqrt(3) / 2) if len(box) == 2 else (2 * spacing / math.sqrt(3),) * 3
    counts = [max(1, round(length / step)) for length, step in zip(box, pitch, strict=True)]
    if 2 * math.prod(n + 2 for n in counts) > np.iinfo(np.int32).max:
        raise MeshError(f"spacing {spacing} in a box of {box}: too many nodes for 32-bit node numbers")
    return _build(*(_triangular if len(box) == 2 else _body_centred)(box, counts), spacing, rows)


def square(size: Sequence[float], spacing: float, rows: bool = True) -> Mesh:
    """Square (2-D) or cubic (3-D) nodes, each cell cut into 2 triangles or 6 tetrahedra: for linear functions."""
    box = _checked_box(size, spacing)
    counts = [max(1, round(length / spacing)) for length in box]
    if 6 * math.prod(n + 1 for n in counts) > np.iinfo(np.int32).max:
        raise MeshError(f"spacing {spacing} in a box of {box}: too many nodes for 32-bit node numbers")
    grid = np.meshgrid(*(np.linspace(0.0, length, n + 1) for length, n in zip(box, counts, strict=True)), indexing="ij")
    number = np.arange(grid[0].size, dtype=np.int32).reshape(grid[0].shape)
    cells = []
    for order in permutations(range(len(box))):  # from corner to corner of a cell, one axis after the other
        corner, path = np.zeros(len(box), dtype=int), []
        for axis in (None, *order):
            corner[list(() if axis is None else (axis,))] = 1
            path.append(number[tuple(slice(c, n + c) for c, n in zip(corner, counts, strict=True))].ravel())
        cells.append(np.stack(path, axis=-1))
    nodes = np.stack(grid, axis=-1).reshape(-1, len(box))
    return _build(nodes, np.concatenate(cells), spacing, rows)


def _checked_box(size: Sequence[float], spacing: float) -> tuple[float, ...]:
    box = tuple(float(length) for length in size)
    if len(box) not in (2, 3) or not all(0 < length < math.inf for length in box):
        raise MeshError(f"size {box}: two or three positive lengths are allowed")
    if not 0 < spacing < math.inf:
        raise MeshError(f"spacing {spacing}: a positive length is allowed")
    return box


def _lines(length: float, n: int) -> tuple[Floats, Floats]:
    """The n + 1 ends of n equal intervals of [0, length], and their n centres between the two walls."""
    ends = np.linspace(0.0, length, n + 1)
    return ends, np.concatenate([[0.0], (ends[1:] + ends[:-1]) / 2, [length]])


def _triangular(box: tuple[float, ...], counts: Sequence[int]) -> tuple[Floats, Numbers]:
    """Rows along x: even ones at the ends of nx intervals, odd ones at their centres and on both walls."""
    nx, ny = counts
    ends, centres = _lines(box[0], nx)
    rows = [ends if j % 2 == 0 else centres for j in range(ny + 1)]
    heights = np.repeat(np.linspace(0.0, box[1], ny + 1), [len(row) for row in rows])
    nodes = np.column_stack([np.concatenate(rows), heights])

    # Strip j lies between an even row e and an odd row o; row j begins at node j (nx + 1) + floor(j / 2).
    j = np.arange(ny, dtype=np.int32)[:, None]
    even, odd = j + j % 2, j + 1 - j % 2
    e = even * (nx + 1) + even // 2 + np.arange(nx + 1, dtype=np.int32)
    o = odd * (nx + 1) + odd // 2 + np.arange(nx + 2, dtype=np.int32)
    based_on_even = np.stack([e[:, :-1], e[:, 1:], o[:, 1:-1]], axis=-1)
    based_on_odd = np.stack([e, o[:, :-1], o[:, 1:]], axis=-1)
    return nodes, np.concatenate([based_on_even.reshape(-1, 3), based_on_odd.reshape(-1, 3)])


def _body_centred(box: tuple[float, ...], counts: Sequence[int]) -> tuple[Floats, Numbers]:
    """Vertices and centres of nx * ny * nz bricks, and the centres of the bricks' faces on the walls.

    A face between two bricks gives four tetrahedra (centre, centre, edge of the face). On a wall the second
    centre is that of the face itself; an array of centres with one more layer on each side makes both alike.
    """
    ends, centres = zip(*(_lines(length, n) for length, n in zip(box, counts, strict=True)), strict=True)
    vertex = np.arange(math.prod(n + 1 for n in counts), dtype=np.int32).reshape([n + 1 for n in counts])
    i, j, k = np.ix_(*((np.arange(n + 2) % (n + 1) == 0).astype(np.int8) for n in counts))
    exists = i + j + k <= 1  # in at most one of the additional layers
    centre = np.full(exists.shape, -1, dtype=np.int32)
    centre[exists] = vertex.size + np.arange(np.count_nonzero(exists), dtype=np.int32)
    corners = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)
    middles = np.stack([grid[exists] for grid in np.meshgrid(*centres, indexing="ij")], axis=-1)

    tetrahedra = []
    for axis in range(3):
        c = np.moveaxis(centre, axis, 0)[:, 1:-1, 1:-1]
        v = np.moveaxis(vertex, axis, 0)
        loop = [v[:, :-1, :-1], v[:, 1:, :-1], v[:, 1:, 1:], v[:, :-1, 1:]]
        for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
            tetrahedra.append(np.stack([c[:-1], c[1:], a, b], axis=-1).reshape(-1, 4))
    return np.concatenate([corners, middles]), np.concatenate(tetrahedra)


def gmsh_mesh(size: Sequence[float], spacing: float) -> Mesh:
    """Delaunay triangles (frontal) or tetrahedra of the box by gmsh, edges near `spacing`; deterministic."""
    box = _checked_box(size, spacing)
    try:
        gmsh: Any = import_module("gmsh")
    except OSError as error:
        raise MeshError(f"gmsh lacks system libraries ({error}): {GMSH_LIBRARIES}") from error
    except ImportError as error:
        raise MeshError(f"gmsh is not installed ({error}): pip install gmsh") from error
    with _gmsh_lock:
        if gmsh.isInitialized():
            raise MeshError("gmsh is in use by another part of this process: call gmsh.finalize() first")
        try:
            with started(gmsh):
                nodes, cells = _generate(gmsh, box, spacing)
        except Exception as error:  # all that gmsh raises
            raise MeshError(f"gmsh could not mesh a box of {box} with spacing {spacing}: {error}") from error
    return _build(nodes.clip(0.0, box), cells, None)


@contextmanager
def started(gmsh: Any) -> Iterator[None]:
    """gmsh, started; what the process does about a broken pipe stays as it was, where gmsh would have it killed."""
    library = ctypes.CDLL(None)  # Python's own signal module works in the main thread alone
    library.signal.restype, library.signal.argtypes = ctypes.c_void_p, [ctypes.c_int, ctypes.c_void_p]
    before = library.signal(signal.SIGPIPE, signal.SIG_IGN)
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    library.signal(signal.SIGPIPE, before)
    try:
        yield
    finally:
        gmsh.finalize()


def _generate(gmsh: Any, box: tuple[float, ...], spacing: float) -> tuple[Floats, Numbers]:
    dim = len(box)
    for name, value in {**GMSH_OPTIONS, "Mesh.MeshSizeMin": spacing, "Mesh.MeshSizeMax": spacing}.items():
        gmsh.option.setNumber(name, value)
    if dim == 2:
        gmsh.model.occ.addRectangle(0, 0, 0, *box)
    else:
        gmsh.model.occ.addBox(0, 0, 0, *box)
    gmsh.model.occ.synchronize()
    gmsh.model.mesh.generate(dim)
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    _, connectivity = gmsh.model.mesh.getElementsByType({2: 2, 3: 4}[dim])
    number = np.full(int(tags.max()) + 1, -1, dtype=np.int32)
    number[tags] = np.arange(len(tags), dtype=np.int32)
    return coordinates.reshape(-1, 3)[:, :dim].copy(), number[connectivity].reshape(-1, dim + 1)


def file_mesh(path: str | Path, size: Sequence[float], integrates: bool = True) -> Mesh:
    """The triangles (2-D) or tetrahedra (3-D) of frit's own mesh file or any that meshio reads; it ignores other cells.

    Nodes of no cell are dropped. Refuses nodes outside the box [0, size], and 2-D meshes off a plane of
    constant z. What was uploaded to a service (FRIT_UPLOADS) is read only as frit's own file. integrates: see
    `make_mesh`.
    """
    box = np.array(_checked_box(size, 1.0))
    dim, kind = len(box), CELL_KIND[len(box)]
    source = _read(path)
    nodes, cells = source.nodes, source.cells[kind]
    if not len(cells):
        others = ", ".join(f"{len(found)} {name}" for name, found in source.cells.items() if len(found))
        raise MeshError(f"{path}: no {kind} cells; the file holds: {others or 'nothing'}")
    if nodes.ndim != 2 or nodes.shape[1] < dim:
        raise MeshError(f"{path}: {dim} coordinates are needed, the file has an array of nodes of shape {nodes.shape}")
    _refuse_lost(path, kind, nodes, cells)
    _refuse_outside(path, nodes, np.unique(cells), box)
    nodes = np.ascontiguousarray(nodes[:, :dim])
    if not integrates:
        nodes, cells = _merged(nodes, cells)
    return _build(nodes, cells.astype(np.int32), None, integrates=integrates)


def _merged(nodes: Floats, cells: Integers) -> tuple[Floats, Integers]:
    """Nodes in the same place become one; cells that have it twice are gone."""
    _, first, number = np.unique(nodes + 0.0, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(nodes):
        return nodes, cells
    cells = number.reshape(-1)[cells]
    return nodes[first], cells[(np.diff(np.sort(cells, axis=1), axis=1) > 0).all(axis=1)]


def _refuse_lost(path: str | Path, kind: str, nodes: Floats, cells: Integers) -> None:
    bad = np.flatnonzero(((cells < 0) | (cells >= len(nodes))).any(axis=1))
    if bad.size:
        where = f"{kind} {bad[0]} has nodes {cells[bad[0]]}"
        raise MeshError(f"{path}: {where}, the file holds an array of nodes of shape {nodes.shape}")


def _read(path: str | Path) -> mesh_file.Contents:
    try:
        with suppress(OSError):  # meshio says so
            if mesh_file.is_own(path):
                return mesh_file.read(path)
    except mesh_file.MeshFileError as error:
        raise MeshError(f"{path}: {error}") from error
    uploads = os.environ.get("FRIT_UPLOADS")
    if uploads and Path(os.path.realpath(path)).is_relative_to(os.path.realpath(uploads)):
        raise MeshError(f"{Path(path).name}: was uploaded in a form that is not read any more: upload it again")
    return _foreign(path)


def read_foreign(path: str | Path, kind: str) -> mesh_file.Contents:
    """A mesh of meshio's format `kind`, complete in itself. Raises `MeshError`."""
    found = _foreign(path, kind)
    if found.nodes.ndim != 2 or found.nodes.shape[1] not in (2, 3):
        raise MeshError(f"{path}: must have 2 or 3 coordinates per node, has an array of shape {found.nodes.shape}")
    if not any(map(len, found.cells.values())):
        raise MeshError(f"{path}: holds no triangles or tetrahedra")
    for name in mesh_file.KINDS:
        _refuse_lost(path, name, found.nodes, found.cells[name])
    return found


def _foreign(path: str | Path, kind: str | None = None) -> mesh_file.Contents:
    """What meshio reads; what it prints before it gives up, or exits, goes into the error."""
    said = io.StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh = import_module("meshio").read(path, kind)
            nodes = np.asarray(mesh.points, dtype=np.float64)
            blocks: dict[str, list[Integers]] = {}
            for block in mesh.cells:  # of those that are not used only the number is kept
                used = block.type in mesh_file.KINDS
                cells = np.asarray(block.data, dtype=np.int64) if used else np.empty((len(block.data), 0), np.int64)
                blocks.setdefault(block.type, []).append(cells)
            found = {name: np.concatenate(parts) for name, parts in blocks.items()}
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:  # readers of broken files raise anything
        reason = " ".join(said.getvalue().split()) or f"{type(error).__name__}: {error}"
        raise MeshError(f"{path}: meshio cannot read it: {reason}") from error
    none = {name: np.empty((0, corners), dtype=np.int64) for name, corners in mesh_file.KINDS.items()}
    return mesh_file.Contents(nodes, none | found)


def _refuse_outside(path: str | Path, nodes: Floats, used: Integers, box: Floats) -> None:
    dim, x, slack = len(box), nodes[used], OUTSIDE * box
    inside = ((x[:, :dim] >= -slack) & (x[:, :dim] <= box + slack)).all(axis=1) & np.isfinite(x).all(axis=1)
    if not inside.all():
        node, others = used[~inside][0], np.count_nonzero(~inside) - 1
        where = f"outside the domain [0, {box.tolist()}], as are {others} others"
        raise MeshError(f"{path}: node {node} at {nodes[node].tolist()} is {where}")
    if x.shape[1] > dim and np.ptp(x[:, dim]) > slack.max():
        raise MeshError(f"{path}: not planar: z from {x[:, dim].min()} to {x[:, dim].max()} in a 2-D domain")


def _build(
    nodes: Floats, cells: Numbers, spacing: float | None, rows: bool = False, integrates: bool = True
) -> Mesh:
    """Check, orient (in place) and order, nodes by rows or curve; spacing None: measure it.

    Errors number nodes and cells as given. integrates: see `make_mesh`.
    """
    used = np.zeros(len(nodes), dtype=np.bool_)
    for column in cells.T:
        used[column] = True
    numbers = np.flatnonzero(used)
    lower, upper = nodes[numbers].min(axis=0), nodes[numbers].max(axis=0)
    extent = float((upper - lower).max())
    volumes, points = _measure(nodes, cells)
    if integrates:
        _refuse_flat(nodes, cells, volumes, extent)
    flip = np.flatnonzero(volumes < 0)
    cells[flip, -2], cells[flip, -1] = cells[flip, -1], cells[flip, -2]

    numbers = numbers[np.lexsort(nodes[numbers].T) if rows else along_curve(nodes[numbers], lower, extent)]
    order = along_curve(points, lower, extent)
    rank = np.empty(len(nodes), dtype=np.int32)
    rank[numbers] = np.arange(len(numbers), dtype=np.int32)
    nodes, cells = nodes[numbers], cells[order]
    for column in cells.T:
        column[:] = rank[column]
    points = points[order]  # one by one: at most one of the large arrays exists twice
    weights = np.abs(volumes[order])
    local = _local_spacing(nodes, cells, numbers) if spacing is None else np.full(len(cells), float(spacing))
    return Mesh(nodes, cells, points, weights, local, float(local.max()), in_cells=True)


def _measure(nodes: Floats, cells: Numbers) -> tuple[Floats, Floats]:
    """Signed volumes det(x_1 - x_0, ..., x_dim - x_0) / dim! and barycentres of the cells."""
    dim = nodes.shape[1]
    volumes, points = np.empty(len(cells)), np.empty((len(cells), dim))
    for start in range(0, len(cells), BLOCK):
        part = slice(start, start + BLOCK)
        x = [nodes[column] for column in cells[part].T]
        points[part] = sum(x[1:], x[0]) / (dim + 1)
        edges = [(xk - x[0]).T for xk in x[1:]]
        volumes[part] = _determinant(edges) / math.factorial(dim)
    return volumes, points


def _determinant(e: list[Floats]) -> Floats:
    """det of the dim vectors e[i], each (dim, cells): written out, so that no BLAS decides the rounding."""
    if len(e) == 2:
        return np.asarray(e[0][0] * e[1][1] - e[0][1] * e[1][0])
    minors = [e[1][i] * e[2][j] - e[1][j] * e[2][i] for i, j in ((1, 2), (2, 0), (0, 1))]
    return np.asarray(e[0][0] * minors[0] + e[0][1] * minors[1] + e[0][2] * minors[2])


def _refuse_flat(nodes: Floats, cells: Numbers, volumes: Floats, extent: float) -> None:
    """No edge is longer than sqrt(dim) extent: only cells that are flat against that need a closer look."""
    dim = nodes.shape[1]
    for cell in np.flatnonzero(np.abs(volumes) <= FLAT * (math.sqrt(dim) * extent) ** dim):
        x = nodes[cells[cell]]
        longest = float(np.linalg.norm(x[:, None] - x, axis=-1).max())
        if abs(volumes[cell]) <= FLAT * longest**dim:
            raise MeshError(f"{CELL_KIND[dim]} {cell} has no volume: nodes {cells[cell]} at {x.tolist()}")


def along_curve(x: Floats, lower: Floats, extent: float) -> Integers:
    """The order of x along Morton's curve in the cube at `lower`: near in space comes to lie near in memory.

    The code interleaves integer coordinates of 31 bits each in 2-D, 21 in 3-D. Ties keep their order.
    """
    dim = x.shape[1]
    bits = {2: 31, 3: 21}[dim]
    code = np.zeros(len(x), dtype=np.uint64)
    for axis in range(dim):
        steps = ((x[:, axis] - lower[axis]) * ((2**bits - 1) / extent)).clip(0, 2**bits - 1)
        code |= _spread(steps.astype(np.uint64), dim) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _spread(x: Codes, dim: int) -> Codes:
    """Move bit i of x to bit dim * i, in groups of 16 bits, then 8, 4, 2 and 1."""
    for group in (16, 8, 4, 2, 1):
        mask = sum((2**group - 1) << shift for shift in range(0, 64, dim * group)) % 2**64
        x = (x | (x << np.uint64((dim - 1) * group))) & np.uint64(mask)
    return x


def _local_spacing(nodes: Floats, cells: Numbers, numbers: Integers) -> Floats:
    """Per node the mean distance to its 2 dim + 2 nearest others; per point the mean over its cell."""
    count = min(2 * nodes.shape[1] + 2, len(nodes) - 1)
    distances = np.asarray(cKDTree(nodes).query(nodes, count + 1)[0])[:, 1:]
    twins = np.flatnonzero(distances[:, 0] == 0)
    if twins.size:
        same = numbers[(nodes == nodes[twins[0]]).all(axis=1)]
        raise MeshError(f"nodes {np.sort(same).tolist()} coincide at {nodes[twins[0]].tolist()}")
    per_node: Floats = distances.mean(axis=1)
    return np.asarray(per_node[cells].mean(axis=1))
