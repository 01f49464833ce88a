"""Elimination by blocks, against dense matrices that are put together block by block."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frit.solver.arrays import Floats, Integers
from frit.solver.elimination import Plan, factors, plan

Graph = tuple[Integers, int]


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    """Pairs of up to a dozen particles, in any order and either way round."""
    particles = draw(st.integers(1, 12))
    every = [(a, b) for a in range(particles) for b in range(a)]
    some = draw(st.lists(st.sampled_from(every), unique=True)) if every else []
    turned = [pair if draw(st.booleans()) else pair[::-1] for pair in some]
    return np.array(turned, dtype=np.int64).reshape(-1, 2), particles


def whole(pairs: Integers, particles: int, blocks: Floats) -> Floats:
    """I + blocks as a dense matrix."""
    k = blocks.shape[1]
    matrix = np.eye(particles * k)
    for i, (a, b) in enumerate(pairs):
        for part, (row, column) in enumerate(((a, a), (a, b), (b, a), (b, b))):
            matrix[row * k : (row + 1) * k, column * k : (column + 1) * k] += blocks[part * len(pairs) + i]
    return matrix


@given(graphs(), st.sampled_from([3, 6]), st.integers(0, 1000))
@settings(max_examples=100, deadline=None)
def test_it_solves_what_the_blocks_spell(graph: Graph, k: int, seed: int) -> None:
    """Blocks of any kind, small enough for the diagonal to dominate: round-off of a well-conditioned system."""
    (pairs, particles), rng = graph, np.random.default_rng(seed)
    blocks = rng.uniform(-1.0, 1.0, (4 * len(pairs), k, k)) * 0.5 / (k * particles)
    b = rng.standard_normal((particles, k))
    exact = np.linalg.solve(whole(pairs, particles, blocks), b.ravel()).reshape(b.shape)
    np.testing.assert_allclose(factors(plan(pairs, particles), blocks).solve(b), exact, rtol=0, atol=1e-13)


@given(graphs(), st.sampled_from([3, 6]), st.integers(0, 1000))
@settings(max_examples=100, deadline=None)
def test_stiff_contacts(graph: Graph, k: int, seed: int) -> None:
    """I + M S, M of each particle and S of springs between them positive, 1000 times stiffer than I: no exchange of
    particles is needed. The error is the round-off of so many rows times the condition; that particles are not
    exchanged costs a digit in one of a thousand such systems, two more are left to the others.
    """
    (pairs, particles), rng = graph, np.random.default_rng(seed)
    parts = np.zeros((4, len(pairs), k, k))
    mobility = rng.uniform(0.5, 2.0, particles)
    for i, (a, b) in enumerate(pairs):
        arms = [rng.standard_normal((k, k)) for _ in range(2)]
        for part, (one, other, sign) in enumerate(((0, 0, 1.0), (0, 1, -1.0), (1, 0, -1.0), (1, 1, 1.0))):
            parts[part, i] = sign * 1e3 * mobility[(a, b)[one]] * arms[one] @ arms[other].T
    blocks = parts.reshape(-1, k, k)
    matrix, b = whole(pairs, particles, blocks), rng.standard_normal((particles, k))
    exact = np.linalg.solve(matrix, b.ravel()).reshape(b.shape)
    slack = 1e3 * len(matrix) * np.finfo(float).eps * np.linalg.cond(matrix) * np.abs(exact).max()
    np.testing.assert_allclose(factors(plan(pairs, particles), blocks).solve(b), exact, rtol=0, atol=slack)


@given(graphs())
@settings(max_examples=60, deadline=None)
def test_every_particle_goes_once_and_later_ones_later(graph: Graph) -> None:
    """Each pair has the entry that names it, and so has each pair of those that a step couples."""
    pairs, particles = graph
    found = plan(pairs, particles)
    step = np.argsort(found.pivots)
    np.testing.assert_array_equal(np.sort(found.pivots), np.arange(particles))
    who = np.repeat(found.pivots, np.diff(found.first))
    assert (step[found.later] > step[who]).all()
    for (a, b), e in zip(pairs, found.place, strict=True):
        assert {a, b} == {who[e], found.later[e]}
    coupled = [
        {found.later[d], found.later[e]}
        for low, high in zip(found.first[:-1], found.first[1:], strict=True)
        for d in range(low, high)
        for e in range(d + 1, high)
    ]
    assert coupled == [{who[e], found.later[e]} for e in found.target]


@given(graphs())
@settings(max_examples=60, deadline=None)
def test_the_one_with_the_fewest_partners_is_next(graph: Graph) -> None:
    """Against the same with sets: the order, and who is left for each to be eliminated from."""
    pairs, particles = graph
    meets: list[set[int]] = [set() for _ in range(particles)]
    for a, b in pairs.tolist():
        meets[a].add(b)
        meets[b].add(a)
    found = plan(pairs, particles)
    left = set(range(particles))
    for i, pivot in enumerate(found.pivots.tolist()):
        assert pivot == min(left, key=lambda a: (len(meets[a]), a))
        assert set(found.later[found.first[i] : found.first[i + 1]].tolist()) == meets[pivot]
        left.remove(pivot)
        for b in meets[pivot]:
            meets[b] = (meets[b] | meets[pivot]) - {pivot, b}


def entries(found: Plan) -> int:
    return int(found.first[-1])


def test_few_blocks_are_filled() -> None:
    """Chains and stars fill none; a ring couples the two ends of what is left, n - 3 times; a square of 10 x 10
    neighbours two thirds of what elimination row by row would."""
    chain = np.stack([np.arange(9), np.arange(1, 10)], axis=1)
    star = np.stack([np.full(9, 4), np.setdiff1d(np.arange(10), 4)], axis=1)
    ring = np.concatenate([chain, [[9, 0]]])
    assert [entries(plan(pairs, 10)) for pairs in (chain, star, ring)] == [9, 9, 10 + 7]
    number = np.arange(100).reshape(10, 10)
    right, up = np.stack([number[:, :-1], number[:, 1:]], -1), np.stack([number[:-1], number[1:]], -1)
    assert entries(plan(np.concatenate([right.reshape(-1, 2), up.reshape(-1, 2)]), 100)) < 0.67 * 90 * 10


def test_a_system_without_solution_gives_no_numbers() -> None:
    """A block that is 0 on the diagonal: the integrator sees that the step failed, and tries a shorter one."""
    pairs, blocks = np.array([[0, 1]]), np.zeros((4, 3, 3))
    blocks[0] = blocks[3] = -np.eye(3)
    assert not np.isfinite(factors(plan(pairs, 2), blocks).solve(np.ones((2, 3)))).all()


@pytest.mark.parametrize("k", [3, 6])
def test_who_touches_nobody_keeps_what_he_has(k: int) -> None:
    b = np.random.default_rng(0).standard_normal((4, k))
    alone = factors(plan(np.empty((0, 2), dtype=np.int64), 4), np.empty((0, k, k)))
    np.testing.assert_array_equal(alone.solve(b), b)
