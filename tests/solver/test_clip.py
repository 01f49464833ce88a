"""Cells cut by a box: against inclusion-exclusion, qhull, and the fact that the parts make up the whole."""

from itertools import pairwise, product

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, Delaunay, HalfspaceIntersection

from frit.solver.arrays import Floats, Numbers
from frit.solver.clip import clip_cells
from frit.solver.geometry import Mesh, lattice


def random_mesh(dim: int, count: int, seed: int = 1) -> tuple[Floats, Numbers]:
    """Delaunay cells that fill the unit box: its corners and random points inside."""
    inside = np.random.default_rng(seed).random((count, dim))
    nodes = np.concatenate([np.array(list(product((0.0, 1.0), repeat=dim))), inside])
    return nodes, Delaunay(nodes).simplices.astype(np.int32)


def own_volumes(nodes: Floats, cells: Numbers) -> Floats:
    edges = nodes[cells[:, 1:]] - nodes[cells[:, :1]]
    return np.asarray(np.abs(np.linalg.det(edges)) / (2.0 if nodes.shape[1] == 2 else 6.0))


def measured(nodes: Floats, cells: Numbers, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Volumes (p,) and centroids (p, dim) of the parts in the box; a cell outside keeps its barycentre."""
    corners, parts, owner = clip_cells(nodes, cells, lower, upper)
    edges = corners[:, 1:] - corners[:, :1]
    exact = np.abs(np.linalg.det(edges)) / (2.0 if nodes.shape[1] == 2 else 6.0)
    np.testing.assert_allclose(parts, exact, rtol=1e-9, atol=1e-15)
    volumes: Floats = np.asarray(np.bincount(owner, parts, len(cells)), dtype=np.float64)
    centroids: Floats = np.asarray(nodes[cells].mean(axis=1))
    shares = (parts / volumes[owner])[:, None] * (corners.mean(axis=1) - centroids[owner])
    np.add.at(centroids, owner, shares)
    return volumes, centroids


def twin(simplex: Floats, lower: Floats, upper: Floats) -> tuple[float, Floats]:
    """Volume and centroid by qhull: intersect the half-spaces, triangulate, sum up the simplices."""
    eye = np.eye(len(lower))
    planes = np.concatenate(
        [ConvexHull(simplex).equations, np.column_stack([-eye, lower]), np.column_stack([eye, -upper])]
    )
    # The centre of the largest ball inside: n . x + |n| r <= -offset, r as large as possible.
    norms = np.linalg.norm(planes[:, :-1], axis=1)
    ball = linprog(
        [0.0] * len(lower) + [-1.0],
        A_ub=np.column_stack([planes[:, :-1], norms]),
        b_ub=-planes[:, -1],
        bounds=[(None, None)] * (len(lower) + 1),
    )
    best = np.asarray(ball.x)
    if best[-1] < 1e-9:
        return 0.0, np.asarray(simplex.mean(axis=0))
    corners = HalfspaceIntersection(planes, best[:-1]).intersections
    pieces = Delaunay(corners).simplices
    volumes = own_volumes(corners, pieces)
    return float(volumes.sum()), np.asarray(volumes @ corners[pieces].mean(axis=1) / volumes.sum())


@pytest.mark.parametrize(("dim", "count"), [(2, 300), (3, 200)])
@pytest.mark.parametrize(("low", "high"), [(0.21, 0.83), (0.5, 0.501), (-1.0, 2.0), (0.0, 1.0), (0.4, 1.7)])
def test_the_parts_have_the_volume_and_the_first_moment_of_the_box(
    dim: int, count: int, low: float, high: float
) -> None:
    nodes, cells = random_mesh(dim, count)
    lower, upper = np.full(dim, low), np.full(dim, high)
    lower[0] += 0.0003
    volumes, centroids = measured(nodes, cells, lower, upper)
    filled = np.clip([lower, upper], 0.0, 1.0)  # the mesh ends at the unit box
    volume = np.prod(filled[1] - filled[0])
    assert volumes.sum() == pytest.approx(volume, rel=1e-12)
    np.testing.assert_allclose(volumes @ centroids, volume * filled.mean(axis=0), rtol=1e-12)


@pytest.mark.parametrize(("dim", "count"), [(2, 80), (3, 40)])
def test_every_cell_agrees_with_qhull(dim: int, count: int) -> None:
    nodes, cells = random_mesh(dim, count, seed=2)
    lower, upper = np.array([0.3, 0.2, 0.4])[:dim], np.array([0.7, 0.6, 0.9])[:dim]
    volumes, centroids = measured(nodes, cells, lower, upper)
    cut = (volumes > 1e-9) & (volumes < own_volumes(nodes, cells) * (1 - 1e-9))
    some = np.concatenate([np.flatnonzero(cut)[:40], np.flatnonzero(~cut)[:20]])
    for p in some:
        volume, centroid = twin(nodes[cells[p]], lower, upper)
        # qhull merges corners closer than about 1e-12
        assert volumes[p] == pytest.approx(volume, rel=1e-7, abs=1e-11)
        if volumes[p] > 1e-9:
            np.testing.assert_allclose(centroids[p], centroid, rtol=0, atol=1e-7)
    assert np.count_nonzero(cut) > 20


@pytest.mark.parametrize("t", [0.1, 0.25, 1 / 3, 0.4, 0.5, 0.7, 1.0, 3.0])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_corner_simplex_in_a_cube_follows_inclusion_exclusion(dim: int, t: float) -> None:
    """dim! V = sum_k (-1)^k C(dim, k) max(0, 1 - k t)^dim for x_i >= 0, sum x_i <= 1 cut by x_i <= t."""
    nodes = np.concatenate([np.zeros((1, dim)), np.eye(dim)])
    cells = np.arange(dim + 1, dtype=np.int32)[None]
    volumes, centroids = measured(nodes, cells, np.full(dim, -1.0), np.full(dim, t))
    signed = {2: (1, -2, 1), 3: (1, -3, 3, -1)}[dim]
    theory = sum(c * max(0.0, 1 - k * t) ** dim for k, c in enumerate(signed)) / (2.0 if dim == 2 else 6.0)
    assert volumes[0] == pytest.approx(theory, rel=1e-14)
    np.testing.assert_allclose(centroids[0], centroids[0, 0], rtol=1e-14)  # by symmetry


def degenerate_cuts(mesh: Mesh, axis: int) -> list[float]:
    """Planes exactly through nodes, a rounding error beside them, and through barycentres."""
    lines = np.unique(mesh.nodes[:, axis])
    inner = lines[len(lines) // 3]
    return [lines[0], inner, np.nextafter(inner, 9.0), mesh.points[len(mesh.points) // 2, axis], lines[-1]]


@pytest.mark.parametrize("size", [(5.0, 4.0), (3.0, 3.3, 2.9)])
def test_boxes_that_tile_the_domain_share_out_every_cell(size: tuple[float, ...]) -> None:
    mesh = lattice(size, 1.0)
    cuts = [sorted(degenerate_cuts(mesh, axis)) for axis in range(len(size))]
    volume, moment = np.zeros(len(mesh.cells)), np.zeros_like(mesh.points)
    for intervals in product(*(list(pairwise(c)) for c in cuts)):
        lower, upper = np.array(intervals).T
        part, centroid = measured(mesh.nodes, mesh.cells, lower, upper)
        assert ((part == 0) | ((centroid > lower - 1e-12) & (centroid < upper + 1e-12)).all(axis=1)).all()
        volume += part
        moment += part[:, None] * centroid
    np.testing.assert_allclose(volume, mesh.weights, rtol=1e-12)
    np.testing.assert_allclose(moment, mesh.weights[:, None] * mesh.points, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("size", [(5.0, 4.0), (3.0, 3.3, 2.9)])
def test_cells_inside_and_outside_are_left_as_they_are(size: tuple[float, ...]) -> None:
    mesh = lattice(size, 1.0)
    box = np.array(size)
    volumes, centroids = measured(mesh.nodes, mesh.cells, 0 * box, box)
    np.testing.assert_allclose(volumes, mesh.weights, rtol=1e-14)
    np.testing.assert_allclose(centroids, mesh.points, rtol=1e-14)
    volumes, centroids = measured(mesh.nodes, mesh.cells, box, 2 * box)  # touches the mesh at one corner
    assert (volumes == 0).all()
    np.testing.assert_allclose(centroids, mesh.points, rtol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_inside_one_cell_and_boxes_that_only_touch_it(dim: int) -> None:
    nodes = 4 * np.concatenate([np.zeros((1, dim)), np.eye(dim)])
    cells = np.arange(dim + 1, dtype=np.int32)[None]
    volumes, centroids = measured(nodes, cells, np.full(dim, 0.5), np.full(dim, 1.0))
    assert volumes[0] == pytest.approx(0.5**dim, rel=1e-14)
    np.testing.assert_allclose(centroids[0], 0.75, rtol=1e-14)
    for low, high in ((-1.0, 0.0), (4 / dim, 5.0)):  # touches a corner; touches the slanted face
        volumes, _ = measured(nodes, cells, np.full(dim, low), np.full(dim, high))
        assert volumes[0] == pytest.approx(0.0, abs=1e-40)
    face = np.full(dim, 5.0)
    face[0] = 0.0
    volumes, _ = measured(nodes, cells, np.full(dim, -1.0), face)  # shares a whole face with the cell
    assert volumes[0] == 0


@pytest.mark.parametrize(("dim", "count"), [(2, 100), (3, 60)])
def test_translation_and_the_order_of_corners_do_not_matter(dim: int, count: int) -> None:
    nodes, cells = random_mesh(dim, count, seed=3)
    lower, upper, shift = np.full(dim, 0.27), np.full(dim, 0.81), np.array([64.0, -32.0, 128.0])[:dim]
    volumes, centroids = measured(nodes, cells, lower, upper)
    rolled = np.roll(cells, 1, axis=1)
    moved, moved_centroids = measured(nodes + shift, rolled, lower + shift, upper + shift)
    # The shift costs 7 bits of the coordinates: 128 eps = 3e-14 per coordinate of size 1.
    np.testing.assert_allclose(moved, volumes, rtol=0, atol=1e-13)
    kept = volumes > 1e-6
    np.testing.assert_allclose((moved_centroids - shift)[kept], centroids[kept], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("lower", "upper"), [([0.0, 0.0], [1.0, 0.0]), ([0.0], [1.0]), ([0.0, np.nan], [1.0, 1.0])]
)
def test_a_box_without_volume_is_refused(lower: list[float], upper: list[float]) -> None:
    nodes, cells = random_mesh(2, 5)
    with pytest.raises(ValueError, match="2 increasing intervals"):
        clip_cells(nodes, cells, np.array(lower), np.array(upper))
