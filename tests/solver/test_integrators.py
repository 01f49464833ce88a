"""Steps in time: what one step is, how errors fall with it, where it is stable, and the values in between."""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import Chebyshev as Series
from numpy.polynomial import Polynomial
from simulate import rates_of

from frit.solver.arrays import Floats, Integers
from frit.solver.case import Case, parse_case
from frit.solver.integrators import RK2, Chebyshev, coefficients, contact_time, paper_step
from frit.solver.partition import Halo, Ranks
from frit.solver.prepare import build_mesh, make_integrator, prepare
from frit.solver.scheme import Scheme
from frit.solver.state import State
from frit.solver.unknowns import OWNED, lay_out

Field = Callable[[Floats], Floats]
ANY = 1e9  # a tolerance that lets every step pass


class Problem:
    """Stands in for a Scheme: du/dt = f(u) with a known solution, of which an integrator sees nothing but this."""

    def __init__(self, f: Field, nodes: int, columns: int) -> None:
        self.f = f
        everywhere = np.arange(nodes)
        self.d = SimpleNamespace(mass=np.ones(nodes), share=SimpleNamespace(ranks=Ranks(), nodes=everywhere))
        self.relax = None
        self.only(everywhere, columns)

    def only(self, changing: Integers, columns: int = 1) -> None:
        """From now on only these nodes change."""
        owner = np.zeros((self.d.mass.size, columns - 1), dtype=np.int32)
        kind = np.full(self.d.mass.size, OWNED)
        self.active = SimpleNamespace(unknowns=lay_out(changing, owner, kind, Halo(Ranks(), self.d.mass.size, [])))

    case = None
    ranks = property(lambda self: self.d.share.ranks)
    vector, keep, at, squares = Scheme.vector, Scheme.keep, Scheme.at, Scheme.squares
    step_error, scramble = Scheme.step_error, Scheme.scramble

    def rates(self, y: Floats, rate: Floats, tau: float | None = None) -> None:
        """Nothing touches here: tau means nothing."""
        places, fields = self.active.unknowns, np.zeros((self.d.mass.size, 8))
        rate[:] = places.take(self.f(places.put(fields, y)))


def start(f: Field, u: Floats) -> tuple[Any, State]:
    """The problem, and its state at t = 0: u (n,) or (n, columns), other columns zero."""
    given = u if u.ndim == 2 else u[:, None]
    fields = np.zeros((len(u), 8))
    fields[:, : given.shape[1]] = given
    none = np.full((len(u), 0), -1, dtype=np.int32)
    return Problem(f, *given.shape), State(0.0, 0, 0, fields, none, np.empty(0, dtype=np.int32))


def decay(u: Floats) -> Floats:
    """u' = -u^2: u = u_0 / (1 + u_0 t)."""
    return -(u**2)


VALUES = np.linspace(0.2, 2.0, 10)


def discs(**time: Any) -> Case:
    return parse_case({
        "domain": {"size": [17.0, 10.0]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {"centres": [[5.2, 5.0], [11.3, 5.0]], "radii": [3.0, 3.2]},
        "time": {"end": 1.0} | time,
    })  # fmt: skip


# --- rk2


def test_rk2_is_two_half_euler_steps(ranks: Ranks) -> None:
    """Equation (32) as printed, by hand on the real scheme. A multiply-add rounds once where numpy rounds twice."""
    case = discs()
    scheme, state = prepare(case, build_mesh(case, ranks), ranks)
    own, dt = replace(state, u=state.u.copy()), 1e-3
    for _ in range(2):
        own.u += 0.5 * dt * rates_of(scheme, own)
    integrator = RK2(dt)
    integrator.restart(scheme, state)
    integrator.step(scheme, state, dt)
    np.testing.assert_allclose(state.u, own.u, rtol=1e-14, atol=1e-16)
    assert (state.time, state.step, state.evaluations) == (dt, 1, 2)


def test_rk2_is_of_first_order() -> None:
    """Two half Euler steps are Euler with half the step: errors halve with it, up to the next order."""
    errors, steps = [], (0.02, 0.01, 0.005)
    for dt in steps:
        problem, state = start(decay, VALUES)
        integrator = RK2(dt)
        integrator.restart(problem, state)
        while state.time < 1.0:
            integrator.step(problem, state, 1.0)
        errors.append(np.abs(state.u[:, 0] - VALUES / (1 + VALUES)).max())
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("z", "grows"), [(3.9, False), (4.1, True)])
def test_rk2_is_stable_up_to_four(z: float, grows: bool) -> None:
    """u' = -z u with dt = 1: a factor (1 - z / 2)^2 per step."""
    problem, state = start(lambda u: -z * u, np.ones(2))
    integrator = RK2(1.0)
    integrator.restart(problem, state)
    for end in range(1, 6):
        integrator.step(problem, state, float(end))
    np.testing.assert_allclose(state.u[:, 0], (1 - z / 2) ** 10, rtol=1e-13)
    assert bool(state.u[0, 0] > 1.0) is grows


@pytest.mark.parametrize(("dt", "count"), [(0.25, 4), (0.3, 4), (0.1, 10), (2.0, 1), (1 / 3, 3)])
def test_rk2_ends_at_the_limit_in_equal_steps_of_at_most_dt(dt: float, count: int) -> None:
    problem, state = start(decay, VALUES)
    integrator = RK2(dt)
    integrator.restart(problem, state)
    times = [0.0]
    while state.time < 1.0:
        integrator.step(problem, state, 1.0)
        times.append(state.time)
    assert times[-1] == 1.0
    np.testing.assert_allclose(np.diff(times), 1.0 / count, rtol=1e-12)
    assert state.evaluations == 2 * count
    np.testing.assert_array_equal(integrator.at(problem, state, 1.0), state.u)


def test_the_papers_step(ranks: Ranks) -> None:
    """0.1 d_min^2 / (2 L kappa_eta) with L = 10, kappa_eta = 1: 0.005 at 1 nm. Contacts may relax in half of it."""
    case = discs(integrator="rk2")
    assert paper_step(1.0, case) == pytest.approx(0.005, rel=1e-15)
    assert paper_step(0.5, case) == pytest.approx(0.00125, rel=1e-15)
    integrator = make_integrator(case, build_mesh(case, ranks))
    assert isinstance(integrator, RK2)
    assert integrator.dt == pytest.approx(0.005, rel=1e-15)
    for tolerance, tau in [(1e-3, 0.0025), (1e-4, 0.00025)]:
        case = discs(tolerance=tolerance)
        adaptive = make_integrator(case, build_mesh(case, ranks))
        assert isinstance(adaptive, Chebyshev)
        assert adaptive.tolerance == tolerance
        assert adaptive.tau == adaptive.least_tau == contact_time(1.0, case) == pytest.approx(tau, rel=1e-14)


# --- the Chebyshev method: its polynomial


def stability(stages: int) -> Any:
    """P_s(z): what s stages make of u' = z u with dt = 1, as `coefficients` says."""
    one, z = Polynomial([1.0]), Polynomial([0.0, 1.0])
    rows = coefficients(stages, 1.0)
    before, last = one, one + rows[0, 4] * z
    for c in rows[1:]:
        before, last = last, c[0] * one + c[1] * last + c[2] * before + c[3] * z * last + c[4] * z
    return last


def value(stages: int, z: Floats) -> Floats:
    """P_s(z) by the recurrence at given z: the powers of a polynomial of high degree lose all digits."""
    rows = coefficients(stages, 1.0)
    before, last = np.ones_like(z), 1.0 + rows[0, 4] * z
    for c in rows[1:]:
        before, last = last, c[0] + c[1] * last + c[2] * before + c[3] * z * last + c[4] * z
    return np.asarray(last)


def published(stages: int, z: Floats) -> Floats:
    """P_s(z) = 1 - b T_s(w_0) + b T_s(w_0 + w_1 z), b = T_s'' / T_s'^2, w_1 = T_s' / T_s'' at w_0 = 1 + 2 / (13 s^2).

    Sommeijer, Shampine and Verwer (1997), section 2, with numpy's Chebyshev series.
    """
    T, w0 = Series.basis(stages), 1.0 + 2.0 / (13.0 * stages**2)
    first, second = T.deriv(1)(w0), T.deriv(2)(w0)
    b = second / first**2
    return np.asarray(1.0 - b * T(w0) + b * T(w0 + first / second * z))


@pytest.mark.parametrize("stages", range(2, 13))
def test_the_polynomial_is_of_second_order(stages: int) -> None:
    """P_s = 1 + z + z^2 / 2 + ..., of degree s. Sums of s terms."""
    c = np.asarray(stability(stages).coef, dtype=float)
    np.testing.assert_allclose(c[:3], [1.0, 1.0, 0.5], rtol=0, atol=1e-14 * stages**2)
    assert len(c) == stages + 1
    assert c[-1] != 0.0


@pytest.mark.parametrize("stages", [2, 3, 4, 5, 8, 13, 21, 50])
def test_the_recurrence_gives_the_published_polynomial(stages: int) -> None:
    """Rounding grows with s^2 in the three-term recurrence: that is the method's own bound."""
    z = -np.linspace(0.0, 0.65 * (stages**2 - 1), 400)
    np.testing.assert_allclose(value(stages, z), published(stages, z), rtol=0, atol=2e-14 * stages**2)


@pytest.mark.parametrize("stages", range(2, 51))
def test_the_method_is_stable_and_damped_on_a_long_strip(stages: int) -> None:
    """|P_s| <= 1 on [-0.65 (s^2 - 1), 0], where w_0 + w_1 z >= -1. Once w_0 + w_1 z <= 1, at z = -0.05 or so,
    P_s <= 1 - b (T_s(w_0) - 1) = 0.95: b = 1 / 3 and T_s(w_0) - 1 = 2 / 13, up to terms of 1 / s^2.
    """
    z = -np.linspace(0.0, 0.65 * (stages**2 - 1), 2001)
    P = np.abs(value(stages, z))
    assert P.max() <= 1.0 + 1e-12
    assert P[z < -0.2].max() < 0.97


# --- the Chebyshev method: steps


def forced_step(integrator: Chebyshev, problem: Any, state: State, dt: float, radius: float) -> None:
    """One step of this length with the number of stages that this spectral radius asks for."""
    integrator.dt, integrator.radius, integrator.age = dt, radius, 1.0
    integrator.step(problem, state, 1e9)


@pytest.mark.parametrize(("radius", "stages"), [(1.0, 2), (30.0, 7), (300.0, 22), (3000.0, 68)])
def test_a_step_multiplies_by_the_polynomial(radius: float, stages: int) -> None:
    """u' = -lambda u for lambda up to the radius, dt = 1; s evaluations, and one for the rate at the start."""
    rates = np.linspace(0.0, radius, 40)
    problem, state = start(lambda u: -rates[:, None] * u, np.ones(40))
    integrator = Chebyshev(ANY, 0.0)
    integrator.restart(problem, state)
    forced_step(integrator, problem, state, 1.0, radius)
    assert state.evaluations == stages + 1
    np.testing.assert_allclose(state.u[:, 0], published(stages, -rates), rtol=0, atol=2e-14 * stages**2)
    assert not state.u[:, 1:].any()


@pytest.mark.parametrize("stages", [2, 6, 25])
def test_it_is_of_second_order_on_a_smooth_problem(stages: int) -> None:
    """Errors at t = 1 of u' = -u^2 with steps of that many stages; three of them bend the fit by less than 0.1."""
    errors, steps = [], np.array([1 / 16, 1 / 32, 1 / 64])
    for dt in steps:
        problem, state = start(decay, VALUES)
        integrator = Chebyshev(ANY, 0.0)
        integrator.restart(problem, state)
        for _ in range(round(1 / dt)):
            forced_step(integrator, problem, state, dt, ((stages - 0.5) ** 2 - 1) / 1.54 / dt)
        assert state.evaluations == 1 + stages * round(1 / dt)
        errors.append(np.abs(state.u[:, 0] - VALUES / (1 + VALUES)).max())
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2.0, abs=0.1)


def heat(nodes: int) -> tuple[Field, Field]:
    """u' = u_xx on a ring of unit length, radius 4 n^2, and its solution at t = 0.01 from the fields at 0."""
    laplacian = nodes**2 * (np.roll(np.eye(nodes), 1, 0) + np.roll(np.eye(nodes), -1, 0) - 2 * np.eye(nodes))
    eigenvalues, vectors = np.linalg.eigh(laplacian)

    def later(u: Floats) -> Floats:
        return np.asarray(vectors * np.exp(np.maximum(0.01 * eigenvalues, -600.0)) @ vectors.T @ u)

    return lambda u: laplacian @ u, later


def marched(f: Field, u: Floats, end: float, integrator: Chebyshev) -> State:
    problem, state = start(f, u)
    integrator.restart(problem, state)
    while state.time < end:
        integrator.step(problem, state, end)
    assert state.time == end
    return state


def test_errors_fall_with_the_tolerance() -> None:
    """An error of dt^3 per step is held at the tolerance, so that of dt^2 at the end goes with its power of 2/3: 0.5 to
    0.9 for steps that change their length on the way. A bump spreads on a ring of 100 nodes, |lambda| = 40000.
    """
    x = np.arange(100) / 100
    bump = np.exp(-200 * (x - 0.5) ** 2)
    f, later = heat(100)
    tolerances, errors, work = [1e-2, 1e-3, 1e-4, 1e-5], [], []
    for tolerance in tolerances:
        state = marched(f, bump, 0.01, Chebyshev(tolerance, 0.0))
        errors.append(np.abs(state.u[:, 0] - later(bump)).max())
        work.append(state.evaluations)
    assert errors == sorted(errors, reverse=True)
    assert work == sorted(work)
    assert (np.array(errors) < 3 * np.array(tolerances) ** (2 / 3)).all()
    assert 0.5 < np.polyfit(np.log(tolerances), np.log(errors), 1)[0] < 0.9
    assert work[0] < 0.01 * 40000 / 2  # explicit Euler needs dt < 2 / |lambda|


def test_the_spectral_radius_is_found() -> None:
    """The power method ends within 1 % of the largest rate from below, or nearly; a margin of 1.2 is put on top."""
    rates = np.linspace(0.0, 300.0, 50)
    problem, state = start(lambda u: -rates[:, None] * u, np.ones(50))
    integrator = Chebyshev(1e-3, 0.0)
    integrator.restart(problem, state)
    integrator.step(problem, state, 1.0)
    assert 300.0 < integrator.radius < 1.21 * 300.0


def test_a_step_that_is_far_too_long_is_tried_again() -> None:
    """What a refused trial has done to the fields must not remain in them."""
    state = marched(decay, VALUES, 1.0, Chebyshev(1e-4, 0.0, {"dt": 1.0, "radius": 4.0}))
    assert state.step > 3
    np.testing.assert_allclose(state.u[:, 0], VALUES / (1 + VALUES), rtol=0, atol=1e-3)


def test_no_sliver_is_left_before_the_limit() -> None:
    """A step of more than half of what remains is cut to half of it; the last one ends at the limit itself."""
    problem, state = start(decay, 1e-3 * VALUES)
    integrator = Chebyshev(ANY, 0.0)
    integrator.restart(problem, state)
    integrator.dt, integrator.radius, integrator.age = 0.8, 1.0, 1.0
    integrator.step(problem, state, 1.0)
    assert state.time == 0.5
    integrator.step(problem, state, 1.0)
    assert state.time == 1.0


def test_a_step_has_at_most_200_stages() -> None:
    problem, state = start(decay, 1e-3 * VALUES)
    integrator = Chebyshev(ANY, 0.0)
    integrator.restart(problem, state)
    forced_step(integrator, problem, state, 1.0, 1e6)
    assert state.evaluations == 1 + 200
    assert state.time == pytest.approx(0.65 * 199**2 / 1e6, rel=1e-14)


def test_memory_is_all_that_the_next_steps_need() -> None:
    """Without contacts: a new integrator with the old one's memory takes the same steps, to the last bit."""
    f, _ = heat(60)
    bump = np.exp(-200 * (np.arange(60) / 60 - 0.5) ** 2)
    problem, state = start(f, bump)
    integrator = Chebyshev(1e-4, 0.0)
    integrator.restart(problem, state)
    runs = []
    for interrupted in (False, True):
        problem, state = start(f, bump)
        integrator = Chebyshev(1e-4, 0.0)
        integrator.restart(problem, state)
        for step in range(12):
            if interrupted and step == 7:
                integrator = Chebyshev(1e-4, 0.0, integrator.memory)
                integrator.restart(problem, state)
            integrator.step(problem, state, 1.0)
        runs.append((state.time, integrator.memory, state.u))
    assert runs[0][:2] == runs[1][:2]
    np.testing.assert_array_equal(runs[0][2], runs[1][2])


# --- between the steps


def test_values_between_steps_are_exact_for_a_cubic() -> None:
    """A Hermite interpolant has four data: cubics are exact, and its ends are the fields themselves."""
    rng = np.random.default_rng(0)
    cubics = [Polynomial(c) for c in rng.uniform(-1, 1, (5, 4))]
    problem, state = start(decay, np.zeros(5))
    integrator = Chebyshev(ANY, 0.0)
    integrator.restart(problem, state)
    integrator.start, state.time = 0.3, 1.1
    for time, field, rate in ((0.3, integrator.old, integrator.rate_0), (1.1, integrator.y, integrator.rate_1)):
        field[:] = [p(time) for p in cubics]
        rate[:] = [p.deriv()(time) for p in cubics]
    for time in (0.3, 0.31, 0.7, 1.0, 1.1):
        got = integrator.at(problem, state, time)[:, 0]
        np.testing.assert_allclose(got, [p(time) for p in cubics], rtol=0, atol=1e-14)


def test_values_between_steps_are_as_good_as_the_steps() -> None:
    """u' = -u^2 at tolerance 1e-4, wherever in the steps; nodes that stand still keep their values."""
    problem, state = start(decay, VALUES)
    problem.only(np.arange(8))
    integrator = Chebyshev(1e-4, 0.0)
    integrator.restart(problem, state)
    while state.time < 1.0:
        before = state.time
        integrator.step(problem, state, 1.0)
        for time in np.linspace(before, state.time, 4):
            got = integrator.at(problem, state, float(time))[:, 0]
            np.testing.assert_allclose(got[:8], (VALUES / (1 + VALUES * time))[:8], rtol=0, atol=1e-3)
            np.testing.assert_array_equal(got[8:], VALUES[8:])


def test_nodes_that_stand_still_keep_their_values_whatever_the_stages() -> None:
    """u' = -500 u beside u' = -u: steps of few stages and of many, the spectral radius estimated once in 25 of them."""
    factors = np.where(np.arange(40) % 2, 1.0, 500.0)[:, None]
    problem, state = start(lambda u: -factors * u, np.linspace(0.2, 2.0, 40))
    problem.only(np.arange(0, 40, 3))
    still = np.setdiff1d(np.arange(40), np.arange(0, 40, 3))
    before = state.u.copy()
    integrator = Chebyshev(1e-5, 0.0)
    integrator.restart(problem, state)
    stages = set()
    while state.time < 4.0:
        done = state.evaluations
        integrator.step(problem, state, 4.0)
        stages.add(state.evaluations - done)
        for fields in (state.u, integrator.at(problem, state, state.time)):
            np.testing.assert_array_equal(fields[still], before[still])
    assert state.step > 50
    assert len(stages) > 3


def test_steps_allocate_nothing_that_grows_with_the_mesh(ranks: Ranks) -> None:
    """Once its arrays are there, a step takes less new memory than one value per node: lists, views, the few numbers of
    each particle and its contacts."""
    case = parse_case({
        "domain": {"size": [60.0, 40.0]},
        "nodes": {"source": "triangular", "spacing": 0.4},
        "particles": {"centres": [[20.0, 20.0], [40.0, 20.0]], "radii": [10.0, 10.0]},
        "time": {"end": 1.0},
    })  # fmt: skip
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    integrator = make_integrator(case, mesh)
    integrator.restart(scheme, state)
    for _ in range(2):
        integrator.step(scheme, state, 1.0)
    tracemalloc.start()
    try:
        integrator.step(scheme, state, 1.0)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    print(most, state.u[:, 0].nbytes)
    assert most < 0.5 * state.u[:, 0].nbytes
