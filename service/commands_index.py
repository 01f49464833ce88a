"""`frit db upgrade` and `frit reindex`: care for the index of a data folder while no service runs on it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

db = typer.Typer(help="The index of a data folder.", no_args_is_help=True)

Data = Annotated[
    Path, typer.Option(metavar="DIR", exists=True, file_okay=False, help="Data folder, which no service uses now.")
]


@db.command()
def upgrade(data: Data = Path("data")) -> None:
    """Bring the index to the version that this frit needs; a copy of the old one is kept."""
    from . import migrations
    from .cli import refuse

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


@contextmanager
def alone(data: Path) -> Iterator[None]:
    """Hold the data folder; refuse where a service does."""
    from .cli import refuse
    from .engine import EngineError, take

    try:
        lock = take(data)
    except EngineError as error:
        refuse(str(error))
    try:
        yield
    finally:
        os.close(lock)
