"""The jobs of a sweep beside each other: one observable over time, and the parameters in which they differ."""

import json

from ..index.records import SweepRecord
from ..index.store import Store
from . import filters, views


class ObservableError(ValueError):
    """An observable that no job of the sweep has; the message names those that there are."""


def compare(store: Store, sweep: SweepRecord, observable: str) -> views.Comparison:
    """Curves in the order of the sweep; jobs without history have empty ones. Raises `ObservableError`."""
    allowed = sorted({*filters.RESULTS, *store.observables(sweep.seq)} - {"time"})
    if observable not in allowed:
        raise ObservableError(f"must be one of {', '.join(allowed)}")
    points, curves = store.sweep_points(sweep.id), store.curves(sweep.seq, observable)
    values: dict[str, set[str]] = {}
    for point in points:
        for name, value in point.parameters.items():
            values.setdefault(name, set()).add(json.dumps(value))
    differing = [name for name, found in values.items() if len(found) > 1]
    shown = []
    for point in points:
        curve = curves.get(point.job.seq, [])
        shown.append(
            views.Curve(
                job=point.job.id, name=point.name, state=point.job.state,
                parameters={name: point.parameters.get(name) for name in differing},
                time=[time for time, _ in curve], values=[value for _, value in curve],
                final=curve[-1][1] if curve else None,
            )
        )  # fmt: skip
    return views.Comparison(sweep=sweep.id, observable=observable, differing=differing, curves=shown)
