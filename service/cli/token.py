"""`frit token`: who may use a service that others can reach."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from .terminal import AsJson, DataFolder, must_be_there, refuse

app = typer.Typer(name="token", help="Access tokens of a data folder; they count at once.", no_args_is_help=True)



@app.command()
def create(
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Whose it is.")],
    scope: Annotated[str, typer.Option("--scope", metavar="SCOPE", help="read, submit (also cancel) or admin.")],
    data: DataFolder = Path("data"),
    as_json: AsJson = False,
) -> None:
    """Make a token and print it: it cannot be shown again."""
    from ..index import tokens
    from ..index.records import StoreError

    try:
        secret = tokens.create(data, name, scope)
    except (ValueError, StoreError) as error:
        refuse(str(error))
    typer.echo(json.dumps({"name": name, "scope": scope, "token": secret}) if as_json else secret)


@app.command()
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME")], data: DataFolder = Path("data"), as_json: AsJson = False
) -> None:
    """Let a token count no more, from now on."""
    from ..index import tokens
    from ..index.records import NotFoundError, StoreError

    must_be_there(data)
    try:
        tokens.revoke(data, name)
    except (NotFoundError, StoreError) as error:
        refuse(str(error))
    typer.echo(json.dumps({"name": name, "revoked": True}) if as_json else f"{name}: revoked")
    say_if_none(data)


@app.command(name="list")
def show(data: DataFolder = Path("data"), as_json: AsJson = False) -> None:
    """List the tokens, never their secrets."""
    from ..index import tokens
    from ..index.records import StoreError

    must_be_there(data)
    try:
        found = tokens.listed(data)
    except StoreError as error:
        refuse(str(error))
    rows = [
        {"name": token.name, "scope": token.scope, "created": day(token.created), "revoked": day(token.revoked)}
        for token in found
    ]
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        for row in rows:
            typer.echo(f"{row['name']:24}{row['scope']:8}{row['created']}  {row['revoked'] or 'active'}")
    say_if_none(data)


def say_if_none(data: Path) -> None:
    """On stderr: that the service answers nobody any more, and what to do."""
    from ..index import tokens
    from ..index.records import StoreError

    try:
        shut = tokens.is_marked(data) and all(token.revoked for token in tokens.listed(data))
    except StoreError:
        return
    if shut:
        way = f"`frit token create --name NAME --scope submit --data {data}` makes one"
        typer.echo(f"no token is active, and without one nobody is served: {way}", err=True)


def day(seconds: float | None) -> str | None:
    """Seconds since 1970 as ISO 8601."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")
