"""Boxes to measure in."""

from collections.abc import Iterator

import numpy as np

from frit.solver.arrays import Floats


def boxes(size: tuple[float, ...]) -> Iterator[tuple[Floats, Floats]]:
    """On nodes, through cells, thinner than a cell, within one cell, up to the walls."""
    full, ones = np.array(size), np.ones(len(size))
    yield 0.0 * full, full
    yield ones, full - 1.0
    yield 0.3137 * full, 0.7713 * full
    yield 0.41 * full, 0.41 * full + 0.05 * ones
    yield 0.0 * full, np.where(np.arange(len(size)) == 0, 0.123, full)
    yield np.where(np.arange(len(size)) == 1, 2.2, 0.5), np.where(np.arange(len(size)) == 1, 2.9, full - 0.25)
