"""Slow, obvious truths in plain numpy, written from the model's equations; nothing here comes from solver/.

p points, n nodes, k particles: rho (n,), eta (n, k), N (p, n), dN (p, n, dim), w (p,), x (p, dim). `m` has the
coefficients of Table 2 as attributes. Numbers in brackets are equations of Huang et al. (2023).
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Floats = NDArray[np.float64]
Coefficients = Any  # anything with the names of Table 2


# --- shape functions


def lme(x: Floats, nodes: Floats, h: float, gamma: float, tolerance: float) -> tuple[Floats, Floats]:
    """N (n,) and grad N (n, dim) of all nodes at one point x (dim,), in any dimension.

    N_a = exp(-beta |x - x_a|^2 + lambda . (x - x_a)) / Z, beta = gamma / h^2, where exp(-beta r^2) >= tolerance.
    lambda minimises the convex log Z: its gradient is sum_a N_a (x - x_a).
    """
    r = x - nodes
    exponent = -gamma * (r**2).sum(axis=1) / h**2
    seen = exponent >= np.log(tolerance)
    d, exponent = r[seen] / h, exponent[seen]

    def parts(multiplier: Floats) -> tuple[float, Floats, Floats, Floats]:
        e = exponent + d @ multiplier
        q = np.exp(np.maximum(e - e.max(), -600.0))
        N = q / q.sum()
        mean = N @ d
        return np.log(q.sum()) + e.max(), N, mean, np.einsum("a,ai,aj->ij", N, d - mean, d - mean)

    descend: Any = minimize  # the stubs know no pair of gradient and Hessian for this method
    multiplier = np.asarray(
        descend(
            lambda s: parts(s)[0],
            np.zeros(len(x)),
            jac=lambda s: parts(s)[2],
            hess=lambda s: parts(s)[3],
            method="trust-exact",
        ).x
    )
    for _ in range(4):
        _, _, mean, J = parts(multiplier)
        multiplier = multiplier - np.linalg.solve(J, mean)
    _, some, mean, J = parts(multiplier)
    assert np.abs(mean).max() < 1e-12, "the reference itself did not converge"
    N, dN = np.zeros(len(nodes)), np.zeros_like(nodes)
    N[seen] = some
    dN[seen] = -some[:, None] * np.linalg.solve(J, d.T).T / h
    return N, dN


def linear(x: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """N (dim + 1,) and grad N of the linear functions with N_a(x_b) = delta_ab on one simplex."""
    c = np.linalg.inv(np.column_stack([np.ones(len(corners)), corners]))
    return np.concatenate([[1.0], x]) @ c, c[1:].T


def dense(offsets: NDArray[Any], near: NDArray[Any], entries: Floats, nodes: int) -> tuple[Floats, Floats]:
    """N (p, n) and dN (p, n, dim) from lists: point p sees near[offsets[p] : offsets[p + 1]], entries (N, dN) there."""
    N = np.zeros((len(offsets) - 1, nodes))
    dN = np.zeros((len(offsets) - 1, nodes, len(entries) - 1))
    for p, (first, last) in enumerate(pairwise(offsets)):
        N[p, near[first:last]] = entries[0, first:last]
        dN[p, near[first:last]] = entries[1:, first:last].T
    return N, dN


# --- free energy and mobility; rho (...), eta (..., k)


def free_energy_density(rho: Floats, eta: Floats, m: Coefficients) -> Floats:
    """(2), with A rho^2 (1 - rho)^2 where the print has A rho^2 (1 - rho^2)."""
    S2, S3 = (eta**2).sum(axis=-1), (eta**3).sum(axis=-1)
    coupling = rho**2 + 6 * (1 - rho) * S2 - 4 * (2 - rho) * S3 + 3 * S2**2
    return np.asarray(m.A * rho**2 * (1 - rho) ** 2 + m.B * coupling)


def df_drho(rho: Floats, eta: Floats, m: Coefficients) -> Floats:
    """(31)"""
    S2, S3 = (eta**2).sum(axis=-1), (eta**3).sum(axis=-1)
    return np.asarray(m.A * (4 * rho**3 - 6 * rho**2 + 2 * rho) + m.B * (2 * rho - 6 * S2 + 4 * S3))


def df_deta(rho: Floats, eta: Floats, m: Coefficients) -> Floats:
    """(30), (..., k)"""
    r, S2 = rho[..., None], (eta**2).sum(axis=-1)[..., None]
    return np.asarray(12 * m.B * ((1 - r) * eta - (2 - r) * eta**2 + eta * S2))


def mobility(rho: Floats, eta: Floats, m: Coefficients) -> Floats:
    """(5) with rho clamped to [0, 1] and every eta to >= 0, and with them the products eta_a eta_b."""
    r, e = np.clip(rho, 0.0, 1.0), np.maximum(eta, 0.0)
    phi = r**3 * (10 - 15 * r + 6 * r**2)
    D = m.D_vol * phi + m.D_vap * (1 - phi) + m.D_surf * r * (1 - r)
    for a, b in permutations(range(eta.shape[-1]), 2):
        D = D + m.D_gb * e[..., a] * e[..., b]
    return np.asarray(D)


def free_energy(rho: Floats, eta: Floats, N: Floats, dN: Floats, w: Floats, m: Coefficients) -> float:
    """(1) by the quadrature of the material points."""
    slope, slopes = np.einsum("pnd,n->pd", dN, rho), np.einsum("pnd,nk->pkd", dN, eta)
    density = free_energy_density(N @ rho, N @ eta, m)
    return float(w @ (density + m.kappa_rho / 2 * (slope**2).sum(1) + m.kappa_eta / 2 * (slopes**2).sum((1, 2))))


# --- rigid motion, with the plane embedded in space: vectors have three components


def in_space(vectors: Floats) -> Floats:
    """(..., dim) with zeros added up to three components."""
    return np.concatenate([vectors, np.zeros((*vectors.shape[:-1], 3 - vectors.shape[-1]))], axis=-1)


@dataclass(frozen=True)
class Bodies:
    """Volumes V (k,), centres r (k, 3), forces F (k, 3) and torques T (k, 3) about the centres."""

    V: Floats
    r: Floats
    F: Floats
    T: Floats

    def velocity(self, a: int, x: Floats, m: Coefficients) -> Floats:
        """(10) without its factor eta_a, at x (p, dim)."""
        turn = np.cross(self.T[a], in_space(x) - self.r[a])
        return np.asarray((m.m_t * self.F[a] + m.m_r * turn) / self.V[a])[:, : x.shape[1]]


def touching_share(one: Floats, other: Floats, slope: Floats, other_slope: Floats, w: Floats, c: float) -> Floats:
    """The volume of the part of each cell, a ball of volume w, in which eta_a eta_b > c, over w; in the plane the same
    cubic with the radius of a disc. No cell counts as larger than what takes the product from c to c / 2."""
    excess = one * other - c
    steepness = np.linalg.norm(one[:, None] * other_slope + other[:, None] * slope, axis=1)
    radius = np.sqrt(w / np.pi) if slope.shape[1] == 2 else (w / (4 / 3 * np.pi)) ** (1 / 3)
    reach = np.minimum(radius * steepness, c / 2)
    d = np.clip(excess / np.where(reach > 0, reach, 1e-300), -1, 1)
    return np.asarray((d + 1) ** 2 * (2 - d) / 4)


def bodies(rho_p: Floats, eta_p: Floats, slopes: Floats, w: Floats, x: Floats, m: Coefficients) -> Bodies:
    """(6)-(9) from the values at the points: rho_p (p,), eta_p (p, k), slopes (p, k, dim) = grad eta."""
    V = w @ eta_p
    r = (w[:, None] * eta_p).T @ in_space(x) / V[:, None]
    F, T = np.zeros_like(r), np.zeros_like(r)
    for a, b in permutations(range(len(V)), 2):
        touching = touching_share(eta_p[:, a], eta_p[:, b], slopes[:, a], slopes[:, b], w, m.c)
        density = (m.k * (rho_p - m.rho_0) * touching)[:, None] * in_space(slopes[:, a] - slopes[:, b])
        F[a] += w @ density
        T[a] += w @ np.cross(in_space(x) - r[a], density)
    return Bodies(V, r, F, T)


# --- the semi-discrete equations


@dataclass(frozen=True)
class Rates:
    W: Floats  # (n,)
    rho: Floats  # (n,)
    eta: Floats  # (n, k)
    bodies: Bodies


def rates(
    rho: Floats, eta: Floats, N: Floats, dN: Floats, w: Floats, x: Floats, m: Coefficients,
    rigid_motion: bool = True, advection: str = "huang",
) -> Rates:  # fmt: skip
    """(17)-(29), every particle everywhere and every point live."""
    # Fields at the points (17), (18), (22)
    rho_p, eta_p = N @ rho, N @ eta
    slope, slopes = np.einsum("pnd,n->pd", dN, rho), np.einsum("pnd,nk->pkd", dN, eta)
    mass = w @ N

    # Potential (24) and its gradient (23)
    W = (N.T @ (w * df_drho(rho_p, eta_p, m)) + m.kappa_rho * np.einsum("p,pnd,pd->n", w, dN, slope)) / mass
    grad_W = np.einsum("pnd,n->pd", dN, W)

    # Velocities v_a (p, dim) of the particles (10) and of the material (11)
    rigid = bodies(rho_p, eta_p, slopes, w, x, m)
    v = np.zeros_like(slopes)
    if rigid_motion:
        for a in range(eta.shape[1]):
            v[:, a] = rigid.velocity(a, x, m) * eta_p[:, a, None]
    v_adv = v.sum(axis=1) if advection == "wang" else (eta_p[:, :, None] * v).sum(axis=1)

    # Rates (20), (21)
    flux = -mobility(rho_p, eta_p, m)[:, None] * grad_W + rho_p[:, None] * v_adv
    rate_rho = np.einsum("p,pnd,pd->n", w, dN, flux) / mass
    rate_eta = np.zeros_like(eta)
    source = -m.L * df_deta(rho_p, eta_p, m)
    for a in range(eta.shape[1]):
        flux = -m.L * m.kappa_eta * slopes[:, a] + eta_p[:, a, None] * v[:, a]
        rate_eta[:, a] = (N.T @ (w * source[:, a]) + np.einsum("p,pnd,pd->n", w, dN, flux)) / mass
    return Rates(W, rate_rho, rate_eta, rigid)


# --- observables


def vacancy_ratio(rho: Callable[[Floats], Floats], low: Floats, high: Floats, parts: int) -> float:
    """R_v of a field rho(x), x (points, dim), in a box cut into parts^dim small boxes: the rule of their midpoints."""
    edges = [lo + (hi - lo) * (np.arange(parts) + 0.5) / parts for lo, hi in zip(low, high, strict=True)]
    middles = np.stack(np.meshgrid(*edges, indexing="ij"), axis=-1).reshape(-1, len(low))
    return 1.0 - float(np.mean(rho(middles)))


def mean_in_box(field: Callable[[Floats], Floats], low: Floats, high: Floats, points: int) -> float:
    """The mean of a smooth field(x), x (..., dim), over a box by Gauss's rule of so many points along each axis.

    Exact for polynomials of degree 2 points - 1; a profile 1 nm wide is exact to 1e-9 at 8 points per nm.
    """
    place, weight = np.polynomial.legendre.leggauss(points)
    axes = [lo + (hi - lo) * 0.5 * (1.0 + place) for lo, hi in zip(low, high, strict=True)]
    values = field(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    for _ in axes:
        values = np.tensordot(values, 0.5 * weight, axes=(0, 0))
    return float(values)


# --- boxes


def meeting(x: Floats, half: Floats) -> set[tuple[int, int]]:
    """All pairs i < j of boxes x +- half, both (n, dim), that have common points."""
    return {
        (i, j)
        for j in range(len(x))
        for i in range(j)
        if all(abs(a - b) <= p + q for a, b, p, q in zip(x[i], x[j], half[i], half[j], strict=True))
    }
