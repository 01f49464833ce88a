"""Points in lattice rows go eight at a time: the same numbers as one by one, whoever exists in whichever lane."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulate import rates_of

from frit.solver import block_kernels, blocks, contacts, vectors
from frit.solver.arrays import Floats, Numbers
from frit.solver.blocks import MIXED, Blocks, find_blocks, find_upright
from frit.solver.case import Case, parse_case
from frit.solver.discretisation import activity
from frit.solver.geometry import lattice
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh, prepare
from frit.solver.shape import lme
from frit.solver.simd import LANES, X86

SIZES = [(23.0, 11.0), (18.0, 6.0, 5.0)]


class Grouped:
    """The blocks of a lattice, along x and upright."""

    def __init__(self, size: tuple[float, ...], nodes: Floats | None = None, shared: Any = None) -> None:
        self.mesh = mesh = lattice(size, 0.8)
        self.nodes = mesh.nodes if nodes is None else nodes
        self.table = lme(mesh.points, mesh.spacing, self.nodes, 1.8, 1e-6)
        self.shared = np.zeros(len(mesh.nodes), dtype=bool) if shared is None else shared
        self.along = find_blocks(self.table, mesh.points, self.shared)
        self.upright = find_upright(self.table, mesh.points, self.nodes, self.along)

    def seen(self, p: int) -> Numbers:
        """The nodes of a point."""
        return self.table.nodes[self.table.offsets[p] : self.table.offsets[p + 1]]


@pytest.mark.parametrize("size", SIZES, ids=["2-D", "3-D"])
def test_every_point_is_in_one_lane_or_loose(size: tuple[float, ...]) -> None:
    """The first and last points of a row have functions of their own: those above each other go together. The box in
    space is so small that most of these are near its floor or ceiling, too."""
    found = Grouped(size)
    lanes = [some.points[some.points >= 0] for some in (found.along, found.upright)]
    np.testing.assert_array_equal(np.sort(np.concatenate([lanes[1], found.upright.loose])), np.sort(found.along.loose))
    everyone = np.sort(np.concatenate([lanes[0], found.along.loose]))
    np.testing.assert_array_equal(everyone, np.arange(len(found.mesh.points)))
    for some in (found.along, found.upright):
        assert ((some.points >= 0).sum(axis=1) >= 2).all()
    assert found.along.loose.size < 0.4 * everyone.size
    assert found.upright.loose.size < (0.3 if len(size) == 2 else 0.8) * found.along.loose.size


@pytest.mark.parametrize("size", SIZES, ids=["2-D", "3-D"])
def test_the_next_lane_sees_the_next_nodes(size: tuple[float, ...]) -> None:
    """Along y the next of those that are numbered so."""
    found = Grouped(size)
    dim = len(size)
    for some in (found.along, found.upright):
        at = some.at if some.at.size else np.arange(len(found.mesh.nodes))
        for b, points in enumerate(some.points):
            first = some.nodes[some.begin[b] : some.begin[b] + some.count[b]]
            for j, p in enumerate(points):
                if p >= 0:
                    np.testing.assert_array_equal(found.seen(p), at[first + j])
                    assert found.table.rows[p] == some.start[b]
                    np.testing.assert_array_equal(some.x[3 * b : 3 * b + dim, j], found.mesh.points[p])
                else:
                    assert (points[j:] < 0).all()


def test_points_of_scattered_nodes_are_loose() -> None:
    nodes = lattice((9.0, 7.0), 0.8).nodes
    found = Grouped((9.0, 7.0), nodes + np.random.default_rng(0).uniform(-0.05, 0.05, nodes.shape))
    for some in (found.along, found.upright):
        assert len(some.points) == 0
        np.testing.assert_array_equal(some.loose, np.arange(len(found.mesh.points)))


def test_who_sees_a_shared_node_is_at_the_border() -> None:
    found = Grouped((23.0, 25.0), shared=lattice((23.0, 25.0), 0.8).nodes[:, 1] > 23.0)
    at_border = np.array([found.shared[found.seen(p)].any() for p in range(len(found.mesh.points))])
    for some in (found.along, found.upright):
        assert 0 < some.border.sum() < len(some.border)
        for lanes, border in zip(some.points, some.border, strict=True):
            assert at_border[lanes[lanes >= 0]].any() == border
        np.testing.assert_array_equal(at_border[some.loose], np.arange(some.loose.size) < some.loose_border)


# --- rates, and the choice of live points


def grains(dim: int, activation: dict[str, Any], model: dict[str, Any]) -> Case:
    """Two touching pairs, and room in which nothing happens."""
    if dim == 2:
        centres = [[4.0, 4.0], [4.2, 8.9], [16.0, 4.0], [16.1, 8.9]]
        tree: dict[str, Any] = {"domain": {"size": [40.0, 14.0]}, "nodes": {"source": "triangular", "spacing": 0.6}}
    else:
        centres = [[4.0, 4.0, 3.6], [4.2, 8.7, 3.5], [17.0, 4.0, 3.5], [17.1, 8.7, 3.4]]
        tree = {"domain": {"size": [36.0, 13.0, 7.0]}, "nodes": {"source": "triangular", "spacing": 0.8}}
    return parse_case(
        tree
        | {
            "particles": {"centres": centres, "radii": [2.5, 2.4] * 2, "interface_width": 0.5},
            "time": {"end": 1.0},
            "activation": activation,
            "model": model | {"m_r": 40.0},
        }
    )


def one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on every point is loose."""

    def none(table: Any, x: Floats, shared: Any) -> Blocks:
        found = find_blocks(table, x, shared)
        edge = np.zeros(table.points, dtype=bool)
        blocks.see(edge, shared, table.offsets, table.nodes)
        every = np.concatenate([np.flatnonzero(edge), np.flatnonzero(~edge)])
        empty = {name: getattr(found, name)[:0] for name in ("points", "begin", "count", "start", "x", "border")}
        return replace(found, **empty, loose=every, loose_border=int(edge.sum()))

    monkeypatch.setattr("frit.solver.discretisation.find_blocks", none)
    monkeypatch.setattr("frit.solver.discretisation.find_upright", lambda table, x, positions, found: found)


@pytest.mark.parametrize("advection", ["huang", "wang", None])
@pytest.mark.parametrize("enabled", [True, False], ids=["some points live", "all live"])
@pytest.mark.parametrize("dim", [2, 3])
def test_rates_are_those_of_single_points(
    ranks: Ranks, monkeypatch: pytest.MonkeyPatch, dim: int, enabled: bool, advection: str | None
) -> None:
    """The same sums in another order; which points live, and which particles exist where, is the same."""
    model = {"rigid_motion": False} if advection is None else {"advection": advection}
    case = grains(dim, {"enabled": enabled, "eps_rho": 1e-4, "eps_eta": 1e-4}, model)
    mesh = build_mesh(case, ranks)
    monkeypatch.setattr("frit.solver.active.WORTH", 1.0)
    scheme, state = prepare(case, mesh, ranks)
    one_by_one(monkeypatch)
    single, same = prepare(case, mesh, ranks)
    together, alone = scheme.active, single.active
    assert min(len(together.blocks.blocks), len(together.upright.blocks), len(together.loose)) > 0
    assert len(alone.blocks.blocks) == len(alone.upright.blocks) == 0
    assert enabled == (together.live.size < len(mesh.points))
    assert together.blocks.partial.any()
    np.testing.assert_array_equal(together.live, alone.live)
    np.testing.assert_array_equal(state.owner, same.owner)
    np.testing.assert_array_equal(state.u, same.u)
    np.testing.assert_array_equal(together.watch, alone.watch)
    exact = rates_of(single, same)
    rate = rates_of(scheme, state)
    for layer in scheme.layers:  # as if lanes had different particles
        mixed = np.where(layer.live.particle >= 0, MIXED, -1).astype(np.int32)
        layer.live = replace(layer.live, particle=mixed)
    np.testing.assert_allclose(rates_of(scheme, state), rate, rtol=0, atol=1e-13 * np.abs(rate).max())
    for column in range(rate.shape[1]):
        scale = max(np.abs(exact[:, column]).max(), 1e-30)
        np.testing.assert_allclose(rate[:, column], exact[:, column], rtol=0, atol=1e-12 * scale)
    scale = np.abs(single.forces).max(initial=1e-30)
    np.testing.assert_allclose(scheme.forces, single.forces, rtol=0, atol=1e-12 * scale)


def test_more_particles_than_a_word_has_bits(ranks: Ranks, monkeypatch: pytest.MonkeyPatch) -> None:
    """72 discs far apart, a column each: the same points live as where each is asked by itself."""
    case = parse_case({
        "domain": {"size": [132.0, 88.0]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {
            "centres": [[6.0 + 11.0 * (k % 12), 6.0 + 15.0 * (k // 12)] for k in range(72)],
            "radii": [2.5] * 72,
            "interface_width": 0.5,
        },
        "time": {"end": 1.0},
        "activation": {"few_order_parameters": False, "eps_rho": 1e-3, "eps_eta": 1e-3},
    })  # fmt: skip
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    one_by_one(monkeypatch)
    single, same = prepare(case, mesh, ranks)
    assert 0 < scheme.active.live.size < 0.6 * len(mesh.points)
    np.testing.assert_array_equal(scheme.active.live, single.active.live)
    rate, exact = rates_of(scheme, state), rates_of(single, same)
    np.testing.assert_allclose(rate, exact, rtol=0, atol=1e-12 * np.abs(exact).max())


def test_more_contacts_than_there_was_room_for(ranks: Ranks) -> None:
    """Nothing of them is lost: forces are the same when there is ample room from the start."""
    case = grains(2, {}, {})
    mesh = build_mesh(case, ranks)
    found = []
    for room in (2, 100_000):
        scheme, state = prepare(case, mesh, ranks)
        state.u[:, 1:3] = np.maximum(state.u[:, 1:3], 0.45)  # meet everywhere
        scheme.contacts = contacts.room(room, 2)
        rates_of(scheme, state)
        assert scheme.contacts.number[0] > 2
        found.append(scheme.forces.copy())
    np.testing.assert_array_equal(found[0], found[1])


def test_what_is_too_small_becomes_zero_in_kernels_and_nowhere_else() -> None:
    """Fields in the vapour far away: denormal numbers would make every sum a hundred times slower."""
    tiny, normal = 1e-310, 1e-300
    array = np.array([tiny] * LANES + [normal] * LANES)
    vectors.advance(array, array, 1.0, np.zeros_like(array))
    assert (array[:LANES] == (0.0 if X86 else tiny)).all()
    assert (array[LANES:] == normal).all()
    with np.errstate(under="ignore"):
        assert np.array([tiny])[0] * 0.5 == 5e-311  # numpy, and Python, go on as before


@pytest.mark.parametrize("nodes", [3, 200, 205])
@pytest.mark.parametrize("columns", [8, 24])
def test_fields_by_columns_are_those_by_nodes(columns: int, nodes: int) -> None:
    """Eight nodes at a time, and what is left singly; behind them zeros."""
    u = np.random.default_rng(3).standard_normal((nodes, columns))
    by_columns = np.full((columns, nodes + LANES), 7.0)
    block_kernels.to_columns(by_columns, u)
    np.testing.assert_array_equal(by_columns, np.vstack([u, np.zeros((LANES, columns))]).T)


# --- what a rank has to do


def test_expected_work_counts_the_fields_that_exist(ranks: Ranks) -> None:
    """A point of vapour has rho alone, one inside a particle its order parameter, one in a contact two of them."""
    case = parse_case(
        {
            "domain": {"size": [60.0, 30.0]},
            "nodes": {"source": "triangular", "spacing": 1.0},
            "particles": {"centres": [[20.0, 15.0], [36.0, 15.0]], "radii": [8.0, 8.0]},
            "time": {"end": 1.0},
        }
    )
    mesh = build_mesh(case, ranks)
    _, state = prepare(case, mesh, ranks)
    work = activity(mesh, state.u, 1e-5)

    def at(x: float, y: float) -> float:
        return float(work[np.argmin(np.linalg.norm(mesh.points - (x, y), axis=1))])

    assert at(28.0, 15.0) == at(20.0, 7.0) + 1.0
    assert at(58.0, 28.0) < 0.2  # rests


def test_work_is_shared_evenly(ranks: Ranks) -> None:
    """On one rank there is nothing to share, and nothing out of balance."""
    scheme, _ = prepare(grains(2, {}, {}), build_mesh(grains(2, {}, {}), ranks), ranks)
    assert scheme.imbalance() == 0.0
    assert scheme.active.work() > scheme.active.blocks.blocks.size
