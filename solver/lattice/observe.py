"""What is measured on a lattice: of the fields u(x) = sum_a N_a(x) u_a, wherever they are asked for."""

from typing import Any

import numpy as np

from ..arrays import Floats, Integers
from ..case import Box
from ..neck import section
from ..observe import distance, history_row
from ..output import Fields
from ..pack_box import PackBox, overlap
from . import loops
from .axis import Axis
from .scheme import LatticeScheme, LatticeState

PRESENT = 0.01  # a neck is where both order parameters are more; in its solid they are much more
GAUSS = 8  # points per cell of the integral over the vacancy box

# A square cut into two triangles, a cube into six tetrahedra along its diagonal: corners, slow axis first
TRIANGLES = (((0, 0, 0), (0, 0, 1), (1, 0, 1)), ((0, 0, 0), (1, 0, 1), (1, 0, 0)))
TETRAHEDRA = tuple(
    ((0, 0, 0), tuple(int(i == a) for i in range(3)), tuple(int(i != c) for i in range(3)), (1, 1, 1))
    for a in range(3) for c in range(3) if a != c
)  # fmt: skip


class LatticeObservables:
    """Computes history rows. Collective; rows exist on rank 0 alone."""

    def __init__(self, scheme: LatticeScheme, box: Box | None = None) -> None:
        """box: of the vacancy ratio, if not the case's."""
        g = scheme.lattice
        low, high = (np.asarray(corner, dtype=float) for corner in box or scheme.case.output.vacancy_box)
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
        rows = rho @ m_fast.T  # the sums of rows, then those of planes
        mass = sum(m_slow[p, g.owned] @ rows[:, :, p] @ m_middle[p] for p in range(2))
        F, live, least, largest = loops.energy(
            y.reshape(1, -1), scheme.layout, g.tables, scheme.room, m, switch.eps_rho, switch.eps_eta,
            g.layers.start, g.layers.start, g.layers.stop,
        )  # fmt: skip
        moments = scheme.moments(y)
        sums = np.concatenate([[mass, F, live, self._in_box(rho)], moments.ravel()])
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
        return float(slow @ (rho @ self.box[2]) @ self.box[1])

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

    Beside the array the coefficients count as 0. Several fields at once: values (slow, middle, fast, fields).
    """
    for k, axis in enumerate(scheme.lattice.axes):
        if axis is None:
            continue
        table = scheme.at_nodes[k] if k in scheme.at_nodes else axis.at_nodes()
        scheme.at_nodes[k] = table
        count, reach = values.shape[k], axis.reach
        moved = np.moveaxis(values, k, 0)
        padded = np.zeros((count + 2 * reach - 2, *moved.shape[1:]))
        padded[reach - 1 : reach - 1 + count] = moved
        found, shares = np.zeros_like(moved), table[first[k] : first[k] + count]
        for t in range(2 * reach - 1):
            found += shares[:, t].reshape(-1, *[1] * (moved.ndim - 1)) * padded[t : t + count]
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


def order_parameter(scheme: LatticeScheme, y: Floats, particle: int) -> Floats:
    """eta of a particle at this rank's nodes."""
    eta = np.zeros((len(scheme.lattice.planes), *scheme.lattice.nodes[1:]))
    values, first = field_of(scheme, y, 1 + particle)
    if values.size:
        start = (first[0] - scheme.lattice.planes.start, *first[1:])
        eta[tuple(slice(f, f + n) for f, n in zip(start, values.shape, strict=True))] = values
    return at_nodes(scheme, eta, (scheme.lattice.planes.start, 0, 0)).ravel()


Placed = tuple[Floats, tuple[int, int, int]]  # coefficients, and the place of the first


def within(values: Floats, first: tuple[int, int, int], low: Integers, high: Integers) -> Floats:
    """Coefficients on the nodes low ... high - 1, 0 where there are none."""
    found = np.zeros(high - low)
    begin, end = np.maximum(low, first), np.minimum(high, np.add(first, values.shape))
    if (begin < end).all():
        here = tuple(slice(b, e) for b, e in zip(begin - low, end - low, strict=True))
        found[here] = values[tuple(slice(b, e) for b, e in zip(begin - first, end - first, strict=True))]
    return found


def contact_box(etas: list[Placed]) -> tuple[Integers, Integers] | None:
    """First node and end of the box where two order parameters are more than `PRESENT`; None: there is none."""
    low = np.max([first for _, first in etas], axis=0)
    high = np.min([np.add(first, values.shape) for values, first in etas], axis=0)
    if (high <= low).any():
        return None
    both = np.logical_and(*(within(*each, low, high) > PRESENT for each in etas))
    if not both.any():
        return None
    there = [np.flatnonzero(both.any(axis=tuple(k for k in range(3) if k != axis))) for axis in range(3)]
    return low + [nodes[0] for nodes in there], low + [nodes[-1] + 1 for nodes in there]


def neck(scheme: LatticeScheme, y: Floats) -> float:
    """This rank's part of the neck of two particles: the measure of {eta_1 = eta_2, rho > 1/2}, nm^(dim - 1).

    The fields are evaluated at the nodes, and are linear in between.
    """
    g = scheme.lattice
    fields = [field_of(scheme, y, w) for w in range(3)]
    found = contact_box(fields[1:])
    if found is None:
        return 0.0
    low, high = np.maximum(found[0] - g.reach, 0), np.minimum(found[1] + g.reach, g.nodes)
    low[0], high[0] = max(low[0], g.layers.start), min(high[0], g.layers.stop + 1)
    if (high - low < np.array([2, 1 if g.dim == 2 else 2, 2])).any():
        return 0.0
    seen = np.maximum(low - g.reach + 1, 0), np.minimum(high + g.reach - 1, g.nodes)
    whole = at_nodes(scheme, np.stack([within(*each, *seen) for each in fields], axis=-1), (*seen[0].tolist(),))
    u = whole[tuple(slice(a - b, c - b) for a, b, c in zip(low, seen[0], high, strict=True))]
    corners = np.array(TRIANGLES if g.dim == 2 else TETRAHEDRA)
    count = np.array(u.shape[:3]) - np.array([1, 0 if g.dim == 2 else 1, 1])
    solid, ahead = u[..., 0] > 0.5, u[..., 1] > u[..., 2]
    places = [tuple(map(slice, corner, corner + count)) for corner in np.array([*np.ndindex(2, g.dim - 1, 2)])]
    cut = np.logical_or.reduce([ahead[c] for c in places]) & ~np.logical_and.reduce([ahead[c] for c in places])
    cut &= np.logical_or.reduce([solid[c] for c in places])
    nodes = (np.argwhere(cut)[:, None, None] + corners).reshape(-1, g.dim + 1, 3)
    if not len(nodes):
        return 0.0
    x = [axis.nodes[low[k] + nodes[..., k]] for k, axis in enumerate(g.axes) if axis is not None]
    return section(np.stack(x, axis=-1), u[nodes[..., 0], nodes[..., 1], nodes[..., 2]])
