"""`frit compare`: the jobs of a sweep beside each other."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .speaking import HERE, Secret, SweepId, Url, speaking
from .terminal import AsJson, fail, of_older, refuse, show_table

if TYPE_CHECKING:
    from ..http.views import Comparison

CURVES = (".png", ".pdf", ".svg")


def compare(
    sweep: SweepId,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="Curves: .png, .pdf, .svg, .html or .csv.")
    ] = None,
    observable: Annotated[str, typer.Option(help="A scalar of the history rows.")] = "vacancy_ratio",
    data: Annotated[
        Path | None, typer.Option("--data", metavar="DIR", file_okay=False, help="Look here, without a service.")
    ] = None,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Table and curves of the jobs of a sweep, by the parameters in which they differ."""
    from frit.sweeps import curves

    if out is not None and out.suffix not in (*CURVES, ".html", ".csv"):
        refuse(f"--out {out}: must end in {', '.join(CURVES)}, .html or .csv")
    if data is not None:
        found = compared_here(data, sweep, observable)
    else:
        found = compared_there(url, token, sweep, observable)
    lines = [
        curves.Curve(c["name"], c["parameters"], c["time"], c["values"]) for c in found["curves"] if c["time"]
    ]  # fmt: skip
    if out is not None:
        if not lines:
            fail(f"sweep {sweep}: no job has a history yet")
        curves.write(out, found["observable"], lines)
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    show_table(
        [
            {
                "job": c["job"],
                **{key.rsplit(".", 1)[-1]: value for key, value in c["parameters"].items()},
                "state": c["state"],
                "time": c["time"][-1] if c["time"] else None,
                f"{observable} first": c["values"][0] if c["values"] else None,
                f"{observable} last": c["final"],
                "revision": c["older"],
            }
            for c in found["curves"]
        ]
    )
    if note := of_older([c["older"] for c in found["curves"]]):
        typer.echo(note)
    typer.echo("Compare packs of equal size: with rigid motion, shrinkage depends on the number of particles.")
    if out is not None:
        typer.echo(f"{out}: curves")


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
