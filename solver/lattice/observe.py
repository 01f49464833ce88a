"""What is measured on a lattice: of the fields u(x) = sum_a N_a(x) u_a, wherever they are asked for."""

from typing import Any

import numpy as np

from ..arrays import Floats
from ..neck import section
from ..observe import distance, history_row
from ..output import Fields
from ..pack_box import PackBox, overlap
from . import loops
from .axis import Axis
from .scheme import LatticeScheme, LatticeState

GAUSS = 8  # points per cell of the integral over the vacancy box

# A square cut into two triangles, a cube into six tetrahedra along its diagonal: corners, slow axis first
TRIANGLES = (((0, 0, 0), (0, 0, 1), (1, 0, 1)), ((0, 0, 0), (1, 0, 1), (1, 0, 0)))
TETRAHEDRA = tuple(
    ((0, 0, 0), tuple(int(i == a) for i in range(3)), tuple(int(i != c) for i in range(3)), (1, 1, 1))
    for a in range(3) for c in range(3) if a != c
)  # fmt: skip


class LatticeObservables:
    """Computes history rows. Collective; rows exist on rank 0 alone."""

    def __init__(self, scheme: LatticeScheme) -> None:
        g, output = scheme.lattice, scheme.case.output
        low, high = (np.asarray(corner, dtype=float) for corner in output.vacancy_box)
        self.box_volume = float(np.prod(high - low))
        corners = [along(corner) for corner in (low, high)]
        self.pack, self.scheme = PackBox(scheme.case), scheme
        self.box = [
            np.ones(1) if axis is None else integrals(axis, corners[0][k], corners[1][k])
            for k, axis in enumerate(g.axes)
        ]

    def row(
        self, scheme: LatticeScheme, state: LatticeState, y: Floats, time: float, wall_time: float
    ) -> dict[str, Any]:
        """One history row, named as in the run directory's history.jsonl."""
        g, m, switch, count = scheme.lattice, scheme.lattice.coefficients, scheme.case.activation, scheme.particles
        held = slice(g.owned.start - g.planes.start, g.owned.stop - g.planes.start)
        rho = g.values(y)[held]
        m_slow, m_middle, m_fast = (sums[0] for sums in g.moments)  # m_a is the sum over p of their products
        mass = np.einsum("smf,ps,pm,pf->", rho, m_slow[:, g.owned], m_middle, m_fast, optimize=True)
        F, live, least, largest = loops.energy(
            y.reshape(1, -1), scheme.layout, g.tables, scheme.room, m, switch.eps_rho, switch.eps_eta,
            g.layers.start, g.layers.start, g.layers.stop,
        )  # fmt: skip
        box = self._in_box(rho)
        moments = scheme.moments(y)
        sums = np.concatenate([[mass, F, live, box], moments.ravel()])
        if count == 2:
            sums = np.append(sums, neck(scheme, y))
        g.ranks.sum(sums)
        moments = sums[4 : 4 + moments.size].reshape(moments.shape)
        bounds = g.ranks.max(np.array([-least, largest]))
        points = 2.0 * np.prod([axis.cells for axis in g.axes if axis is not None])
        vacancy_ratio = 1.0 - sums[3] / self.box_volume
        fractions = sums[2] / points, 1.0
        row = history_row(state, time, wall_time, moments, vacancy_ratio, sums[0], sums[1], fractions, bounds)
        row["pack_porosity"] = self._porosity(vacancy_ratio, rho, moments)
        if count == 2:
            row["neck_length"] = float(sums[-1])
            row["centre_distance"] = distance(moments)
        return row

    def vacancy_ratio(self, state: LatticeState) -> float:
        """Of the state's own fields. Collective."""
        g = self.scheme.lattice
        held = slice(g.owned.start - g.planes.start, g.owned.stop - g.planes.start)
        return float(1.0 - g.ranks.sum(np.array([self._in_box(g.values(state.y)[held])]))[0] / self.box_volume)

    def _in_box(self, rho: Floats) -> float:
        """This rank's part of the field's integral over the vacancy box; rho: coefficients of the nodes it owns."""
        slow = self.box[0][self.scheme.lattice.owned]
        return float(np.einsum("smf,s,m,f->", rho, slow, self.box[1], self.box[2], optimize=True))

    def _porosity(self, vacancy_ratio: float, rho: Floats, moments: Floats) -> float:
        """See `observe.Observables`. Collective."""
        g = self.scheme.lattice
        means = []
        for low, high in ((self.pack.low, self.pack.high), self.pack.now(moments)):
            inside = [
                np.ones((2, 1)) if axis is None else overlap(axis.points, axis.step, a, b)
                for axis, a, b in zip(g.axes, along(low), along(high), strict=True)
            ]
            slow, middle, fast = (
                part if axis is None else axis.sums(part) for axis, part in zip(g.axes, inside, strict=True)
            )
            solid = np.einsum("smf,ps,pm,pf->", rho, slow[:, g.owned], middle, fast, optimize=True)
            volume = np.prod([part.sum(axis=1) for part in inside], axis=0).sum()
            means.append(float(g.ranks.sum(np.array([solid]))[0] / volume))
        return vacancy_ratio + means[0] - means[1]


def along(corner: Floats) -> Floats:
    """Coordinates in the order of a lattice's axes: slow, middle (0 in 2-D), fast."""
    return corner[::-1] if len(corner) == 3 else np.insert(corner[::-1], 1, 0.0)


def integrals(axis: Axis, low: float, high: float) -> Floats:
    """int_low^high N_i dx of the axis' nodes i."""
    x, w = np.polynomial.legendre.leggauss(GAUSS)
    edges = np.unique(np.clip(np.concatenate([axis.nodes, [low, high]]), low, high))
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    points = middle[:, None] + half[:, None] * x
    return np.asarray((half[:, None] * w).ravel() @ axis.at(points.ravel()))


def at_nodes(scheme: LatticeScheme, values: Floats, first: tuple[int, int, int]) -> Floats:
    """The field at the nodes where these are its coefficients: values (slow, middle, fast), the first node's place.

    Beside the array the coefficients count as 0.
    """
    for k, axis in enumerate(scheme.lattice.axes):
        if axis is None:
            continue
        table = scheme.at_nodes[k] if k in scheme.at_nodes else axis.at_nodes()
        scheme.at_nodes[k] = table
        count, reach = values.shape[k], axis.reach
        moved = np.moveaxis(values, k, 0)
        padded = np.pad(moved, [(reach - 1, reach - 1), (0, 0), (0, 0)])
        found = np.zeros_like(moved)
        for t in range(2 * reach - 1):
            found += table[first[k] : first[k] + count, t, None, None] * padded[t : t + count]
        values = np.moveaxis(found, 0, k)
    return values


def field_of(scheme: LatticeScheme, y: Floats, w: int) -> tuple[Floats, tuple[int, int, int]]:
    """Coefficients of a window's field on its nodes, and the place of the first."""
    g, layout = scheme.lattice, scheme.layout
    low, size = layout.low[w], layout.size[w]
    values = y[layout.offset[w] : layout.offset[w + 1]].reshape(size)
    begin, end = max(0, -int(low[2])), min(int(size[2]), g.nodes[2] - int(low[2]))
    return values[:, :, begin:end], (int(low[0]), int(low[1]), int(low[2]) + begin)


def nodal(scheme: LatticeScheme, y: Floats) -> Fields:
    """At this rank's nodes."""
    rho = at_nodes(scheme, *field_of(scheme, y, 0))
    largest, squares = np.full(rho.shape, -np.inf), np.zeros(rho.shape)
    particle = np.full(rho.shape, -1, dtype=np.int32)
    start = scheme.layout.low[0, 0]
    for w in range(1, len(scheme.layout.low)):
        values, first = field_of(scheme, y, w)
        if not values.size:
            continue
        eta = at_nodes(scheme, values, first)
        here = tuple(slice(f - s, f - s + n) for f, s, n in zip(first, (start, 0, 0), eta.shape, strict=True))
        more = eta > largest[here]
        largest[here] = np.where(more, eta, largest[here])
        particle[here] = np.where(more, w - 1, particle[here])
        squares[here] += eta**2
    return Fields(rho.ravel(), squares.ravel(), np.where(rho >= 0.5, particle, -1).astype(np.int32).ravel())


def neck(scheme: LatticeScheme, y: Floats) -> float:
    """This rank's part of the neck of two particles: the measure of {eta_1 = eta_2, rho > 1/2}, nm^(dim - 1).

    The fields are evaluated at the nodes, and are linear in between.
    """
    g = scheme.lattice
    fields = [field_of(scheme, y, w) for w in range(3)]
    low = np.max([first for _, first in fields[1:]], axis=0)
    high = np.min([np.array(first) + values.shape for values, first in fields[1:]], axis=0)
    low[0], high[0] = max(low[0], g.layers.start), min(high[0], g.layers.stop + 1)
    if (high - low < np.array([2, 1 if g.dim == 2 else 2, 2])).any():
        return 0.0
    there = []
    for values, first in fields:
        reach = g.reach
        begin = [max(0, low[k] - first[k] - reach) for k in range(3)]
        part = values[tuple(slice(begin[k], high[k] - first[k] + reach) for k in range(3))]
        place = tuple(first[k] + begin[k] for k in range(3))
        whole = at_nodes(scheme, part, (place[0], place[1], place[2]))
        there.append(whole[tuple(slice(low[k] - place[k], high[k] - place[k]) for k in range(3))])
    u = np.stack(there, axis=-1)
    cuts = TRIANGLES if g.dim == 2 else TETRAHEDRA
    axes = [axis.nodes[low[k] : high[k]] if axis is not None else np.zeros(1) for k, axis in enumerate(g.axes)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)[..., [0, 2] if g.dim == 2 else [0, 1, 2]]
    count = np.array(u.shape[:3]) - np.array([1, 0 if g.dim == 2 else 1, 1])
    most = np.full(count, -np.inf)[..., None]
    for corner in {corner for cut in cuts for corner in cut}:
        most = np.maximum(most, u[tuple(slice(c, c + n) for c, n in zip(corner, count, strict=True))])
    near = (most[..., 0] > 0.2) & (most[..., 1] > 0.01) & (most[..., 2] > 0.01)
    cells = np.argwhere(near)
    if not len(cells):
        return 0.0
    total = 0.0
    for cut in cuts:
        places = [tuple((cells + np.array(corner)).T) for corner in cut]
        total += section(np.stack([grid[p] for p in places], axis=1), np.stack([u[p] for p in places], axis=1))
    return total
