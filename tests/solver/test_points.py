"""Points of their own and one width: weights, gaps, what is refused, and functions that exist at every point."""

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.spatial import Delaunay

from frit.solver import field
from frit.solver.arrays import Floats
from frit.solver.case import CaseError, parse_case
from frit.solver.discretisation import shape_table
from frit.solver.geometry import MeshError
from frit.solver.partition import Ranks
from frit.solver.points import largest_gap, regular, remarks
from frit.solver.prepare import build_mesh, prepare
from frit.solver.revision import revision_of
from frit.sweeps.paper import bad_meshes

SIZE = (12.0, 10.0)


def on_file(path: Path, nodes: Floats, cells: Any = None, **tables: Any) -> dict[str, Any]:
    """A disc, or a sphere, on a mesh file of these nodes; cells: Delaunay's where none are given."""
    dim = nodes.shape[1]
    cells = Delaunay(nodes).simplices if cells is None else cells
    kind = "triangle" if dim == 2 else "tetra"
    meshio.Mesh(np.column_stack([nodes, np.zeros((len(nodes), 3 - dim))]), [(kind, cells)]).write(path)
    size = nodes.max(axis=0)
    return {
        "domain": {"size": size.tolist()},
        "nodes": {"source": "file", "path": str(path)},
        "particles": {"centres": [(0.5 * size).tolist()], "radii": [0.25 * float(size.min())]},
        "time": {"end": 1.0},
    } | tables


def grid(size: tuple[float, ...], pitch: float = 1.0) -> Floats:
    axes = [np.linspace(0.0, s, 1 + round(s / pitch)) for s in size]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(size))


@pytest.mark.parametrize("size", [(12.0, 10.0), (3.3, 7.7), (4.0, 5.0, 6.1)])
def test_points_fill_the_box(size: tuple[float, ...]) -> None:
    """Equal bricks: volume and first moments are those of the box to round-off, walls included."""
    points, weights = regular(size, 0.61)
    assert weights.sum() == pytest.approx(np.prod(size), rel=1e-14)
    np.testing.assert_allclose(weights @ points, np.prod(size) * np.array(size) / 2, rtol=1e-13)
    assert len(np.unique(points.round(9), axis=0)) == len(points)
    assert (points > 0.15).all()
    assert (points < np.array(size) - 0.15).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_largest_gap_is_found(dim: int) -> None:
    """In the middle of a square or cube of nodes; and where a node is taken away."""
    size = (12.0, 10.0, 8.0)[:dim]
    gap, _ = largest_gap(grid(size), size)
    assert gap == pytest.approx(0.5 * np.sqrt(dim), abs=0.03)
    nodes = grid(size)
    hole = np.array([5.0, 4.0, 3.0])[:dim]
    gap, middle = largest_gap(nodes[np.linalg.norm(nodes - hole, axis=1) > 0.5], size)
    assert gap == pytest.approx(1.0, abs=0.04)
    np.testing.assert_allclose(middle, hole, atol=0.3)


def test_one_width_by_the_largest_gap(tmp_path: Path, ranks: Ranks) -> None:
    """A spacing where nodes are even; no more than the interface bears where they are not."""
    even = build_mesh(parse_case(on_file(tmp_path / "even.vtk", grid(SIZE, 0.5))), ranks)
    assert 0.5 <= even.width <= 0.6
    nodes = grid(SIZE, 0.5)
    sparse = nodes[(np.linalg.norm(nodes - (6.0, 5.0), axis=1) > 0.9) | (nodes == 0).any(axis=1)]
    holed = build_mesh(parse_case(on_file(tmp_path / "holed.vtk", sparse)), ranks)
    assert holed.width == pytest.approx(1.3)
    assert (holed.points.shape, holed.in_cells) == ((len(holed.points), 2), False)
    assert holed.weights.sum() == pytest.approx(120.0, rel=1e-14)


def test_what_the_keys_mean(tmp_path: Path, ranks: Ranks) -> None:
    tree = on_file(tmp_path / "a.vtk", grid(SIZE))
    cells = build_mesh(parse_case(tree | {"points": {"source": "cells"}}), ranks)
    np.testing.assert_allclose(cells.points, cells.nodes[cells.cells].mean(axis=1), rtol=1e-13)
    asked = {"points": {"pitch": 0.4}, "shape_functions": {"width": 1.1}}
    mesh = build_mesh(parse_case(tree | asked), ranks)
    assert (len(mesh.points), mesh.width) == (2 * 21 * 18, 1.1)
    linear = build_mesh(parse_case(tree | {"shape_functions": {"kind": "linear"}}), ranks)
    np.testing.assert_array_equal(linear.points, cells.points)
    lattice = tree | {"nodes": {"source": "triangular", "spacing": 1.0}, "shape_functions": {"width": 1.2}}
    assert build_mesh(parse_case(lattice), ranks).width == 1.2
    scheme, _ = prepare(parse_case(lattice), build_mesh(parse_case(lattice), ranks), ranks)
    assert scheme.d.blocks.points.size > 0


def test_what_is_too_narrow_or_too_wide_is_told_with_place_and_remedy(tmp_path: Path, ranks: Ranks) -> None:
    nodes = grid(SIZE, 0.5)
    sparse = nodes[np.linalg.norm(nodes - (6.0, 5.0), axis=1) > 1.9]
    tree = on_file(tmp_path / "holed.vtk", sparse)
    narrow = r"width = 0\.6: too narrow for the gap around \([56].*, [45].*\) nm, .* at least 1\.\d+ is needed"
    with pytest.raises(MeshError, match=narrow):
        build_mesh(parse_case(tree | {"shape_functions": {"width": 0.6}}), ranks)
    coarse = tree | {"points": {"pitch": 2.5}, "shape_functions": {"width": 2.0}}
    with pytest.raises(MeshError, match=r"points.pitch = 2\.5: must be at most the width of the shape functions, 2$"):
        build_mesh(parse_case(coarse), ranks)
    wide = parse_case(tree | {"shape_functions": {"width": 2.5}})
    (remark,) = remarks(wide, build_mesh(wide, ranks))
    assert "2.5 nm wide, the interface 2 nm (2 particles.interface_width)" in remark
    assert "the largest gap is around (" in remark
    fine = parse_case(tree)
    assert remarks(fine, build_mesh(fine, ranks)) == []


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        ({"points": {"pitch": 0.5}}, "points.pitch = 0.5: must be left out: built-in nodes"),
        ({"points": {"source": "cells", "pitch": 0.5}}, "points.pitch = 0.5: does not belong to source = 'cells'"),
        ({"points": {"pitch": 1e-5}, "nodes": {"source": "gmsh", "spacing": 1}}, "points.pitch = 1e-05: must be at"),
        ({"points": {"source": "grid"}}, "points.source = 'grid': must be 'lattice' or 'cells'"),
    ],
)
def test_what_makes_no_sense_is_refused(tables: dict[str, Any], key: str) -> None:
    particle = {"centres": [[6.0, 5.0]], "radii": [2.5]}
    nodes = {"source": "triangular", "spacing": 1.0}
    tree = {"domain": {"size": [12.0, 10.0]}, "nodes": nodes, "particles": particle, "time": {"end": 1.0}}
    with pytest.raises(CaseError) as refusal:
        parse_case(tree | tables)
    assert key in str(refusal.value)


def test_nodes_in_one_place_are_one_node(tmp_path: Path, ranks: Ranks) -> None:
    """And flat cells do no harm, where they do not integrate; the paper's way refuses both."""
    nodes = grid(SIZE)
    cells = Delaunay(nodes).simplices
    twice = np.concatenate([nodes, nodes[20:30]])
    flat = np.column_stack([np.arange(20, 30), np.arange(len(nodes), len(twice)), cells[:10, 0]])
    tree = on_file(tmp_path / "twice.vtk", twice, np.concatenate([cells, flat]))
    mesh = build_mesh(parse_case(tree), ranks)
    np.testing.assert_allclose(np.unique(mesh.nodes, axis=0), np.unique(nodes, axis=0), atol=0)
    for tables in ({"points": {"source": "cells"}}, {"shape_functions": {"kind": "linear"}}):
        with pytest.raises(MeshError, match="has no volume"):
            build_mesh(parse_case(tree | tables), ranks)


@pytest.mark.parametrize("kind", bad_meshes.KINDS)
def test_functions_exist_at_every_point_of_bad_meshes(kind: str, tmp_path: Path, ranks: Ranks) -> None:
    """Walls and corners included: sum N = 1 and sum N x_a = x to 1e-12 of a width, and none is negative."""
    case = parse_case(bad_meshes.case(bad_meshes.write(kind, tmp_path / f"{kind}.vtk"), 1.0))
    mesh = build_mesh(case, ranks)
    table = shape_table(case, mesh, np.arange(len(mesh.points)))
    shares = table.entries()[0]
    assert shares.min() >= 0.0
    ones = np.add.reduceat(shares, table.offsets[:-1])
    np.testing.assert_allclose(ones, 1.0, rtol=0, atol=1e-12)
    back = np.add.reduceat(shares[:, None] * mesh.nodes[table.nodes], table.offsets[:-1], axis=0)
    np.testing.assert_allclose(back, mesh.points, rtol=0, atol=2e-12)


def test_functions_exist_in_space(tmp_path: Path, ranks: Ranks) -> None:
    """Random nodes between even ones on the walls; fields are linear where coefficients are, to the walls."""
    size = (6.0, 5.0, 7.0)
    nodes = grid(size)
    inside = ((nodes > 0) & (nodes < size)).all(axis=1)
    nodes[inside] = np.random.default_rng(2).uniform(0.0, size, (int(inside.sum()), 3))
    case = parse_case(on_file(tmp_path / "random.vtk", nodes))
    mesh = build_mesh(case, ranks)
    slope = np.array([0.3, -0.2, 0.5])
    x = np.concatenate([mesh.nodes, np.random.default_rng(3).uniform(0.0, size, (200, 3))])
    got = field.at(case, mesh, x, (mesh.nodes @ slope)[:, None])[:, 0]
    np.testing.assert_allclose(got, x @ slope, rtol=0, atol=1e-10)


def test_keys_of_their_own_count_only_where_they_say_something() -> None:
    """See test_revision.py, too: what knew no points had these identities already."""
    discs: dict[str, Any] = {
        "domain": {"size": [100.0, 60.0]},
        "nodes": {"source": "gmsh", "spacing": 1.0},
        "particles": {"centres": [[30.0, 30.0], [70.0, 30.0]], "radii": [20.0, 20.0]},
        "time": {"end": 10.0},
    }
    told: list[dict[str, Any]] = [
        {"points": {"source": "lattice"}}, {"points": {"source": "cells"}}, {"points": {"pitch": 0.5}},
        {"shape_functions": {"width": 1.0}},
    ]  # fmt: skip
    plain = parse_case(discs).identity()
    assert plain[:16] == "4e8908627ed72dcd"
    assert [parse_case(discs | tables).identity() == plain for tables in told] == [True, False, False, False]


@pytest.mark.parametrize(
    ("tables", "revision"),
    [
        ({"nodes": {"source": "lattice", "spacing": 1.0}}, 4),
        ({"nodes": {"source": "triangular", "spacing": 1.0}}, 1),
        ({"nodes": {"source": "gmsh", "spacing": 1.0}}, 2),
        ({"nodes": {"source": "gmsh", "spacing": 1.0}, "shape_functions": {"kind": "linear"}}, 1),
    ],
)
def test_free_nodes_have_another_revision(tables: dict[str, Any], revision: int) -> None:
    discs: dict[str, Any] = {
        "domain": {"size": [100.0, 60.0]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {"centres": [[30.0, 30.0], [70.0, 30.0]], "radii": [20.0, 20.0]},
        "time": {"end": 10.0},
    }
    assert revision_of(parse_case(discs | tables).tree()) == revision
