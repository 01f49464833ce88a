"""The run between its output times: which they are, who hears of them, and what is said when it goes wrong."""

import math
import re
from typing import Any

import launching
import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from frit.solver.arrays import Floats
from frit.solver.case import Case, parse_case
from frit.solver.geometry import Mesh
from frit.solver.integrators import Integrator
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh, make_integrator, prepare
from frit.solver.run import PRESSED, Ending, Event, RunError, check, events, piled_up, run
from frit.solver.scheme import Scheme
from frit.solver.state import State


def discs(model: dict[str, Any] | None = None, output: dict[str, Any] | None = None, **time: Any) -> Case:
    """Two touching discs of 3 nm: a few milliseconds per step."""
    return parse_case({
        "domain": {"size": [17.0, 10.0]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {"centres": [[5.2, 5.0], [11.3, 5.0]], "radii": [3.0, 3.2]},
        "time": {"end": 1.0} | time,
        "model": model or {},
        "output": output or {},
    })  # fmt: skip


def start(case: Case, ranks: Ranks) -> tuple[Mesh, Scheme, State]:
    mesh = build_mesh(case, ranks)
    return mesh, *prepare(case, mesh, ranks)


# --- output times


def test_history_and_snapshots_at_one_time_are_one_event() -> None:
    """Four rows and three snapshots, one of them at a time of its own."""
    case = discs(output={"history_every": 0.25, "snapshots": [0.0, 0.6, 1.0]})
    assert events(case) == [
        Event(0.0, True, 0),
        Event(0.25, True, None),
        Event(0.5, True, None),
        Event(0.6, False, 1),
        Event(0.75, True, None),
        Event(1.0, True, 2),
    ]


def test_multiples_that_differ_in_the_last_bit_are_one_event() -> None:
    """3 * 0.1 is 0.30000000000000004: rows and snapshots reach it by different sums."""
    case = discs(end=0.9, output={"history_every": 0.1, "snapshots": [0.3, 0.6, 0.7]})
    got = events(case)
    assert [event.snapshot for event in got] == [None, None, None, 0, None, None, 1, 2, None, None]
    assert all(event.history for event in got)
    assert got[-1].time == 0.9


def test_the_end_is_an_event_where_nothing_asks_for_it() -> None:
    case = discs(output={"history_every": 0.3, "snapshots": {"every": 0.4}})
    got = events(case)
    np.testing.assert_allclose([event.time for event in got], [0.0, 0.3, 0.4, 0.6, 0.8, 0.9, 1.0], rtol=1e-15)
    assert [event.snapshot for event in got] == [0, None, 1, None, 2, None, None]
    assert [event.history for event in got] == [True, True, False, True, False, True, True]


@given(st.floats(0.1, 1e4), st.floats(0.003, 2.0), st.floats(0.01, 2.0))
@settings(deadline=None)
def test_events_of_any_case(end: float, row: float, snapshot: float) -> None:
    """Whatever the intervals: from 0 to the end, apart, nothing missing, nothing twice."""
    case = discs(end=end, output={"history_every": row * end, "snapshots": {"every": snapshot * end}})
    got = events(case)
    times = np.array([event.time for event in got])
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(end, rel=1e-9)
    assert (np.diff(times) > 1e-9 * end).all()
    assert got[0].history
    assert got[-1].history
    numbers = [event.snapshot for event in got if event.snapshot is not None]
    assert numbers == list(range(math.floor(1 / snapshot + 1e-12) + 1))
    # A row at every multiple, at the end, and nowhere else.
    rows = np.array([event.time for event in got if event.history])
    wanted = np.append(np.arange(math.floor(1 / row + 1e-9) + 1) * row * end, end)
    assert (np.abs(rows[:, None] - wanted).min(axis=0) <= 2e-9 * end).all()
    assert (np.abs(rows[:, None] - wanted).min(axis=1) <= 2e-9 * end).all()


# --- the observer


class Log:
    """Writes down what it hears; asks for the end after some steps."""

    def __init__(self, stop: int = 10**9) -> None:
        self.stop, self.steps = stop, 0
        self.rows: list[float] = []
        self.numbers: list[tuple[int, float]] = []
        self.fields: dict[float, Floats] = {}

    def history(self, scheme: Scheme, state: State, u: Floats, time: float) -> None:
        self.rows.append(time)
        self.fields[time] = u.copy()

    def snapshot(self, number: int, scheme: Scheme, state: State, u: Floats, time: float) -> None:
        self.numbers.append((number, time))

    def after_step(self, scheme: Scheme, state: State, integrator: Integrator) -> bool:
        self.steps += 1
        return self.steps >= self.stop


OUTPUT = {"history_every": 0.03, "snapshots": [0.0, 0.05, 0.1]}
INTEGRATORS = [{"integrator": "rk2", "step": 5e-4}, {"integrator": "adaptive"}]


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=["rk2", "adaptive"])
def test_the_observer_hears_of_every_event_in_order(ranks: Ranks, integrator: dict[str, Any]) -> None:
    case = discs(output=OUTPUT, end=0.1, **integrator)
    mesh, scheme, state = start(case, ranks)
    log = Log()
    assert run(scheme, state, make_integrator(case, mesh), log) is Ending.DONE
    np.testing.assert_allclose(log.rows, [0.0, 0.03, 0.06, 0.09, 0.1], rtol=1e-12)
    np.testing.assert_allclose([time for _, time in log.numbers], [0.0, 0.05, 0.1], rtol=1e-12)
    assert [number for number, _ in log.numbers] == [0, 1, 2]
    assert state.time == 0.1
    np.testing.assert_array_equal(log.fields[log.rows[-1]], state.u)


def test_fields_between_adaptive_steps_are_those_of_the_time(ranks: Ranks) -> None:
    """Against rk2, whose steps end at the output times. Contacts relax within 0.05, here at speeds of some nm per unit:
    rk2 is then wrong by 5e-4 (seen with shorter steps), and the adaptive contacts, which lag by 0.001, by 1.5e-3.
    """
    logs = []
    methods: list[dict[str, Any]] = [{"integrator": "rk2", "step": 1e-4}, {"tolerance": 1e-4}]
    for integrator in methods:
        case = discs(output=OUTPUT, end=0.1, **integrator)
        mesh, scheme, state = start(case, ranks)
        logs.append(Log())
        assert run(scheme, state, make_integrator(case, mesh), logs[-1]) is Ending.DONE
        assert scheme.active.owner.shape[1] == 2
    for ours, theirs in zip(logs[0].rows, logs[1].rows, strict=True):
        np.testing.assert_allclose(logs[0].fields[ours], logs[1].fields[theirs], rtol=0, atol=3e-3)


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=["rk2", "adaptive"])
def test_a_run_that_is_ended_goes_on_where_it_was(ranks: Ranks, integrator: dict[str, Any]) -> None:
    """The second call gives the events that the first has not."""
    case = discs(output=OUTPUT, end=0.1, **integrator)
    mesh, scheme, state = start(case, ranks)
    first, second = Log(stop=4), Log()
    method = make_integrator(case, mesh)
    assert run(scheme, state, method, first) is Ending.STOPPED
    assert 0.0 < state.time < 0.1
    assert run(scheme, state, method, second) is Ending.DONE
    np.testing.assert_allclose(first.rows + second.rows, [0.0, 0.03, 0.06, 0.09, 0.1], rtol=1e-12)
    assert [number for number, _ in first.numbers + second.numbers] == [0, 1, 2]


def test_who_asks_for_the_end_at_the_end_gets_a_finished_run(ranks: Ranks) -> None:
    case = discs(end=0.002, integrator="rk2", step=0.001)
    mesh, scheme, state = start(case, ranks)
    assert run(scheme, state, make_integrator(case, mesh), Log(stop=101)) is Ending.DONE
    assert state.time == 0.002


# --- fields that have lost their meaning

CAUSE = "the time step is too long for the interface: choose a smaller time.step or time.tolerance"
STIFF = ", or the rigid motion is too stiff for it: choose a smaller model.m_t"
MESSAGE = re.compile(
    r"at t = (?P<time>[-\d.e]+), step (?P<step>\d+), at \((?P<place>[-\d., ]+)\) nm: "
    r"rho = (?P<rho>\S+?)(?P<eta>(, eta of particle \d+ = \S+?)*) left \[-0\.5, 1\.5\]; likely cause: (?P<cause>.*)"
)


@pytest.mark.parametrize("rigid", [False, True])
def test_a_step_far_too_long_ends_with_time_place_and_cause(ranks: Ranks, rigid: bool) -> None:
    """0.1 is 20 times the paper's step, and three times the limit of stability even without rigid motion, 4 / 120.

    Fields leave [-0.5, 1.5] within a few steps, long before they overflow.
    """
    case = discs({"rigid_motion": rigid}, {"history_every": 1.0}, integrator="rk2", step=0.1)
    mesh, scheme, state = start(case, ranks)
    with pytest.raises(RunError) as failure:
        run(scheme, state, make_integrator(case, mesh), Log())
    said = MESSAGE.fullmatch(str(failure.value))
    assert said, str(failure.value)
    assert float(said["time"]) == pytest.approx(state.time, rel=1e-5)
    assert int(said["step"]) == state.step >= 1
    assert said["cause"] == CAUSE + (STIFF if rigid else "")
    place = [float(x) for x in said["place"].split(",")]
    fields = shape_at(mesh, place) @ state.u  # the field, not what a node holds
    assert float(said["rho"]) == pytest.approx(fields[0], rel=1e-2)
    named = {int(a): float(value) for a, value in re.findall(r"eta of particle (\d+) = ([^\s,]+)", said["eta"])}
    assert named.keys() <= {0, 1}
    assert all(named[a] == pytest.approx(fields[1 + state.slot_of[a]], rel=1e-2, abs=1e-3) for a in named)
    assert not all(-0.5 <= value <= 1.5 for value in (float(said["rho"]), *named.values()))


def shape_at(mesh: Mesh, place: list[float]) -> Floats:
    """The functions of all nodes at a place of two discs' lattice; places are told to a thousandth."""
    return reference.lme(np.array(place), mesh.nodes, 1.0, 1.8, 1e-6)[0]


def around(scheme: Scheme, state: State, place: tuple[float, float], column: int, value: float) -> None:
    """Set a coefficient to the value at all nodes within 5 nm: so is the field within about 2 nm, and every field of
    that kind owns what it holds."""
    near = np.linalg.norm(scheme.d.positions - place, axis=1) < 5.0
    state.u[near, column] = value
    if column:
        state.owner[near, column - 1] = np.flatnonzero(state.slot_of == column - 1)[0]
    scheme.activate(state)
    state.u[near, column] = value  # what no point sees has been set to zero


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_single_value_that_is_no_number_is_found(ranks: Ranks, value: float, column: int) -> None:
    _, scheme, state = start(discs(), ranks)
    there = state.owner[:, column - 1] >= 0 if column else np.ones(len(state.u), dtype=bool)
    node = int(np.flatnonzero(there)[41])
    state.u[node, column] = value
    with np.errstate(invalid="ignore"), pytest.raises(RunError, match="step 0, at ") as failure:  # inf - inf
        check(scheme, state, scheme.active.unknowns.take(state.u))
    place = [float(x) for x in re.findall(r"at \((.*)\) nm", str(failure.value))[0].split(",")]
    assert np.linalg.norm(scheme.d.positions[node] - place) < 2.8  # in range of the node


@pytest.mark.parametrize("value", [1.51, -0.51])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_field_that_is_out_of_range_is_found(ranks: Ranks, value: float, column: int) -> None:
    _, scheme, state = start(discs(), ranks)
    around(scheme, state, (8.25, 5.0), column, value)
    with pytest.raises(RunError, match=re.escape("left [-0.5, 1.5]")):
        check(scheme, state, scheme.active.unknowns.take(state.u))


@pytest.mark.parametrize("value", [2.5, -1.5])
def test_a_coefficient_is_not_the_field(ranks: Ranks, value: float) -> None:
    """A node's function is at most 0.28 anywhere inside: one value far out leaves the field in range."""
    _, scheme, state = start(discs(), ranks)
    node = int(np.argmin(np.linalg.norm(scheme.d.positions - (8.25, 5.0), axis=1)))
    state.u[node, 0] = value
    fields = scheme.d.sample(state.u)[:, 0]
    assert -0.5 < fields.min() < fields.max() < 1.5
    check(scheme, state, scheme.active.unknowns.take(state.u))


def test_values_at_the_limits_pass(ranks: Ranks) -> None:
    """Within round-off of a sum of a few dozen."""
    _, scheme, state = start(discs(), ranks)
    check(scheme, state, scheme.active.unknowns.take(state.u))
    for place, column, value in [((8.25, 5.0), 0, 1.5), ((8.25, 5.0), 1, -0.5), ((0.0, 5.0), 0, 2.999)]:
        _, scheme, state = start(discs(), ranks)
        around(scheme, state, place, column, value * (1.0 - 1e-12))
        if value > 1.5:  # only at the wall
            state.u[scheme.d.positions[:, 0] > 0.9, 0] = np.minimum(state.rho[scheme.d.positions[:, 0] > 0.9], 1.0)
        check(scheme, state, scheme.active.unknowns.take(state.u))


@pytest.mark.parametrize(("column", "value"), [(0, 3.01), (0, -0.51), (1, 1.51)])
def test_there_are_limits_at_walls_too(ranks: Ranks, column: int, value: float) -> None:
    _, scheme, state = start(discs(), ranks)
    around(scheme, state, (0.0, 5.0), column, value)
    if value > 3.0:  # only at the wall
        inner = scheme.d.positions[:, 0] > 0.9
        state.u[inner, 0] = np.minimum(state.rho[inner], 1.0)
        state.u[~inner, 0] = np.where(state.rho[~inner] > 1.0, 9.0, state.rho[~inner])
    limits = rf"\[-0\.5, 3\]; likely cause: {PRESSED}, or" if value > 3.0 else r"\[-0\.5, 1\.5\]; likely cause:"
    with pytest.raises(RunError, match=rf"at \(0\.\d+, .* left {limits} {CAUSE}"):
        check(scheme, state, scheme.active.unknowns.take(state.u))


def test_walls_are_the_points_within_a_spacing(ranks: Ranks) -> None:
    mesh, scheme, _ = start(discs(), ranks)
    x, y = mesh.points.T
    near = np.minimum.reduce([x, 17.0 - x, y, 10.0 - y]) <= mesh.spacing.max()
    np.testing.assert_array_equal(scheme.d.at_wall, near)
    assert 0 < near.sum() < 0.6 * len(near)


class Pressed(Log):
    """Writes down the largest rho, and what is said of it, at history times."""

    def __init__(self) -> None:
        super().__init__()
        self.most: list[float] = []
        self.said: list[str | None] = []

    def history(self, scheme: Scheme, state: State, u: Floats, time: float) -> None:
        self.most.append(float(scheme.d.sample(state.u)[:, 0].max()))
        self.said.append(piled_up(scheme, state))


def test_a_particle_pressed_against_a_wall_is_no_failure(ranks: Ranks) -> None:
    """There rho rises and falls."""
    case = parse_case(launching.PRESSED | {"time": {"end": 1.2}})
    mesh, scheme, state = start(case, ranks)
    mass = scheme.d.mass @ state.rho
    log = Pressed()
    assert run(scheme, state, make_integrator(case, mesh), log) is Ending.DONE
    most = np.array(log.most)
    assert 1.5 < most.max() < 3.0
    assert most[0] <= 1.01
    assert most[-1] < most.max() - 0.05
    assert [text is not None for text in log.said] == (most > 1.5).tolist()
    texts = [text for text in log.said if text]
    assert all(re.fullmatch(rf"at t = .* at \((0|15)\.\d+, .*\) nm: rho = .*: {PRESSED}", text) for text in texts)
    assert scheme.d.mass @ state.rho == pytest.approx(mass, rel=1e-12)
