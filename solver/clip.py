"""The part of each cell in a box, as simplices: what integrals over a box that cuts cells are made of."""

import numpy as np

from .arrays import Floats, Integers, Numbers
from .jit import ONE, ZERO, jit

DEPTH = 16  # of the stack: at most 6 cuts, each replaces the simplex on top by at most 3: 1 + 6 * 2 = 13


def clip_cells(nodes: Floats, cells: Numbers, lower: Floats, upper: Floats) -> tuple[Floats, Floats, Integers]:
    """The intersections of the cells with the box [lower, upper] as simplices that do not overlap.

    corners (s, dim + 1, dim), volumes (s,) > 0 and the place in `cells` of the cell that each is a part of (s,), in
    rising order. A cell inside the box is its own part.
    """
    dim = nodes.shape[1]
    low, high = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    if low.shape != (dim,) or high.shape != (dim,) or not (low < high).all():
        raise ValueError(f"box from {low.tolist()} to {high.tolist()}: {dim} increasing intervals are needed")
    room, found = 0, len(cells) + 64
    while found > room:  # a second time only where cells are cut into more simplices than cells
        room = found
        corners, volumes, owner = np.empty((room, dim + 1, dim)), np.empty(room), np.empty(room, dtype=np.int64)
        found = clip(corners, volumes, owner, nodes, cells, np.concatenate((low, -high)))
    return corners[:found], volumes[:found], owner[:found]


@jit
def clip(
    corners: Floats, volumes: Floats, owner: Integers, nodes: Floats, cells: Numbers, bounds: Floats
) -> int:
    """Cut each cell by half-space after half-space, depth first, and gather the simplices that are left over, as far as
    there is room for them; returns their number.

    Half-space i < dim: x_i >= bounds_i; half-space i >= dim: -x_(i - dim) >= bounds_i.
    """
    dim = nodes.shape[1]
    stack = np.empty((DEPTH, dim + 1, dim))  # simplices
    done = np.empty(DEPTH, np.int64)  # the number of half-spaces that have cut each of them
    x, distance, prism = np.empty((dim + 1, dim)), np.empty(dim + 1), np.empty((2, dim, dim))
    count = 0
    for p in range(len(cells)):
        if outside(nodes, cells[p], bounds):
            continue
        for corner in range(dim + 1):
            for i in range(dim):
                stack[0, corner, i] = nodes[cells[p, corner], i]
        done[0], top = 2 * dim if inside(nodes, cells[p], bounds) else 0, ZERO
        while top >= 0:
            if done[top] < 2 * dim:
                kept = arrange(x, distance, stack[top], done[top], bounds)
                done[top] += 1
                top = replace(stack, done, top, kept, x, distance, prism)
                continue
            part = volume(stack[top])
            if part > 0.0:
                if count < len(owner):
                    volumes[count], owner[count] = part, p
                    for corner in range(dim + 1):
                        for i in range(dim):
                            corners[count, corner, i] = stack[top, corner, i]
                count += 1
            top -= 1
    return count


@jit
def outside(nodes: Floats, cell: Numbers, bounds: Floats) -> bool:
    """Whether all corners are beyond one of the half-spaces."""
    dim = nodes.shape[1]
    for i in range(dim):
        below, above = True, True
        for a in cell:
            below &= nodes[a, i] <= bounds[i]
            above &= -nodes[a, i] <= bounds[dim + i]
        if below or above:
            return True
    return False


@jit
def inside(nodes: Floats, cell: Numbers, bounds: Floats) -> bool:
    """Whether all corners are in all half-spaces."""
    dim = nodes.shape[1]
    for a in cell:
        for i in range(dim):
            if nodes[a, i] < bounds[i] or -nodes[a, i] < bounds[dim + i]:
                return False
    return True


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
            section(stack, top, out, x, distance, ZERO, out)
        return top
    # Otherwise a prism between two simplices p and q of dim corners: kept corners and sections of edges.
    for i in range(dim):
        if kept == dim:
            section(prism, ZERO, i, x, distance, i, i)
            section(prism, ONE, i, x, distance, i, dim)
        else:
            section(prism, ZERO, i, x, distance, ZERO, i + 1 if i else 0)
            section(prism, ONE, i, x, distance, ONE, i + 1)
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
def volume(x: Floats) -> float:
    """|det(x_1 - x_0, ..., x_dim - x_0)| / dim!"""
    dim, determinant = x.shape[1], 0.0
    if dim == 2:
        determinant += (x[1, 0] - x[0, 0]) * (x[2, 1] - x[0, 1]) - (x[1, 1] - x[0, 1]) * (x[2, 0] - x[0, 0])
        return float(abs(determinant)) / 2.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        minor = (x[2, j] - x[0, j]) * (x[3, k] - x[0, k]) - (x[2, k] - x[0, k]) * (x[3, j] - x[0, j])
        determinant += (x[1, i] - x[0, i]) * minor
    return float(abs(determinant)) / 6.0
