"""What a case costs in core seconds, from similar past runs or from a model, and the plan of a sweep.

The model counts work: every evaluation of the rates visits each live material point and its nodes. It was fitted by
hand to ten runs on one shared 2.6 GHz core, in processor seconds, with kernels compiled before: two discs (both
integrators, with and without rigid motion, gamma 1.8 and 4, spacing 1 and 0.5), two spheres, and packs of 11, 18 and
22 discs of radius 6. It meets their evaluations and seconds within a factor of 1.6. Elsewhere expect a factor of 3: a
poured pack of 30 discs took 0.9 of the evaluations, one of 100 discs at spacing 0.53 took 1.04 of them. With more
particles nothing was measured. Compiling and packing are left out.
"""

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import ceil, exp, log, pi, prod, sqrt
from statistics import median
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from frit.solver import amounts
from frit.solver.arrays import Floats

from .expand import Expansion
from .scaling import efficiencies

START = 3.0  # s: command, interpreter, imports, compiled kernels from disk
SET_UP = 2.0e-7  # s per point and node in range: mesh, neighbours, shape functions
ROW, ROW_POINT = 5e-3, 3e-7  # s per history row, and more per point
VISIT = 1.1e-8  # s per live point, node in range and evaluation
FACTORED = {2: 8.0, 3: 11.0}  # nodes in range that cost as much where sums go axis by axis; measured on packs
BAND = 14.0  # nm: width of what is live along a surface, both sides together
FIRST = 10.0  # evaluations: first steps, and the first estimate of the spectral radius
FIT = 43.0  # evaluations per (spectral radius)^STIFF x (model time)^GROWTH
STIFF = 0.1  # more stages per step, but steps are as long as accuracy allows on any mesh
GROWTH = 0.5  # steps get longer as interfaces come to rest
CONTACTS = 0.6  # contacts that form and shift shorten the steps: per root of the number of other particles
TOLERANCE = 1 / 6, 0.3  # power of 1 / tolerance without and with contacts
RESTING = 0.6  # points rest where no more than this part of all has to live: `WORTH` of solver/discretisation.py
SIMILAR = 5  # past runs that a guess rests on
FAR = 2.0  # in logarithms of the work's parts: runs farther away say little

Case = Mapping[str, Any]


# --- the model


@dataclass(frozen=True)
class Work:
    """What a run has to do."""

    points: float
    """material points"""
    nodes: float
    """nodes in the range of a point"""
    live: float
    """share of the points that is live"""
    evaluations: float
    """of the rates, over the run"""
    rows: float
    """of the history"""

    def core_seconds(self) -> float:
        """On one core, from start to end."""
        set_up = START + self.points * self.nodes * SET_UP + self.rows * (ROW + ROW_POINT * self.points)
        return set_up + self.evaluations * self.evaluation()

    def evaluation(self) -> float:
        """Seconds of one evaluation of the rates on one core."""
        return self.points * self.live * self.nodes * VISIT


def work(case: Case) -> Work:
    """The work of a resolved case, as a tree of plain values."""
    h, size = _spacing(case), case["domain"]["size"]
    dense = 2 / sqrt(3) if len(size) == 2 else 0.75 * sqrt(3)  # nodes per h^dim: triangular, body-centred
    nodes = (1.0 if case["nodes"]["source"] == "lattice" else dense) * prod(size) / h ** len(size)
    points = points_of(case, nodes, amounts.points(nodes, len(size)))
    rows = case["time"]["end"] / case["output"]["history_every"]
    return Work(points, nodes_in_range(case, h), _live(case), evaluations(case), rows)


def points_of(case: Case, nodes: float, cells: float) -> float:
    """Material points on that many nodes with that many cells: one in each, or on a lattice of their own."""
    size, points = case["domain"]["size"], case.get("points", {})  # which cases of old have not
    if factored(case):
        return 2.0 * nodes
    on_mesh = case["nodes"]["source"] == "triangular" or case["shape_functions"]["kind"] == "linear"
    if on_mesh or points.get("source") == "cells":
        return cells
    if (pitch := points.get("pitch")) is not None:
        return prod(amounts.quotient(length, pitch) for length in size)
    return nodes * amounts.POINTS ** len(size)


def evaluations(case: Case) -> float:
    """Evaluations of the rates from t = 0 to the end.

    rk2: two per step, of the paper's length where none is given. adaptive: the stages of a step go with the root of
    its length and of the spectral radius, steps with the third root of the tolerance; rigid motion shortens them.
    """
    time, model, h = case["time"], case["model"], _spacing(case)
    if time["integrator"] == "rk2":
        step = time.get("step") or amounts.paper_step(h, model["L"], model["kappa_eta"])
        return 2.0 * ceil(float(time["end"] / step))
    others = max(_particles(case["particles"], len(case["domain"]["size"])) - 1, 0)
    rigid = CONTACTS * sqrt(others) if model["rigid_motion"] else 0.0
    accuracy = (1e-3 / float(time["tolerance"])) ** TOLERANCE[rigid > 0.0]
    return float(FIRST + FIT * (1 + rigid) * accuracy * _radius(case) ** STIFF * time["end"] ** GROWTH)


def _radius(case: Case) -> float:
    """Spectral radius of the Jacobian without rigid motion [1]: that of the Laplacian enters (3) squared, (4) once.

    The largest eigenvalue of the lumped Laplacian, times h^2, is interpolated in gamma between measured values.
    """
    shape, model, h = case["shape_functions"], case["model"], _spacing(case)
    gamma = shape["gamma"] if shape["kind"] == "lme" else 4.0
    laplacian = float(np.interp(gamma, (0.8, 1.8, 4.0), (2.2, 4.6, 8.3))) / h**2
    mobility = max(model["D_vol"], model["D_vap"], model["D_surf"] / 4)
    return float(mobility * model["kappa_rho"] * laplacian**2 + model["L"] * model["kappa_eta"] * laplacian)


def _spacing(case: Case) -> float:
    """h, nm; of a mesh file, which is not opened here, a fiftieth of the shortest edge of the domain."""
    return float(case["nodes"].get("spacing") or min(case["domain"]["size"]) / 50)


def nodes_in_range(case: Case, spacing: float) -> float:
    """Nodes, so far from each other, within h sqrt(-ln(delta_0) / gamma) of a point; of linear functions, of a cell."""
    dim, shape = len(case["domain"]["size"]), case["shape_functions"]
    if shape["kind"] == "linear":
        return dim + 1.0
    if factored(case):
        return FACTORED[dim] * (1 + int(_reach(shape) - 0.25)) / 3  # 3: of the default functions
    reach = _reach(shape) * (shape.get("width") or spacing) / spacing
    return pi * reach**2 * 2 / sqrt(3) if dim == 2 else 4 / 3 * pi * reach**3 * 0.75 * sqrt(3)


def factored(case: Case) -> bool:
    """Whether sums go axis by axis: on a square or cubic lattice, with maximum-entropy functions."""
    return bool(case["nodes"]["source"] == "lattice" and case["shape_functions"]["kind"] == "lme")


def _reach(shape: Case) -> float:
    """Range of the shape functions over h; one cell for linear ones."""
    return 1.0 if shape["kind"] == "linear" else sqrt(-log(shape["tolerance"]) / shape["gamma"])


def _live(case: Case) -> float:
    """Share of live points: a band along every surface, while bands leave room between them."""
    if not case["activation"]["enabled"] or factored(case):
        return 1.0
    size = case["domain"]["size"]
    volume, surface = prod(size), _surface(case["particles"], len(size))
    live = 1.0 - exp(-BAND * surface / volume)
    return live if live <= RESTING else 1.0


def _particles(particles: Case, dim: int) -> float:
    """How many there are, or about how many there will be."""
    if (mean := particles.get("mean_radius")) is None:
        return float(len(particles["centres"]))
    if (count := particles.get("count")) is not None:
        return float(count)
    lower, upper = particles["container"]
    solid = prod(b - a for a, b in zip(lower, upper, strict=True)) * particles["packing_density"]
    return float(solid * dim / (_sphere(mean, dim) * mean))


def _surface(particles: Case, dim: int) -> float:
    """Perimeter, nm, or surface, nm^2, of all particles."""
    if (mean := particles.get("mean_radius")) is not None:
        return _particles(particles, dim) * _sphere(mean, dim)
    if "sizes" in particles:
        return float(sum(2 * prod(edges) * sum(1 / edge for edge in edges) for edges in particles["sizes"]))
    return float(sum(_sphere(radius, dim) for radius in particles["radii"]))


def _sphere(radius: float, dim: int) -> float:
    """Its perimeter or surface; its volume is this times radius / dim."""
    return 2 * pi * radius if dim == 2 else 4 * pi * radius**2


# --- with past runs


@dataclass(frozen=True)
class Measured:
    """A past run: its resolved tree, and what it took, summed over its ranks."""

    case: Case
    core_seconds: float


@dataclass(frozen=True)
class Estimate:
    """What a run will take, summed over its ranks, and what says so."""

    core_seconds: float
    source: str
    """either "past runs" or "cost model", as it is"""


def estimate(case: Case, past: Sequence[Measured] = ()) -> Estimate:
    """What a resolved case will take. Raises nothing for a case that is checked."""
    return Experience(past).estimate(case)


class Experience:
    """Past runs, ready to be asked: the model is scaled by what they took over what it said, a median over those
    that are most alike. Runs are alike that have the same dimension, method and kind of shape functions, and whose
    parts of the work differ by less than a factor of exp(FAR) altogether.
    """

    def __init__(self, past: Iterable[Measured]) -> None:
        known: dict[tuple[object, ...], list[tuple[Floats, float]]] = {}
        for run in past:
            said = work(run.case)
            if run.core_seconds > 0:
                ratio = run.core_seconds / said.core_seconds()
                known.setdefault(_kind(run.case), []).append((_parts(said), ratio))
        self._known = {
            kind: (cKDTree(np.array([parts for parts, _ in runs])), [ratio for _, ratio in runs])
            for kind, runs in known.items()
        }

    def estimate(self, case: Case) -> Estimate:
        """As the function of this name."""
        said = work(case)
        tree, ratios = self._known.get(_kind(case), (None, []))
        if tree is not None:
            nearest = list(range(1, min(SIMILAR, tree.n) + 1))
            distance, near = map(np.asarray, tree.query(_parts(said), k=nearest))
            found = [ratios[i] for i in near[distance < FAR]]
            if found:
                return Estimate(said.core_seconds() * median(found), "past runs")
        return Estimate(said.core_seconds(), "cost model")


def _kind(case: Case) -> tuple[object, ...]:
    """What has to be equal for one run to say anything about another."""
    rigid = case["model"]["rigid_motion"]
    return len(case["domain"]["size"]), case["time"]["integrator"], rigid, case["shape_functions"]["kind"]


def _parts(said: Work) -> Floats:
    return np.log([said.points, said.nodes, said.live, said.evaluations, said.rows])


# --- the plan of a sweep


@dataclass(frozen=True)
class Plan:
    """What running a sweep means."""

    points: int
    """different cases"""
    duplicates: int
    """points left out as an earlier one is the same case"""
    done: int
    """cases that have been computed before"""
    older: dict[str, int]
    """by revision of the solver: how many cases an older one has computed, and are not to be computed anew"""
    to_run: int
    """cases that are missing"""
    core_hours: float
    """what these will take, summed over their ranks"""
    source: str
    """what the hours rest on: "past runs", "cost model", or how many of each"""
    busy: dict[str, float]
    """ranks, and the part of their time that is work, for the costliest of the missing cases"""

    def rows(self) -> list[tuple[str, str]]:
        """The plan as a table of words and figures."""
        hours = f"{self.core_hours:.2g} ({self.source})" if self.to_run else "0"
        older = ", ".join(f"{n} by revision {revision}" for revision, n in self.older.items())
        return [
            ("points", f"{self.points + self.duplicates}"),
            ("duplicates", f"{self.duplicates}"),
            ("already done", f"{self.done}"),
            *([("by an older solver", f"{older}; --recompute computes them anew")] if older else []),
            ("to run", f"{self.to_run}"),
            ("core-hours", hours),
            ("ranks kept busy", ", ".join(f"{ranks}: {part:.0%}" for ranks, part in self.busy.items()) or "-"),
        ]

    def as_dict(self) -> dict[str, Any]:
        """The plan for JSON."""
        return asdict(self)


def busy(case: Case) -> dict[str, float]:
    """Ranks, and the part of their time that is work, for a resolved case; see `scaling`."""
    said, size = work(case), tuple(case["domain"]["size"])
    nodes = said.points / (2 if len(size) == 2 else 6)  # of the built-in lattices
    shape = case["shape_functions"]
    reach, particles = _reach(shape) * (shape.get("width") or _spacing(case)), _particles(case["particles"], len(size))
    found = efficiencies(size, nodes, reach, said.evaluation(), particles)
    return {str(ranks): part for ranks, part in found.items()}


def plan(
    expansion: Expansion,
    past: Sequence[Measured] = (),
    done: Collection[str] = (),
    older: Mapping[str, int] | None = None,
) -> Plan:
    """The plan of an expanded sweep; `done` are the identities of cases that need not be computed, `older` those of
    cases that another revision of the solver has computed, which one, and that are not to be computed anew.
    """
    by = dict(older or {})
    stale = Counter(str(by[point.identity]) for point in expansion.points if point.identity in by)
    kept = {*done, *by}
    missing = [point for point in expansion.points if point.identity not in kept]
    experience = Experience(past)
    cases = [json.loads(point.case) for point in missing]
    guesses = [experience.estimate(case) for case in cases]
    known = sum(guess.source == "past runs" for guess in guesses)
    mixed = f"past runs for {known}, cost model for the rest"
    source = {len(guesses): "past runs", 0: "cost model"}.get(known, mixed)
    costliest = max(zip(guesses, cases, strict=True), key=lambda pair: pair[0].core_seconds, default=None)
    return Plan(
        busy=busy(costliest[1]) if costliest else {},
        points=len(expansion.points),
        duplicates=expansion.duplicates,
        done=len(expansion.points) - len(missing) - stale.total(),
        older=dict(sorted(stale.items())),
        to_run=len(missing),
        core_hours=sum(guess.core_seconds for guess in guesses) / 3600,
        source=source,
    )
