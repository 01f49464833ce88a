"""From a sweep to its points: axes -> values -> cases, each with the hash that is its identity."""

import gc
import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import qmc

from frit.solver.arrays import Floats
from frit.solver.case import CaseError, Problem
from frit.solver.variations import MOST, Variations, case_text, identity

from .definition import Range, Sample, Spacing, Sweep, is_whole, length, types_of

SEED = "particles.seed"
MOST_REFUSED = 10  # points that are refused before expansion gives up

Scalar = float | int | str | bool


@dataclass(frozen=True, slots=True)
class Point:
    """A case of a sweep."""

    identity: str
    """`Case.identity`: the same for the same case in any sweep"""
    case: str
    """the resolved case as compact JSON; its name is that of the point"""
    name: str
    """the sweep's name, the values along the axes, and the replicate, counted from 1"""
    parameters: dict[str, Scalar]
    """values along the axes by dotted key; a list or table as JSON. With replicates also particles.seed"""


@dataclass(frozen=True)
class Expansion:
    """The points, each case once where it comes first, in the order of the file."""

    points: tuple[Point, ...]
    duplicates: int
    """how many points were left out because an earlier one is the same case"""


class Column(NamedTuple):
    """An axis laid out: its key and the values that the rows of the sweep pick by number."""

    key: str
    values: tuple[Any, ...]
    shown: tuple[Scalar, ...]
    labels: tuple[str, ...]


def count(sweep: Sweep) -> int:
    """How many points there are before duplicates are left out."""
    lengths = [length(axis) for axis in sweep.axes.values()]
    method = sweep.sample.method
    chosen = prod(lengths) if method == "grid" else max(lengths, default=1)
    return (sweep.sample.points or chosen) * sweep.sample.replicates


def expand(sweep: Sweep, limit: int | None = None, room: int | None = None) -> Expansion:
    """All points. Raises `CaseError` for more than `limit` points, before any is made, and for impossible cases.

    room: bytes of all resolved cases together, at most.
    """
    with _no_collections():
        return _expand(sweep, limit, math.inf if room is None else room)


@contextmanager
def _no_collections() -> Iterator[None]:
    """The garbage collector rests: nothing of a hundred thousand new objects can be freed, and it would look often."""
    working = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if working:
            gc.enable()


def _expand(sweep: Sweep, limit: int | None, most: float) -> Expansion:
    if limit is not None and (n := count(sweep)) > limit:
        raise CaseError([Problem("axes", None, f"give {n} points, must be at most {limit}")])
    with np.errstate(all="ignore"):  # what overflows is refused with its case
        columns, rows = _lay_out(sweep)
    points: dict[str, Point] = {}
    refused: dict[tuple[str, str], Problem] = {}
    variations, trees = Variations(), _Trees(sweep.base, columns)
    duplicates = bad = more = 0
    room = most
    for number, picks in enumerate(rows, start=1):
        try:
            case = variations.case(trees.tree(picks))
        except CaseError as error:
            bad, more = bad + 1, more + error.more
            for problem in error.problems:
                refused.setdefault((problem.key, str(problem)), _at(problem, number, columns, picks))
            if bad == MOST_REFUSED:
                break
            continue
        texts = variations.texts(case)
        if (hashed := identity(texts)) in points:
            duplicates += 1
            continue
        name = _name(sweep, columns, picks)
        parameters = {column.key: column.shown[pick] for column, pick in zip(columns, picks, strict=True)}
        if sweep.sample.replicates > 1 and case.particles.seed is not None:
            parameters[SEED] = case.particles.seed  # the first one's may be a default
        text = case_text(name, texts)
        common = sum(len(text.tree) for table, text in texts.items() if table not in trees.members)
        room -= len(text)
        if room < 0 or (not points and common * count(sweep) > most):
            allowed = f"give {count(sweep)} cases that take more than {most:.3g} bytes together, which is the limit"
            raise CaseError([Problem("axes", None, allowed)])
        points[hashed] = Point(hashed, text, name, parameters)
    if refused:
        raise CaseError(refused.values(), more)
    return Expansion(tuple(points.values()), duplicates)


class _Trees:
    """The plain trees of the points. Tables that pick the same values are the same object."""

    def __init__(self, base: Mapping[str, Any], columns: list[Column]) -> None:
        self.base = base
        self.members: dict[str, list[int]] = {}
        for number, column in enumerate(columns):
            self.members.setdefault(column.key.partition(".")[0], []).append(number)
        self.columns = columns
        self.paths = [column.key.split(".")[1:] for column in columns]
        self.made: dict[tuple[str, tuple[int, ...]], Any] = {}

    def tree(self, picks: tuple[int, ...]) -> dict[str, Any]:
        """The tree of one row."""
        if len(self.made) > MOST:
            self.made.clear()
        return {**self.base} | {name: self._table(name, picks) for name in self.members}

    def _table(self, name: str, picks: tuple[int, ...]) -> Any:
        members = self.members[name]
        key = name, tuple([picks[number] for number in members])
        if (table := self.made.get(key)) is None:
            table = self.base.get(name)
            for number in members:
                table = _put(table, self.paths[number], self.columns[number].values[picks[number]])
            self.made[key] = table
        return table


def _put(table: Any, path: list[str], value: Any) -> Any:
    """A copy of the table with the value at the path."""
    if not path:
        return value
    here, *below = path
    old = table or {}
    return {**old, here: _put(old.get(here), below, value) if below else value}


# --- rows


def _lay_out(sweep: Sweep) -> tuple[list[Column], Iterator[tuple[int, ...]]]:
    """The columns, and for each point which value it picks from each; replicates are the last column."""
    sample, drawn = sweep.sample, sweep.sample.method in Sample.drawn
    if not drawn:
        columns = [_column(key, _listed(key, axis), sweep.axes) for key, axis in sweep.axes.items()]
        ranges = [range(len(column.values)) for column in columns]
        together = iter(zip(*ranges, strict=True)) if ranges else iter([()])
        rows: Iterator[tuple[int, ...]] = product(*ranges) if sample.method == "grid" else together
    else:
        u = _drawn(sample, len(sweep.axes))
        columns, picks = [], []
        for (key, axis), share in zip(sweep.axes.items(), u.T, strict=True):
            if isinstance(axis, Range):
                values = _within(axis, share, is_whole(key))
                picks.append(list(range(len(u))))
            else:
                values = _listed(key, axis)
                picks.append(_floor(share * len(values)))
            columns.append(_column(key, values, sweep.axes))
        rows = zip(*picks, strict=True)
    if sample.replicates > 1:
        numbers = tuple([f"#{r}" for r in range(1, sample.replicates + 1)])
        columns.append(_column(SEED, _seeds(sweep))._replace(labels=numbers))
        rows = ((*row, r) for row in rows for r in range(sample.replicates))
    return columns, rows


def _drawn(sample: Sample, axes: int) -> Floats:
    """Points of the unit cube, (points, axes).

    Independent random and Sobol points are a sequence: more of them start with the same ones. A Latin hypercube puts
    one point into each of `points` layers along every axis, so that none stays when their number changes.
    """
    n = sample.points or 1
    if sample.method == "random":
        return np.random.default_rng(sample.seed).random((n, axes))
    if sample.method == "lhs":
        return np.asarray(qmc.LatinHypercube(axes, rng=sample.seed).random(n))
    power = (n - 1).bit_length()  # scipy draws 2^power points without complaint
    return np.asarray(qmc.Sobol(axes, rng=sample.seed).random_base2(power)[:n])


def _within(axis: Range, share: Floats, whole: bool) -> list[Any]:
    """Values of a range at shares in [0, 1) of it; integers include both ends, all equally likely."""
    high = axis.high + 1 if whole else axis.high
    if axis.log:
        values = np.exp(np.log(axis.low) + share * (np.log(high) - np.log(axis.low)))
    else:
        values = axis.low + share * (high - axis.low)
    values = np.clip(values, axis.low, axis.high + whole * 0.5)
    return _floor(values) if whole else [float(value) for value in values]


def _floor(values: Floats) -> list[int]:
    return [int(value) for value in np.floor(values)]


def _listed(key: str, axis: Any) -> list[Any]:
    """Values of an axis that is a list or a spacing; whole numbers where the key needs them."""
    if isinstance(axis, Spacing):
        [(function, (start, stop, n))] = axis.given().items()
        spaced: Callable[..., Floats] = getattr(np, function)
        values = spaced(start, stop, n)
        return [int(value) for value in np.rint(values)] if is_whole(key) else values.tolist()
    floating = "number" in types_of(key)
    return [float(value) if floating and type(value) is int and abs(value) < 2**53 else value for value in axis]


def _seeds(sweep: Sweep) -> list[Any]:
    """A seed of 32 bits per replicate, the same whatever the point and however many there are.

    The first is the case's own, so that a sweep without replicates is part of the same sweep with them.
    """
    particles = sweep.base.get("particles") or {}
    spawned = [np.random.SeedSequence(sweep.sample.seed, spawn_key=(r,)) for r in range(1, sweep.sample.replicates)]
    return [particles.get("seed"), *(int(seed.generate_state(1)[0]) for seed in spawned)]


# --- words


def _column(key: str, values: list[Any], others: Collection[str] = ()) -> Column:
    """A column, with labels `key=value` in which the key is as short as the other keys allow."""
    shown = [value if isinstance(value, Scalar) else json.dumps(value) for value in values]
    last = key.rpartition(".")[2]
    head = key if any(other != key and other.rpartition(".")[2] == last for other in others) else last
    return Column(key, tuple(values), tuple(shown), tuple([f"{head}={_short(value)}" for value in shown]))


def _short(value: Scalar) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _name(sweep: Sweep, columns: list[Column], picks: tuple[int, ...]) -> str:
    labels = " ".join([column.labels[pick] for column, pick in zip(columns, picks, strict=True)])
    return f"{sweep.name}: {labels}" if labels else sweep.name


def _at(problem: Problem, number: int, columns: list[Column], picks: tuple[int, ...]) -> Problem:
    """The problem with the point and its values along the axes."""
    values = [f"{column.key} = {column.shown[pick]}" for column, pick in zip(columns, picks, strict=True)]
    return replace(problem, allowed=f"{problem.allowed} ({', '.join([f'point {number}', *values])})")
