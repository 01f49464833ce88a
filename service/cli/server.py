"""`frit serve`, and the commands that speak to a service: submit, jobs, show, log, cancel, retry, compare."""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from frit.solver.characters import visible

from .terminal import AsJson, DataFolder, SweepFile, fail, refuse, show_table

if TYPE_CHECKING:
    from ..client import Client, RemoteJob
    from ..http.views import Comparison

Url = Annotated[str, typer.Option("--url", envvar="FRIT_URL", metavar="URL", help="Address of the service.")]
Secret = Annotated[str | None, typer.Option("--token", envvar="FRIT_TOKEN", help="Access token of the service.")]
JobId = Annotated[str, typer.Argument(metavar="ID", help="Of the job, or the beginning of it.")]
SWITCH = 5e-4  # seconds that a thread which checks a large case keeps the event loop waiting at a time
HERE = "http://127.0.0.1:8000"
CURVES = (".png", ".pdf", ".svg")


def add_to(app: typer.Typer) -> None:
    """Make these the app's commands."""
    for command in (serve, submit, jobs, show, log, cancel, retry, compare):
        app.command()(command)


def serve(
    data: DataFolder = Path("data"),
    cores: Annotated[int | None, typer.Option(metavar="N", min=1, help="Processors for jobs; default: all.")] = None,
    host: Annotated[str, typer.Option(envvar="FRIT_HOST", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(envvar="FRIT_PORT", min=0, max=65535, help="0: any free one.")] = 8000,
    access_log: Annotated[bool, typer.Option("--access-log", help="A line on stderr per request.")] = False,
    release: Annotated[
        bool | None, typer.Option("--release/--leave", help="At the end: stop running jobs, with a checkpoint.")
    ] = None,
) -> None:
    """Serve jobs over HTTP. Ending the service leaves its jobs running; the next one takes them up again.

    With --release (or FRIT_RELEASE=1) they write a checkpoint, end and wait in the queue: where nothing outlives it.
    """
    import uvicorn
    from pydantic import ValidationError

    from ..http.app import create_app
    from ..http.security import AddressError, check
    from ..http.wire import options
    from ..jobs.engine import EngineError
    from ..jobs.memory import keep_little
    from ..settings import Settings

    chosen = {"cores": cores, "release": release}
    given = {"data": data, "host": host, "port": port, **{k: v for k, v in chosen.items() if v is not None}}
    try:
        settings = Settings.model_validate(Settings().model_dump() | given)
        warning = check(settings)
    except ValidationError as error:
        refuse(*(f"FRIT_{'_'.join(map(str, e['loc'])).upper()} = {e['input']!r}: {e['msg']}" for e in error.errors()))
    except (EngineError, AddressError) as error:
        refuse(str(error))
    typer.echo(f"frit serves {settings.data.absolute()} with {settings.cores} cores", err=True)
    if warning is not None:
        typer.echo(warning, err=True)
    sys.setswitchinterval(SWITCH)
    keep_little()
    uvicorn.run(create_app(settings), host=host, port=port, access_log=access_log, **options(settings))


def submit(
    file: SweepFile,
    ranks: Annotated[int | None, typer.Option(metavar="N", min=1, help="MPI ranks of a job.")] = None,
    name: Annotated[str | None, typer.Option(help="Default: the case's own.")] = None,
    priority: Annotated[int | None, typer.Option(help="Higher comes first; default 0.")] = None,
    tag: Annotated[list[str] | None, typer.Option(help="May be given several times.")] = None,
    time_limit: Annotated[float | None, typer.Option(metavar="SECONDS", help="Wall-clock time of an attempt.")] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Stay to the end; exit status 1 unless all succeed.")] = False,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Submit a case or a sweep to a service."""
    from ..client import RemoteJob

    options = {"ranks": ranks, "name": name, "priority": priority, "tags": tag or None, "time_limit": time_limit}
    with speaking(url, token, str(file)) as client:
        given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
        submitted = client.submit(file, **given)
        if wait:
            submitted.wait()
        found = [submitted] if isinstance(submitted, RemoteJob) else list(submitted.jobs())
        if as_json:
            typer.echo(json.dumps(submitted.data, indent=2))
        else:
            typer.echo(submitted.id)
            if wait:
                show_table([row(job) for job in found])
        if wait and any(job.state != "succeeded" for job in found):
            raise typer.Exit(1)


def jobs(
    where: Annotated[list[str] | None, typer.Argument(metavar="[FILTER]...", help="As state=running.")] = None,
    limit: Annotated[int, typer.Option(metavar="N", min=1, help="Rows, at most.")] = 50,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, newest first; filters as in HTTP: state=queued particles.mean_radius.ge=9 order=name sweep=s1."""
    filters = dict(word.split("=", 1) for word in where or () if "=" in word)
    if wrong := [word for word in where or () if "=" not in word]:
        refuse(f"{wrong[0]}: must be KEY=VALUE, as state=running")
    with speaking(url, token) as client:
        found = []
        for job in client.jobs(**{"limit": min(limit, 200), **filters}):
            found.append(job)
            if len(found) == limit:
                break
        if as_json:
            typer.echo(json.dumps([job.data for job in found], indent=2))
        else:
            show_table([row(job) for job in found])


def show(identifier: JobId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """Show all about one job."""
    with speaking(url, token) as client:
        data = client.job(identifier).data
    if as_json:
        typer.echo(json.dumps(data, indent=2))
        return
    for key, value in data.items():
        if value not in (None, [], {}) and key != "links":
            text = value if isinstance(value, str) else json.dumps(value)
            typer.echo(f"{key.replace('_', ' '):18}{visible(text)}")


def log(
    identifier: JobId,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Stay to the end of the job.")] = False,
    url: Url = HERE,
    token: Secret = None,
) -> None:
    """Print the log of one job."""
    with speaking(url, token) as client:
        job, offset = client.job(identifier), 0
        while True:
            final = job.final  # as it was before the last look
            added = job.log_bytes(offset)
            offset += len(added)
            typer.echo(visible(added.decode(errors="replace"), keep="\n\t"), nl=False)
            if final or not follow:
                return
            time.sleep(0.5)
            job.refresh()


def cancel(identifier: JobId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """End a job; what it has computed stays, in a checkpoint."""
    change(identifier, url, token, as_json, lambda job: job.cancel())


def retry(identifier: JobId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """Queue a job that did not succeed again; it goes on from its checkpoint."""
    change(identifier, url, token, as_json, lambda job: job.retry())


def change(
    identifier: str, url: str, token: str | None, as_json: bool, move: "Callable[[RemoteJob], RemoteJob]"
) -> None:
    """Have something done to a job, and tell its state."""
    with speaking(url, token) as client:
        job = move(client.job(identifier))
        word = "stopping" if job.data.get("stopping") else job.state
        typer.echo(json.dumps(job.data, indent=2) if as_json else f"{job.id} {word}")


def compare(
    sweep: Annotated[str, typer.Argument(metavar="SWEEP", help="Id or name; of a name, the newest.")],
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
            }
            for c in found["curves"]
        ]
    )
    typer.echo("Compare packs of equal size: with rigid motion, shrinkage depends on the number of particles.")
    if out is not None:
        typer.echo(f"{out}: curves")


def compared_here(data: Path, sweep: str, observable: str) -> dict[str, Any]:
    """From the index of a data folder."""
    from ..http.comparison import ObservableError
    from ..http.comparison import compare as compare_jobs
    from ..index.migrations import IndexVersionError
    from ..index.records import NotFoundError, StoreError
    from ..index.store import Store

    if not (data / "frit.db").exists():
        refuse(f"--data {data}: holds no index of jobs")
    try:
        store = Store(data, writable=False)
        try:
            made: Comparison = compare_jobs(store, store.sweep(sweep), observable)
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
