"""What the commands that speak to a service share: where it is, what it says no to, jobs as rows."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from .terminal import duration, fail, part, refuse, show_table

if TYPE_CHECKING:
    from ..client import Client
    from ..remote import RemoteJob, RemoteSweep

Url = Annotated[str, typer.Option("--url", envvar="FRIT_URL", metavar="URL", help="Address of the service.")]
Secret = Annotated[str | None, typer.Option("--token", envvar="FRIT_TOKEN", help="Access token of the service.")]
JobId = Annotated[str, typer.Argument(metavar="ID", help="Of the job, the beginning of it, or its name.")]
SweepId = Annotated[str, typer.Argument(metavar="SWEEP", help="Id or name; of a name, the newest.")]
HERE = "http://127.0.0.1:8000"


@contextmanager
def speaking(url: str, token: str | None, file: str | None = None) -> "Iterator[Client]":
    """A client; what goes wrong is said in words: 2 for what is refused, 1 for a service that cannot."""
    import httpx2

    from frit.solver.case import CaseError

    from ..client import Client, ProblemError

    try:
        with Client(url, token, patience=3.0) as client:
            yield client
    except CaseError as error:
        refuse(*(f"{file}: {line}" for line in str(error).splitlines()))
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    except ProblemError as error:
        lines = [wrong_field(wrong) for wrong in error.problem.get("errors", ())] or [str(error)]
        (refuse if error.status < 500 else fail)(*lines)
    except httpx2.TransportError as error:
        fail(f"no service answers at {url}: {error}; `frit serve` starts one")
    except httpx2.InvalidURL as error:
        refuse(f"--url {url}: {error}")


Found = TypeVar("Found", "RemoteJob", "RemoteSweep")
FEW = 8  # things that are listed where none is found


def jobs_of(client: "Client", wanted: str) -> "list[RemoteJob]":
    """By an id, the beginning of one, or a name: then the newest two of that name."""
    try:
        if "/" not in wanted:
            return [client.job(wanted)]
    except client.Problem as error:
        if error.status != 404:
            raise
    return list(islice(client.jobs(name=wanted, limit=2), 2))


def sweeps_of(client: "Client", wanted: str) -> "list[RemoteSweep]":
    """By an id or a name: then all of that name, newest first."""
    found = [each for each in client.sweeps() if wanted in (each.id, each.name)]
    return [each for each in found if each.id == wanted] or found


def find_job(client: "Client", wanted: str) -> "RemoteJob":
    """By its id, the beginning of that, or its name: of several the newest, and that is said. Else refuse."""
    return newest("job", wanted, jobs_of(client, wanted), client.jobs(limit=FEW))


def find_sweep(client: "Client", wanted: str) -> "RemoteSweep":
    """By its id or name, as `find_job`."""
    return newest("sweep", wanted, sweeps_of(client, wanted), client.sweeps())


def newest(kind: str, wanted: str, found: "list[Found]", there: "Iterator[Found]") -> "Found":
    """The first of what was found; refuse where that is nothing, with what there is."""
    if not found:
        known = [f"  {each.id}  {each.name}" for each in islice(there, FEW)]
        what = "the newest are" if known else "nothing was submitted yet"
        refuse(f"{kind} {wanted!r}: there is none; {what}", *known)
    if len(found) > 1:
        typer.echo(f"several {kind}s are named {wanted!r}: the newest, {found[0].id}, is meant", err=True)
    return found[0]


def wrong_field(wrong: dict[str, Any]) -> str:
    """A line for one wrong field of a problem."""
    where = wrong.get("pointer") or wrong.get("parameter") or "the request"
    value = "" if wrong.get("value") is None else f" = {wrong['value']!r}"
    return f"{where}{value}: {wrong.get('detail')}"


def row(job: "RemoteJob") -> dict[str, Any]:
    """Of the table of jobs."""
    data = job.data
    result = data.get("result") or {}
    progress = data.get("progress")
    done = None if progress is None else progress.get("phase") or f"{part(progress):.0%}"
    left = None if progress is None or "phase" in progress else duration(progress.get("remaining"))
    return {
        "id": data["id"], "state": data["state"], "name": data["name"], "ranks": data["ranks"],
        "priority": data["priority"] or None, "done": done, "left": left, "time": result.get("time"),
        "vacancy_ratio": result.get("vacancy_ratio"), "core_seconds": data.get("core_seconds"),
        "message": data.get("message"),
    }  # fmt: skip


def tell(tree: Any, as_json: bool, words: str) -> None:
    """As JSON, or in words."""
    typer.echo(json.dumps(tree, indent=2) if as_json else words)


def tell_rows(
    rows: "list[dict[str, Any]]", as_json: bool, shown: "Sequence[Mapping[str, Any]] | None" = None, none: str = "none"
) -> None:
    """As JSON, or as a table; shown: what the table has of them; none: what is said where there are none."""
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        show_table(rows if shown is None else shown, none)
