"""What the commands that speak to a service share: where it is, what it says no to, jobs as rows."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .terminal import fail, refuse, show_table

if TYPE_CHECKING:
    from ..client import Client
    from ..remote import RemoteJob

Url = Annotated[str, typer.Option("--url", envvar="FRIT_URL", metavar="URL", help="Address of the service.")]
Secret = Annotated[str | None, typer.Option("--token", envvar="FRIT_TOKEN", help="Access token of the service.")]
JobId = Annotated[str, typer.Argument(metavar="ID", help="Of the job, or the beginning of it.")]
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
    except ProblemError as error:
        lines = [str(error), *(wrong_field(wrong) for wrong in error.problem.get("errors", ()))]
        (refuse if error.status < 500 else fail)(*lines)
    except httpx2.TransportError as error:
        fail(f"no service answers at {url}: {error}; `frit serve` starts one")
    except httpx2.InvalidURL as error:
        refuse(f"--url {url}: {error}")


def wrong_field(wrong: dict[str, Any]) -> str:
    """A line for one wrong field of a problem."""
    where = wrong.get("pointer") or wrong.get("parameter") or ""
    return f"{where} = {wrong.get('value')!r}: {wrong.get('detail')}"


def row(job: "RemoteJob") -> dict[str, Any]:
    """Of the table of jobs."""
    data = job.data
    result = data.get("result") or {}
    return {
        "id": data["id"], "state": data["state"], "name": data["name"], "ranks": data["ranks"],
        "priority": data["priority"] or None, "time": result.get("time"),
        "vacancy_ratio": result.get("vacancy_ratio"), "core_seconds": data.get("core_seconds"),
        "message": (data.get("message") or "")[:60] or None,
    }  # fmt: skip


def tell(tree: Any, as_json: bool, words: str) -> None:
    """As JSON, or in words."""
    typer.echo(json.dumps(tree, indent=2) if as_json else words)


def tell_rows(rows: "list[dict[str, Any]]", as_json: bool, shown: "list[Mapping[str, Any]] | None" = None) -> None:
    """As JSON, or as a table; shown: what the table has of them."""
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        show_table(rows if shown is None else shown)
