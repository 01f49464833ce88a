"""Meshes: the lattices against crystallography and topology, files and gmsh against what went into them."""

import signal
import threading
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.spatial import cKDTree

from frit.solver import geometry
from frit.solver.arrays import Floats, Integers, Numbers
from frit.solver.geometry import (
    Mesh,
    MeshError,
    file_mesh,
    gmsh_mesh,
    lattice,
    make_mesh,
    started,
)

INSTALL = "apt-get install libglu1-mesa libgl1 libxrender1 libxcursor1 libxft2 libxinerama1 libgomp1"
A = 2 / np.sqrt(3)  # cube edge of the body-centred lattice with nearest neighbours at distance 1
ROW = np.sqrt(3) / 2  # distance of the rows of the triangular lattice
SIZES = [(5.2, 4.0), (1.0, 0.2), (0.3, 7.0), (4.0, 5.0, 3.3), (0.2, 3.0, 1.5), (1.0, 1.0, 1.0)]


def edge_lengths(mesh: Mesh) -> Floats:
    """(p, edges) in increasing order."""
    x = mesh.nodes[mesh.cells]
    pairs = combinations(range(mesh.cells.shape[1]), 2)
    return np.sort(np.stack([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in pairs], axis=1), axis=1)


def facets(mesh: Mesh) -> tuple[Numbers, Integers]:
    """The facets' sorted nodes and the number of cells that share each."""
    corners = mesh.cells.shape[1]
    sides = [np.delete(mesh.cells, i, axis=1) for i in range(corners)]
    unique, counts = np.unique(np.sort(np.concatenate(sides), axis=1), axis=0, return_counts=True)
    return unique, counts


def check_mesh(mesh: Mesh, size: tuple[float, ...], wall: float) -> None:
    """What every mesh of the box must satisfy; its walls flat to `wall`."""
    dim, box = len(size), np.array(size)
    edges = mesh.nodes[mesh.cells[:, 1:]] - mesh.nodes[mesh.cells[:, :1]]
    signed = np.linalg.det(edges) / (2 if dim == 2 else 6)
    assert signed.min() > 0
    np.testing.assert_allclose(mesh.weights, signed, rtol=1e-9)
    np.testing.assert_allclose(mesh.points, mesh.nodes[mesh.cells].mean(axis=1), rtol=1e-13)
    assert mesh.weights.sum() == pytest.approx(np.prod(box), rel=1e-13)
    np.testing.assert_allclose(mesh.weights @ mesh.points, np.prod(box) * box / 2, rtol=1e-12)
    # Conforming: a facet has two cells, or has one and lies on a wall; such facets add up to the walls' area.
    nodes, shared = facets(mesh)
    assert shared.max() <= 2
    x = mesh.nodes[nodes[shared == 1]]
    on_wall = (abs(x) <= wall).all(axis=1) | (abs(x - box) <= wall).all(axis=1)
    assert on_wall.any(axis=1).all()
    spans = x[:, 1:] - x[:, :1]
    normals = spans[:, 0] if dim == 2 else np.cross(spans[:, 0], spans[:, 1]) / 2
    surface = 2 * sum(np.prod(np.delete(box, i)) for i in range(dim))
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(surface, rel=1e-12)
    # Numbered without gaps, types as the kernels expect them.
    assert (np.unique(mesh.cells) == np.arange(len(mesh.nodes))).all()
    assert mesh.cells.dtype == np.int32
    arrays = (mesh.nodes, mesh.cells, mesh.points, mesh.weights, mesh.spacing)
    assert all(array.flags.c_contiguous for array in arrays)
    assert len(mesh.spacing) == len(mesh.weights) == len(mesh.points) == len(mesh.cells)


@pytest.mark.parametrize("size", SIZES)
def test_a_lattice_is_a_conforming_mesh_of_the_box_with_straight_walls(size: tuple[float, ...]) -> None:
    mesh = lattice(size, 0.5)
    check_mesh(mesh, size, wall=0.0)
    assert (mesh.spacing == 0.5).all()


@pytest.mark.parametrize(
    ("size", "nodes", "cells"),
    [
        ((1.0, ROW), 2 + 3, 3),
        ((4.0, 3 * ROW), 2 * 5 + 2 * 6, 3 * 9),
        ((4.0, 4 * ROW), 3 * 5 + 2 * 6, 4 * 9),
        ((A, A, A), 8 + 1 + 6, 24),
        ((2 * A, 3 * A, A), 24 + 6 + 2 * (6 + 3 + 2), 4 * (3 * 3 + 2 * 4 + 6 * 2)),
    ],
)
def test_counts_of_small_lattices(size: tuple[float, ...], nodes: int, cells: int) -> None:
    mesh = lattice(size, 1.0)
    assert (len(mesh.nodes), len(mesh.cells)) == (nodes, cells)


def test_triangles_are_equilateral_and_halved_at_the_walls() -> None:
    mesh = lattice((6.0, 7 * ROW), 1.0)
    half = mesh.weights < 0.9 * ROW / 2
    assert np.count_nonzero(half) == 2 * 7
    np.testing.assert_allclose(edge_lengths(mesh)[~half], 1.0, rtol=1e-13)
    right = np.broadcast_to([0.5, ROW, 1.0], (2 * 7, 3))
    np.testing.assert_allclose(edge_lengths(mesh)[half], right, rtol=1e-13)


def test_tetrahedra_are_congruent_and_halved_at_the_walls() -> None:
    """Edges: centre to centre and cube edge a, four of length h; 12 of them make a cube."""
    mesh = lattice((4 * A, 3 * A, 5 * A), 1.0)
    half = mesh.weights < 0.9 * A**3 / 12
    assert np.count_nonzero(half) == 4 * 2 * (12 + 15 + 20)
    np.testing.assert_allclose(edge_lengths(mesh)[~half][:, :4], 1.0, rtol=1e-13)
    np.testing.assert_allclose(edge_lengths(mesh)[~half][:, 4:], A, rtol=1e-13)
    np.testing.assert_allclose(mesh.weights[~half], A**3 / 12, rtol=1e-12)
    np.testing.assert_allclose(mesh.weights[half], A**3 / 24, rtol=1e-12)


@pytest.mark.parametrize(("size", "neighbours"), [((8.0, 9 * ROW), 6), ((5 * A, 6 * A, 5 * A), 8)])
def test_inner_nodes_have_equal_distances(size: tuple[float, ...], neighbours: int) -> None:
    mesh = lattice(size, 1.0)
    inner = ((mesh.nodes > 1.3) & (mesh.nodes < np.array(size) - 1.3)).all(axis=1)
    distances = np.asarray(cKDTree(mesh.nodes).query(mesh.nodes[inner], neighbours + 2)[0])
    np.testing.assert_allclose(distances[:, 1:-1], 1.0, rtol=1e-13)
    assert distances[:, -1].min() > 1.1


@pytest.mark.parametrize(("dim", "limit"), [(2, 2.0), (3, 6.0)])
def test_points_per_node_tend_to_two_and_six(dim: int, limit: float) -> None:
    """What is missing is the walls' share: it halves with the spacing, up to terms of h^2."""
    missing = []
    for h in (1 / 16, 1 / 32):
        mesh = lattice((1.0,) * dim, h)
        missing.append(limit - len(mesh.cells) / len(mesh.nodes))
    assert 0 < missing[1] < 0.15 * limit
    assert missing[0] / missing[1] == pytest.approx(2.0, abs=0.25)


@pytest.mark.parametrize("size", [(10.4, 7.3), (6.3, 5.5, 7.1)])
def test_the_lattice_is_stretched_by_at_most_half_a_cell(size: tuple[float, ...]) -> None:
    mesh = lattice(size, 1.0)
    for axis, length in enumerate(size):
        step = {(2, 0): 1.0, (2, 1): ROW}.get((len(size), axis), A)
        layers = len(np.unique(mesh.nodes[:, axis])) - 1
        cells = layers if (len(size), axis) == (2, 1) else layers / 2  # rows, or ends and centres
        assert abs(cells * step - length) <= step / 2


@pytest.mark.parametrize("size", [(60.0, 50.0), (14.0, 14.0, 14.0)])
def test_numbering_keeps_neighbours_together(size: tuple[float, ...]) -> None:
    mesh = lattice(size, 1.0)
    shuffled = np.random.default_rng(0).permutation(len(mesh.nodes)).astype(np.int32)[mesh.cells]
    assert np.ptp(mesh.cells, axis=1).mean() < 0.25 * np.ptp(shuffled, axis=1).mean()
    step = np.linalg.norm(np.diff(mesh.points, axis=0), axis=1)
    assert step.mean() < 1.5  # from one point to the next, in units of the spacing


def morton(x: list[float], bits: int) -> int:
    """Interleave the bits of coordinates in [0, 1] one by one."""
    steps = [int(c * (2**bits - 1)) for c in x]
    return sum((q >> b & 1) << (b * len(x) + axis) for axis, q in enumerate(steps) for b in range(bits))


@pytest.mark.parametrize(("dim", "bits"), [(2, 31), (3, 21)])
def test_nodes_and_points_follow_mortons_curve(dim: int, bits: int) -> None:
    mesh = lattice((1.0,) * dim, 0.13, rows=False)
    for x in (mesh.nodes, mesh.points):
        codes = [morton(row, bits) for row in x.tolist()]
        assert codes == sorted(codes)


@pytest.mark.parametrize("size", [(7.0, 5.0), (7.0, 5.0, 4.0)])
def test_the_nodes_of_a_lattice_are_numbered_by_rows_along_x(size: tuple[float, ...]) -> None:
    """The same mesh as along the curve: only the numbers of the nodes differ."""
    mesh, curve = lattice(size, 0.7), lattice(size, 0.7, rows=False)
    backwards = [tuple(reversed(x)) for x in mesh.nodes.tolist()]
    assert backwards == sorted(backwards)
    np.testing.assert_array_equal(mesh.nodes[mesh.cells], curve.nodes[curve.cells])
    np.testing.assert_array_equal(mesh.points, curve.points)


@pytest.mark.parametrize(
    ("size", "spacing", "message"),
    [
        ((5.0,), 1.0, "two or three"),
        ((5.0, -1.0), 1.0, r"size \(5.0, -1.0\)"),
        ((5.0, float("nan")), 1.0, "nan"),
        ((5.0, 5.0), 0.0, "spacing 0.0"),
        ((5.0, 5.0), float("inf"), "spacing inf"),
        ((1e4, 1e4, 1e4), 0.1, "32-bit"),
    ],
)
def test_impossible_lattices_are_refused(size: tuple[float, ...], spacing: float, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        lattice(size, spacing)


def write(path: Path, nodes: Any, **cells: Any) -> Path:
    """A mesh file; nodes of two coordinates get a third zero one, as most 2-D meshes have it."""
    points = np.array(nodes, dtype=float)
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    mesh = meshio.Mesh(points, [(kind, np.array(c)) for kind, c in cells.items()])
    meshio.write(path, mesh, file_format="gmsh22" if path.suffix == ".msh" else None)
    return path


SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]
HALVES = [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
@pytest.mark.parametrize(("size", "kind"), [((5.2, 4.0), "triangle"), ((4.0, 3.0, 3.3), "tetra")])
def test_a_file_gives_back_the_mesh_whatever_its_numbering(
    tmp_path: Path, size: tuple[float, ...], kind: str, suffix: str
) -> None:
    mesh, rng = lattice(size, 1.0, rows=False), np.random.default_rng(5)
    # Renumber nodes, shuffle cells, turn half of them inside out, add a node without cell and other cells.
    number = rng.permutation(len(mesh.nodes))
    nodes = np.full((len(number) + 1, len(size)), 77.0)
    nodes[number] = mesh.nodes
    cells = number[rng.permutation(mesh.cells)]
    cells[::2, :2] = cells[::2, 1::-1]
    path = write(tmp_path / f"mesh{suffix}", nodes, **{kind: cells}, line=[[0, 1]], vertex=[[2]])
    again = file_mesh(path, size)
    check_mesh(again, size, wall=0.0)
    np.testing.assert_array_equal(again.nodes, mesh.nodes)
    np.testing.assert_array_equal(np.sort(again.cells, axis=1), np.sort(mesh.cells, axis=1))


def test_the_spacing_of_a_file_is_the_distance_of_its_nodes(tmp_path: Path) -> None:
    for size, kind in (((9.0, 9 * ROW), "triangle"), ((6 * A, 6 * A, 6 * A), "tetra")):
        mesh = lattice(size, 1.0)
        read = file_mesh(write(tmp_path / "mesh.vtu", mesh.nodes, **{kind: mesh.cells}), size)
        inner = ((mesh.points > 2.5) & (mesh.points < np.array(size) - 2.5)).all(axis=1)
        np.testing.assert_allclose(read.spacing[inner], 1.0, rtol=1e-12)
        assert read.spacing.min() > 0.8
        assert read.spacing.max() < 1.4


def test_the_spacing_of_two_triangles(tmp_path: Path) -> None:
    """Every node of the unit square has the others at 1, 1 and sqrt 2."""
    mesh = file_mesh(write(tmp_path / "square.vtu", SQUARE, triangle=HALVES), (1.0, 1.0))
    np.testing.assert_allclose(mesh.spacing, (2 + np.sqrt(2)) / 3, rtol=1e-14)


def test_slivers_are_kept(tmp_path: Path) -> None:
    nodes = [*SQUARE, [0.5, 1e-9]]
    fan = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    mesh = file_mesh(write(tmp_path / "sliver.vtu", nodes, triangle=fan), (1.0, 1.0))
    check_mesh(mesh, (1.0, 1.0), wall=0.0)
    assert mesh.weights.min() == pytest.approx(5e-10, rel=1e-6)


@pytest.mark.parametrize(
    ("nodes", "cells", "message"),
    [
        (SQUARE, {"quad": [[0, 1, 2, 3]], "line": [[0, 1], [1, 2]]}, "no triangle cells.*1 quad, 2 line"),
        ([*SQUARE, [0.2, 0.2]], {"triangle": [*HALVES, [0, 4, 2]]}, r"triangle 2 has no volume: nodes \[0 4"),
        ([*SQUARE, [1, 1]], {"triangle": [[0, 1, 2], [0, 4, 3]]}, r"nodes \[2, 4\] coincide at \[1.0, 1.0\]"),
        ([*SQUARE[:2], [1, 1.1], [0, 1]], {"triangle": HALVES}, r"node 2 at \[1.0, 1.1, 0.0\] is outside"),
        ([*SQUARE[:3], [np.nan, 1]], {"triangle": HALVES}, "node 3 at .nan"),
        ([*SQUARE[:3], [0, -1e-5]], {"triangle": HALVES}, "node 3"),
        ([[0, 0, 0], [1, 0, 0], [1, 1, 0.1], [0, 1, 0]], {"triangle": HALVES}, "not planar: z from 0"),
        (SQUARE, {"triangle": [[0, 1, 2], [0, 2, 9]]}, r"triangle 1 has nodes \[0 2 9\]"),
    ],
)
def test_unusable_files_are_refused_by_name_and_number(
    tmp_path: Path, nodes: Any, cells: dict[str, Any], message: str
) -> None:
    with pytest.raises(MeshError, match=message):
        file_mesh(write(tmp_path / "bad.vtk", nodes, **cells), (1.0, 1.0))


def test_a_plane_mesh_is_no_mesh_of_a_solid(tmp_path: Path) -> None:
    path = write(tmp_path / "flat.vtu", SQUARE, triangle=HALVES)
    with pytest.raises(MeshError, match="no tetra cells; the file holds: 2 triangle"):
        file_mesh(path, (1.0, 1.0, 1.0))


UNREADABLE = [("bad.msh", "nonsense"), ("bad.vtu", "<a>"), ("bad.what", ""), ("missing.vtu", None)]


@pytest.mark.parametrize(("name", "text"), UNREADABLE)
def test_unreadable_files_say_why_and_print_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, text: str | None
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(MeshError, match=f"{name}: meshio cannot read it: ."):
        file_mesh(tmp_path / name, (1.0, 1.0))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("size", [(8.0, 5.0), (4.0, 3.0, 3.5)])
def test_gmsh_fills_the_box_the_same_way_every_time(
    gmsh: Any, capfd: pytest.CaptureFixture[str], size: tuple[float, ...]
) -> None:
    mesh = gmsh_mesh(size, 0.7)
    check_mesh(mesh, size, wall=1e-12)
    assert mesh.spacing.mean() == pytest.approx(0.7, rel=0.3)
    from_thread: list[Mesh] = []
    thread = threading.Thread(target=lambda: from_thread.append(gmsh_mesh(size, 0.7)))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(from_thread[0].nodes, mesh.nodes)
    np.testing.assert_array_equal(from_thread[0].cells, mesh.cells)
    assert not gmsh.isInitialized()
    assert capfd.readouterr() == ("", "")


def test_a_file_that_gmsh_wrote_with_all_its_entities(gmsh: Any, tmp_path: Path) -> None:
    with started(gmsh):
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.addBox(0, 0, 0, 2, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.generate(3)
        gmsh.write(str(tmp_path / "box.msh"))
    check_mesh(file_mesh(tmp_path / "box.msh", (2.0, 1.0, 1.0)), (2.0, 1.0, 1.0), wall=1e-12)


def test_gmsh_in_use_elsewhere_is_left_alone(gmsh: Any) -> None:
    with started(gmsh):
        with pytest.raises(MeshError, match=r"gmsh\.finalize"):
            gmsh_mesh((3.0, 3.0), 1.0)
        assert gmsh.isInitialized()


def test_gmsh_does_not_have_the_process_killed_by_a_broken_pipe(gmsh: Any) -> None:
    """Python ignores SIGPIPE and raises; a service or a notebook that made a mesh must still do so."""

    def ignored() -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1], 16) for line in lines if line.startswith("SigIgn"))

    before = ignored()
    assert before >> (signal.SIGPIPE - 1) & 1
    gmsh_mesh((3.0, 3.0), 1.0)
    assert ignored() == before


@pytest.mark.parametrize(
    ("error", "advice"), [(OSError("libGLU.so.1: gone"), INSTALL), (ImportError("gmsh"), "pip install gmsh")]
)
def test_missing_gmsh_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, error: Exception, advice: str
) -> None:
    def fail(name: str) -> None:
        raise error

    monkeypatch.setattr(geometry, "import_module", fail)
    with pytest.raises(MeshError, match=advice):
        gmsh_mesh((3.0, 3.0), 1.0)


@pytest.mark.parametrize(
    ("source", "name"), [("triangular", "lattice"), ("lattice", "square"), ("gmsh", "gmsh_mesh"), ("file", "file_mesh")]
)
def test_make_mesh_calls_the_source_of_the_case(
    monkeypatch: pytest.MonkeyPatch, source: str, name: str
) -> None:
    called: list[tuple[Any, ...]] = []
    monkeypatch.setattr(geometry, name, lambda *arguments: called.append(arguments))
    spacing, path = (None, "a.msh") if source == "file" else (0.5, None)
    nodes: Any = SimpleNamespace(source=source, spacing=spacing, path=path)
    make_mesh(nodes, (3.0, 2.0))
    expected = {"file": ("a.msh", (3.0, 2.0), True), "gmsh": ((3.0, 2.0), 0.5)}
    assert called == [expected.get(source, ((3.0, 2.0), 0.5, True))]
    nothing: Any = SimpleNamespace(source=source, spacing=None, path=None)
    with pytest.raises(MeshError, match=f"source {source}"):
        make_mesh(nothing, (3.0, 2.0))
