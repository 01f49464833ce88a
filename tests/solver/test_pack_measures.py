"""Solid fractions against Monte Carlo and closed forms; contacts, rattlers and percolation of small arrangements."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frit.solver.arrays import Floats
from frit.solver.pack_measures import density_profile, near_pairs, parts_inside, solid_fraction, touching, volumes


def halton(n: int, base: int) -> Floats:
    """The first n numbers of the van der Corput sequence."""
    i, factor, result = np.arange(1, n + 1), 1.0 / base, np.zeros(n)
    while i.any():
        result += factor * (i % base)
        i, factor = i // base, factor / base
    return result


def counted(x: Floats, r: float, low: Floats, high: Floats, points: int = 40_000) -> float:
    """Volume of a particle in a box by counting evenly spread points in the box: error about a thousandth of it."""
    u = np.stack([halton(points, base) for base in (2, 3, 5)[: len(x)]], axis=1)
    inside = np.linalg.norm(low + u * (high - low) - x, axis=1) < r
    return float(inside.mean() * np.prod(high - low))


@pytest.mark.parametrize("dim", [2, 3])
def test_parts_of_particles_in_a_box_against_counting(dim: int) -> None:
    rng = np.random.default_rng(1)
    x, r = rng.uniform(-1.5, 2.5, (60, dim)), rng.uniform(0.2, 1.8, 60)
    low, high = np.zeros(dim), np.linspace(1.0, 1.2, dim)
    found = parts_inside(x, r, low, high)
    for a in range(60):
        assert abs(found[a] - counted(x[a], r[a], low, high)) < 4e-3


@settings(max_examples=60, deadline=None)
@given(st.floats(-2.0, 2.0), st.floats(0.1, 1.0), st.sampled_from([2, 3]))
def test_a_halfspace_cuts_off_a_cap(height: float, r: float, dim: int) -> None:
    """A large box whose one face cuts the particle: pi h^2 (3 R - h) / 3; a segment of a circle."""
    low, high = np.full(dim, -9.0), np.full(dim, 9.0)
    high[-1] = height
    h = min(max(height + r, 0.0), 2.0 * r)
    cap = np.pi * h**2 * (3.0 * r - h) / 3.0
    if dim == 2:
        t = np.arccos(np.clip(1.0 - h / r, -1.0, 1.0))
        cap = r**2 * (t - np.sin(t) * np.cos(t))
    found = parts_inside(np.zeros((1, dim)), np.array([r]), low, high)[0]
    assert found == pytest.approx(cap, abs=1e-4 * r**dim)


def test_octants_share_a_sphere() -> None:
    """Eight boxes that meet inside a sphere hold all of it."""
    x, r, total = np.array([[0.1, -0.2, 0.3]]), np.array([1.0]), 0.0
    for corner in np.ndindex(2, 2, 2):
        low = np.where(np.array(corner) == 1, 0.0, -5.0)
        total += parts_inside(x, r, low, low + 5.0)[0]
    assert total == pytest.approx(4.0 / 3.0 * np.pi, rel=1e-4)


def test_slabs_add_up_to_the_container() -> None:
    rng = np.random.default_rng(2)
    x, r = rng.uniform(1.0, 9.0, (40, 3)), np.full(40, 0.9)
    low, high = np.zeros(3), np.full(3, 10.0)
    _, fractions = density_profile(x, r, low, high, 7)
    assert fractions.mean() == pytest.approx(solid_fraction(x, r, low, high), rel=1e-4)
    assert solid_fraction(x, r, low, high) == pytest.approx(volumes(r, 3).sum() / 1000.0, rel=1e-6)


def test_pairs_are_all_pairs_whatever_the_sizes() -> None:
    rng = np.random.default_rng(3)
    for r in (np.full(80, 0.5), rng.lognormal(-1.0, 0.8, 80)):
        x = rng.uniform(0.0, 8.0, (80, 3))
        gap = np.linalg.norm(x[:, None] - x, axis=2) - r - r[:, None]
        expected = np.argwhere(np.triu(gap < 0.2, 1))
        pairs, gaps = near_pairs(x, r, 0.2)
        assert pairs.tolist() == expected.tolist()
        np.testing.assert_allclose(gaps, gap[expected[:, 0], expected[:, 1]], atol=1e-12)


def test_a_chain_percolates_and_a_broken_one_does_not() -> None:
    x, r = np.array([[1.0, 1.0], [1.0, 3.0], [1.0, 5.0]]), np.ones(3)
    low, high = np.zeros(2), np.array([4.0, 6.0])
    chain = touching(x, r, low, high)
    assert (chain.percolates(1), chain.percolates(0)) == (True, False)
    assert (chain.clusters, chain.alone) == (1, 0)
    assert chain.coordination == pytest.approx(4 / 3)
    x[1, 0] = 2.5
    broken = touching(x, r, low, high)
    assert (broken.percolates(1), broken.clusters, broken.alone) == (False, 3, 3)


def test_overlap_is_the_largest_of_pairs_and_walls() -> None:
    low, high = np.zeros(2), np.full(2, 10.0)
    x, r = np.array([[1.0, 1.0], [2.99, 1.0]]), np.ones(2)
    assert touching(x, r, low, high).overlap == pytest.approx(0.01)
    x[0, 1] = 0.95
    assert touching(x, r, low, high).overlap == pytest.approx(0.05)


def test_rattlers_are_peeled_off() -> None:
    """Four discs in a square touch two neighbours and two walls each; one on its own counts as a rattler."""
    x = np.array([[1.0, 1.0], [3.0, 1.0], [1.0, 3.0], [3.0, 3.0], [2.0, 2.0]])
    r = np.array([1.0, 1.0, 1.0, 1.0, 0.1])
    contacts = touching(x, r, np.zeros(2), np.full(2, 4.0))
    mean, rattlers = contacts.backbone_coordination(3)
    assert mean == 2.0
    assert rattlers == pytest.approx(0.2)
