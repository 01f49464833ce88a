"""The grid finds what comparing all distances finds."""

import numpy as np
import pytest

from frit.solver.arrays import Floats
from frit.solver.neighbours import make_grid


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("typical", [0.05, 1.0, 7.0, 1e4])
def test_every_node_in_range_and_no_other(dim: int, typical: float) -> None:
    """Points inside, on and far beyond the hull of the nodes, with ranges from nothing to everything."""
    rng = np.random.default_rng(dim)
    nodes = rng.uniform(-3.0, 9.0, (400, dim))
    points = np.concatenate([rng.uniform(-12.0, 18.0, (60, dim)), nodes[:20]])
    ranges = np.concatenate([rng.uniform(0.0, 30.0, 60), np.zeros(20)])
    offsets, near = make_grid(nodes, typical).within(points, ranges)
    for p, (x, r) in enumerate(zip(points, ranges, strict=True)):
        expected = np.flatnonzero(((nodes - x) ** 2).sum(axis=1) <= r * r)
        np.testing.assert_array_equal(np.sort(near[offsets[p] : offsets[p + 1]]), expected)


@pytest.mark.parametrize(
    "nodes", [np.empty((0, 2)), np.zeros((1, 2)), np.ones((5, 3)), np.array([[0.0, 0.0], [1e6, 0.0]])]
)
def test_degenerate_sets_of_nodes(nodes: Floats) -> None:
    """None, one, five in one place, two in line a million apart: all of them are found from near, none from afar."""
    grid = make_grid(nodes, 1.0)
    offsets, near = grid.within(nodes, np.full(len(nodes), 0.5))
    assert near.size == sum(np.linalg.norm(nodes - x, axis=1).__le__(0.5).sum() for x in nodes)
    assert offsets[-1] == near.size
    assert grid.starts.size <= 4 * len(nodes) + 66
    assert grid.within(np.full((1, nodes.shape[1]), -50.0), np.array([1.0]))[1].size == 0
