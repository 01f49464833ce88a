"""Radii of a packing: drawn from a distribution so that even few particles have the asked mean and spread."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from .arrays import Floats

SMALLEST = 0.2  # of the mean: no radius is drawn below
BITS = 36  # that are kept of 53

Distribution = Literal["normal", "lognormal", "histogram"]
Histogram = Sequence[tuple[float, float]]  # radius, weight


def steady(values: ArrayLike) -> Floats:
    """The values with BITS bits: exponentials, logarithms and powers, whose last bit is another on another processor,
    are the same there, but for one in 2^16 of those that differ.
    """
    mantissa, exponent = np.frexp(values)
    return np.asarray(np.ldexp(np.rint(np.ldexp(mantissa, BITS)), exponent - BITS))


def draw(
    count: int,
    distribution: Distribution,
    mean: float,
    std: float,
    truncation: float,
    histogram: Histogram,
    rng: np.random.Generator,
) -> Floats:
    """`count` radii in random order.

    One quantile is drawn from each of `count` equal strata, so the sample follows its distribution evenly. Normal and
    log-normal samples are then shifted and scaled to have mean and standard deviation as asked (a single particle has
    the mean); both are cut at `truncation` standard deviations (of the radius, of its logarithm), and nothing is drawn
    below SMALLEST of the mean, so a wide spread leans to one side.
    """
    levels = (rng.permutation(count) + rng.random(count)) / count
    if distribution == "histogram":
        values, weights = np.array(sorted(histogram), dtype=float).T
        steps = np.cumsum(weights) / weights.sum()
        return np.asarray(values[np.minimum(np.searchsorted(steps, levels), len(values) - 1)])
    if std == 0.0 or count == 1:
        return np.full(count, mean)
    if distribution == "lognormal":
        width = np.sqrt(np.log1p((std / mean) ** 2))
        raw = mean * np.exp(width * _normal(levels, -truncation, truncation) - 0.5 * width**2)
    else:
        raw = mean + std * _normal(levels, max(-truncation, (SMALLEST - 1.0) * mean / std), truncation)
    raw = steady(raw)
    return np.asarray(np.maximum(mean + (raw - raw.mean()) * (std / raw.std()), SMALLEST * mean))


def _normal(levels: Floats, low: float, high: float) -> Floats:
    """Standard normal variates between low and high at the given levels in (0, 1)."""
    return np.asarray(ndtri(ndtr(low) + levels * (ndtr(high) - ndtr(low))))


def expected_volume(
    distribution: Distribution, mean: float, std: float, truncation: float, histogram: Histogram, dim: int
) -> float:
    """Mean volume of a particle, from a large sample drawn as above."""
    r = draw(10_000, distribution, mean, std, truncation, histogram, np.random.default_rng(0))
    return float(np.mean(np.pi * r**2 if dim == 2 else 4.0 / 3.0 * np.pi * r**3))
