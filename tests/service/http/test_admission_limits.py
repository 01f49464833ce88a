"""What a case may ask for: reckoned before anything is built, refused with key, value and limit, and quickly."""

from pathlib import Path
from typing import Any

import pytest
from asking import PACKING, TINY, Tree, service
from cases import altered
from places import ROOT

from frit.service.http.admission import job_of, sweep_of
from frit.service.http.problems import HttpError
from frit.service.http.reckoning import excesses, need
from frit.service.http.views import JobSubmission, SweepSubmission
from frit.service.settings import Settings
from frit.solver.case import load_case, parse_case
from frit.solver.geometry import lattice
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh
from frit.sweeps.cost import nodes_in_range

ROOMY: dict[str, Any] = {"cores": 2, "memory_limit": 12_000_000_000}
MODEST = Settings(**ROOMY)


def resolved(tree: Any) -> Tree:
    return parse_case(tree).tree()


def refused(case: Tree, settings: Settings = MODEST, ranks: int = 1) -> list[tuple[str | None, Any, str]]:
    with pytest.raises(HttpError) as caught:
        job_of(JobSubmission(case=case, ranks=ranks), settings)
    assert caught.value.details.type == "/problems/over-limit"
    return [(wrong.pointer, wrong.value, wrong.detail) for wrong in caught.value.details.errors]


@pytest.mark.parametrize("path", sorted((ROOT / "sweeps").glob("*/pack*.toml")), ids=lambda path: path.stem)
def test_the_cases_that_come_along_are_accepted(path: Path) -> None:
    case = load_case(path).tree()
    for ranks in (1, 2):
        assert list(excesses(case, ranks, MODEST)) == []


@pytest.mark.parametrize(("size", "spacing"), [((40.0, 30.0), 0.5), ((12.0, 14.0, 16.0), 1.0)])
def test_nodes_and_points_are_those_of_the_lattice(size: tuple[float, ...], spacing: float) -> None:
    mesh = lattice(size, spacing)
    centre = [0.5 * length for length in size]
    nodes, particles = {"source": "triangular", "spacing": spacing}, {"centres": [centre], "radii": [4]}
    asked = altered({"domain.size": size, "nodes": nodes, "particles": particles, "output.history_change": 0})
    found = need(resolved(asked), 1)
    assert found.nodes == pytest.approx(len(mesh.nodes), rel=0.15)
    assert found.points == pytest.approx(len(mesh.points), rel=0.25)
    assert (found.rows, found.snapshots, found.particles) == (101, 2, 1)


def test_memory_is_what_was_measured() -> None:
    """Within a fourth, of runs on one rank."""
    for source, size, spacing, gamma, measured in [
        ("triangular", [500.0, 500.0], 0.8, 1.8, 0.981e9), ("triangular", [200.0, 200.0], 0.8, 0.5, 0.429e9),
        ("triangular", [50.0] * 3, 1.2, 1.8, 0.799e9), ("triangular", [70.0] * 3, 1.2, 1.8, 1.771e9),
        ("triangular", [50.0] * 3, 1.2, 0.5, 3.095e9), ("gmsh", [50.0] * 3, 1.2, 1.8, 1.747e9),
        ("gmsh", [30.0] * 3, 1.2, 1.8, 0.572e9), ("lattice", [500.0, 500.0], 0.8, 1.8, 0.593e9),
    ]:  # fmt: skip
        particles = {"centres": [[0.5 * length for length in size]], "radii": [4.0]}
        changes = {"nodes": {"source": source, "spacing": spacing}, "shape_functions.gamma": gamma, "domain.size": size}
        found = need(resolved(altered(changes | {"particles": particles})), 1)
        assert found.memory > 0.95 * measured
        assert found.memory < 1.25 * measured + 0.25e9, "which is the compiler's"


def test_pitch_and_width_count(ranks: Ranks) -> None:
    """As many points and pairs as a mesh gets; and they are blamed where they are why it does not fit."""
    centre, size = [[10.0, 8.0]], [20.0, 16.0]
    given = {"nodes": {"source": "gmsh", "spacing": 1.0}, "domain.size": size, "points": {"pitch": 0.25}}
    tree = resolved(altered(given | {"particles": {"centres": centre, "radii": [4.0]}}))
    assert need(tree, 1).points == pytest.approx(20 * 16 / 0.25**2, rel=0.01)
    assert len(build_mesh(parse_case(tree), ranks).points) == pytest.approx(20 * 16 / 0.25**2, rel=0.05)
    plain = need(tree | {"shape_functions": tree["shape_functions"] | {"width": 1.0}}, 1).memory
    wide = need(tree | {"shape_functions": tree["shape_functions"] | {"width": 3.0}}, 1).memory
    pairs = 40.0 * need(tree, 1).points * nodes_in_range(tree, 1.0)
    assert wide - plain == pytest.approx(8 * pairs, rel=1e-9)
    far = given | {"points": {"pitch": 0.0025}, "particles": {"centres": centre, "radii": [4.0]}}
    assert "/case/points/pitch" in {pointer for pointer, _, _ in refused(altered(far))}


LARGE = {"domain.size": [1000.0, 1000.0], "nodes.spacing": 0.3, "activation.few_order_parameters": False}
MANY = [[20.0 + 30.0 * (k % 30), 20.0 + 30.0 * (k // 30)] for k in range(900)]


@pytest.mark.parametrize(
    ("changes", "key", "value", "words"),
    [
        ({"nodes.spacing": 0.01}, "nodes/spacing", 0.01, "nodes, must be at most 20000000"),
        ({"output.history_every": 1e-6}, "output/history_every", 1e-6, "1e+07 rows, must be at most 1000000"),
        ({"output.snapshots": {"every": 1e-4}}, "output/snapshots/every", 1e-4, "snapshots, must be at most 10000"),
        ({"output.snapshots": [1e-5 * k for k in range(10_001)]}, "output/snapshots", None, "must be at most 10000"),
        ({"nodes.spacing": 0.06, "output.snapshots": {"every": 2e-3}}, "output/snapshots/every", 2e-3, "bytes on disk"),
        ({"nodes.spacing": 0.02}, "nodes/spacing", 0.02, "bytes of memory, must be at most 1.2e+10 on 1 ranks"),
        (LARGE | {"particles": {"centres": MANY, "radii": [10.0] * 900}}, "activation/few_order_parameters", False,
         "bytes of memory"),
        ({"particles": {"centres": [[1.0, 1.0]] * 50_001, "radii": [1.0]}}, "particles/centres", None, "50001 entries"),
    ],
)  # fmt: skip
def test_too_much_is_refused_with_key_value_and_limit(changes: Tree, key: str, value: Any, words: str) -> None:
    found = refused(altered(changes))
    assert found[0][:2] == (f"/case/{key}", value), found
    assert words in found[0][2]


BOX = {"container": [[0.0, 0.0], [100.0, 60.0]], "source": "packing"}


@pytest.mark.parametrize(
    ("particles", "key", "value"),
    [
        ({"mean_radius": 0.12, "packing_density": 0.5}, "mean_radius", 0.12),
        ({"mean_radius": 1.0, "count": 1_000_000_000}, "count", 1_000_000_000),
        ({"distribution": "histogram", "histogram": [[0.12, 1.0]], "packing_density": 0.5}, "histogram", [[0.12, 1.0]]),
        ({"distribution": "histogram", "histogram": [[0.12, 1.0], [9.0, 0.1]], "count": 20_000}, "histogram", None),
    ],
)
def test_a_packing_is_reckoned_before_it_is_drawn(particles: Tree, key: str, value: Any) -> None:
    roomier = Settings(**ROOMY | {"nodes_limit": 10**9, "memory_limit": 10**15})
    (pointer, shown, words), *_ = refused(altered({"particles": BOX | particles, "nodes.spacing": 0.012}), roomier)
    assert pointer == f"/case/particles/{key}"
    assert "must be at most" in words
    if value is not None:
        assert shown == value


def test_a_sweep_is_bounded_by_the_sum_of_its_cases() -> None:
    base = altered({"particles": {"centres": MANY, "radii": [10.0] * 900}, "domain.size": [1000.0, 1000.0]})
    definition = {"name": "s", "base": base, "axes": {"model.A": {"linspace": [1.0, 2.0, 1000]}}}
    with pytest.raises(HttpError, match=r"give 1000 cases that take more than 1e\+06 bytes together") as caught:
        sweep_of(SweepSubmission(definition=definition), Settings(**ROOMY, sweep_limit=1_000_000))
    assert caught.value.details.errors[0].pointer == "/definition/axes"
    names = {**definition, "axes": {"particles.interface_width": {"linspace": [1.0, 2.0, 50]}}}
    with pytest.raises(HttpError, match=r"give 50 cases that take more than 1e\+05 bytes together"):
        sweep_of(SweepSubmission(definition=names), Settings(**ROOMY, sweep_limit=100_000))
    few = {**definition, "axes": {"model.A": [1.0, 2.0]}}
    assert len(sweep_of(SweepSubmission(definition=few), Settings(**ROOMY, sweep_limit=1_000_000)).points) == 2


@pytest.mark.parametrize("place", ["base", "axes"])
def test_long_lists_of_a_sweep_are_refused_before_they_are_looked_into(place: str) -> None:
    particles = {"centres": ["a"] * 200_000, "radii": [1.0]}
    definition: Tree = {"name": "s", "base": PACKING, "axes": {}}
    if place == "base":
        definition["base"] = {**PACKING, "particles": particles}
    else:
        definition["axes"] = {"particles": [particles]}
    with pytest.raises(HttpError, match="has 200000 entries, must be at most 50000"):
        sweep_of(SweepSubmission(definition=definition), MODEST)


def test_a_point_of_a_sweep_that_wants_too_much_is_named() -> None:
    definition = {"name": "s", "base": TINY, "axes": {"output.history_every": [0.001, 1e-9]}}
    with pytest.raises(HttpError, match=r"output.history_every gives .* rows, must be at most 1000000 \(s: history"):
        sweep_of(SweepSubmission(definition=definition), MODEST)


def test_the_limits_are_told(tmp_path: Path) -> None:
    limits = {"particles_limit": 5, "rows_limit": 6, "snapshots_limit": 7, "disk_limit": 8, "sweep_limit": 9}
    with service(tmp_path, memory_limit=10, **limits) as client:
        told = client.get("/v1/limits").json()
    names = ("particles_per_case", "rows_per_case", "snapshots_per_case", "disk_bytes_per_case", "bytes_per_sweep")
    assert [told[name] for name in names] == list(limits.values())
    assert told["memory_bytes_per_core"] == 10
