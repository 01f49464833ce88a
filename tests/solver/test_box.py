"""The quadrature of a box: polynomials, profiles that its faces cut, and weights that stay sane."""

import os
from collections.abc import Callable, Iterator
from importlib import import_module
from itertools import product
from pathlib import Path

import meshio
import numpy as np
import pytest
from boxes import boxes as ordinary_boxes
from launching import Case, columns, solve
from reference import mean_in_box
from scipy.spatial import Delaunay

from frit.solver.arrays import Floats
from frit.solver.box import box_weights
from frit.solver.geometry import Mesh, file_mesh, gmsh_mesh, lattice
from frit.solver.partition import Ranks

SMALL = {2: (11.0, 9.0), 3: (7.0, 6.5, 6.0)}
SIZES = {2: (30.0, 26.0), 3: (16.0, 15.0, 14.0)}
RADIUS = {2: 9.0, 3: 5.0}


def profile(x: Floats, centre: Floats, radius: float) -> Floats:
    """(34) with xi = 1 nm."""
    return np.asarray(0.5 * (1.0 - np.tanh(np.linalg.norm(x - centre, axis=-1) - radius)))


def polynomial(degree: int, size: tuple[float, ...], seed: int) -> Callable[[Floats], Floats]:
    """With all its monomials, of a size near 1 in the domain."""
    powers = [e for e in product(range(degree + 1), repeat=len(size)) if sum(e) <= degree]
    factors = np.random.default_rng(seed).uniform(-1.0, 1.0, len(powers))

    def value(x: Floats) -> Floats:
        y = x / np.array(size)
        return np.asarray(sum(f * np.prod(y**e, axis=-1) for f, e in zip(factors, powers, strict=True)))

    return value


def shaken(directory: Path, size: tuple[float, ...], spacing: float, amount: float, seed: int = 1) -> Mesh:
    """The Delaunay mesh of a lattice whose nodes were moved by up to `amount` spacings along each axis, walls in place.

    In space it is full of slivers; in the plane one is put in: a node 1e-4 off an edge.
    """
    box, regular = np.array(size), lattice(size, spacing)
    steps = np.random.default_rng(seed).uniform(-amount, amount, regular.nodes.shape) * spacing
    free = (regular.nodes > 0.0) & (regular.nodes < box)
    nodes = np.clip(np.where(free, regular.nodes + steps, regular.nodes), 0.0, box)
    if len(size) == 2:
        a, b = nodes[regular.cells[len(regular.cells) // 2, :2]]
        nodes = np.concatenate([nodes, [0.5 * (a + b) + 1e-4 * spacing * np.array([b[1] - a[1], a[0] - b[0]])]])
    cells = Delaunay(nodes).simplices
    volumes = np.abs(np.linalg.det(nodes[cells[:, 1:]] - nodes[cells[:, :1]]))
    path = directory / f"{spacing}-{amount}.vtu"
    kind = "triangle" if len(size) == 2 else "tetra"
    points = np.pad(nodes, ((0, 0), (0, 3 - len(size))))
    meshio.write(path, meshio.Mesh(points, [(kind, cells[volumes > 1e-12])]))
    return file_mesh(path, size)


def boxes(size: tuple[float, ...]) -> Iterator[tuple[Floats, Floats]]:
    """The domain, on nodes, through cells, thinner than a cell, within one cell, along walls, in a corner."""
    full = np.array(size)
    yield from ordinary_boxes(size)
    yield full - 0.3, full


def error(mesh: Mesh, low: Floats, high: Floats, field: Callable[[Floats], Floats], regular: bool) -> float:
    """Of the mean over the box."""
    mean = box_weights(mesh, low, high, regular, Ranks()) @ field(mesh.nodes) / np.prod(high - low)
    return float(abs(mean - mean_in_box(field, low, high, {2: 160, 3: 72}[len(low)])))


def worst_of(mesh: Mesh, size: tuple[float, ...], regular: bool, boxes: int) -> float:
    """The largest error for particles cut by boxes, both put at random."""
    random, box, dim, found = np.random.default_rng(3), np.array(size), len(size), []
    for _ in range(boxes):
        centre, radius = box * random.uniform(0.4, 0.6, dim), RADIUS[dim] * random.uniform(0.7, 1.2)
        low, high = box * random.uniform(0.05, 0.3, dim), box * random.uniform(0.6, 0.95, dim)
        found.append(error(mesh, low, high, lambda x: profile(x, centre, radius), regular))  # noqa: B023
    return max(found)


# --- polynomials


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["lattice", "shaken", "wild"])
def test_cubics_are_integrated_exactly(tmp_path: Path, dim: int, kind: str) -> None:
    """Round-off, in spite of slivers, walls and boxes of any size; nor do weights of both signs grow without bounds."""
    size, amounts = SMALL[dim], {"shaken": 0.2, "wild": 0.45}
    mesh = lattice(size, 1.0) if kind == "lattice" else shaken(tmp_path, size, 1.0, amounts[kind])
    cubic = polynomial(3, size, seed=dim)
    for low, high in boxes(size):
        weights = box_weights(mesh, low, high, kind == "lattice", Ranks()) / np.prod(high - low)
        assert weights.sum() == pytest.approx(1.0, abs=1e-10)
        assert weights @ cubic(mesh.nodes) == pytest.approx(mean_in_box(cubic, low, high, 2), abs=1e-10)
        assert np.abs(weights).sum() < 6.0  # in a corner of the domain; else below 2


def test_a_quartic_is_not() -> None:
    """The test above can fail."""
    low, high = np.array([2.2, 2.4]), np.array([6.7, 7.9])
    assert error(lattice(SMALL[2], 1.0), low, high, polynomial(4, SMALL[2], seed=0), True) > 1e-7


@pytest.mark.parametrize(("height", "degree"), [(0.9, 1), (1.8, 2), (2.7, 3)])
def test_few_rows_of_nodes_give_the_degree_that_they_determine(height: float, degree: int) -> None:
    """Two rows determine no parabola across, three no cubic."""
    size = (12.0, height)
    mesh, low, high = lattice(size, 1.0), np.array([2.3, 0.1]), np.array([8.8, 0.7 * height])
    assert len(np.unique(mesh.nodes[:, 1])) == degree + 1
    assert error(mesh, low, high, polynomial(degree, size, seed=1), True) < 1e-11


def test_a_single_cell_integrates_linear_fields() -> None:
    nodes = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    cells = np.arange(3, dtype=np.int32)[None]
    mesh = Mesh(nodes, cells, nodes.mean(axis=0)[None], np.array([8.0]), np.array([4.0]), 4.0, True)
    low, high = np.array([0.5, 0.7]), np.array([1.5, 1.2])
    assert error(mesh, low, high, polynomial(1, (4.0, 4.0), seed=1), False) < 1e-13


# --- lattices


@pytest.mark.parametrize("size", [(40.0, 31.0), (17.0, 16.0, 16.5)])
def test_deep_in_a_lattice_weights_are_the_nodes_volumes(size: tuple[float, ...]) -> None:
    """What is not computed there is what would be computed. At the walls and away from them."""
    mesh, full = lattice(size, 1.0), np.array(size)
    for low, high in ((0.0 * full, full), (0.02 * full, 0.97 * full), (0.11 * full, 0.93 * full)):
        short, whole = (box_weights(mesh, low, high, regular, Ranks()) for regular in (True, False))
        np.testing.assert_allclose(short, whole, rtol=0.0, atol=1e-12)
        middle = np.argmin(np.linalg.norm(mesh.nodes - 0.5 * full, axis=1))
        around = (mesh.cells == middle).any(axis=1)
        assert whole[middle] == pytest.approx(mesh.weights[around].sum() / (len(size) + 1), rel=1e-11)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_ten_thousandth_wherever_the_box_lies(dim: int) -> None:
    """At h = xi, the coarsest that makes sense, for boxes that are not aligned with the lattice."""
    assert worst_of(lattice(SIZES[dim], 1.0), SIZES[dim], True, {2: 20, 3: 8}[dim]) < 1e-4


@pytest.mark.parametrize("dim", [2, 3])
def test_boxes_at_the_walls(dim: int) -> None:
    """Fits are one-sided there; the particle is cut by the faces inside."""
    full = np.array(SIZES[dim])
    mesh = lattice(SIZES[dim], 1.0)
    for low, high in ((0.0 * full, 0.57 * full), (0.43 * full, full), (0.0 * full, np.r_[full[:-1], 0.6 * full[-1]])):
        assert error(mesh, low, high, lambda x: profile(x, 0.5 * full + 0.1, RADIUS[dim]), True) < 1e-4


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_of_a_few_cells(dim: int) -> None:
    """The interface fills it: 1e-4 of its own small volume cannot be had, a thousandth can at half the spacing."""
    full = np.array(SIZES[dim])
    mesh, low = lattice(SIZES[dim], 0.5), 0.5 * full + RADIUS[dim] / np.sqrt(dim) - 0.7
    assert error(mesh, low, low + 1.4, lambda x: profile(x, 0.5 * full, RADIUS[dim]), True) < 1e-3


# --- other meshes


@pytest.mark.parametrize(("dim", "spacing", "bound"), [(2, 1.0, 1e-4), (2, 0.5, 1e-5), (3, 1.0, 5e-4), (3, 0.5, 5e-5)])
def test_gmsh_meshes(dim: int, spacing: float, bound: float) -> None:
    """In space a gmsh mesh has half the nodes of a lattice of the same spacing, so at h = xi it does not reach 1e-4."""
    try:
        import_module("gmsh")
    except (ImportError, OSError) as missing:
        if os.environ.get("FRIT_REQUIRE_ALL") == "1":
            raise
        pytest.skip(str(missing))
    size = SIZES[2] if dim == 2 else (14.0, 13.0, 12.0)
    assert worst_of(gmsh_mesh(size, spacing), size, False, {2: 12, 3: 4}[dim]) < bound


@pytest.mark.parametrize(("dim", "spacing", "bound"), [(2, 1.0, 1e-3), (2, 0.5, 1e-4), (3, 1.0, 1e-3), (3, 0.5, 1e-4)])
def test_meshes_with_slivers_and_gaps(tmp_path: Path, dim: int, spacing: float, bound: float) -> None:
    """Gaps of up to 1.9 h count as a spacing of that size: 1.9^4 = 13 times the lattice's error of 7e-5 at h = xi."""
    size = SIZES[2] if dim == 2 else (13.0, 12.0, 12.0)
    assert worst_of(shaken(tmp_path, size, spacing, 0.45), size, False, {2: 12, 3: 4}[dim]) < bound


# --- ranks


@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_any_number_of_ranks_measures_the_same(tmp_path: Path, dim: int) -> None:
    """A particle that the box cuts: to 1e-4 of the truth on 1, 2 and 3 ranks, and to round-off of each other."""
    size, radius = SIZES[dim], RADIUS[dim]
    low, high, centre = 0.21 * np.array(size), 0.77 * np.array(size), 0.5 * np.array(size) + 0.13
    case: Case = {
        "domain": {"size": list(size)},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "shape_functions": {"kind": "linear"},  # the quickest: the weights know nothing of shape functions
        "particles": {"centres": [centre.tolist()], "radii": [radius]},
        "time": {"integrator": "rk2", "end": 2e-4, "step": 1e-4},
        "output": {"vacancy_box": [low.tolist(), high.tolist()]},
    }
    found = [columns(solve(case, tmp_path / str(ranks), ranks))["vacancy_ratio"] for ranks in (1, 2, 3)]
    exact = 1.0 - mean_in_box(lambda x: profile(x, centre, radius), low, high, {2: 160, 3: 72}[dim])
    for ratio in found:
        assert ratio[0] == pytest.approx(exact, abs=1e-4)
        np.testing.assert_allclose(ratio, found[0], rtol=0.0, atol=1e-12)
