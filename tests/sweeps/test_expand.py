"""From a sweep to its points: which there are, that a point is the case it says, and what extending leaves alone."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frit.solver.case import Case, CaseError, parse_case
from frit.solver.variations import Variations, case_text, identity
from frit.sweeps.definition import Sweep, parse_sweep
from frit.sweeps.expand import MOST_REFUSED, Expansion, count, expand

Tree = dict[str, Any]

PACKING: Tree = {
    "domain": {"size": [100, 100]},
    "nodes": {"spacing": 1},
    "particles": {"source": "packing", "mean_radius": 8.0, "packing_density": 0.4, "container": [[5, 5], [95, 95]]},
    "time": {"end": 4},
}
DISCS = PACKING | {"particles": {"centres": [[30, 30], [70, 30]], "radii": [20, 20]}}
BOXES = PACKING | {"particles": {"shape": "box", "centres": [[20, 20], [50, 20]], "sizes": [[20, 10], [40, 10]]}}
CUBE = PACKING | {"domain": {"size": [40, 40, 40]}, "particles": {"centres": [[20, 20, 20]], "radii": [10]}}
A, B, RADIUS = "model.A", "model.B", "particles.mean_radius"


def sweep(axes: Tree | None = None, base: Tree = PACKING, **sample: Any) -> Sweep:
    return parse_sweep({"name": "s", "base": base, "axes": axes or {}, "sample": sample})


def values(expansion: Expansion, *keys: str) -> list[tuple[Any, ...]]:
    return [tuple(point.parameters[key] for key in keys) for point in expansion.points]


def identities(expansion: Expansion) -> list[str]:
    return [point.identity for point in expansion.points]


# --- which points


def test_no_axes_are_one_point_the_base() -> None:
    [point] = expand(sweep()).points
    assert (point.name, point.parameters) == ("s", {})
    assert point.identity == parse_case(PACKING).identity()


def test_grid_is_every_combination_with_the_last_axis_fastest() -> None:
    found = sweep({A: [1, 2.0], B: {"linspace": [3, 5, 3]}})
    assert values(expand(found), A, B) == [(1, 3), (1, 4), (1, 5), (2, 3), (2, 4), (2, 5)]
    assert count(found) == 6


def test_zip_takes_values_together() -> None:
    found = sweep({A: [1, 2], B: {"logspace": [0, 1, 2]}}, method="zip")
    assert values(expand(found), A, B) == [(1.0, 1.0), (2.0, 10.0)]
    assert count(found) == 2


def test_spacings_are_numpys() -> None:
    axes = {A: {"linspace": [1, 2, 5]}, B: {"logspace": [-1, 2, 5]}, "model.L": {"geomspace": [1, 16, 5]}}
    found = np.array(values(expand(sweep(axes, method="zip")), *axes))
    expected = [np.linspace(1, 2, 5), np.logspace(-1, 2, 5), np.geomspace(1, 16, 5)]
    assert found.T.tolist() == [column.tolist() for column in expected]


@pytest.mark.parametrize("method", ["random", "lhs", "sobol"])
def test_drawn_points_fill_their_ranges(method: str) -> None:
    n = 64
    axes = {A: {"low": 2, "high": 4}, "model.D_gb": {"low": 0.01, "high": 100, "log": True}, "particles.seed": None}
    axes["particles.seed"] = {"low": 3, "high": 6}
    found = values(expand(sweep(axes, method=method, points=n, seed=1)), *axes)
    linear, log, whole = zip(*found, strict=True)
    assert len(found) == n
    assert all(2 <= x < 4 for x in linear)
    assert all(0.01 <= x < 100 for x in log)
    assert {type(x) for x in whole} == {int}
    assert set(whole) == {3, 4, 5, 6}
    decades = np.histogram(np.log10(log), [-2, -1, 0, 1, 2])[0]
    assert decades.min() >= (n / 4 - 4 * math.sqrt(n / 4) if method == "random" else n / 4 - 2)


def test_a_latin_hypercube_has_one_point_in_every_layer() -> None:
    axes = {A: {"low": 0, "high": 10}, B: {"low": 0, "high": 10}}
    for column in np.array(values(expand(sweep(axes, method="lhs", points=10)), A, B)).T:
        assert sorted(np.floor(column)) == list(range(10))


def test_drawn_methods_choose_from_lists_by_number() -> None:
    axes = {A: [1.0, 2.0, 3.0], B: {"low": 1, "high": 2}}
    found = [a for (a,) in values(expand(sweep(axes, method="sobol", points=63)), A)]
    assert sorted(set(found)) == [1, 2, 3]
    assert max(map(found.count, found)) <= 23


def test_integers_are_rounded_where_a_spacing_falls_between() -> None:
    axes = {"particles.packing_density": [None], "particles.count": {"linspace": [4, 6, 4]}}
    assert [n for (n,) in values(expand(sweep(axes)), "particles.count")] == [4, 5, 6]
    assert expand(sweep(axes)).duplicates == 1


def test_axes_override_the_base_and_may_be_lists_or_tables() -> None:
    axes = {
        "domain.size": [[100, 100], [110, 100]],
        "output.snapshots": [[0, 1], {"every": 2}],
        "particles": [PACKING["particles"], DISCS["particles"]],
    }
    found = expand(sweep(axes)).points
    assert len(found) == 8
    last = json.loads(found[-1].case)
    assert (last["domain"]["size"], last["output"]["snapshots"]) == ([110, 100], {"every": 2})
    assert last["particles"]["radii"] == [20, 20]
    assert found[-1].parameters["domain.size"] == "[110, 100]"


def test_a_base_may_lack_what_an_axis_gives() -> None:
    base = PACKING | {"particles": {k: v for k, v in PACKING["particles"].items() if k != "mean_radius"}}
    assert identities(expand(sweep({RADIUS: [8.0, 9]}, base=base))) == identities(expand(sweep({RADIUS: [8.0, 9.0]})))


# --- what a point says


def test_names_are_short_and_tell_axes_apart() -> None:
    axes = {RADIUS: [8, 9.25], "particles.packing_density": [1 / 3]}
    assert [point.name for point in expand(sweep(axes, replicates=2)).points] == [
        "s: mean_radius=8 packing_density=0.333333 #1",
        "s: mean_radius=8 packing_density=0.333333 #2",
        "s: mean_radius=9.25 packing_density=0.333333 #1",
        "s: mean_radius=9.25 packing_density=0.333333 #2",
    ]
    axes = {"shape_functions.tolerance": [1e-6], "time.tolerance": [1e-3], "time.end": [3]}
    [point] = expand(sweep(axes)).points
    assert point.name == "s: shape_functions.tolerance=1e-06 time.tolerance=0.001 end=3"


def test_the_case_of_a_point_is_complete_and_has_its_name() -> None:
    for point in expand(sweep({RADIUS: [8, 9], A: [4, 5]}, replicates=2)).points:
        case = parse_case(json.loads(point.case))
        assert case.name == point.name
        assert case.identity() == point.identity
        assert json.loads(point.case) == case.tree()
        assert "\n" not in point.case
        assert (case.particles.mean_radius, case.model.A) == (point.parameters[RADIUS], point.parameters[A])
        assert case.particles.seed == point.parameters["particles.seed"]


# --- the same case never twice


def test_the_same_case_is_kept_once_where_it_comes_first() -> None:
    found = expand(sweep({A: [1, 2, 1.0], "domain.size": [[100, 100], [100.0, 100]]}))
    assert [a for (a,) in values(found, A)] == [1, 2]
    assert found.duplicates == 4


EXTENDED: list[tuple[Tree, Tree, Tree, Tree]] = [
    ({A: [1, 2]}, {}, {A: [0.5, 1, 2, 3]}, {}),
    ({A: [1, 2], B: [3]}, {}, {A: [1, 2], B: [3, 4]}, {}),
    ({A: [1, 2]}, {}, {A: [1, 2], B: [1.0, 2.0]}, {}),  # 1.0 is what the base has
    ({A: [1, 2], B: [3, 4]}, {"method": "zip"}, {A: [1, 2, 5], B: [3, 4, 5]}, {"method": "zip"}),
    ({A: [1, 2]}, {}, {A: [1, 2]}, {"replicates": 2}),
    ({A: [1, 2]}, {"replicates": 3}, {A: [1, 2]}, {"replicates": 7}),
    ({A: [1, 2]}, {"replicates": 3, "seed": 5}, {A: [0, 1, 2]}, {"replicates": 3, "seed": 5}),
    ({A: {"low": 1, "high": 2}, B: [1, 2]}, {"method": "random", "points": 5},
     {A: {"low": 1, "high": 2}, B: [1, 2]}, {"method": "random", "points": 50}),
    ({A: {"low": 1, "high": 2}, B: [1, 2]}, {"method": "sobol", "points": 5, "seed": 3},
     {A: {"low": 1, "high": 2}, B: [1, 2]}, {"method": "sobol", "points": 50, "seed": 3}),
]  # fmt: skip


@pytest.mark.parametrize(("axes", "sample", "more_axes", "more"), EXTENDED)
def test_extending_changes_no_point(axes: Tree, sample: Tree, more_axes: Tree, more: Tree) -> None:
    before, after = (identities(expand(sweep(a, **s))) for a, s in ((axes, sample), (more_axes, more)))
    assert len(after) > len(before)
    assert set(before) <= set(after)


def test_replicates_have_spawned_seeds_that_are_the_same_at_every_point() -> None:
    found = expand(sweep({A: [1, 2]}, replicates=4, seed=7))
    seeds = [seed for (seed,) in values(found, "particles.seed")]
    assert seeds[:4] == seeds[4:]
    assert seeds[0] == parse_case(PACKING).particles.seed
    spawned = np.random.SeedSequence(7).spawn(4)
    assert seeds[1:4] == [int(child.generate_state(1)[0]) for child in spawned[1:]]
    assert all(0 <= seed < 2**32 for seed in seeds)
    assert seeds[1:4] != [seed for (seed,) in values(expand(sweep(replicates=4, seed=8)), "particles.seed")][1:]


def test_a_latin_hypercube_of_another_size_is_another_one() -> None:
    five, six = (
        set(identities(expand(sweep({A: {"low": 1, "high": 2}}, method="lhs", points=n)))) for n in (5, 6)
    )
    assert not five & six


# --- refused


def test_a_refused_point_is_named_with_its_values() -> None:
    with pytest.raises(CaseError) as caught:
        expand(sweep({RADIUS: [8, -1.0], B: [1, 2]}))
    [problem] = caught.value.problems
    assert (problem.key, problem.value) == (RADIUS, -1.0)
    assert problem.allowed == (
        "must be greater than 0 (point 3, particles.mean_radius = -1.0, model.B = 1.0)"
    )


def test_refused_points_are_reported_together_each_problem_once() -> None:
    with pytest.raises(CaseError) as caught:
        expand(sweep({RADIUS: [8, 0.5, 0.25], "output.history_every": [0.0, 1.0]}))
    lines = str(caught.value).splitlines()
    assert [line.split(":")[0] for line in lines] == ["output.history_every = 0.0", *["nodes.spacing = 1.0"] * 2]
    assert "0.5 (point 4, particles.mean_radius = 0.5, output.history_every = 1.0)" in lines[1]
    with pytest.raises(CaseError) as caught:
        expand(sweep({A: {"linspace": [-99, -1, 99]}}))
    assert len(caught.value.problems) == MOST_REFUSED


def test_a_limit_is_kept_before_any_point_is_made() -> None:
    wide = {A: {"linspace": [1, 2, 10**5]}, B: {"linspace": [1, 2, 10**5]}}
    with pytest.raises(CaseError, match="axes: give 20000000000 points, must be at most 1000"):
        expand(sweep(wide, replicates=2), limit=1000)
    assert len(expand(sweep({A: [1, 2]}), limit=2).points) == 2


def test_replicates_of_what_is_not_packed_are_refused() -> None:
    with pytest.raises(CaseError, match="all would be one case"):
        sweep({A: [1]}, base=DISCS, replicates=2)


@pytest.mark.parametrize(
    ("axes", "sample"),
    [
        ({A: {"linspace": [1, 2, 7]}, B: [1, 2, 3]}, {"replicates": 3}),
        ({A: [1, 2], B: [1, 2]}, {"method": "zip", "replicates": 2}),
        ({A: {"low": 1, "high": 2}}, {"method": "random", "points": 9}),
        ({}, {}),
    ],
)
def test_count_is_how_many_there_are(axes: Tree, sample: Tree) -> None:
    found = expand(sweep(axes, **sample))
    assert count(sweep(axes, **sample)) == len(found.points) + found.duplicates


# --- variations are parse_case

CHANGES: list[tuple[str, Any]] = [
    ("name", "other"), ("name", 3),
    ("domain.size", [100, 100]), ("domain.size", [100, 90.0]), ("domain.size", [70, 70]), ("domain.size", [40, 40, 40]),
    ("domain.size", [-1, 3]), ("domain", None), ("nodes", None),
    ("nodes.spacing", 0.5), ("nodes.spacing", 11), ("nodes.spacing", 50.0), ("nodes.source", "gmsh"),
    ("nodes", {"source": "file", "path": "m.msh"}), ("nodes", {"source": "file", "path": "none.msh"}),
    ("shape_functions.gamma", 4), ("shape_functions.kind", "linear"), ("shape_functions", {}),
    ("particles", PACKING["particles"]), ("particles", DISCS["particles"]), ("particles", BOXES["particles"]),
    ("particles", CUBE["particles"]), ("particles", {"source": "file", "path": "p.csv"}),
    ("particles", {"source": "file", "path": "none.csv"}), ("particles", []),
    ("particles.mean_radius", 9.5), ("particles.mean_radius", 0.1), ("particles.mean_radius", None),
    ("particles.seed", 5), ("particles.seed", 5.0), ("particles.radii", [20, 19]), ("particles.radii", [20, 90]),
    ("particles.centres", [[30, 30], [31, 30]]), ("particles.container", [[5, 5, 5], [95, 95, 95]]),
    ("particles.container", [[5, 5], [80, 80]]), ("particles.container", [[5, 5], [80, 180]]),
    ("model.A", 8), ("model.A", 8.5), ("model.B", -0.0), ("model.B", 0.0), ("model.stiffness", 1), ("model", None),
    ("time.end", 2), ("time.end", 1e-3), ("time.end", "2"), ("time.integrator", "rk2"), ("time.step", 0.1),
    ("time", {"end": 4, "integrator": "rk2", "step": 0.2}),
    ("activation.enabled", False), ("output.snapshots", [0.0, 3.0]), ("output.snapshots", {"every": 1.0}),
    ("output.snapshots", {"every": 0}), ("output.vacancy_box", [[10, 10], [60, 60]]),
    ("output.vacancy_box", [[10, 10, 10], [30, 30, 30]]), ("output.vacancy_box", [[60, 60], [10, 10]]),
    ("output.checkpoint_every", 5.0), ("output", {}), ("output", 3), ("extra", {}),
]  # fmt: skip

starts = st.sampled_from([PACKING, DISCS, BOXES, CUBE])
walks = st.lists(st.one_of(st.sampled_from(CHANGES), starts), min_size=2, max_size=12)


def trees(start: Tree, walk: list[Any]) -> Iterator[Tree]:
    """Trees along a walk; each has the tables of the one before, as the same objects, but for the one that changes."""
    tree = start
    for step in walk:
        if isinstance(step, dict):
            tree = step
        else:
            name, _, key = step[0].partition(".")
            table = tree.get(name)
            tree = tree | {name: {**table, key: step[1]} if key and isinstance(table, dict) else step[1]}
        yield tree


def outcome(read: Any, tree: Tree) -> Case | list[str]:
    try:
        case: Case = read(tree)
    except CaseError as error:
        return str(error).splitlines()
    return case


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Has a mesh and a list of particles."""
    path = tmp_path_factory.mktemp("files")
    (path / "m.msh").write_text("mesh")
    (path / "p.csv").write_text("30,30,10\n60,30,12\n")
    return path


@settings(max_examples=300, deadline=None)
@given(start=starts, walk=walks)
def test_variations_are_what_parse_case_reads_and_refuses(folder: Path, start: Tree, walk: list[Any]) -> None:
    variations = Variations(folder)
    for tree in trees(start, walk):
        expected = outcome(lambda tree: parse_case(tree, folder), tree)
        found = outcome(variations.case, tree)
        assert found == expected
        if isinstance(found, Case) and isinstance(expected, Case):
            texts = variations.texts(found)
            assert identity(texts) == expected.identity()
            assert json.loads(case_text(found.name, texts)) == expected.tree()
            assert list(json.loads(case_text(found.name, texts))) == list(expected.tree())


numbers = st.floats(0.0, 200.0) | st.integers(-1, 100)


@settings(max_examples=100, deadline=None)
@given(columns=st.dictionaries(
    st.sampled_from([A, "particles.mean_radius", "nodes.spacing", "time.end", "output.history_every"]),
    st.lists(numbers, min_size=1, max_size=3), max_size=3,
))  # fmt: skip
def test_an_expansion_is_every_tree_parsed(columns: dict[str, list[float]]) -> None:
    expected: list[str] = []
    refused = False
    for picks in np.ndindex(*map(len, columns.values())):
        tree = {name: dict(table) for name, table in PACKING.items()}
        for (key, listed), pick in zip(columns.items(), picks, strict=True):
            name, _, field = key.partition(".")
            tree.setdefault(name, {})[field] = listed[pick]
        found = outcome(parse_case, tree)
        refused |= not isinstance(found, Case)
        expected += [found.identity()] if isinstance(found, Case) else []
    if refused:
        with pytest.raises(CaseError):
            expand(sweep(columns))
    else:
        assert identities(expand(sweep(columns))) == list(dict.fromkeys(expected))


def test_memory_of_tables_is_bounded_and_forgetting_changes_nothing() -> None:
    n = 700  # more tables than are remembered
    found = expand(sweep({RADIUS: {"linspace": [5, 9, n]}, A: [8.0, 16.0]}))
    assert len(found.points) == 2 * n
    for point in (*found.points[:3], *found.points[498:503], *found.points[-3:]):
        assert parse_case(json.loads(point.case)).identity() == point.identity
    assert values(found, A) == [(8.0,), (16.0,)] * n
