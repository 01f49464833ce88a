"""`frit compare`: the points of a sweep, ranked, and their curves."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from frit.solver.characters import visible

from .speaking import HERE, Secret, SweepId, Url, speaking
from .terminal import AsJson, fail, of_older, refuse, show_table

if TYPE_CHECKING:
    from frit.sweeps.ranking import Ranking

    from ..http.views import Comparison

CURVES = (".png", ".pdf", ".svg")
MOST_TOLD = 10  # jobs without a result that are named one by one


def compare(
    sweep: SweepId,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="Curves: .png, .pdf, .svg, .html or .csv.")
    ] = None,
    reach: Annotated[
        float | None, typer.Option(metavar="VALUE", help="Also the time to this value of the observable.")
    ] = None,
    observable: Annotated[str, typer.Option(help="A scalar of the history rows.")] = "vacancy_ratio",
    runs: Annotated[bool, typer.Option("--runs", help="Single runs, too: a table, and thin curves.")] = False,
    log_time: Annotated[bool, typer.Option("--log-time", help="Curves over the logarithm of time.")] = False,
    data: Annotated[
        Path | None, typer.Option("--data", metavar="DIR", file_okay=False, help="Look here, without a service.")
    ] = None,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Rank the points of a sweep: which ends densest, which is fastest, what each axis does; and draw their curves.

    Replicates count as one point, with the standard error of their mean.
    """
    from frit.sweeps import curves
    from frit.sweeps.ranking import outcomes, rank

    if out is not None and out.suffix not in (*CURVES, ".html", ".csv"):
        refuse(f"--out {out}: must end in {', '.join(CURVES)}, .html or .csv")
    if data is not None:
        found = compared_here(data, sweep, observable)
    else:
        found = compared_there(url, token, sweep, observable)
    ranking = rank(outcomes(found), reach)
    if out is not None:
        if not any(curves.drawn(point) for point in ranking.points):
            fail(f"sweep {sweep}: no job has a history yet")
        curves.write(out, found["observable"], ranking, curves.Look(runs, log_time))
    if as_json:
        typer.echo(json.dumps({**found, **ranking.tree()}, indent=2))
        return
    show(ranking, found, runs)
    if note := of_older([c["older"] for c in found["curves"]]):
        typer.echo(note)
    typer.echo(curves.NOTE)
    if out is not None:
        typer.echo(f"{out}: curves")


def show(ranking: "Ranking", found: dict[str, Any], runs: bool) -> None:
    """The tables and what they say, in words."""
    word = found["observable"].replace("_", " ")
    show_table(ranking.rows(word))
    if runs:
        typer.echo("")
        show_table(run_rows(ranking, word))
    if effects := ranking.effect_rows(word):
        typer.echo("\neach axis, mean over the others")
        show_table(effects)
    typer.echo("")
    for line in ranking.answer(word):
        typer.echo(visible(line))
    for outcome in ranking.left_out[:MOST_TOLD]:
        said = f": {outcome.message}" if outcome.message else ""
        typer.echo(visible(f"not counted: {outcome.name} (job {outcome.job}, {outcome.state}){said}"))
    if (more := len(ranking.left_out) - MOST_TOLD) > 0:
        typer.echo(f"not counted: {more} more; --runs shows all")


def run_rows(ranking: "Ranking", word: str) -> list[dict[str, Any]]:
    """A row per job."""
    return [
        {
            "job": run.job, "point": point.label, "state": run.state, "time": run.time[-1] if run.time else None,
            f"{word} first": run.values[0] if run.values else None,
            f"{word} last": run.values[-1] if run.values else None, "message": run.message,
        }
        for point in ranking.points for run in point.runs
    ]  # fmt: skip


def compared_here(data: Path, sweep: str, observable: str) -> dict[str, Any]:
    """From the index of a data folder."""
    from ..http.comparison import ROWS, ObservableError, Page
    from ..http.comparison import compare as compare_jobs
    from ..index.migrations import IndexVersionError
    from ..index.records import NotFoundError, StoreError
    from ..index.store import Store

    if not (data / "frit.db").exists():
        refuse(f"--data {data}: holds no index of jobs")
    try:
        store = Store(data, writable=False)
        try:
            made: Comparison = compare_jobs(store, store.sweep(sweep), observable, Page(limit=10**9, rows=ROWS))
        finally:
            store.close()
    except (NotFoundError, IndexVersionError, StoreError) as error:
        refuse(str(error))
    except ObservableError as error:
        refuse(f"--observable {observable}: {error}")
    return made.model_dump(mode="json")


def compared_there(url: str, token: str | None, sweep: str, observable: str) -> dict[str, Any]:
    """From a service."""
    with speaking(url, token) as client:
        return client.sweep(sweep).compare(observable)
