"""The sweep file: a case, the axes along which it varies, and how points are chosen from them."""

import copy
import json
import os
from collections.abc import Iterator, Mapping
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, model_validator

from frit.solver.case import CaseError, Place, Problem, case_schema, read_tree, refusal, showable, unknown_part

# Keys that change no result: axes along them would repeat one case.
FREE = ("name", "output.checkpoint_every", "output.keep_checkpoint")

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Whole = Annotated[int, Field(strict=True)]
# Every point has the words of its sweep: they are short, as those of a job are.
Name = Annotated[str, Field(strict=True, max_length=500), AfterValidator(showable)]
Label = Annotated[str, Field(strict=True, max_length=100), AfterValidator(showable)]


class Part(BaseModel):
    """A table of the sweep file."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class Spacing(Part):
    """Evenly spaced values [start, stop, how many], as numpy's function of the same name gives them."""

    linspace: tuple[Number, Number, Annotated[Whole, Field(ge=1)]] | None = None
    """evenly spaced from start to stop"""
    logspace: tuple[Number, Number, Annotated[Whole, Field(ge=1)]] | None = None
    """from 10^start to 10^stop, evenly spaced exponents"""
    geomspace: tuple[Number, Number, Annotated[Whole, Field(ge=1)]] | None = None
    """from start to stop with a constant ratio; both greater than 0"""

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        given = self.given()
        if len(given) != 1:
            words = "give exactly one of linspace, logspace, geomspace"
            raise CaseError([Problem(" and ".join(given) or "linspace", None, words)])
        if self.geomspace is not None and min(self.geomspace[:2]) <= 0:
            raise CaseError([Problem("geomspace", list(self.geomspace), "start and stop must be greater than 0")])
        if self.logspace is not None and max(map(abs, self.logspace[:2])) > 300:
            raise CaseError([Problem("logspace", list(self.logspace), "takes exponents of 10, between -300 and 300")])
        return self

    def given(self) -> dict[str, tuple[float, float, int]]:
        """The function's name and its arguments."""
        return {name: value for name, value in self if value is not None}


class Range(Part):
    """What random, lhs and sobol draw from."""

    low: Number
    """smallest value"""
    high: Number
    """largest value"""
    log: Annotated[bool, Field(strict=True)] = False
    """whether the logarithm is what is evenly distributed"""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.low < self.high:
            raise CaseError([Problem("high", self.high, f"must be greater than low, {self.low}")])
        if self.log and self.low <= 0:
            raise CaseError([Problem("low", self.low, "must be greater than 0 with log = true")])
        return self


def _form(axis: object) -> str:
    if isinstance(axis, Spacing | Range):
        return "|spacing" if isinstance(axis, Spacing) else "|range"
    if not isinstance(axis, Mapping):
        return "|values"
    return "|range" if {"low", "high"} & axis.keys() else "|spacing"


Values = Annotated[tuple[Any, ...], Field(min_length=1)]
Axis = Annotated[
    Annotated[Values, Tag("|values")] | Annotated[Spacing, Tag("|spacing")] | Annotated[Range, Tag("|range")],
    Discriminator(_form),
]


class Sample(Part):
    """Which points of the axes are computed."""

    drawn: ClassVar = ("random", "lhs", "sobol")

    method: Literal["grid", "zip", "random", "lhs", "sobol"] = "grid"
    """grid: every combination, the last axis fastest; zip: first values together, second values together, ...;
    random, lhs (Latin hypercube), sobol: `points` drawn from ranges. More points keep the first ones with random and
    sobol; a Latin hypercube of another size has no point in common"""
    points: Annotated[Whole, Field(ge=1)] | None = None
    """how many points are drawn (random, lhs, sobol)"""
    replicates: Annotated[Whole, Field(ge=1)] = 1
    """packings per point: the first has the seed of the case, the others spawned ones, the same at every point"""
    seed: Annotated[Whole, Field(ge=0)] = 0
    """seed of the points that are drawn and of the replicates' seeds"""

    @model_validator(mode="after")
    def _points_fit_method(self) -> Self:
        drawn = self.method in self.drawn
        if drawn and self.points is None:
            raise CaseError([Problem("points", None, f"must be given with method = {self.method!r}")])
        if not drawn and self.points is not None:
            raise CaseError([Problem("points", self.points, f"does not belong to method = {self.method!r}")])
        return self


class Sweep(Part):
    """A checked definition. Whether its points are possible cases shows when it is expanded."""

    name: Name = "untitled"
    """free text; names of points start with it"""
    ranks: Annotated[Whole, Field(ge=1)] = 1
    """MPI ranks per job"""
    priority: Annotated[Whole, Field(ge=-1_000_000, le=1_000_000)] = 0
    """jobs of higher priority start first"""
    tags: Annotated[tuple[Label, ...], Field(max_length=50, fail_fast=True)] = ()
    """free labels of the jobs"""
    base: dict[str, Any]
    """a case; in a file also the path of one, relative to it. What an axis sets may be left out"""
    axes: dict[str, Axis] = {}
    """dotted keys of the case, each with a list of values, { linspace | logspace | geomspace = [start, stop, n] } or
    a range { low, high, log }"""
    sample: Sample = Sample()
    """which points of the axes are computed"""

    @model_validator(mode="after")
    def _axes_fit(self) -> Self:
        if found := [*self._wrong_keys(), *self._wrong_values(), *self._wrong_lengths(), *self._wrong_replicates()]:
            raise CaseError(found)
        return self

    def _wrong_keys(self) -> Iterator[Problem]:
        for key in self.axes:
            if allowed := unknown_part(key):
                yield Problem(f'axes."{key}"', None, allowed)
            elif key in FREE:
                yield Problem(f'axes."{key}"', None, "does not change the result: it cannot be an axis")
        for a, b in combinations(sorted(self.axes), 2):
            if b.startswith(f"{a}."):
                yield Problem(f'axes."{b}"', None, f'is set by axes."{a}" already')
        tables = {key.rpartition(".")[0] for key in self.axes if "." in key}
        for table in sorted(tables):
            node: Any = self.base
            for part in table.split("."):
                node = node.get(part) if isinstance(node, Mapping) else node
            if node is not None and not isinstance(node, Mapping):
                yield Problem(f"base.{table}", node, "must be a table: axes set keys of it")

    def _wrong_values(self) -> Iterator[Problem]:
        for key, axis in self.axes.items():
            if isinstance(axis, tuple) or unknown_part(key):
                continue
            place, shown = f'axes."{key}"', axis.model_dump(exclude_defaults=True)
            if not types_of(key) & {"number", "integer"}:
                yield Problem(place, shown, f"must be a list of values: {key} is not a number")
            elif isinstance(axis, Range) and self.sample.method not in Sample.drawn:
                yield Problem(place, shown, f"a range needs sample.method = {', '.join(Sample.drawn)}")
            elif isinstance(axis, Range) and is_whole(key) and (axis.low % 1 or axis.high % 1):
                yield Problem(place, shown, "low and high must be whole numbers")

    def _wrong_lengths(self) -> Iterator[Problem]:
        lengths = {key: length(axis) for key, axis in self.axes.items()}
        if self.sample.method == "zip" and len(set(lengths.values())) > 1:
            said = ", ".join(f"{key} has {n}" for key, n in lengths.items())
            yield Problem("sample.method", "zip", f"needs axes of one length: {said}")
        if self.sample.method in Sample.drawn and not self.axes:
            yield Problem("axes", None, f"must be given with sample.method = {self.sample.method!r}")

    def _wrong_replicates(self) -> Iterator[Problem]:
        if (n := self.sample.replicates) == 1:
            return
        if "particles.seed" in self.axes:
            yield Problem("sample.replicates", n, 'must be 1 with an axis "particles.seed": both set the seed')
        elif others := {source for source in self._sources() if source != "packing"}:
            said = ", ".join(map(repr, sorted(map(str, others))))
            allowed = "must be 1: replicates differ in the seed of their packing, so with particles.source = "
            yield Problem("sample.replicates", n, f"{allowed}{said} all would be one case")

    def _sources(self) -> Iterator[object]:
        """Where the particles of the points come from."""
        tables = self.axes.get("particles", [self.base.get("particles")])
        sources = self.axes.get("particles.source")
        if isinstance(sources, tuple):
            yield from sources
        elif isinstance(tables, tuple | list):
            yield from (table.get("source", "list") for table in tables if isinstance(table, Mapping))

    def resolved_json(self) -> str:
        """The definition as JSON that needs no other definition file: `parse_sweep` gives an equal sweep."""
        return json.dumps(self.model_dump(mode="json", exclude_none=True), indent=2, ensure_ascii=False) + "\n"


def length(axis: Any) -> int:
    """How many values an axis has; 0 for a range."""
    if isinstance(axis, Spacing):
        [(_, _, n)] = axis.given().values()
        return n
    return len(axis) if isinstance(axis, tuple) else 0


# --- what the case's schema says of a key


def types_of(key: str) -> frozenset[str]:
    """JSON types that a dotted key of the case may have."""
    return frozenset(_types(_SCHEMA, key.split(".")))


def is_whole(key: str) -> bool:
    """Whether the values of a key are integers."""
    return "integer" in types_of(key)


def _types(schema: Mapping[str, Any], parts: list[str]) -> Iterator[str]:
    if "$ref" in schema:
        yield from _types(_SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]], parts)
    for form in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
        yield from _types(form, parts)
    if not parts:
        yield from [schema["type"]] if "type" in schema else []
    elif parts[0] in schema.get("properties", {}):
        yield from _types(schema["properties"][parts[0]], parts[1:])


_SCHEMA = case_schema()
CASE_TABLES = frozenset(_SCHEMA["properties"]) - {"name"}

# --- reading


def sweep_schema() -> dict[str, Any]:
    """JSON Schema of a sweep definition; that of its base is `case_schema`."""
    return Sweep.model_json_schema()


def load_sweep(path: Path | str) -> Sweep:
    """The sweep in a TOML or JSON file. Raises `CaseError`."""
    return parse_sweep(read_tree(path), base=Path(path).parent)


def parse_sweep(tree: Mapping[str, Any], base: Path | None = None) -> Sweep:
    """The sweep in a tree of plain values. Raises `CaseError`.

    Relative paths start from the folder `base`. Without one there is no file to be relative to: `base` in the tree
    must be a table then, never the path of a case.
    """
    if wrong := [*_misplaced(tree)]:
        raise CaseError(wrong)
    try:
        return Sweep.model_validate(_found(tree, base))
    except ValidationError as error:
        raise refusal(error, _part) from None


def _misplaced(tree: object) -> Iterator[Problem]:
    """A case in the place of a sweep, told in one sentence; keys of [sample] and of the case above all tables."""
    if not isinstance(tree, Mapping):
        return
    if not {"base", "axes", "sample"} & tree.keys() and {"domain", "particles"} & tree.keys():
        words = "this is a case, not a sweep: `frit run` and `frit submit` take cases; a sweep has a [base] and [axes]"
        yield Problem("base", None, words)
        return
    for key in (key for key in tree if key not in Sweep.model_fields):
        if key in Sample.model_fields:
            yield Problem(str(key), tree[key], "put it in [sample]")
        elif key in CASE_TABLES:
            yield Problem(str(key), None, f"belongs to the case: put it in [base.{key}]")


def _found(tree: object, base: Path | None) -> object:
    """The tree with the case of `base = "case.toml"` read and all paths absolute."""
    if not isinstance(tree, Mapping):
        return tree
    found, folder = copy.deepcopy(dict(tree)), base
    if isinstance(case := found.get("base"), str) and base is not None:
        folder = (base / case).parent
        found["base"] = read_tree(base / case)
    if isinstance(found.get("base"), Mapping):
        found["base"] = {key: _with_path(table, folder) for key, table in found["base"].items()}
    if isinstance(axes := found.get("axes"), Mapping):
        found["axes"] = {key: _axis_with_paths(key, axis, base) for key, axis in axes.items()}
    return found


def _with_path(table: Any, folder: Path | None) -> Any:
    if isinstance(table, Mapping) and isinstance(path := table.get("path"), str):
        return {**table, "path": os.path.abspath((folder or Path()) / path)}
    return table


def _axis_with_paths(key: str, axis: Any, folder: Path | None) -> Any:
    if not isinstance(axis, list):
        return axis
    if key.endswith(".path"):
        return [_with_path({"path": value}, folder)["path"] for value in axis]
    return [_with_path(value, folder) for value in axis]


def _part(loc: Place) -> type[BaseModel]:
    """The part of the definition that holds the key at `loc`."""
    if loc[0] == "sample":
        return Sample if len(loc) > 1 else Sweep
    if loc[0] == "axes" and len(loc) > 2:
        return Range if "|range" in loc else Spacing
    return Sweep
