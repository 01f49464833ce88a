"""`frit db upgrade` and `frit reindex`: care for the index of a data folder while no service runs on it."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from .terminal import AsJson, refuse

db = typer.Typer(help="The index of a data folder.", no_args_is_help=True)

Data = Annotated[
    Path, typer.Option(metavar="DIR", exists=True, file_okay=False, help="Data folder, which no service uses now.")
]


@db.command()
def upgrade(data: Data = Path("data")) -> None:
    """Bring the index to the version that this frit needs; a copy of the old one is kept."""
    from ..index import migrations

    path = data.absolute() / "frit.db"
    with alone(data):
        if not path.exists():
            refuse(f"{path}: there is no index; `frit reindex --data {data}` makes one from the run directories")
        try:
            before, newest = migrations.versions(path)
            copy = migrations.upgrade(path)
        except migrations.IndexVersionError as error:
            refuse(str(error))
    typer.echo(f"{path}: version {newest}" + (f", was {before}, which is kept as {copy}" if copy else " already"))


def reindex(
    data: Data = Path("data"),
    as_json: AsJson = False,
) -> None:
    """Make a lost or damaged index again from the journal and the run directories; what is left of it is kept."""
    from ..index.records import StoreError
    from ..index.reindex import rebuild
    from ..jobs.engine import EngineError
    from ..settings import Settings

    try:
        made = rebuild(data, Settings(data=data).attempts)
    except (EngineError, StoreError, OSError) as error:
        refuse(str(error))
    for problem in made.problems:
        typer.echo(problem, err=True)
    counts = {"jobs": sum(made.states.values()), "sweeps": made.sweeps, "states": made.states}
    if as_json:
        typer.echo(json.dumps({**counts, "aside": made.aside and str(made.aside), "problems": made.problems}, indent=2))
        return
    typer.echo(f"{data / 'frit.db'}: {counts['jobs']} jobs, {made.sweeps} sweeps")
    for state, count in made.states.items():
        typer.echo(f"{state:12}{count}")
    if made.aside:
        typer.echo(f"the old index is kept as {made.aside}")
    typer.echo("tokens are nowhere but in an index: make new ones with `frit token create`")


@contextmanager
def alone(data: Path) -> Iterator[None]:
    """Hold the data folder; refuse where a service does."""
    from ..jobs.engine import EngineError, take

    try:
        lock = take(data)
    except EngineError as error:
        refuse(str(error))
    try:
        yield
    finally:
        os.close(lock)
