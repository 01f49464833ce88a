"""The cost of a case: the model against recorded counts, what past runs change, and the plan of a sweep."""

import json
from typing import Any

import numpy as np
import pytest
from places import ROOT
from scipy.spatial import cKDTree
from simulate import simulate

from frit.solver.case import load_case, parse_case
from frit.solver.geometry import make_mesh
from frit.solver.shape import search_range
from frit.sweeps.cost import Measured, estimate, plan, work
from frit.sweeps.definition import load_sweep, parse_sweep
from frit.sweeps.expand import Expansion, expand

Tree = dict[str, Any]

DISCS: Tree = {
    "domain": {"size": [46.0, 24.0]},
    "nodes": {"source": "triangular", "spacing": 1.0},
    "particles": {"centres": [[14.0, 12.0], [32.0, 12.0]], "radii": [9.0, 9.0]},
    "time": {"end": 5.0},
}
SPHERES = DISCS | {
    "domain": {"size": [26.0, 14.0, 14.0]},
    "particles": {"centres": [[7.0, 7.0, 7.0], [16.5, 7.0, 7.0]], "radii": [5.0, 4.5]},
    "time": {"end": 1.0},
}
PACK = DISCS | {
    "domain": {"size": [80.0, 80.0]},
    "particles": {"source": "packing", "mean_radius": 5.5, "count": 18, "container": [[5, 10], [75, 70]]},
    "time": {"end": 4.0},
}
STILL = {"rigid_motion": False}
CASES = ROOT / "sweeps" / "cases"


def resolved(tree: Tree, **tables: Tree) -> Tree:
    return parse_case(tree | {name: tree.get(name, {}) | table for name, table in tables.items()}).tree()


# Runs on one rank: evaluations, mean live fraction of the points, processor seconds from start to end.
RECORDED: list[tuple[str, Tree, float, float, float]] = [
    ("rigid", resolved(DISCS), 232, 1.00, 4.3),
    ("still", resolved(DISCS, model=STILL), 206, 1.00, 4.4),
    ("rk2", resolved(DISCS, model=STILL, time={"end": 1.0, "integrator": "rk2"}), 400, 1.00, 4.1),
    ("gamma", resolved(DISCS, shape_functions={"gamma": 4.0}), 257, 1.00, 4.3),
    ("fine", resolved(DISCS, nodes={"spacing": 0.5}, time={"end": 2.0}), 189, 1.00, 4.5),
    ("spheres", resolved(SPHERES), 108, 1.00, 10.3),
    ("still spheres", resolved(SPHERES, model=STILL, shape_functions={"gamma": 4.0}), 94, 1.00, 7.4),
    ("11 discs", resolved(PACK, particles={"count": 11, "mean_radius": 6.0}), 494, 0.50, 4.5),
    ("18 discs", resolved(PACK), 511, 0.90, 5.7),
    ("22 discs", resolved(PACK, particles={"count": 22}), 532, 0.98, 5.6),
]


@pytest.mark.parametrize(("name", "case", "evaluations", "live", "seconds"), RECORDED)
def test_the_model_meets_recorded_runs(name: str, case: Tree, evaluations: float, live: float, seconds: float) -> None:
    said = work(case)
    assert 1 / 1.6 < said.evaluations / evaluations < 1.6
    assert 0.8 < said.live / live < 1.25
    assert 1 / 1.6 < estimate(case).core_seconds / seconds < 1.6


def test_the_model_gives_the_order_for_a_pack_that_it_was_not_fitted_to() -> None:
    case = load_case(CASES / "pack.toml").tree()  # recorded: 658 evaluations, 12.0 s, all points live
    said = work(case)
    assert 1 / 3 < said.evaluations / 658 < 3
    assert 0.8 < said.live / 1.0 < 1.25
    assert 1 / 3 < estimate(case).core_seconds / 12.0 < 3


def test_the_first_sweep_to_run_is_three_short_runs() -> None:
    points = expand(load_sweep(CASES.parent / "quick.toml")).points
    seconds = [estimate(json.loads(point.case)).core_seconds for point in points]
    assert len(points) == 3
    assert max(seconds) < 60
    assert [point.name.split("=")[0] for point in points] == ["density: packing_density"] * 3


def test_the_model_gives_the_order_of_a_run_that_it_was_not_fitted_to() -> None:
    tree = DISCS | {"domain": {"size": [40.0, 22.0]}, "time": {"end": 2.0}}
    tree["particles"] = {"centres": [[12.0, 11.0], [28.0, 11.0]], "radii": [9.0, 7.0]}
    run = simulate(tree)
    said = work(run.case.tree())
    assert 1 / 3 < said.evaluations / run.state.evaluations < 3
    assert 1 / 3 < said.live / run.rows[-1]["live_fraction"] < 3


@pytest.mark.parametrize("tree", [DISCS, SPHERES], ids=["2-D", "3-D"])
def test_points_and_nodes_are_those_of_the_lattice(tree: Tree) -> None:
    case = parse_case(tree)
    mesh, said = make_mesh(case.nodes, case.domain.size), work(case.tree())
    assert said.points == pytest.approx(len(mesh.points), rel=0.15)  # the walls halve cells
    reach = search_range(mesh.spacing[:1], case.shape_functions.gamma, case.shape_functions.tolerance)[0]
    middle = mesh.points[cKDTree(mesh.points).query(np.array(case.domain.size) / 2, k=50)[1]]
    counts = cKDTree(mesh.nodes).query_ball_point(middle, reach, return_length=True)
    assert said.nodes == pytest.approx(np.mean(counts), rel=0.05)


def test_more_work_costs_more() -> None:
    cost = estimate(resolved(DISCS)).core_seconds
    more: list[Tree] = [
        {"nodes": {"spacing": 0.5}},
        {"time": {"end": 10.0}},
        {"time": {"tolerance": 1e-4}},
        {"shape_functions": {"tolerance": 1e-9}},
        {"output": {"history_every": 0.01}},
    ]
    assert all(estimate(resolved(DISCS, **tables)).core_seconds > cost for tables in more)
    assert estimate(resolved(DISCS, model=STILL)).core_seconds < cost
    roomy, off = {"domain": {"size": [120.0, 80.0]}}, {"activation": {"enabled": False}}
    assert estimate(resolved(DISCS, **roomy, **off)).core_seconds > estimate(resolved(DISCS, **roomy)).core_seconds


def test_every_kind_of_case_has_an_estimate() -> None:
    boxes = {"shape": "box", "centres": [[10, 12], [30, 12]], "sizes": [[12, 12], [12, 9]]}
    density = {"source": "packing", "mean_radius": 4.0, "packing_density": 0.5, "container": [[2, 2], [44, 22]]}
    for tables in ({"particles": boxes}, {"particles": density}, {"shape_functions": {"kind": "linear"}}):
        assert estimate(parse_case(DISCS | tables).tree()).core_seconds > 0


def test_past_runs_scale_the_model_by_what_they_took() -> None:
    case = resolved(DISCS)
    model = estimate(case).core_seconds
    alike = [resolved(DISCS, time={"end": end}) for end in (4.0, 4.5, 5.5, 6.0)]
    past = [Measured(tree, 3 * estimate(tree).core_seconds) for tree in alike]
    odd = Measured(resolved(DISCS, time={"end": 5.1}), 1e6)  # a machine that slept: the median does not care
    for runs in ([*past, odd], past[:1]):
        found = estimate(case, runs)
        assert found.core_seconds == pytest.approx(3 * model)
        assert found.source == "past runs"


def test_past_runs_of_another_kind_or_size_say_nothing() -> None:
    case = resolved(DISCS)
    others = [resolved(SPHERES), resolved(DISCS, model=STILL), resolved(DISCS, domain={"size": [4600.0, 2400.0]})]
    assert estimate(case, [Measured(tree, 1e6) for tree in others]) == estimate(case)
    assert estimate(case).source == "cost model"


# --- plans


def pack_sweep(*densities: float) -> Expansion:
    base = PACK | {"particles": {k: v for k, v in PACK["particles"].items() if k != "count"}}
    tree = {"name": "s", "base": base, "axes": {"particles.packing_density": list(densities)}}
    return expand(parse_sweep(tree))


def test_a_plan_counts_what_is_missing() -> None:
    sweep = pack_sweep(0.4, 0.5, 0.4, 0.6)
    first, *others = sweep.points
    found = plan(sweep, done={first.identity, "something else"})
    assert (found.points, found.duplicates, found.done, found.to_run) == (3, 1, 1, 2)
    seconds = sum(estimate(json.loads(point.case)).core_seconds for point in others)
    assert found.core_hours == pytest.approx(seconds / 3600)
    assert found.source == "cost model"
    assert found.rows()[:4] == [("points", "4"), ("duplicates", "1"), ("already done", "1"), ("to run", "2")]
    assert found.rows()[4][1].endswith(" (cost model)")
    assert json.loads(json.dumps(found.as_dict())) == found.as_dict()


def test_a_plan_tells_what_an_older_solver_computed() -> None:
    sweep = pack_sweep(0.4, 0.5, 0.6, 0.7)
    a, b, c, _ = [point.identity for point in sweep.points]
    found = plan(sweep, done={a}, older={b: 2, c: 1, "something else": 1})
    assert (found.done, found.to_run, found.older) == (1, 1, {"1": 1, "2": 1})
    words = "1 by revision 1, 1 by revision 2; --recompute computes them anew"
    assert found.rows()[2:5] == [("already done", "1"), ("by an older solver", words), ("to run", "1")]
    anew = plan(sweep, done={a})
    assert (anew.to_run, anew.older) == (3, {})
    assert anew.core_hours > 2 * found.core_hours


def test_a_plan_says_what_its_hours_rest_on() -> None:
    sweep = pack_sweep(0.4, 0.5)
    past = [Measured(json.loads(sweep.points[0].case), 7200.0)]
    assert plan(sweep, past, {sweep.points[0].identity}).source == "past runs"
    mixed = expand(parse_sweep({"base": DISCS, "axes": {"model.rigid_motion": [True, False]}}))
    past = [Measured(json.loads(mixed.points[0].case), 7200.0)]
    found = plan(mixed, past)
    assert found.source == "past runs for 1, cost model for the rest"
    assert found.core_hours == pytest.approx(2, rel=0.01)


def test_a_plan_with_nothing_to_run() -> None:
    sweep = pack_sweep(0.4)
    found = plan(sweep, done={point.identity for point in sweep.points})
    assert (found.to_run, found.core_hours) == (0, 0)
    assert found.rows()[-2:] == [("core-hours", "0"), ("ranks kept busy", "-")]
