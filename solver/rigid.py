"""Rigid-body motion: from contact forces and particle moments to velocities   (6)-(11)."""

import numpy as np
from numpy.typing import NDArray

from .energy import Coefficients

Floats = NDArray[np.float64]

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

    forces (particles, dim + rotations): F_a = int b_a and int r x b_a; moments (particles, 1 + dim): V_a = int eta_a and
    int r eta_a. With r_a = int r eta_a / V_a and T_a = int (r - r_a) x b_a,
    V_a(r) = [ m_t F_a + m_r T_a x (r - r_a) ] / V_a; the paper's v_a is V_a(r) eta_a.
    """
    dim = moments.shape[1] - 1
    volume = np.where(moments[:, :1] > SMALLEST_VOLUME, moments[:, :1], np.inf)
    centre = moments[:, 1:] / volume
    F = forces[:, :dim]
    omega = m.m_r * (forces[:, dim:] - torque(centre, F)) / volume
    return np.hstack([m.m_t * F / volume - cross(omega, centre), omega])
