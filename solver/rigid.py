"""Rigid-body motion: from contact forces and particle moments to velocities   (6)-(11).

Contacts are by far the stiffest part of the model, and the least interesting: within a few hundredths of a time unit
the particles sit where their forces vanish, and then follow diffusion. `Relaxation` keeps that motion and bounds the
speed at which they get there.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from .arrays import Floats, Integers
from .energy import Coefficients

SMALLEST_VOLUME = 1e-3  # nm^dim: a particle that has been consumed has no velocity


def rotations(dim: int) -> int:
    """The number of rotational degrees of freedom: one in the plane, three in space."""
    return 1 if dim == 2 else 3


def cross(omega: Floats, r: Floats) -> Floats:
    """omega x r per row; in the plane omega (n, 1) points out of it."""
    if r.shape[1] == 2:
        return np.stack([-omega[:, 0] * r[:, 1], omega[:, 0] * r[:, 0]], axis=1)
    return np.cross(omega, r)


def torque(r: Floats, F: Floats) -> Floats:
    """r x F per row: (n, 1) in the plane, (n, 3) in space."""
    if r.shape[1] == 2:
        return (r[:, 0] * F[:, 1] - r[:, 1] * F[:, 0])[:, None]
    return np.cross(r, F)


def velocities(forces: Floats, moments: Floats, m: Coefficients) -> Floats:
    """The rigid motion (v, omega) of every particle, v taken at the origin: V_a(r) = v + omega x r.

    forces (particles, dim + rotations): F_a = int b_a and int r x b_a; moments (particles, 1 + dim): V_a = int eta_a
    and int r eta_a. With r_a = int r eta_a / V_a and T_a = int (r - r_a) x b_a,
    V_a(r) = [ m_t F_a + m_r T_a x (r - r_a) ] / V_a; the paper's v_a is V_a(r) eta_a.
    """
    dim = moments.shape[1] - 1
    volume = np.where(moments[:, :1] > SMALLEST_VOLUME, moments[:, :1], np.inf)
    centre = moments[:, 1:] / volume
    F = forces[:, :dim]
    omega = m.m_r * (forces[:, dim:] - torque(centre, F)) / volume
    return np.hstack([m.m_t * F / volume - cross(omega, centre), omega])


def in_space(motion: Floats) -> Floats:
    """Rigid motions (particles, dim + rotations) with three components each of v and omega: (particles, 6)."""
    if motion.shape[1] == 6:
        return motion
    whole = np.zeros((len(motion), 6))
    whole[:, :2], whole[:, 5] = motion[:, :2], motion[:, 2]
    return whole


@dataclass(frozen=True)
class Relaxation:
    """Contacts that relax no faster than 1 / tau: the map from the free motion V = M Q to the V_tau of

    (I + tau M S) (V_tau - V_0) = M Q - V_0

    M takes forces Q = (F, T) to motions V = (v, omega), `velocities`; S says how forces answer to motion, dQ/dt = -S V.
    A mode that relaxes at the rate lambda now does at lambda / (1 + tau lambda) < 1 / tau, an implicit Euler step of
    length tau for the forces; V_0, the motion of late, goes on freely, so that steady motion does not lag behind.
    """

    carried: Floats  # V_0 (particles, dim + rotations)
    solve: Callable[[Floats], Floats]

    def __call__(self, free: Floats) -> Floats:
        """V_tau for the free motion V."""
        return self.carried + self.solve((free - self.carried).ravel()).reshape(free.shape)


class Pattern:
    """Where the entries of I + tau M S lie in a sparse matrix by columns, for the pairs (pairs, 2) that may touch."""

    def __init__(self, pairs: Integers, particles: int, size: int) -> None:
        """size: degrees of freedom of a particle."""
        a, b = pairs[:, 0], pairs[:, 1]
        self.block_rows, block_columns = np.concatenate([a, a, b, b]), np.concatenate([a, b, a, b])
        self.count = count = particles * size
        each, diagonal = np.arange(size), np.arange(count)
        rows = self.block_rows[:, None, None] * size + each[:, None]
        columns = block_columns[:, None, None] * size + each
        codes = np.concatenate([(columns * count + rows).ravel(), diagonal * (count + 1)])
        found, self.place = np.unique(codes, return_inverse=True)  # of each value in the matrix; the diagonal last
        self.indices = (found % count).astype(np.int32)
        self.starts = np.searchsorted(found, np.arange(count + 1) * count).astype(np.int32)

    def matrix(self, blocks: Floats) -> csc_array:
        """I + the blocks (4 pairs, size, size) of the pairs' rows and columns (a, a), (a, b), (b, a), (b, b)."""
        values = np.concatenate([blocks.ravel(), np.ones(self.count)])
        return csc_array((np.bincount(self.place, values), self.indices, self.starts), shape=(self.count, self.count))


def relaxation(
    stiffness: Floats, pattern: Pattern, moments: Floats, m: Coefficients, tau: float, carried: Floats
) -> Relaxation:
    """The relaxation for a stiffness (pairs, 2, k, k) as `kernels.contact_stiffness` leaves it, summed over ranks."""
    particles, size = len(moments), stiffness.shape[2]
    units = np.broadcast_to(np.eye(size)[:, None, :], (size, particles, size))
    M = np.stack([velocities(unit, moments, m) for unit in units], axis=2)
    S = np.concatenate([stiffness[:, 0], stiffness[:, 1], -stiffness[:, 0], -stiffness[:, 1]])
    return Relaxation(carried, splu(pattern.matrix(tau * (M[pattern.block_rows] @ S))).solve)
