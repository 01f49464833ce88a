"""The fields themselves, u(x) = sum_a N_a(x) u_a, anywhere: what is checked, measured and drawn.

Maximum-entropy functions do not interpolate: a coefficient u_a is not the field at node a, and may lie outside of all
values that the field has. On a wall only the nodes of that wall take part, in a limit that Newton does not reach: there
the field is that a little inside, and its slope there the rest of the way.
"""

from collections.abc import Iterator

import numpy as np

from . import sampling
from .arrays import Floats, Integers
from .case import Case
from .discretisation import lme_at
from .geometry import Mesh
from .neighbours import Grid, make_grid
from .shape import ShapeTable, pad_rows, row_offsets

INSIDE = 1e-3  # widths that a place is moved away from a wall
BLOCK = 1 << 15  # places at a time: keeps tables small


def tables(case: Case, mesh: Mesh, x: Floats, grid: Grid | None = None) -> Iterator[tuple[slice, ShapeTable]]:
    """The case's maximum-entropy functions at places x (q, dim), block by block; grid: of the nodes, if it exists."""
    margin, size = INSIDE * mesh.width, np.asarray(case.domain.size)
    grid = make_grid(mesh.nodes, 2.0 * mesh.width) if grid is None else grid
    for start in range(0, len(x), BLOCK):
        part = slice(start, min(start + BLOCK, len(x)))
        inside = np.clip(x[part], margin, size - margin)
        yield part, moved(lme_at(case, mesh, inside, grid), x[part] - inside)


def moved(table: ShapeTable, shift: Floats) -> ShapeTable:
    """The table with N + grad N . shift in the place of N; shift (p, dim)."""
    far = np.flatnonzero(shift.any(axis=1))
    if not far.size:
        return table
    counts = np.diff(table.offsets)[far]
    offsets = row_offsets(counts)
    own = table.table[:, np.repeat(table.rows[far] - offsets[:-1], counts) + np.arange(offsets[-1])]
    own[0] += (own[1:] * np.repeat(shift[far], counts, axis=0).T).sum(axis=0)
    starts, more = pad_rows(offsets, own)
    rows = table.rows.copy()
    rows[far] = table.table.shape[1] + starts
    return ShapeTable(table.offsets, table.nodes, rows, np.concatenate([table.table, more], axis=1))


def at(case: Case, mesh: Mesh, x: Floats, u: Floats, grid: Grid | None = None) -> Floats:
    """The fields of the coefficients u (n, F) at places x (q, dim)."""
    values = np.empty((len(x), u.shape[1]))
    for part, table in tables(case, mesh, x, grid):
        sampling.sample(values[part], u, table.offsets, table.nodes, table.rows, table.table)
    return values


def at_nodes(case: Case, mesh: Mesh, nodes: Integers | slice, u: Floats, grid: Grid | None = None) -> Floats:
    """The fields of the coefficients u (n, F) at some nodes; those of linear functions are the coefficients."""
    if case.shape_functions.kind == "linear":
        return u[nodes]
    return at(case, mesh, mesh.nodes[nodes], u, grid)


def shares(case: Case, mesh: Mesh, x: Floats, weights: Floats) -> Floats:
    """omega (n,) with sum_q w_q u(x_q) = sum_a omega_a u_a."""
    omega = np.zeros(len(mesh.nodes))
    for part, table in tables(case, mesh, x):
        each = np.repeat(weights[part], np.diff(table.offsets))
        omega += np.bincount(table.nodes, table.entries()[0] * each, minlength=len(omega))
    return omega
