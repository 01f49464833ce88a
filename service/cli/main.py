"""The command `frit`: words in; a launch, a picture or a schema out.

Exit status: 0 done, 1 the run failed, 2 the input was refused, 130 interrupted with a checkpoint written.
What a command imports beyond the terminal is imported inside it: `frit --help` is quick.
"""

import json
import math
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import monotonic
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console

from frit.solver.ended import SUCCEEDED, read_run

from ..jobs.child import die_with
from ..jobs.launch import Launch, LaunchError, Outcome
from . import compare, index, jobs, pictures, serve, service, sweep, token
from .terminal import AsJson, Shown, cell, in_words, refuse

EXIT = {SUCCEEDED: 0, "failed": 1, "refused": 2, "interrupted": 130}
GRACE = 300.0  # seconds for the checkpoint after Ctrl-C or TERM; a second Ctrl-C does not wait

app = typer.Typer(
    name="frit",
    help="Meshfree phase-field sintering of metal particles.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)


def at_least_one(ranks: int | None) -> int | None:
    """Option callback."""
    if ranks is not None and ranks < 1:
        raise typer.BadParameter(f"{ranks}: must be 1 or more")
    return ranks


CaseFile = Annotated[Path, typer.Argument(metavar="CASE.toml", exists=True, dir_okay=False, help="Or JSON.")]
Ranks = Annotated[int, typer.Option(metavar="N", callback=at_least_one, help="MPI ranks.")]
RunDirectory = Annotated[Path, typer.Argument(metavar="DIR", exists=True, file_okay=False)]


def main() -> None:
    """Entry point of the console script."""
    app()


def group(panel: str, *commands: tuple[str, Callable[..., Any], str]) -> None:
    """Commands under one heading of the help, each with an example."""
    for name, function, example in commands:
        app.command(name, rich_help_panel=panel, epilog=f"Example: {example}")(function)


def show_version(wanted: bool) -> None:
    """Option callback."""
    if wanted:
        try:
            typer.echo(f"frit {version('frit')}")
        except PackageNotFoundError:
            typer.echo("frit, not installed")
        raise typer.Exit


@app.callback()
def frit(
    _version: Annotated[bool, typer.Option("--version", callback=show_version, is_eager=True)] = False,
) -> None:
    """Options before the command."""


def run(
    case: CaseFile,
    ranks: Ranks = 1,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", file_okay=False, help="Run directory; default: runs/CASE.")
    ] = None,
    profile: Annotated[bool, typer.Option("--profile", help="Print where the time of each rank went.")] = False,
    as_json: AsJson = False,
) -> None:
    """Run one case here; Ctrl-C writes a checkpoint and ends."""
    check_case(case)
    directory = out or Path("runs") / case.stem
    state = read_run(directory).get("state")
    if (directory / "run.json").exists() and state != "refused":
        resumable = any((directory / name).exists() for name in ("checkpoint.h5", "case.json"))
        way = f"`frit resume {directory}` goes on with it" if resumable else "it has no checkpoint: remove it"
        refuse(f"--out {directory}: holds a run already (state: {state})", f"{way}, or name another folder")
    follow(ranks, [str(case), "--out", str(directory), "--progress"], directory, as_json, profile)


def resume(
    directory: RunDirectory,
    ranks: Annotated[
        int | None, typer.Option(metavar="N", callback=at_least_one, help="MPI ranks; default: as before.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Go on from the last checkpoint; anew where there was none yet."""
    record = read_run(directory)
    if record.get("state") == SUCCEEDED:
        typer.echo(f"{directory} is done already", err=True)
        report(directory, Outcome(SUCCEEDED, record.get("message"), 0, ""), {}, None, as_json)
        return
    if not (directory / "checkpoint.h5").exists():
        if not (directory / "case.json").exists():
            refuse(f"{directory} has neither checkpoint.h5 nor case.json to go on from: run its case with `frit run`")
        typer.echo(f"{directory} has no checkpoint yet: it is begun anew from its case.json", err=True)
    ranks = ranks or int(record.get("ranks", 1))
    follow(ranks, ["--resume", str(directory), "--progress"], directory, as_json)


def pack_only(
    case: CaseFile,
    out: Annotated[Path, typer.Option(metavar="FILE.csv", dir_okay=False, help="Particles: x,y[,z],radius, nm.")],
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE.png", dir_okay=False, help="Default: beside the CSV; .pdf, .svg too.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make the packing only: a CSV, a picture, and what it is like."""
    from . import pack

    check_case(case)
    try:
        report = pack.pack(case, out, dict(os.environ))
        picture = picture or out.with_suffix(".png")
        pack.draw(out, report, f"{case.stem}: {report['packing']['count']} particles", picture)
    except (ValueError, OSError) as error:
        refuse(str(error))
    if as_json:
        typer.echo(json.dumps(report, indent=2))
        return
    console = Console(highlight=False)
    for table in pack.tables(report):
        console.print(table, "")
    typer.echo(f"{out}, {picture}")


def schema() -> None:
    """JSON Schema of the case file."""
    from frit.solver.case import case_schema

    typer.echo(json.dumps(case_schema(), indent=2))


def check_case(path: Path) -> None:
    """Refuse a wrong case with a line per problem."""
    from frit.solver.case import CaseError, load_case

    try:
        load_case(path)
    except CaseError as error:
        refuse(*(f"{path}: {line}" for line in str(error).splitlines()))


# --- the commands, those most used first -------------------------------------------------------------

group(
    "Run a case here",
    ("run", run, "frit run case.toml --ranks 2"),
    ("resume", resume, "frit resume runs/case"),
    ("plot", pictures.plot, "frit plot runs/case --time 5"),
    ("movie", pictures.movie, "frit movie runs/case"),
    ("pack", pack_only, "frit pack case.toml --out particles.csv"),
    ("schema", schema, "frit schema > case.schema.json"),
)
app.add_typer(sweep.app, name="sweep", rich_help_panel=(SWEEPS := "Sweeps"))
group(SWEEPS, ("compare", compare.compare, 'frit compare "density by spread" --data data --out curves.png'))
group(
    "The service",
    ("serve", serve.serve, "frit serve --data data --cores 8"),
    ("submit", jobs.submit, "frit submit density.toml --wait"),
    ("jobs", jobs.jobs, "frit jobs state=running particles.mean_radius.ge=9"),
    ("top", jobs.top, "frit top"),
    ("show", jobs.show, "frit show 3fa9"),
    ("log", jobs.log, "frit log 3fa9 -f"),
    ("cancel", jobs.cancel, "frit cancel 3fa9"),
    ("retry", jobs.retry, "frit retry 3fa9"),
    ("rerun", jobs.rerun, "frit rerun 3fa9"),
    ("change", jobs.change, "frit change 3fa9 --priority 5 --tag urgent"),
    ("plan", service.plan, "frit plan density.toml"),
    ("limits", service.limits, "frit limits"),
    ("events", service.events, "frit events --since 0"),
)
app.add_typer(token.app, name="token", rich_help_panel="The service")
group(
    DATA := "Data",
    ("rm", jobs.remove, "frit rm 3fa9 s2"),
    ("gc", jobs.gc, "frit gc --keep 30d --keep succeeded"),
    ("reindex", index.reindex, "frit reindex --data data"),
)
app.add_typer(service.files, name="files", rich_help_panel=DATA)
app.add_typer(index.db, name="db", rich_help_panel=DATA)


# --- following a launch ---------------------------------------------------------------------------------


def follow(ranks: int, arguments: list[str], directory: Path, as_json: bool, profile: bool = False) -> NoReturn:
    """Launch the solver, show its progress to the end, and leave with the exit status of its outcome."""
    if ranks > (cores := len(os.sched_getaffinity(0))):
        typer.echo(f"--ranks {ranks}: there are {cores} cores; ranks that share one wait for each other", err=True)
    try:
        tied = die_with(os.getpid(), signal.SIGTERM)  # killed without a word, it leaves a checkpoint all the same
        launch = Launch(ranks, arguments, directory, first=tied)
    except (LaunchError, OSError) as error:
        refuse(str(error))
    start, progress = monotonic(), dict[str, Any]()
    with launch, Shown() as shown, signals_passed_on(launch, shown):
        for line in launch:
            if not launch.stopping:
                shown.tell(in_words(line), line.get("time"), line.get("end"))
            progress = line if "time" in line else progress
        outcome = launch.wait()
    report(directory, outcome, progress, monotonic() - start, as_json)
    if profile and (seconds := read_run(directory).get("profile")):
        from frit.solver.profile import table

        typer.echo("\n" + table(seconds), err=as_json)
    raise typer.Exit(EXIT[outcome.state])


@contextmanager
def signals_passed_on(launch: Launch, shown: Shown) -> Iterator[None]:
    """INT, TERM, HUP: one TERM to the ranks; a second INT kills. What nohup or & had ignored stays so."""

    def handle(number: int, _: object) -> None:
        if launch.stopping and number == signal.SIGINT:
            launch.kill()
        launch.stop(GRACE)
        keeps = "writing a checkpoint" if launch.marches else "stopping"
        shown.tell(f"{keeps}; Ctrl-C again kills")

    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    heard = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    for number in heard:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number])


def report(
    directory: Path, outcome: Outcome, progress: dict[str, Any], wall_time: float | None, as_json: bool
) -> None:
    """The summary on stdout; what went wrong and how to go on, on stderr."""
    summary = summarise(directory, outcome, progress, wall_time)
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
    else:
        for key, value in summary.items():
            values = value if isinstance(value, list) else [value]
            typer.echo(f"{key.replace('_', ' '):15}{' -> '.join(map(cell, values))}")
    for note in read_run(directory).get("notes", []):
        typer.echo(f"note: {note}", err=True)
    if outcome.state in ("failed", "refused"):
        log = directory / "log.txt"
        lines = [outcome.errors, outcome.message, f"see {log}" if log.exists() else None]
        typer.echo("\n".join(filter(None, lines)), err=True)
    elif outcome.state == "interrupted":
        typer.echo(f"interrupted ({outcome.message}); `frit resume {directory}` goes on", err=True)


def summarise(
    directory: Path, outcome: Outcome, progress: dict[str, Any], wall_time: float | None
) -> dict[str, Any]:
    """The run so far, from its last history row or the last progress line; `wall_time` is this launch's."""
    from frit.sweeps.plots import read_history

    history = read_history(directory)
    last = {key: column[-1].item() for key, column in history.items()}
    if progress.get("time", -math.inf) >= last.get("time", -math.inf):
        last |= progress
    first = [column[0].item() for key, column in history.items() if key == "vacancy_ratio"]
    return {
        "state": outcome.state,
        "message": outcome.message,
        "time": finite(last.get("time")),
        "steps": last.get("step"),
        "evaluations": last.get("evaluations"),
        "wall_time": round(last.get("wall_time", 0.0) if wall_time is None else wall_time, 2),
        "vacancy_ratio": [finite(v) for v in (*first, last.get("vacancy_ratio"))],
        "directory": str(directory),
    }


def finite(value: float | None) -> float | None:
    """JSON knows no NaN."""
    return value if value is not None and math.isfinite(value) else None
