"""What is measured, against fields whose integrals, distances and necks are known."""

from collections.abc import Callable
from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
from boxes import boxes
from launching import Case
from places import ROOT
from reference import mean_in_box
from scipy.spatial import ConvexHull

from frit.solver import field
from frit.solver.arrays import Floats
from frit.solver.case import load_case, parse_case
from frit.solver.discretisation import Discretisation, discretise
from frit.solver.geometry import Mesh
from frit.solver.neck import Neck, section
from frit.solver.observe import Observables, box_weights
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh, prepare

PACK = ROOT / "sweeps/cases/pack.toml"
SIZES = {2: (30.0, 26.0), 3: (16.0, 15.0, 14.0)}
RADIUS = {2: 9.0, 3: 5.0}
FUNCTIONS: list[dict[str, Any]] = [*({"kind": "lme", "gamma": g} for g in (0.8, 1.8, 4.0)), {"kind": "linear"}]


def tree(size: tuple[float, ...], spacing: float = 1.0, kind: str = "lme", **tables: Any) -> Case:
    """A case with a small particle in the middle, which most tests do not look at."""
    middle: dict[str, Any] = {"centres": [[0.5 * s for s in size]], "radii": [0.25 * min(size)]}
    return {
        "domain": {"size": list(size)},
        "nodes": {"source": "triangular", "spacing": spacing},
        "shape_functions": {"kind": kind},
        "particles": middle,
        "time": {"end": 1.0},
        **tables,
    }


def meshed(case: Case, ranks: Ranks) -> tuple[Mesh, Discretisation]:
    parsed = parse_case(case)
    mesh = build_mesh(parsed, ranks)
    return mesh, discretise(parsed, mesh, ranks, np.ones(len(mesh.points)))


def profile(x: Floats, centre: Any, radius: float) -> Floats:
    """(34) with xi = 1 nm."""
    return np.asarray(0.5 * (1.0 - np.tanh(np.linalg.norm(x - np.asarray(centre), axis=-1) - radius)))


def subdivided(low: Floats, high: Floats, field: Callable[[Floats], Floats], cuts: int) -> float:
    """The mean of a field over a box by midpoints: exact to (box / cuts)^2 / 24 times the curvature."""
    axes = [a + (np.arange(cuts) + 0.5) * (b - a) / cuts for a, b in zip(low, high, strict=True)]
    return float(field(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)).mean())


# --- vacancy ratio --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["lme", "linear"])
@pytest.mark.parametrize("size", [(9.0, 7.0), (6.0, 5.0, 5.0)], ids=["2-D", "3-D"])
def test_linear_fields_are_integrated_exactly(size: tuple[float, ...], kind: str, ranks: Ranks) -> None:
    """Round-off: of cubics too (test_box.py), but here through the case and the discretisation."""
    case = parse_case(tree(size, kind=kind))
    mesh, d = meshed(tree(size, kind=kind), ranks)
    slope = np.array([0.31, -0.17, 0.23])[: len(size)]
    field = 0.4 + d.positions @ slope
    for low, high in boxes(size):
        mean = box_weights(case, mesh, d, low, high) @ field / np.prod(high - low)
        assert mean == pytest.approx(0.4 + 0.5 * (low + high) @ slope, abs=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_particle_in_the_box_is_measured_whole(dim: int, ranks: Ranks) -> None:
    """1e-4 of V_box is what the model asks for. No face cuts the interface."""
    size, centre = SIZES[dim], 0.5 * np.array(SIZES[dim]) + 0.13
    case = tree(size)
    mesh, d = meshed(case, ranks)
    low, high = 0.07 * np.array(size), 0.94 * np.array(size)
    mean = box_weights(parse_case(case), mesh, d, low, high) @ profile(d.positions, centre, 0.6 * RADIUS[dim])
    exact = subdivided(low, high, lambda x: profile(x, centre, 0.6 * RADIUS[dim]), {2: 800, 3: 120}[dim])
    assert mean / np.prod(high - low) == pytest.approx(exact, abs=1e-4)


@pytest.mark.parametrize("kind", ["lme", "linear"])
def test_a_pack_is_measured_to_a_ten_thousandth(kind: str, ranks: Ranks) -> None:
    """What the model asks for, where it matters: a box whose faces cut many particles, in and out alike."""
    case = parse_case(load_case(PACK).tree() | {"shape_functions": {"kind": kind}})
    mesh = build_mesh(case, ranks)
    d = discretise(case, mesh, ranks, np.ones(len(mesh.points)))
    discs = list(zip(case.particles.centres, case.particles.radii, strict=True))

    def rho(x: Floats) -> Floats:
        return np.minimum(sum(profile(x, centre, radius) for centre, radius in discs), 1.0)

    solid = rho(d.positions)
    for shift in (0.0, 0.3, 1.7, -2.2):
        low, high = np.add(case.output.vacancy_box, [[shift], [0.7 * shift]])
        mean = box_weights(case, mesh, d, low, high) @ solid / np.prod(high - low)
        assert mean == pytest.approx(subdivided(low, high, rho, 500), abs=1e-4)


def cut_error(dim: int, functions: dict[str, Any], spacing: float, ranks: Ranks) -> float:
    """In units of V_box, for a box that the interface of one particle leaves through every face."""
    size, centre = SIZES[dim], 0.5 * np.array(SIZES[dim]) + 0.13
    case = tree(size, spacing, shape_functions=functions)
    mesh, d = meshed(case, ranks)
    low, high = 0.21 * np.array(size), 0.77 * np.array(size)
    mean = box_weights(parse_case(case), mesh, d, low, high) @ profile(d.positions, centre, RADIUS[dim])
    exact = mean_in_box(lambda x: profile(x, centre, RADIUS[dim]), low, high, {2: 160, 3: 72}[dim])
    return float(abs(mean / np.prod(high - low) - exact))


@pytest.mark.parametrize("functions", FUNCTIONS, ids=["0.8", "1.8", "4", "linear"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_particle_that_the_box_cuts_is_measured_to_a_ten_thousandth(
    dim: int, functions: dict[str, Any], ranks: Ranks
) -> None:
    """Whatever the shape functions smooth: nodal values count as samples."""
    assert cut_error(dim, functions, 1.0, ranks) < 1e-4


@pytest.mark.parametrize(("dim", "gamma", "bound"), [(2, 1.8, 1e-5), (2, 4.0, 1e-4), (3, 1.8, 1e-4)])
def test_on_free_nodes_the_field_is_measured(dim: int, gamma: float, bound: float, ranks: Ranks, gmsh: Any) -> None:
    """By a rule of its own points, wherever the nodes are: the integral of the field that a run starts from."""
    size, centre = SIZES[dim], 0.5 * np.array(SIZES[dim]) + 0.13
    particle = {"centres": [centre.tolist()], "radii": [RADIUS[dim]]}
    functions = {"kind": "lme", "gamma": gamma}
    free = tree(size, shape_functions=functions, particles=particle) | {"nodes": {"source": "gmsh", "spacing": 1.0}}
    case = parse_case(free)
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    low, high = 0.21 * np.array(size), 0.77 * np.array(size)
    mean = box_weights(case, mesh, scheme.d, low, high) @ state.rho / np.prod(high - low)

    def rho(x: Floats) -> Floats:
        return field.at(case, mesh, x.reshape(-1, dim), state.rho[:, None])[:, 0].reshape(x.shape[:-1])

    assert mean == pytest.approx(mean_in_box(rho, low, high, {2: 60, 3: 24}[dim]), abs=bound)


def test_the_error_of_cut_particles_falls_with_the_fourth_power_of_the_spacing(ranks: Ranks) -> None:
    """The rule is exact for cubics, so that h^4 times fourth derivatives is the first thing left."""
    spacings = np.array([1.0, 0.5, 0.25])
    errors = [cut_error(2, {"kind": "linear"}, spacing, ranks) for spacing in spacings]
    slopes = np.diff(np.log(errors)) / np.diff(np.log(spacings))
    assert (slopes > 3.5).all(), errors  # 4, but for where the box's faces lie in the lattice


# --- sums -----------------------------------------------------------------------------------------------


def row(case: Case, ranks: Ranks, change: Callable[[Floats], None] = lambda u: None) -> dict[str, Any]:
    """The history row of a case at time 0, its fields changed."""
    parsed = parse_case(case)
    mesh = build_mesh(parsed, ranks)
    scheme, state = prepare(parsed, mesh, ranks)
    change(state.u)
    observables = Observables(parsed, mesh, scheme.d, len(state.slot_of))
    return observables.row(scheme, state, state.u, 0.0, 0.0)


def pair(dim: int, gap: float, **tables: Any) -> tuple[Case, Floats, Floats]:
    """Two particles, askew, 4 nm from all walls; their centres and radii."""
    size = (26.0, 18.0) if dim == 2 else (19.0, 14.0, 13.5)
    radii = np.array([4.5, 3.7] if dim == 2 else [2.6, 2.2])
    first = np.array([radii[0] + 4.2, 0.48 * size[1], 0.5 * size[-1]])[:dim]
    axis = np.array([1.0, 0.17, 0.08])[:dim] / np.linalg.norm([1.0, 0.17, 0.08][:dim])
    centres = np.array([first, first + axis * (radii.sum() + gap)])
    particles = {"centres": centres.tolist(), "radii": radii.tolist()}
    return tree(size, **({"particles": particles} | tables)), centres, radii


@pytest.mark.parametrize("dim", [2, 3])
def test_mass_volumes_and_distance_of_two_particles(dim: int, ranks: Ranks) -> None:
    """Sommerfeld's expansion of the profile, exact to exp(-2 R / xi): R^2 pi + pi^3 xi^2 / 12, and
    4/3 pi R^3 + pi^3 xi^2 R / 3. A sum over a lattice converges faster than any power of its spacing."""
    case, centres, R = pair(dim, gap=0.5, activation={"enabled": False})
    measured = row(case, ranks)
    exact = np.pi * R**2 + np.pi**3 / 12 if dim == 2 else 4 / 3 * np.pi * R**3 + np.pi**3 / 3 * R
    # What lies beyond the walls, exp(-8), and what activation drops of an order parameter, 30 eps_eta.
    assert measured["volumes"] == pytest.approx(exact, rel=1e-3)
    assert measured["solid_mass"] == pytest.approx(exact.sum(), rel=1e-3)
    assert measured["centre_distance"] == pytest.approx(np.linalg.norm(centres[1] - centres[0]), rel=1e-3)
    assert (measured["particles"], measured["live_fraction"]) == (2, 1.0)


def test_a_particle_that_has_vanished(ranks: Ranks) -> None:
    """It counts no more, and there is no distance to it; nor is there a neck."""

    def consume(u: Floats) -> None:
        u[:, 2] = 0.0

    measured = row(pair(2, gap=0.5)[0], ranks, consume)
    assert (measured["particles"], measured["volumes"][1]) == (1, 0.0)
    assert measured["centre_distance"] is None
    assert measured["neck_length"] == 0.0


def test_sums_of_uniform_fields(ranks: Ranks) -> None:
    """rho = 1/2 and nothing else: mass |Omega| / 2, free energy f |Omega| = (A / 16 + B / 4) |Omega|   (2)"""

    def half(u: Floats) -> None:
        u[:] = 0.0
        u[:, 0] = 0.5

    measured = row(pair(2, gap=0.5)[0], ranks, half)
    assert measured["vacancy_ratio"] == pytest.approx(0.5, rel=1e-12)
    assert measured["solid_mass"] == pytest.approx(0.5 * 26.0 * 18.0, rel=1e-12)
    assert measured["free_energy"] == pytest.approx((16.0 / 16.0 + 1.0 / 4.0) * 26.0 * 18.0, rel=1e-12)


def test_still_points_are_not_live(ranks: Ranks) -> None:
    case, _, _ = pair(2, gap=0.5)
    case["domain"] = {"size": [46.0, 38.0]}
    parsed = parse_case(case)
    scheme, _ = prepare(parsed, build_mesh(parsed, ranks), ranks)
    measured = row(case, ranks)
    assert measured["live_fraction"] == scheme.active.live.size / scheme.d.shape.points
    assert 0.2 < measured["live_fraction"] < 1.0


# --- neck -----------------------------------------------------------------------------------------------


def exact_neck(dim: int, radii: Floats, distance: float) -> float:
    """Where eta_1 = eta_2: |x - r_1| - R_1 = |x - r_2| - R_2 = t, and rho = 2 eta = 1 - tanh t > 1/2.

    At the distances d = R + t from the centres lies the circle of radius y around the axis, at x from r_1.
    """
    t = np.linspace(0.5 * (distance - radii.sum()), np.arctanh(0.5), 20_001)
    d1, d2 = radii[:, None] + t
    x = (d1**2 - d2**2 + distance**2) / (2.0 * distance)
    y = np.sqrt(np.maximum(d1**2 - x**2, 0.0))
    ds = np.hypot(np.diff(x), np.diff(y))
    return float(2.0 * ds.sum() if dim == 2 else (np.pi * (y[1:] + y[:-1]) * ds).sum())


@pytest.mark.parametrize("kind", ["lme", "linear"])
@pytest.mark.parametrize(
    ("dim", "radii", "spacings"),
    [
        (2, [5.0, 5.0], [1.0, 0.5, 0.25]),
        (2, [5.0, 3.5], [1.0, 0.5, 0.25]),
        (3, [3.0, 3.0], [1.0, 0.5]),
        (3, [3.0, 2.2], [1.0, 0.5]),
    ],
)
def test_neck_of_two_overlapping_particles(
    dim: int, radii: list[float], spacings: list[float], kind: str, ranks: Ranks
) -> None:
    """Smoothing and linear interpolation move the contour rho = 1/2 by h^2 / xi times 0.14 and less, and it meets the
    plane of the neck at an angle: 0.1 (h / xi)^2 of a neck of some xi."""
    R = np.array(radii)
    size = (21.0, 13.3) if dim == 2 else (12.0, 9.3, 9.1)
    distance = 0.85 * float(R.sum())
    axis = np.array([1.0, 0.3, 0.2])[:dim]
    axis *= distance / np.linalg.norm(axis)
    first = 0.5 * np.array(size) + 0.1 - axis * R[0] / R.sum()
    errors = []
    for spacing in spacings:
        case = parse_case(tree(size, spacing, kind))
        mesh = build_mesh(case, ranks)
        eta = [profile(mesh.nodes, c, r) for c, r in zip((first, first + axis), radii, strict=True)]
        neck = Neck(case, mesh).measure(np.stack([np.minimum(sum(eta), 1.0), *eta], axis=1))
        errors.append(abs(neck / exact_neck(dim, R, distance) - 1.0))
    assert (np.array(errors) < 0.1 * np.array(spacings) ** 2).all(), errors
    assert errors[-1] < errors[0]


def test_exact_neck_of_equal_particles() -> None:
    """The chord, or the disc, on the plane between them: the truth above is true."""
    half = np.sqrt((5.0 + np.arctanh(0.5)) ** 2 - 4.25**2)
    assert exact_neck(2, np.array([5.0, 5.0]), 8.5) == pytest.approx(2.0 * half, rel=1e-6)
    assert exact_neck(3, np.array([5.0, 5.0]), 8.5) == pytest.approx(np.pi * half**2, rel=1e-6)


def test_no_neck_where_nothing_touches(ranks: Ranks) -> None:
    assert row(pair(2, gap=4.0)[0], ranks)["neck_length"] == 0.0


def cells_of_a_cube(dim: int, cuts: int, shift: float = 0.0) -> Floats:
    """Corners (c, dim + 1, dim) of the unit cube's cells in Kuhn's division; shift bends the lines in between."""
    lattice = np.array(list(product(range(cuts), repeat=dim)), dtype=float)
    walks = [np.cumsum([np.zeros(dim), *np.eye(dim)[list(order)]], axis=0) for order in permutations(range(dim))]
    corners = (lattice[:, None, None, :] + np.array(walks)[None]).reshape(-1, dim + 1, dim) / cuts
    return np.asarray(corners + shift * np.prod(np.sin(np.pi * corners), axis=2, keepdims=True))


def cut(x: Floats, normal: Floats, offset: float, keep: Floats, bound: float) -> float:
    """`section` of the plane normal . x = offset, solid where keep . x > bound."""
    gap, rho = x @ normal - offset, x @ keep - bound + 0.5
    return section(x, np.stack([rho, 0.5 + gap, np.full_like(gap, 0.5)], axis=2))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("cuts", [1, 4])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_plane_through_vertices_and_edges_counts_every_facet_once(dim: int, cuts: int, sign: float) -> None:
    """Values of exactly zero at corners: a plane of facets between two cells belongs to one of them."""
    x, everywhere = cells_of_a_cube(dim, cuts), np.zeros(dim)
    first, second = sign * np.eye(dim)[:2]
    for offset in np.arange(1, cuts) / cuts:  # along facets
        assert cut(x, first, sign * offset, everywhere, -1.0) == pytest.approx(1.0, rel=1e-14)
    # The diagonal plane, all of whose facets are the cells' own.
    assert cut(x, first - second, 0.0, everywhere, -1.0) == pytest.approx(np.sqrt(2.0), rel=1e-14)
    # The other diagonal: only through vertices.
    assert cut(x, first + second, sign, everywhere, -1.0) == pytest.approx(np.sqrt(2.0), rel=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_any_plane_is_cut_exactly(dim: int, seed: int) -> None:
    """Linear fields: the sections of all cells add up to the polygon that the plane cuts out of the cube."""
    random = np.random.default_rng(seed)
    normal, inside = random.normal(size=dim), random.uniform(0.3, 0.7, size=dim)
    offset = float(normal @ inside)
    x = cells_of_a_cube(dim, 5, shift=0.05)
    assert cut(x, normal, offset, np.zeros(dim), -1.0) == pytest.approx(polygon(normal, offset), rel=1e-12)


def polygon(normal: Floats, offset: float) -> float:
    """Length or area of the plane normal . x = offset in the unit cube, from its crossings of the cube's edges."""
    dim, crossings = len(normal), []
    for axis in range(dim):
        for rest in product((0.0, 1.0), repeat=dim - 1):
            corner = np.insert(np.array(rest), axis, 0.0)
            t = (offset - normal @ corner) / normal[axis]
            if 0.0 <= t <= 1.0:
                crossings.append(np.insert(np.array(rest), axis, t))
    points = np.array(crossings)
    if dim == 2:
        return float(np.linalg.norm(points[1] - points[0]))
    flat = (points - points[0]) @ np.linalg.svd(normal[None])[2][1:].T
    return float(ConvexHull(flat).volume)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("bound", [0.0, 0.37, 0.5, 1.0])
def test_only_the_solid_part_counts(dim: int, bound: float) -> None:
    """x_1 = 0.4 where x_0 - x_1 + 0.4 > bound; exact, as all fields are linear."""
    first, second = np.eye(dim)[:2]
    x = cells_of_a_cube(dim, 5)
    assert cut(x, second, 0.4, first, bound) == pytest.approx(1.0 - bound, abs=1e-14)
    assert cut(x, second, 0.4 + 1e-3, first, bound) == pytest.approx(1.0 - bound, abs=1e-14)


def test_section_of_no_cells_is_nothing() -> None:
    assert section(np.empty((0, 3, 2)), np.empty((0, 3, 3))) == 0.0
    assert section(np.empty((0, 4, 3)), np.empty((0, 4, 3))) == 0.0
