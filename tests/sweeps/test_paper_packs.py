"""The packs of Huang et al. 2023 (sweeps/paper): particle counts, and vacancy ratios at t = 0 as frit measures them.

The full meshes have 5.6 million points. With linear shape functions the ratio needs neither their tables nor their
neighbours, and the nodal fields (34) are the same; meshes of two spacings show how far it has converged.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from places import ROOT

from frit.solver.case import Case, Nodes, ShapeFunctions, load_case
from frit.solver.geometry import make_mesh
from frit.solver.observe import box_weights
from frit.solver.pack_measures import touching
from frit.solver.pack_store import packed
from frit.solver.partition import Ranks
from frit.solver.prepare import prepare
from frit.solver.setup import make_setup

FOLDER = ROOT / "sweeps/paper"
# count, initial vacancy ratio
PACKS = {"pack_a": (143, 0.351), "pack_b": (150, 0.350), "pack_c": (134, 0.277), "pack_d": (85, 0.621)}


@cache
def placed(name: str) -> Case:
    """The case with its particles."""
    case = load_case(FOLDER / f"{name}.toml")
    packing = packed(case)
    return case.with_particles(packing.centres, packing.radii)


def vacancy_ratio(case: Case, spacing: float) -> float:
    """R_v = 1 - int rho / V of the initial fields on a lattice of this spacing."""
    case = case.model_copy(
        update={"nodes": Nodes(source="triangular", spacing=spacing), "shape_functions": ShapeFunctions(kind="linear")}
    )
    mesh = make_mesh(case.nodes, case.domain.size)
    low, high = (np.array(corner) for corner in case.output.vacancy_box)
    # Only cells at the box count: the others are left out, before anything is computed for them.
    near = ((mesh.points > low - 2.0 * spacing) & (mesh.points < high + 2.0 * spacing)).all(axis=1)
    seen, cells = np.unique(mesh.cells[near], return_inverse=True)
    part = replace(
        mesh, nodes=mesh.nodes[seen], cells=cells.reshape(-1, mesh.cells.shape[1]).astype(np.int32),
        points=mesh.points[near], weights=mesh.weights[near], spacing=mesh.spacing[near],
    )  # fmt: skip
    scheme, state = prepare(case, part, Ranks())
    return float(1.0 - box_weights(case, part, scheme.d, low, high) @ state.rho / np.prod(high - low))


@pytest.mark.parametrize("name", PACKS)
def test_packs_have_the_papers_counts_and_are_sound(name: str) -> None:
    case = placed(name)
    x, r = np.array(case.particles.centres), np.array(case.particles.radii)
    contacts = touching(x, r, np.zeros(3), np.array(case.domain.size))
    assert abs(len(r) - PACKS[name][0]) <= 5
    assert r.mean() == pytest.approx(10.0, abs=1e-6)
    assert r.std() == pytest.approx(3.0 if name == "pack_c" else 1.0, abs=1e-6)
    assert contacts.overlap < 0.005
    if name == "pack_d":
        assert (contacts.alone, contacts.clusters, contacts.percolates(2)) == (0, 1, True)


@pytest.mark.parametrize("name", PACKS)
def test_vacancy_ratios_are_the_papers(name: str) -> None:
    """Within 0.01 at twice the spacing of the case already, where the ratio has converged to 0.002."""
    case = placed(name)
    coarse, fine = vacancy_ratio(case, 3.2), vacancy_ratio(case, 2.4)
    assert abs(coarse - fine) < 2e-3
    assert abs(fine - PACKS[name][1]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("name", PACKS)
def test_vacancy_ratios_at_the_spacing_of_the_case(name: str) -> None:
    case = placed(name)
    spacing = case.nodes.spacing
    assert spacing is not None
    assert abs(vacancy_ratio(case, spacing) - PACKS[name][1]) < 0.01


def test_meshes_are_as_large_as_the_papers() -> None:
    """53 889 nodes in 2-D, 942 587 in 3-D, to half a per cent."""
    flat = load_case(FOLDER / "pack2d.toml")
    assert make_setup(flat, Ranks()).nodes == 53_889
    for name in PACKS:
        case = load_case(FOLDER / f"{name}.toml")
        assert case.domain.size == (100.0, 100.0, 125.0)
        assert make_setup(case, Ranks()).nodes == pytest.approx(942_587, rel=5e-3)


def test_the_flat_pack_has_a_hundred_discs() -> None:
    case = placed("pack2d")
    x, r = np.array(case.particles.centres), np.array(case.particles.radii)
    assert len(r) == 100
    assert touching(x, r, np.zeros(2), np.array(case.domain.size)).overlap < 0.005
