"""Which boxes are near each other: all of them are found, once, and little else is looked at, whatever the sizes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import meeting

from frit.solver.arrays import Floats
from frit.solver.case import MOST_COUNTED, MOST_PROBLEMS, CaseError, parse_case
from frit.solver.overlaps import BATCH, near_pairs
from frit.solver.pack_measures import near_pairs as touching_pairs

width = st.builds(lambda octave, part: part * 2.0**octave, st.integers(-6, 9), st.floats(1.0, 2.0))
place = st.integers(-400, 400).map(lambda k: 0.1 * k)


def cubes(r: Floats, dim: int) -> Floats:
    return np.repeat(r[:, None], dim, axis=1)


def looked_at(x: Floats, half: Floats) -> int:
    return sum(len(i) for i, _ in near_pairs(x, half))


@given(st.integers(2, 3).flatmap(lambda d: st.lists(st.tuples(st.tuples(*[place] * d), st.tuples(*[width] * d)),
                                                    min_size=1, max_size=30)))  # fmt: skip
def test_every_pair_that_meets_is_found_once(drawn: list[tuple[tuple[float, ...], tuple[float, ...]]]) -> None:
    x, half = np.array([place for place, _ in drawn]), np.array([widths for _, widths in drawn])
    pairs = [pair for i, j in near_pairs(x, half) for pair in zip(i.tolist(), j.tolist(), strict=True)]
    assert len(pairs) == len(set(pairs))
    assert all(i < j for i, j in pairs)
    assert set(pairs) >= meeting(x, half)


@given(st.lists(st.tuples(place, place, width), min_size=1, max_size=25), st.sampled_from([1e-3, 3.0]))
def test_contacts_are_those_of_all_pairs(drawn: list[tuple[float, ...]], tolerance: float) -> None:
    table = np.array(drawn)
    x, r = table[:, :2], table[:, 2]
    gaps = np.linalg.norm(x[:, None] - x, axis=2) - r - r[:, None]
    pairs, found = touching_pairs(x, r, tolerance)
    expected = np.argwhere(np.triu(gaps < tolerance, 1))
    assert pairs.tolist() == expected.tolist()
    assert found == pytest.approx(gaps[tuple(expected.T)])


def beside_a_giant(n: int) -> tuple[Floats, Floats]:
    """One disc of radius 499 and n of radius 1 that stand in rows beside it and touch."""
    rows = int(n**0.5) + 1
    small = [[1000.0 + 2.0 * (k % rows), 2.0 * (k // rows) + 2.0] for k in range(n)]
    return np.array([[500.0, 500.0], *small]), np.array([499.0, *[1.0] * n])


@pytest.mark.parametrize("find", ["boxes", "contacts"])
def test_work_grows_with_the_number_whatever_the_sizes(find: str, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = []
    for n in (1000, 4000):
        x, r = beside_a_giant(n)
        if find == "boxes":
            counts.append(looked_at(x, cubes(r, 2)))
        else:
            seen: list[int] = []

            def counted(x: Floats, half: Floats, seen: list[int] = seen) -> object:
                for i, j in near_pairs(x, half):
                    seen.append(len(i))
                    yield i, j

            monkeypatch.setattr("frit.solver.overlaps.near_pairs", counted)
            touching_pairs(x, r, 1e-3)
            counts.append(sum(seen))
        assert counts[-1] < 10 * n
    assert counts[1] < 6 * counts[0]


def test_thin_boxes_side_by_side_are_no_neighbours_of_all() -> None:
    n = 2000
    x = np.column_stack([np.full(n, 500.0), 2.5 * np.arange(n)])
    assert looked_at(x, np.tile([400.0, 1.0], (n, 1))) < 4 * n
    both = np.concatenate([x, x[:, ::-1] + [3000.0, 0.0]])
    assert looked_at(both, np.concatenate([np.tile([400.0, 1.0], (n, 1)), np.tile([1.0, 400.0], (n, 1))])) < 20 * n


def test_batches_are_bounded_and_enough_is_enough() -> None:
    n = 10_000
    sizes = []
    for i, _ in near_pairs(np.zeros((n, 2)), np.ones((n, 2))):
        sizes.append(len(i))
        if len(sizes) == 8:
            break
    assert max(sizes) < 2 * BATCH
    tree = {"domain": {"size": [9.0, 9.0]}, "nodes": {"spacing": 1.0}, "time": {"end": 1.0}}
    with pytest.raises(CaseError) as caught:
        parse_case({**tree, "particles": {"centres": [[4.0, 4.0]] * n, "radii": [2.0] * n}})
    assert (len(caught.value.problems), caught.value.more) == (MOST_PROBLEMS, MOST_COUNTED)
    assert str(caught.value).endswith(f"and at least {MOST_COUNTED} more")


def test_the_largest_and_smallest_numbers_are_no_trouble() -> None:
    x = np.array([[1e30, 0.0], [1e30, 1e-30], [-1e30, 5.0]])
    half = np.array([[1e-30, 1e-30], [1e30, 1e-30], [1e30, 1.0]])
    pairs = {pair for i, j in near_pairs(x, half) for pair in zip(i.tolist(), j.tolist(), strict=True)}
    assert pairs >= meeting(x, half)
