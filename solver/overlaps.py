"""Which of many boxes are near enough to share room, at a cost near-linear in their number for any mix of sizes.

Boxes are sorted into classes of like widths, a factor of two each. Two classes are compared in a metric in which their
widest boxes reach each other at a distance of 1: so small boxes are searched for as near as small ones reach, whatever
else there is. Pairs come in batches of bounded size; whoever has seen enough of them stops.
"""

from collections.abc import Iterator
from itertools import combinations_with_replacement

import numpy as np
from scipy.spatial import cKDTree

from .arrays import Floats, Integers

CLASSES = 128  # at most: more would cost more than they spare
BATCH = 200_000  # pairs, about
FIRST = 16  # points in the first batch of two classes
LARGEST = 1e300  # coordinates in the common metric: what is as far as this is not told apart
WIDER = 1.0 + 1e-9  # what only touches is looked at too


def near_pairs(x: Floats, half: Floats) -> Iterator[tuple[Integers, Integers]]:
    """Batches of pairs (i, j), i < j, that hold every two boxes x +- half, both (n, dim), with common points.

    Each pair comes once. Of two classes all pairs come that lie within the reach of their widest boxes.
    """
    for a, b in combinations_with_replacement(_classes(half), 2):
        few, many = (a, b) if len(a) <= len(b) else (b, a)
        with np.errstate(over="ignore", under="ignore"):
            reach = np.maximum(half[a].max(axis=0) + half[b].max(axis=0), np.finfo(float).tiny)
            scaled = np.clip(x / reach, -LARGEST, LARGEST)
        yield from _within_reach(scaled, few, many)


def _classes(half: Floats) -> list[Integers]:
    """The boxes by octaves of their widths along the axes; coarser where these would be too many."""
    octaves = np.frexp(half)[1].astype(np.int64)
    for step in range(12):
        kinds, kind = np.unique(octaves >> step, axis=0, return_inverse=True)
        if len(kinds) <= CLASSES:
            break
    order = np.argsort(kind.ravel(), kind="stable")
    return np.split(order, np.flatnonzero(np.diff(kind.ravel()[order])) + 1)


def _within_reach(x: Floats, few: Integers, many: Integers) -> Iterator[tuple[Integers, Integers]]:
    """Pairs of one box of each class that are nearer than 1 along every axis."""
    tree, start, size = cKDTree(x[many]), 0, FIRST
    while start < len(few):
        part = few[start : start + size]
        found = [np.asarray(near, dtype=np.int64) for near in tree.query_ball_point(x[part], WIDER, p=np.inf)]
        i, j = np.repeat(part, [len(near) for near in found]), many[np.concatenate(found)]
        good = i < j if few is many else np.full(len(i), True)
        yield np.minimum(i, j)[good], np.maximum(i, j)[good]
        start += size
        size = max(1, min(4 * size, size * BATCH // max(len(i), 1)))
