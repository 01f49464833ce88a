"""A square becomes a disc on meshes that finite elements cannot use (section 3.5 of the paper).

The good mesh says what is right: no other code is needed to tell that a square of 16 nm turns into a disc, and that the
disc has one diameter.
"""

from pathlib import Path

import numpy as np
import pytest
from launching import Case, different, interrupted, resume, solve
from simulate import Result, simulate

from frit.solver import field
from frit.solver.arrays import Floats
from frit.sweeps.paper import bad_meshes

LINES = np.array([(1.0, 0.0), (0.0, 1.0), (0.5**0.5, 0.5**0.5)])  # horizontal, vertical, diagonal


def diameters(result: Result) -> Floats:
    """Where rho = 1/2 along three lines through the middle: the field's outermost crossings."""
    s = np.linspace(-14.0, 14.0, 1121)
    found = []
    for line in LINES:
        x = 0.5 * bad_meshes.SIDE + s[:, None] * line
        above = field.at(result.case, result.mesh, x, np.ascontiguousarray(result.state.u[:, :1]))[:, 0] - 0.5
        k = np.flatnonzero(np.diff(np.sign(above)))
        at = s[k] - above[k] * (s[k + 1] - s[k]) / (above[k + 1] - above[k])
        found.append(at[-1] - at[0])
    return np.array(found)


def square(kind: str, folder: Path, end: float, seed: int = bad_meshes.SEED) -> Result:
    return simulate(bad_meshes.case(bad_meshes.write(kind, folder / f"{kind}{seed}.vtk", seed), end))


def test_the_meshes_are_as_bad_as_they_should_be() -> None:
    """What the names promise, with as many nodes in each, or nearly."""
    made = {kind: bad_meshes.make(kind) for kind in bad_meshes.KINDS}
    assert {len(nodes) for kind, (nodes, _) in made.items() if kind != "good"} == {3721}
    assert len(made["good"][0]) == pytest.approx(3721, rel=0.02)
    aspects = {kind: bad_meshes.aspect(*mesh).max() for kind, mesh in made.items()}
    assert aspects["good"] < 2.5
    assert aspects["slivers"] > 100.0
    assert (bad_meshes.areas(*made["slivers"]) > 0.0).all()
    for kind in ("graded", "askew"):
        x = np.unique(made[kind][0][:, 0])
        assert np.diff(x).max() / np.diff(x).min() == pytest.approx(6.0)
    x = np.unique(made["pairs"][0][:, 0].round(9))
    assert np.diff(x).min() == pytest.approx(0.01)
    moved = np.linalg.norm(made["collapsed"][0] - bad_meshes.squares()[0], axis=1) > 0.1
    assert moved.sum() == int(0.25 * 59**2)


def test_bad_meshes_do_not_matter(tmp_path: Path) -> None:
    """At t = 10 corners are gone, and diameters still differ along the axes and the diagonal: within 1.5 % of the good
    mesh's, and no more than twice its evaluations. The bar of 0.7 % is at t = 40, below."""
    good = square("good", tmp_path, 10.0)
    for kind in ("collapsed", "pairs"):
        bad = square(kind, tmp_path, 10.0)
        np.testing.assert_allclose(diameters(bad), diameters(good), rtol=0.015)
        assert bad.state.evaluations <= 2 * good.state.evaluations


@pytest.mark.slow
def test_bad_meshes_do_not_matter_in_the_end(tmp_path: Path) -> None:
    """Three diameters within 0.7 % of the good mesh's; on random nodes, and on those graded askew, 1 %."""
    good = square("good", tmp_path, 40.0)
    right = diameters(good)
    assert np.ptp(right) < 0.003 * right.mean()
    for kind in ("graded", "askew", "slivers", "collapsed", "pairs", "random"):
        bad = square(kind, tmp_path, 40.0)
        errors = diameters(bad) / right - 1.0
        print(f"{kind}: {100 * errors} %, {bad.state.evaluations} evaluations of {good.state.evaluations}")
        assert np.abs(errors).max() < (0.01 if kind in ("random", "askew") else 0.007)
        assert bad.state.evaluations <= 2 * good.state.evaluations
        mass = bad.column("solid_mass")
        assert np.abs(mass / mass[0] - 1.0).max() < 1e-12


@pytest.fixture
def triple(tmp_path: Path) -> Case:
    """Three touching discs on random nodes, in a corner of which lies another part of the mesh."""
    nodes = np.stack(np.meshgrid(np.linspace(0, 21, 22), np.linspace(0, 18, 19), indexing="ij"), axis=-1).reshape(-1, 2)
    inside = ((nodes > 0) & (nodes < (21.0, 18.0))).all(axis=1)
    nodes[inside] += np.random.default_rng(4).uniform(-0.7, 0.7, (int(inside.sum()), 2))
    nodes[inside] = np.clip(nodes[inside], 0.01, (20.99, 17.99))
    import meshio
    from scipy.spatial import Delaunay

    path = tmp_path / "jittered.vtk"
    meshio.Mesh(np.column_stack([nodes, 0 * nodes[:, 0]]), [("triangle", Delaunay(nodes).simplices)]).write(path)
    return {
        "domain": {"size": [21.0, 18.0]},
        "nodes": {"source": "file", "path": str(path)},
        "particles": {"centres": [[5.8, 5.5], [14.2, 6.1], [9.6, 12.8]], "radii": [4.4, 4.1, 3.8]},
        "time": {"integrator": "rk2", "end": 0.01, "step": 1e-4},
        "output": {"history_every": 0.001, "snapshots": [0.0, 0.0035, 0.01]},
    }


@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_agree_on_any_nodes(tmp_path: Path, triple: Case, ranks: int) -> None:
    """See test_ranks.py."""
    alone, together = solve(triple, tmp_path / "1"), solve(triple, tmp_path / str(ranks), ranks)
    assert different(alone, together, 1e-10) == {}


def test_a_resumed_run_on_any_nodes_is_the_same_run(tmp_path: Path, triple: Case) -> None:
    whole = solve(triple, tmp_path / "whole")
    part = resume(interrupted(triple, tmp_path / "part", ranks=2), ranks=1)
    assert different(whole, part, 1e-10) == {}
