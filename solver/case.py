"""The case: one frozen model per table of the case file, complete and checked at birth.

Checks come in three stages: each value by itself; each table (which fields go with its source); the whole
case (dimensions, geometry, times). Lengths are in nm; time and energy are the model's own units, written [1].
Equations, sections and tables are those of Huang et al. (2023).
"""

import difflib
import hashlib
import json
import math
import os
import re
import reprlib
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import chain, count, islice, pairwise, takewhile
from operator import ge
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    ModelWrapValidatorHandler,
    Tag,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError, PydanticKnownError

from . import amounts, overlaps, particle_file, resolution
from .arrays import Flags, Floats
from .characters import UNSHOWABLE
from .particle_file import ParticleFileError

CANONICAL = json.JSONEncoder(sort_keys=True)
PLAIN = {"tuple_type": "must be a list", "model_type": "must be a table", "dict_type": "must be a table"}
MOST_POINTS = 500_000_000  # 36 GB for their places alone
ROUND_OFF = 1e-9  # relative: what only touches a limit keeps it
SMALLEST, LARGEST = 1e-30, 1e30  # sizes of numbers: products of a few neither vanish nor overflow
LONGEST_KEY = 100  # characters of an unknown key that are compared with known ones
MOST_PROBLEMS = 50  # that are told one by one
MOST_COUNTED = 1000  # that are counted beyond these
MOST_NODES = 2**31 - 1  # nodes have 32-bit numbers
MOST_ROWS = 1e9  # of the history
MOST_SNAPSHOTS = 1e6
MOST_STEPS = 1e12  # of rk2
MOST_PARTICLES = 2**31 - 1
MIXED = 1e6  # largest over smallest radius or edge: no mesh resolves both
TOGETHER = 200  # items of a list that are checked at a time

# --- vocabulary



def _counted_on(x: float) -> float:
    """A number that may be multiplied with others; -0.0 becomes 0.0, so that equal cases have one identity."""
    if x and not SMALLEST <= abs(x) <= LARGEST:
        words = "must be 0 or of a size between 1e-30 and 1e30" if x < 0 else "must be between 1e-30 and 1e30"
        raise PydanticCustomError("size", words)
    return x + 0.0


def _not_tiny(x: float) -> float:
    """A part of something, of which there are not too many."""
    if 0.0 < x < 1e-3:
        raise PydanticCustomError("tiny", "must be 0 or between 0.001 and 1")
    return x + 0.0


def _in_parts(items: object, check: ValidatorFunctionWrapHandler) -> object:
    """A long list is checked part by part up to the first that has something wrong: errors are not without end."""
    if not isinstance(items, list | tuple) or len(items) <= TOGETHER:
        return check(items)
    parts = []
    for start in range(0, len(items), TOGETHER):
        try:
            parts.append(check(items[start : start + TOGETHER]))
        except (ValidationError, ValueError):
            return check(items[: start + TOGETHER])  # once more, so that the errors have their numbers
    return tuple(chain.from_iterable(parts))


FINITE = Field(strict=True, allow_inf_nan=False)
SIZED = AfterValidator(_counted_on)
LONG = WrapValidator(_in_parts)
Number = Annotated[float, FINITE, SIZED]
NonNegative = Annotated[float, FINITE, Field(ge=0), SIZED]
Positive = Annotated[float, FINITE, Field(gt=0), SIZED]
Fraction = Annotated[float, FINITE, Field(gt=0, lt=1)]
Flag = Annotated[bool, Field(strict=True)]


def showable(text: str) -> str:
    """The text, unless it has characters that must not be shown."""
    if UNSHOWABLE.search(text):
        raise PydanticCustomError("unshowable", "must have no control characters")
    return text


def _few(value: object) -> object:
    """A list of coordinates, unless it is so long that its items need no look."""
    if isinstance(value, list | tuple) and len(value) > 3:
        raise PydanticKnownError("too_long", {"field_type": "Tuple", "max_length": 3, "actual_length": len(value)})
    return value


Text = Annotated[str, Field(strict=True), AfterValidator(showable)]
Name = Annotated[str, Field(strict=True, max_length=10_000), AfterValidator(showable)]  # of a point: long
Point = Annotated[tuple[Number, ...], Field(min_length=2, max_length=3), BeforeValidator(_few)]
Edges = Annotated[tuple[Positive, ...], Field(min_length=2, max_length=3), BeforeValidator(_few)]
Box = tuple[Point, Point]
Place = tuple[str | int, ...]  # of a value in the tree: names, indices, and "|form" where it may have two


BRIEF = reprlib.Repr()  # looks at the beginning of large values only
BRIEF.maxlist = BRIEF.maxtuple = BRIEF.maxdict = 40
BRIEF.maxstring = BRIEF.maxother = BRIEF.maxlong = 100
BRIEF.maxlevel = 12


@dataclass(frozen=True)
class Problem:
    """One refused value: its dotted key, the value (None where there is none to show) and what is allowed."""

    key: str
    value: Any
    allowed: str

    def __str__(self) -> str:
        shown = text if len(text := BRIEF.repr(self.value)) <= 80 else text[:77] + "..."
        return f"{self.key}{'' if self.value is None else f' = {shown}'}: {self.allowed}"


class CaseError(ValueError):
    """A refused case and what is wrong with it: one line of `str()` per problem, and one for the rest.

    `problems` are the first MOST_PROBLEMS, `more` is how many others there are. Counting ends, so that a refusal takes
    no time: with `more` at MOST_COUNTED or above there may be others still.
    """

    def __init__(self, problems: Iterable[Problem], more: int = 0) -> None:
        """more: problems known beside these."""
        waiting = iter(problems)
        self.problems = tuple(islice(waiting, MOST_PROBLEMS))
        self.more = more + sum(1 for _ in islice(waiting, MOST_COUNTED))
        super().__init__(self.problems)

    def __str__(self) -> str:
        least = "at least " if self.more >= MOST_COUNTED else ""
        return "\n".join([*map(str, self.problems), *([f"and {least}{self.more} more"] if self.more else [])])


def _refuse(problems: Iterable[Problem]) -> None:
    """Raise them, if there are any. Validators give keys relative to what they validate."""
    waiting = iter(problems)
    if (first := next(waiting, None)) is not None:
        raise CaseError(chain([first], waiting))


class Table(BaseModel):
    """A table of the case file. `null` in JSON is the same as leaving the key out.

    `owned` has the fields that go with each setting of the `switches`: `...` for one that must be given, else
    its default. Those that go with another setting only are refused. `alone` names fields of which the table checks
    whether they are given, but never their value against another field's. `added` has the defaults of fields that came
    after the first release of identities: at its default such a field is no part of the identity, which old cases so
    keep. A field is not in both.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
    switches: ClassVar[tuple[str, ...]] = ()
    owned: ClassVar[Mapping[tuple[str, ...], Mapping[str, Any]]] = {(): {}}
    alone: ClassVar[tuple[str, ...]] = ()
    added: ClassVar[Mapping[str, Any]] = {}

    @model_validator(mode="wrap")
    @classmethod
    def _fit_switches(cls, tree: object, complete: ModelWrapValidatorHandler[Self]) -> Self:
        """Fill in what goes with the setting of the switches, refuse what does not. A finished table passes."""
        if type(tree) is cls:
            return tree
        if not isinstance(tree, Mapping):
            return complete(tree)
        given = {key: value for key, value in tree.items() if value is not None}
        if not cls.switches:
            return complete(given)
        setting = tuple([str(given.get(switch, default)) for switch, default in _switches(cls)])
        table = complete(_defaults(cls, setting) | given)
        _refuse(table._misfits())
        return table

    def _misfits(self) -> Iterator[Problem]:
        fields = vars(self)
        setting = tuple([fields[switch] for switch in self.switches])
        own = self.owned.get(setting)
        given = [name for name in _owned(type(self)) if fields[name] not in (None, ())]
        said = [f"{switch} = {value!r}" for switch, value in zip(self.switches, setting, strict=True)]
        if own is None:
            yield Problem(self.switches[-1], setting[-1], f"not possible with {said[0]}")
            return
        for name, default in own.items():
            if default is ... and name not in given:
                yield Problem(name, None, f"must be given with {', '.join(said)}{_about(type(self), name)}")
        for name in given:
            if name not in own:
                takes = f"does not belong to {', '.join(said)}, which takes {', '.join(own) or 'nothing more'}"
                yield Problem(name, fields[name], takes)

    def tree(self) -> dict[str, Any]:
        """The table as plain values, without the fields that are absent."""
        return self.model_dump(mode="json", exclude_none=True)

    def essence(self, tree: dict[str, Any]) -> dict[str, Any]:
        """What of the table's tree changes the result; the tree itself where all of it does."""
        old = {key for key, default in self.added.items() if key in tree and tree[key] == default}
        return {key: value for key, value in tree.items() if key not in old} if old else tree


@cache
def _switches(table: type[Table]) -> tuple[tuple[str, Any], ...]:
    """The switches and their defaults."""
    return tuple((switch, table.model_fields[switch].default) for switch in table.switches)


@lru_cache(maxsize=64)
def _defaults(table: type[Table], setting: tuple[str, ...]) -> dict[str, Any]:
    """What a setting of the switches fills in."""
    return {key: value for key, value in table.owned.get(setting, {}).items() if value is not ...}


@cache
def _owned(table: type[Table]) -> tuple[str, ...]:
    """The fields of a table that go with some settings of its switches only."""
    return tuple(sorted({name for fields in table.owned.values() for name in fields}))


def _about(table: type[BaseModel], field: str) -> str:
    return f": {table.model_fields[field].description}"


# --- tables


LATTICES = ("lattice", "triangular")  # sources of nodes that are built in


class Domain(Table):
    """The simulated box. Nothing crosses its walls."""

    size: Edges
    """edge lengths, nm; two: 2-D, three: 3-D; the lower corner is the origin"""


class Nodes(Table):
    """Where the mesh of nodes and material points comes from."""

    switches: ClassVar = ("source",)
    owned: ClassVar = {
        ("lattice",): {"spacing": ...}, ("triangular",): {"spacing": ...}, ("gmsh",): {"spacing": ...},
        ("file",): {"path": ...},
    }  # fmt: skip
    alone: ClassVar = ("spacing",)

    source: Literal["lattice", "triangular", "gmsh", "file"] = "lattice"
    """lattice: square or cubic; triangular: body-centred in 3-D; gmsh: meshed by gmsh; file: read by meshio"""
    spacing: Positive | None = None
    """h, nm: nodal spacing (lattice, triangular, gmsh)"""
    path: Text | None = None
    """mesh of triangles or tetrahedra; relative to the case file (file)"""

    def essence(self, tree: dict[str, Any]) -> dict[str, Any]:
        """A mesh file counts by its content, wherever it is."""
        tree = super().essence(tree)
        if self.path is None:
            return tree
        return tree | {"path": hashlib.sha256(Path(self.path).read_bytes()).hexdigest()}


class Points(Table):
    """The material points, which integrate; `linear` shape functions stand on the mesh, and make no use of this."""

    switches: ClassVar = ("source",)
    owned: ClassVar = {("lattice",): {"pitch": None}, ("cells",): {}}
    added: ClassVar = {"source": "lattice"}

    source: Literal["lattice", "cells"] = "lattice"
    """lattice: a regular lattice of their own over the domain (gmsh, file; those of built-in nodes are one already);
    cells: the barycentres of the mesh, as in the paper"""
    pitch: Positive | None = None
    """nm: edge of the cube that each point has to itself (lattice; default: 0.72 mean distances of the nodes)"""


class ShapeFunctions(Table):
    """How fields are interpolated between the nodes; `linear` makes no use of gamma, width and tolerance."""

    alone: ClassVar = ("kind", "gamma", "width", "tolerance")

    kind: Literal["lme", "linear"] = "lme"
    """N_a, eq. (17): local maximum entropy, or linear finite elements on the same mesh"""
    gamma: Annotated[float, FINITE, Field(ge=0.5, le=6)] = 1.8
    """gamma [1]: N_a = exp(-gamma |x - x_a|^2 / h^2 + lambda . (x - x_a)) / Z (lme)"""
    width: Positive | None = None
    """h, nm, the same for all functions (lme; default: the spacing of a lattice, else by the largest gap between
    nodes)"""
    tolerance: Annotated[float, FINITE, Field(gt=0, lt=0.1)] = 1e-6
    """delta_0 [1]: N_a is dropped where exp(-gamma r^2 / h^2) < delta_0 (lme)"""


class Particles(Table):
    """Spheres (discs in 2-D) or boxes. Fields of another source are absent: None, or an empty tuple."""

    switches: ClassVar = ("source", "shape")
    owned: ClassVar = {
        ("list", "sphere"): {"centres": ..., "radii": ...},
        ("list", "box"): {"centres": ..., "sizes": ...},
        ("file", "sphere"): {"path": ..., "units": "nm"},
        ("packing", "sphere"): {"method": ..., "distribution": "normal", "mean_radius": None, "std_radius": None}
        | {"truncation": None, "histogram": (), "packing_density": None, "count": None, "seed": 0, "container": ...}
        | {"friction": 0.0, "exchange": False},
    }
    alone: ClassVar = (
        "mean_radius", "std_radius", "truncation", "packing_density", "count", "seed", "interface_width"
    )  # fmt: skip

    source: Literal["list", "file", "packing"] = "list"
    """list: given here; file: a CSV, read into a list at once; packing: drawn and packed before the run"""
    shape: Literal["sphere", "box"] = "sphere"
    """box: with source = 'list' only"""
    centres: Annotated[tuple[Point, ...], LONG] = ()
    """r(a), nm: a point per particle (list)"""
    radii: Annotated[tuple[Positive, ...], LONG] = ()
    """R_a, nm, eq. (34): one per particle (list of spheres)"""
    sizes: Annotated[tuple[Edges, ...], LONG] = ()
    """edge lengths, nm: one set per particle (list of boxes)"""
    path: Text | None = None
    """CSV of x,y[,z],radius, or a .cloud file of x y z r; relative to the case file (file)"""
    units: Literal["nm", "um", "mm", "m"] | None = None
    """of the lengths in that file (file; default nm)"""
    method: Literal["pour", "density"] | None = None
    """pour: gravity fills the container, along the last axis; density: a lid presses the particles in the container
    to a solid fraction (packing; default: density where packing_density is given, pour where count is)"""
    distribution: Literal["normal", "lognormal", "histogram"] | None = None
    """of the radii (packing; default normal)"""
    mean_radius: Positive | None = None
    """mean of the radii, nm (packing)"""
    std_radius: NonNegative | None = None
    """standard deviation of the radii, nm (packing; default 0)"""
    truncation: Annotated[float, FINITE, Field(gt=0, le=6)] | None = None
    """radii are drawn within this many standard deviations of the mean [1], and not below a fifth of it; for
    lognormal: of the logarithm (packing; default 3)"""
    histogram: Annotated[tuple[tuple[Positive, Positive], ...], LONG] = ()
    """pairs of radius, nm, and weight [1], instead of mean_radius and std_radius (packing, histogram)"""
    packing_density: Fraction | None = None
    """solid fraction [1], within 0.005, of output.vacancy_box, or of the container where that box is not inside it
    or particles are poured (packing; this or count)"""
    count: Annotated[int, Field(strict=True, ge=1, le=MOST_PARTICLES)] | None = None
    """number of particles (packing; this or packing_density)"""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**63)] | None = None
    """seed of the random draw (packing; default 0)"""
    container: Box | None = None
    """lower and upper corner of the packed box, nm (packing)"""
    friction: NonNegative | None = None
    """Coulomb's coefficient between particles [1]; walls are smooth (packing, pour; default 0)"""
    exchange: Flag | None = None
    """let shaken particles exchange radii: denser than random close packing where radii differ (packing, density;
    default false)"""
    interface_width: Positive = 1.0
    """xi, nm: eta(a) = (1 - tanh((d_a - R_a) / xi)) / 2 at t = 0, eq. (34)"""

    @model_validator(mode="after")
    def _counts_agree(self) -> Self:
        name = "sizes" if self.shape == "box" else "radii"
        given, n = getattr(self, name), len(self.centres)
        if self.source == "list" and len(given) != n:
            raise CaseError([Problem(name, list(given[:9]), f"must be {n}, one per centre, not {len(given)}")])
        _refuse(_mixed(self))
        if self.source == "packing":
            _refuse(_packing_problems(self))
        return self

    def tree(self) -> dict[str, Any]:
        """Lists of another source or shape are absent, not empty."""
        return {key: value for key, value in super().tree().items() if value != []}

    @model_validator(mode="before")
    @classmethod
    def _choose(cls, tree: object) -> object:
        """Defaults of a packing that depend on what else was given."""
        if not isinstance(tree, Mapping) or tree.get("source") != "packing":
            return tree
        given = {key: value for key, value in tree.items() if value is not None}
        drawn = {} if given.get("distribution") == "histogram" else {"std_radius": 0.0, "truncation": 3.0}
        return {"method": "pour" if "count" in given else "density"} | drawn | given

    def extents(self) -> tuple[Floats, Floats]:
        """Centres, and half widths along the axes, of a list: both (particles, dim)."""
        centres = np.array(self.centres, dtype=float)
        if self.shape == "box":
            return centres, 0.5 * np.array(self.sizes, dtype=float)
        return centres, np.repeat(np.array(self.radii, dtype=float)[:, None], centres.shape[1], axis=1)

    def smallest(self) -> float:
        """The smallest radius or half edge of a list, nm."""
        return 0.5 * min(map(min, self.sizes)) if self.shape == "box" else min(self.radii)

    def bounds(self) -> Box:
        """Lower and upper corner of the container of a packing, or of the box around a list."""
        if self.container is not None:
            return self.container
        centres, half = self.extents()
        return tuple((centres - half).min(axis=0).tolist()), tuple((centres + half).max(axis=0).tolist())


class Model(Table):
    """Coefficients; the defaults are those of Table 2."""

    alone: ClassVar = (
        "A", "B", "L", "kappa_rho", "kappa_eta", "D_vol", "D_vap", "D_surf", "D_gb", "m_t", "m_r", "k", "rho_0", "c",
        "rigid_motion", "advection",
    )  # fmt: skip

    A: NonNegative = 16.0
    """A [1]: double well A rho^2 (1 - rho)^2, eq. (2)"""
    B: NonNegative = 1.0
    """B [1]: coupling of rho and eta, eq. (2)"""
    L: Positive = 10.0
    """L [1]: boundary mobility, eq. (4)"""
    kappa_rho: Positive = 10.0
    """kappa_rho [nm^2]: gradient energy of rho, eq. (1)"""
    kappa_eta: Positive = 1.0
    """kappa_eta [nm^2]: gradient energy of eta, eq. (1)"""
    D_vol: NonNegative = 0.01
    """D_vol [nm^2]: diffusivity in the solid, eq. (5)"""
    D_vap: NonNegative = 0.001
    """D_vap [nm^2]: diffusivity in the vapour, eq. (5)"""
    D_surf: NonNegative = 4.0
    """D_surf [nm^2]: diffusivity along surfaces, eq. (5)"""
    D_gb: NonNegative = 0.4
    """D_gb [nm^2]: diffusivity along grain boundaries, eq. (5)"""
    m_t: NonNegative = 500.0
    """m_t [1]: mobility of translation, eq. (10)"""
    m_r: NonNegative = 1.0
    """m_r [1]: mobility of rotation, eq. (10)"""
    k: NonNegative = 100.0
    """k [1]: stiffness of the sintering force, eq. (6)"""
    rho_0: NonNegative = 0.9816
    """rho_0 [1]: density of a grain boundary at rest, eq. (6)"""
    c: Fraction = 0.14
    """c [1]: the force acts where eta(a) eta(b) > c, eq. (7)"""
    rigid_motion: Flag = True
    """whether particles move as rigid bodies, eqs. (6)-(11)"""
    advection: Literal["huang", "wang"] = "huang"
    """v_adv: sum of eta(a) v(a), eq. (11), or sum of v(a), Wang (2006)"""


class Time(Table):
    """The run lasts from t = 0 to `end`, in the model's own unit of time."""

    switches: ClassVar = ("integrator",)
    owned: ClassVar = {("adaptive",): {"tolerance": 1e-3}, ("rk2",): {"step": None}}
    alone: ClassVar = ("end", "tolerance", "step")

    end: Positive
    """t at the end of the run [1]"""
    integrator: Literal["adaptive", "rk2"] = "adaptive"
    """adaptive: with error control; rk2: two half Euler steps, eq. (32)"""
    tolerance: Positive | None = None
    """error allowed per step [1] (adaptive; default 0.001)"""
    step: Positive | None = None
    """dt [1] (rk2; default: the paper's rule, 0.1 d_min^2 / (2 L kappa_eta))"""


class Activation(Table):
    """What a run may skip: material points (section 2.4) and order parameters (section 2.5)."""

    alone: ClassVar = ("enabled", "eps_rho", "eps_eta", "few_order_parameters")

    enabled: Flag = True
    """switch off material points where both gradients are below their bounds, section 2.4"""
    eps_rho: NonNegative = 1e-5
    """eps_rho [1/nm]: bound on |grad rho|, section 2.4"""
    eps_eta: NonNegative = 1e-5
    """eps_eta [1/nm]: bound on every |grad eta(a)|, section 2.4"""
    few_order_parameters: Flag = True
    """store only non-zero eta(a), in shared slots, section 2.5; false: a slot per particle everywhere"""


class Every(Table):
    """Evenly spaced snapshots, the other form of a list of times."""

    every: Positive
    """model time between snapshots [1], from t = 0"""


def _form(snapshots: object) -> str:
    return "|every" if isinstance(snapshots, Mapping | Every) else "|times"


Times = Annotated[tuple[NonNegative, ...], LONG, Tag("|times")]
Snapshots = Annotated[Times | Annotated[Every, Tag("|every")], Discriminator(_form)]


class Output(Table):
    """When and where to look. What a case file leaves out is filled in by `Case`, from the other tables."""

    model_config = ConfigDict(json_schema_extra=lambda schema: schema.update(required=[]))
    alone: ClassVar = ("history_every", "snapshots", "vacancy_box", "checkpoint_every")
    added: ClassVar = {"history_change": 0.02}

    history_every: Positive
    """model time between history rows [1] (default: time.end / 100)"""
    history_change: Annotated[float, FINITE, Field(ge=0, le=1), AfterValidator(_not_tiny)] = 0.02
    """also a row whenever the vacancy ratio has moved by this part of its first value [1], at least 0.001; 0: no such
    rows"""
    snapshots: Snapshots
    """increasing times [1] up to time.end, or { every = ... } (default: [0, time.end])"""
    vacancy_box: Box
    """corners, nm, of the box of the vacancy ratio R_v (default: the container, or the box around the
    particles, shrunk to 80 % about its centre)"""
    checkpoint_every: Positive = 60.0
    """wall-clock seconds between checkpoints"""
    keep_checkpoint: Flag = False
    """whether the last one stays when the run has come to its end"""

    def essence(self, tree: dict[str, Any]) -> dict[str, Any]:
        """Checkpoints change nothing."""
        return {key: value for key, value in super().essence(tree).items() if "checkpoint" not in key}

    def snapshot_count(self, end: float) -> float:
        """How many snapshots a run to `end` writes, reckoned without making them."""
        if isinstance(self.snapshots, Every):
            return amounts.times(end, self.snapshots.every)
        return float(len(self.snapshots))

    def snapshot_times(self, end: float) -> tuple[float, ...]:
        """The times [1] of all snapshots of a run to `end`; round-off does not lose the last of `every`."""
        if not isinstance(self.snapshots, Every):
            return self.snapshots
        every = self.snapshots.every
        return tuple(takewhile(lambda t: t <= end * (1 + 1e-12), (k * every for k in count())))


class Case(Table):
    """A resolved case: every default filled in, every file found or read, every check passed."""

    name: Name = "untitled"
    """free text, without effect on the result"""
    domain: Domain
    """the box that is simulated"""
    nodes: Nodes
    """where rho and eta are stored"""
    points: Points = Points()
    """where the equations are integrated"""
    shape_functions: ShapeFunctions = ShapeFunctions()
    """how they are interpolated"""
    particles: Particles
    """the solid at t = 0"""
    model: Model = Model()
    """coefficients, Table 2"""
    time: Time
    """how long, and how integrated"""
    activation: Activation = Activation()
    """what may be skipped"""
    output: Output = Field(default_factory=dict, validate_default=True)
    """what is written, and when"""

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.domain.size)

    @field_validator("nodes")
    @classmethod
    def _find_mesh(cls, nodes: Nodes, info: ValidationInfo) -> Nodes:
        if nodes.path is None:
            return nodes
        path = _absolute(nodes.path, info)
        if not os.path.isfile(path):
            raise CaseError([Problem("path", path, "must be a file, and there is none")])
        return nodes.model_copy(update={"path": path})

    @field_validator("particles")
    @classmethod
    def _read_list(cls, particles: Particles, info: ValidationInfo) -> Particles:
        if particles.path is None or "domain" not in info.data:
            return particles
        path = _absolute(particles.path, info)
        try:
            centres, radii = particle_file.read(path, len(info.data["domain"].size), particles.units or "nm")
        except ParticleFileError as error:
            raise CaseError((Problem("path", path, text) for text in error.problems), error.more) from error
        width = particles.interface_width
        return Particles(centres=centres.tolist(), radii=radii.tolist(), interface_width=width)

    @field_validator("output", mode="before")
    @classmethod
    def _fill_in(cls, tree: object, info: ValidationInfo) -> object:
        """Where another table is refused, any valid value will do."""
        if not isinstance(tree, Mapping):
            return tree
        end = info.data["time"].end if "time" in info.data else 1.0
        return filled_in(tree, end, info.data.get("domain"), info.data.get("particles"))

    @field_validator("particles", "output")
    @classmethod
    def _same_dimension(cls, table: Table, info: ValidationInfo) -> Table:
        if "domain" in info.data:
            _refuse(wrong_dimensions(table, len(info.data["domain"].size)))
        return table

    @model_validator(mode="after")
    def _tables_agree(self, info: ValidationInfo) -> Self:
        _refuse(disagreements(self, kept=bool((info.context or {}).get("kept"))))
        return self

    def with_particles(self, centres: ArrayLike, radii: ArrayLike) -> "Case":
        """The case with spheres, (n, dim) and (n,), for its particles: what a packing turns into."""
        spheres = {
            "centres": np.asarray(centres, dtype=float).tolist(),
            "radii": np.asarray(radii, dtype=float).tolist(),
            "interface_width": self.particles.interface_width,
        }
        return parse_case({**self.tree(), "particles": spheres}, kept=True)

    def tables(self) -> dict[str, Table]:
        """All that has a table of its own, in the order of the case file."""
        return {name: value for name, value in vars(self).items() if name != "name"}

    def tree(self) -> dict[str, Any]:
        """The case as plain values, which need no defaults and no CSV: `parse_case` gives an equal case."""
        return {"name": self.name} | {name: table.tree() for name, table in self.tables().items()}

    def resolved_json(self) -> str:
        """The tree as a JSON case file."""
        return json.dumps(self.tree(), indent=2, ensure_ascii=False) + "\n"

    def identity(self) -> str:
        """SHA-256 of all that changes the result: the essence of every table."""
        tables = self.tables().items()
        return fingerprint({name: canonical(table.essence(table.tree())) for name, table in tables})


def _mixed(given: Particles) -> Iterator[Problem]:
    """Sizes that no mesh resolves together."""
    edges = given.radii or tuple(chain.from_iterable(given.sizes)) or tuple(radius for radius, _ in given.histogram)
    if edges and max(edges) > MIXED * min(edges):
        name = "radii" if given.radii else "sizes" if given.sizes else "histogram"
        yield Problem(name, [min(edges), max(edges)], f"the largest must be at most {MIXED:g} times the smallest")


def _packing_problems(given: Particles) -> Iterator[Problem]:
    if (given.count is None) == (given.packing_density is None):
        yield Problem("packing_density", given.packing_density, "give either this or count")
    drawn = ("mean_radius", "std_radius", "truncation")
    if given.distribution != "histogram":
        if given.mean_radius is None:
            about = _about(Particles, "mean_radius")
            yield Problem("mean_radius", None, f"must be given with source = 'packing'{about}")
        if given.histogram:
            yield Problem("histogram", given.histogram, "belongs to distribution = 'histogram'")
    else:
        if not given.histogram:
            yield Problem("histogram", None, f"must be given{_about(Particles, 'histogram')}")
        for name in drawn:
            if (value := getattr(given, name)) is not None:
                yield Problem(name, value, "does not belong to distribution = 'histogram'")
    if given.method == "pour" and given.exchange:
        yield Problem("exchange", True, "must be false with method = 'pour'")
    if given.method == "density" and given.friction:
        yield Problem("friction", given.friction, "must be 0 with method = 'density', which presses without friction")


def canonical(tree: Mapping[str, Any]) -> str:
    """The one JSON text of a tree."""
    return CANONICAL.encode(tree)


def fingerprint(tables: Mapping[str, str]) -> str:
    """SHA-256 of a case, from the canonical text of each table; a table that says nothing is left out."""
    body = ", ".join([f'"{name}": {tables[name]}' for name in sorted(tables) if tables[name] != "{}"])
    return hashlib.sha256(f"{{{body}}}".encode()).hexdigest()


# --- across tables


def filled_in(
    output: Mapping[str, Any], end: float, domain: Domain | None, particles: Particles | None
) -> dict[str, Any]:
    """The plain table with the defaults that need other tables."""
    given = {key: value for key, value in output.items() if value is not None}
    if "vacancy_box" not in given:
        given["vacancy_box"] = _inner_box(domain, particles)
    return {"history_every": end / 100, "snapshots": (0.0, end)} | given


def wrong_dimensions(table: Table, dim: int) -> Iterator[Problem]:
    """Points and edges of a table that are not `dim` numbers."""
    fields = vars(table)
    for field in ("centres", "sizes", "container", "vacancy_box"):
        for i, point in enumerate(fields.get(field) or ()):
            if len(point) != dim:
                yield Problem(f"{field}[{i}]", list(point), f"must be {dim} numbers, as domain.size is")


def disagreements(case: Case, agreed: bool = False, kept: bool = False) -> Iterator[Problem]:
    """What is wrong between tables that are right by themselves.

    agreed: particles, domain and boxes are known to fit; kept: the case was accepted before, maybe by fewer rules.
    """
    if case.particles.source == "list" and not agreed:
        yield from _particles_inside(case)
        yield from _particles_apart(case)
    yield from _particles_resolved(case)
    yield from _interface_held(case, kept)
    yield from _points_of_their_own(case)
    if not agreed:
        yield from _boxes_inside(case)
    yield from _times_in_order(case)
    yield from _can_be_counted(case)


def _inner_box(domain: Domain | None, particles: Particles | None) -> Box:
    """The container, or the box around the particles, shrunk to 80 % about its centre, within the domain."""
    size = domain.size if domain else (1.0, 1.0)
    spans = [(0.0, edge) for edge in size]
    if domain and particles:
        spans = [
            (min(max(low + 0.1 * (high - low), 0.0), edge), min(max(high - 0.1 * (high - low), 0.0), edge))
            for low, high, edge in zip(*particles.bounds(), size, strict=True)
        ]
    if not all(low < high for low, high in spans):  # the particles are refused themselves: they are the problem
        spans = [(0.0, edge) for edge in size]
    lower, upper = zip(*spans, strict=True)
    return lower, upper


def _beyond(low: float, high: float, edge: float) -> bool:
    """Whether a span sticks out of [0, edge] by more than round-off."""
    return low < -ROUND_OFF * edge or high > edge * (1 + ROUND_OFF)


def _outside(lower: Floats, upper: Floats, case: Case) -> Flags:
    size = np.array(case.domain.size)
    outside: Flags = (lower < -ROUND_OFF * size) | (upper > size * (1 + ROUND_OFF))
    return np.asarray(outside.any(axis=-1))


def _particles_inside(case: Case) -> Iterator[Problem]:
    centres, half = case.particles.extents()
    domain = f"must stay in the domain, {list(case.domain.size)}"
    for i in np.flatnonzero(_outside(centres - half, centres + half, case)):
        allowed = f"reaches {half[i].tolist()} to each side, {domain}"
        yield Problem(f"particles.centres[{i}]", centres[i].tolist(), allowed)


def _particles_apart(case: Case) -> Iterator[Problem]:
    """R_i + R_j - |r_i - r_j| <= min(R_i, R_j) / 2; for boxes along the axis of the least overlap."""
    centres, half = case.particles.extents()
    boxes = case.particles.shape == "box"
    found: list[tuple[int, int, float, float]] = []
    for i, j in overlaps.near_pairs(centres, half):
        away, reach = np.abs(centres[i] - centres[j]), half[i] + half[j]
        shared = (reach - away).min(axis=1) if boxes else reach[:, 0] - np.linalg.norm(away, axis=1)
        limit = 0.5 * np.minimum(half[i].min(axis=1), half[j].min(axis=1))
        bad = np.flatnonzero(shared > limit * (1 + ROUND_OFF))[:MOST_COUNTED]
        found += zip(i[bad].tolist(), j[bad].tolist(), shared[bad].tolist(), limit[bad].tolist(), strict=True)
        if len(found) > MOST_COUNTED:
            break
    for first, second, overlap, most in sorted(found):
        allowed = f"overlaps particles.centres[{first}] by {overlap:g} nm, must be at most {most:g}"
        yield Problem(f"particles.centres[{second}]", centres[second].tolist(), allowed)


def _particles_resolved(case: Case) -> Iterator[Problem]:
    """h <= the smallest radius or half edge; before a packing is drawn only the mean is known."""
    spacing, given = case.nodes.spacing, case.particles
    if given.source == "packing":
        smallest, what = given.mean_radius or min(radius for radius, _ in given.histogram), "particles.mean_radius"
    else:
        smallest, what = given.smallest(), "the smallest radius or half edge"
    if spacing is not None and spacing > smallest:
        yield Problem("nodes.spacing", spacing, f"must be at most {what}, {smallest}")


def _interface_held(case: Case, kept: bool) -> Iterator[Problem]:
    """Lengths in another unit, and nodes too far apart; see `resolution`."""
    width, given = resolution.boundary_width(case.model.kappa_eta, case.model.B), case.particles
    if kept or width is None:
        return
    if given.source == "packing":
        largest = given.mean_radius or max(radius for radius, _ in given.histogram)
        named = "particles.mean_radius" if given.mean_radius else "particles.histogram"
    else:
        named, largest = "particles.sizes", 0.5 * max(chain.from_iterable(given.sizes), default=0.0)
        if given.radii:
            named, largest = "particles.radii", max(given.radii)
    found = resolution.wrong_lengths(width, given.interface_width, (named, largest), case.nodes.spacing)
    for key, allowed in found:
        yield Problem(key, case.nodes.spacing if key == "nodes.spacing" else largest, allowed)


def _points_of_their_own(case: Case) -> Iterator[Problem]:
    """A pitch has an effect, and gives no more points than can be numbered."""
    pitch = case.points.pitch
    if pitch is None:
        return
    if case.nodes.source in LATTICES or case.shape_functions.kind == "linear":
        allowed = "must be left out: built-in nodes and linear functions come with points (gmsh or file, lme)"
        yield Problem("points.pitch", pitch, allowed)
    least = (math.prod(case.domain.size) / MOST_POINTS) ** (1.0 / case.dim)
    if pitch < least:
        yield Problem("points.pitch", pitch, f"must be at least {least:.3g}: at most {MOST_POINTS} points")


def _boxes_inside(case: Case) -> Iterator[Problem]:
    size = case.domain.size
    boxes = {"particles.container": case.particles.container, "output.vacancy_box": case.output.vacancy_box}
    for key, box in boxes.items():
        if box is None:
            continue
        if any(map(ge, *box)):
            yield Problem(key, list(box), "must be [lower corner, upper corner], lower along every axis")
        elif any(map(_beyond, *box, size)):
            yield Problem(key, list(box), f"must be inside the domain, {list(size)}")


def _times_in_order(case: Case) -> Iterator[Problem]:
    end, step, snapshots = case.time.end, case.time.step, case.output.snapshots
    if step is not None and step > end:
        yield Problem("time.step", step, f"must be at most time.end, {end}")
    times = () if isinstance(snapshots, Every) else snapshots
    for i, (before, t) in enumerate(pairwise((-math.inf, *times))):
        if t > end:
            yield Problem(f"output.snapshots[{i}]", t, f"must be at most time.end, {end}")
        if t <= before:
            yield Problem(f"output.snapshots[{i}]", t, f"must be greater than the time before, {before}")


def _can_be_counted(case: Case) -> Iterator[Problem]:
    """What is asked for in numbers beyond all memory, time or kinds of integers."""
    end, output, h = case.time.end, case.output, case.nodes.spacing
    if h is not None and (n := amounts.nodes(case.domain.size, h)) > MOST_NODES:
        yield Problem("nodes.spacing", h, f"gives about {n:.3g} nodes, must be at most {MOST_NODES}")
    if (n := amounts.times(end, every := output.history_every)) > MOST_ROWS:
        yield Problem("output.history_every", every, f"gives {n:.3g} rows, must be at most {MOST_ROWS:g}")
    if (n := output.snapshot_count(end)) > MOST_SNAPSHOTS:
        yield Problem(*snapshots_by(output), f"gives {n:.3g} snapshots, must be at most {MOST_SNAPSHOTS:g}")
    step = (case.time.step or _rule(case)) if case.time.integrator == "rk2" else None
    if step is not None and (n := amounts.quotient(end, step)) > MOST_STEPS:
        yield Problem("time.end", end, f"takes {n:.3g} steps of {step:g}, must be at most {MOST_STEPS:g}")


def snapshots_by(output: Output) -> tuple[str, float | None]:
    """The key that decides how many snapshots there are, and its value where that is a number."""
    if isinstance(output.snapshots, Every):
        return "output.snapshots.every", output.snapshots.every
    return "output.snapshots", None


def _rule(case: Case) -> float | None:
    """The step of rk2 where none is given; None: not known before a mesh is read."""
    h = case.nodes.spacing
    return None if h is None else amounts.paper_step(h, case.model.L, case.model.kappa_eta)


# --- reading


def case_schema() -> dict[str, Any]:
    """JSON Schema of a case file; which fields go with which source is in the descriptions only."""
    return Case.model_json_schema()


def load_case(path: Path | str, kept: bool = False) -> Case:
    """The case in a TOML or JSON file; see `parse_case`. Raises `CaseError`."""
    return parse_case(read_tree(path), Path(path).parent, kept)


def read_tree(path: Path | str) -> Any:
    """What a TOML or JSON file holds, as plain values. Raises `CaseError`."""
    path = Path(path)
    readers: dict[str, Callable[[str], Any]] = {".toml": tomllib.loads, ".json": json.loads}
    if path.suffix not in readers:
        raise CaseError([Problem(str(path), None, "must end in .toml or .json")])
    try:
        return readers[path.suffix](path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CaseError([Problem(str(path), None, f"cannot be read: {error.strerror}")]) from error
    except (ValueError, RecursionError) as error:
        kind = path.suffix[1:].upper()
        raise CaseError([Problem(str(path), None, f"not valid {kind}: {error}")]) from error


def parse_case(tree: Mapping[str, Any], base: Path | None = None, kept: bool = False) -> Case:
    """The case in a tree of plain values; relative paths start from `base`; kept: it was accepted before.

    Raises `CaseError`.
    """
    _refuse(_not_a_case(tree))
    try:
        return Case.model_validate(tree, context={"base": base, "kept": kept})
    except ValidationError as error:
        raise refusal(error, _table) from None


def _not_a_case(tree: object) -> Iterator[Problem]:
    """Of a sweep in the place of a case, one sentence instead of a line for each of its keys."""
    if isinstance(tree, Mapping) and "base" in tree:
        yield Problem("base", None, "this is a sweep, not a case: `frit sweep run` and `frit submit` take sweeps")


def refusal(error: ValidationError, table_at: Callable[[Place], type[BaseModel]]) -> CaseError:
    """What pydantic refused, in the words of a case file; `table_at` gives the table that holds a key."""
    causes = [entry.get("ctx", {}).get("error") for entry in error.errors(include_url=False, include_input=False)]
    more = sum(cause.more for cause in causes if isinstance(cause, CaseError))
    return CaseError(problems(error, table_at), more)


def _absolute(path: str, info: ValidationInfo) -> str:
    return os.path.abspath(((info.context or {}).get("base") or Path()) / path)


def problems(error: ValidationError, table_at: Callable[[Place], type[BaseModel]]) -> Iterator[Problem]:
    """What pydantic refused, in the words of a case file; `table_at` gives the table that holds a key."""
    entries = error.errors(include_url=False)
    inside = {entry["loc"][:-1] for entry in entries}
    for entry in entries:
        loc, kind, cause = entry["loc"], entry["type"], entry.get("ctx", {}).get("error")
        if isinstance(cause, CaseError):
            start = f"{_dotted(loc)}." if loc else ""
            yield from (replace(problem, key=start + problem.key) for problem in cause.problems)
        elif kind == "too_short" and loc in inside:
            continue  # it counts the refused items as lacking
        elif kind == "missing":
            about = _about(table_at(loc), loc[-1]) if isinstance(loc[-1], str) else ""
            yield Problem(_dotted(loc), None, f"must be given{about}")
        else:
            allowed = PLAIN.get(kind) or re.sub(r"^\w+ should ", "must ", entry["msg"]).replace(" after validation", "")
            if kind == "extra_forbidden":
                allowed = _known(str(loc[-1]), table_at(loc))
            yield Problem(_dotted(loc), entry["input"], allowed)


def _dotted(loc: Place) -> str:
    """The key as TOML writes it: a name that has dots itself is quoted."""
    names = (f'"{part}"' if "." in str(part) else part for part in loc if str(part)[:1] != "|")
    parts = (f"[{name}]" if isinstance(name, int) else f".{name}" for name in names)
    return "".join(parts).removeprefix(".") or "case"


def _table(loc: Place) -> type[BaseModel]:
    """The table that holds the key at `loc`."""
    table: Any = Case
    for part in loc[:-1]:
        table = Every if part in ("snapshots", "|every") else table.model_fields[part].annotation
    found: type[BaseModel] = table
    return found


def _known(name: str, table: type[BaseModel]) -> str:
    known = list(table.model_fields)
    close = difflib.get_close_matches(name[:LONGEST_KEY], known, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"unknown key; allowed here: {', '.join(known)}{hint}"


def unknown_part(key: str) -> str | None:
    """What is allowed in place of the first part of a dotted key that no case has; None: the key exists."""
    table: type[BaseModel] | None = Case
    parts = key.split(".")
    for depth, part in enumerate(parts, start=1):
        if table is None:
            return f"{'.'.join(parts[: depth - 1])} has no keys below it"
        if part not in table.model_fields:
            return _known(part, table)
        below = Every if part == "snapshots" else table.model_fields[part].annotation
        table = below if isinstance(below, type) and issubclass(below, BaseModel) else None
    return None
