"""Shape functions: who sees whom, and with what weight.

`lme` builds local maximum-entropy functions (Arroyo & Ortiz 2006) on scattered nodes, `linear` the finite-element
functions of the same mesh. Both give a `ShapeTable`, the only thing that the kernels know of the discretisation.
"""

from dataclasses import dataclass

import numpy as np

from .arrays import Codes, Floats, Integers, Numbers
from .jit import jit
from .neighbours import Grid, make_grid
from .simd import LANES

CONVERGED = 1e-13  # |sum N (x - x_a)| / h; the consistency of the table is this times h
NEWTON_STEPS = 60
WIDER = 1.25  # factor on h at a point whose Newton iteration fails
ATTEMPTS = 8


class ShapeError(ValueError):
    """Shape functions that cannot be had; the message names the point, gamma and the number of nodes in range."""


@dataclass(frozen=True)
class ShapeTable:
    """Who sees whom: point p sees nodes[offsets[p] + i], i < offsets[p + 1] - offsets[p].

    Its shape functions are table[:, rows[p] + i] = (N, grad N), grad N in 1/nm. Points that see the same pattern of
    nodes, as nearly all of a lattice do, share their rows: the table stays in the processor's cache. Rows start at
    multiples of LANES, and zeros fill them up, so that loops may run over whole packs.
    offsets (p + 1,), nodes (e,), rows (p,), table (1 + dim, stored).
    """

    offsets: Integers
    nodes: Numbers
    rows: Integers
    table: Floats

    @property
    def points(self) -> int:
        """The number of points."""
        return self.rows.size

    @property
    def longest(self) -> int:
        """Room for the longest row, in whole packs."""
        return int(padded(np.diff(self.offsets).max(initial=0)))

    def of(self, p: int) -> tuple[Numbers, Floats]:
        """The nodes that a point sees, and their N there."""
        seen = self.nodes[self.offsets[p] : self.offsets[p + 1]]
        return seen, self.table[0, self.rows[p] : self.rows[p] + seen.size]

    def part(self, points: slice) -> "ShapeTable":
        """Some points, one after the other."""
        offsets = self.offsets[points.start : points.stop + 1]
        return ShapeTable(offsets, self.nodes, self.rows[points], self.table)

    def entries(self) -> Floats:
        """(N, grad N) of every entry, in the order of `nodes`: (1 + dim, e)."""
        counts = np.diff(self.offsets)
        return self.table[:, np.repeat(self.rows - self.offsets[:-1], counts) + np.arange(self.nodes.size)]


@dataclass(frozen=True)
class Nearest:
    """The nodes that count most: nodes[offsets[p] + places[e]] at point p, starts[kind[p]] <= e < starts[kind[p] + 1].

    They are in the order of falling N. kind (p,), starts (kinds + 1,), places: points that share rows share these.
    """

    kind: Integers
    starts: Integers
    places: Numbers


def nearest(table: ShapeTable, least: float) -> Nearest:
    """The nodes with N_a(x_p) >= least."""
    rows, first, kind = np.unique(table.rows, return_index=True, return_inverse=True)
    counts = np.diff(table.offsets)[first]
    starts = np.zeros(rows.size + 1, dtype=np.int64)
    none = np.empty(0, dtype=np.int32)
    choose(none, starts, rows, counts, table.table, least)
    np.cumsum(starts, out=starts)
    places = np.empty(int(starts[-1]), dtype=np.int32)
    choose(places, starts, rows, counts, table.table, least)
    return Nearest(kind.astype(np.int64), starts, places)


@jit
def choose(places: Numbers, starts: Integers, rows: Integers, counts: Integers, table: Floats, least: float) -> None:
    """Count the entries of at least `least` of row r into starts[r + 1] where `places` is empty, else write them."""
    for r in range(rows.size):
        order = np.argsort(-table[0, rows[r] : rows[r] + counts[r]])
        for i in range(counts[r]):
            if table[0, rows[r] + order[i]] < least:
                break
            if places.size:
                places[starts[r] + i] = order[i]
            else:
                starts[r + 1] += 1


def row_offsets(counts: Integers) -> Integers:
    """The starts of rows of the given lengths, and the end of the last."""
    return np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts, dtype=np.int64)])


def padded(counts: Integers) -> Integers:
    """Counts rounded up to whole packs."""
    return LANES * -(-counts // LANES)


def pad_rows(offsets: Integers, table: Floats) -> tuple[Integers, Floats]:
    """Spread the rows table[:, offsets[p] : offsets[p + 1]] to multiples of LANES, zeros between; their new starts."""
    counts = np.diff(offsets)
    starts = row_offsets(padded(counts))
    spread = np.zeros((len(table), int(starts[-1])))
    spread[:, np.repeat(starts[:-1] - offsets[:-1], counts) + np.arange(table.shape[1])] = table
    return starts[:-1], spread


def search_range(spacing: Floats, gamma: float, tolerance: float) -> Floats:
    """r = h sqrt(-ln(delta_0) / gamma): where exp(-beta r^2) with beta = gamma / h^2 falls to delta_0; nm."""
    return np.asarray(spacing * np.sqrt(-np.log(tolerance) / gamma))


def linear(points: Floats, cells: Numbers, nodes: Floats) -> ShapeTable:
    """Barycentric coordinates of each point in the cell of the same number, and their constant gradients.

    points (p, dim), cells (p, dim + 1), nodes (n, dim).
    """
    count, corners = cells.shape
    edges = nodes[cells[:, 1:]] - nodes[cells[:, :1]]
    gradients = np.linalg.inv(edges).transpose(0, 2, 1)
    table = np.empty((count, corners, corners))
    table[:, 1:, 1:] = gradients
    table[:, 0, 1:] = -gradients.sum(axis=1)
    table[:, 1:, 0] = np.einsum("pkd,pd->pk", gradients, points - nodes[cells[:, 0]])
    table[:, 0, 0] = 1.0 - table[:, 1:, 0].sum(axis=1)
    offsets = np.arange(count + 1, dtype=np.int64) * corners
    rows, spread = pad_rows(offsets, table.reshape(-1, corners).T)
    return ShapeTable(offsets, cells.reshape(-1).astype(np.int32), rows, spread)


def lme(
    points: Floats, spacing: Floats, nodes: Floats, gamma: float, tolerance: float, grid: Grid | None = None
) -> ShapeTable:
    """Local maximum-entropy functions of the nodes at the points.

    N_a(x) = exp(-beta |x - x_a|^2 + lambda . (x - x_a)) / Z with beta = gamma / h^2 and lambda such that
    sum_a N_a (x - x_a) = 0;  grad N_a = -N_a J^-1 (x - x_a),  J = sum_a N_a (x - x_a)(x - x_a)^T.
    N_a is dropped beyond `search_range`. points (p, dim) nm, spacing (p,) h at the points in nm, nodes (n, dim) nm;
    grid: of the nodes, made when absent.

    A point whose Newton iteration does not converge is tried again with h, and so the range, 1.25 times wider, up to
    8 times; ShapeError says which point defeats that. Source: Arroyo & Ortiz (2006), equations (24)-(33).
    """
    ranges = search_range(spacing, gamma, tolerance)
    grid = make_grid(nodes, float(np.median(ranges)) if ranges.size else 1.0) if grid is None else grid
    offsets, near = grid.within(points, ranges)
    keys = np.empty(len(points), dtype=np.uint64)
    arrange(near, keys, points, spacing, nodes, offsets)
    _, first, kind = np.unique(keys, return_index=True, return_inverse=True)
    table, residual = _solve(points[first], spacing[first], nodes, *_pick(offsets, near, first), gamma)
    starts, table = pad_rows(row_offsets(np.diff(offsets)[first]), table)
    if not (failed := np.flatnonzero(~(residual[kind] <= CONVERGED))).size:
        return ShapeTable(offsets, near, starts[kind], table)
    rows = starts[kind]
    lists = np.split(near, offsets[1:-1])
    for p in failed:
        rows[p] = table.shape[1]
        lists[p], more = _repair(int(p), points[p], spacing[p], grid, gamma, tolerance)
        table = np.concatenate([table, pad_rows(np.array([0, more.shape[1]]), more)[1]], axis=1)
    return ShapeTable(row_offsets(np.array([part.size for part in lists])), np.concatenate(lists), rows, table)


def _pick(offsets: Integers, near: Numbers, chosen: Integers) -> tuple[Integers, Numbers]:
    """Offsets and neighbours of the chosen points alone."""
    counts = np.diff(offsets)[chosen]
    picked = row_offsets(counts)
    return picked, near[np.repeat(offsets[chosen] - picked[:-1], counts) + np.arange(picked[-1])]


def _solve(
    points: Floats, spacing: Floats, nodes: Floats, offsets: Integers, near: Numbers, gamma: float
) -> tuple[Floats, Floats]:
    """Table and Newton residuals |r| / h of some points."""
    table = np.empty((1 + nodes.shape[1], near.size))
    residual = np.empty(len(points))
    solve_lme(table, residual, points, spacing, nodes, offsets, near, gamma)
    return table, residual


def _repair(
    p: int, point: Floats, spacing: float, grid: Grid, gamma: float, tolerance: float
) -> tuple[Numbers, Floats]:
    """Neighbours and table rows of a point that needs a wider range, or ShapeError."""
    h = np.array([spacing])
    for _ in range(ATTEMPTS):
        h *= WIDER
        offsets, near = grid.within(point[None], search_range(h, gamma, tolerance))
        table, residual = _solve(point[None], h, grid.nodes, offsets, near, gamma)
        if residual[0] <= CONVERGED:
            return near, table
    r = float(search_range(h, gamma, tolerance)[0])
    raise ShapeError(
        f"Newton stopped at |r| = {residual[0]:.1e} h at point {p} ({', '.join(f'{x:.6g}' for x in point)}) nm with "
        f"gamma = {gamma:g}: {near.size} nodes within {r:.3g} nm do not surround it"
    )


@jit
def arrange(
    near: Numbers, keys: Codes, points: Floats, spacing: Floats, nodes: Floats, offsets: Integers
) -> None:
    """Order each point's neighbours by their displacement in units of h, and give equal patterns equal keys.

    Displacements count as equal within 2^-30 h. The order is that of x: nodes of one row, to which `block_kernels` adds
    overlapping packs, then come far apart. Beyond that, order and key come from a hash: only equality matters.
    """
    dim = points.shape[1]
    most = 0
    for p in range(keys.size):
        most = max(most, offsets[p + 1] - offsets[p])
    code = np.empty(most, dtype=np.uint64)
    along = np.empty(most, dtype=np.uint64)
    sorted_near = np.empty(most, dtype=near.dtype)
    for p in range(keys.size):
        first = offsets[p]
        count = offsets[p + 1] - first
        for i in range(count):
            h = np.uint64(1469598103934665603)
            for k in range(dim):
                units = np.rint((nodes[near[first + i], k] - points[p, k]) / spacing[p] * 2.0**30)
                h = mix(h, np.uint64(np.int64(units)))
                if k == 0:
                    along[i] = np.uint64(np.int64(units) + 2**39) << np.uint64(24)
            code[i] = h
            along[i] |= h >> np.uint64(40)
        order = np.argsort(along[:count])
        key = mix(np.uint64(count), np.uint64(np.int64(np.rint(spacing[p] * 2.0**30))))
        for i in range(count):
            key = mix(key, code[order[i]])
            sorted_near[i] = near[first + order[i]]
        keys[p] = key
        for i in range(count):
            near[first + i] = sorted_near[i]


@jit
def mix(h: np.uint64, value: np.uint64) -> np.uint64:
    """A 64-bit hash of h and value, by multiplication and shifts."""
    h = (h ^ value) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    return h ^ (h >> np.uint64(32))


@jit
def solve_lme(
    table: Floats, residual: Floats, points: Floats, spacing: Floats, nodes: Floats,
    offsets: Integers, near: Numbers, gamma: float,
) -> None:
    """Fill table (1 + dim, e) and residual (p,) = |sum N (x - x_a)| / h; infinity where no Newton step could be taken.

    Newton on the convex log Z(lambda), with step halving where log Z would grow, in units of h.
    """
    dim = points.shape[1]
    most = 0
    for p in range(points.shape[0]):
        most = max(most, offsets[p + 1] - offsets[p])
    d = np.empty((most, dim))
    weight = np.empty(most)
    multiplier = np.empty(dim)
    step = np.empty(dim)
    r = np.empty(dim)
    J = np.empty((dim, dim))
    inverse = np.empty((dim, dim))
    for p in range(points.shape[0]):
        first = offsets[p]
        count = offsets[p + 1] - first
        h = spacing[p]
        residual[p] = np.inf
        if count <= dim:
            continue
        for i in range(count):
            for k in range(dim):
                d[i, k] = (points[p, k] - nodes[near[first + i], k]) / h
        multiplier[:] = 0.0
        log_Z = sum_up(weight, r, J, d, count, multiplier, gamma)
        size = norm(r)
        for _ in range(NEWTON_STEPS):
            if size <= 1e-15 or not invert(inverse, J):
                break
            step[:] = 0.0
            for k in range(dim):
                for q in range(dim):
                    step[k] -= inverse[k, q] * r[q]
            descent = 0.0
            for k in range(dim):
                descent += step[k] * r[k]
            length = 1.0
            while True:
                for k in range(dim):
                    multiplier[k] += length * step[k]
                trial = sum_up(weight, r, J, d, count, multiplier, gamma)
                if size < 1e-4 or trial <= log_Z + 1e-4 * length * descent or length < 1e-6:
                    break
                for k in range(dim):
                    multiplier[k] -= length * step[k]
                length *= 0.5
            log_Z = trial
            previous = size
            size = norm(r)
            if size <= CONVERGED and size >= 0.5 * previous:
                break
        if not size <= CONVERGED:
            residual[p] = size
            continue
        if not invert(inverse, J):
            continue
        residual[p] = size
        for i in range(count):
            table[0, first + i] = weight[i]
            for k in range(dim):
                g = 0.0
                for q in range(dim):
                    g += inverse[k, q] * d[i, q]
                table[1 + k, first + i] = -weight[i] * g / h


@jit
def sum_up(
    weight: Floats, r: Floats, J: Floats, d: Floats, count: int, multiplier: Floats, gamma: float
) -> float:
    """weight = N_a, r = sum N d, J = sum N d d^T - r r^T (Hessian of log Z) and, returned, log Z; d in units of h."""
    dim = d.shape[1]
    largest = -np.inf
    for i in range(count):
        exponent = 0.0
        for k in range(dim):
            exponent += d[i, k] * (multiplier[k] - gamma * d[i, k])
        weight[i] = exponent
        largest = max(largest, exponent)
    Z = 0.0
    for i in range(count):
        weight[i] = np.exp(weight[i] - largest)
        Z += weight[i]
    r[:] = 0.0
    J[:] = 0.0
    for i in range(count):
        weight[i] /= Z
        for k in range(dim):
            r[k] += weight[i] * d[i, k]
            for q in range(k + 1):
                J[k, q] += weight[i] * d[i, k] * d[i, q]
    for k in range(dim):
        for q in range(k + 1):
            J[k, q] -= r[k] * r[q]
            J[q, k] = J[k, q]
    return float(np.log(Z) + largest)


@jit
def norm(r: Floats) -> float:
    """|r|."""
    square = 0.0
    for k in range(r.size):
        square += r[k] * r[k]
    return float(np.sqrt(square))


@jit
def invert(inverse: Floats, J: Floats) -> bool:
    """The inverse of a symmetric positive 2 x 2 or 3 x 3 matrix; False where its determinant is not positive."""
    if J.shape[0] == 2:
        det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
        if not det > 1e-300:
            return False
        inverse[0, 0] = J[1, 1] / det
        inverse[1, 1] = J[0, 0] / det
        inverse[0, 1] = -J[0, 1] / det
        inverse[1, 0] = inverse[0, 1]
        return True
    for i in range(3):
        for j in range(3):
            a = (j + 1) % 3
            b = (j + 2) % 3
            c = (i + 1) % 3
            e = (i + 2) % 3
            inverse[i, j] = J[a, c] * J[b, e] - J[a, e] * J[b, c]
    det = J[0, 0] * inverse[0, 0] + J[0, 1] * inverse[1, 0] + J[0, 2] * inverse[2, 0]
    if not det > 1e-300:
        return False
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= det
    return True
