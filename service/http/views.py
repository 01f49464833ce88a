"""What travels over HTTP: the bodies of requests and of answers. Times are ISO 8601 in UTC."""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from frit.solver.characters import HIDDEN

from ..jobs.states import State

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
    reuse: Annotated[bool, Field(strict=True, description="Take the job that there is of this case, if any.")] = False
    recompute: Annotated[bool, Field(strict=True, description="With reuse: not what an older solver computed.")] = False


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
    recompute: Annotated[bool, Field(strict=True, description="Compute anew what an older solver computed.")] = False


class JobChanges(Body):
    """What is to be different about a job; what is not given stays."""

    name: Text | None = None
    priority: Priority | None = None
    tags: Tags | None = None


class PlanRequest(Body):
    """A case, or the definition of a sweep."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"case": EXAMPLE_CASE}, {"definition": EXAMPLE_SWEEP}],
            "oneOf": [
                {"required": [one], "properties": {one: {"type": "object"}, other: {"type": "null"}}}
                for one, other in (("case", "definition"), ("definition", "case"))
            ],
        }
    )

    case: dict[str, Any] | None = None
    definition: dict[str, Any] | None = None
    ranks: Ranks | None = None
    files: Files = {}


class Need(BaseModel):
    """What one case will need, as it is reckoned before it is built."""

    nodes: float
    points: float
    particles: float
    memory_bytes: float
    disk_bytes: float


class Plan(BaseModel):
    """What a case or sweep would cost. `busy`: by ranks, the part of their time that is work."""

    points: int
    duplicates: int
    done: int
    to_run: int
    core_hours: float
    source: str
    busy: dict[str, float]
    need: Need | None


class FileView(BaseModel):
    """A file that was uploaded by itself; `bytes` of what is kept of it: meshes are converted."""

    id: str
    name: str
    owner: str | None
    bytes: int
    created: datetime


class FilePage(BaseModel):
    """Some files; `next` is the address of the files after them."""

    files: list[FileView]
    next: str | None


class AttemptView(BaseModel):
    """One try at a job."""

    number: int
    state: str | None
    message: str | None
    started: datetime
    ended: datetime | None
    core_seconds: float | None


class JobSummary(BaseModel):
    """A job. `parameters`: every scalar of its case by dotted key; `result`: scalars of its last history row.

    `progress`: while it runs, the last that its solver said.
    """

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
    bytes: int | None
    owner: str | None
    origin: str | None
    parameters: dict[str, Any]
    result: dict[str, Any]
    links: dict[str, str]
    progress: dict[str, Any] | None


class JobView(JobSummary):
    """A job with its resolved case and its attempts."""

    case: dict[str, Any]
    attempts: list[AttemptView]


class JobPage(BaseModel):
    """Some jobs; `next` is the address of the jobs after them."""

    jobs: list[JobSummary]
    next: str | None


class History(BaseModel):
    """Rows of a job's history, as the solver wrote them."""

    job: str
    rows: list[dict[str, Any]]


class Histories(BaseModel):
    """Histories of several jobs."""

    histories: list[History]


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
    owner: str | None
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
    """An observable of one job over model time. `parameters`: those that differ within the sweep.

    `older`: the revision of the solver that computed it, where it is not the present one's; `pack_porosity`: of the
    pack's own box, at the end.
    """

    job: str
    name: str
    state: State
    parameters: dict[str, Any]
    time: list[float]
    values: list[float | None]
    final: float | None
    older: int | None
    message: str | None
    pack_porosity: float | None


class Comparison(BaseModel):
    """An observable of jobs of a sweep; `next` is the address of those after them."""

    sweep: str
    observable: str
    differing: list[str]
    curves: list[Curve]
    next: str | None


class Quota(BaseModel):
    """What a token may have (None: as much as it likes), has, and has left."""

    used: float
    limit: float | None
    left: float | None


class Limits(BaseModel):
    """What this service allows, the quotas of the token that asks, and the states in words."""

    cores: int
    ranks: int
    body_bytes: int
    file_bytes: int
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
    private: bool
    token: str | None
    quotas: dict[str, Quota]
    states: dict[str, str]


class Health(BaseModel):
    """How the service is."""

    status: str
