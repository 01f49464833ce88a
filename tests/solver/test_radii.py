"""Radii: asked mean and spread to round-off, bounds, and the distributions themselves."""

import numpy as np
import pytest
from scipy.stats import kstest, lognorm, norm

from frit.solver.radii import SMALLEST, Distribution, draw, expected_volume


@pytest.mark.parametrize("distribution", ["normal", "lognormal"])
@pytest.mark.parametrize("count", [2, 30, 1000])
@pytest.mark.parametrize("std", [0.0, 0.1, 2.0])
def test_mean_and_spread_are_as_asked(distribution: Distribution, count: int, std: float) -> None:
    r = draw(count, distribution, 10.0, std, 3.0, (), np.random.default_rng(count))
    assert r.mean() == pytest.approx(10.0, rel=1e-12)
    assert r.std() == pytest.approx(std, abs=1e-12)


@pytest.mark.parametrize("distribution", ["normal", "lognormal"])
def test_samples_follow_their_distribution(distribution: Distribution) -> None:
    """An evenly drawn sample is nearer to the distribution than a random one: far below 1.36 / sqrt(n) = 0.03."""
    r = draw(2000, distribution, 10.0, 2.0, 5.0, (), np.random.default_rng(0))
    width = np.sqrt(np.log1p(0.04))
    law = norm(10.0, 2.0) if distribution == "normal" else lognorm(width, scale=10.0 * np.exp(-0.5 * width**2))
    assert kstest(r, law.cdf).statistic < 0.005


def test_bounds_hold_and_a_wide_spread_is_cut_at_a_fifth_of_the_mean() -> None:
    rng = np.random.default_rng(0)
    r = draw(3000, "normal", 10.0, 1.0, 2.0, (), rng)
    assert np.abs(r - 10.0).max() < 2.0 * 1.0 / 0.879 * 1.01  # two deviations of a cut normal, widened to spread 1
    wide = draw(3000, "normal", 10.0, 6.0, 3.0, (), rng)
    assert wide.min() >= SMALLEST * 10.0


def test_a_histogram_gives_its_shares_and_a_list_gives_each_radius() -> None:
    rng = np.random.default_rng(0)
    r = draw(100, "histogram", 0.0, 0.0, 0.0, [(8.0, 3.0), (4.0, 1.0)], rng)
    assert np.bincount(r.astype(int)).tolist() == [0, 0, 0, 0, 25, 0, 0, 0, 75]
    listed = [3.0, 5.0, 4.0, 8.0]
    assert sorted(draw(4, "histogram", 0.0, 0.0, 0.0, [(radius, 1.0) for radius in listed], rng)) == sorted(listed)


def test_the_mean_volume_of_a_normal_spread() -> None:
    """E R^3 = m^3 + 3 m s^2, E R^2 = m^2 + s^2."""
    assert expected_volume("normal", 10.0, 1.0, 5.0, (), 3) == pytest.approx(4 / 3 * np.pi * 1030.0, rel=1e-3)
    assert expected_volume("normal", 10.0, 1.0, 5.0, (), 2) == pytest.approx(np.pi * 101.0, rel=1e-6)
