"""The part of each cell in a box: exact volumes and centroids, for averages over a box that cuts cells."""

import numpy as np

from .arrays import Floats, Integers, Numbers
from .jit import jit

DEPTH = 16  # of the stack: at most 6 cuts, each replaces the simplex on top by at most 3: 1 + 6 * 2 = 13


def clip_cells(nodes: Floats, cells: Numbers, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Volumes (p,) and centroids (p, dim) of the cells' intersections with the box [lower, upper].

    The integral of a linear field over the box is sum_p volume_p field(centroid_p), exactly. A cell outside
    has volume 0 and keeps its barycentre.
    """
    dim = nodes.shape[1]
    low, high = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    if low.shape != (dim,) or high.shape != (dim,) or not (low < high).all():
        raise ValueError(f"box from {low.tolist()} to {high.tolist()}: {dim} increasing intervals are needed")
    volumes, centroids = np.zeros(len(cells)), np.zeros((len(cells), dim))
    clip(volumes, centroids, nodes, cells, np.concatenate((low, -high)))
    return volumes, centroids


@jit
def clip(volumes: Floats, centroids: Floats, nodes: Floats, cells: Numbers, bounds: Floats) -> None:
    """Cut each cell by half-space after half-space, depth first, and gather the simplices that are left over.

    Half-space i < dim: x_i >= bounds_i; half-space i >= dim: -x_(i - dim) >= bounds_i.
    """
    dim = nodes.shape[1]
    stack = np.empty((DEPTH, dim + 1, dim))  # simplices
    done = np.empty(DEPTH, np.int64)  # the number of half-spaces that have cut each of them
    x, distance, prism = np.empty((dim + 1, dim)), np.empty(dim + 1), np.empty((2, dim, dim))
    for p in range(len(cells)):
        for corner in range(dim + 1):
            for i in range(dim):
                stack[0, corner, i] = nodes[cells[p, corner], i]
                centroids[p, i] += nodes[cells[p, corner], i] / (dim + 1)
        done[0], top = 0, 0
        while top >= 0:
            if done[top] == 2 * dim:
                gather(volumes, centroids, p, stack[top])
                top -= 1
            else:
                kept = arrange(x, distance, stack[top], done[top], bounds)
                done[top] += 1
                top = replace(stack, done, top, kept, x, distance, prism)


@jit
def arrange(x: Floats, distance: Floats, simplex: Floats, plane: int, bounds: Floats) -> int:
    """Copy the simplex to x, corners in the half-space first; return how many, 0 if they span nothing."""
    dim = simplex.shape[1]
    axis, sign = plane % dim, 1.0 if plane < dim else -1.0
    first, last, deepest = 0, dim, 0.0
    for corner in range(dim + 1):
        d = sign * simplex[corner, axis] - bounds[plane]
        deepest = max(deepest, d)
        if d >= 0.0:
            row = first
            first += 1
        else:
            row = last
            last -= 1
        distance[row] = d
        for i in range(dim):
            x[row, i] = simplex[corner, i]
    return first if deepest > 0.0 else 0


@jit
def replace(
    stack: Floats, done: Integers, top: int, kept: int, x: Floats, distance: Floats, prism: Floats
) -> int:
    """Put the kept part of simplex x, cut into simplices, in place of the one on top; return the new top."""
    dim: int = x.shape[1]
    if kept == 0 or kept == dim + 1:
        return top if kept else top - 1
    if kept == 1:  # corner 0 and the sections of its edges
        for out in range(dim + 1):
            section(stack, top, out, x, distance, 0, out)
        return top
    # Otherwise a prism between two simplices p and q of dim corners: kept corners and sections of edges.
    for i in range(dim):
        if kept == dim:
            section(prism, 0, i, x, distance, i, i)
            section(prism, 1, i, x, distance, i, dim)
        else:
            section(prism, 0, i, x, distance, 0, i + 1 if i else 0)
            section(prism, 1, i, x, distance, 1, i + 1)
    # It consists of the simplices (p_0 ... p_k, q_k ... q_(dim - 1)), k = 0 ... dim - 1.
    for k in range(dim):
        done[top + k] = done[top]
        for corner in range(dim + 1):
            for i in range(dim):
                stack[top + k, corner, i] = prism[0, corner, i] if corner <= k else prism[1, corner - 1, i]
    return top + dim - 1


@jit
def section(target: Floats, m: int, row: int, x: Floats, distance: Floats, a: int, b: int) -> None:
    """target[m, row] = the crossing of the plane by the edge from corner a (inside) to b; or a, if b = a."""
    t = 0.0 if a == b else distance[a] / (distance[a] - distance[b])
    for i in range(x.shape[1]):
        target[m, row, i] = x[a, i] + t * (x[b, i] - x[a, i])


@jit
def gather(volumes: Floats, centroids: Floats, p: int, x: Floats) -> None:
    """Add simplex x to volume p and move centroid p towards its barycentre by its share of the volume."""
    dim = x.shape[1]
    volume = (x[1, 0] - x[0, 0]) * (x[2, 1] - x[0, 1]) - (x[1, 1] - x[0, 1]) * (x[2, 0] - x[0, 0])
    if dim == 3:
        volume = 0.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            minor = (x[2, j] - x[0, j]) * (x[3, k] - x[0, k]) - (x[2, k] - x[0, k]) * (x[3, j] - x[0, j])
            volume += (x[1, i] - x[0, i]) * minor
    volume = abs(volume) / (2.0 if dim == 2 else 6.0)
    if volume > 0.0:
        volumes[p] += volume
        for i in range(dim):
            mean = 0.0
            for corner in range(dim + 1):
                mean += x[corner, i] / (dim + 1)
            centroids[p, i] += volume / volumes[p] * (mean - centroids[p, i])
