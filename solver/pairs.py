"""Pairs of particles that are near each other, whatever the mix of their sizes.

A particle looks for those of its own class and of smaller ones; the reaches of a class differ by less than two. So
what is found is in proportion to the particles that are really near, where one tree for all makes each small particle
look as far as the largest.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from .arrays import Floats, Integers

LOT = 100_000  # pairs in a lot, about
BLOCK = 16  # particles that look together at first


def near_pairs(centres: Floats, reach: Floats) -> Iterator[Integers]:
    """Pairs (m, 2) of numbers whose cubes of half edge `reach` (n,) about `centres` (n, dim) may meet, in lots.

    Each pair comes once, the smaller number first; a few come that do not meet. Lots stay small where everything is
    near everything, so that who has seen enough can stop.
    """
    if len(reach) < 2:
        return
    _, exponent = np.frexp(reach)  # reach = m 2^exponent, 1/2 <= m < 1
    classes = np.unique(exponent)
    members = [np.flatnonzero(exponent == value) for value in classes]
    trees = [cKDTree(centres[numbers]) for numbers in members]
    for larger, numbers in enumerate(members):
        for smaller in range(larger + 1):
            for i, j in _lots(centres, reach, numbers, members[smaller], trees[smaller]):
                if smaller == larger:
                    i, j = i[i < j], j[i < j]
                if len(i):
                    yield np.sort(np.stack([i, j], axis=1), axis=1)


def _lots(
    centres: Floats, reach: Floats, lookers: Integers, others: Integers, tree: "cKDTree"
) -> Iterator[tuple[Integers, Integers]]:
    """Who of `lookers` finds whom of `others`, which are in the tree in this order."""
    first, block, widest = 0, BLOCK, float(reach[others].max())
    while first < len(lookers):
        part = lookers[first : first + block]
        found = tree.query_ball_point(centres[part], reach[part] + widest, p=np.inf)
        counts = np.fromiter(map(len, found), np.int64, len(part))
        if total := int(counts.sum()):
            yield np.repeat(part, counts), others[np.concatenate([near for near in found if near])]
        first += block
        block = min(2 * block, 4096) if 4 * total < LOT else max(block // 2, 1)
