"""What a case would take is reckoned before it is let in, and what is too much is named with its key."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from asking import PACKING, TINY, Tree, service, settings_in
from fastapi.testclient import TestClient

from frit.service.reckoning import particles_of, reckon, too_much
from frit.service.settings import Settings
from frit.solver.case import load_case, parse_case

ROOT = Path(__file__).parents[1]
SHIPPED = sorted([*ROOT.glob("sweeps/cases/*.toml"), *ROOT.glob("sweeps/paper/*.toml")])
PACK: Tree = {"source": "packing", "container": [[1.0, 1.0], [20.0, 12.0]]}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    with service(tmp_path_factory.mktemp("data"), memory_limit=2_000_000_000) as found:
        yield found


def changed(case: Tree, changes: Tree) -> Tree:
    return {**case, **{table: {**case.get(table, {}), **values} for table, values in changes.items()}}


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"output": {"snapshots": {"every": 1e-10}}, "time": {"end": 0.05}}, "output/snapshots"),
        ({"output": {"history_every": 1e-10}}, "output/history_every"),
        ({"nodes": {"spacing": 1e-4}}, "nodes/spacing"), ({"nodes": {"spacing": 0.01}}, "nodes/spacing"),
        ({"particles": {**PACK, "mean_radius": 1e-3, "packing_density": 0.5}, "nodes": {"spacing": 1e-3}},
         "particles/mean_radius"),
        ({"particles": {**PACK, "mean_radius": 0.012, "packing_density": 0.5}, "nodes": {"spacing": 0.012}},
         "particles/mean_radius"),
        ({"particles": {**PACK, "mean_radius": 1e-200, "packing_density": 0.5}, "nodes": {"spacing": 1e-200}},
         "particles/mean_radius"),
        ({"particles": {**PACK, "mean_radius": 5.0, "count": 10**12}}, "particles/count"),
        ({"particles": {**PACK, "distribution": "histogram", "histogram": [[1e-3, 1.0], [2e-3, 1.0]],
                        "packing_density": 0.5}, "nodes": {"spacing": 1e-3}}, "particles/histogram"),
    ],
)  # fmt: skip
def test_too_much_is_refused_by_its_key(client: TestClient, changes: Tree, key: str) -> None:
    """The same in a sweep, with the name of the point."""
    base = {**TINY, "particles": {}} if "particles" in changes else TINY
    case = changed(base, changes)
    answer = client.post("/v1/jobs", json={"case": case})
    assert answer.status_code == 422, answer.text
    problem = answer.json()
    assert problem["type"] == "/problems/over-limit", problem
    assert f"/case/{key}" in [error["pointer"] for error in problem["errors"]]
    sweep = client.post("/v1/sweeps", json={"definition": {"base": case, "axes": {"model.D_surf": [1.0, 2.0]}}})
    assert sweep.status_code == 422
    assert sweep.json()["errors"][0]["pointer"].startswith("/definition/base/")
    assert "D_surf=1" in sweep.json()["detail"]


def test_more_ranks_have_more_memory(client: TestClient) -> None:
    case = changed(TINY, {"nodes": {"spacing": 0.018}})
    refused = client.post("/v1/jobs", json={"case": case, "ranks": 1}).json()
    assert [error["pointer"] for error in refused["errors"]] == ["/case/nodes/spacing"]
    assert "bytes of memory on 1 ranks" in refused["errors"][0]["detail"]
    assert client.post("/v1/jobs", json={"case": case, "ranks": 2}).status_code == 201


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_what_frit_ships_is_let_in(path: Path, tmp_path: Path) -> None:
    """On a machine of two cores and 24 GiB."""
    case = json.loads(load_case(path).resolved_json())
    settings = Settings(data=tmp_path, memory_limit=12 * 2**30)
    assert [one.what for one in too_much(case, 1, settings)] == []


def test_the_particles_of_a_packing_are_about_those_it_gets() -> None:
    """143 spheres of 10 nm were packed into this container; discs by area."""
    case = json.loads(parse_case(PACKING).resolved_json())
    assert particles_of(case) == pytest.approx(90 * 50 * 0.4 / (math.pi * 64), rel=1e-12)


def test_all_figures_are_finite_for_what_is_let_in(tmp_path: Path) -> None:
    case: Any = json.loads(parse_case(TINY).resolved_json())
    assert all(0 < one.figure < one.most for one in reckon(case, 1, settings_in(tmp_path)))


def test_a_sweep_of_large_cases_is_refused_before_it_is_made(tmp_path: Path) -> None:
    centres = [[5.0 + 9.0 * (k % 100), 5.0 + 9.0 * (k // 100)] for k in range(5000)]
    base = {**TINY, "domain": {"size": [1000.0, 500.0]}, "particles": {"centres": centres, "radii": [4.0] * 5000}}
    definition = {"base": base, "axes": {"model.D_surf": [1.0 + k for k in range(1000)]}}
    with service(tmp_path, sweep_bytes_limit=2_000_000) as client:
        answer = client.post("/v1/sweeps", json={"definition": definition})
        assert answer.status_code == 422
        assert "together after" in answer.json()["detail"]


def test_the_limits_are_told(client: TestClient) -> None:
    limits = client.get("/v1/limits").json()
    for what in ("particles", "rows", "snapshots", "nodes"):
        assert limits[f"{what}_per_case"] > 0
    assert limits["memory_per_rank_bytes"] == 2_000_000_000
