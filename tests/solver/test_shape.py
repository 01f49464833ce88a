"""Shape functions: consistency, boundaries, convergence, limits, and a slow solution of each point alone."""

from itertools import product
from pathlib import Path

import meshio
import numpy as np
import pytest
import reference
from scipy.spatial import Delaunay, cKDTree

from frit.solver.arrays import Floats
from frit.solver.geometry import Mesh, file_mesh, lattice
from frit.solver.shape import ShapeError, ShapeTable, linear, lme, search_range

ROW, CUBE = np.sqrt(3) / 2, 2 / np.sqrt(3)  # rows of the triangular, edge of the body-centred lattice of spacing 1
PLANE, SPACE = (10.0, 10 * ROW), (5 * CUBE, 4 * CUBE, 4 * CUBE)  # boxes that these lattices fill unstretched
WIDTHS = [(PLANE, 0.8), (PLANE, 1.8), (PLANE, 4.0), (SPACE, 1.2), (SPACE, 1.8), (SPACE, 4.0)]
TOLERANCE = 1e-6


def unit_lattice(size: tuple[float, ...]) -> Mesh:
    return lattice(size, 1.0)


def of_mesh(mesh: Mesh, gamma: float) -> ShapeTable:
    return lme(mesh.points, mesh.spacing, mesh.nodes, gamma, TOLERANCE)


def dense(table: ShapeTable, nodes: Floats) -> tuple[Floats, Floats]:
    return reference.dense(table.offsets, table.nodes, table.entries(), len(nodes))


def random_points(count: int, size: tuple[float, ...], margin: float = 0.0) -> Floats:
    return margin + np.random.default_rng(7).random((count, len(size))) * (np.array(size) - 2 * margin)


def check_consistency(table: ShapeTable, x: Floats, nodes: Floats) -> None:
    """sum N = 1, sum N x_a = x: Newton stops at 1e-13 h. sum grad N = 0, sum grad N (x) x_a = I: here its remainder is
    divided by the spread of N, which is as small as a sliver is flat and its gradients are large: 1e-9 of the largest.
    All sums are about x, where they lose no digits.
    """
    N, dN = table.entries()[0], table.entries()[1:].T
    away = nodes[table.nodes] - np.repeat(x, np.diff(table.offsets), axis=0)

    def total(values: Floats) -> Floats:
        return np.asarray(np.add.reduceat(values, table.offsets[:-1], axis=0))

    assert N.min() >= 0.0  # exponentials; the smallest of a wide range beside a wall underflow
    np.testing.assert_allclose(total(N), 1.0, rtol=0, atol=1e-12)
    with np.errstate(under="ignore"):
        first, second = total(N[:, None] * away), total(dN[:, :, None] * away[:, None, :])
    np.testing.assert_allclose(first, 0.0, atol=1e-12)
    largest = np.maximum.reduceat(np.abs(dN).max(axis=1), table.offsets[:-1])
    scale = np.maximum(1.0, largest)
    np.testing.assert_allclose(total(dN) / scale[:, None], 0.0, atol=1e-9)
    np.testing.assert_allclose((second - np.eye(x.shape[1])) / scale[:, None, None], 0.0, atol=1e-9)


def random_nodes(size: tuple[float, ...], inside: int, seed: int) -> Floats:
    """Nodes anywhere in the box, on its walls and edges, and in its corners."""
    rng, box, free = np.random.default_rng(seed), np.array(size), np.full(len(size), -1.0)
    parts = [rng.random((inside, len(size))) * box]
    for side in product((0.0, 1.0, -1.0), repeat=len(size)):  # -1: anywhere along this axis
        loose = side.count(-1.0)
        if loose < len(size):
            x = rng.random((int(4**loose), len(size)))
            parts.append(np.where(np.array(side) == free, x, side) * box)
    return np.concatenate(parts)


def delaunay(path: Path, nodes: Floats, size: tuple[float, ...]) -> Mesh:
    """The Delaunay mesh of the nodes as frit reads it from a file, without cells of no volume."""
    cells = Delaunay(nodes).simplices
    volume = np.abs(np.linalg.det(nodes[cells[:, 1:]] - nodes[cells[:, :1]]))
    kind = "triangle" if len(size) == 2 else "tetra"
    points = np.pad(nodes, ((0, 0), (0, 3 - len(size))))
    meshio.write(path, meshio.Mesh(points, [(kind, cells[volume > 1e-13])]))
    return file_mesh(path, size)


# --- consistency


@pytest.mark.parametrize(("size", "gamma"), WIDTHS)
def test_consistent_on_the_lattice(size: tuple[float, ...], gamma: float) -> None:
    mesh = unit_lattice(size)
    check_consistency(of_mesh(mesh, gamma), mesh.points, mesh.nodes)


@pytest.mark.parametrize(("size", "gamma"), WIDTHS)
@pytest.mark.parametrize("seed", [0, 1])
def test_consistent_on_random_nodes(tmp_path: Path, size: tuple[float, ...], gamma: float, seed: int) -> None:
    """In space a Delaunay mesh of random nodes is full of slivers: the flattest here has 1e-5 of a usual volume."""
    nodes = random_nodes(size, 100 if len(size) == 2 else 150, seed)
    mesh = delaunay(tmp_path / "random.vtu", nodes, size)
    check_consistency(of_mesh(mesh, gamma), mesh.points, mesh.nodes)


@pytest.mark.parametrize("gamma", [0.8, 1.8, 4.0])
@pytest.mark.parametrize("flat", [1e-2, 1e-4, 1e-6])
def test_consistent_beside_slivers(tmp_path: Path, gamma: float, flat: float) -> None:
    """A node a little off an edge: on one side of it lies a triangle of height `flat`. Once inside, once at the wall,
    where the point comes so near to it that J has an eigenvalue of flat / 3 times the distance of the next row.
    """
    nodes = np.concatenate([unit_lattice(PLANE).nodes, [[4.5, 4 * ROW + flat], [5.5, flat]]])
    mesh = delaunay(tmp_path / "slivers.vtu", nodes, PLANE)
    assert mesh.weights.min() == pytest.approx(flat / 2, rel=1e-3)
    check_consistency(of_mesh(mesh, gamma), mesh.points, mesh.nodes)


@pytest.mark.parametrize("size", [PLANE, SPACE])
def test_linear_functions_are_consistent(tmp_path: Path, size: tuple[float, ...]) -> None:
    mesh = delaunay(tmp_path / "random.vtu", random_nodes(size, 100, 3), size)
    check_consistency(linear(mesh.points, mesh.cells, mesh.nodes), mesh.points, mesh.nodes)


# --- against slow solutions


@pytest.mark.parametrize(("size", "gamma"), WIDTHS)
def test_lme_agrees_with_the_reference(size: tuple[float, ...], gamma: float) -> None:
    """Both solve the same convex problem to 1e-13 or better; the condition of J, below 10 here, comes on top."""
    nodes, x = unit_lattice(size).nodes, random_points(30, size)
    N, dN = dense(lme(x, np.ones(len(x)), nodes, gamma, TOLERANCE), nodes)
    for p, point in enumerate(x):
        slow_N, slow_dN = reference.lme(point, nodes, 1.0, gamma, TOLERANCE)
        np.testing.assert_allclose(N[p], slow_N, rtol=0, atol=1e-12)
        np.testing.assert_allclose(dN[p], slow_dN, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("size", "gamma"), [(PLANE, 1.8), (SPACE, 1.8)])
def test_lme_agrees_with_the_reference_on_random_nodes(tmp_path: Path, size: tuple[float, ...], gamma: float) -> None:
    """The spacing differs from point to point, J may be ill-conditioned: gradients agree relative to the largest."""
    mesh = delaunay(tmp_path / "random.vtu", random_nodes(size, 100, 5), size)
    some = np.random.default_rng(1).choice(len(mesh.points), 30, replace=False)
    N, dN = dense(lme(mesh.points[some], mesh.spacing[some], mesh.nodes, gamma, TOLERANCE), mesh.nodes)
    for row, p in enumerate(some):
        slow_N, slow_dN = reference.lme(mesh.points[p], mesh.nodes, mesh.spacing[p], gamma, TOLERANCE)
        if not np.array_equal(slow_N > 0, N[row] > 0):
            continue  # this point was repaired by a wider range
        np.testing.assert_allclose(N[row], slow_N, rtol=0, atol=1e-11)
        np.testing.assert_allclose(dN[row], slow_dN, rtol=0, atol=1e-10 * np.abs(slow_dN).max())


@pytest.mark.parametrize("size", [PLANE, SPACE])
def test_linear_agrees_with_the_reference(tmp_path: Path, size: tuple[float, ...]) -> None:
    """At points anywhere in their cells. A sliver's inverse is as inexact as its gradients are large."""
    mesh = delaunay(tmp_path / "random.vtu", random_nodes(size, 100, 4), size)
    share = np.random.default_rng(0).dirichlet(np.ones(len(size) + 1), len(mesh.cells))
    x = np.einsum("pa,pad->pd", share, mesh.nodes[mesh.cells])
    table = linear(x, mesh.cells, mesh.nodes)
    entries = table.entries().reshape(1 + len(size), *mesh.cells.shape)
    for p in range(0, len(x), 5):
        N, dN = reference.linear(x[p], mesh.nodes[mesh.cells[p]])
        scale = np.abs(dN).max() * max(size)
        np.testing.assert_allclose(entries[0, p], N, rtol=0, atol=1e-13 * scale)
        np.testing.assert_allclose(entries[0, p], share[p], rtol=0, atol=1e-13 * scale)
        np.testing.assert_allclose(entries[1:, p].T, dN, rtol=0, atol=1e-13 * scale**2)


@pytest.mark.parametrize("gamma", [1.8, 4.0])
@pytest.mark.parametrize("size", [PLANE, SPACE])
def test_shared_rows_are_those_of_each_point_alone(size: tuple[float, ...], gamma: float) -> None:
    """Points of one pattern take the first one's row: here their displacements differ by the rounding of positions,
    1e-15 of the box. An unstretched lattice has two kinds of points in the plane, twelve in space, and others within
    reach of a wall.
    """
    mesh = unit_lattice(size)
    table = of_mesh(mesh, gamma)
    inner = depth(mesh.points, size) > search_range(mesh.spacing, gamma, TOLERANCE)
    assert len(np.unique(table.rows[inner])) <= (2 if len(size) == 2 else 12)
    N, dN = dense(table, mesh.nodes)
    for p in range(0, table.points, 11):
        alone = lme(mesh.points[[p]], mesh.spacing[[p]], mesh.nodes, gamma, TOLERANCE)
        N_p, dN_p = dense(alone, mesh.nodes)
        np.testing.assert_allclose(N[p], N_p[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(dN[p], dN_p[0], rtol=0, atol=1e-12)


def test_rows_start_at_packs_and_are_filled_with_zeros() -> None:
    """Loops run over whole packs of 8 without asking where a row ends."""
    table = of_mesh(unit_lattice(PLANE), 1.8)
    counts = np.diff(table.offsets)
    assert (table.rows % 8 == 0).all()
    assert table.longest == -(-counts.max() // 8) * 8
    for p in range(table.points):
        end = table.rows[p] + counts[p]
        assert not table.table[:, end : -(-end // 8) * 8].any()


# --- gradients


@pytest.mark.parametrize(("size", "gamma"), WIDTHS)
def test_gradients_are_the_slopes_of_the_functions(size: tuple[float, ...], gamma: float) -> None:
    """Four-point differences with step 1e-3 h: 1e-12 h^4 times a fifth derivative of the order of gamma^5, below 1e-8.

    Where a node comes into range within the stencil, N jumps by up to delta_0: such points are left out.
    """
    nodes, x, e = unit_lattice(size).nodes, random_points(25, size, 0.1), 1e-3

    def at(x: Floats) -> tuple[Floats, Floats]:
        return dense(lme(x, np.ones(len(x)), nodes, gamma, TOLERANCE), nodes)

    N, dN = at(x)
    for axis, unit in enumerate(np.eye(len(size))):
        near = [at(x + k * e * unit)[0] for k in (-2, -1, 1, 2)]
        same = np.all([(other > 0) == (N > 0) for other in near], axis=(0, 2))
        slope = (8 * (near[2] - near[1]) - (near[3] - near[0])) / (12 * e)
        assert same.sum() > 10
        np.testing.assert_allclose(dN[same, :, axis], slope[same], rtol=0, atol=1e-8)


# --- range


SHELLS = [
    (2, 0.8, 63, 61), (2, 1.8, 27, 26), (2, 4.0, 12, 12), (2, 6.0, 6, 6),
    (3, 1.2, 208, 175), (3, 1.8, 108, 96), (3, 2.5, 68, 62), (3, 3.0, 56, 52), (3, 4.0, 32, 30),
]  # fmt: skip


@pytest.mark.parametrize(("dim", "gamma", "inside", "sheet"), SHELLS)
def test_nodes_per_point(dim: int, gamma: float, inside: int, sheet: int) -> None:
    """Far from walls: the nodes within h sqrt(-ln(delta_0) / gamma) of the centre of a cell of the infinite lattice.

    The numbers of model.md are means over a small box, whose points at walls see fewer: they are up to 16 % lower.
    """
    cells = range(-8, 9)
    if dim == 2:
        shift, corner = [[0.0, 0.0]], np.array([[0.0, 0.0], [1.0, 0.0], [0.5, ROW]])
        nodes = np.array([[i + j / 2, j * ROW] for i in cells for j in cells])
    else:
        shift = [[0.0, 0.0, 0.0], [0.5, 0.5, 0.5]]
        corner = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 1.5], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]) * CUBE
        nodes = np.concatenate([(np.array(list(product(cells, repeat=3))) + s) * CUBE for s in shift])
    r = search_range(np.ones(1), gamma, TOLERANCE)[0]
    assert r == pytest.approx(np.sqrt(np.log(1e6) / gamma), rel=1e-14)
    assert (np.linalg.norm(nodes - corner.mean(axis=0), axis=1) <= r).sum() == inside
    assert sheet <= inside <= 1.2 * sheet
    if (gamma < 2.0 and dim == 3) or gamma > 5.0:
        return  # the range does not fit into the box, or is too narrow and widened
    size = (12.0, 14 * ROW) if dim == 2 else (6 * CUBE,) * 3
    mesh = unit_lattice(size)
    far = depth(mesh.points, size) > r
    assert far.any()
    assert set(np.diff(of_mesh(mesh, gamma).offsets)[far]) == {inside}


def depth(x: Floats, size: tuple[float, ...]) -> Floats:
    """Distance to the nearest wall."""
    return np.asarray(np.minimum(x, np.array(size) - x).min(axis=1))


# --- boundaries


@pytest.mark.parametrize("size", [PLANE, SPACE])
@pytest.mark.parametrize("height", [1e-2, 1e-4, 1e-6])
def test_nodes_inside_fade_at_the_wall(size: tuple[float, ...], height: float) -> None:
    """The weak Kronecker delta. Consistency across the wall is sum_a N_a y_a = y with all N_a, y_a >= 0: nodes off the
    wall have together at most y / (distance of the next row). With that little taken away, the nodes of the wall have
    the LME functions of the wall alone.
    """
    gamma, nodes, x = 1.8, unit_lattice(size).nodes, random_points(20, size)
    x[:, -1] = height
    N, _ = dense(lme(x, np.ones(len(x)), nodes, gamma, TOLERANCE), nodes)
    wall = nodes[:, -1] == 0.0
    row = nodes[~wall, -1].min()
    assert (N[:, ~wall].sum(axis=1) <= height / row * (1 + 1e-9)).all()
    for p, point in enumerate(x):
        alone, _ = reference.lme(point[:-1], nodes[wall, :-1], 1.0, gamma, TOLERANCE)
        np.testing.assert_allclose(N[p, wall], alone, rtol=0, atol=2 * height / row)


def test_values_on_the_wall_itself_are_those_of_the_wall() -> None:
    """There the multiplier is infinite and Newton ends where N of the nodes inside is round-off."""
    gamma, nodes, x = 1.8, unit_lattice(PLANE).nodes, random_points(20, PLANE)
    x[:, 1] = 0.0
    N, _ = dense(lme(x, np.ones(len(x)), nodes, gamma, TOLERANCE), nodes)
    wall = nodes[:, 1] == 0.0
    assert N[:, ~wall].max() < 1e-13
    for p, point in enumerate(x):
        alone, _ = reference.lme(point[:1], nodes[wall, :1], 1.0, gamma, TOLERANCE)
        np.testing.assert_allclose(N[p, wall], alone, rtol=0, atol=1e-12)


# --- limits


@pytest.mark.parametrize(
    ("box", "spacings", "gamma"),
    [
        *(((3.0, 2.5), (0.2, 0.1, 0.05), gamma) for gamma in (None, 0.8, 1.8, 4.0)),
        *(((2.0, 1.5, 1.8), (0.4, 0.28, 0.2), gamma) for gamma in (None, 4.0)),
        ((2.0, 1.5, 1.8), (0.28, 0.2, 0.14), 1.8),
    ],
)
def test_interpolation_is_of_second_order(
    box: tuple[float, ...], spacings: tuple[float, ...], gamma: float | None
) -> None:
    """L2 error of sin x cos y [cos z] from its exact nodal values; gamma None: linear functions.

    Linear fields are exact, so the error goes as h^2. LME does not interpolate: the width of N adds to the constant.
    Walls, where N is one-sided, and spacings that do not divide the box keep fits of three points within 0.12 of 2.
    """
    errors = []
    for h in spacings:
        mesh = lattice(box, h)
        table = linear(mesh.points, mesh.cells, mesh.nodes) if gamma is None else of_mesh(mesh, gamma)
        exact = [np.sin(x[:, 0]) * np.cos(x[:, 1:]).prod(axis=1) for x in (mesh.nodes, mesh.points)]
        values = np.add.reduceat(table.entries()[0] * exact[0][table.nodes], table.offsets[:-1])
        errors.append(np.sqrt(mesh.weights @ (values - exact[1]) ** 2))
    slope = np.polyfit(np.log(spacings), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.12)


@pytest.mark.parametrize("size", [PLANE, SPACE])
def test_large_gamma_tends_to_linear_functions(size: tuple[float, ...]) -> None:
    """For large gamma the corners of a Delaunay cell share all but exp(-gamma P_d / h^2) prod_a b_a^c_a of each further
    node d: b are the barycentric coordinates of the point, c those of d, and P_d > 0 is the power of d to the cell's
    circumsphere. This is what remains of N_d when the multiplier makes N = b at the corners; the next term is smaller
    by about the sum of these N_d, over the smallest b from which they take.
    """
    mesh = unit_lattice(size)
    cells = mesh.cells[depth(mesh.points, size) > 1.8]
    corners = len(size) + 1
    b = 0.15 + (1 - 0.15 * corners) * np.random.default_rng(2).dirichlet(np.ones(corners), len(cells))
    x = np.einsum("pa,pad->pd", b, mesh.nodes[cells])
    N_linear, dN_linear = dense(linear(x, cells, mesh.nodes), mesh.nodes)
    for gamma in (12.0, 18.0, 24.0):
        N, dN = dense(lme(x, np.ones(len(x)), mesh.nodes, gamma, np.exp(-gamma * 1.9**2)), mesh.nodes)
        for p, cell in enumerate(cells):
            others = np.setdiff1d(np.flatnonzero(N[p]), cell)
            c, power = coordinates_and_power(mesh.nodes[others], mesh.nodes[cell])
            leading = np.exp(-gamma * power + c @ np.log(b[p]))
            near = leading > 1e-3 * leading.max()
            assert power.min() > 0.1
            np.testing.assert_allclose(N[p, others[near]], leading[near], rtol=10 * leading.sum() / b.min() + 1e-9)
            assert np.abs(N[p] - N_linear[p]).max() <= 10 * leading.sum()
            assert np.abs(dN[p] - dN_linear[p]).max() <= 10 * gamma * leading.sum()


def coordinates_and_power(d: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Barycentric coordinates of points in a simplex and their powers |d - centre|^2 - R^2 to its circumsphere."""
    square = np.column_stack([np.ones(len(corners)), corners])
    c = np.linalg.solve(square.T, np.column_stack([np.ones(len(d)), d]).T).T
    return c, (d**2).sum(axis=1) - c @ (corners**2).sum(axis=1)


# --- errors and repair

GOOD = [[100.0, 100.0], [101.0, 100.0], [100.0, 101.0]]  # beyond the widest range of the others
HOPELESS = [
    ([[0.0, 0.0], [1.0, 0.0]], [0.5, 0.0], 2),  # two nodes
    ([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]], [0.7, 0.0], 4),  # all in a line
    ([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [1.0, 1.0], 3),  # outside
    ([], [0.25, 0.5], 0),
]


@pytest.mark.parametrize(("nodes", "point", "count"), HOPELESS)
def test_points_without_enough_nodes_are_refused(nodes: list[list[float]], point: list[float], count: int) -> None:
    """The message names point, gamma, and the nodes within the widest range that is tried, 1.25^8 = 6 times 2.8 nm."""
    message = rf"point 1 \({point[0]:g}, {point[1]:g}\) nm with gamma = 1\.8: {count} nodes within 16\.5 nm"
    with pytest.raises(ShapeError, match=message):
        lme(np.array([[100.3, 100.3], point]), np.ones(2), np.array([*nodes, *GOOD]), 1.8, TOLERANCE)


@pytest.mark.parametrize("size", [PLANE, SPACE])
def test_narrow_functions_are_repaired_by_a_wider_range(tmp_path: Path, size: tuple[float, ...]) -> None:
    """At gamma = 6 a few of the points of random nodes are not surrounded: h grows there, and only there."""
    mesh = delaunay(tmp_path / "random.vtu", random_nodes(size, 100, 2), size)
    table = of_mesh(mesh, 6.0)
    check_consistency(table, mesh.points, mesh.nodes)
    r = search_range(mesh.spacing, 6.0, TOLERANCE)
    counts = np.asarray(cKDTree(mesh.nodes).query_ball_point(mesh.points, r, return_length=True))
    more = np.diff(table.offsets) - counts
    assert more.min() == 0
    assert 0 < np.count_nonzero(more) < 0.1 * len(more)


@pytest.mark.parametrize("p", [0, 3])
def test_a_repaired_point_is_that_of_a_wider_h(p: int) -> None:
    """Its functions are those of h 1.25^k and that range, at the smallest k that will do; others stay as they are."""
    nodes = np.array([[0.0, 0.0], [2.5, 0.0], [0.0, 2.5], [2.5, 2.5], [0.1, 0.0], [0.0, 0.1], [0.1, 0.1]])
    x = np.full((4, 2), 0.05)
    x[p] = [1.0, 1.2]
    N, dN = dense(lme(x, np.ones(4), nodes, 6.0, TOLERANCE), nodes)
    first = next(h for h in 1.25 ** np.arange(1, 9) if surrounded(x[p], nodes, h))
    slow_N, slow_dN = reference.lme(x[p], nodes, first, 6.0, TOLERANCE)
    np.testing.assert_allclose(N[p], slow_N, rtol=0, atol=1e-12)
    np.testing.assert_allclose(dN[p], slow_dN, rtol=0, atol=1e-11)
    slow_N, _ = reference.lme(x[p - 1], nodes, 1.0, 6.0, TOLERANCE)
    np.testing.assert_allclose(N[p - 1], slow_N, rtol=0, atol=1e-12)


def surrounded(x: Floats, nodes: Floats, h: float) -> bool:
    """Whether x is inside the hull of the nodes in range."""
    near = nodes[np.linalg.norm(nodes - x, axis=1) <= search_range(np.array([h]), 6.0, TOLERANCE)]
    return len(near) > 2 and bool(Delaunay(near).find_simplex(x) >= 0)
