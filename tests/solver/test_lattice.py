"""Square and cubic lattices: sums axis by axis give what sums over all nodes and points give, and what theory says."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import reference
from simulate import merged

from frit.solver.arrays import Floats
from frit.solver.case import parse_case
from frit.solver.lattice import loops, windows
from frit.solver.lattice.axis import Axis, make_axis
from frit.solver.lattice.observe import at_nodes, field_of, integrals, neck
from frit.solver.lattice.scheme import LatticeScheme, LatticeState, cut, meeting
from frit.solver.lattice.setup import LatticeSetup
from frit.solver.lattice.start import fitting_boxes, move
from frit.solver.partition import Collector, Ranks
from frit.solver.setup import MeshSetup, make_setup
from frit.solver.shape import ShapeError

DISCS: dict[str, Any] = {
    "domain": {"size": [22.0, 13.0]},
    "nodes": {"spacing": 1.0},
    "particles": {"centres": [[6.5, 6.2], [15.4, 6.8]], "radii": [5.0, 4.0]},
    "time": {"end": 0.5},
    "output": {"history_every": 0.1, "snapshots": [0.0]},
}
SPHERES: dict[str, Any] = DISCS | {
    "domain": {"size": [14.0, 12.0, 11.0]},
    "particles": {"centres": [[4.5, 5.6, 5.5], [9.0, 6.3, 5.6]], "radii": [2.5, 2.3]},
}


EPS = 0.02  # 1/nm: at some points fields vary by more, at others by less


def started(tree: dict[str, Any]) -> tuple[LatticeScheme, LatticeState]:
    setup = LatticeSetup(parse_case(tree), Ranks())
    scheme, state, _ = setup.start()
    return scheme, state


def whole(scheme: LatticeScheme, y: Floats, w: int) -> Floats:
    """A window's field on all nodes, 0 where it has none."""
    field = np.zeros(scheme.lattice.nodes)
    values, first = field_of(scheme, y, w)
    field[tuple(slice(f, f + n) for f, n in zip(first, values.shape, strict=True))] = values
    return field.ravel()


def dense(scheme: LatticeScheme) -> tuple[Floats, Floats, Floats, Floats]:
    """N (p, n), dN (p, n, dim), weights and positions of the points from the domain's centre."""
    axes = [axis for axis in scheme.lattice.axes if axis is not None]

    def table(axis: Axis, values: Floats) -> Floats:
        found = np.zeros((2, axis.cells, axis.cells + 1))
        for c in range(axis.cells):
            for t in range(2 * axis.reach):
                if 0 <= (node := c - axis.reach + 1 + t) <= axis.cells:
                    found[:, c, node] = values[:, c, t]
        return found

    N, dN = [table(axis, axis.N) for axis in axes], [table(axis, axis.dN) for axis in axes]

    def product(slope: int | None) -> Floats:
        rows = []
        for p in range(2):
            result = np.ones((1, 1))
            for k in range(len(axes)):
                result = np.kron(result, (dN if k == slope else N)[k][p])
            rows.append(result)
        return np.concatenate(rows)

    gradients = np.stack([product(k) for k in reversed(range(len(axes)))], axis=-1)
    places = []
    for p in range(2):
        grid = np.meshgrid(*(axis.points[p] - axis.length / 2 for axis in axes), indexing="ij")
        places.append(np.stack(grid[::-1], axis=-1).reshape(-1, len(axes)))
    x = np.concatenate(places)
    return product(None), gradients, np.full(len(x), scheme.lattice.tables.weight), x


@pytest.mark.parametrize(
    ("gamma", "tolerance", "width"), [(1.8, 1e-6, None), (0.8, 1e-6, None), (4.0, 1e-6, None), (1.8, 1e-3, 1.2)]
)
def test_functions_of_an_axis_are_consistent_and_those_of_the_plain_solver(
    gamma: float, tolerance: float, width: float | None
) -> None:
    """sum N = 1, sum N x = x, sum dN = 0, sum dN x = 1: at walls, too."""
    axis = make_axis(11.3, 0.7, gamma, tolerance, width)
    node = np.arange(axis.cells)[:, None] - axis.reach + 1 + np.arange(2 * axis.reach)
    x = node * axis.step
    np.testing.assert_allclose(axis.N.sum(axis=2), 1.0, atol=1e-14)
    np.testing.assert_allclose((axis.N * x).sum(axis=2), axis.points, atol=1e-12)
    np.testing.assert_allclose(axis.dN.sum(axis=2), 0.0, atol=1e-12)
    np.testing.assert_allclose((axis.dN * x).sum(axis=2), 1.0, atol=1e-10)
    assert (axis.N[:, (node < 0).any(axis=1)][:, :, 0] == 0.0).all()
    np.testing.assert_allclose(axis.sums(np.ones((2, 1))).sum(), 2 * axis.cells, rtol=1e-13)
    for p, c in ((0, 0), (1, 0), (0, 7), (1, axis.cells - 1)):
        N, dN = reference.lme(axis.points[p, c : c + 1], axis.nodes[:, None], width or axis.step, gamma, tolerance)
        inside = (node[c] >= 0) & (node[c] <= axis.cells)
        np.testing.assert_allclose(axis.N[p, c, inside], N[node[c, inside]], atol=1e-11)
        np.testing.assert_allclose(axis.dN[p, c, inside], dN[node[c, inside]].ravel(), atol=1e-9)


def test_tables_by_cell_and_by_node_say_the_same() -> None:
    axis = make_axis(9.0, 1.0, 1.8, 1e-6)
    by_cell, by_node = axis.by_cell(axis.N), axis.by_node(axis.N)
    ghosts, taps = (by_cell.shape[1] - axis.cells) // 2, 2 * axis.reach
    for p in range(2):
        for t in range(taps):
            for c in range(axis.cells):
                node = c - axis.reach + 1 + t
                assert by_cell[p * taps + t, ghosts + c] == axis.N[p, c, t]
                if 0 <= node <= axis.cells:
                    assert by_node[p * taps + t, ghosts + node] == axis.N[p, c, t]


def test_functions_that_reach_too_few_nodes_are_refused() -> None:
    with pytest.raises(ShapeError, match="gamma = 6"):
        make_axis(9.0, 1.0, 6.0, 0.09)


@pytest.mark.parametrize("tree", [DISCS, SPHERES], ids=["2-D", "3-D"])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"shape_functions": {"gamma": 4.0}},
        {"shape_functions": {"gamma": 0.9}},
        {"model": {"advection": "wang"}},
        {"model": {"rigid_motion": False}},
        {"activation": {"few_order_parameters": False}},
    ],
    ids=["default", "sharp", "wide", "wang", "still", "all nodes"],
)
def test_rates_are_those_of_the_plain_sums(tree: dict[str, Any], changes: dict[str, Any]) -> None:
    scheme, state = started(merged(tree, **changes))
    rng = np.random.default_rng(1)
    y = state.y * (1.0 + 0.05 * rng.standard_normal(state.y.size))  # nothing that symmetry could hide
    rate = np.full_like(y, np.nan)
    scheme.rates(y, rate)
    N, dN, w, x = dense(scheme)
    rho, eta = whole(scheme, y, 0), np.stack([whole(scheme, y, 1), whole(scheme, y, 2)], axis=-1)
    model = scheme.case.model
    expected = reference.rates(rho, eta, N, dN, w, x, scheme.lattice.coefficients, model.rigid_motion, model.advection)
    scale = np.abs(expected.rho).max()
    assert (scheme.contacts.number[0] > 3) == model.rigid_motion
    np.testing.assert_allclose(whole(scheme, rate, 0), expected.rho, atol=3e-7 * scale)  # what windows cut off
    for a in range(2):
        mine, theirs = whole(scheme, rate, 1 + a), expected.eta[:, a]
        inside = whole(scheme, np.ones_like(y), 1 + a).astype(bool) & (mine != 0.0)
        # At the rim points count that have no corner of their cell in the window, and are left out: below eps.
        np.testing.assert_allclose(mine[inside], theirs[inside], atol=1e-9 * scale, rtol=1e-11)
        assert np.abs(theirs[~inside]).max(initial=0.0) < 1e-5 * scale


def energy(scheme: LatticeScheme, y: Floats) -> tuple[float, float, float, float]:
    g = scheme.lattice
    fields = y.reshape(1, -1), scheme.layout, g.tables, scheme.room
    return loops.energy(*fields, g.coefficients, EPS, EPS, 0, 0, len(g.layers))


def test_mass_is_conserved_and_energy_falls_without_motion() -> None:
    for tree in (DISCS, SPHERES):
        scheme, state = started(merged(tree, model={"rigid_motion": False}))
        rate, g = np.empty_like(state.y), scheme.lattice
        mass = 1.0 / np.where(g.inverse_mass > 0.0, g.inverse_mass, np.inf)
        energies, y = [], state.y.copy()
        for _ in range(12):
            scheme.rates(y, rate)
            assert abs(np.vdot(mass[: scheme.rho], rate[: scheme.rho])) < 1e-13 * np.abs(rate[: scheme.rho]).sum()
            energies.append(energy(scheme, y)[0])
            y += 1e-3 * rate
        assert (np.diff(energies) < 0.0).all()


def test_energy_is_that_of_the_plain_sum() -> None:
    for tree in (DISCS, SPHERES):
        scheme, state = started(tree)
        g = scheme.lattice
        F, live, least, most = energy(scheme, state.y)
        N, dN, w, _ = dense(scheme)
        rho = whole(scheme, state.y, 0)
        eta = np.stack([whole(scheme, state.y, 1), whole(scheme, state.y, 2)], axis=-1)
        assert pytest.approx(reference.free_energy(rho, eta, N, dN, w, g.coefficients), rel=1e-7) == F
        steep = np.linalg.norm(np.einsum("pnd,n->pd", dN, rho), axis=1) >= EPS
        slopes = np.linalg.norm(np.einsum("pnd,nk->pkd", dN, eta), axis=2)
        assert live == (steep | (slopes >= EPS).any(axis=1)).sum() < len(w)
        assert (least, most) == pytest.approx((float((N @ rho).min()), float((N @ rho).max())), abs=1e-14)


def test_moments_are_exact() -> None:
    for tree in (DISCS, SPHERES):
        scheme, state = started(tree)
        N, _, w, x = dense(scheme)
        for a in range(2):
            eta = N @ whole(scheme, state.y, 1 + a)
            expected = [w @ eta, *(w * eta) @ x]
            np.testing.assert_allclose(scheme.moments(state.y)[a], expected, rtol=1e-12, atol=1e-9)


def test_the_vacancy_box_is_integrated_exactly() -> None:
    """Of a linear field, wherever the box cuts the cells: int_a^b x dx = (b^2 - a^2) / 2."""
    axis = make_axis(10.0, 0.8, 1.8, 1e-6)
    for low, high in ((0.0, 10.0), (1.234, 7.001), (3.3, 3.4)):
        weights = integrals(axis, low, high)
        assert weights.sum() == pytest.approx(high - low, rel=1e-12)
        assert weights @ axis.nodes == pytest.approx((high**2 - low**2) / 2, rel=1e-10)


def test_fields_at_the_nodes_are_those_of_the_plain_functions() -> None:
    scheme, state = started(DISCS)
    values = at_nodes(scheme, *field_of(scheme, state.y, 0))
    nodes = LatticeSetup(scheme.case, Ranks()).positions()
    for a in (0, 30, 150, len(nodes) - 1):  # on walls the field is that of the wall alone
        x, y = (scheme.lattice.axes[k].at(nodes[a, i : i + 1])[0] for k, i in ((2, 0), (0, 1)))  # type: ignore[union-attr]
        assert values.ravel()[a] == pytest.approx(np.kron(y, x) @ whole(scheme, state.y, 0), abs=1e-13)


def test_the_neck_of_two_discs_is_the_chord_of_the_solid() -> None:
    """Overlapping discs of radius R, 2 d apart: where rho = 1/2 on the plane between them, near 2 sqrt(R^2 - d^2)."""
    tree = merged(
        DISCS, domain={"size": [40.0, 26.0]}, nodes={"spacing": 0.4},
        particles={"centres": [[13.7, 13.0], [26.3, 13.0]], "radii": [8.0, 8.0], "interface_width": 0.8},
    )  # fmt: skip
    scheme, state = started(tree)
    field = np.hypot(np.linspace(-13, 13, 200001), 6.3) - 8.0
    rho = 1.0 - np.tanh(field / 0.8)
    chord = np.ptp(np.linspace(-13, 13, 200001)[rho > 0.5])
    assert neck(scheme, state.y) == pytest.approx(chord, rel=0.02)


def test_windows_follow_the_fields_and_lose_nothing_that_counts() -> None:
    particles = {"centres": [[22.5, 18.2], [31.4, 18.8]]}
    scheme, state = started(merged(DISCS, domain={"size": [52.0, 38.0]}, particles=particles))
    begin = scheme.boxes.begin.copy()
    inside = (scheme.boxes.end - np.minimum(scheme.boxes.begin, scheme.boxes.end)).sum()
    assert inside < 0.9 * 2 * np.prod(scheme.lattice.nodes)  # of two fields on all nodes
    y = state.y.copy()
    w = 1
    assert windows.rim(y, scheme.layout, np.array(scheme.lattice.nodes), 1) < 1e-5
    row = scheme.layout.row[w] + scheme.layout.size[w, 0] // 2
    at = scheme.layout.offset[w] + (scheme.layout.size[w, 0] // 2) * scheme.layout.size[w, 2]
    y[at + scheme.layout.begin[row]] = 0.3
    assert windows.rim(y, scheme.layout, np.array(scheme.lattice.nodes), 1) == 0.3
    before = [whole(scheme, y, k) for k in range(3)]
    (moved,) = move(scheme, fitting_boxes(scheme, y, 1e-5), y)
    for k in range(3):
        np.testing.assert_allclose(whole(scheme, moved, k), before[k], atol=1e-5)
    assert not np.array_equal(scheme.boxes.begin, begin)
    gone = moved.copy()
    gone[scheme.layout.offset[1] : scheme.layout.offset[2]] = 0.0  # the first particle has been consumed
    (left,) = move(scheme, fitting_boxes(scheme, gone, 1e-5), gone)
    assert scheme.boxes.size[0].sum() == 0
    assert scheme.pairs.size == 0
    rate = np.empty_like(left)
    scheme.rates(left, rate)
    assert np.isfinite(rate).all()
    assert scheme.moments(left)[0, 0] == 0.0


def test_pairs_are_those_whose_windows_meet() -> None:
    rng = np.random.default_rng(3)
    low, size = rng.integers(0, 40, (30, 3)), rng.integers(1, 12, (30, 3))
    none = np.empty(0, dtype=np.int32)
    boxes = windows.Boxes(low, size, np.zeros(31, dtype=np.int64), none, none)
    first, last = low - 1, low + size + 1
    pairs = [(a, b) for a in range(30) for b in range(a + 1, 30)]
    expected = [(a, b) for a, b in pairs if (first[a] < last[b]).all() and (first[b] < last[a]).all()]
    assert [tuple(pair) for pair in meeting(boxes)] == expected


def test_layers_are_cut_by_work() -> None:
    assert cut(np.ones(10), 2) == (0, 5, 10)
    assert cut(np.array([9.0, 1, 1, 1, 1, 1, 1, 1, 1, 1]), 2) == (0, 1, 10)
    assert cut(np.ones(3), 3) == (0, 1, 2, 3)
    with pytest.raises(ValueError, match="4 ranks"):
        cut(np.ones(3), 4)


def test_linear_functions_stand_on_the_cells_of_the_lattice() -> None:
    for tree, cells, corners in ((DISCS, 22 * 13 * 2, 3), (SPHERES, 14 * 12 * 11 * 6, 4)):
        setup = make_setup(parse_case(merged(tree, shape_functions={"kind": "linear"})), Ranks())
        assert isinstance(setup, MeshSetup)
        assert setup.mesh.cells.shape == (cells, corners)
        assert setup.mesh.weights.sum() == pytest.approx(np.prod(tree["domain"]["size"]))
        assert len(np.unique(setup.mesh.weights.round(12))) == 1


def test_a_checkpoint_of_a_lattice_gives_the_same_fields(tmp_path: Path) -> None:
    setup = LatticeSetup(parse_case(SPHERES), Ranks())
    scheme, state, integrator = setup.start()
    integrator.restart(scheme, state)
    integrator.step(scheme, state, 0.01)
    inside = np.zeros_like(state.y)
    windows.carry(inside, scheme.layout, state.y, scheme.layout)
    np.testing.assert_array_equal(state.y, inside)  # whole planes are written: nothing is beside the windows
    state.time, state.step, state.evaluations = 0.25, 7, 31
    collector = Collector(setup.share(scheme), 100)
    setup.keep(tmp_path, scheme, state, collector, {"identity": "x", "memory": {"dt": 0.1}, "wall_time": 2.0})
    kept = setup.read(tmp_path, "x")
    again, resumed, _ = setup.start(kept)
    assert (resumed.time, resumed.step, resumed.evaluations, kept.wall_time) == (0.25, 7, 31, 2.0)
    np.testing.assert_array_equal(resumed.y, state.y)
    np.testing.assert_array_equal(again.boxes.begin, scheme.boxes.begin)
