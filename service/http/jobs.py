"""Routes of jobs."""

import asyncio
from collections.abc import AsyncIterator
from concurrent.futures import Future
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.responses import StreamingResponse

from ..index.records import NotFoundError
from ..jobs.states import Job, NewJob
from . import admission, delivery, filters, openapi, shown, stream, views
from .asking import (
    GivenKey,
    LastEvent,
    MyJob,
    TheEngine,
    TheJob,
    TheRooms,
    hidden,
    job_view,
    key_of,
    key_of_body,
    made,
    rooms_of,
    running,
)
from .bodies import SMALL, LimitedRoute, declared
from .comparison import ROWS
from .problems import WrongField, refused
from .security import Reader, Submitter, still_admitted

PROBLEMS = openapi.problems
TOGETHER, ALL_ROWS = 100, 100_000  # jobs, and rows of all, in one answer with histories

api = APIRouter(prefix="/v1", route_class=LimitedRoute)


@api.post(
    "/jobs", status_code=201, tags=["jobs"], response_model=views.JobView,
    responses=openapi.created(401, 403, 413, 415, 422, 429, 503),
)  # fmt: skip
async def submit_job(
    submission: views.JobSubmission, request: Request, who: Submitter, given: GivenKey = None
) -> Response:
    """Queue a case. Every request makes a job, also of a case that was run before, unless `reuse` is true: then the job
    that there is of the case is the answer, tried again where it was cancelled or lost. See Idempotency-Key.
    """

    def queued(new: NewJob) -> "Future[Job]":
        if not submission.reuse:
            return engine.store.submit(new, key)
        return engine.store.reuse(new, key, not engine.settings.private, submission.recompute)

    engine, rooms = running(request), rooms_of(request)
    key = await key_of_body(given, who, "POST /v1/jobs", submission)
    if key is not None and (before := engine.store.known(key)) is not None:
        job = engine.store.job(before)
    else:
        if declared(request) < SMALL and not admission.needs_files(submission.case, submission.files):
            new = admission.job_of(submission, engine.settings, owner=who.label)
            rooms.quotas.admit(who, 1, new.ranks)
            job = await asyncio.wrap_future(queued(new))
        else:
            async with admission.taken(submission.case, submission.files, "/case", rooms, who) as uploads:
                new = await asyncio.to_thread(admission.job_of, submission, engine.settings, uploads, who.label)
                rooms.quotas.admit(who, 1, new.ranks)
                job = await asyncio.wrap_future(queued(new))
    return made(job_view(engine, job), f"/v1/jobs/{job.id}")


@api.get("/jobs", tags=["jobs"], responses=PROBLEMS(401, 403, 404, 422, 503), openapi_extra=openapi.FILTERS)
async def list_jobs(request: Request, response: Response, engine: TheEngine, who: Reader) -> views.JobPage:
    """Jobs that fit all filters, newest first. The next page is in `next` and in the Link header.

    A filter is `key=value` or `key.operator=value` with operator eq, ne, lt, le, gt, ge or in (values between commas).
    Keys: columns of a job, scalars of its case (`particles.mean_radius.ge=9`), results (`result.vacancy_ratio.le=0.1`).
    """
    store = engine.store

    def seq_of(name: str) -> int:
        sweep = store.sweep(name)
        if not who.sees(sweep.owner):
            raise NotFoundError(f"sweep {name!r}: there is none")
        return sweep.seq

    def page() -> tuple[views.JobPage, str | None]:
        selection = filters.select(request.query_params.multi_items(), seq_of, who.only)
        value = None if selection.scalar is None else selection.scalar.sql
        found = store.page(selection.where, selection.order, selection.limit + 1, value, selection.few, selection.near)
        listed = [shown.summary(job, hidden(engine), engine.progress(job.id)) for job, _ in found[: selection.limit]]
        following = None
        if len(found) > selection.limit:
            cursor = filters.cursor(selection, *found[selection.limit - 1])
            following = f"/v1/jobs?{request.url.include_query_params(cursor=cursor).query}"
        return views.JobPage(jobs=listed, next=following), following

    answer, following = await asyncio.to_thread(page)
    if following is not None:
        response.headers["Link"] = f'<{following}>; rel="next"'
    return answer


@api.get("/histories", tags=["jobs"], responses=PROBLEMS(401, 403, 404, 422, 503), response_model=views.Histories)
async def show_histories(
    engine: TheEngine, who: Reader,
    id: Annotated[str, Query(max_length=5000, pattern=r"^[0-9a-zA-Z-]+(,[0-9a-zA-Z-]+)*$", description="Of jobs.")],
    rows: Annotated[int, Query(ge=2, le=ROWS, description="Rows of a history, at most: spread over all.")] = 1000,
) -> Response:  # fmt: skip
    """The histories of up to 100 jobs, in at most 100 000 rows together, in the order in which they are named."""
    named = id.split(",")
    if len(named) > TOGETHER or len(named) * rows > ALL_ROWS:
        said = f"must be at most {TOGETHER} jobs, and at most {ALL_ROWS} rows together: {len(named)} times {rows}"
        raise refused("refused-query", "The query is refused", [WrongField(parameter="id", value=id[:80], detail=said)])

    def found() -> str:
        jobs = [engine.store.job(name) for name in named]
        for name, job in zip(named, jobs, strict=True):
            if not who.sees(job.owner):
                raise NotFoundError(f"job {name!r}: there is none, or several begin so")
        lines = engine.store.histories([job.seq for job in jobs], rows)
        parts = [f'{{"job":"{job.id}","rows":[{",".join(lines.get(job.seq, ()))}]}}' for job in jobs]
        return f'{{"histories":[{",".join(parts)}]}}'

    return Response(await asyncio.to_thread(found), media_type="application/json")


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
    request: Request, engine: TheEngine, who: Reader, job: TheJob, last_event_id: LastEvent = None
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
    return views.SnapshotList(snapshots=found, zarr=shown.links(job.id)["zarr"])


@api.head("/jobs/{id}/snapshots.zarr/{path:path}", include_in_schema=False)
@api.get(
    "/jobs/{id}/snapshots.zarr/{path:path}", tags=["jobs"], response_class=Response,
    responses=openapi.file("application/octet-stream"),
)  # fmt: skip
async def read_zarr(request: Request, engine: TheEngine, who: Reader, job: TheJob, path: str) -> Response:
    """A key of the zarr store: zarr and xarray open the address before it."""
    kind = "application/json" if path.endswith(".json") else "application/octet-stream"
    return delivery.file_beneath(request, engine.run_directory(job.id) / "snapshots.zarr", path, kind)


CHANGES = PROBLEMS(401, 403, 404, 409, 413, 415, 422, 503)


@api.post("/jobs/{id}/cancel", tags=["jobs"], responses=CHANGES)
async def cancel_job(engine: TheEngine, who: Submitter, job: MyJob, given: GivenKey = None) -> views.JobView:
    """End a job: at once where it has no cores, else its ranks write a checkpoint first (`stopping` until then)."""
    key = key_of(given, who, "POST /v1/jobs/cancel", job.id)
    return job_view(engine, await engine.cancel(job.id, key))


@api.post("/jobs/{id}/retry", tags=["jobs"], responses={**CHANGES, **PROBLEMS(429)})
async def retry_job(
    engine: TheEngine, rooms: TheRooms, who: Submitter, job: MyJob, given: GivenKey = None
) -> views.JobView:
    """Queue a job that ended without success again; it goes on from its last checkpoint."""
    key = key_of(given, who, "POST /v1/jobs/retry", job.id)
    if key is None or engine.store.known(key) is None:
        rooms.quotas.admit(who, 1, job.ranks)
    return job_view(engine, await asyncio.wrap_future(engine.store.retry(job.id, key)))


@api.post(
    "/jobs/{id}/rerun", status_code=201, tags=["jobs"], response_model=views.JobView,
    responses=openapi.created(401, 403, 404, 413, 415, 422, 429, 503),
)  # fmt: skip
async def rerun_job(
    engine: TheEngine, rooms: TheRooms, who: Submitter, job: TheJob, given: GivenKey = None
) -> Response:
    """Queue the same case as a new job, which begins from the start; its `origin` is this one."""
    key = key_of(given, who, "POST /v1/jobs/rerun", job.id)
    if key is None or engine.store.known(key) is None:
        rooms.quotas.admit(who, 1, job.ranks)
    new = await asyncio.wrap_future(engine.store.rerun(job.id, who.label, key))
    return made(job_view(engine, new), f"/v1/jobs/{new.id}")


@api.patch("/jobs/{id}", tags=["jobs"], responses=PROBLEMS(401, 403, 404, 413, 415, 422, 503))
async def change_job(changes: views.JobChanges, engine: TheEngine, job: MyJob) -> views.JobView:
    """Give a job another name, other tags or another priority; what is not given stays."""
    values = changes.model_dump(exclude_unset=True, exclude_none=True)
    return job_view(engine, await asyncio.wrap_future(engine.store.change(job.id, values)))


@api.delete("/jobs/{id}", status_code=204, tags=["jobs"], responses=PROBLEMS(401, 403, 404, 409, 415, 503))
async def delete_job(engine: TheEngine, job: MyJob) -> None:
    """Delete a job that has ended, with all its files, for good. Not while somebody else's sweep refers to it (409)."""
    await engine.remove([job.id])
