"""What is measured: vacancy ratio, mass, energy, live fraction, volumes, neck and distance of a pair."""

from typing import Any

import numpy as np

from . import kernels
from .arrays import Floats
from .case import Case
from .clip import clip_cells
from .discretisation import Discretisation, shape_table
from .geometry import Mesh
from .neck import Neck
from .partition import Collector
from .scheme import Scheme
from .state import State


class Observables:
    """Computes history rows. Every method is collective; rows exist on rank 0 alone."""

    def __init__(self, case: Case, mesh: Mesh, d: Discretisation, particles: int) -> None:
        self.case, self.d, self.particles = case, d, particles
        low, high = (np.asarray(corner, dtype=float) for corner in case.output.vacancy_box)
        self.box_volume = float(np.prod(high - low))
        self.box_weights = box_weights(case, mesh, d, low, high)
        self.pair = particles == 2
        self.collector = Collector(d.share, d.share.total) if self.pair else None
        self.neck = Neck(case, mesh) if self.pair and d.share.ranks.root else None

    def row(self, scheme: Scheme, state: State, u: Floats, time: float, wall_time: float) -> dict[str, Any]:
        """One history row, named as in the run directory's history.jsonl."""
        d, table, owned = self.d, self.d.shape, self.d.share.owned
        sums = np.zeros(5 + self.particles * (1 + d.dim))
        moments = sums[5:].reshape(self.particles, 1 + d.dim)
        kernels.add_moments(moments, u, owned, state.owner, d.mass, d.first_moment)
        sums[0] = d.mass[owned] @ u[owned, 0]
        sums[1] = kernels.free_energy(
            u, d.weights, d.dim, table.offsets, table.nodes, table.rows, table.table, d.coefficients
        )
        sums[2:4] = scheme.active.live.size, table.points
        sums[4] = self.box_weights @ u[:, 0]
        d.share.ranks.sum(sums)
        volumes = moments[:, 0]
        row: dict[str, Any] = {
            "time": time,
            "step": state.step,
            "vacancy_ratio": 1.0 - sums[4] / self.box_volume,
            "solid_mass": sums[0],
            "free_energy": sums[1],
            "live_fraction": sums[2] / sums[3],
            "particles": int((volumes > 1.0).sum()),
            "volumes": volumes.tolist(),
            "evaluations": state.evaluations,
            "wall_time": wall_time,
        }
        if self.collector is not None:
            row["neck_length"] = self._neck(state, u)
            row["centre_distance"] = distance(moments)
        return {key: float(value) if isinstance(value, np.floating) else value for key, value in row.items()}

    def _neck(self, state: State, u: Floats) -> float | None:
        assert self.collector is not None  # narrows the type: only called for a pair
        columns = [0, *(1 + state.slot_of)]
        fields = self.collector.whole(np.ascontiguousarray(u[:, columns]))
        return self.neck.measure(fields) if self.neck is not None and fields is not None else None


def distance(moments: Floats) -> float | None:
    """|r_1 - r_2| of the first two particles in nm, from (V_a, int r eta_a); None when one has vanished."""
    if (moments[:2, 0] <= 0.0).any():
        return None
    centres = moments[:2, 1:] / moments[:2, :1]
    return float(np.linalg.norm(centres[0] - centres[1]))


def box_weights(case: Case, mesh: Mesh, d: Discretisation, low: Floats, high: Floats) -> Floats:
    """omega (n,) on this rank's nodes, zero where another rank owns the node, with int_box rho dV = sum omega_a rho_a.

    Whole cells contribute as in the scheme, w_p N_a(x_p). A cell that the box cuts contributes the exact volume of the
    part inside times N_a at that part's barycentre: exact for linear fields.
    """
    points = d.share.points
    volumes, centroids = clip_cells(mesh.nodes, mesh.cells[points], low, high)
    whole = np.isclose(volumes, d.weights, rtol=1e-12, atol=0.0)
    cut = np.flatnonzero((volumes > 0.0) & ~whole)
    counts = np.diff(d.shape.offsets)
    inside = np.repeat(np.where(whole, d.weights, 0.0), counts) * d.shape.entries()[0]
    weights = np.zeros(d.share.total)
    np.add.at(weights, d.share.nodes[d.shape.nodes], inside)
    if cut.size:
        cells = points[cut]
        table = shape_table(case, centroids[cut], mesh.spacing[cells], mesh.cells[cells], mesh.nodes)
        np.add.at(weights, table.nodes, np.repeat(volumes[cut], np.diff(table.offsets)) * table.entries()[0])
    d.share.ranks.sum(weights)
    return np.where(d.share.halo.owned, weights[d.share.nodes], 0.0)
