"""How busy more ranks stay: the model of their boxes against the real partitions and halos of small meshes."""

import numpy as np
import pytest

from frit.solver.geometry import lattice
from frit.solver.neighbours import make_grid
from frit.solver.partition import bisect
from frit.solver.shape import search_range
from frit.sweeps.scaling import Division, boxes, divide, efficiencies


@pytest.mark.parametrize("parts", [1, 2, 3, 7, 64])
@pytest.mark.parametrize("size", [(30.0, 20.0), (10.0, 11.0, 25.0)])
def test_boxes_of_equal_volume_fill_the_domain(size: tuple[float, ...], parts: int) -> None:
    found = boxes(size, parts)
    volumes = [np.prod(np.subtract(high, low)) for low, high in found]
    np.testing.assert_allclose(volumes, np.prod(size) / parts, rtol=1e-12)
    points = np.random.default_rng(1).uniform(0, size, (200, len(size)))
    inside = [((points >= low) & (points < high)).all(axis=1) for low, high in found]
    np.testing.assert_array_equal(np.sum(inside, axis=0), 1)


@pytest.mark.parametrize("ranks", [2, 4, 8, 16])
@pytest.mark.parametrize(("size", "h"), [((100.0, 80.0), 1.0), ((24.0, 24.0, 30.0), 1.2)])
def test_the_model_meets_real_partitions(size: tuple[float, ...], h: float, ranks: int) -> None:
    """Neighbours exactly, shared nodes of the busiest rank within 30 %: corners of boxes count as if they were full."""
    mesh = lattice(size, h)
    reach = search_range(mesh.spacing, 1.8, 1e-6)
    offsets, near = make_grid(mesh.nodes, reach[0]).within(mesh.points, reach)
    part = bisect(mesh.points, np.ones(len(mesh.points)), ranks)
    held = np.zeros((len(mesh.nodes), ranks), dtype=np.int64)
    held[near, np.repeat(part, np.diff(offsets))] = 1
    shared = (held * (held.sum(axis=1, keepdims=True) - 1)).sum(axis=0)
    neighbours = (held.T @ held > 0).sum(axis=0) - 1
    model = divide(size, len(mesh.nodes), float(reach[0]), ranks)
    print(shared.max(), model.shared)
    assert model.neighbours == neighbours.max()
    assert 0.9 < model.shared / shared.max() < 1.3


def test_efficiency_falls_with_ranks_and_rises_with_work() -> None:
    few, more = (efficiencies((100.0, 100.0, 125.0), 940_000, 3.4, work, 143) for work in (0.5, 5.0))
    assert list(few) == [2, 4, 8, 16, 32, 64, 128, 256, 512]
    assert all(a > b for a, b in zip(few.values(), list(few.values())[1:], strict=False))
    assert all(few[ranks] < more[ranks] < 1.0 for ranks in few)
    assert list(efficiencies((10.0, 10.0), 450, 2.7, 0.01, 2)) == [2, 4]  # 100 nodes for each rank


def test_one_rank_talks_to_nobody() -> None:
    assert divide((10.0, 10.0), 100, 2.7, 1) == Division(1, 0.0, 0.0, 0)
    assert Division(1, 0.0, 0.0, 0).efficiency(1.0, 100) == 1.0
