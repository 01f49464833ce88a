"""What is measured of a packing of spheres (discs in 2-D): solid fractions, contacts, coordination, percolation.

Overlaps of particles are counted twice in a solid fraction: they are below 0.5 % of the mean radius in what frit packs.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from . import overlaps
from .arrays import Flags, Floats, Integers

TOUCH = 1e-3  # of the mean radius: particles nearer than this touch
SLICES = 48  # Gauss points through a sphere that a box cuts: an error below 1e-4 of the sphere, see the tests


def volumes(r: Floats, dim: int) -> Floats:
    """pi R^2 or 4/3 pi R^3."""
    return np.asarray(np.pi * r**2 if dim == 2 else 4.0 / 3.0 * np.pi * r**3)


def solid_fraction(x: Floats, r: Floats, low: Floats, high: Floats) -> float:
    """The part of the box [low, high] that particles at x (n, dim) with radii r (n,) fill."""
    return float(parts_inside(x, r, low, high).sum() / np.prod(high - low))


def parts_inside(x: Floats, r: Floats, low: Floats, high: Floats) -> Floats:
    """Volume (n,) of each particle inside the box: discs exactly, spheres as a stack of discs."""
    with np.errstate(under="ignore"):
        return _parts_inside(x, r, low, high)


def _parts_inside(x: Floats, r: Floats, low: Floats, high: Floats) -> Floats:
    dim = x.shape[1]
    inside = ((x - r[:, None] >= low) & (x + r[:, None] <= high)).all(axis=1)
    outside = ((x + r[:, None] <= low) | (x - r[:, None] >= high)).any(axis=1)
    found = np.where(inside, volumes(r, dim), 0.0)
    cut = np.flatnonzero(~inside & ~outside)
    if not cut.size:
        return found
    a, b = (low - x[cut]) / r[cut, None], (high - x[cut]) / r[cut, None]
    if dim == 2:
        found[cut] = r[cut] ** 2 * _disc_in_rectangle(a, b)
        return found
    # With z = R sin t, the part is R^3 int cos^3 t A(t) dt: A in a unit disc, the rectangle's edges over cos t.
    t_low, t_high = np.arcsin(np.clip(a[:, 2], -1.0, 1.0)), np.arcsin(np.clip(b[:, 2], -1.0, 1.0))
    nodes, weights = np.polynomial.legendre.leggauss(SLICES)
    for node, weight in zip(nodes, weights, strict=True):
        t = 0.5 * (t_low + t_high) + 0.5 * (t_high - t_low) * node
        cos = np.cos(t)[:, None]
        area = _disc_in_rectangle(a[:, :2] / cos, b[:, :2] / cos)
        found[cut] += 0.5 * weight * (t_high - t_low) * r[cut] ** 3 * cos[:, 0] ** 3 * area
    return found


def _disc_in_rectangle(a: Floats, b: Floats) -> Floats:
    """Area (n,) of the unit disc inside the rectangles [a, b] (n, 2)."""
    a, b = np.clip(a, -1.0, 1.0), np.clip(b, -1.0, 1.0)
    area = _below(b[:, 0], b[:, 1]) - _below(a[:, 0], b[:, 1]) - _below(b[:, 0], a[:, 1]) + _below(a[:, 0], a[:, 1])
    return np.maximum(area, 0.0)


def _below(x: Floats, y: Floats) -> Floats:
    """Area of the part of the unit disc to the left of x and below y, both in [-1, 1]."""
    left, under = _segment(x), _segment(y)
    corner_inside = 0.5 * (left + under) - 0.25 * np.pi + x * y
    # A corner outside the disc: what x and y cut off does not overlap, or one contains the other, or nothing is left.
    corner_outside = np.where(
        (x >= 0) & (y >= 0), left + under - np.pi, np.where((x < 0) & (y < 0), 0.0, np.minimum(left, under))
    )
    return np.where(x**2 + y**2 < 1.0, corner_inside, corner_outside)


def _segment(x: Floats) -> Floats:
    """Area of the part of the unit disc to the left of x in [-1, 1]."""
    return np.asarray(0.5 * np.pi + x * np.sqrt(1.0 - x**2) + np.arcsin(x))


@dataclass(frozen=True)
class Touching:
    """Who touches whom. Particles and walls touch below a gap of TOUCH mean radii."""

    pairs: Integers  # (pairs, 2)
    counts: Integers  # (n,) neighbours of each particle; walls do not count
    cluster: Integers  # (n,) particles of one cluster are connected by contacts
    walls: Flags  # (n, dim, 2) whether a particle touches the lower, the upper wall
    overlap: float  # the largest, in mean radii, walls included

    @property
    def coordination(self) -> float:
        """Mean number of neighbours, rattlers included."""
        return float(self.counts.mean())

    def backbone_coordination(self, needed: int) -> tuple[float, float]:
        """Mean number of neighbours without rattlers, and the fraction of these.

        A rattler has fewer contacts than needed to hold it, walls included, not counting those with rattlers: dim + 1
        hold a particle without gravity, dim with it.
        """
        kept = np.ones(len(self.counts), dtype=bool)
        while True:
            good = self.pairs[kept[self.pairs].all(axis=1)]
            neighbours = np.bincount(good.ravel(), minlength=len(kept))
            held = kept & (neighbours + self.walls.sum(axis=(1, 2)) >= needed)
            if (held == kept).all():
                mean = float(neighbours[kept].mean()) if kept.any() else 0.0
                return mean, float(1.0 - kept.mean())
            kept = held

    def percolates(self, axis: int) -> bool:
        """Whether a connected cluster touches both walls of this axis."""
        low, high = (set(self.cluster[self.walls[:, axis, side]].tolist()) for side in (0, 1))
        return bool(low & high)

    @property
    def clusters(self) -> int:
        """The number of clusters; 1: everything hangs together."""
        return int(self.cluster.max()) + 1

    @property
    def alone(self) -> int:
        """How many particles touch no other."""
        return int((self.counts == 0).sum())


def touching(x: Floats, r: Floats, low: Floats, high: Floats) -> Touching:
    """The contacts of particles at x (n, dim) with radii r (n,) in the box [low, high]."""
    n, tolerance = len(r), TOUCH * float(r.mean())
    pairs, gaps = near_pairs(x, r, tolerance)
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    _, cluster = connected_components(links, directed=False)
    away = np.stack([x - low - r[:, None], high - x - r[:, None]], axis=2)
    deepest = min(float(gaps.min(initial=0.0)), float(away.min(initial=0.0)))
    counts = np.bincount(pairs.ravel(), minlength=n)
    return Touching(pairs, counts, cluster.astype(np.int64), away < tolerance, -deepest / float(r.mean()))


def near_pairs(x: Floats, r: Floats, tolerance: float) -> tuple[Integers, Floats]:
    """Pairs (p, 2), and their gaps (p,), of particles whose surfaces are nearer than the tolerance."""
    half = np.repeat((r + 0.5 * tolerance)[:, None], x.shape[1], axis=1)
    kept, gaps = [np.empty((0, 2), dtype=np.int64)], [np.empty(0)]
    for i, j in overlaps.near_pairs(x, half):
        gap = np.linalg.norm(x[i] - x[j], axis=1) - (r[i] + r[j])
        near = gap < tolerance
        kept.append(np.stack([i[near], j[near]], axis=1))
        gaps.append(gap[near])
    pairs, gap = np.concatenate(kept), np.concatenate(gaps)
    order = np.lexsort(pairs.T[::-1])
    return pairs[order], gap[order]


def density_profile(
    x: Floats, r: Floats, low: Floats, high: Floats, slabs: int, margin: float = 0.0
) -> tuple[Floats, Floats]:
    """Heights of the middles of equal slabs across the last axis, and the solid fraction of each.

    margin: how much of the box next to the side walls is left out, nm.
    """
    edges = np.linspace(low[-1], high[-1], slabs + 1)
    fractions = []
    for bottom, top in pairwise(edges):
        a, b = low + margin, high - margin
        a[-1], b[-1] = bottom, top
        fractions.append(solid_fraction(x, r, a, b))
    return 0.5 * (edges[:-1] + edges[1:]), np.array(fractions)


