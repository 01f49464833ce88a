"""The jobs of a sweep beside each other: one observable over time, and the parameters in which they differ."""

from typing import NamedTuple

from ..index.records import SweepRecord
from ..index.store import Store
from . import filters, shown, views

CURVES = 1000  # on a page, at most
ROWS = 10_000  # points of a curve, at most


class ObservableError(ValueError):
    """An observable that no job of the sweep has; the message names those that there are."""


class Page(NamedTuple):
    """Which jobs of the sweep, in its own order, and how many points of each curve."""

    after: int = 0
    limit: int = CURVES
    rows: int = 50


def compare(store: Store, sweep: SweepRecord, observable: str, page: Page | None = None) -> views.Comparison:
    """Curves in the order of the sweep; jobs without history have empty ones. Raises `ObservableError`."""
    allowed = sorted({*filters.RESULTS, *store.observables(sweep.seq)} - {"time"})
    if observable not in allowed:
        raise ObservableError(f"must be one of {', '.join(allowed)}")
    page = page or Page()
    differing = store.differing(sweep.seq)
    found = store.compared(sweep.seq, page.after, page.limit + 1)
    jobs = found[: page.limit]
    curves = store.curves([job.seq for job in jobs], observable, page.rows)
    curves_shown = []
    for job in jobs:
        times, values = curves.get(job.seq, ([], []))
        curves_shown.append(
            views.Curve(
                job=job.id, name=job.name, state=job.state,
                parameters={name: job.parameters.get(name) for name in differing},
                time=times, values=values, final=values[-1] if values else None, older=job.older,
                message=shown.without_path(job.message, str(store.path.parent)), pack_porosity=job.porosity,
            )
        )  # fmt: skip
    following = None
    if len(found) > page.limit:
        place = f"observable={observable}&limit={page.limit}&after={page.after + page.limit}&rows={page.rows}"
        following = f"/v1/sweeps/{sweep.id}/compare?{place}"
    return views.Comparison(
        sweep=sweep.id, observable=observable, differing=differing, curves=curves_shown, next=following
    )  # fmt: skip
