"""The rates of change against the reference, conservation, forces, and what switching points off costs."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reference
from simulate import rates_of

from frit.solver import active
from frit.solver.arrays import Floats
from frit.solver.case import Case, parse_case
from frit.solver.contacts import touching_share
from frit.solver.geometry import Mesh
from frit.solver.observe import free_energy
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh, make_integrator, prepare
from frit.solver.scheme import Scheme
from frit.solver.state import State, width

Tree = dict[str, Any]

LME, LINEAR = {"kind": "lme", "gamma": 1.8}, {"kind": "linear"}
STILL, HUANG, WANG = {"rigid_motion": False}, {"advection": "huang"}, {"advection": "wang"}
FULL = {"enabled": False, "few_order_parameters": False}  # all points live, one slot per particle everywhere
TURNING = {"m_r": 40.0}  # lets torques weigh as much as forces on particles this small


def small_case(dim: int, shape: Tree, model: Tree, particles: int = 3, activation: Tree = FULL) -> Case:
    """Three touching particles, each of another size; as few points as dense matrices allow."""
    plane = {
        "domain": {"size": [17.0, 15.0]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {
            "centres": [[5.0, 5.1], [11.0, 5.0], [8.0, 10.2]][:particles],
            "radii": [3.1, 2.9, 3.0][:particles],
        },
    }
    space = {
        "domain": {"size": [8.5, 8.2, 6.0]},
        "nodes": {"source": "triangular", "spacing": 1.2},
        "particles": {
            "centres": [[2.5, 2.5, 3.0], [6.0, 2.6, 3.2], [4.25, 5.5, 2.9]][:particles],
            "radii": [1.8, 1.7, 1.75][:particles],
        },
    }
    tree = {"time": {"end": 1.0}, "shape_functions": shape, "model": TURNING | model, "activation": activation}
    return parse_case((plane if dim == 2 else space) | tree)


def dense(scheme: Scheme) -> tuple[Floats, Floats]:
    table = scheme.d.shape
    return reference.dense(table.offsets, table.nodes, table.entries(), scheme.d.nodes)


def disturb(state: State, particles: int) -> None:
    """Random nodal values added to the initial ones: gradients everywhere, overlaps, values below 0 and above 1."""
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, (len(state.u), 1 + particles))
    state.u[:, : 1 + particles] += noise


def check(scheme: Scheme, state: State, mesh: Mesh, N: Floats, dN: Floats, tolerance: float) -> None:
    """Rates, potential and motion against the reference, each relative to its largest value."""
    case, k = scheme.d.case, len(state.slot_of)
    rate = rates_of(scheme, state)
    exact = reference.rates(
        state.u[:, 0], state.u[:, 1 : 1 + k], N, dN, mesh.weights, mesh.points, case.model,
        case.model.rigid_motion, case.model.advection,
    )  # fmt: skip

    def close(got: Floats, true: Floats) -> None:
        np.testing.assert_allclose(got, true, rtol=0, atol=tolerance * np.abs(true).max())

    close(scheme.W, exact.W)
    close(rate[:, 0], exact.rho)
    close(rate[:, 1 : 1 + k], exact.eta)
    assert not rate[:, 1 + k :].any()
    if case.model.rigid_motion:
        close(scheme.forces[:, : case.dim], exact.bodies.F[:, : case.dim])
        turning = exact.bodies.T[:, 2:] if case.dim == 2 else exact.bodies.T
        close(scheme.motion[:, case.dim :], case.model.m_r * turning / exact.bodies.V[:, None])


@pytest.mark.parametrize("model", [STILL, HUANG, WANG], ids=["still", "huang", "wang"])
@pytest.mark.parametrize("shape", [LME, LINEAR, LME | {"gamma": 4.0}], ids=["lme", "linear", "narrow"])
@pytest.mark.parametrize("dim", [2, 3])
def test_rates_agree_with_the_reference(ranks: Ranks, dim: int, shape: Tree, model: Tree) -> None:
    """The same sums of up to some thousand terms in another order; single terms are up to 100 times their sum."""
    case = small_case(dim, shape, model)
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    disturb(state, 3)
    check(scheme, state, mesh, *dense(scheme), tolerance=1e-12)


@pytest.mark.parametrize("shape", [LME, LINEAR], ids=["lme", "linear"])
def test_rates_agree_with_the_reference_and_its_own_shape_functions(ranks: Ranks, shape: Tree) -> None:
    """Nothing but the mesh is shared. Newton ends at 1e-13 h at the latest in both; forces multiply it by k = 100."""
    case = small_case(2, shape, HUANG)
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    disturb(state, 3)
    N, dN = np.zeros((len(mesh.points), len(mesh.nodes))), np.zeros((len(mesh.points), len(mesh.nodes), 2))
    for p, (x, cell) in enumerate(zip(mesh.points, mesh.cells, strict=True)):
        if shape == LINEAR:
            N[p, cell], dN[p, cell] = reference.linear(x, mesh.nodes[cell])
        else:
            N[p], dN[p] = reference.lme(x, mesh.nodes, 1.0, 1.8, 1e-6)
    check(scheme, state, mesh, N, dN, tolerance=1e-11)


# --- conservation and balance


@pytest.mark.parametrize("model", [STILL, HUANG, WANG], ids=["still", "huang", "wang"])
@pytest.mark.parametrize("dim", [2, 3])
def test_mass_is_conserved(ranks: Ranks, dim: int, model: Tree) -> None:
    """sum_a grad N_a = 0 at every point: a flux is taken from some nodes and given to others. Round-off remains."""
    case = small_case(dim, LME, model)
    scheme, state = prepare(case, build_mesh(case, ranks), ranks)
    disturb(state, 3)
    share = scheme.d.mass * rates_of(scheme, state)[:, 0]
    assert abs(share.sum()) < 1e-14 * np.abs(share).sum()


@pytest.mark.parametrize("shape", [LME, LINEAR], ids=["lme", "linear"])
@pytest.mark.parametrize("dim", [2, 3])
def test_uniform_fields_stay_uniform(ranks: Ranks, dim: int, shape: Tree) -> None:
    """W = df/drho, d rho/dt = 0 and d eta/dt = -L df/deta at every node, walls included.

    Round-off of W = 5, and of L kappa_eta = 10 times the gradients, over the small masses of nodes in corners.
    """
    case = small_case(dim, shape, HUANG)
    scheme, state = prepare(case, build_mesh(case, ranks), ranks)
    rho, eta = np.array(0.7), np.array([0.3, 0.2, 0.6])
    state.u[:, :4] = [rho, *eta]
    rate = rates_of(scheme, state)
    np.testing.assert_allclose(scheme.W, reference.df_drho(rho, eta, case.model), rtol=1e-12)
    np.testing.assert_allclose(rate[:, 0], 0.0, atol=1e-11)
    exact = -case.model.L * reference.df_deta(rho, eta, case.model)
    np.testing.assert_allclose(rate[:, 1:4], np.broadcast_to(exact, (len(rate), 3)), rtol=0, atol=1e-11)


@pytest.mark.parametrize("dim", [2, 3])
def test_forces_on_a_pair_are_opposite(ranks: Ranks, dim: int) -> None:
    """Equation (6) is antisymmetric at every point: forces cancel, and so do torques about a common origin."""
    case = small_case(dim, LME, HUANG)
    scheme, state = prepare(case, build_mesh(case, ranks), ranks)
    rates_of(scheme, state)
    assert (np.abs(scheme.forces[:, :dim]).max(axis=1) > 1.0).all()
    np.testing.assert_allclose(scheme.forces.sum(axis=0), 0.0, atol=1e-13 * np.abs(scheme.forces).max())


def test_a_symmetric_pair_is_pulled_along_its_axis(ranks: Ranks) -> None:
    """Mirror images: no force across the axis, no torque about the own centres, centres of mass at the centres."""
    case = parse_case({
        "domain": {"size": [16.0, 12 * np.sqrt(3) / 2]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {"centres": [[5.0, 3 * np.sqrt(3)], [11.0, 3 * np.sqrt(3)]], "radii": [3.0, 3.0]},
        "time": {"end": 1.0},
        "activation": FULL,
    })  # fmt: skip
    scheme, state = prepare(case, build_mesh(case, ranks), ranks)
    rates_of(scheme, state)
    middle = np.array(case.domain.size) / 2
    centre = scheme.moments[:, 1:] / scheme.moments[:, :1]
    np.testing.assert_allclose(centre[:, 0] + middle[0], [5.0, 11.0], atol=0.05)  # walls cut off a tail of exp(-4)
    np.testing.assert_allclose(centre[:, 1], 0.0, atol=1e-13)
    assert scheme.forces[0, 0] == pytest.approx(-scheme.forces[1, 0], rel=1e-13)
    assert scheme.forces[0, 0] > 1.0  # towards the other: rho < rho_0 where the grains meet
    np.testing.assert_allclose(scheme.forces[:, 1:], 0.0, atol=1e-12)
    np.testing.assert_allclose(scheme.motion[:, 1:], 0.0, atol=1e-12)


@pytest.mark.parametrize("model", [HUANG, WANG], ids=["huang", "wang"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_rigid_translation_carries_the_centre_of_mass(ranks: Ranks, dim: int, model: Tree) -> None:
    """sum_a x_a (x) grad N_a = I: with all particles moving at c, sum_a m_a x_a d rho_a/dt gains int rho sum eta^2 c
    [wang: int rho sum eta c], and the same without rho for each eta. Exact in the discretisation: round-off.
    """
    case = small_case(dim, LME, model)
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    c = np.array([0.7, -1.3, 0.4])[:dim]
    motion = np.concatenate([c, np.zeros(scheme.motion.shape[1] - dim)])
    scheme.relax = lambda free: np.zeros_like(free)
    rest = rates_of(scheme, state)
    scheme.relax = lambda free: np.broadcast_to(motion, free.shape).copy()
    gain = scheme.d.mass[:, None] * (rates_of(scheme, state) - rest)
    N, _ = dense(scheme)
    rho, eta = N @ state.u[:, 0], N @ state.u[:, 1:4]
    swept = mesh.weights @ eta**2
    carried = mesh.weights @ (rho[:, None] * (eta**2 if model == HUANG else eta)).sum(axis=1)
    expected = np.concatenate([[carried], swept])[:, None] * c
    np.testing.assert_allclose(gain[:, :4].T @ mesh.nodes, expected, rtol=0, atol=1e-12 * np.abs(gain).sum())


@pytest.mark.parametrize("model", [HUANG, WANG], ids=["huang", "wang"])
@pytest.mark.parametrize("dim", [2, 3])
def test_relaxed_contacts_are_an_implicit_step_of_the_forces(ranks: Ranks, dim: int, model: Tree) -> None:
    """V_tau is the motion under the forces that its departure from the carried motion V_0 leaves behind after tau:
    those of rho - tau sum_c (V_c - V_0c) . grad(rho eta_c^2) [wang: grad(rho eta_c)] at the points. Both sides are
    linear in V_tau: what differs is the round-off of a solve whose condition, the free motion over the relaxed one, is
    below 1000.
    """
    case, tau = small_case(dim, LME, model, particles=2), 0.01
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    rates_of(scheme, state)
    free = scheme.motion.copy()
    carried = np.random.default_rng(3).normal(size=free.shape)
    scheme.motion = carried
    rates_of(scheme, state, tau)
    relaxed = scheme.motion.copy()
    rates_of(scheme, state)
    np.testing.assert_array_equal(scheme.motion, relaxed)
    N, dN = dense(scheme)
    u = state.u[:, :3]
    rho, eta = N @ u[:, 0], N @ u[:, 1:]
    slope, slopes = np.einsum("pnd,n->pd", dN, u[:, 0]), np.einsum("pnd,nk->pkd", dN, u[:, 1:])
    for a in range(2):
        q = eta[:, a] ** 2 if model == HUANG else eta[:, a]
        dq = 2 * eta[:, a, None] * slopes[:, a] if model == HUANG else slopes[:, a]
        V = velocity(relaxed[a] - carried[a], mesh.points - np.array(case.domain.size) / 2)
        rho = rho - tau * (V * (q[:, None] * slope + (N @ u[:, 0])[:, None] * dq)).sum(axis=1)
    later = reference.bodies(rho, eta, slopes, mesh.weights, mesh.points, case.model)
    for a in range(2):
        V = velocity(relaxed[a], mesh.points - np.array(case.domain.size) / 2)
        expected = later.velocity(a, mesh.points, case.model)
        np.testing.assert_allclose(V, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    assert np.abs(relaxed).max() < 0.5 * np.abs(free).max()


def test_the_touching_share_is_the_cut_of_a_ball() -> None:
    """In space: the part of a ball, whose volume is the cell's, on one side of a plane, by slices across the plane."""
    eta, slope, w = np.array([0.4, 0.3]), np.array([[0.05, 0.02, 0.0], [-0.02, 0.07, 0.05]]), 0.7
    gradient = eta[0] * slope[1] + eta[1] * slope[0]
    steepness, radius = np.linalg.norm(gradient), (w / (4 / 3 * np.pi)) ** (1 / 3)
    for height in (-1.2, -1.0, -0.6, -0.1, 0.0, 0.3, 0.9, 1.0, 1.2):
        level = eta.prod() - height * radius * steepness  # the plane lies `height` radii below the point
        z = np.linspace(-1.0, 1.0, 200_001)
        slices = np.pi * (1.0 - z**2) * (z > -height)
        exact = np.trapezoid(slices, z) / (4 / 3 * np.pi)
        assert touching_share(eta.prod(), gradient @ gradient, w, 3, level) == pytest.approx(exact, abs=2e-5)
        given = reference.touching_share(eta[:1], eta[1:], slope[:1], slope[1:], np.array([w]), level)
        assert given[0] == pytest.approx(exact, abs=2e-5)


def test_contact_forces_follow_a_sliding_particle_without_jumps(ranks: Ranks) -> None:
    """Points that come above the threshold one by one would give steps as large as the change over a whole spacing;
    with cells that do so by and by, the force changes in a tenth of a spacing by about a tenth of that."""
    forces = []
    for x in np.linspace(17.0, 16.0, 41):
        tree = {
            "domain": {"size": [25.0, 14.0]},
            "nodes": {"source": "triangular", "spacing": 1.0},
            "particles": {"centres": [[7.1, 7.0], [x, 7.3]], "radii": [4.8, 4.9]},
            "time": {"end": 1.0},
        }
        case = parse_case(tree)
        scheme, state = prepare(case, build_mesh(case, ranks), ranks)
        rates_of(scheme, state)
        forces.append(scheme.forces[0, 0])
    steps = np.abs(np.diff(forces))
    print(steps.max(), np.ptp(forces))
    assert np.ptp(forces) > 10.0
    assert steps.max() < 0.1 * np.ptp(forces)


def velocity(motion: Floats, x: Floats) -> Floats:
    """v + omega x r at x (p, dim), measured from the origin of the motion."""
    dim = x.shape[1]
    omega = np.array([0.0, 0.0, motion[2]]) if dim == 2 else motion[3:]
    return np.asarray(motion[:dim] + np.cross(omega, reference.in_space(x))[:, :dim])


# --- switching off


@pytest.fixture(autouse=True)
def every_point_rests_that_may(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where so many live that it does not pay."""
    monkeypatch.setattr(active, "WORTH", 1.0)


EPS = [1e-5, 1e-7]


def pack_case(shape: Tree, model: Tree = HUANG, activation: Tree = FULL) -> Case:
    """Three touching discs large enough to have a still interior, and still corners around them."""
    return parse_case({
        "domain": {"size": [58.0, 54.0]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {"centres": [[16.0, 16.0], [40.0, 16.0], [28.0, 36.5]], "radii": [12.0, 12.0, 11.8]},
        "time": {"end": 1.0},
        "shape_functions": shape,
        "model": model,
        "activation": activation,
    })  # fmt: skip


@pytest.fixture(scope="module", params=[LME, LINEAR], ids=["lme", "linear"])
def pack(request: pytest.FixtureRequest, ranks: Ranks) -> tuple[Tree, Mesh, State]:
    """The discs after t = 0.5 with everything on: interiors are still, but no longer exactly 1."""
    case = pack_case(request.param)
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    integrator = make_integrator(case, mesh)
    integrator.restart(scheme, state)
    while state.time < 0.5:
        integrator.step(scheme, state, 0.5)
    return request.param, mesh, state


def by_particle(state: State, values: Floats) -> Floats:
    """Values (n, F) in the state's slots as (n, 1 + particles)."""
    out = np.zeros((len(values), 1 + len(state.slot_of)))
    out[:, 0] = values[:, 0]
    for a, slot in enumerate(state.slot_of):
        own = state.owner[:, slot] == a
        out[own, 1 + a] = values[own, 1 + slot]
    return out


def everything(state: State) -> State:
    """The same fields with one slot per particle everywhere."""
    k = len(state.slot_of)
    u = np.zeros((len(state.u), width(k)))
    u[:, : 1 + k] = by_particle(state, state.u)
    owner = np.tile(np.arange(k, dtype=np.int32), (len(u), 1))
    return State(state.time, state.step, state.evaluations, u, owner, np.arange(k, dtype=np.int32))


def compare(
    ranks: Ranks, pack: tuple[Tree, Mesh, State], model: Tree, switches: Tree
) -> tuple[Scheme, Scheme, Floats, Floats]:
    """Two schemes on the same fields, with the switches and with everything on, and their rates by particle.

    What the first has dropped from the fields when it was made is missing in both.
    """
    shape, mesh, state = pack
    own = replace(state, u=state.u.copy(), owner=state.owner.copy(), slot_of=state.slot_of.copy())
    scheme, own = prepare(pack_case(shape, model, switches), mesh, ranks, own)
    full, same = prepare(pack_case(shape, model), mesh, ranks, everything(own))
    return scheme, full, by_particle(own, rates_of(scheme, own)), by_particle(same, rates_of(full, same))


@pytest.mark.parametrize("eps", EPS)
@pytest.mark.parametrize("model", [STILL, HUANG, WANG], ids=["still", "huang", "wang"])
def test_switching_points_off_costs_eps(ranks: Ranks, pack: tuple[Tree, Mesh, State], model: Tree, eps: float) -> None:
    """A switched-off point withholds a flux of at most L kappa_eta eps, and the reaction 12 L B eta with eta < eps/2:
    the tail of a tanh has grad eta = 2 eta / xi. Together below 100 eps. It still pays its shares of W and of the
    motion: both are exact to round-off, also at the nodes between live and still points.
    """
    switches = {"enabled": True, "few_order_parameters": False, "eps_rho": eps, "eps_eta": eps}
    scheme, full, rate, exact = compare(ranks, pack, model, switches)
    active = scheme.active
    still = np.setdiff1d(np.arange(len(rate)), active.nodes)
    assert active.live.size < 0.97 * scheme.d.shape.points
    assert still.size > 0
    np.testing.assert_allclose(scheme.W[active.nodes], full.W[active.nodes], rtol=0, atol=1e-14 * np.abs(full.W).max())
    np.testing.assert_allclose(scheme.motion, full.motion, rtol=1e-12, atol=1e-12)
    assert np.abs(rate - exact)[active.nodes].max() < 100 * eps
    assert np.abs(exact[still]).max() < 100 * eps


@pytest.mark.parametrize("eps", EPS)
@pytest.mark.parametrize("model", [STILL, HUANG, WANG], ids=["still", "huang", "wang"])
def test_few_order_parameters_cost_thirty_eps(
    ranks: Ranks, pack: tuple[Tree, Mesh, State], model: Tree, eps: float
) -> None:
    """An order parameter does not exist where it and its gradient are below 30 eps: the reaction 12 L B eta loses up to
    3600 eps, the flux L kappa_eta grad eta 300 eps times the gradients of N, 2 / h. W sees squares, 6 B eta^2.
    """
    for enabled in (False, True):
        switches = {"enabled": enabled, "few_order_parameters": True, "eps_rho": eps, "eps_eta": eps}
        scheme, full, rate, exact = compare(ranks, pack, model, switches)
        nodes = scheme.active.nodes
        assert scheme.active.owner.shape[1] == 3
        assert (scheme.active.owner < 0).any()
        assert np.abs(rate - exact)[nodes].max() < 4200 * eps
        assert np.abs(scheme.W - full.W)[nodes].max() < 10 * (30 * eps) ** 2
        np.testing.assert_allclose(scheme.motion, full.motion, rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", [STILL, HUANG, WANG], ids=["still", "huang", "wang"])
def test_mass_is_conserved_with_points_switched_off(ranks: Ranks, pack: tuple[Tree, Mesh, State], model: Tree) -> None:
    """The shares of still points to the advection are given without their sum: what live nodes get adds up to 0."""
    scheme, _, rate, _ = compare(ranks, pack, model, {})
    nodes = scheme.active.nodes
    assert nodes.size < len(rate)
    if model != STILL:
        assert scheme.active.edge_nodes.size > 0
        assert np.abs(scheme.motion).max() > 0.01
    share = scheme.d.mass[nodes] * rate[nodes, 0]
    assert abs(share.sum()) < 1e-14 * np.abs(share).sum()


def test_still_points_pay_their_shares(ranks: Ranks, pack: tuple[Tree, Mesh, State]) -> None:
    """Without them the nodes between live and still points would see a step in W, and the advection of a moving grain
    would end there: errors that do not fall with eps, a hundred times those that remain.
    """
    scheme, _, rate, exact = compare(ranks, pack, HUANG, {"few_order_parameters": False})
    edge = scheme.active.edge_nodes
    assert edge.size > 50
    error = np.abs(rate - exact)[edge].max()
    scheme.active.potential[:] = 0.0
    scheme.active.drift[:] = 0.0
    state = everything(pack[2])
    crude = np.abs(rates_of(scheme, state)[:, :4] - exact)[edge].max()
    assert error < 0.01 * crude


def test_nothing_rests_at_eps_zero(ranks: Ranks, pack: tuple[Tree, Mesh, State]) -> None:
    """Every point lives and every order parameter exists wherever it is not 0: the rates are those of all of them."""
    zero = {"eps_rho": 0.0, "eps_eta": 0.0}
    scheme, full, rate, exact = compare(ranks, pack, HUANG, zero)
    assert scheme.active.live.size == scheme.d.shape.points
    assert scheme.active.stale(scheme.active.unknowns.take(everything(pack[2]).u)) >= 0.0
    np.testing.assert_allclose(rate, exact, rtol=0, atol=1e-12 * np.abs(exact).max())
    np.testing.assert_allclose(scheme.motion, full.motion, rtol=1e-10, atol=1e-12)


def test_choosing_again_from_the_same_state_gives_the_same(ranks: Ranks) -> None:
    """A resumed run chooses the live points of its reference state again, and must come to the same set and owners."""
    mesh = build_mesh(pack_case(LME), ranks)
    _, whole = prepare(pack_case(LME), mesh, ranks)
    scheme, state = prepare(pack_case(LME, activation={}), mesh, ranks, whole)
    first, u, before = scheme.active, state.u.copy(), scheme.before
    assert not np.array_equal(before.u, u)  # tails were cut
    again = replace(before, u=before.u.copy(), owner=before.owner.copy(), slot_of=before.slot_of.copy())
    scheme.activate(again)
    np.testing.assert_array_equal(again.u, u)
    np.testing.assert_array_equal(again.owner, state.owner)
    np.testing.assert_array_equal(scheme.active.live, first.live)
    np.testing.assert_array_equal(scheme.active.owner, first.owner)
    np.testing.assert_array_equal(scheme.active.blocks.owner, first.blocks.owner)


# --- the equations descend the free energy


@pytest.mark.parametrize("dim", [2, 3])
def test_free_energy_agrees_with_the_reference(ranks: Ranks, dim: int) -> None:
    """One sum over the points in another order."""
    case = small_case(dim, LME, STILL)
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    disturb(state, 3)
    exact = reference.free_energy(state.u[:, 0], state.u[:, 1:4], *dense(scheme), mesh.weights, case.model)
    assert free_energy(scheme.d, state.u) == pytest.approx(exact, rel=1e-13)


def test_free_energy_of_more_particles_than_a_word_has_bits(ranks: Ranks) -> None:
    """72 discs with a column each, also in blocks that see fewer of them than there are."""
    centres = [[1.7 + 3.4 * i, 1.6 + 3.3 * j] for i in range(9) for j in range(8)]
    case = parse_case({
        "domain": {"size": [30.6, 26.5]},
        "nodes": {"source": "triangular", "spacing": 0.85},
        "particles": {"centres": centres, "radii": [1.5] * 72, "interface_width": 0.5},
        "time": {"end": 1.0},
        "activation": FULL,
    })  # fmt: skip
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    exact = reference.free_energy(state.u[:, 0], state.u[:, 1:73], *dense(scheme), mesh.weights, case.model)
    assert len(scheme.d.blocks.points) > 100
    assert free_energy(scheme.d, state.u) == pytest.approx(exact, rel=1e-13)


@pytest.mark.parametrize("dim", [2, 3])
def test_potentials_are_the_slopes_of_the_free_energy(ranks: Ranks, dim: int) -> None:
    """(24) is m_a W_a = dF/d rho_a, and (21) without motion m_a d eta_a/dt = -L dF/d eta_a. F is of degree four in each
    nodal value: five-point differences with steps of 1/4 are exact, up to the round-off of F, 1e-16 of some thousand.
    """
    case = small_case(dim, LME, STILL)
    scheme, state = prepare(case, build_mesh(case, ranks), ranks)
    disturb(state, 3)
    rate, h = rates_of(scheme, state), 0.25
    for node in np.random.default_rng(1).choice(len(rate), 8, replace=False):
        m = scheme.d.mass[node]
        for column, exact in enumerate([m * scheme.W[node], *(-m * rate[node, 1:4] / case.model.L)]):
            F = []
            for k in (-2, -1, 1, 2):
                moved = state.u.copy()
                moved[node, column] += k * h
                F.append(free_energy(scheme.d, moved))
            assert (8 * (F[2] - F[1]) - (F[3] - F[0])) / (12 * h) == pytest.approx(exact, rel=1e-9, abs=1e-10)


@pytest.mark.parametrize("dim", [2, 3])
def test_free_energy_falls(ranks: Ranks, dim: int) -> None:
    """Without motion dF/dt = -int D |grad W|^2 - L sum_a (dF/d eta_a)^2 / m_a: the balance is that of the model."""
    case = small_case(dim, LME, STILL)
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    rate = rates_of(scheme, state)
    N, dN = dense(scheme)
    u, m, L = state.u[:, :4], scheme.d.mass, case.model.L
    D = reference.mobility(N @ u[:, 0], N @ u[:, 1:], case.model)
    slope = np.einsum("pnd,n->pd", dN, scheme.W)
    lost = mesh.weights @ (D * (slope**2).sum(axis=1)) + (m @ rate[:, 1:4] ** 2).sum() / L
    gained = (m * scheme.W) @ rate[:, 0] - (m @ rate[:, 1:4] ** 2).sum() / L
    assert gained == pytest.approx(-lost, rel=1e-12)
    assert lost > 1.0
    before, dt = free_energy(scheme.d, state.u), 1e-6
    after = free_energy(scheme.d, state.u + dt * rate)
    assert (after - before) / dt == pytest.approx(-lost, rel=1e-2)  # up to dt times the stiffest part, 120 to 1000
