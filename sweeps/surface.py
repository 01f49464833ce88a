"""The surface {rho = 1/2} of a pack of spheres as seen from outside: rays through a regular grid, lit by its slope."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from frit.solver.arrays import Floats, Integers

GRID = 110  # places along the longest edge where nodes are no lattice
RAYS = 420  # pixels along the longest edge of the picture
AZIMUTH, ELEVATION = -55.0, 24.0  # degrees: where the eye is
LIGHT = np.array([-0.45, 0.55, 0.7])  # to the right, up, towards the eye
AHEAD = 20_000  # rays at a time


class Grid(NamedTuple):
    """Fields at regular places: rho and owner (nx, ny, nz), and the distance of neighbours along each axis, nm."""

    rho: Floats
    owner: Integers
    step: Floats


class Seen(NamedTuple):
    """What the eye sees: colours (h, w, 4) with the last one 0 beside the pack, and the picture's extent, nm."""

    picture: Floats
    extent: tuple[float, float, float, float]
    edges: Floats  # (12, 2, 2) of the domain


def gridded(nodes: Floats, rho: Floats, owner: Integers, size: Floats) -> Grid:
    """From nodes anywhere; those of a lattice are a grid already."""
    axes = [np.unique(np.round(nodes[:, k], 9)) for k in range(3)]
    shape = tuple(len(axis) for axis in axes)
    if np.prod(shape) == len(nodes):
        order = np.lexsort((nodes[:, 2], nodes[:, 1], nodes[:, 0]))
        return Grid(rho[order].reshape(shape), owner[order].reshape(shape), size / (np.array(shape) - 1))
    counts = np.maximum(np.round(size / size.max() * GRID).astype(int), 2)
    lines = [np.linspace(0, s, n) for s, n in zip(size, counts, strict=True)]
    places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    distance, near = map(np.asarray, cKDTree(nodes).query(places.reshape(-1, 3), 4))
    weight = 1.0 / np.maximum(distance, 1e-9 * size.max()) ** 2
    mean = (weight * rho[near]).sum(axis=1) / weight.sum(axis=1)
    shape = tuple(counts.tolist())
    return Grid(mean.reshape(shape), owner[near[:, 0]].reshape(shape), size / (counts - 1))


def seen(grid: Grid, size: Floats, colours: Floats) -> Seen:
    """The first crossing of each ray with rho = 1/2, in the colour of its particle; colours (particles + 1, 3)."""
    right, up, back = _eye()
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * size
    flat = np.stack([corners @ right, corners @ up], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    pixel = (high - low).max() / RAYS
    x, y = (np.arange(a + 0.5 * pixel, b, pixel) for a, b in zip(low, high, strict=True))
    depth = corners @ back
    z = np.arange(depth.max(), depth.min(), -0.8 * grid.step.min())
    starts = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    slopes = np.gradient(grid.rho, *grid.step)
    picture = np.zeros((len(starts), 4))
    for part in np.array_split(np.arange(len(starts)), len(starts) // AHEAD + 1):
        base = starts[part, :1] * right + starts[part, 1:] * up
        values = _at(grid.rho, base[:, None] + z[:, None] * back, grid.step)
        inside = values > 0.5
        hit = inside.any(axis=1)
        k = inside.argmax(axis=1)[hit]
        rows = np.flatnonzero(hit)
        after, before = values[rows, k], values[rows, np.maximum(k - 1, 0)]
        share = np.where(k > 0, (0.5 - before) / np.where(after > before, after - before, 1.0), 1.0)
        at = base[hit] + (z[np.maximum(k - 1, 0)] + share * (z[k] - z[np.maximum(k - 1, 0)]))[:, None] * back
        normal = -np.stack([_at(np.asarray(slope), at, grid.step) for slope in slopes], axis=-1)
        normal[k == 0] = back  # cut by the wall
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        lit = (normal @ (LIGHT @ np.stack([right, up, back])) / np.linalg.norm(LIGHT)).clip(0, 1)
        whose = grid.owner[tuple(np.clip(np.rint(at / grid.step).astype(int), 0, np.array(grid.rho.shape) - 1).T)]
        nearer = grid.owner[tuple(
            np.clip(np.rint((at - normal * grid.step.max()) / grid.step).astype(int), 0, np.array(grid.rho.shape) - 1).T
        )]  # fmt: skip
        colour = colours[np.where(whose >= 0, whose, nearer)]
        picture[part[hit], :3] = (colour * (0.35 + 0.7 * lit[:, None])).clip(0, 1)
        picture[part[hit], 3] = 1.0
    ends = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
    edges = np.array([[flat[a], flat[b]] for a, b in ends])
    return Seen(picture.reshape(len(y), len(x), 4), (low[0], x[-1], low[1], y[-1]), edges)


def _eye() -> tuple[Floats, Floats, Floats]:
    """Unit vectors to the right, up and towards the eye."""
    a, e = np.radians(AZIMUTH), np.radians(ELEVATION)
    back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return right, np.cross(back, right), back


def _at(values: Floats, places: Floats, step: Floats) -> Floats:
    """Linear between the grid's places; 0 outside."""
    index = np.moveaxis(places / step, -1, 0)
    return np.asarray(map_coordinates(values, index, order=1, mode="constant", cval=0.0))
