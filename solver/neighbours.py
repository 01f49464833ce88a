"""Which nodes lie within a given range of each point: a grid of cells, in two and three dimensions."""

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Integers, Numbers
from .jit import jit

PER_RANGE = 2  # cells along a typical range: fewer nodes outside of it are looked at than with cells as large as it


@dataclass(frozen=True)
class Grid:
    """Nodes sorted into the cells of a grid. Cell c (row-major) holds the nodes order[starts[c] : starts[c + 1]]."""

    nodes: Floats  # (n, dim) nm
    low: Floats  # (dim,) corner of the grid
    edge: float  # of a cell, nm
    shape: Integers  # (3,) cells along each axis; one along an axis that is not there
    starts: Integers
    order: Numbers
    sorted: Floats  # (n, 3) nodes[order], 0 along an axis that is not there

    def within(self, points: Floats, ranges: Floats) -> tuple[Integers, Numbers]:
        """Offsets (p + 1,) and numbers of the nodes at most ranges[p] away from points[p], in no particular order."""
        offsets = np.zeros(len(points) + 1, dtype=np.int64)
        none = np.empty(0, dtype=np.int32)
        find(none, offsets, points, ranges, self.low, self.edge, self.shape, self.starts, self.order, self.sorted)
        np.cumsum(offsets, out=offsets)
        near = np.empty(int(offsets[-1]), dtype=np.int32)
        find(near, offsets, points, ranges, self.low, self.edge, self.shape, self.starts, self.order, self.sorted)
        return offsets, near


def make_grid(nodes: Floats, typical: float) -> Grid:
    """The grid for searches within about `typical` nm; never many more cells than nodes."""
    count, dim = nodes.shape
    low, high = (nodes.min(axis=0), nodes.max(axis=0)) if count else (np.zeros(dim), np.zeros(dim))
    extent = np.maximum(high - low, 1e-300)
    edge = typical / PER_RANGE
    while np.prod(np.floor(extent / edge) + 1.0) > 4.0 * count + 64.0:
        edge *= 1.25
    shape = np.ones(3, dtype=np.int64)
    shape[:dim] = np.floor(extent / edge).astype(np.int64) + 1
    at = np.zeros((count, 3))
    at[:, :dim] = nodes
    index = np.minimum(((nodes - low) / edge).astype(np.int64), shape[:dim] - 1)
    cell = np.zeros(count, dtype=np.int64)
    for axis in range(dim):
        cell = cell * shape[axis] + index[:, axis]
    order = np.argsort(cell, kind="stable").astype(np.int32)
    starts = np.searchsorted(cell[order], np.arange(np.prod(shape) + 1))
    return Grid(nodes, low, edge, shape, starts, order, at[order])


@jit
def find(
    near: Numbers, offsets: Integers, points: Floats, ranges: Floats,
    low: Floats, edge: float, shape: Integers, starts: Integers, order: Numbers, nodes: Floats,
) -> None:
    """Count the neighbours of point p into offsets[p + 1] where `near` is empty, else write them from offsets[p] on."""
    dim = points.shape[1]
    x = np.zeros(3)
    first = np.zeros(3, dtype=np.int64)
    last = np.zeros(3, dtype=np.int64)
    for p in range(ranges.size):
        r = ranges[p]
        for k in range(dim):
            x[k] = points[p, k]
            first[k] = min(max(np.int64(np.floor((x[k] - r - low[k]) / edge)), 0), shape[k] - 1)
            last[k] = min(max(np.int64(np.floor((x[k] + r - low[k]) / edge)), 0), shape[k] - 1)
        found = 0 if near.size == 0 else offsets[p]
        begin = found
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                row = (i * shape[1] + j) * shape[2]
                for e in range(starts[row + first[2]], starts[row + last[2] + 1]):
                    square = 0.0
                    for k in range(3):
                        square += (x[k] - nodes[e, k]) * (x[k] - nodes[e, k])
                    if square <= r * r:
                        if near.size:
                            near[found] = order[e]
                        found += 1
        if near.size == 0:
            offsets[p + 1] = found - begin
