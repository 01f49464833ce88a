"""What is measured: vacancy ratio, mass, energy, live fraction, volumes, neck and distance of a pair."""

from typing import Any

import numpy as np

from . import block_kernels, box, field, kernels, unknowns
from .arrays import Floats
from .case import Box, Case
from .discretisation import Discretisation
from .geometry import Mesh
from .neck import Neck
from .pack_box import PackBox, overlap
from .partition import Collector
from .points import on_mesh
from .scheme import Scheme
from .simd import LANES
from .state import State
from .system import Progress


class Observables:
    """Computes history rows. Every method is collective; rows exist on rank 0 alone."""

    def __init__(self, case: Case, mesh: Mesh, d: Discretisation, particles: int, box: Box | None = None) -> None:
        """box: of the vacancy ratio, if not the case's."""
        self.case, self.d, self.particles = case, d, particles
        low, high = (np.asarray(corner, dtype=float) for corner in box or case.output.vacancy_box)
        self.box_volume = float(np.prod(high - low))
        self.box_weights = box_weights(case, mesh, d, low, high)
        self.pack, self.edge = PackBox(case), d.weights ** (1.0 / d.dim)
        self.pair = particles == 2
        self.collector = Collector(d.share, d.share.total) if self.pair else None
        self.neck = Neck(case, mesh) if self.pair and d.share.ranks.root else None

    def row(self, scheme: Scheme, state: State, u: Floats, time: float, wall_time: float) -> dict[str, Any]:
        """One history row, named as in the run directory's history.jsonl."""
        d, owned = self.d, self.d.share.owned
        sums = np.zeros(5 + self.particles * (1 + d.dim))
        moments = sums[5:].reshape(self.particles, 1 + d.dim)
        moments += scheme.active.moments
        places = scheme.active.unknowns
        unknowns.add_moments(moments, places.take(u), d.mass, d.first_moment, places.strips)
        sums[0] = d.mass[owned] @ u[owned, 0]
        sums[1] = free_energy(d, u)
        sums[2:4] = scheme.active.live.size, d.shape.points
        sums[4] = self.box_weights @ u[:, 0]
        d.share.ranks.sum(sums)
        rho = d.sample(np.ascontiguousarray(u[:, :1]))
        extremes = d.share.ranks.max(np.array([-rho.min(initial=np.inf), rho.max(initial=-np.inf)]))
        fractions = sums[2] / sums[3], sums[2] / sums[3]
        vacancy_ratio = 1.0 - sums[4] / self.box_volume
        row = history_row(state, time, wall_time, moments, vacancy_ratio, sums[0], sums[1], fractions, extremes)
        row["pack_porosity"] = self._porosity(vacancy_ratio, rho[:, 0], moments)
        if self.collector is not None:
            row["neck_length"] = self._neck(state, u)
            row["centre_distance"] = distance(moments)
        return row

    def vacancy_ratio(self, state: State) -> float:
        """Of the state's own fields. Collective."""
        return float(1.0 - self.d.share.ranks.sum(np.array([self.box_weights @ state.u[:, 0]]))[0] / self.box_volume)

    def _porosity(self, vacancy_ratio: float, rho: Floats, moments: Floats) -> float:
        """1 - mean rho in the pack's own box: by how much means over the points differ there and in the fixed one.

        rho (points,), moments as in `row`. Collective.
        """
        boxes, x = ((self.pack.low, self.pack.high), self.pack.now(moments)), self.d.x + 0.5 * self.pack.size
        inside = [self.d.weights * overlap(x, self.edge[:, None], *box).prod(axis=1) for box in boxes]
        solid, volume = self.d.share.ranks.sum(np.array([[w @ rho, w.sum()] for w in inside])).T
        return float(vacancy_ratio + solid[0] / volume[0] - solid[1] / volume[1])

    def _neck(self, state: State, u: Floats) -> float | None:
        assert self.collector is not None  # narrows the type: only called for a pair
        columns = [0, *(1 + state.slot_of)]
        fields = self.collector.whole(np.ascontiguousarray(u[:, columns]))
        return self.neck.measure(fields) if self.neck is not None and fields is not None else None


def history_row(
    state: Progress, time: float, wall_time: float, moments: Floats, vacancy_ratio: float, solid_mass: float,
    free_energy: float, fractions: tuple[float, float], extremes: Floats,
) -> dict[str, Any]:
    """What every row holds, named as in the run directory's history.jsonl.

    moments (particles, 1 + dim): V_a first; fractions of the points: those that the criterion of 2.4 switches on, those
    that were evaluated; extremes (2,): -min rho, max rho.
    """
    volumes = moments[:, 0]
    return {
        "time": time,
        "step": state.step,
        "vacancy_ratio": float(vacancy_ratio),
        "solid_mass": float(solid_mass),
        "free_energy": float(free_energy),
        "live_fraction": float(fractions[0]),
        "evaluated_fraction": float(fractions[1]),
        "rho_min": float(-extremes[0]),
        "rho_max": float(extremes[1]),
        "particles": int((volumes > 1.0).sum()),
        "volumes": volumes.tolist(),
        "evaluations": state.evaluations,
        "wall_time": wall_time,
    }


def free_energy(d: Discretisation, u: Floats) -> float:
    """F (1) of the fields u (n, F), this rank's part."""
    table, blocks = d.shape, d.blocks
    loose = kernels.free_energy(
        u, d.weights, d.dim, blocks.loose, table.offsets, table.nodes, table.rows, table.table, d.coefficients
    )
    columns = np.empty((u.shape[1], d.nodes + LANES))
    block_kernels.to_columns(columns, u)
    return loose + block_kernels.free_energy(
        columns, blocks.points, d.weights, blocks.begin, blocks.count, blocks.start, table.nodes, table.table,
        d.coefficients,
    )


def distance(moments: Floats) -> float | None:
    """|r_1 - r_2| of the first two particles in nm, from (V_a, int r eta_a); None when one has vanished."""
    if (moments[:2, 0] <= 0.0).any():
        return None
    centres = moments[:2, 1:] / moments[:2, :1]
    return float(np.linalg.norm(centres[0] - centres[1]))


def box_weights(case: Case, mesh: Mesh, d: Discretisation, low: Floats, high: Floats) -> Floats:
    """omega (n,) on this rank's nodes, zero where another rank owns the node: int_box rho dV = sum omega_a rho_a."""
    ranks = d.share.ranks
    if on_mesh(case):
        weights = box.box_weights(mesh, low, high, case.nodes.source == "triangular", ranks)
    else:  # The sharper the functions, the more intervals: at gamma = 4 in space one is 1e-3 off, two 3e-5.
        step = mesh.width / np.ceil(np.sqrt(case.shape_functions.gamma / 2.0))
        x, rule = box.gauss_rule(low, high, np.full(case.dim, step))
        part = slice(len(x) * ranks.rank // ranks.size, len(x) * (ranks.rank + 1) // ranks.size)
        weights = ranks.sum(field.shares(case, mesh, x[part], rule[part]))
    return np.where(d.share.halo.owned, weights[d.share.nodes], 0.0)
