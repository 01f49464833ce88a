"""The integral of a field over a box: quadrature rules that are exact for cubics.

On free nodes a rule takes the field where it likes: `gauss_rule`. On a lattice, and with linear functions, nodal values
count as samples of something smooth. Around every node a lies a cubic p_a, fitted to the values f_b of the nodes near
by (moving least squares):

    p_a(x) = P(x - x_a) . c_a,  G_a c_a = sum_b W_ab P(x_b - x_a) f_b,  G_a = sum_b W_ab P(x_b - x_a) P(x_b - x_a)^T

where P are the monomials and W_ab falls smoothly from 1 at x_a to 0 at the reach of the fit. In a cell f is the mean of
the fits around its corners, and this mean is integrated exactly over the part of the cell that lies in the box:

    int_box f dV = sum_a M_a . c_a = sum_b omega_b f_b,   omega_b = sum_a W_ab P(x_b - x_a) . G_a^-1 M_a,
    M_a = 1 / (dim + 1) sum_(cells at a) int_(cell in box) P(x - x_a) dV.

The values count as samples of f: interpolating them with shape functions that smooth would move every interface which
the box cuts. Deep in a lattice all fits are alike, and omega_b is the volume of a node: the trapezoidal rule.
"""

from typing import NamedTuple

import numpy as np

from .arrays import Flags, Floats, Integers, Numbers
from .clip import clip_cells
from .geometry import Mesh
from .jit import jit
from .partition import Ranks

GAUSS = 3.0**-0.5  # Gauss's two points in [-1, 1]
DEGREE = 3  # of the fits
REACH = 2.0  # in local nodal spacings: beyond, fits smooth what is 1 spacing wide; below, they have too few nodes
WIDER = 1.25  # factor on a reach whose nodes do not determine a polynomial,
ATTEMPTS = 6  # so many times; then the degree there is one less
PIVOT = 1e-5  # of G, scaled to a diagonal of ones: less means that they do not
LONGEST = 0.65  # edge of a lattice, in reaches: 2 / sqrt(3) spacings, stretched by 1/12 where anything is deep
BLOCK = 1 << 16  # cells cut at a time


class Monomials(NamedTuple):
    """P_0 = 1, P_m(y) = P_parent(y) y_axis, by rising degree; the first ends[k] have degrees up to k."""

    parent: Integers
    axis: Integers
    ends: Integers


class Bins(NamedTuple):
    """Nodes sorted into cubes of edge `width`: a bin's are at starts[bin] ... starts[bin + 1] of x and number."""

    x: Floats  # (n, dim)
    number: Integers  # (n,) in the mesh
    starts: Integers  # (bins + 1,)
    shape: Integers  # (dim,) bins along each axis, the last one runs fastest
    origin: Floats  # (dim,)
    width: float


def box_weights(mesh: Mesh, low: Floats, high: Floats, regular: bool, ranks: Ranks) -> Floats:
    """omega (n,) on all nodes of the mesh with sum_a omega_a f(x_a) = int_box f dV, exact for cubics. Collective.

    regular: the mesh is a lattice but for its walls, so that the weights deep in the box are known. Where nodes do not
    determine a cubic (a domain of three rows), the rule is exact for the highest degree that they do.
    """
    spacing = np.zeros(len(mesh.nodes))
    volumes = np.zeros(len(mesh.nodes))
    gather(spacing, volumes, mesh.cells, mesh.spacing, mesh.weights)
    # In reaches: fits are all alike from `first` inside the box on; one reach further in, so are weights; two reaches
    # further in are nodes whose fits change no other weights.
    reach = REACH * float(spacing.max())
    depth = np.minimum(mesh.nodes - low, high - mesh.nodes).min(axis=1) / reach
    walls = np.minimum(low - mesh.nodes.min(axis=0), mesh.nodes.max(axis=0) - high).min() / reach
    first = max(LONGEST, 1.0 - walls) if regular else np.inf
    deep, wanted = depth >= first + 1.0, depth < first + 2.0
    weights = np.zeros(len(mesh.nodes))
    add_fits(weights, mesh, low, high, spacing, wanted & share_of(wanted & (depth > 0.0), ranks))
    ranks.sum(weights)
    return np.where(deep, volumes, weights)


def gauss_rule(low: Floats, high: Floats, steps: Floats) -> tuple[Floats, Floats]:
    """Points (q, dim) and weights (q,) of a rule on a box that is exact for cubics: Gauss's, two points along each axis
    in each interval between multiples of that axis's step.
    """
    points, weights = [], []
    for a, b, step in zip(low, high, steps, strict=True):
        inner = step * np.arange(np.ceil(a / step), np.floor(b / step) + 1)
        ends = np.concatenate([[a], inner[(inner > a + 1e-9 * step) & (inner < b - 1e-9 * step)], [b]])
        middles, halves = 0.5 * (ends[1:] + ends[:-1]), 0.5 * np.diff(ends)
        points.append(np.add.outer(middles, np.zeros(2)).ravel() + np.outer(halves, [-GAUSS, GAUSS]).ravel())
        weights.append(np.repeat(halves, 2))
    place = np.stack(np.meshgrid(*points, indexing="ij"), axis=-1).reshape(-1, len(points))
    return place, np.prod(np.stack(np.meshgrid(*weights, indexing="ij"), axis=-1).reshape(-1, len(points)), axis=1)


def share_of(nodes: Flags, ranks: Ranks) -> Flags:
    """The interval of node numbers (as flags) that is this rank's: equal numbers of the given nodes to each."""
    place = np.cumsum(nodes) * ranks.size // (1 + int(np.count_nonzero(nodes)))
    return np.asarray(place == ranks.rank)


def add_fits(weights: Floats, mesh: Mesh, low: Floats, high: Floats, spacing: Floats, wanted: Flags) -> None:
    """Add W_ab P(x_b - x_a) . G_a^-1 M_a of the wanted nodes a to the weights of all b."""
    dim = mesh.nodes.shape[1]
    basis = monomials(dim, DEGREE)
    moments = np.zeros((len(mesh.nodes), basis.axis.size))
    rule = cubic_rule(dim)
    for start in range(0, len(mesh.cells), BLOCK):
        cells = mesh.cells[start : start + BLOCK]
        cells = cells[wanted[cells].any(axis=1)]
        corners, parts, owner = clip_cells(mesh.nodes, cells, low, high)
        add_moments(moments, corners, parts, cells[owner], mesh.nodes, wanted, *rule, basis)
    anchors = np.flatnonzero(moments[:, 0] > 0.0)
    bins = sort_into_bins(mesh.nodes, REACH * spacing)
    fit(weights, anchors, moments, mesh.nodes, spacing, bins, basis)


def monomials(dim: int, degree: int) -> Monomials:
    """All of them up to a degree: each times the coordinates from its last one on gives those one degree higher."""
    parent, axis, ends = [0], [0], [1]
    for k in range(degree):
        for m in range(ends[k - 1] if k else 0, ends[k]):
            for i in range(axis[m], dim):
                parent.append(m)
                axis.append(i)
        ends.append(len(axis))
    return Monomials(np.array(parent), np.array(axis), np.array(ends))


def cubic_rule(dim: int) -> tuple[Floats, Floats]:
    """Barycentric coordinates (q, dim + 1) and weights (q,) of a rule on a simplex that is exact for cubics.

    Its centre and the points 2 / (dim + 3) on from there to the corners.
    """
    centre, corners = np.full((1, dim + 1), 1.0 / (dim + 1)), (1.0 + 2.0 * np.eye(dim + 1)) / (dim + 3)
    outer = (dim + 3) ** 2 / (4.0 * (dim + 1) * (dim + 2))
    return np.concatenate([centre, corners]), np.array([1.0 - (dim + 1) * outer] + [outer] * (dim + 1))


def sort_into_bins(nodes: Floats, reach: Floats) -> Bins:
    """Bins as wide as most fits reach, at most 512 along an axis."""
    origin, extent = nodes.min(axis=0), np.ptp(nodes, axis=0)
    width = max(float(np.median(reach)), float(extent.max()) / 512.0)
    places = ((nodes - origin) / width).astype(np.int64)
    shape = places.max(axis=0) + 1
    code = np.ravel_multi_index(tuple(places.T), tuple(shape))
    order = np.argsort(code, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(code, minlength=int(shape.prod())))])
    return Bins(nodes[order], order, starts, shape, origin, width)


@jit
def gather(spacing: Floats, volumes: Floats, cells: Numbers, cell_spacing: Floats, cell_volumes: Floats) -> None:
    """Each node's largest spacing and its share 1 / (dim + 1) of the volume, of the cells around it."""
    for p in range(len(cells)):
        for a in cells[p]:
            spacing[a] = max(spacing[a], cell_spacing[p])
            volumes[a] += cell_volumes[p] / cells.shape[1]


@jit
def add_moments(
    moments: Floats, corners: Floats, volumes: Floats, cells: Numbers, nodes: Floats, wanted: Flags,
    rule: Floats, rule_weights: Floats, basis: Monomials,
) -> None:
    """M_a: add the moments of simplices (s, dim + 1, dim), parts of cells (s, dim + 1), at their wanted corners."""
    points, dim = len(rule_weights), nodes.shape[1]
    x, y, P = np.empty((dim, points)), np.empty((dim, points)), np.empty((moments.shape[1], points))
    for s in range(len(volumes)):
        for i in range(dim):
            for q in range(points):
                x[i, q] = 0.0
                for corner in range(dim + 1):
                    x[i, q] += rule[q, corner] * corners[s, corner, i]
        for a in cells[s]:
            if not wanted[a]:
                continue
            for i in range(dim):
                for q in range(points):
                    y[i, q] = x[i, q] - nodes[a, i]
            evaluate(P, y, points, basis)
            for m in range(len(P)):
                mean = 0.0
                for q in range(points):
                    mean += rule_weights[q] * P[m, q]
                moments[a, m] += mean * volumes[s] / (dim + 1)


@jit
def evaluate(P: Floats, y: Floats, points: int, basis: Monomials) -> None:
    """The monomials (m, points) at y (dim, points)."""
    for q in range(points):
        P[0, q] = 1.0
    for m in range(1, len(P)):
        parent, axis = basis.parent[m], basis.axis[m]
        for q in range(points):
            P[m, q] = P[parent, q] * y[axis, q]


@jit
def fit(
    weights: Floats, anchors: Integers, moments: Floats, nodes: Floats, spacing: Floats, bins: Bins, basis: Monomials
) -> None:
    """Add W_ab P(x_b - x_a) . G_a^-1 M_a of the anchors a to the weights, all in units of a's spacing."""
    dim, size = nodes.shape[1], moments.shape[1]
    near, W, share, y, P = room(64, dim, size)
    G, M, c = np.empty((size, size)), np.empty(size), np.empty(size)
    for a in anchors:
        degree, attempt, reach = DEGREE, 0, REACH
        while True:
            count = find(near, nodes[a], reach * spacing[a], bins)
            if count > near.size:
                near, W, share, y, P = room(2 * count, dim, size)
                continue
            for b in range(count):
                r2 = 0.0
                for i in range(dim):
                    y[i, b] = (bins.x[near[b], i] - nodes[a, i]) / spacing[a]
                    r2 += y[i, b] ** 2
                r = np.sqrt(r2) / reach
                W[b] = (1.0 - r) ** 4 * (4.0 * r + 1.0)
            terms = basis.ends[degree]
            evaluate(P, y, count, basis)
            if count >= terms and factorise(G, share, P[:terms], W[:count]):
                break
            attempt, reach = attempt + 1, reach * WIDER
            if attempt > ATTEMPTS:
                degree, attempt, reach = degree - 1, 0, REACH
        unit = 1.0
        for k in range(degree + 1):
            for m in range(basis.ends[k - 1] if k else 0, basis.ends[k]):
                M[m] = moments[a, m] * unit
            unit /= spacing[a]
        share[:count] = 0.0
        for _ in range(2):  # once more for what rounding leaves of the moments
            for m in range(terms):
                left = M[m]
                for b in range(count):
                    left -= P[m, b] * share[b]
                c[m] = left
            solve(c, G, terms)
            for m in range(terms):
                for b in range(count):
                    share[b] += c[m] * W[b] * P[m, b]
        for b in range(count):
            weights[bins.number[near[b]]] += share[b]


@jit
def room(count: int, dim: int, size: int) -> tuple[Integers, Floats, Floats, Floats, Floats]:
    """Scratch arrays for so many nodes: their places in the bins, W, shares, y and P."""
    return np.empty(count, np.int64), np.empty(count), np.empty(count), np.empty((dim, count)), np.empty((size, count))


@jit
def find(near: Integers, x: Floats, reach: float, bins: Bins) -> int:
    """The places in the bins of the nodes within reach of x; returns their number, which may be more than fit."""
    dim, last, count = len(x), len(x) - 1, 0
    lower, upper = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for i in range(dim):
        lower[i] = max(0, int((x[i] - reach - bins.origin[i]) / bins.width))
        upper[i] = min(int(bins.shape[i]) - 1, int((x[i] + reach - bins.origin[i]) / bins.width))
    for i in range(lower[0], upper[0] + 1):
        for j in range(lower[1], upper[1] + 1) if dim == 3 else range(1):
            row = ((i * bins.shape[1] + j) if dim == 3 else i) * bins.shape[last]
            for b in range(bins.starts[row + lower[last]], bins.starts[row + upper[last] + 1]):
                r2 = 0.0
                for k in range(dim):
                    r2 += (bins.x[b, k] - x[k]) ** 2
                if r2 < reach**2:
                    if count < near.size:
                        near[count] = b
                    count += 1
    return count


@jit
def factorise(G: Floats, WP: Floats, P: Floats, W: Floats) -> bool:
    """Cholesky's factor of sum_b W_b P_b P_b^T in the lower triangle of G; False where it is as good as singular."""
    for i in range(len(P)):
        for b in range(len(W)):
            WP[b] = W[b] * P[i, b]
        for j in range(i + 1):
            total = 0.0
            for b in range(len(W)):
                total += WP[b] * P[j, b]
            G[i, j] = total
    for i in range(len(P)):
        diagonal = G[i, i]
        for j in range(i + 1):
            total = G[i, j]
            for k in range(j):
                total -= G[i, k] * G[j, k]
            G[i, j] = total / G[j, j] if j < i else total
        if not G[i, i] > PIVOT * diagonal:
            return False
        G[i, i] = np.sqrt(G[i, i])
    return True


@jit
def solve(c: Floats, L: Floats, terms: int) -> None:
    """c <- (L L^T)^-1 c in its first terms."""
    for i in range(terms):
        total = c[i]
        for k in range(i):
            total -= L[i, k] * c[k]
        c[i] = total / L[i, i]
    for i in range(terms - 1, -1, -1):
        c[i] /= L[i, i]
        for k in range(i):
            c[k] -= L[i, k] * c[i]
