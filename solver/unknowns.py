"""What changes, as one vector: the form in which the integrators see the fields.

y holds rho at every node that changes, and each order parameter at those of them where a particle has it: two or three
values a node, whatever number of columns all particles of the case need. Values of one field at nodes that follow one
another make a strip. Strips of nodes that other ranks hold, too, come first; the others follow by column and node.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .arrays import Floats, Integers, Numbers
from .jit import jit
from .partition import Halo
from .simd import flush_denormals, restore_denormals

BLOCKS, LOOSE, OWNED = 1, 2, 4  # bits in `Strips.kind`: seen by blocks, by loose points; this rank is the nodes' owner


class Strips(NamedTuple):
    """Strip r: y[first[r]] ... y[first[r + 1] - 1] are the field in column[r] at the nodes node[r], node[r] + 1, ..."""

    first: Integers  # (r + 1,)
    node: Integers
    column: Integers
    particle: Integers  # -1: rho
    kind: Integers  # the same at all nodes of a strip


@dataclass(frozen=True)
class Unknowns:
    """Where the entries of y belong."""

    strips: Strips
    shared: int  # the strips at nodes that other ranks hold, too: the first ones
    nodes: Numbers  # (y,) node of each entry
    halo: Halo  # of y

    @property
    def size(self) -> int:
        """The number of entries."""
        return int(self.nodes.size)

    def take(self, u: Floats) -> Floats:
        """y of the fields u (n, F)."""
        y = np.empty(self.size)
        take(y, u, self.strips)
        return y

    def put(self, u: Floats, y: Floats) -> Floats:
        """Write y into the fields u (n, F), and return them."""
        put(u, y, self.strips)
        return u


def lay_out(listed: Integers, owner: Numbers, kind: Numbers, halo: Halo) -> Unknowns:
    """The unknowns at the listed nodes (sorted); owner (n, slots), kind (n,), halo of the nodes."""
    shared = np.zeros(len(owner), dtype=bool)
    shared[halo.shared] = True
    parts = [_entries(chosen, owner) for chosen in (listed[shared[listed]], listed[~shared[listed]])]
    node, column, particle = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    ends = (np.diff(node) != 1) | (np.diff(column) != 0) | (np.diff(particle) != 0) | (np.diff(kind[node]) != 0)
    border = parts[0][0].size
    if 0 < border < node.size:
        ends[border - 1] = True
    starts = np.append(0, np.flatnonzero(ends) + 1)[: node.size]
    kinds = kind[node[starts]].astype(np.int64)
    strips = Strips(np.append(starts, node.size), node[starts], column[starts], particle[starts], kinds)
    return Unknowns(strips, int(np.searchsorted(starts, border)), node.astype(np.int32), halo.of(node[:border]))


def _entries(listed: Integers, owner: Numbers) -> tuple[Integers, Integers, Integers]:
    """Node, column and particle of the unknowns at the listed nodes, by column and node."""
    nodes, particles = [listed], [np.full(listed.size, -1)]
    for slot in range(owner.shape[1]):
        here = owner[listed, slot]
        nodes.append(listed[here >= 0])
        particles.append(here[here >= 0].astype(np.int64))
    column = np.repeat(np.arange(len(nodes)), [some.size for some in nodes])
    return np.concatenate(nodes), column, np.concatenate(particles)


@jit
def take(y: Floats, u: Floats, strips: Strips) -> None:
    """y of the fields u (n, F)."""
    for r in range(strips.node.size):
        begin = strips.first[r]
        for k in range(strips.first[r + 1] - begin):
            y[begin + k] = u[strips.node[r] + k, strips.column[r]]


@jit
def put(u: Floats, y: Floats, strips: Strips) -> None:
    """The fields u (n, F) of y; others stay."""
    for r in range(strips.node.size):
        begin = strips.first[r]
        for k in range(strips.first[r + 1] - begin):
            u[strips.node[r] + k, strips.column[r]] = y[begin + k]


@jit
def spread(columns: Floats, rows: Floats, y: Floats, strips: Strips) -> None:
    """y for the loops over points: columns (F, n + LANES) where blocks see it, rows (n, F) where loose points do."""
    for r in range(strips.node.size):
        values, a, c = y[strips.first[r] : strips.first[r + 1]], strips.node[r], strips.column[r]
        if strips.kind[r] & BLOCKS:
            column = columns[c, a : a + values.size]
            for k in range(values.size):
                column[k] = values[k]
        if strips.kind[r] & LOOSE:
            for k in range(values.size):
                rows[a + k, c] = values[k]


@jit
def collect(rate: Floats, columns: Floats, rows: Floats, mass: Floats, strips: Strips, low: int, high: int) -> None:
    """rate = (columns + rows) / m_a of the strips low ... high - 1, and 0 in their place there.

    Points also add to fields that no particle has at a node; nobody reads those.
    """
    mode = flush_denormals()
    for r in range(low, high):
        values, a, c = rate[strips.first[r] : strips.first[r + 1]], strips.node[r], strips.column[r]
        column, m = columns[c, a : a + values.size], mass[a : a + values.size]
        if strips.kind[r] & LOOSE:
            for k in range(values.size):
                column[k] += rows[a + k, c]
                rows[a + k, c] = 0.0
        for k in range(values.size):
            values[k] = column[k] / m[k]
            column[k] = 0.0
    restore_denormals(mode)


@jit
def add_moments(moments: Floats, y: Floats, mass: Floats, first_moment: Floats, strips: Strips) -> None:
    """moments[a] += sum_b (m_b eta_b, q_b eta_b) over the nodes that this rank owns: V_a and int r eta_a exactly."""
    for r in range(strips.node.size):
        particle = strips.particle[r]
        if particle < 0 or not strips.kind[r] & OWNED:
            continue
        eta, b = y[strips.first[r] : strips.first[r + 1]], strips.node[r]
        m, q = mass[b : b + eta.size], first_moment[b : b + eta.size]
        volume = 0.0
        for k in range(eta.size):
            volume += m[k] * eta[k]
        moments[particle, 0] += volume
        for i in range(q.shape[1]):
            moment = 0.0
            for k in range(eta.size):
                moment += q[k, i] * eta[k]
            moments[particle, 1 + i] += moment


@jit
def squares(y: Floats, strips: Strips) -> float:
    """sum y^2 over the nodes that this rank owns."""
    total = 0.0
    for r in range(strips.node.size):
        if strips.kind[r] & OWNED:
            for value in y[strips.first[r] : strips.first[r + 1]]:
                total += value * value
    return total


@jit
def step_error(
    sums: Floats, new: Floats, old: Floats, rate_1: Floats, rate_0: Floats, dt: float, tolerance: float,
    mass: Floats, strips: Strips,
) -> None:
    """sums = sum_a m_a sum_fields (e / (tolerance (1 + |u|)))^2 and sum_a m_a over the nodes that this rank owns;

    e = 0.8 (y_n - y_{n+1}) + 0.4 dt (F_n + F_{n+1}).
    """
    sums[:] = 0.0
    for r in range(strips.node.size):
        if not strips.kind[r] & OWNED:
            continue
        begin, end, a = strips.first[r], strips.first[r + 1], strips.node[r]
        u_0, u_1, F_0, F_1 = old[begin:end], new[begin:end], rate_0[begin:end], rate_1[begin:end]
        m = mass[a : a + u_0.size]
        square = 0.0
        volume = 0.0
        for k in range(u_0.size):
            error = (0.8 * (u_0[k] - u_1[k]) + 0.4 * dt * (F_0[k] + F_1[k])) / (tolerance * (1.0 + abs(u_1[k])))
            square += m[k] * error * error
            volume += m[k]
        sums[0] += square
        if strips.particle[r] < 0:
            sums[1] += volume
