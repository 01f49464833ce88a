"""`frit sweep`: a sweep's cost before it starts, the sweep itself without a server, and the sweeps of a service."""

import asyncio
import json
import signal
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from frit.solver.characters import visible

from .speaking import HERE, Secret, SweepId, Url, find_sweep, row, speaking, tell, tell_rows
from .terminal import AsJson, DataFolder, Recompute, Shown, SweepFile, of_older, refuse, show_table

app = typer.Typer(no_args_is_help=True, help="Sweeps: their cost, running them without a server, those of a service.")


@app.command()
def plan(
    file: SweepFile, data: DataFolder = Path("data"), recompute: Recompute = False, as_json: AsJson = False
) -> None:
    """Points, duplicates, what is done already, and the core-hours that the rest will take."""
    from frit.sweeps.cost import Measured
    from frit.sweeps.cost import plan as make_plan

    from ..index.store import Store

    expansion = expanded(file)[1]
    if not data.is_dir():
        typer.echo(f"--data {data}: not there yet, so no job of it counts as done", err=True)
    past, done, older = list[Measured](), set[str](), dict[str, int]()
    if (data / "frit.db").exists():
        store = Store(data, writable=False)
        past = [Measured(json.loads(case), seconds) for case, seconds in store.measured()]
        identities = [point.identity for point in expansion.points]
        known = store.identities(identities, recompute).items()
        done = {identity for identity, job in known if job.state == "succeeded"}
        older = {identity: job.older for identity, job in known if identity in done and job.older is not None}
        store.close()
    made = make_plan(expansion, past, done - older.keys(), older)
    if as_json:
        typer.echo(json.dumps(made.as_dict(), indent=2))
        return
    for key, value in made.rows():
        typer.echo(f"{key:20}{value}")


@app.command()
def run(
    file: SweepFile,
    data: DataFolder = Path("data"),
    cores: Annotated[int | None, typer.Option(metavar="N", min=1, help="Cores; default: all of this process.")] = None,
    recompute: Recompute = False,
    as_json: AsJson = False,
) -> None:
    """Run what is missing of a sweep here; Ctrl-C writes checkpoints, and the same command goes on."""
    from ..jobs.engine import EngineError
    from ..settings import Settings

    sweep, expansion = expanded(file)
    settings = Settings(data=data) if cores is None else Settings(data=data, cores=cores)
    if sweep.ranks > settings.cores:
        refuse(f"{file}: ranks = {sweep.ranks}: must be at most the {settings.cores} cores that there are (--cores)")
    try:
        status, rows = asyncio.run(run_here(settings, sweep, expansion, recompute))
    except EngineError as error:
        refuse(str(error))
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        show_table(rows)
        if note := of_older([row["older_revision"] for row in rows]):
            typer.echo(note)
        typer.echo(f"run directories: {settings.runs}/")
        if status == 130:
            typer.echo("interrupted; the same command goes on", err=True)
    raise typer.Exit(status)


@app.command(name="list")
def list_sweeps(url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """List the sweeps of a service, newest first."""
    with speaking(url, token) as client:
        rows = [sweep.data for sweep in client.sweeps()]
    keys = ("id", "name", "points", "reused", "new")
    shown = [{**{key: row[key] for key in keys}, "states": in_states(row["states"])} for row in rows]
    tell_rows(rows, as_json, shown, "no sweeps yet")


@app.command()
def show(sweep: SweepId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """Show a sweep of a service and its jobs."""
    with speaking(url, token) as client:
        found = find_sweep(client, sweep)
        rows = [job.data if as_json else row(job) for job in found.jobs()]
    if as_json:
        typer.echo(json.dumps({**found.data, "jobs": rows}, indent=2))
        return
    typer.echo(f"{found.id} {visible(found.name)}: {in_states(found.states)}")
    show_table(rows)


@app.command()
def cancel(sweep: SweepId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """End all jobs of a sweep of a service."""
    with speaking(url, token) as client:
        found = find_sweep(client, sweep).cancel()
    tell(found.data, as_json, f"{found.id} {in_states(found.states)}")


@app.command()
def retry(sweep: SweepId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """Queue all jobs of a sweep of a service that did not succeed again."""
    with speaking(url, token) as client:
        found = find_sweep(client, sweep).retry()
    tell(found.data, as_json, f"{found.id} {in_states(found.states)}")


def in_states(states: Mapping[str, int]) -> str:
    """How many jobs are in which state, in words."""
    return ", ".join(f"{n} {state}" for state, n in states.items())


def expanded(file: Path) -> tuple[Any, Any]:
    """The sweep and its points; refused with a line per problem."""
    from frit.solver.case import CaseError
    from frit.sweeps.definition import load_sweep
    from frit.sweeps.expand import expand

    try:
        sweep = load_sweep(file)
        return sweep, expand(sweep)
    except CaseError as error:
        refuse(*(f"{file}: {line}" for line in str(error).splitlines()))


async def run_here(
    settings: Any, sweep: Any, expansion: Any, recompute: bool = False
) -> tuple[int, list[dict[str, Any]]]:
    """Submit the sweep to an engine of our own and stay to its end; exit status and a row per job."""
    from ..jobs.engine import Engine

    async with Engine(settings) as engine:
        record = await engine.submit_sweep(sweep, expansion, recompute=recompute)
        stopped = await follow(engine, record.id)
        rows = rows_of(engine.store, record.id)
    failed = any(row["state"] != "succeeded" for row in rows)
    return 130 if stopped else int(failed), rows


async def follow(engine: Any, sweep: str) -> bool:
    """Show one line for all jobs until they are final; True where Ctrl-C came before."""
    stop = asyncio.Event()
    with Shown() as shown, stopping(stop):
        while True:
            seen = engine.notifier.count
            points = engine.store.sweep_points(sweep)
            states = Counter(point.job.state.value for point in points)
            running = [engine.progress(point.job.id) for point in points if point.job.state.active]
            shown.tell_all(states, running, sum(point.job.final for point in points))
            if all(point.job.final for point in points):
                return False
            if stop.is_set():
                shown.tell("writing checkpoints")
                await engine.scheduler.release()
                return True
            await engine.notifier.wait(1.0, seen)


@contextmanager
def stopping(stop: asyncio.Event) -> Iterator[None]:
    """INT and TERM ask for checkpoints and the end; what nohup or & had ignored stays so."""
    loop = asyncio.get_running_loop()
    heard = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN]
    for number in heard:
        loop.add_signal_handler(number, stop.set)
    try:
        yield
    finally:
        for number in heard:
            loop.remove_signal_handler(number)


def rows_of(store: Any, sweep: str) -> list[dict[str, Any]]:
    """A row per job of a sweep: the axes, how it ended, the vacancy ratio at both ends."""
    rows = []
    for point in store.sweep_points(sweep):
        job, first = point.job, store.history(point.job.id, limit=1)
        start = json.loads(first[0][1])["vacancy_ratio"] if first else None
        rows.append(
            {
                "job": job.id,
                **{key.rsplit(".", 1)[-1]: value for key, value in point.parameters.items()},
                "state": job.state.value,
                "time": job.result.get("time"),
                "vacancy_start": start,
                "vacancy_end": job.result.get("vacancy_ratio"),
                "particles": job.result.get("particles"),
                "core_seconds": job.core_seconds,
                "older_revision": job.older,
                "message": job.message,
            }
        )
    return rows
