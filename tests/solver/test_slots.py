"""Slots: particles that meet never share one, none is ever lost, and where a particle is stored changes nothing."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulate import rates_of

from frit.solver import active, slots
from frit.solver.arrays import Floats, Integers, Numbers
from frit.solver.case import Case, parse_case
from frit.solver.geometry import Mesh
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh, prepare
from frit.solver.slots import MOST_SLOTS, SlotError
from frit.solver.state import State, width

LEAST = 30  # eps_eta: below this an order parameter and its gradient do not exist, in these tests


@pytest.fixture(autouse=True)
def exists(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drop more than `active` does by itself."""
    monkeypatch.setattr(active, "LEAST", float(LEAST))


# --- colouring


@st.composite
def graphs(draw: st.DrawFn) -> tuple[Integers, int]:
    """Which of up to 14 particles meet: pairs (pairs, 2) with a < b, and the number of particles."""
    particles = draw(st.integers(1, 14))
    possible = list(combinations(range(particles), 2))
    pairs = draw(st.lists(st.sampled_from(possible), unique=True)) if possible else []
    return np.array(pairs, dtype=np.int64).reshape(-1, 2), particles


def clashes(slot_of: Numbers, pairs: Integers) -> Integers:
    return np.asarray(pairs[slot_of[pairs[:, 0]] == slot_of[pairs[:, 1]]])


@given(graphs())
@settings(deadline=None)
def test_colours_differ_where_particles_meet(graph: tuple[Integers, int]) -> None:
    """Greedy colouring needs at most one slot more than a particle has neighbours."""
    pairs, particles = graph
    slot_of = slots.colour(pairs, particles)
    assert not len(clashes(slot_of, pairs))
    most = np.bincount(pairs.ravel(), minlength=particles).max()
    assert 0 <= slot_of.min() <= slot_of.max() <= most


@given(graphs(), st.data())
@settings(deadline=None)
def test_recolouring_separates_and_moves_only_those_that_clash(
    graph: tuple[Integers, int], data: st.DataObject
) -> None:
    pairs, particles = graph
    old = np.array(data.draw(st.lists(st.integers(0, 3), min_size=particles, max_size=particles)), dtype=np.int32)
    new = slots.recolour(old, pairs)
    assert not len(clashes(new, pairs))
    moved = set(np.flatnonzero(new != old).tolist())
    assert moved <= set(clashes(old, pairs).ravel().tolist())
    if not len(clashes(old, pairs)):
        assert (new == old).all()


def test_particles_that_all_meet_fill_all_slots_and_no_more() -> None:
    everyone = np.array(list(combinations(range(MOST_SLOTS), 2)))
    assert sorted(slots.colour(everyone, MOST_SLOTS)) == list(range(MOST_SLOTS))
    one_more = np.array(list(combinations(range(MOST_SLOTS + 1), 2)))
    with pytest.raises(SlotError, match="63 particles meet at one place, at most 62 can"):
        slots.colour(one_more, MOST_SLOTS + 1)
    with pytest.raises(SlotError, match="63 particles meet"):
        slots.recolour(np.zeros(MOST_SLOTS + 1, dtype=np.int32), one_more)


@given(st.lists(st.tuples(st.integers(-1, 5), st.integers(-1, 5)), max_size=20))
@settings(deadline=None)
def test_unique_pairs(rows: list[tuple[int, int]]) -> None:
    """-1 is no particle, and nobody meets himself."""
    got = slots.unique_pairs(np.array(rows, dtype=np.int64).reshape(-1, 2))
    assert [tuple(row) for row in got.tolist()] == sorted(
        {(min(r), max(r)) for r in rows if min(r) >= 0 and r[0] != r[1]}
    )


# --- fields in slots


@st.composite
def stored(draw: st.DrawFn) -> tuple[Floats, Numbers, Numbers, Numbers]:
    """Fields u and owners of a few nodes, where particles that share a slot never meet; old and new slots."""
    pairs, particles = draw(graphs())
    old, meets = slots.colour(pairs, particles), {tuple(pair) for pair in pairs.tolist()}
    owner = np.full((6, int(old.max()) + 1), -1, dtype=np.int32)
    for row in owner:
        for a in draw(st.lists(st.integers(0, particles - 1), max_size=4, unique=True)):
            if all(b < 0 or (min(a, int(b)), max(a, int(b))) in meets for b in row):
                row[old[a]] = a
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    u = np.zeros((6, width(owner.shape[1])))
    u[:, 0] = rng.random(6)
    u[:, 1 : 1 + owner.shape[1]] = np.where(owner >= 0, rng.random(owner.shape), 0.0)
    start = np.array(draw(st.lists(st.integers(0, 9), min_size=particles, max_size=particles)), dtype=np.int32)
    return u, owner, old, slots.recolour(start, pairs)


def by_particle(u: Floats, owner: Numbers, particles: int) -> Floats:
    """rho and every particle's field (n, 1 + particles), zero where it is not stored."""
    out = np.zeros((len(u), 1 + particles))
    out[:, 0] = u[:, 0]
    for node, slot in zip(*np.nonzero(owner >= 0), strict=True):
        out[node, 1 + owner[node, slot]] = u[node, 1 + slot]
    return out


@given(stored())
@settings(deadline=None)
def test_repacking_keeps_every_field(case: tuple[Floats, Numbers, Numbers, Numbers]) -> None:
    u, owner, old, new = case
    columns = width(int(new.max()) + 1)
    new_u, new_owner = slots.repack(u, owner, new, columns)
    assert new_u.shape == (len(u), columns)
    np.testing.assert_array_equal(by_particle(new_u, new_owner, len(old)), by_particle(u, owner, len(old)))
    nodes, columns_used = np.nonzero(new_owner >= 0)
    np.testing.assert_array_equal(new[new_owner[nodes, columns_used]], columns_used)
    assert np.count_nonzero(new_owner >= 0) == np.count_nonzero(owner >= 0)


@given(stored())
@settings(deadline=None)
def test_meeting_finds_every_pair_of_the_chosen_rows(case: tuple[Floats, Numbers, Numbers, Numbers]) -> None:
    _, owner, _, _ = case
    chosen = np.array([0, 2, 3])
    rows = [sorted(a for a in row if a >= 0) for row in owner[chosen].tolist()]
    expected = sorted({pair for row in rows for pair in combinations(row, 2)})
    assert [tuple(pair) for pair in slots.unique_pairs(slots.meeting(owner, chosen)).tolist()] == expected


# --- the same rates, wherever particles are stored


def grid_case(
    across: int, radius: float, pitch: float, eps: float, few: bool, enabled: bool = False, kind: str = "lme"
) -> Case:
    """across^2 discs on a square grid."""
    centres = [[pitch * (i + 0.7), pitch * (j + 0.7) + 0.1 * i] for i in range(across) for j in range(across)]
    size = pitch * (across + 0.4) + 0.1 * across
    return parse_case({
        "domain": {"size": [size, size]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {"centres": centres, "radii": [radius] * len(centres)},
        "time": {"end": 1.0},
        "shape_functions": {"kind": kind},
        "activation": {"enabled": enabled, "few_order_parameters": few, "eps_rho": eps, "eps_eta": eps},
    })  # fmt: skip


def rates(ranks: Ranks, case: Case, mesh: Mesh, state: State | None) -> tuple[State, Floats, Integers]:
    """The state as the scheme has arranged it, its rates by particle, and the nodes that change."""
    scheme, own = prepare(case, mesh, ranks, state)
    return own, by_particle(rates_of(scheme, own), own.owner, len(own.slot_of)), scheme.active.nodes


def one_each(state: State) -> State:
    """The same fields with one slot per particle everywhere."""
    k = len(state.slot_of)
    u = np.zeros((len(state.u), width(k)))
    u[:, : 1 + k] = by_particle(state.u, state.owner, k)
    owner = np.tile(np.arange(k, dtype=np.int32), (len(u), 1))
    return replace(state, u=u, owner=owner, slot_of=np.arange(k, dtype=np.int32))


def check_rates(ranks: Ranks, few: Case, plain: Case, state: State | None, slack: float = 0.0) -> State:
    """Rates in shared slots against one slot per particle, as `test_scheme` bounds what does not exist: 4200 eps."""
    mesh = build_mesh(few, ranks)
    own, rate, nodes = rates(ranks, few, mesh, state)
    _, exact, _ = rates(ranks, plain, mesh, one_each(own))
    assert np.abs(exact).max() > 1.0
    assert np.abs(rate - exact)[nodes].max() < 4200 * few.activation.eps_eta + slack
    return own


@pytest.mark.parametrize(("eps", "least"), [(1e-5, 8), (1e-13, 16)])
@pytest.mark.parametrize("enabled", [False, True])
def test_more_particles_than_one_pack_holds(ranks: Ranks, eps: float, least: int, enabled: bool) -> None:
    """25 small discs whose tails overlap: more than 7 slots make two packs of columns, more than 15 three and more."""
    state = check_rates(
        ranks, grid_case(5, 2.0, 4.0, eps, True, enabled), grid_case(5, 2.0, 4.0, eps, False), None, 1e-10
    )
    assert state.slot_of.max() + 1 >= least
    assert state.u.shape[1] == width(int(state.slot_of.max()) + 1) >= 8 * (1 + least // 8)


def crammed(case: Case, nodes: Floats, slot_of: Numbers) -> State:
    """Initial fields in the given slots, made by hand: a node's slot belongs to the nearest of those that share it."""
    centres, radii = np.array(case.particles.centres), np.array(case.particles.radii)
    distance = np.linalg.norm(nodes[:, None] - centres, axis=2) - radii
    eta = 0.5 * (1 - np.tanh(distance))
    count = int(slot_of.max()) + 1
    u, owner = np.zeros((len(nodes), width(count))), np.full((len(nodes), count), -1, dtype=np.int32)
    u[:, 0] = np.minimum(eta.sum(axis=1), 1.0)
    for slot in range(count):
        mine = np.flatnonzero(slot_of == slot)
        if not mine.size:
            continue
        nearest = mine[distance[:, mine].argmin(axis=1)]
        value = eta[np.arange(len(nodes)), nearest]
        kept = value >= 1e-5
        u[kept, 1 + slot], owner[kept, slot] = value[kept], nearest[kept]
    return State(0.0, 0, 0, u, owner, slot_of)


def test_two_near_particles_in_one_slot_are_separated(ranks: Ranks) -> None:
    """Where they meet the slot is torn between them, a state that only a mistake could make: nothing may come of it."""
    few, plain = grid_case(2, 3.0, 6.2, 1e-5, True), grid_case(2, 3.0, 6.2, 1e-5, False)
    state = crammed(few, build_mesh(few, ranks).nodes, np.array([0, 0, 1, 2], dtype=np.int32))
    own = check_rates(ranks, few, plain, state)
    assert len(set(own.slot_of.tolist())) == 4


@pytest.mark.parametrize("seed", range(3))
def test_sixteen_particles_in_two_slots_are_separated(ranks: Ranks, seed: int) -> None:
    """One move makes the next necessary: it goes on until nobody clashes, and more slots are made on the way."""
    few, plain = grid_case(4, 2.0, 4.0, 1e-5, True), grid_case(4, 2.0, 4.0, 1e-5, False)
    slot_of = np.random.default_rng(seed).integers(0, 2, 16).astype(np.int32)
    own = check_rates(ranks, few, plain, crammed(few, build_mesh(few, ranks).nodes, slot_of))
    assert own.slot_of.max() > 1


def test_nothing_is_lost_while_particles_are_separated(ranks: Ranks) -> None:
    """Two particles stored at one node must never be dealt the same slot, even where the points around see only a third
    that shares the slot of one of them.
    """
    few = grid_case(4, 2.0, 4.0, 1e-5, True)
    mesh = build_mesh(few, ranks)
    for seed in range(6):
        state = crammed(few, mesh.nodes, np.random.default_rng(seed).integers(0, 2, 16).astype(np.int32))
        before = by_particle(state.u, state.owner, 16)
        _, own = prepare(few, mesh, ranks, state)
        assert lost(before, by_particle(own.u, own.owner, 16)) <= 5 * LEAST * 1e-5


def lost(before: Floats, after: Floats) -> float:
    """The largest value that is no longer stored; all others must be as they were."""
    gone = (after == 0.0) & (before != 0.0)
    np.testing.assert_array_equal(after[~gone], before[~gone])
    return float(np.abs(before[gone]).max(initial=0.0))


@pytest.mark.parametrize("kind", ["lme", "linear"])
def test_only_what_no_point_sees_is_dropped(ranks: Ranks, kind: str) -> None:
    """A value goes where it and its gradient are below 30 eps at all points around its node; some of them see at least
    a fifth of it at gamma = 1.8, a third with linear functions. The rest is kept to the last bit, rho everywhere.
    """
    case = grid_case(3, 3.0, 6.5, 1e-5, True, kind=kind)
    mesh = build_mesh(case, ranks)
    state = crammed(case, mesh.nodes, np.arange(9, dtype=np.int32))
    before = by_particle(state.u, state.owner, 9)
    _, own = prepare(case, mesh, ranks, state)
    after = by_particle(own.u, own.owner, 9)
    np.testing.assert_array_equal(after[:, 0], before[:, 0])
    assert lost(before, after) <= (5 if kind == "lme" else 3) * LEAST * 1e-5
    if kind == "linear":  # wider functions leave a point everywhere that sees more
        assert lost(before, after) > 0.0


def test_too_many_particles_at_one_place_are_refused(ranks: Ranks) -> None:
    """64 discs, each with a tail above 1e-13 at all others."""
    case = grid_case(8, 1.0, 2.0, 1e-13, True)
    with pytest.raises(SlotError, match="63 particles meet at one place, at most 62 can"):
        prepare(case, build_mesh(case, ranks), ranks)
