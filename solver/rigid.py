"""Rigid-body motion: from contact forces and particle moments to velocities   (6)-(11).

Contacts are by far the stiffest part of the model, and the least interesting: within a few hundredths of a time unit
the particles sit where their forces vanish, and then follow diffusion. `Relaxation` keeps that motion and bounds the
speed at which they get there.
"""

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Integers
from .contacts import Contacts, contact_stiffness
from .elimination import Factors, Plan, factors, plan
from .energy import Coefficients
from .jit import jit
from .partition import Ranks

SMALLEST_VOLUME = 1e-3  # nm^dim: a particle that has been consumed has no velocity


def rotations(dim: int) -> int:
    """The number of rotational degrees of freedom: one in the plane, three in space."""
    return 1 if dim == 2 else 3


def velocities(forces: Floats, moments: Floats, m: Coefficients) -> Floats:
    """The rigid motion (v, omega) of every particle, v taken at the origin: V_a(r) = v + omega x r.

    forces (particles, dim + rotations): F_a = int b_a and int r x b_a; moments (particles, 1 + dim): V_a = int eta_a
    and int r eta_a. With r_a = int r eta_a / V_a and T_a = int (r - r_a) x b_a,
    V_a(r) = [ m_t F_a + m_r T_a x (r - r_a) ] / V_a; the paper's v_a is V_a(r) eta_a.
    """
    motion = np.empty(forces.shape)
    move(motion, forces, moments, m)
    return motion


@jit
def move(motion: Floats, forces: Floats, moments: Floats, m: Coefficients) -> None:
    """The loop of `velocities`."""
    dim = moments.shape[1] - 1
    for a in range(len(moments)):
        volume = moments[a, 0] if moments[a, 0] > SMALLEST_VOLUME else np.inf
        turn, push = m.m_r / volume, m.m_t / volume
        x, y = moments[a, 1] / volume, moments[a, 2] / volume
        F_x, F_y = forces[a, 0], forces[a, 1]
        if dim == 2:
            spin = turn * (forces[a, 2] - (x * F_y - y * F_x))
            motion[a, 0] = push * F_x + spin * y
            motion[a, 1] = push * F_y - spin * x
            motion[a, 2] = spin
            continue
        z, F_z = moments[a, 3] / volume, forces[a, 2]
        spin_x = turn * (forces[a, 3] - (y * F_z - z * F_y))
        spin_y = turn * (forces[a, 4] - (z * F_x - x * F_z))
        spin_z = turn * (forces[a, 5] - (x * F_y - y * F_x))
        motion[a, 0] = push * F_x - (spin_y * z - spin_z * y)
        motion[a, 1] = push * F_y - (spin_z * x - spin_x * z)
        motion[a, 2] = push * F_z - (spin_x * y - spin_y * x)
        motion[a, 3] = spin_x
        motion[a, 4] = spin_y
        motion[a, 5] = spin_z


def in_space(motion: Floats) -> Floats:
    """Rigid motions (particles, dim + rotations) with three components each of v and omega: (particles, 6)."""
    if motion.shape[1] == 6:
        return motion
    whole = np.zeros((len(motion), 6))
    whole[:, :2], whole[:, 5] = motion[:, :2], motion[:, 2]
    return whole


def stiffness_of(
    found: Contacts, x: Floats, pairs: Integers, order: Plan, m: Coefficients, huang: bool, ranks: Ranks
) -> tuple[Floats, Plan]:
    """How contact forces answer to rigid motion: (pairs, 2, k, k) summed over the ranks, for the pairs that push each
    other; and the elimination for these, which is `order` where they are the same as before. Collective.

    found, x: this rank's contacts and where they are; pairs (pairs, 2): all that there may be, sorted.
    """
    particles, dim = len(order.pivots), x.shape[1]
    size = dim + rotations(dim)
    stiffness = np.zeros((len(pairs), 2, size, size))
    contact_stiffness(stiffness, pairs[:, 0] * particles + pairs[:, 1], found, x, particles, m, huang)
    ranks.sum(stiffness)
    pushing = stiffness.any(axis=(1, 2, 3))
    if not np.array_equal(pairs[pushing], order.pairs):
        order = plan(pairs[pushing], particles)
    return stiffness[pushing], order


@dataclass(frozen=True)
class Relaxation:
    """Contacts that relax no faster than 1 / tau: the map from the free motion V = M Q to the V_tau of

    (I + tau M S) (V_tau - V_0) = M Q - V_0

    M takes forces Q = (F, T) to motions V = (v, omega), `velocities`; S says how forces answer to motion, dQ/dt = -S V.
    A mode that relaxes at the rate lambda now does at lambda / (1 + tau lambda) < 1 / tau, an implicit Euler step of
    length tau for the forces; V_0, the motion of late, goes on freely, so that steady motion does not lag behind.
    """

    carried: Floats  # V_0 (particles, dim + rotations)
    system: Factors

    def __call__(self, free: Floats) -> Floats:
        """V_tau for the free motion V."""
        return self.carried + self.system.solve(free - self.carried)


def relaxation(
    stiffness: Floats, order: Plan, moments: Floats, m: Coefficients, tau: float, carried: Floats
) -> Relaxation:
    """The relaxation for a stiffness (pairs, 2, k, k) as `contacts.contact_stiffness` leaves it, summed over ranks."""
    particles, size = len(moments), stiffness.shape[2]
    M = np.empty((particles, size, size))
    for k in range(size):
        unit = np.zeros((particles, size))
        unit[:, k] = 1.0
        M[:, :, k] = velocities(unit, moments, m)
    first, second = M[order.pairs[:, 0]], M[order.pairs[:, 1]]
    a, b = stiffness[:, 0], stiffness[:, 1]
    return Relaxation(carried, factors(order, tau * np.concatenate([first @ a, first @ b, -second @ a, -second @ b])))
