"""The jobs of a sweep as an answer: which point ends densest, which gets there fastest, and what each axis does.

Replicates, which differ in their packing's seed alone, are one point: its numbers are means, with the standard error
of the mean. Only runs that reached their end count; the others are named.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from frit.solver.arrays import Array

from .labels import REPLICATE, differing, labels, spelled, words

FEW = 8  # values of an axis that are shown one by one; of more, or of words, the lower and the upper half
Number = float | None


@dataclass(frozen=True)
class Outcome:
    """A job: its values along the axes, and an observable over model time [1]."""

    job: str
    name: str
    state: str
    parameters: Mapping[str, Any]
    time: Sequence[float]
    values: Sequence[Number]
    porosity: Number = None
    """of the pack's own box, at the end"""
    message: str | None = None

    @property
    def done(self) -> bool:
        """Whether it reached its end, so that its last value can be compared."""
        return self.state == "succeeded" and len(self.time) > 0 and self.values[-1] is not None

    @cached_property
    def curve(self) -> tuple[Array, Array]:
        """Times and values, without the rows that have none."""
        time, values = np.asarray(self.time, float), np.array([np.nan if v is None else v for v in self.values], float)
        there = np.isfinite(values)
        return time[there], values[there]

    def reached(self, level: float) -> Number:
        """The first time at which the curve, which falls or rises from its first to its last value, is at or beyond a
        level: between rows by a straight line. None: not reached.
        """
        time, values = self.curve
        if not len(values):
            return None
        away = (values - level) * (1.0 if values[-1] <= values[0] else -1.0)
        beyond = np.flatnonzero(away <= 0.0)
        if not len(beyond):
            return None
        k = int(beyond[0])
        if k == 0:
            return float(time[0])
        return float(time[k - 1] + (time[k] - time[k - 1]) * away[k - 1] / (away[k - 1] - away[k]))


@dataclass(frozen=True)
class Mean:
    """Of some runs: their mean, and its standard error where there are two or more."""

    value: Number
    error: Number = None

    @classmethod
    def of(cls, numbers: Iterable[Number]) -> "Mean":
        """Of those that are there."""
        found = np.array([number for number in numbers if number is not None and np.isfinite(number)], float)
        if not len(found):
            return cls(None)
        return cls(float(found.mean()), float(found.std(ddof=1) / np.sqrt(len(found))) if len(found) > 1 else None)

    @classmethod
    def over(cls, means: Sequence["Mean"]) -> "Mean":
        """Of the means of several points: the error is that of their replicates, not what the points differ by."""
        there = [mean for mean in means if mean.value is not None]
        if not there:
            return cls(None)
        errors = [mean.error for mean in there if mean.error is not None]
        error = float(np.sqrt(np.square(errors).sum()) / len(there)) if len(errors) == len(there) else None
        return cls(float(np.mean([mean.value for mean in there])), error)


@dataclass(frozen=True)
class Point:
    """Runs that differ in the seed of their packing alone."""

    label: str
    parameters: Mapping[str, Any]
    runs: Sequence[Outcome]
    level: Number

    @cached_property
    def done(self) -> list[Outcome]:
        """Those that count."""
        return [run for run in self.runs if run.done]

    @cached_property
    def final(self) -> Mean:
        """The last values."""
        return Mean.of(run.curve[1][-1] for run in self.done)

    @cached_property
    def start(self) -> Mean:
        """The first values."""
        return Mean.of(run.curve[1][0] for run in self.done)

    @cached_property
    def drop(self) -> Mean:
        """First less last."""
        return Mean.of(run.curve[1][0] - run.curve[1][-1] for run in self.done)

    @cached_property
    def porosity(self) -> Mean:
        """Of the pack's own box, at the end."""
        return Mean.of(run.porosity for run in self.done)

    @cached_property
    def times(self) -> list[Number]:
        """When each run came to the level."""
        return [] if self.level is None else [run.reached(self.level) for run in self.done]

    @cached_property
    def reached(self) -> Mean:
        """When the level was reached; a value only where all runs did."""
        return Mean.of(self.times) if None not in self.times else Mean(None)

    @property
    def reached_by(self) -> int:
        """How many runs came to the level."""
        return sum(time is not None for time in self.times)

    def time_in_words(self) -> str | None:
        """The time to the level, or that it was not reached, or by how many."""
        if self.level is None or not self.done:
            return None
        if self.reached.value is not None:
            return with_error(self.reached)
        return f"reached by {self.reached_by} of {len(self.done)}" if self.reached_by else "not reached"

    def row(self) -> dict[str, Any]:
        """All numbers, by plain names."""
        found: dict[str, Any] = {**self.parameters, "runs": len(self.done), "label": self.label}
        for name in ("start", "final", "drop", "porosity"):
            mean: Mean = getattr(self, name)
            found |= {name: mean.value, f"{name}_error": mean.error}
        if self.level is not None:
            found |= {"reached": self.reached.value, "reached_error": self.reached.error, "reached_by": self.reached_by}
        return found


@dataclass(frozen=True)
class Effect:
    """A value of an axis, or a half of its values: means over the points that have it."""

    axis: str
    value: str
    points: int
    final: Mean
    reached: Mean
    porosity: Mean


@dataclass(frozen=True)
class Ranking:
    """Points, the lowest last value first and those without one at the end."""

    points: Sequence[Point]
    axes: Sequence[str]
    level: Number
    left_out: Sequence[Outcome] = field(default=())

    @property
    def densest(self) -> Point | None:
        """The point that ends lowest."""
        return next((point for point in self.points if point.final.value is not None), None)

    @property
    def fastest(self) -> Point | None:
        """Of the points all of whose runs reached the level, the first."""
        there = [point for point in self.points if point.reached.value is not None]
        return min(there, key=lambda point: point.reached.value or 0.0, default=None)

    def effects(self) -> list[Effect]:
        """Of each axis, the mean over all others at each of its values."""
        counted = [point for point in self.points if point.final.value is not None]
        return [effect for axis in self.axes for effect in _effects(axis, counted)]

    def strongest(self) -> str | None:
        """Of the axes that are numbers, the one whose order goes best with that of the last values."""
        from scipy.stats import rankdata

        counted = [point for point in self.points if point.final.value is not None]
        last = rankdata([point.final.value for point in counted]) if len(counted) > 1 else np.zeros(2)

        def agreement(axis: str) -> float:
            x = rankdata([point.parameters[axis] for point in counted]) if len(counted) > 1 else np.zeros(2)
            return abs(float(np.corrcoef(x, last)[0, 1])) if np.ptp(x) and np.ptp(last) else 0.0

        axes = [axis for axis in self.axes if all(is_number(point.parameters.get(axis)) for point in self.points)]
        return max(axes, key=agreement, default=None)

    # --- in words

    def rows(self, observable: str) -> list[dict[str, Any]]:
        """A row per point for a table; columns in which no two points differ are left out."""
        short = words(self.axes)
        rows = []
        for place, point in enumerate(self.points, start=1):
            done, all_runs = len(point.done), len(point.runs)
            states = ", ".join(sorted({run.state for run in point.runs if not run.done}))
            rows.append({
                "rank": place if point.final.value is not None else None,
                **({short[axis]: point.parameters.get(axis) for axis in self.axes} or {"point": point.label}),
                "runs": str(done) if done == all_runs else f"{done} of {all_runs}",
                f"{observable} at the end": with_error(point.final),
                "drop": with_error(point.drop),
                f"time to {self.level:g}" if self.level is not None else "time": point.time_in_words(),
                "porosity of the pack": with_error(point.porosity),
                "not done": states or None,
            })  # fmt: skip
        if len({row["runs"] for row in rows}) == 1 and rows[0]["runs"] == "1":
            rows = [{key: value for key, value in row.items() if key != "runs"} for row in rows]
        return rows

    def effect_rows(self, observable: str) -> list[dict[str, Any]]:
        """A row per value of each axis for a table; none where a single axis says no more than the points do."""
        effects = self.effects()
        if len(self.axes) == 1 and len(effects) == len(self.points):
            return []
        short = words(self.axes)
        return [
            {
                "axis": short[effect.axis], "value": effect.value, "points": effect.points,
                observable: with_error(effect.final),
                f"time to {self.level:g}" if self.level is not None else "time": with_error(effect.reached),
                "porosity of the pack": with_error(effect.porosity),
            }
            for effect in effects
        ]  # fmt: skip

    def answer(self, observable: str) -> list[str]:
        """The answer."""
        said = []
        if (densest := self.densest) is not None:
            said.append(f"lowest {observable}: {densest.label} ({with_error(densest.final)})")
        if self.level is not None and (fastest := self.fastest) is not None:
            said.append(f"first at {self.level:g}: {fastest.label} (t = {with_error(fastest.reached)})")
        elif self.level is not None and densest is not None:
            said.append(f"no point reached {self.level:g} with all its runs")
        return said

    def tree(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "reach": self.level,
            "points": [{"jobs": [run.job for run in point.runs], **point.row()} for point in self.points],
            "effects": [
                {
                    "axis": e.axis, "value": e.value, "points": e.points, "final": e.final.value,
                    "reached": e.reached.value, "porosity": e.porosity.value,
                }
                for e in self.effects()
            ],
            "not_counted": [{"job": run.job, "name": run.name, "state": run.state} for run in self.left_out],
        }  # fmt: skip


def outcomes(compared: Mapping[str, Any]) -> list[Outcome]:
    """The jobs of what `GET /v1/sweeps/{id}/compare` answers."""
    return [
        Outcome(
            c["job"], c["name"], c["state"], c["parameters"], c["time"], c["values"], c.get("pack_porosity"),
            c.get("message"),
        )
        for c in compared["curves"]
    ]  # fmt: skip


def rank(outcomes: Sequence[Outcome], level: Number = None) -> Ranking:
    """The ranking; level: of the observable, to which times are told."""
    together: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        together.setdefault(point_of(outcome.parameters), []).append(outcome)
    parameters = [{k: v for k, v in runs[0].parameters.items() if k != REPLICATE} for runs in together.values()]
    named = labels(parameters)
    points = [
        Point(label or runs[0].name, own, runs, level)
        for label, own, runs in zip(named, parameters, together.values(), strict=True)
    ]
    points.sort(key=lambda point: np.inf if point.final.value is None else point.final.value)
    return Ranking(points, differing(parameters), level, [outcome for outcome in outcomes if not outcome.done])


def point_of(parameters: Mapping[str, Any]) -> str:
    """Equal for replicates."""
    return repr([(key, value) for key, value in parameters.items() if key != REPLICATE])


def with_error(mean: Mean, digits: int = 4) -> str | None:
    """In words, the error in two digits and the mean in as many places: "0.2314 ± 0.0021"."""
    if mean.value is None:
        return None
    if not mean.error:
        return f"{mean.value:.{digits}g}"
    places = max(0, 1 - int(np.floor(np.log10(mean.error))))
    return f"{mean.value:.{places}f} ± {mean.error:.{places}f}"


def is_number(value: Any) -> bool:
    """Whether it has a place on a scale."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _effects(axis: str, points: Sequence[Point]) -> list[Effect]:
    values = list({repr(v): v for v in (point.parameters.get(axis) for point in points)}.values())
    numbers = all(map(is_number, values))
    if numbers:
        values.sort()
    if not numbers or len(values) <= FEW:
        parts = [(spelled(v), [p for p in points if p.parameters.get(axis) == v]) for v in values]
    else:
        half = len(values) // 2
        parts = [
            (f"{spelled(some[0], 3)} to {spelled(some[-1], 3)}", [p for p in points if p.parameters[axis] in some])
            for some in (values[:half], values[half:])
        ]
    return [
        Effect(
            axis, value, len(some), Mean.over([p.final for p in some]), Mean.over([p.reached for p in some]),
            Mean.over([p.porosity for p in some]),
        )
        for value, some in parts
    ]  # fmt: skip
