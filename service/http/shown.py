"""Records of the index as views: what is shown of them, and what is not."""

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

from ..index.records import Attempt, SweepRecord
from ..jobs.states import Job
from .stored import StoredFile
from .views import AttemptView, FileView, JobSummary, JobView, SweepDetail, SweepView


def moment(seconds: float) -> datetime:
    """Seconds since 1970 as a time of day."""
    return datetime.fromtimestamp(seconds, UTC)


def maybe(seconds: float | None) -> datetime | None:
    """The same of what may not have happened."""
    return None if seconds is None else moment(seconds)


def scalars(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every scalar by its dotted key; lists are left out."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from scalars(value, f"{prefix}{key}.")
        elif not isinstance(value, list):
            yield prefix + key, value


def links(identifier: str) -> dict[str, str]:
    """Addresses of all that a job has."""
    this = f"/v1/jobs/{identifier}"
    parts = {name: f"{this}/{name}" for name in ("history", "log", "events", "snapshots", "cancel", "retry", "rerun")}
    return {"self": this, **parts, "zarr": f"{this}/snapshots.zarr"}


def summary(job: Job, hidden: str, progress: dict[str, Any] | None) -> JobSummary:
    """A job without its case. `hidden`: the path of the data folder, which no message shows."""
    return JobSummary(**_summary(job, hidden, json.loads(job.case)), progress=progress)


def _summary(job: Job, hidden: str, case: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "id": job.id, "name": job.name, "identity": job.identity, "state": job.state, "sentence": job.state.sentence,
        "final": job.final, "stopping": job.stopping, "message": without_path(job.message, hidden),
        "priority": job.priority, "ranks": job.ranks, "tags": list(job.tags), "time_limit": job.time_limit,
        "attempt": job.attempt, "created": moment(job.created), "started": maybe(job.started),
        "ended": maybe(job.ended), "core_seconds": job.core_seconds,
        "bytes": job.bytes, "owner": job.owner, "origin": job.origin,
        "parameters": dict(scalars(shown_case(case))), "result": job.result, "links": links(job.id),
    }  # fmt: skip


def detail(job: Job, hidden: str, attempts: list[Attempt], progress: dict[str, Any] | None) -> JobView:
    """A job with all that is known of it."""
    case = shown_case(json.loads(job.case))
    tries = [
        AttemptView(
            number=a.number, state=a.state, message=without_path(a.message, hidden), started=moment(a.claimed),
            ended=maybe(a.ended), core_seconds=a.core_seconds,
        )
        for a in attempts
    ]  # fmt: skip
    return JobView(**_summary(job, hidden, case), case=case, attempts=tries, progress=progress)


def shown_case(case: Mapping[str, Any]) -> dict[str, Any]:
    """The case with the name of its mesh file in the place of the server's path."""
    nodes = case["nodes"]
    if (path := nodes.get("path")) is None:
        return dict(case)
    return {**case, "nodes": {**nodes, "path": path.rpartition("/")[2]}}


def without_path(message: str | None, hidden: str) -> str | None:
    """A message that does not tell where on the server it happened."""
    return message.replace(f"{hidden}/", "").replace(hidden, "data") if message else message


def sweep_view(record: SweepRecord, new: int) -> SweepView:
    """A sweep and its counts."""
    return SweepView(**_sweep(record, new))


def sweep_detail(record: SweepRecord, new: int) -> SweepDetail:
    """A sweep with its definition."""
    definition = json.loads(record.definition)
    return SweepDetail(**_sweep(record, new), definition=_shown_paths(definition))


def _sweep(record: SweepRecord, new: int) -> dict[str, Any]:
    this = f"/v1/sweeps/{record.id}"
    return {
        "id": record.id, "name": record.name, "created": moment(record.created), "owner": record.owner,
        "points": record.points, "duplicates": record.duplicates, "new": new, "reused": record.points - new,
        "states": record.states,
        "links": {"self": this, "jobs": f"/v1/jobs?sweep={record.id}", "compare": f"{this}/compare"},
    }  # fmt: skip


def file_view(file: StoredFile) -> FileView:
    """A file as it is shown."""
    return FileView(**{**file._asdict(), "created": moment(file.created)})


def _shown_paths(tree: Any, at: str = "") -> Any:
    """The definition with names of files in the place of the server's paths."""
    if isinstance(tree, dict):
        return {key: _shown_paths(value, str(key)) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_shown_paths(value, at) for value in tree]
    if isinstance(tree, str) and at.rpartition(".")[2] == "path":
        return tree.rpartition("/")[2]
    return tree
