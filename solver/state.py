"""Fields in memory: rho and the slots of eta on this rank's nodes, and the fields a run starts from."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .arrays import Floats, Integers, Numbers
from .case import Case
from .simd import LANES
from .slots import colour

TAIL = 1e-16  # rho = sum eta_a counts order parameters down to this value


@dataclass
class State:
    """Everything that a run goes on from.

    u (n, F): rho in column 0, slot s of eta in column 1 + s, unused columns 0; F is a multiple of LANES.
    owner (n, slots): the particle that slot s means at this node, -1 where the slot is empty.
    slot_of (particles,): the slot of each particle, the same on all ranks.
    """

    time: float
    step: int
    evaluations: int
    u: Floats
    owner: Numbers
    slot_of: Numbers

    @property
    def rho(self) -> Floats:
        """Concentration at the nodes (n,)."""
        return self.u[:, 0]

    @property
    def eta(self) -> Floats:
        """Slots of the order parameters at the nodes (n, slots)."""
        return self.u[:, 1 : 1 + self.owner.shape[1]]


def width(slots: int) -> int:
    """F: columns for rho and the slots, rounded up to whole packs."""
    return LANES * -(-(1 + slots) // LANES)


def profile(distance: Floats, xi: float) -> Floats:
    """eta = 1/2 (1 - tanh(d / xi)) with d the signed distance to the particle's surface, nm   (34)"""
    return 0.5 * (1.0 - np.tanh(np.minimum(distance / xi, 40.0)))


def surface_distance(case: Case, particle: int, x: Floats) -> Floats:
    """Signed distance (nm, negative inside) of x (n, dim) to a particle's surface."""
    given = case.particles
    r = x - np.asarray(given.centres[particle])
    if given.shape == "sphere":
        return np.asarray(np.linalg.norm(r, axis=1) - given.radii[particle])
    beyond = np.abs(r) - 0.5 * np.asarray(given.sizes[particle])
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0))


def reach(case: Case) -> Floats:
    """Radius of the smallest ball around each particle's centre that holds it, nm."""
    given = case.particles
    if given.shape == "sphere":
        return np.asarray(given.radii, dtype=float)
    return np.asarray(0.5 * np.linalg.norm(np.asarray(given.sizes, dtype=float), axis=1))


def initial_state(case: Case, nodes: Floats) -> State:
    """The fields (34) on the given nodes (n, dim): rho = min(sum eta, 1), and eta_a where it is at least eps_eta.

    Particles whose kept parts overlap do not share a slot; `active.activate` separates those that are merely close.
    """
    few = case.activation.few_order_parameters
    xi, radii = case.particles.interface_width, reach(case)
    centres = np.asarray(case.particles.centres)
    cut = max(case.activation.eps_eta, TAIL)
    extent = radii + 0.5 * xi * np.log(1.0 / cut)
    slot_of = colour(_neighbours(centres, extent), len(radii)) if few else np.arange(len(radii), dtype=np.int32)
    slots = int(slot_of.max()) + 1
    u = np.zeros((len(nodes), width(slots)))
    owner = np.full((len(nodes), slots), -1, dtype=np.int32)
    tree = cKDTree(nodes)
    for a, centre in enumerate(centres):
        near = np.asarray(tree.query_ball_point(centre, radii[a] + 0.5 * xi * np.log(1.0 / TAIL)), dtype=np.int64)
        eta = profile(surface_distance(case, a, nodes[near]), xi)
        u[near, 0] += eta
        kept = eta >= cut if few else np.ones(near.size, dtype=bool)
        u[near[kept], 1 + slot_of[a]] = eta[kept]
        owner[near[kept] if few else slice(None), slot_of[a]] = a
    np.minimum(u[:, 0], 1.0, out=u[:, 0])
    return State(0.0, 0, 0, u, owner, slot_of)


def _neighbours(centres: Floats, reaches: Floats) -> Integers:
    """Pairs (a, b), a < b, of particles whose balls of the given radii overlap; (pairs, 2)."""
    tree = cKDTree(centres)
    pairs = tree.query_pairs(2.0 * float(reaches.max()), output_type="ndarray").astype(np.int64)
    gap = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
    return np.asarray(pairs[gap < reaches[pairs[:, 0]] + reaches[pairs[:, 1]]])
