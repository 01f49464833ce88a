"""Who is near whom: every pair that overlaps, for any mix of sizes, and no more work than there are neighbours."""

import re
from typing import Any

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st

from frit.solver import case as case_module
from frit.solver.arrays import Floats
from frit.solver.case import MOST_COUNTED, MOST_PROBLEMS, CaseError, Problem, parse_case
from frit.solver.pairs import near_pairs

SIZE = 1000.0


def refused(particles: dict[str, Any], dim: int = 2) -> CaseError | None:
    tree = {"domain": {"size": [SIZE] * dim}, "nodes": {"spacing": 1e-9}, "particles": particles, "time": {"end": 1.0}}
    try:
        parse_case(tree)
    except CaseError as error:
        return error
    return None


@given(
    st.integers(2, 3), st.booleans(), st.integers(0, 2**32 - 1), st.integers(2, 40), st.sampled_from([0.1, 1.0, 3.0])
)
def test_overlaps_are_those_of_all_pairs(dim: int, boxes: bool, seed: int, n: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    half = np.repeat(np.minimum(10.0 * np.exp(spread * rng.standard_normal(n)), 200.0)[:, None], dim, axis=1)
    half *= rng.uniform(0.3, 1.0, (n, dim)) if boxes else 1.0
    centres = half + rng.random((n, dim)) * (SIZE / rng.integers(1, 6) - 2 * half).clip(0.0)
    shape = {"shape": "box", "sizes": (2 * half).tolist()} if boxes else {"radii": half[:, 0].tolist()}
    error = refused({"centres": centres.tolist(), **shape}, dim)
    truth = reference.overlapping(centres, half, boxes)
    told = [] if error is None else [pair_of(problem) for problem in error.problems]
    if len(truth) <= MOST_PROBLEMS:
        assert told == truth
    else:
        assert len(told) == MOST_PROBLEMS
        assert set(told) <= set(truth)


def pair_of(problem: Problem) -> tuple[int, int]:
    [j], [i] = re.findall(r"\d+", problem.key), re.findall(r"overlaps particles.centres\[(\d+)", problem.allowed)
    return int(i), int(j)


def looked_at(centres: Floats, reach: Floats) -> int:
    return sum(len(pairs) for pairs in near_pairs(centres, reach))


@pytest.mark.parametrize("n", [1000, 8000])
def test_a_large_one_does_not_make_all_look_far(n: int) -> None:
    """The small ones lie about the large one, apart from it and from each other."""
    side = int(np.ceil(np.sqrt(4 * n)))
    grid = np.stack(np.meshgrid(*[np.linspace(1.0, 999.0, side)] * 2), axis=-1).reshape(-1, 2)
    small = grid[np.hypot(*(grid - 500.0).T) > 400.0][:n]
    centres = np.concatenate([[[500.0, 500.0]], small])
    reach = np.concatenate([[390.0], np.full(len(small), 0.4)])
    assert looked_at(centres, reach) <= 2 * n


def test_each_pair_comes_once() -> None:
    rng = np.random.default_rng(1)
    centres, reach = rng.uniform(0, 50, (500, 3)), np.exp(rng.uniform(-3, 3, 500))
    pairs = np.concatenate(list(near_pairs(centres, reach)))
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    away = np.abs(centres[:, None] - centres).max(axis=-1)
    meet = np.argwhere(np.triu(away <= reach[:, None] + reach, 1))
    assert {tuple(pair) for pair in meet.tolist()} <= {tuple(pair) for pair in pairs.tolist()}


@pytest.mark.parametrize("n", [0, 1])
def test_who_is_alone_has_no_pairs(n: int) -> None:
    assert looked_at(np.zeros((n, 2)), np.ones(n)) == 0


def test_all_at_one_place_is_seen_from_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """50 000 particles would make a thousand million pairs."""
    seen = 0

    def counted(centres: Floats, reach: Floats) -> Any:
        nonlocal seen
        for pairs in near_pairs(centres, reach):
            seen += len(pairs)
            yield pairs

    monkeypatch.setattr(case_module, "near_pairs", counted)
    n = 50_000
    error = refused({"centres": [[500.0, 500.0]] * n, "radii": [1.0] * n})
    assert error is not None
    assert (len(error.problems), error.more) == (MOST_PROBLEMS, MOST_COUNTED - MOST_PROBLEMS)
    assert seen < 20 * n


# --- long lists, and errors without end


@pytest.mark.parametrize(
    "particles",
    [
        {"centres": ["a"] * 100_000, "radii": [1.0] * 100_000},
        {"centres": [[1.0, 2.0]] * 100_000, "radii": [-1.0] * 100_000},
        {"centres": [["x"] * 100_000] * 3, "radii": [1.0] * 3},
        {"centres": [[1.0]] * 100_000, "radii": [None] * 100_000},
        {"centres": [[9.0, 9.0]] * 70_000 + ["a"] * 70_000, "radii": [1.0] * 70_000 + [{}] * 70_000},
    ],
)
def test_a_long_list_is_checked_up_to_what_is_wrong(particles: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    shifted, lines = case_module._shifted, 0

    def counted(error: Any, start: int) -> Any:
        nonlocal lines
        lines += error.error_count()
        return shifted(error, start)

    monkeypatch.setattr(case_module, "_shifted", counted)
    error = refused(particles)
    assert error is not None
    assert 1 <= len(error.problems) <= MOST_PROBLEMS
    assert lines <= 400
    assert len(str(error)) < 30_000


def test_an_item_far_along_a_list_is_named_by_its_place() -> None:
    radii: list[Any] = [1.0] * 1000
    radii[777] = -2.0
    centres = [[5.0 + 9.0 * (k % 100), 5.0 + 9.0 * (k // 100)] for k in range(1000)]
    told = str(refused({"centres": centres, "radii": radii}))
    assert told == "particles.radii[777] = -2.0: must be greater than 0"
    radii[777] = 2.0
    assert refused({"centres": centres, "radii": radii}) is None


def test_what_is_beyond_the_limit_is_counted() -> None:
    error = CaseError(Problem(f"key {k}", k, "no") for k in range(60))
    assert (len(error.problems), error.more) == (50, 10)
    assert str(error).splitlines()[-1] == "and 10 more"
    endless = (Problem("key", k, "no") for k in iter(int, 1))
    assert CaseError(endless).more == MOST_COUNTED


def test_only_the_beginning_of_a_refused_value_is_written_out() -> None:
    assert len(str(Problem("key", ["x" * 1000] * 1_000_000, "no"))) < 120


# --- what never ends


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"time": {"end": 1e308}}, "time.end"),
        ({"time": {"end": 1e12}, "output": {"history_every": 1.0}}, "output.history_every"),
        ({"output": {"history_every": 5e-324}}, "output.history_every"),
        ({"output": {"snapshots": {"every": 1e-12}}}, "output.snapshots.every"),
        ({"time": {"end": 1.0, "integrator": "rk2", "step": 1e-300}}, "time.step"),
    ],
)
def test_what_can_never_come_to_its_end_is_refused(changes: dict[str, Any], key: str) -> None:
    tree: dict[str, Any] = {
        "domain": {"size": [22.0, 13.0]}, "nodes": {"spacing": 1.0},
        "particles": {"centres": [[6.5, 6.2]], "radii": [5.0]}, "time": {"end": 1.0},
    }  # fmt: skip
    parse_case(tree)
    with pytest.raises(CaseError, match=re.escape(key)) as raised:
        parse_case({**tree, **changes})
    assert [problem.key for problem in raised.value.problems] == [key]
