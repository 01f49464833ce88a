"""What travels over HTTP: the bodies of requests and of responses. Times are ISO 8601 in UTC."""

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from frit.solver.characters import HIDDEN

from ..index.records import Attempt, SweepRecord
from ..jobs.states import Job, State

EXAMPLE_CASE: dict[str, Any] = {
    "name": "two equal discs",
    "domain": {"size": [100.0, 60.0]},
    "nodes": {"spacing": 1.0},
    "particles": {"centres": [[30.0, 30.0], [70.0, 30.0]], "radii": [20.0, 20.0]},
    "time": {"end": 10.0},
}
EXAMPLE_SWEEP: dict[str, Any] = {
    "name": "radius",
    "base": {
        "domain": {"size": [100.0, 60.0]},
        "nodes": {"spacing": 1.0},
        "particles": {
            "source": "packing", "mean_radius": 8.0, "packing_density": 0.5, "container": [[5.0, 5.0], [95.0, 55.0]]
        },
        "time": {"end": 10.0},
    },
    "axes": {"particles.mean_radius": [8.0, 10.0]},
}  # fmt: skip

Text = Annotated[str, Field(max_length=500, pattern=f"^[^{HIDDEN}]*$")]
Tag = Annotated[str, Field(min_length=1, max_length=100, pattern=f"^[^{HIDDEN}]+$")]
Tags = Annotated[list[Tag], Field(max_length=50, fail_fast=True)]
WHOLE = BeforeValidator(lambda value: int(value) if isinstance(value, float) and value.is_integer() else value)
Priority = Annotated[int, Field(strict=True, ge=-1_000_000, le=1_000_000), WHOLE]
Ranks = Annotated[int, Field(strict=True, ge=1, le=1_000_000), WHOLE]
Limit = Annotated[float, Field(strict=True, gt=0, le=1e9, allow_inf_nan=False)]


class Body(BaseModel):
    """A request's body: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class FileContent(Body):
    """A mesh or particle file, uploaded as content."""

    content: str
    """the file's text, or its bytes in base64"""
    encoding: Literal["text", "base64"] = "text"


Files = Annotated[
    dict[Annotated[str, Field(min_length=1, max_length=200)], FileContent],
    Field(max_length=100, description="Files by the name that `path` in the case has for them."),
]


class JobSubmission(Body):
    """A case to run. `time_limit`: wall-clock seconds of one attempt. The name is the case's unless given."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"case": EXAMPLE_CASE, "ranks": 1, "tags": ["demo"]}]})

    case: Annotated[dict[str, Any], Field(description="As in a case file; `frit schema` prints its JSON Schema.")]
    ranks: Ranks = 1
    name: Text | None = None
    priority: Priority = 0
    tags: Tags = []
    time_limit: Limit | None = None
    files: Files = {}


class SweepSubmission(Body):
    """A sweep to run. What is given beside the definition takes the place of what the definition says."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"definition": EXAMPLE_SWEEP}]})

    definition: Annotated[dict[str, Any], Field(description="As in a sweep file; `base` is a case, not a path.")]
    ranks: Ranks | None = None
    name: Text | None = None
    priority: Priority | None = None
    tags: Tags | None = None
    time_limit: Limit | None = None
    files: Files = {}


class AttemptView(BaseModel):
    """One try at a job."""

    number: int
    state: str | None
    message: str | None
    started: datetime
    ended: datetime | None
    core_seconds: float | None


class JobSummary(BaseModel):
    """A job. `parameters`: every scalar of its case by dotted key; `result`: scalars of its last history row."""

    id: str
    name: str
    identity: str
    state: State
    sentence: str
    final: bool
    stopping: bool
    message: str | None
    priority: int
    ranks: int
    tags: list[str]
    time_limit: float | None
    attempt: int
    created: datetime
    started: datetime | None
    ended: datetime | None
    core_seconds: float | None
    parameters: dict[str, Any]
    result: dict[str, Any]
    links: dict[str, str]


class JobView(JobSummary):
    """A job with its resolved case, its attempts and, while it runs, its last line of progress."""

    case: dict[str, Any]
    attempts: list[AttemptView]
    progress: dict[str, Any] | None


class JobPage(BaseModel):
    """Some jobs; `next` is the address of the jobs after them."""

    jobs: list[JobSummary]
    next: str | None


class SnapshotView(BaseModel):
    """A complete snapshot: its place along the arrays' first axis, and its model time."""

    number: int
    time: float


class SnapshotList(BaseModel):
    """The complete snapshots; `zarr` is the address of the store that holds them."""

    snapshots: list[SnapshotView]
    zarr: str


class SweepView(BaseModel):
    """A sweep. Of its points some were new, some were jobs already; `duplicates` were left out."""

    id: str
    name: str
    created: datetime
    points: int
    duplicates: int
    new: int
    reused: int
    states: dict[str, int]
    links: dict[str, str]


class SweepDetail(SweepView):
    """A sweep with its definition."""

    definition: dict[str, Any]


class SweepPage(BaseModel):
    """Some sweeps; `next` is the address of the sweeps after them."""

    sweeps: list[SweepView]
    next: str | None


class Curve(BaseModel):
    """An observable of one job over model time. `parameters`: those that differ within the sweep."""

    job: str
    name: str
    state: State
    parameters: dict[str, Any]
    time: list[float]
    values: list[float | None]
    final: float | None


class Comparison(BaseModel):
    """An observable of all jobs of a sweep."""

    sweep: str
    observable: str
    differing: list[str]
    curves: list[Curve]


class Limits(BaseModel):
    """What this service allows, and its states in words."""

    cores: int
    ranks: int
    body_bytes: int
    points_per_sweep: int
    values_per_body: int
    nodes_per_case: int
    particles_per_case: int
    rows_per_case: int
    snapshots_per_case: int
    memory_bytes_per_core: int
    disk_bytes_per_case: int
    bytes_per_sweep: int
    queued_jobs: int
    page: int
    states: dict[str, str]


class Health(BaseModel):
    """How the service is."""

    status: str


# --- records into views -----------------------------------------------------------------------------------


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
    parts = {name: f"{this}/{name}" for name in ("history", "log", "events", "snapshots", "cancel", "retry")}
    return {"self": this, **parts, "zarr": f"{this}/snapshots.zarr"}


def summary(job: Job, hidden: str, case: Mapping[str, Any] | None = None) -> JobSummary:
    """A job without its case. `hidden`: the path of the data folder, which no message shows."""
    return JobSummary(**_summary(job, hidden, json.loads(job.case) if case is None else case))


def _summary(job: Job, hidden: str, case: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "id": job.id, "name": job.name, "identity": job.identity, "state": job.state, "sentence": job.state.sentence,
        "final": job.final, "stopping": job.stopping, "message": without_path(job.message, hidden),
        "priority": job.priority, "ranks": job.ranks, "tags": list(job.tags), "time_limit": job.time_limit,
        "attempt": job.attempt, "created": moment(job.created), "started": maybe(job.started),
        "ended": maybe(job.ended), "core_seconds": job.core_seconds,
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
        "id": record.id, "name": record.name, "created": moment(record.created), "points": record.points,
        "duplicates": record.duplicates, "new": new, "reused": record.points - new, "states": record.states,
        "links": {"self": this, "jobs": f"/v1/jobs?sweep={record.id}", "compare": f"{this}/compare"},
    }  # fmt: skip


def _shown_paths(tree: Any, at: str = "") -> Any:
    """The definition with names of files in the place of the server's paths."""
    if isinstance(tree, dict):
        return {key: _shown_paths(value, str(key)) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_shown_paths(value, at) for value in tree]
    if isinstance(tree, str) and at.rpartition(".")[2] == "path":
        return tree.rpartition("/")[2]
    return tree
