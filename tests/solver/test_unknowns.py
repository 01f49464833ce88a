"""The vector of unknowns: which fields it holds and where, and sums over it against obvious ones over all fields."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frit.solver import unknowns, vectors
from frit.solver.arrays import Floats, Numbers
from frit.solver.partition import Halo, Ranks
from frit.solver.simd import LANES
from frit.solver.unknowns import BLOCKS, LOOSE, OWNED, Unknowns, lay_out

NODES, SLOTS = 60, 4


class Layout:
    """Random owners and nodes that change; every third shared with rank 1, and some with rank 2."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.listed = np.flatnonzero(np.repeat(rng.random(NODES // 5) < 0.7, 5))
        parts = np.repeat(rng.integers(-1, 3, (NODES // 6, SLOTS)), 6, axis=0)
        self.owner: Numbers = (parts + 3 * np.where(parts >= 0, np.arange(SLOTS), 0)).astype(np.int32)
        self.kind = np.repeat(rng.integers(0, 8, NODES // 4), 4) | BLOCKS
        neighbours = [(rank, np.flatnonzero(rng.random(NODES) < 0.3)) for rank in (1, 2)]
        self.halo = Halo(Ranks(), NODES, neighbours)
        self.unknowns: Unknowns = lay_out(self.listed, self.owner, self.kind, self.halo)
        self.u = rng.standard_normal((NODES, 8))
        exists = np.hstack([np.ones((NODES, 1), dtype=bool), self.owner >= 0, np.zeros((NODES, 7 - SLOTS), dtype=bool)])
        exists[np.setdiff1d(np.arange(NODES), self.listed)] = False
        self.exists = exists

    def whole(self, y: Floats) -> Floats:
        """The vector as fields, 0 where it has none."""
        return self.unknowns.put(np.zeros((NODES, 8)), y)


layouts = st.integers(0, 10_000).map(Layout)


@given(layouts)
@settings(max_examples=60, deadline=None)
def test_it_holds_what_exists_and_nothing_else(layout: Layout) -> None:
    """rho at each node that changes, an order parameter where somebody has the slot; back and forth to the last bit."""
    y = layout.unknowns.take(layout.u)
    assert y.size == layout.unknowns.size == layout.exists.sum()
    np.testing.assert_array_equal(layout.whole(y), np.where(layout.exists, layout.u, 0.0))
    fields = layout.u.copy()
    assert layout.unknowns.put(fields, -y) is fields
    np.testing.assert_array_equal(fields, np.where(layout.exists, -layout.u, layout.u))


@given(layouts)
@settings(max_examples=60, deadline=None)
def test_strips_have_one_field_one_particle_and_one_kind(layout: Layout) -> None:
    """Shared nodes come first; in each of the two parts entries are sorted by column and node: all ranks agree."""
    places, strips = layout.unknowns, layout.unknowns.strips
    length = np.diff(strips.first)
    assert (length > 0).all()
    assert strips.first[-1] == places.size
    node = np.concatenate([np.arange(a, a + k) for a, k in zip(strips.node, length, strict=True)])
    column, particle, kind = (np.repeat(x, length) for x in (strips.column, strips.particle, strips.kind))
    np.testing.assert_array_equal(node, places.nodes)
    np.testing.assert_array_equal(kind, layout.kind[node])
    owner = np.hstack([np.full((NODES, 1), -1), layout.owner])
    np.testing.assert_array_equal(particle, owner[node, column])
    border = strips.first[places.shared]
    np.testing.assert_array_equal(np.isin(node, layout.halo.shared), np.arange(node.size) < border)
    for part in (slice(None, border), slice(border, None)):
        assert (np.diff(column[part] * NODES + node[part]) > 0).all()
    for (rank, common), (same, entries) in zip(layout.halo.neighbours, places.halo.neighbours, strict=True):
        assert rank == same
        assert isinstance(common, np.ndarray)
        np.testing.assert_array_equal(entries, np.flatnonzero(np.isin(node, common)))


@given(layouts)
@settings(max_examples=60, deadline=None)
def test_sums_of_the_points_come_back_once(layout: Layout) -> None:
    """What blocks and loose points have added, over m_a; then there is nothing left."""
    strips, rng = layout.unknowns.strips, layout.rng
    columns, rows = np.zeros((8, NODES + LANES)), np.zeros((NODES, 8))
    y = layout.unknowns.take(layout.u)
    unknowns.spread(columns, rows, y, strips)
    loose = layout.exists & (layout.kind & LOOSE > 0)[:, None]
    np.testing.assert_array_equal(columns[:, :NODES].T, np.where(layout.exists, layout.u, 0.0))
    np.testing.assert_array_equal(rows, np.where(loose, layout.u, 0.0))
    columns, rows = rng.standard_normal((8, NODES + LANES)), rng.standard_normal((NODES, 8))
    mass, rate = rng.uniform(0.5, 2.0, NODES), np.full_like(y, np.nan)
    sums = (columns[:, :NODES].T + np.where(loose, rows, 0.0)) / mass[:, None]
    for low, high in ((0, layout.unknowns.shared), (layout.unknowns.shared, strips.node.size)):
        unknowns.collect(rate, columns, rows, mass, strips, low, high)
    np.testing.assert_allclose(layout.whole(rate), np.where(layout.exists, sums, 0.0), rtol=1e-15, atol=0)
    assert not columns[:, :NODES].T[layout.exists].any()
    assert not rows[loose].any()
    unknowns.collect(rate, columns, rows, mass, strips, 0, strips.node.size)
    assert not rate.any()


@given(layouts)
@settings(max_examples=60, deadline=None)
def test_sums_over_owned_nodes(layout: Layout) -> None:
    """Moments, squares and the error of a step, each against its formula; the order of summation differs."""
    strips, rng = layout.unknowns.strips, layout.rng
    mass, q = rng.uniform(0.5, 2.0, NODES), rng.standard_normal((NODES, 3))
    old, new, F_0, F_1 = rng.standard_normal((4, layout.unknowns.size))
    owned = layout.exists & (layout.kind & OWNED > 0)[:, None]
    u = np.where(owned, layout.whole(new), 0.0)
    moments = np.zeros((3 * SLOTS, 4))
    unknowns.add_moments(moments, new, mass, q, strips)
    for a in range(3 * SLOTS):
        eta = np.where(layout.owner == a, u[:, 1 : 1 + SLOTS], 0.0).sum(axis=1)
        np.testing.assert_allclose(moments[a], [mass @ eta, *(eta @ q)], rtol=0, atol=1e-13)
    assert unknowns.squares(new, strips) == pytest.approx((u**2).sum(), rel=1e-13)
    sums = np.full(2, np.nan)
    unknowns.step_error(sums, new, old, F_1, F_0, 0.3, 1e-2, mass, strips)
    error = layout.whole((0.8 * (old - new) + 0.4 * 0.3 * (F_0 + F_1)) / (1e-2 * (1.0 + np.abs(new))))
    exact = [(mass[:, None] * np.where(owned, error, 0.0) ** 2).sum(), mass[owned[:, 0]].sum()]
    np.testing.assert_allclose(sums, exact, rtol=1e-12)


@given(layouts)
@settings(max_examples=30, deadline=None)
def test_the_largest_change_counts_what_is_watched(layout: Layout) -> None:
    reference, weight = layout.rng.standard_normal((2, layout.unknowns.size))
    weight = np.maximum(weight, 0.0)
    change = np.abs(layout.unknowns.take(layout.u) - reference) * weight
    largest: Any = vectors.largest_change(layout.unknowns.take(layout.u), reference, weight)
    assert largest == pytest.approx(change.max(initial=0.0), rel=1e-14)


def test_nothing_changes(ranks: Ranks) -> None:
    """No nodes, no entries, and no harm done."""
    none = lay_out(np.empty(0, dtype=np.int64), np.zeros((5, 2), dtype=np.int32), np.zeros(5, dtype=np.int64),
                   Halo(ranks, 5, []))
    assert (none.size, none.shared, none.strips.node.size) == (0, 0, 0)
    assert none.take(np.ones((5, 8))).size == 0
