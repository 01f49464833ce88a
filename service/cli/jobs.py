"""Commands about jobs on a service: submit, jobs, show, log, cancel, retry, rerun, change, rm, gc."""

import json
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from rich.console import Group
from rich.live import Live

from frit.solver.characters import visible

from .speaking import HERE, JobId, Secret, Url, find_job, jobs_of, row, speaking, sweeps_of, tell, tell_rows
from .terminal import AsJson, Recompute, Shown, SweepFile, in_words, refuse, show_table, table_of

if TYPE_CHECKING:
    from ..client import Client
    from ..remote import RemoteJob, RemoteSweep

SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
BYTES = {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}
ENDED = ("succeeded", "failed", "cancelled", "timed_out", "error", "lost")


def submit(
    file: SweepFile,
    ranks: Annotated[int | None, typer.Option(metavar="N", min=1, help="MPI ranks of a job.")] = None,
    name: Annotated[str | None, typer.Option(help="Default: the case's own.")] = None,
    priority: Annotated[int | None, typer.Option(help="Higher comes first; default 0.")] = None,
    tag: Annotated[list[str] | None, typer.Option(help="May be given several times.")] = None,
    time_limit: Annotated[float | None, typer.Option(metavar="SECONDS", help="Wall-clock time of an attempt.")] = None,
    recompute: Recompute = False,
    again: Annotated[bool, typer.Option("--again", help="Compute a case that there is already once more.")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Stay to the end; exit status 1 unless all succeed.")] = False,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Submit a case or a sweep to a service."""
    from ..remote import RemoteJob

    options = {"ranks": ranks, "name": name, "priority": priority, "tags": tag or None, "time_limit": time_limit}
    with speaking(url, token, str(file)) as client:
        given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
        submitted = client.submit(file, recompute=recompute, reuse=not again, **given)
        if not as_json:
            typer.echo(submitted.id)
            if (data := submitted.data).get("points") is not None:
                counts = f"{data['points']} points, {data['reused']} reused, {data['new']} new"
                more = f", {data['duplicates']} duplicates left out" if data["duplicates"] else ""
                typer.echo(f"sweep {data['name']!r}: {counts}{more}", err=True)
            elif not wait and submitted.data.get("state", "queued") != "queued":
                state = submitted.data["state"]
                typer.echo(f"this case is there already: {state}; --again computes it once more", err=True)
        if wait:
            wait_for(submitted)
        found = [submitted] if isinstance(submitted, RemoteJob) else list(submitted.jobs())
        if as_json:
            typer.echo(json.dumps(submitted.data, indent=2))
        elif wait:
            show_table([row(job) for job in found])
        if wait and any(job.state != "succeeded" for job in found):
            raise typer.Exit(1)


def wait_for(submitted: "RemoteJob | RemoteSweep") -> None:
    """To its end, with progress; Ctrl-C leaves it running."""
    from ..remote import RemoteJob

    try:
        with Shown() as shown:
            if isinstance(submitted, RemoteJob):
                submitted.wait(tell=lambda job: tell_of(job, shown))
            else:
                submitted.wait(tell=lambda sweep: tell_of_all(sweep, shown))
    except KeyboardInterrupt:
        typer.echo(f"no longer waiting: {submitted.id} goes on; `frit jobs` shows it", err=True)
        raise typer.Exit(130) from None


def tell_of(job: "RemoteJob", shown: Shown) -> None:
    """Where a job is."""
    now = job.progress or {}
    shown.tell(f"{job.state} {in_words(now) if now else ''}".rstrip(), now.get("time"), now.get("end"))


def tell_of_all(sweep: "RemoteSweep", shown: Shown) -> None:
    """Where the jobs of a sweep are."""
    running = [job.progress for job in sweep.jobs(state="starting,running", limit=200)]
    shown.tell_all(sweep.states, running, sum(n for state, n in sweep.states.items() if state in ENDED))


def jobs(
    where: Annotated[list[str] | None, typer.Argument(metavar="[FILTER]...", help="As state=running.")] = None,
    limit: Annotated[int, typer.Option(metavar="N", min=1, help="Rows, at most.")] = 50,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, newest first; filters as in HTTP: state=queued particles.mean_radius.ge=9 order=name sweep=s1."""
    filters = filters_of(word for word in where or () if "=" in word)
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
            shown = f"no job fits {' '.join(where)}" if where else "no jobs yet"
            show_table([row(job) for job in found], shown)


def top(
    every: Annotated[float, typer.Option(metavar="SECONDS", min=0.2, help="Between two looks.")] = 2.0,
    once: Annotated[bool, typer.Option("--once", help="Look once, and end.")] = False,
    url: Url = HERE,
    token: Secret = None,
) -> None:
    """Watch what runs: jobs, cores, speed, time left. Ctrl-C ends it."""
    with speaking(url, token) as client:
        if once or not sys.stdout.isatty():
            typer.echo(summary_of(found := going(client), client))
            show_table([busy_row(job) for job in found])
            return
        with Live(screen=True, auto_refresh=False) as live:
            while True:
                found = going(client)
                live.update(Group(summary_of(found, client), table_of([busy_row(job) for job in found])), refresh=True)
                time.sleep(every)


def going(client: "Client") -> "list[RemoteJob]":
    """What has not ended: what runs first."""
    now = [*client.jobs(state="starting,running", limit=200)]
    return [*now, *islice(client.jobs(state="queued", order="created", limit=20), 20)]


def summary_of(found: "Sequence[RemoteJob]", client: "Client") -> str:
    """Cores that are in use, jobs that run."""
    running = [job for job in found if job.state != "queued"]
    return f"{sum(job.data['ranks'] for job in running)} of {client.limits()['cores']} cores, {len(running)} jobs run"


def busy_row(job: "RemoteJob") -> dict[str, Any]:
    """Of the table of what runs."""
    shown, speed = row(job), (job.progress or {}).get("evaluations_per_second")
    return {
        **{key: shown[key] for key in ("id", "state", "name", "ranks", "done", "left")},
        "evaluations_per_second": speed, "vacancy_ratio": (job.progress or {}).get("vacancy_ratio"),
    }  # fmt: skip


def filters_of(words: Iterable[str]) -> dict[str, Any]:
    """Of KEY=VALUE; several values of `state` mean any of them."""
    filters = dict[str, Any]()
    for key, value in (word.split("=", 1) for word in words):
        filters[key] = f"{filters[key]},{value}" if key == "state" and key in filters else value
    return filters


def show(identifier: JobId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """Show all about one job."""
    with speaking(url, token) as client:
        data = find_job(client, identifier).data
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
        job, offset = find_job(client, identifier), 0
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
    alter(identifier, url, token, as_json, lambda job: job.cancel())


def retry(identifier: JobId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """Queue a job that did not succeed again; it goes on from its checkpoint."""
    alter(identifier, url, token, as_json, lambda job: job.retry())


def rerun(identifier: JobId, url: Url = HERE, token: Secret = None, as_json: AsJson = False) -> None:
    """Queue the case of a job once more, as a new job, from the start."""
    alter(identifier, url, token, as_json, lambda job: job.rerun())


def change(
    identifier: JobId,
    name: Annotated[str | None, typer.Option(help="Another name.")] = None,
    priority: Annotated[int | None, typer.Option(help="Higher comes first.")] = None,
    tag: Annotated[list[str] | None, typer.Option(help="All its tags from now on; may be given several times.")] = None,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Give a job another name, priority or other tags."""
    alter(identifier, url, token, as_json, lambda job: job.change(name=name, priority=priority, tags=tag or None))


def remove(
    identifiers: Annotated[list[str], typer.Argument(metavar="ID...", help="Of jobs and sweeps.")],
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Delete jobs, and sweeps with their jobs, that have ended: for good, with all their files."""
    with speaking(url, token) as client:
        rows = [removed(client, identifier) for identifier in identifiers]
    tell_rows(rows, as_json)
    if not all(each["removed"] for each in rows):
        raise typer.Exit(2)


def removed(client: "Client", identifier: str) -> dict[str, Any]:
    """Of one job or sweep: whether it is gone, and why not."""
    found: Sequence[RemoteJob | RemoteSweep] = jobs_of(client, identifier) or sweeps_of(client, identifier)
    if not found:
        return {"id": identifier, "removed": False, "reason": "there is none"}
    if len(found) > 1:
        reason = f"several have this name: give an id, as {' or '.join(each.id for each in found[:2])}"
        return {"id": identifier, "removed": False, "reason": reason}
    try:
        found[0].delete()
    except client.Problem as error:
        if error.status not in (404, 409):
            raise
        return {"id": identifier, "removed": False, "reason": str(error.problem.get("detail"))}
    return {"id": identifier, "removed": True, "reason": None}


class Keep(NamedTuple):
    """What is not to be removed."""

    seconds: float | None
    """jobs that ended no longer ago"""
    states: frozenset[str]
    """jobs in these states"""
    bytes: float | None
    """of all others the newest, as far as they fit into that together"""


def keep_of(words: list[str]) -> Keep:
    """From the command line: 30d, succeeded, 10GB; each kind may come, states several times."""
    seconds, size, states = None, None, set()
    for word in words:
        found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([a-zA-Z]+)", word)
        if word in ENDED:
            states.add(word)
        elif found is not None and found[2] in SECONDS:
            seconds = float(found[1]) * SECONDS[found[2]]
        elif found is not None and found[2] in BYTES:
            size = float(found[1]) * BYTES[found[2]]
        else:
            allowed = f"an age as 30d ({', '.join(SECONDS)}), a size as 10GB ({', '.join(BYTES)})"
            refuse(f"--keep {word}: must be {allowed}, or a state: {', '.join(ENDED)}")
    return Keep(seconds, frozenset(states), size)


def doomed(found: "Iterator[RemoteJob]", keep: Keep, now: float) -> "Iterator[RemoteJob]":
    """Of jobs that have ended, the newest first, those that are not kept."""
    total = 0.0
    for job in found:
        ended = job.ended
        if not job.final or job.state in keep.states or ended is None:
            continue
        if keep.seconds is not None and now - ended <= keep.seconds:
            continue
        total += job.data["bytes"] or 0
        if keep.bytes is None or total > keep.bytes:
            yield job


def gc(
    keep: Annotated[
        list[str], typer.Option("--keep", metavar="WHAT", help="30d, succeeded, 10GB: each keeps more; see below.")
    ],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only show what would go.")] = False,
    url: Url = HERE,
    token: Secret = None,
    as_json: AsJson = False,
) -> None:
    """Delete jobs that have ended, but for those that --keep names.

    An age keeps jobs that ended no longer ago; a state keeps the jobs in it; a size keeps, of all others, the newest
    that fit into it. Jobs of others, and those that a sweep of somebody else refers to, stay.
    """
    wanted = keep_of(keep)
    with speaking(url, token) as client:
        found = client.jobs(state=",".join(ENDED), order="-ended", limit=500)
        chosen = [*doomed(found, wanted, time.time())]
        rows = []
        for job in chosen:
            outcome = {"id": job.id, "removed": False, "reason": None} if dry_run else collected(client, job)
            rows.append({**outcome, "state": job.state, "name": job.name, "bytes": job.data["bytes"]})
    gone = [each for each in rows if each["removed"]]
    tell_rows(rows, as_json)
    if not as_json:
        freed = sum(each["bytes"] or 0 for each in (rows if dry_run else gone))
        typer.echo(f"{len(rows) if dry_run else len(gone)} jobs, {freed} bytes{': would go' if dry_run else ''}")


def collected(client: "Client", job: "RemoteJob") -> dict[str, Any]:
    """As `removed`; another's job stays without a complaint."""
    try:
        return removed(client, job.id)
    except client.Problem as error:
        if error.status != 403:
            raise
        return {"id": job.id, "removed": False, "reason": str(error.problem.get("detail"))}


def alter(
    identifier: str, url: str, token: str | None, as_json: bool, move: "Callable[[RemoteJob], RemoteJob]"
) -> None:
    """Have something done to a job, and tell its state."""
    with speaking(url, token) as client:
        job = move(find_job(client, identifier))
        word = "stopping" if job.data.get("stopping") else job.state
        tell(job.data, as_json, f"{job.id} {word}")
