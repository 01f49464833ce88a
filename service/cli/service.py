"""Commands about a service as a whole: what it allows, what would be, what happens, its files."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from frit.solver.characters import visible

from .speaking import HERE, Secret, Url, speaking, tell, tell_rows
from .terminal import AsJson, SweepFile

files = typer.Typer(name="files", help="Meshes and particles that are uploaded by themselves.", no_args_is_help=True)


def limits(url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """What a service allows, and what is left of the quotas of the token."""
    with speaking(url, token) as client:
        found = client.limits()
    quotas = [{"quota": name.replace("_", " "), **values} for name, values in found["quotas"].items()]
    if as_json or not quotas:
        typer.echo(json.dumps(found, indent=2))
    else:
        tell_rows(quotas, as_json)


def plan(
    file: SweepFile,
    ranks: Annotated[int | None, typer.Option(metavar="N", min=1, help="MPI ranks of a job.")] = None,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Check a case or a sweep on a service, and tell what it would cost there; nothing is submitted."""
    with speaking(url, token, str(file)) as client:
        found = client.plan(file, ranks=ranks)
    need: dict[str, Any] = found.pop("need") or {}
    if as_json:
        typer.echo(json.dumps({**found, "need": need or None}, indent=2))
        return
    for key, value in {**found, **need}.items():
        typer.echo(f"{key.replace('_', ' '):15}{value if not isinstance(value, float) else format(value, '.3g')}")


def events(
    since: Annotated[int | None, typer.Option(metavar="N", help="Begin after this event; 0: with the first.")] = None,
    count: Annotated[int | None, typer.Option(metavar="N", min=1, help="End after so many.")] = None,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Follow what happens to all jobs, a line each; Ctrl-C ends it."""
    with speaking(url, token) as client:
        for number, event in enumerate(client.news(since), 1):
            data = {"id": int(event.id), "kind": event.kind, **event.data}
            name = data.get("job") or data.get("sweep")
            words = f"{data['at']}  {name}  {data.get('state', 'deleted')}  {data.get('name') or ''}"
            typer.echo(json.dumps(data) if as_json else visible(words.rstrip()))
            if number == count:
                return


@files.command("list")
def list_files(url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """List them, newest first."""
    with speaking(url, token) as client:
        tell_rows([*client.files()], as_json)


@files.command("add")
def add_file(
    file: Annotated[Path, typer.Argument(metavar="FILE", exists=True, dir_okay=False)],
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Upload one, and print the id that a case names it by."""
    with speaking(url, token) as client:
        found = client.upload(file)
    tell(found, as_json, found["id"])


@files.command("rm")
def remove_files(
    identifiers: Annotated[list[str], typer.Argument(metavar="ID...")],
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Remove some that nothing refers to."""
    with speaking(url, token) as client:
        for identifier in identifiers:
            client.remove_file(identifier)
    tell([{"id": identifier, "removed": True} for identifier in identifiers], as_json, "\n".join(identifiers))
