"""The shape functions of one axis of a lattice, and their sums over its points.

With a box as search range, local maximum-entropy functions on a square or cubic lattice are products, at walls too: of
exp(-gamma (x - x_i)^2 / h^2 + lambda (x - x_i)) / Z along each axis. Every cell has two material points, at 1/4 and at
3/4 of its diagonal, so that an axis knows two sets of points, one at each quarter of its cells.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Integers
from ..shape import CONVERGED, NEWTON_STEPS, ShapeError
from ..simd import LANES

QUARTERS = (0.25, 0.75)  # of a cell, where its points are
SOME = 3  # reaches are whole multiples of it: loops take the taps of both sides six at a time
GHOSTS = 24  # places beyond both ends in tables by cell or node: packs may begin there


@dataclass(frozen=True)
class Axis:
    """n cells of equal length between n + 1 nodes; the tap t of cell c is node c - reach + 1 + t, t < 2 reach.

    N (2, n, 2 reach) are the functions of those nodes at the two points of each cell, 0 for nodes that are not there;
    dN (2, n, 2 reach) their derivatives, 1/nm.
    """

    length: float  # nm
    cells: int
    reach: int
    gamma: float  # of the functions in units of `step`
    tolerance: float
    N: Floats
    dN: Floats  # noqa: N815  (the derivative of N)

    @property
    def step(self) -> float:
        """The distance of neighbouring nodes, nm."""
        return self.length / self.cells

    @property
    def nodes(self) -> Floats:
        """Their positions, nm."""
        return np.linspace(0.0, self.length, self.cells + 1)

    @property
    def points(self) -> Floats:
        """Positions (2, n) of both points of each cell, nm."""
        return np.asarray((np.arange(self.cells) + np.array(QUARTERS)[:, None]) * self.step)

    def sums(self, values: Floats) -> Floats:
        """sum_c N_i(x_c) values_c at the nodes i: (2, n + 1) from (2, n) or less."""
        found = np.zeros((2, self.cells + 1))
        weighted = self.N * np.broadcast_to(values, self.N.shape[:2])[:, :, None]
        for t in range(2 * self.reach):
            first = t - self.reach + 1
            begin, end = max(0, -first), min(self.cells, self.cells + 1 - first)
            found[:, begin + first : end + first] += weighted[:, begin:end, t]
        return found

    def by_cell(self, table: Floats) -> Floats:
        """N or dN as (2 * 2 reach, n + ghosts): entry [p, t] of all cells in a row, 0 beyond the ends."""
        return np.pad(table.transpose(0, 2, 1).reshape(-1, self.cells), ((0, 0), (GHOSTS, GHOSTS)))

    def by_node(self, table: Floats) -> Floats:
        """N or dN as (2 * 2 reach, n + 1 + ghosts): row [p, t] holds node i's function at the cell c with tap t = i."""
        taps = 2 * self.reach
        rows = np.zeros((2 * taps, self.cells + 1 + 2 * GHOSTS))
        for t in range(taps):
            first = GHOSTS + t - self.reach + 1
            rows[t::taps, first : first + self.cells] = table[:, :, t]
        rows[:, :GHOSTS] = 0.0
        rows[:, GHOSTS + self.cells + 1 :] = 0.0
        return rows

    def at(self, x: Floats) -> Floats:
        """N_i(x) of all nodes i at places x (q,): (q, n + 1)."""
        return functions(x, self.nodes, self.step, self.gamma, self.tolerance)[0]

    def at_nodes(self) -> Floats:
        """Functions of the nodes i - reach + 1 ... i + reach - 1 at node i: (n + 1, 2 reach - 1)."""
        N = self.at(self.nodes)
        i = np.arange(self.cells + 1)[:, None]
        return _taps(N, i - self.reach + 1 + np.arange(2 * self.reach - 1))


def make_axis(length: float, spacing: float, gamma: float, tolerance: float, width: float | None = None) -> Axis:
    """The axis whose nodes are nearest to `spacing` apart; width: h of beta = gamma / h^2 if not their distance.

    Raises `ShapeError`.
    """
    cells = max(1, round(length / spacing))
    step = length / cells
    gamma = gamma if width is None else gamma * (step / width) ** 2
    reach = 1 + max(0, int(np.floor(search_range(gamma, tolerance) - QUARTERS[0])))
    if reach > LANES:
        raise ShapeError(f"gamma = {gamma:g} and tolerance = {tolerance:g}: functions reach {reach} nodes far")
    reach = SOME * -(-reach // SOME)
    nodes = np.linspace(0.0, length, cells + 1)
    points = (np.arange(cells)[None, :] + np.array(QUARTERS)[:, None]) * step
    N, dN = functions(points.ravel(), nodes, step, gamma, tolerance)
    taps = np.tile(np.arange(cells), 2)[:, None] - reach + 1 + np.arange(2 * reach)
    tables = (_taps(table, taps).reshape(2, cells, -1) for table in (N, dN))
    return Axis(length, cells, reach, gamma, tolerance, *tables)


def search_range(gamma: float, tolerance: float) -> float:
    """Distance in units of h beyond which exp(-gamma r^2 / h^2) < delta_0, and N_a is dropped."""
    return float(np.sqrt(-np.log(tolerance) / gamma)) * (1.0 + 1e-12)


def functions(points: Floats, nodes: Floats, h: float, gamma: float, tolerance: float) -> tuple[Floats, Floats]:
    """N (p, n) and dN/dx (p, n), 1/nm, of nodes h apart: Newton on sum N_i (x - x_i) = 0. Raises `ShapeError`.

    Few points of an axis differ: those that see a wall. The others have the functions of one that does not.
    """
    x = (points[:, None] - nodes[None, :]) / h
    near = np.abs(x) <= search_range(gamma, tolerance)
    ends = np.abs(points - nodes[0]), np.abs(nodes[-1] - points)  # one that stands on a wall is its node's alone
    on_wall = np.minimum(*ends) <= 1e-12 * h
    multiplier = np.zeros(len(points))
    for _ in range(NEWTON_STEPS):
        exponent = np.where(near, multiplier[:, None] * x - gamma * x * x, -np.inf)
        weight = np.exp(np.maximum(exponent - exponent.max(axis=1, keepdims=True), -700.0)) * near
        weight /= weight.sum(axis=1, keepdims=True)
        r = (weight * x).sum(axis=1)
        J = (weight * x * x).sum(axis=1) - r * r
        left = np.where(on_wall, 0.0, np.abs(r))
        if (left <= 0.01 * CONVERGED).all():
            break
        multiplier -= np.where(on_wall, 0.0, r / np.maximum(J, 1e-300)).clip(-2.0, 2.0)
    if not (left <= CONVERGED).all():
        p = int(left.argmax())
        raise ShapeError(
            f"Newton stopped at |r| = {left[p]:.1e} h at x = {points[p]:.6g} nm with gamma = {gamma:g}: "
            f"{int(near[p].sum())} nodes of the axis within its range do not surround it"
        )
    slope = -weight * x / np.maximum(J, 1e-300)[:, None] / h
    weight[on_wall], slope[on_wall] = np.abs(x[on_wall]) <= 1e-12, 0.0
    return weight, slope


def _taps(table: Floats, taps: Integers) -> Floats:
    """table[p, taps[p]], 0 where there is no such node."""
    inside = (taps >= 0) & (taps < table.shape[1])
    return np.where(inside, np.take_along_axis(table, np.clip(taps, 0, table.shape[1] - 1), axis=1), 0.0)
