"""The sweep file: what is accepted, what is refused and in which words, and that it can be written and read back."""

import json
from pathlib import Path
from typing import Any

import pytest

from frit.solver.case import CaseError
from frit.sweeps.definition import Range, Spacing, Sweep, load_sweep, parse_sweep, sweep_schema
from frit.sweeps.expand import expand

Tree = dict[str, Any]

DOCUMENTED = """
name = "density by spread"
ranks = 1
[base]
domain = { size = [120.0, 100.0] }
nodes = { spacing = 1.0 }
particles = { source = "packing", container = [[10.0, 10.0], [110.0, 90.0]] }
time = { end = 4.0 }
[axes]
"particles.mean_radius" = [8.0, 10.0, 12.0]
"particles.std_radius"  = { linspace = [0.5, 3.0, 4] }
"particles.packing_density" = [0.40, 0.65]
[sample]
method = "grid"
replicates = 3
seed = 7
"""


def base(**particles: Any) -> Tree:
    """A packing that lacks nothing."""
    packing = {"source": "packing", "mean_radius": 8.0, "packing_density": 0.4, "container": [[5, 5], [95, 95]]}
    return {
        "domain": {"size": [100, 100]},
        "nodes": {"spacing": 1},
        "particles": packing | particles,
        "time": {"end": 4},
    }


DISCS = {"centres": [[30, 30], [70, 30]], "radii": [20, 20]}


def sweep(axes: Tree | None = None, sample: Tree | None = None, **rest: Any) -> Sweep:
    return parse_sweep({"name": "s", "base": base(), "axes": axes or {}, "sample": sample or {}} | rest)


def test_the_documented_example(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(DOCUMENTED)
    found = load_sweep(tmp_path / "a.toml")
    assert (found.name, found.ranks, found.priority, found.tags) == ("density by spread", 1, 0, ())
    assert list(found.axes) == ["particles.mean_radius", "particles.std_radius", "particles.packing_density"]
    assert found.axes["particles.std_radius"] == Spacing(linspace=(0.5, 3.0, 4))
    assert (found.sample.method, found.sample.replicates, found.sample.seed) == ("grid", 3, 7)


@pytest.mark.parametrize(
    ("axes", "sample"),
    [
        ({}, {}),
        ({"model.A": [8, 16.0], "model.rigid_motion": [True, False], "domain.size": [[100, 100], [97, 95]]}, {}),
        ({"model.A": {"logspace": [0, 2, 3]}, "model.B": {"geomspace": [1, 4, 3]}}, {"method": "zip"}),
        ({"model.A": {"low": 8, "high": 16, "log": True}, "time.end": [3.0]}, {"method": "sobol", "points": 4}),
        ({"output.snapshots": [[0.0, 1.0], {"every": 0.5}]}, {"replicates": 2, "seed": 9}),
    ],
)
def test_resolved_json_reads_back_as_an_equal_sweep(axes: Tree, sample: Tree) -> None:
    found = sweep(axes, sample, priority=3, tags=["a", "b"], ranks=2)
    again = parse_sweep(json.loads(found.resolved_json()))
    assert again == found
    assert expand(again) == expand(found)


def test_a_base_file_is_read_and_paths_start_where_they_are_written(tmp_path: Path) -> None:
    folder = tmp_path / "cases"
    folder.mkdir()
    (folder / "pack.csv").write_text("30,30,20\n70,30,20\n")
    (tmp_path / "other.csv").write_text("30,30,10\n70,30,10\n")
    case = base() | {"particles": {"source": "file", "path": "pack.csv"}}
    (folder / "case.json").write_text(json.dumps(case))
    axes = {"particles.path": ["cases/pack.csv", "other.csv"]}
    (tmp_path / "s.json").write_text(json.dumps({"base": "cases/case.json", "axes": axes}))
    found = load_sweep(tmp_path / "s.json")
    assert found.base["particles"]["path"] == str(folder / "pack.csv")
    assert found.axes["particles.path"] == (str(folder / "pack.csv"), str(tmp_path / "other.csv"))
    assert parse_sweep(json.loads(found.resolved_json())) == found
    radii = [json.loads(point.case)["particles"]["radii"] for point in expand(found).points]
    assert radii == [[20.0, 20.0], [10.0, 10.0]]


def test_without_a_file_the_base_cannot_be_a_path(tmp_path: Path) -> None:
    (tmp_path / "case.json").write_text(json.dumps(base()))
    with pytest.raises(CaseError, match=r"base = '.*: must be a table"):
        parse_sweep({"base": str(tmp_path / "case.json")})


RADIUS = 'axes."particles.mean_radius"'
SEED = 'axes."particles.seed"'
BAD: list[tuple[Tree, str, str]] = [
    ({"base": None}, "base: ", "must be a table"),
    ({"ranks": 0}, "ranks = 0: ", "must be greater than or equal to 1"),
    ({"rank": 1}, "rank = 1: ", "unknown key; allowed here: name, ranks,"),
    ({"tags": "a"}, "tags = 'a': ", "must be a list"),
    ({"tags": ["a" * 101]}, "tags[0] = ", "must have at most 100 characters"),
    ({"name": "a" * 501}, "name = ", "must have at most 500 characters"),
    ({"priority": 10**30}, "priority = ", "must be less than or equal to 1000000"),
    ({"priority": -1_000_001}, "priority = ", "must be greater than or equal to -1000000"),
    ({"sample": {"metod": "grid"}}, "sample.metod = 'grid': ", "(did you mean method?)"),
    ({"sample": {"method": "latin"}}, "sample.method = 'latin': ", "'grid', 'zip', 'random', 'lhs' or 'sobol'"),
    ({"sample": {"replicates": 0}}, "sample.replicates = 0: ", "must be greater than or equal to 1"),
    ({"sample": {"replicates": 2.0}}, "sample.replicates = 2.0: ", "must be a valid integer"),
    ({"sample": {"seed": -1}}, "sample.seed = -1: ", "must be greater than or equal to 0"),
    ({"sample": {"method": "lhs"}}, "sample.points: ", "must be given with method = 'lhs'"),
    ({"sample": {"points": 3}}, "sample.points = 3: ", "does not belong to method = 'grid'"),
    ({"sample": {"method": "random", "points": 3}}, "axes: ", "must be given with sample.method = 'random'"),
    ({"axes": {"particles.mean_radus": [1]}}, 'axes."particles.mean_radus": ', "(did you mean mean_radius?)"),
    ({"axes": {"partikles.seed": [1]}}, 'axes."partikles.seed": ', "(did you mean particles?)"),
    ({"axes": {"time.end.x": [1]}}, 'axes."time.end.x": ', "time.end has no keys below it"),
    ({"axes": {"name": ["a"]}}, "axes.", "does not change the result"),
    ({"axes": {"output.checkpoint_every": [1.0]}}, "axes.", "does not change the result"),
    ({"axes": {"particles": [DISCS], "particles.radii": [[1, 1]]}}, "axes.", 'is set by axes."particles" already'),
    ({"axes": {"particles.mean_radius": []}}, f"{RADIUS} = []: ", "must have at least 1 item"),
    ({"axes": {"particles.mean_radius": 8}}, f"{RADIUS} = 8: ", "must be a list"),
    ({"axes": {"particles.mean_radius": {"linspce": [1, 2, 3]}}}, f"{RADIUS}.linspce", "(did you mean linspace?)"),
    ({"axes": {"particles.mean_radius": {"linspace": [1, 2]}}}, f"{RADIUS}.linspace[2]: ", "must be given"),
    ({"axes": {"particles.mean_radius": {"linspace": [1, 2, 0]}}}, f"{RADIUS}.linspace[2] = 0", "must be greater"),
    ({"axes": {"particles.mean_radius": {}}}, f"{RADIUS}.linspace: ", "exactly one of linspace, logspace, geomspace"),
    ({"axes": {"particles.mean_radius": {"geomspace": [0, 2, 3]}}}, f"{RADIUS}.geomspace", "must be greater than 0"),
    ({"axes": {"particles.mean_radius": {"low": 5, "high": 9}}}, RADIUS, "needs sample.method = random, lhs, sobol"),
    ({"axes": {"particles.mean_radius": {"low": 9, "high": 9}}}, f"{RADIUS}.high = 9.0", "greater than low, 9.0"),
    ({"axes": {"particles.mean_radius": {"low": 9}}}, f"{RADIUS}.high: ", "must be given: largest value"),
    ({"axes": {"model.A": {"low": 0, "high": 9, "log": True}}}, 'axes."model.A".low = 0.0', "greater than 0 with"),
    ({"axes": {"model.advection": {"linspace": [1, 2, 3]}}}, "axes.", "a list of values: model.advection is not"),
    (
        {"axes": {"particles.count": {"low": 1.5, "high": 9}}, "sample": {"method": "lhs", "points": 3}},
        'axes."particles.count"',
        "must be whole numbers",
    ),
    (
        {"axes": {"model.A": [1, 2], "model.B": [1, 2, 3]}, "sample": {"method": "zip"}},
        "sample.method = 'zip': ",
        "needs axes of one length: model.A has 2, model.B has 3",
    ),
    (
        {"axes": {"particles.seed": [1, 2]}, "sample": {"replicates": 2}},
        "sample.replicates = 2: ",
        'must be 1 with an axis "particles.seed"',
    ),
    (
        {"base": base() | {"particles": DISCS}, "sample": {"replicates": 2}},
        "sample.replicates = 2: ",
        "with particles.source = 'list' all would be one case",
    ),
    ({"axes": {"particles.source": ["packing", "file"]}, "sample": {"replicates": 2}}, "sample.", "= 'file' all would"),
    ({"base": {"particles": 3}, "axes": {"particles.seed": [1]}}, "base.particles = 3: ", "must be a table"),
]


@pytest.mark.parametrize(("changes", "start", "words"), BAD, ids=lambda part: str(part)[:60])
def test_refused(changes: Tree, start: str, words: str) -> None:
    with pytest.raises(CaseError) as caught:
        parse_sweep({"base": base()} | changes)
    lines = str(caught.value).splitlines()
    assert any(line.startswith(start) and words in line for line in lines), lines


def test_what_stands_in_the_wrong_place_is_told_its_place() -> None:
    for tree, words in (
        (base(), ["base: this is a case, not a sweep: `frit run` and `frit submit` take cases; a sweep has a [base]"]),
        (
            {"base": base(), "method": "lhs", "time": {"end": 1.0}},
            ["method = 'lhs': put it in [sample]", "time: belongs to the case: put it in [base.time]"],
        ),
    ):
        with pytest.raises(CaseError) as caught:
            parse_sweep(tree)
        found = str(caught.value).splitlines()
        assert len(found) == len(words)
        assert all(line.startswith(start) for line, start in zip(found, words, strict=True))


@pytest.mark.parametrize("tree", [[], "sweep", None, 3])
def test_not_a_table(tree: Any) -> None:
    with pytest.raises(CaseError, match="must be a"):
        parse_sweep(tree)


def test_unreadable_files_are_refused_as_cases_are(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text('base = "no.toml"')
    with pytest.raises(CaseError, match=r"no.toml: cannot be read"):
        load_sweep(tmp_path / "s.toml")
    with pytest.raises(CaseError, match=r"must end in .toml or .json"):
        load_sweep(tmp_path / "s.yaml")


def test_the_schema_describes_every_field() -> None:
    schema = sweep_schema()
    assert schema["required"] == ["base"]
    for properties in [schema["properties"], *(part["properties"] for part in schema["$defs"].values())]:
        assert all(entry["description"] for entry in properties.values())


def test_a_sweep_cannot_be_changed() -> None:
    found = sweep({"model.A": {"low": 1, "high": 2}}, {"method": "lhs", "points": 2})
    assert found.axes["model.A"] == Range(low=1, high=2)
    with pytest.raises(ValueError, match="frozen"):
        found.ranks = 3
