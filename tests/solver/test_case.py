"""The case file: what is accepted, how it is filled in, what is refused and in which words."""

import itertools
import json
import math
import pickle
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import altered, minimal, tables
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from frit.solver.case import Case, CaseError, Model, Output, Problem, case_schema, load_case, parse_case

Tree = dict[str, Any]

TWO_DISCS = """
name = "two equal discs"

[domain]
size = [100.0, 60.0]

[nodes]
source = "lattice"
spacing = 1.0

[shape_functions]
kind = "lme"
gamma = 1.8
tolerance = 1e-6

[particles]
source = "list"
shape = "sphere"
centres = [[30.0, 30.0], [70.0, 30.0]]
radii = [20.0, 20.0]
interface_width = 1.0

[model]
A = 16.0
rigid_motion = true
advection = "huang"

[time]
end = 10.0
integrator = "adaptive"
tolerance = 1e-3

[activation]
enabled = true
eps_rho = 1e-5
eps_eta = 1e-5

[output]
history_every = 0.1
snapshots = [0.0, 5.0, 10.0]
vacancy_box = [[10.0, 10.0], [90.0, 50.0]]
checkpoint_every = 60.0
"""

PACKING = {
    "source": "packing",
    "mean_radius": 10.0,
    "std_radius": 1.0,
    "packing_density": 0.4,
    "seed": 3,
    "container": [[4.0, 5.0], [94.0, 55.0]],
}
BOXES = {"shape": "box", "centres": [[20, 20], [50.0, 20.0]], "sizes": [[20.0, 10.0], [40.0, 10.0]]}
CUBE = {"domain": {"size": [40, 40, 40]}, "particles": {"centres": [[20, 20, 20]], "radii": [10]}}


def outcome(tree: Any) -> Case | CaseError:
    try:
        return parse_case(tree)
    except CaseError as error:
        return error


def lines(tree: Any, base: Path | None = None) -> list[str]:
    with pytest.raises(CaseError) as caught:
        parse_case(tree, base)
    return str(caught.value).splitlines()


# --- accepted


def test_the_documented_example_is_the_minimal_case_with_its_defaults_written_out() -> None:
    full = parse_case(tomllib.loads(TWO_DISCS))
    tree = altered({"name": "two equal discs", "output.snapshots": [0, 5, 10]})
    tree["output"]["vacancy_box"] = [[10, 10], [90, 50]]
    assert parse_case(tree) == full
    assert full.dim == 2


def test_default_coefficients_are_table_2() -> None:
    assert Model().model_dump() == {
        **{"A": 16, "B": 1, "L": 10, "kappa_rho": 10, "kappa_eta": 1},
        **{"D_gb": 0.4, "D_vol": 0.01, "D_surf": 4, "D_vap": 0.001},
        **{"m_t": 500, "m_r": 1, "k": 100, "rho_0": 0.9816, "c": 0.14},
        **{"rigid_motion": True, "advection": "huang"},
    }


def test_defaults_that_need_other_tables() -> None:
    output = parse_case(minimal()).output
    assert output.history_every == 0.1
    assert output.snapshots == (0.0, 10.0)
    assert output.vacancy_box == ((18.0, 14.0), (82.0, 46.0))  # 80 % of [10, 90] x [10, 50]


def test_defaults_that_depend_on_the_source() -> None:
    assert parse_case(minimal()).time.tolerance == 1e-3
    assert parse_case(altered({"time.integrator": "rk2"})).time.tolerance is None
    particles = parse_case(altered({"particles": PACKING | {"std_radius": None, "seed": None}})).particles
    assert (particles.std_radius, particles.seed) == (0.0, 0)
    assert parse_case(minimal()).particles.seed is None


def test_boxes_have_sizes_and_a_packing_has_a_container() -> None:
    boxes = parse_case(altered({"particles": BOXES}))
    centres, half = boxes.particles.extents()
    assert centres.tolist() == [[20, 20], [50, 20]]
    assert half.tolist() == [[10, 5], [20, 5]]
    assert boxes.output.vacancy_box == ((16.0, 16.0), (64.0, 24.0))
    packing = parse_case(altered({"particles": PACKING}))
    assert packing.output.vacancy_box == ((13.0, 10.0), (85.0, 50.0))
    assert packing.particles.centres == ()


def test_null_is_the_same_as_leaving_out() -> None:
    tree = altered({"nodes.spacing": 1}) | {"name": None, "output": None}
    tree["time"] |= {"step": None, "tolerance": None}
    assert parse_case(tree) == parse_case(minimal())


def test_touching_the_wall_and_half_an_overlap_are_allowed() -> None:
    third = 0.1 + 0.2  # 0.30000000000000004: touches 0.6 but for round-off
    parse_case(altered({"domain.size": [0.6, 0.6], "nodes.spacing": 0.1, "time.end": 1})
               | {"particles": {"centres": [[0.3, 0.3]], "radii": [third]}})  # fmt: skip
    parse_case(altered({"particles.centres": [[30, 30], [60, 30]]}))


def test_three_dimensions() -> None:
    case = parse_case(minimal() | CUBE)
    assert case.dim == 3
    assert case.output.vacancy_box == ((12.0, 12.0, 12.0), (28.0, 28.0, 28.0))


@pytest.mark.parametrize(("every", "n"), [(1.0, 11), (0.1, 101), (3.0, 4), (20.0, 1)])
def test_snapshots_every(every: float, n: int) -> None:
    case = parse_case(altered({"output.snapshots": {"every": every}}))
    assert case.output.snapshot_times(10.0) == tuple(k * every for k in range(n))


def test_listed_snapshots_are_kept() -> None:
    assert parse_case(altered({"output.snapshots": []})).output.snapshot_times(10.0) == ()
    assert parse_case(altered({"output.snapshots": [1, 2.5]})).output.snapshot_times(10.0) == (1.0, 2.5)


def test_a_case_cannot_be_changed() -> None:
    case = parse_case(minimal())
    with pytest.raises(ValidationError, match="frozen"):
        case.time.end = 3.0


# --- refused


def packing(**changes: Any) -> Tree:
    return {"particles": PACKING | changes}


def boxes(**changes: Any) -> Tree:
    return {"particles": BOXES | changes}


INSIDE = "must stay in the domain, [100.0, 60.0]"
BAD: list[tuple[Tree, str, str]] = [
    # one value
    ({"domain.size": [100]}, "domain.size = [100]", "must have at least 2 items, not 1"),
    ({"domain.size": [1, 1, 1, 1]}, "domain.size = [1, 1, 1, 1]", "must have at most 3 items, not 4"),
    ({"domain.size": [100, -60]}, "domain.size[1] = -60", "must be greater than 0"),
    ({"domain.size": 100}, "domain.size = 100", "must be a list"),
    ({"domain": 3}, "domain = 3", "must be a table"),
    ({"name": 3}, "name = 3", "must be a valid string"),
    ({"nodes.spacing": "1"}, "nodes.spacing = '1'", "must be a valid number"),
    ({"nodes.spacing": True}, "nodes.spacing = True", "must be a valid number"),
    ({"nodes.spacing": math.nan}, "nodes.spacing = nan", "must be a finite number"),
    ({"nodes.source": "grid"}, "nodes.source = 'grid'", "must be 'lattice', 'triangular', 'gmsh' or 'file'"),
    ({"shape_functions.gamma": 6.5}, "shape_functions.gamma = 6.5", "must be less than or equal to 6"),
    ({"shape_functions.gamma": 0.4}, "shape_functions.gamma = 0.4", "must be greater than or equal to 0.5"),
    ({"shape_functions.tolerance": 0}, "shape_functions.tolerance = 0", "must be greater than 0"),
    ({"particles.radii": [20, -3.0]}, "particles.radii[1] = -3.0", "must be greater than 0"),
    ({"particles.centres": [[30, "a"]]}, "particles.centres[0][1] = 'a'", "must be a valid number"),
    ({"particles.interface_width": 0}, "particles.interface_width = 0", "must be greater than 0"),
    ({"model.L": 0}, "model.L = 0", "must be greater than 0"),
    ({"model.kappa_eta": -1}, "model.kappa_eta = -1", "must be greater than 0"),
    ({"model.D_gb": -0.1}, "model.D_gb = -0.1", "must be greater than or equal to 0"),
    ({"model.c": 1}, "model.c = 1", "must be less than 1"),
    ({"model.rigid_motion": 1}, "model.rigid_motion = 1", "must be a valid boolean"),
    ({"time.end": math.inf}, "time.end = inf", "must be a finite number"),
    ({"time.end": None}, "time.end: ", "must be given: t at the end of the run [1]"),
    ({"time": None}, "time: ", "must be given"),
    ({"activation.eps_rho": -1e-5}, "activation.eps_rho = -1e-05", "must be greater than or equal to 0"),
    ({"output.checkpoint_every": 0}, "output.checkpoint_every = 0", "must be greater than 0"),
    ({"output.history_every": 0}, "output.history_every = 0", "must be greater than 0"),
    ({"output.snapshots": 3}, "output.snapshots = 3", "must be a list"),
    ({"output.snapshots": [0, -1]}, "output.snapshots[1] = -1", "must be greater than or equal to 0"),
    ({"output.snapshots": {"every": 0}}, "output.snapshots.every = 0", "must be greater than 0"),
    ({"output.vacancy_box": [[0, 0]]}, "output.vacancy_box[1]: ", "must be given"),
    (packing(packing_density=1), "particles.packing_density = 1", "must be less than 1"),
    (packing(seed=1.0), "particles.seed = 1.0", "must be a valid integer"),
    # unknown keys
    ({"time.stpe": 3}, "time.stpe = 3", "allowed here: end, integrator, tolerance, step (did you mean step?"),
    ({"partikles": {}}, "partikles = {}", "unknown key; allowed here: name, domain, nodes"),
    ({"output.snapshots": {"every": 1, "xyz": 2}}, "output.snapshots.xyz = 2", "allowed here: every"),
    # one table
    ({"nodes.spacing": None}, "nodes.spacing: ", "must be given with source = 'lattice': h, nm"),
    ({"nodes.path": "a"}, "nodes.path = 'a'", "does not belong to source = 'lattice', which takes spacing"),
    ({"nodes": {"source": "file", "spacing": 1}}, "nodes.spacing = 1.0", "source = 'file', which takes path"),
    ({"nodes": {"source": "file"}}, "nodes.path: ", "must be given with source = 'file'"),
    ({"nodes": {"source": "file", "path": "a"}}, "nodes.path = '/", "must be a file, and there is none"),
    ({"time.step": 0.1}, "time.step = 0.1", "does not belong to integrator = 'adaptive'"),
    ({"time": {"end": 1, "integrator": "rk2", "tolerance": 1}}, "time.tolerance = 1.0", "which takes step"),
    ({"particles": {}}, "particles.centres: ", "must be given with source = 'list', shape = 'sphere'"),
    ({"particles": {"centres": [], "radii": []}}, "particles.radii: ", "must be given with source = 'list'"),
    ({"particles.radii": [20]}, "particles.radii = [20.0]", "must be 2, one per centre, not 1"),
    ({"particles.seed": 3}, "particles.seed = 3", "which takes centres, radii"),
    (boxes(radii=[5, 5]), "particles.radii = (5.0, 5.0)", "which takes centres, sizes"),
    (boxes(sizes=[[5, 5]]), "particles.sizes = [(5.0, 5.0)]", "must be 2, one per centre, not 1"),
    (packing(shape="box"), "particles.shape = 'box'", "not possible with source = 'packing'"),
    (packing(count=9), "particles.packing_density = 0.4", "give either this or count"),
    (packing(packing_density=None), "particles.packing_density: ", "give either this or count"),
    (packing(mean_radius=None), "particles.mean_radius: ", "must be given with source = 'packing'"),
    (packing(radii=[3]), "particles.radii = (3.0,)", "does not belong to source = 'packing'"),
    # the whole case
    (
        {"particles.centres": [[30, 30], [7, 3, 1]]},
        "particles.centres[1] = [7.0, 3.0, 1.0]",
        "must be 2 numbers",
    ),
    (packing(container=[[0, 0, 0], [9, 9, 9]]), "particles.container[0]", "must be 2 numbers"),
    ({"output.vacancy_box": [[0, 0, 0], [1, 1]]}, "output.vacancy_box[0]", "must be 2 numbers"),
    ({"particles.centres": [[30, 30], [81, 30]]}, "particles.centres[1] = [81.0, 30.0]", INSIDE),
    (boxes(centres=[[9, 9], [50, 9]]), "particles.centres[0] = [9.0, 9.0]", INSIDE),
    ({"particles.centres": [[30, 30], [59, 30]]}, "particles.centres[1]", "particles.centres[0] by 11 nm"),
    (boxes(centres=[[20, 20], [47, 20]]), "particles.centres[1]", "by 3 nm, must be at most 2.5"),
    ({"nodes.spacing": 21}, "nodes.spacing = 21.0", "must be at most the smallest radius or half edge, 20.0"),
    (boxes() | {"nodes.spacing": 6}, "nodes.spacing = 6.0", "smallest radius or half edge, 5.0"),
    (packing() | {"nodes.spacing": 11}, "nodes.spacing = 11.0", "at most particles.mean_radius, 10.0"),
    (packing(container=[[0, 0], [99, 61]]), "particles.container = [(0.0,", "must be inside the domain"),
    (packing(container=[[0, 9], [99, 9]]), "particles.container = [(0.0,", "lower corner, upper corner"),
    ({"output.vacancy_box": [[-1, 0], [9, 9]]}, "output.vacancy_box = [(-1.0,", "must be inside the domain"),
    ({"output.vacancy_box": [[9, 0], [9, 9]]}, "output.vacancy_box = [(9.0,", "lower corner, upper corner"),
    ({"output.snapshots": [0, 11]}, "output.snapshots[1] = 11.0", "must be at most time.end, 10.0"),
    ({"output.snapshots": [0, 3, 3]}, "output.snapshots[2] = 3.0", "must be greater than the time before"),
    ({"time.integrator": "rk2", "time.step": 11}, "time.step = 11.0", "must be at most time.end, 10.0"),
]


@pytest.mark.parametrize(("changes", "start", "words"), BAD, ids=lambda part: str(part)[:50])
def test_refused(changes: Tree, start: str, words: str) -> None:
    found = [line for line in lines(altered(changes)) if line.startswith(start)]
    assert any(words in line for line in found), lines(altered(changes))


def test_all_that_one_stage_can_find_is_reported_at_once() -> None:
    tree = altered({"domain.size": [100, -60], "nodes.spacing": "1", "time": {"ned": 1}, "model.c": 2})
    assert lines(tree) == [
        "domain.size[1] = -60: must be greater than 0",
        "nodes.spacing = '1': must be a valid number",
        "model.c = 2: must be less than 1",
        "time.end: must be given: t at the end of the run [1]",
        "time.ned = 1: unknown key; allowed here: end, integrator, tolerance, step (did you mean end?)",
    ]
    tree = altered({"particles.centres": [[10, 30], [25, 30]], "nodes.spacing": 30, "output.snapshots": [11]})
    assert [line.split(" = ")[0] for line in lines(tree)] == [
        *("particles.centres[0]", "particles.centres[1]", "nodes.spacing", "output.snapshots[0]")
    ]


@pytest.mark.parametrize(("unit", "factor"), [("m", 1e-9), ("mm", 1e-6), ("um", 1e-3)])
def test_lengths_in_another_unit_are_told_by_the_width_of_a_boundary(unit: str, factor: float) -> None:
    scaled = {
        "domain.size": [100 * factor, 60 * factor],
        "nodes.spacing": factor,
        "particles": {"centres": [[30 * factor, 30 * factor]], "radii": [20 * factor]},
    }
    [line] = lines(altered(scaled))
    assert line.startswith(f"particles.radii = {20 * factor}: must be at least 0.1155, a tenth of the width")
    assert line.endswith(f"lengths are in nm (20 nm, if {unit} was meant)")


def test_a_spacing_that_cannot_hold_an_interface_is_refused_but_for_what_was_accepted_before() -> None:
    [line] = lines(altered({"nodes.spacing": 2.5}))
    assert line.startswith("nodes.spacing = 2.5: cannot hold an interface: must be at most 2.309")
    assert parse_case(altered({"nodes.spacing": 2.5}), kept=True).nodes.spacing == 2.5
    for allowed in ({"nodes.spacing": 2.3}, {"nodes.spacing": 2.5, "model.kappa_eta": 1.5}):
        parse_case(altered(allowed))


def test_a_sweep_is_no_case() -> None:
    [line] = lines({"base": altered({}), "axes": {}})
    assert line.startswith("base: this is a sweep, not a case")


def test_a_particle_outside_is_one_problem_not_two() -> None:
    [line] = lines(altered({"particles": {"centres": [[300, 30]], "radii": [20]}}))
    assert line.startswith("particles.centres[0] = [300.0, 30.0]: reaches [20.0, 20.0] to each side")


def test_problems_name_key_value_and_what_is_allowed() -> None:
    with pytest.raises(CaseError) as caught:
        parse_case(altered({"particles.radii": [20, -3.0]}))
    [problem] = caught.value.problems
    assert (problem.key, problem.value, problem.allowed) == (
        "particles.radii[1]",
        -3.0,
        "must be greater than 0",
    )
    assert (
        str(pickle.loads(pickle.dumps(caught.value))) == "particles.radii[1] = -3.0: must be greater than 0"
    )


@pytest.mark.parametrize("tree", [[], "case", None, 3])
def test_not_a_table(tree: Any) -> None:
    assert lines(tree)[0].endswith("must be a table")


# --- written and read back


@pytest.mark.parametrize(
    "particles", [minimal()["particles"], BOXES, PACKING], ids=["discs", "boxes", "packing"]
)
@pytest.mark.parametrize("time", [{"end": 3}, {"end": 3, "integrator": "rk2"}], ids=["adaptive", "rk2"])
def test_resolved_json_is_the_same_case(particles: Tree, time: Tree) -> None:
    case = parse_case(altered({"particles": particles, "time": time, "output.snapshots": {"every": 0.3}}))
    again = parse_case(json.loads(case.resolved_json()))
    assert again == case
    assert again.identity() == case.identity()
    assert again.resolved_json() == case.resolved_json()


def test_a_packing_turns_into_a_list_and_all_else_is_kept() -> None:
    packing = parse_case(altered({"particles": PACKING | {"interface_width": 2.0}, "name": "pack"}))
    listed = packing.with_particles(np.array([[30.0, 30.0], [70.0, 30.0]]), np.array([9.0, 10.0]))
    assert listed.particles.source == "list"
    assert listed.particles.radii == (9.0, 10.0)
    assert listed.particles.interface_width == 2.0
    tables = set(Case.model_fields) - {"particles"}
    assert listed.model_dump(include=tables) == packing.model_dump(include=tables)
    with pytest.raises(CaseError, match=r"particles.centres\[0\]"):
        packing.with_particles([[1.0, 30.0]], [9.0])


def test_toml_and_json_files_are_the_same_case(tmp_path: Path) -> None:
    toml, jsonfile = tmp_path / "case.toml", tmp_path / "case.json"
    toml.write_text(TWO_DISCS)
    jsonfile.write_text(json.dumps(tomllib.loads(TWO_DISCS)))
    assert load_case(toml) == load_case(str(jsonfile)) == parse_case(tomllib.loads(TWO_DISCS))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.toml", None, "cannot be read: No such file"),
        ("a.toml", b"x = \n", "not valid TOML: Invalid value (at line 1"),
        ("a.toml", b"x = '\xff'\n", "not valid TOML: 'utf-8' codec"),
        ("a.json", b"{", "not valid JSON: Expecting property name"),
        ("a.yaml", b"", "must end in .toml or .json"),
    ],
)
def test_unreadable_files(tmp_path: Path, name: str, content: bytes | None, words: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(CaseError) as caught:
        load_case(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: {words}")


# --- files beside the case

FROM_FILE = {"source": "file", "path": "p.csv", "interface_width": 2}


def read_csv(folder: Path, text: str, size: tuple[float, ...] = (100.0, 60.0)) -> Case:
    (folder / "p.csv").write_text(text)
    return parse_case(altered({"particles": FROM_FILE, "domain.size": size}), folder)


@pytest.mark.parametrize(
    "text",
    [
        "30,30,20\n70,30,20\n",
        "x,y,radius\n30,30,20\n70,30,20",
        "# packed\n\n X , Y, Radius\r\n 30.0 , 3e1, 20\r\n\r\n  # two\n70,30,20\n",
        "\ufeff30,30,20\n70,30,20\n",
    ],
)
def test_csv(tmp_path: Path, text: str) -> None:
    case = read_csv(tmp_path, text)
    assert case == parse_case(altered({"particles.interface_width": 2}))
    (tmp_path / "p.csv").unlink()
    assert parse_case(json.loads(case.resolved_json())) == case  # case.json alone is enough


def test_csv_in_three_dimensions_beside_the_case_file(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("x,y,z,radius\n30,31,32,20\n")
    tree = altered({"particles": FROM_FILE, "domain.size": [60, 60, 60]})
    (tmp_path / "case.json").write_text(json.dumps(tree))
    assert load_case(tmp_path / "case.json").particles.centres == ((30.0, 31.0, 32.0),)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("30,30,20\n70,abc,20\n", "line 2, column 2 (y) is 'abc', must be a number"),
        ("# c\n30,nan,20\n", "line 2, column 2 (y) is 'nan', must be a number"),
        ("30,30,-1\n", "line 1, column 3 (radius) is '-1', must be a number greater than 0"),
        ("30,30,\n", "line 1, column 3 (radius) is '', must be a number greater than 0"),
        ("30,30,30,20\n", "line 1 has 4 columns, must have 3: x,y,radius"),
        ("radius,x,y\n20,30,30\n", "line 1, column 1 (x) is 'radius', must be a number"),
        ("x,y,radius\n", "holds no particles"),
        ("", "holds no particles"),
    ],
)
def test_csv_errors_name_file_line_and_column(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(CaseError) as caught:
        read_csv(tmp_path, text)
    assert str(caught.value).splitlines()[0] == f"particles.path = '{tmp_path / 'p.csv'}': {words}"


def test_all_wrong_cells_are_named_and_particles_of_a_file_are_checked_too(tmp_path: Path) -> None:
    with pytest.raises(CaseError) as caught:
        read_csv(tmp_path, "a,1,b\n1,1\n")
    assert len(caught.value.problems) == 3
    with pytest.raises(CaseError, match=r"particles.centres\[1\] = \[30.0, 29.0\]: overlaps"):
        read_csv(tmp_path, "30,30,20\n30,29,20\n")
    assert "cannot be read" in lines(altered({"particles": FROM_FILE}), tmp_path / "nowhere")[0]


def test_a_mesh_is_found_beside_the_case_file_and_counts_by_its_content(tmp_path: Path) -> None:
    for folder, content in (("a", "mesh"), ("b", "mesh"), ("c", "other")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "m.msh").write_text(content)
    tree = altered({"nodes": {"source": "file", "path": "m.msh"}})
    a, b, c = (parse_case(tree, tmp_path / folder) for folder in "abc")
    assert a.nodes.path == str(tmp_path / "a" / "m.msh")
    assert parse_case(json.loads(a.resolved_json())) == a
    assert a.identity() == b.identity() != c.identity()


# --- identity and schema


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "another"},
        {"output.checkpoint_every": 5.0},
        {"model.A": 16},
        {"output.history_every": 0.1},
        {"output.vacancy_box": [[18.0, 14.0], [82.0, 46.0]]},
        {"nodes": {"spacing": 1.0, "source": "lattice"}},
    ],
)
def test_identity_is_the_same(changes: Tree) -> None:
    assert parse_case(altered(changes)).identity() == parse_case(minimal()).identity()


@pytest.mark.parametrize(
    "changes",
    [
        {"model.A": 16.5},
        {"model.advection": "wang"},
        {"output.history_every": 0.2},
        {"output.snapshots": [0.0]},
        {"nodes.spacing": 0.5},
        {"nodes.source": "gmsh"},
        {"particles.radii": [20, 19]},
        {"activation.few_order_parameters": False},
        {"time.tolerance": 1e-4},
    ],
)
def test_identity_differs(changes: Tree) -> None:
    assert parse_case(altered(changes)).identity() != parse_case(minimal()).identity()


def test_identity_does_not_see_the_sign_of_zero() -> None:
    plus, minus = (parse_case(altered({"model.B": zero, "output.snapshots": [zero]})) for zero in (0.0, -0.0))
    assert plus.identity() == minus.identity()


def test_the_schema_describes_every_field() -> None:
    schema = case_schema()
    assert schema["required"] == ["domain", "nodes", "particles", "time"]
    assert len(tables()) == len(schema["$defs"]) + 1  # Case is the schema itself
    for properties in [schema["properties"], *(part["properties"] for part in schema["$defs"].values())]:
        assert all(entry["description"] for entry in properties.values())


# --- properties

radius = st.floats(0.5, 4.0)


@given(st.lists(st.tuples(radius, st.floats(-1.0, 1.0)), min_size=1, max_size=6), st.floats(1e-3, 1e6))
def test_a_row_of_discs_round_trips(row: list[tuple[float, float]], end: float) -> None:
    centres = [[5.0 + 10 * i + shift, 10.0 - shift] for i, (_, shift) in enumerate(row)]
    particles = {"centres": centres, "radii": [r for r, _ in row]}
    tree = altered({"particles": particles, "nodes.spacing": 0.5, "time.end": end})
    case = parse_case(tree)
    assert parse_case(json.loads(case.resolved_json())) == case
    assert parse_case(dict(reversed(tree.items()))).identity() == case.identity()


@given(
    st.lists(st.tuples(*[st.integers(0, 12)] * 3, st.integers(2, 6)), min_size=2, max_size=6, unique=True),
    st.integers(2, 3),
)
def test_too_close_is_what_the_slow_loop_says(drawn: list[tuple[int, ...]], dim: int) -> None:
    centres = [[20.0 + x for x in particle[:dim]] for particle in drawn]
    radii = [float(particle[3]) for particle in drawn]
    expected = {
        (i, j)
        for i, j in itertools.combinations(range(len(drawn)), 2)
        if radii[i] + radii[j] - math.dist(centres[i], centres[j]) > min(radii[i], radii[j]) / 2 + 1e-12
    }
    tree = altered({"domain.size": [60] * dim, "particles": {"centres": centres, "radii": radii}})
    result = outcome(tree)
    problems = result.problems if isinstance(result, CaseError) else ()
    named = [re.findall(r"centres\[(\d+)\]", str(problem)) for problem in problems]
    found = {(int(i), int(j)) for j, i in named}
    assert found == expected


@given(st.floats(0.01, 3.0), st.floats(0.01, 30.0))
def test_snapshots_are_multiples_up_to_the_end(every: float, end: float) -> None:
    output = Output.model_validate(
        {"history_every": 1, "snapshots": {"every": every}, "vacancy_box": [[0, 0], [1, 1]]}
    )
    times = output.snapshot_times(end)
    assert all(t == k * every for k, t in enumerate(times))
    assert times[-1] <= end * (1 + 1e-12) < len(times) * every


KEYS = [
    f"{key}.{field}"
    for key, table in vars(parse_case(minimal())).items()
    if key != "name"
    for field in vars(table)
]
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just("file"),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.sampled_from(KEYS), anything, min_size=1, max_size=3))
def test_anything_else_is_refused_not_crashed_on(changes: Tree) -> None:
    result = outcome(altered(changes))
    if isinstance(result, CaseError):
        assert result.problems
        assert len(str(result).splitlines()) >= len(result.problems)
    else:
        assert parse_case(json.loads(result.resolved_json())) == result


# --- too much


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time.end": 1e308}, "time.end = 1e+308: must be between 1e-30 and 1e30"),
        ({"model.A": 1e200}, "model.A = 1e+200: must be between 1e-30 and 1e30"),
        ({"particles.interface_width": 5e-324}, "particles.interface_width = 5e-324: must be between 1e-30 and 1e30"),
        ({"particles.centres": [[30, 30], [-1e300, 30]]}, "must be 0 or of a size between 1e-30 and 1e30"),
        ({"output.history_every": 5e-324}, "output.history_every = 5e-324: must be between 1e-30 and 1e30"),
        ({"output.history_every": 1e-9}, "output.history_every = 1e-09: gives 1e+10 rows, must be at most 1e+09"),
        ({"output.snapshots": {"every": 1e-12}}, "output.snapshots.every = 1e-12: gives 1e+13 snapshots"),
        ({"time.integrator": "rk2", "time.step": 1e-20}, "time.end = 10.0: takes 1e+21 steps of 1e-20"),
        ({"time.integrator": "rk2", "model.L": 1e20}, "time.end = 10.0: takes 2e+22 steps of 5e-22"),
        ({"nodes.spacing": 1e-6}, "nodes.spacing = 1e-06: gives about 6.93e+15 nodes, must be at most 2147483647"),
        ({"nodes.spacing": 1e-25}, "nodes.spacing = 1e-25: gives about 6.93e+53 nodes"),
        ({"particles": PACKING | {"count": 10**400, "packing_density": None}}, "particles.count"),
        ({"particles": PACKING | {"seed": 2**70}}, "particles.seed"),
    ],
)
def test_what_can_never_be_is_refused_with_key_value_and_limit(changes: Tree, words: str) -> None:
    said = lines(altered(changes))
    assert any(words in line for line in said), said


def test_sizes_that_no_mesh_resolves_together_are_refused() -> None:
    changes = {"particles.radii": [20.0, 1e-6], "nodes": {"source": "file", "path": __file__}}
    words = "particles.radii = [1e-06, 20.0]: the largest must be at most 1e+06 times the smallest"
    assert lines(altered(changes)) == [words]


WRONG: list[Any] = ["a", None, -1.0, [], {}, [1, 2, 3, 4], ["x", "y"]]


@pytest.mark.parametrize("key", ["centres", "radii", "sizes", "histogram", "snapshots", "container", "vacancy_box"])
@pytest.mark.parametrize("wrong", WRONG)
def test_a_list_of_a_million_wrong_items_is_looked_at_only_so_far(key: str, wrong: Any) -> None:
    table = "output" if key in ("snapshots", "vacancy_box") else "particles"
    with pytest.raises(CaseError) as caught:
        parse_case(altered({f"{table}.{key}": [wrong] * 1_000_000}))
    assert len(caught.value.problems) + caught.value.more < 1500


def test_a_wrong_item_far_into_a_list_has_its_number() -> None:
    radii: list[Any] = [1.0] * 5000
    radii[4321] = -1.0
    tree = altered({"particles": {"centres": [[1.0, 1.0]] * 5000, "radii": radii}})
    assert lines(tree) == ["particles.radii[4321] = -1.0: must be greater than 0"]


def test_problems_without_end_are_told_in_part_and_counted_in_part() -> None:
    one = Problem("a", 1, "must be 2")
    few = CaseError([one] * 60)
    assert (len(few.problems), few.more, str(few).splitlines()[-1]) == (50, 10, "and 10 more")
    endless = CaseError(itertools.repeat(one), more=3)
    assert str(endless).splitlines()[-1] == "and at least 1003 more"
    again = pickle.loads(pickle.dumps(few))
    assert (again.problems, again.more) == (few.problems, 10)
    assert str(CaseError([one])) == "a = 1: must be 2"


def test_a_file_of_wrong_lines_is_told_in_part(tmp_path: Path) -> None:
    with pytest.raises(CaseError) as caught:
        read_csv(tmp_path, "a,b,c\n" * 100)
    assert (len(caught.value.problems), caught.value.more) == (50, 250)
    with pytest.raises(CaseError, match=r"line 1 has 1 columns") as caught:
        read_csv(tmp_path, "x\n" * 1_000_000)
    assert caught.value.more == 950


def test_a_list_of_coordinates_is_not_looked_through_where_it_is_too_long() -> None:
    particles = {"centres": [["x"] * 100_000] * 3, "radii": [1.0] * 3}
    with pytest.raises(CaseError) as raised:
        parse_case({**minimal(), "particles": particles})
    told = [problem for problem in raised.value.problems if problem.key.startswith("particles.centres")]
    assert [problem.key for problem in told] == [f"particles.centres[{k}]" for k in range(3)]
    assert "at most 3 items" in told[0].allowed


def test_only_the_beginning_of_a_refused_value_is_written_out() -> None:
    assert len(str(Problem("key", ["x" * 1000] * 1_000_000, "no"))) < 120


@pytest.mark.parametrize("text", ["\x1b[31mRED", "a\nb", "\x9b", "\u202e", "\u2028", "\ud800"])
def test_a_name_has_no_control_characters(text: str) -> None:
    with pytest.raises(CaseError, match=r"name = .*: must (have no control characters|be a valid string)"):
        parse_case({**minimal(), "name": text})


def test_a_name_is_not_a_text_of_any_length() -> None:
    tree = tomllib.loads(TWO_DISCS)
    assert parse_case(tree | {"name": "a" * 10_000}).name == "a" * 10_000
    with pytest.raises(CaseError, match="must have at most 10000 characters"):
        parse_case(tree | {"name": "a" * 10_001})
