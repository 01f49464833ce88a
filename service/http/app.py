"""The HTTP interface: routes only. What they take and give is in views.py, who may use them in security.py."""

import asyncio
import gc
import hashlib
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated, Any

from fastapi import APIRouter, Depends, FastAPI, Header, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel
from starlette.responses import StreamingResponse

from ..index.records import Key, SweepRecord
from ..jobs.engine import Engine
from ..jobs.states import SENTENCES, Job
from ..settings import Settings
from . import admission, delivery, filters, metrics, openapi, stream, views
from .bodies import AT_ONCE, SMALL, LimitedRoute, declared
from .comparison import ObservableError, compare
from .problems import WrongField, handle_problems, refused, unavailable
from .security import Gate, Reader, Submitter, needs, still_admitted

PROBLEMS = openapi.problems

api = APIRouter(prefix="/v1", route_class=LimitedRoute)
plain = APIRouter()


def create_app(settings: Settings) -> FastAPI:
    """The service of one data folder; it runs jobs from its start-up to its shutdown."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with Engine(settings) as engine:
            app.state.engine, app.state.settings = engine, settings
            app.state.large_bodies = asyncio.Semaphore(AT_ONCE)
            gc.collect()
            gc.freeze()  # what is there now stays: a collection of what requests leave need not look through it
            app.state.queue = admission.QueueLimit(engine.store, settings.queue_limit)
            yield
            if settings.release:
                await engine.scheduler.release()

    app = FastAPI(
        title="frit", version=openapi.version(), description=openapi.DESCRIPTION, lifespan=lifespan,
        generate_unique_id_function=lambda route: route.name,
    )  # fmt: skip
    handle_problems(app, [*api.routes, *plain.routes])
    app.include_router(api)
    app.include_router(plain)

    def engine() -> Engine:
        started: Engine = app.state.engine
        return started

    metrics.expose(app, engine, dependencies=[Depends(needs("read"))], tags=["service"], responses=PROBLEMS(401, 403))
    app.add_middleware(Gate, settings=settings, store=lambda: engine().store)
    openapi.complete(app, settings.cores)
    return app


# --- what routes share ------------------------------------------------------------------------------------


def running(request: Request) -> Engine:
    """The engine of the app."""
    engine: Engine = request.app.state.engine
    return engine


async def _engine(request: Request) -> Engine:
    return running(request)


async def _job(request: Request, id: Annotated[str, Path(max_length=100, description="Or its beginning.")]) -> Job:
    return running(request).store.job(id)


async def _sweep(request: Request, id: Annotated[str, Path(max_length=200, description="Or its name.")]) -> SweepRecord:
    return running(request).store.sweep(id)


TheEngine = Annotated[Engine, Depends(_engine)]
TheJob = Annotated[Job, Depends(_job)]
TheSweep = Annotated[SweepRecord, Depends(_sweep)]
GivenKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key", min_length=1, max_length=255, pattern=r"^[\x21-\x7e]+( +[\x21-\x7e]+)*$",
        description="The same key with the same request gives what it gave, and does nothing twice.",
    ),
]  # fmt: skip


def key_of(value: str | None, who: str, route: str, request: Any) -> Key | None:
    """One user's key for one route; the request is told by its content, not by its spelling."""
    if value is None:
        return None
    text = json.dumps(request, sort_keys=True)
    return Key(f"{who} {route}", value, hashlib.sha256(text.encode()).hexdigest())


async def key_of_body(value: str | None, who: str, route: str, body: BaseModel) -> Key | None:
    """As `key_of`, for a request whose body may be large."""
    if value is None:
        return None
    return await asyncio.to_thread(lambda: key_of(value, who, route, body.model_dump(mode="json")))


def hidden(engine: Engine) -> str:
    """What no answer shows."""
    return str(engine.settings.data.absolute())


def job_view(engine: Engine, job: Job) -> views.JobView:
    """A job with all that is known of it."""
    attempts = engine.store.attempts(job.id) if job.attempt else []
    return views.detail(job, hidden(engine), attempts, engine.progress(job.id))


def made(view: BaseModel, address: str) -> Response:
    """201, and where the new thing is."""
    return Response(view.model_dump_json(), 201, {"Location": address}, "application/json")


# --- jobs -------------------------------------------------------------------------------------------------


@api.post(
    "/jobs", status_code=201, tags=["jobs"], response_model=views.JobView,
    responses=openapi.created(401, 403, 413, 415, 422, 429, 503),
)  # fmt: skip
async def submit_job(
    submission: views.JobSubmission, request: Request, who: Submitter, given: GivenKey = None
) -> Response:
    """Queue a case. Every request makes a job, also of a case that was run before; see Idempotency-Key."""
    engine = running(request)
    store = engine.store
    key = await key_of_body(given, who, "POST /v1/jobs", submission)
    if key is not None and (before := store.known(key)) is not None:
        job = store.job(before)
    else:
        if submission.files:
            await asyncio.to_thread(admission.check_paths, submission.case, submission.files, "/case")
        async with engine.shelf.taken(submission.files) as uploads:
            if declared(request) >= SMALL or submission.files:
                new = await asyncio.to_thread(admission.job_of, submission, engine.settings, uploads)
            else:
                new = admission.job_of(submission, engine.settings)
            request.app.state.queue.admit(1)
            job = await asyncio.wrap_future(store.submit(new, key))
    return made(job_view(engine, job), f"/v1/jobs/{job.id}")


@api.get("/jobs", tags=["jobs"], responses=PROBLEMS(401, 403, 404, 422, 503), openapi_extra=openapi.FILTERS)
async def list_jobs(request: Request, response: Response, engine: TheEngine, who: Reader) -> views.JobPage:
    """Jobs that fit all filters, newest first. The next page is in `next` and in the Link header.

    A filter is `key=value` or `key.operator=value` with operator eq, ne, lt, le, gt, ge or in (values between commas).
    Keys: columns of a job, scalars of its case (`particles.mean_radius.ge=9`), results (`result.vacancy_ratio.le=0.1`).
    """
    store = engine.store

    def page() -> tuple[views.JobPage, str | None]:
        selection = filters.select(
            request.query_params.multi_items(), lambda name: store.sweep(name).seq
        )
        value = None if selection.scalar is None else selection.scalar.sql
        found = store.page(selection.where, selection.order, selection.limit + 1, value, selection.few, selection.near)
        shown = [views.summary(job, hidden(engine)) for job, _ in found[: selection.limit]]
        following = None
        if len(found) > selection.limit:
            cursor = filters.cursor(selection, *found[selection.limit - 1])
            following = f"/v1/jobs?{request.url.include_query_params(cursor=cursor).query}"
        return views.JobPage(jobs=shown, next=following), following

    answer, following = await asyncio.to_thread(page)
    if following is not None:
        response.headers["Link"] = f'<{following}>; rel="next"'
    return answer


@api.get("/jobs/{id}", tags=["jobs"], response_model=views.JobView, responses=openapi.cached())
async def show_job(request: Request, engine: TheEngine, who: Reader, job: TheJob) -> Response:
    """A job: its state in words, its case, attempts, last progress, results and links."""
    return delivery.tagged(request, job_view(engine, job).model_dump_json().encode(), "application/json")


@api.get("/jobs/{id}/history", tags=["jobs"], response_class=Response, responses=openapi.history())
async def show_history(request: Request, engine: TheEngine, who: Reader, job: TheJob) -> Response:
    """The history rows so far: JSON, or CSV of the scalar columns by Accept. A long one has no tag."""
    store, accept = engine.store, request.headers.get("accept", "*/*")
    first = await asyncio.to_thread(store.history, job.id, 0, delivery.ROWS + 1)
    rows, vary, table = [line for _, line in first], {"Vary": "Accept"}, "text/csv; charset=utf-8"
    as_table = delivery.prefers(accept, "text/csv", "application/json")
    if len(rows) > delivery.ROWS:
        if as_table:
            columns = await asyncio.to_thread(store.columns, job.seq)
            return StreamingResponse(delivery.long_csv(store, job.id, columns), 200, vary, table)
        return StreamingResponse(delivery.long_json(store, job.id), 200, vary, "application/json")
    if as_table:
        text = await asyncio.to_thread(delivery.as_csv, rows)
        return delivery.tagged(request, text.encode(), table, vary)
    return delivery.tagged(request, f"[{','.join(rows)}]".encode(), "application/json", vary)


@api.get("/jobs/{id}/log", tags=["jobs"], response_class=Response, responses=openapi.file("text/plain"))
async def show_log(request: Request, engine: TheEngine, who: Reader, job: TheJob) -> Response:
    """The solver's log so far, or a part by Range; empty before there is one."""
    handle = delivery.open_beneath(engine.run_directory(job.id), ["log.txt"])
    if handle is None:
        return Response(b"", media_type="text/plain", headers={"Accept-Ranges": "bytes"})
    return delivery.file_response(request, handle, "text/plain")


@api.get("/jobs/{id}/events", tags=["jobs"], response_class=EventSourceResponse, responses=PROBLEMS(401, 403, 404, 503))
async def follow_job(
    request: Request, engine: TheEngine, who: Reader, job: TheJob, last_event_id: Annotated[str | None, Header()] = None
) -> AsyncIterator[ServerSentEvent]:
    """The job's life as server-sent events `state`, `history`, `progress` and, once it is final, `end`.

    Last-Event-ID goes on after the event of that id.
    """
    async for event in stream.events(engine, job.id, last_event_id, lambda: still_admitted(request)):
        yield event


@api.get("/jobs/{id}/snapshots", tags=["jobs"], responses=PROBLEMS(401, 403, 404, 503))
async def list_snapshots(engine: TheEngine, who: Reader, job: TheJob) -> views.SnapshotList:
    """The complete snapshots, and the address of the zarr store that holds them."""
    found = [views.SnapshotView(number=n, time=t) for n, t in engine.store.snapshots(job.id)]
    return views.SnapshotList(snapshots=found, zarr=views.links(job.id)["zarr"])


@api.head("/jobs/{id}/snapshots.zarr/{path:path}", include_in_schema=False)
@api.get(
    "/jobs/{id}/snapshots.zarr/{path:path}", tags=["jobs"], response_class=Response,
    responses=openapi.file("application/octet-stream"),
)  # fmt: skip
async def read_zarr(request: Request, engine: TheEngine, who: Reader, job: TheJob, path: str) -> Response:
    """A key of the zarr store: zarr and xarray open the address before it."""
    kind = "application/json" if path.endswith(".json") else "application/octet-stream"
    return delivery.file_beneath(request, engine.run_directory(job.id) / "snapshots.zarr", path, kind)


@api.post("/jobs/{id}/cancel", tags=["jobs"], responses=PROBLEMS(401, 403, 404, 409, 413, 415, 422, 503))
async def cancel_job(engine: TheEngine, who: Submitter, job: TheJob, given: GivenKey = None) -> views.JobView:
    """End a job: at once where it has no cores, else its ranks write a checkpoint first (`stopping` until then)."""
    key = key_of(given, who, "POST /v1/jobs/cancel", job.id)
    return job_view(engine, await engine.cancel(job.id, key))


@api.post("/jobs/{id}/retry", tags=["jobs"], responses=PROBLEMS(401, 403, 404, 409, 413, 415, 422, 503))
async def retry_job(engine: TheEngine, who: Submitter, job: TheJob, given: GivenKey = None) -> views.JobView:
    """Queue a job that ended without success again; it goes on from its last checkpoint."""
    key = key_of(given, who, "POST /v1/jobs/retry", job.id)
    return job_view(engine, await asyncio.wrap_future(engine.store.retry(job.id, key)))


# --- sweeps -----------------------------------------------------------------------------------------------


@api.post(
    "/sweeps", status_code=201, tags=["sweeps"], response_model=views.SweepView,
    responses=openapi.created(401, 403, 413, 415, 422, 429, 503),
)  # fmt: skip
async def submit_sweep(
    submission: views.SweepSubmission, request: Request, engine: TheEngine, who: Submitter, given: GivenKey = None
) -> Response:
    """Queue the points of a sweep that no job has yet; the others are shared with the jobs there are."""
    store = engine.store
    key = await key_of_body(given, who, "POST /v1/sweeps", submission)
    if key is not None and (before := store.known(key)) is not None:
        sweep = store.sweep(before)
    else:
        if submission.files:
            await asyncio.to_thread(admission.check_paths, submission.definition, submission.files, "/definition")
        async with engine.shelf.taken(submission.files) as uploads:
            new = await asyncio.to_thread(admission.sweep_of, submission, engine.settings, uploads)
            request.app.state.queue.admit(len(new.points))
            queued = store.submit_sweep(new.name, new.definition, new.points, new.duplicates, key)
            sweep = await asyncio.wrap_future(queued)
    view = views.sweep_view(sweep, store.new_in_sweeps([sweep.seq])[sweep.seq])
    return made(view, f"/v1/sweeps/{sweep.id}")


@api.get("/sweeps", tags=["sweeps"], responses=PROBLEMS(401, 403, 422, 503))
async def list_sweeps(
    response: Response, engine: TheEngine, who: Reader,
    limit: Annotated[int, Query(ge=1, le=filters.LARGEST_PAGE)] = filters.PAGE,
    cursor: Annotated[str | None, Query(pattern=r"^[0-9]{1,18}$", description="From `next`.")] = None,
) -> views.SweepPage:  # fmt: skip
    """Sweeps, newest first."""

    def page() -> list[views.SweepView]:
        found = engine.store.sweeps(None if cursor is None else int(cursor), limit + 1)
        new = engine.store.new_in_sweeps([sweep.seq for sweep in found])
        return [views.sweep_view(sweep, new[sweep.seq]) for sweep in found]

    found = await asyncio.to_thread(page)
    following = None
    if len(found) > limit:
        last = engine.store.sweep(found[limit - 1].id).seq
        following = f"/v1/sweeps?limit={limit}&cursor={last}"
        response.headers["Link"] = f'<{following}>; rel="next"'
    return views.SweepPage(sweeps=found[:limit], next=following)


@api.get("/sweeps/{id}", tags=["sweeps"], response_model=views.SweepDetail, responses=openapi.cached())
async def show_sweep(request: Request, engine: TheEngine, who: Reader, sweep: TheSweep) -> Response:
    """A sweep: its definition, and how many of its jobs are in which state."""
    view = views.sweep_detail(sweep, engine.store.new_in_sweeps([sweep.seq])[sweep.seq])
    return delivery.tagged(request, view.model_dump_json().encode(), "application/json")


@api.get("/sweeps/{id}/compare", tags=["sweeps"], responses=PROBLEMS(401, 403, 404, 422, 503))
async def compare_jobs(
    engine: TheEngine, who: Reader, sweep: TheSweep,
    observable: Annotated[str, Query(max_length=100, description="A scalar of the history rows.")] = "vacancy_ratio",
) -> views.Comparison:  # fmt: skip
    """An observable of all jobs over time, with the parameters that differ."""
    try:
        return await asyncio.to_thread(compare, engine.store, sweep, observable)
    except ObservableError as error:
        wrong = WrongField(parameter="observable", value=observable, detail=str(error))
        raise refused("refused-query", "The query is refused", [wrong]) from None


# --- the service ------------------------------------------------------------------------------------------


@api.get("/limits", tags=["service"], responses=PROBLEMS(401, 403))
async def show_limits(engine: TheEngine, who: Reader) -> views.Limits:
    """What this service allows, and what the states mean."""
    s = engine.settings
    return views.Limits(
        cores=s.cores, ranks=s.cores, body_bytes=s.body_limit, points_per_sweep=s.points_limit,
        values_per_body=s.values_limit, nodes_per_case=s.nodes_limit, particles_per_case=s.particles_limit,
        rows_per_case=s.rows_limit, snapshots_per_case=s.snapshots_limit, memory_bytes_per_core=s.memory_limit,
        disk_bytes_per_case=s.disk_limit, bytes_per_sweep=s.sweep_limit, queued_jobs=s.queue_limit,
        page=filters.LARGEST_PAGE,
        states={str(state): sentence for state, sentence in SENTENCES.items()},
    )  # fmt: skip


@plain.get("/livez", tags=["service"])
async def live() -> views.Health:
    """Whether the process answers."""
    return views.Health(status="alive")


@plain.get("/readyz", tags=["service"], responses=PROBLEMS(503))
async def ready(engine: TheEngine) -> views.Health:
    """Whether jobs can be started and recorded; if not, why."""
    if (reason := engine.trouble()) is not None:
        raise unavailable(views.without_path(reason, hidden(engine)) or "")
    return views.Health(status="ready")
