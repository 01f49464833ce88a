"""Routes of sweeps."""

import asyncio
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from ..jobs.states import State
from . import admission, delivery, filters, openapi, shown, views
from .asking import (
    GivenKey,
    MySweep,
    TheEngine,
    TheRooms,
    TheSweep,
    key_of,
    key_of_body,
    made,
    rooms_of,
    sweep_view,
)
from .bodies import LimitedRoute
from .comparison import CURVES, ROWS, ObservableError, Page, compare
from .problems import WrongField, refused
from .security import Reader, Submitter

PROBLEMS = openapi.problems
AGAIN = (State.FAILED, State.ERROR, State.CANCELLED, State.TIMED_OUT, State.LOST)

api = APIRouter(prefix="/v1", route_class=LimitedRoute)


@api.post(
    "/sweeps", status_code=201, tags=["sweeps"], response_model=views.SweepView,
    responses=openapi.created(401, 403, 413, 415, 422, 429, 503),
)  # fmt: skip
async def submit_sweep(
    submission: views.SweepSubmission, request: Request, engine: TheEngine, who: Submitter, given: GivenKey = None
) -> Response:
    """Queue the points of a sweep that no job has yet; the others are shared with the jobs there are."""
    store, rooms = engine.store, rooms_of(request)
    key = await key_of_body(given, who, "POST /v1/sweeps", submission)
    if key is not None and (before := store.known(key)) is not None:
        sweep = store.sweep(before)
    else:
        async with admission.taken(submission.definition, submission.files, "/definition", rooms, who) as uploads:
            new = await asyncio.to_thread(admission.sweep_of, submission, engine.settings, uploads, who.label)
            rooms.quotas.admit(who, len(new.points), max((point.job.ranks for point in new.points), default=1))
            sweep = await asyncio.wrap_future(new.queued(store, key, not engine.settings.private, submission.recompute))
    view = shown.sweep_view(sweep, store.new_in_sweeps([sweep.seq])[sweep.seq])
    return made(view, f"/v1/sweeps/{sweep.id}")


@api.get("/sweeps", tags=["sweeps"], responses=PROBLEMS(401, 403, 422, 503))
async def list_sweeps(
    response: Response, engine: TheEngine, who: Reader,
    limit: Annotated[int, Query(ge=1, le=filters.LARGEST_PAGE)] = filters.PAGE,
    cursor: Annotated[str | None, Query(pattern=r"^[0-9]{1,18}$", description="From `next`.")] = None,
) -> views.SweepPage:  # fmt: skip
    """Sweeps, newest first."""

    def page() -> list[views.SweepView]:
        found = engine.store.sweeps(None if cursor is None else int(cursor), limit + 1, who.only)
        new = engine.store.new_in_sweeps([sweep.seq for sweep in found])
        return [shown.sweep_view(sweep, new[sweep.seq]) for sweep in found]

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
    view = shown.sweep_detail(sweep, engine.store.new_in_sweeps([sweep.seq])[sweep.seq])
    return delivery.tagged(request, view.model_dump_json().encode(), "application/json")


@api.get(
    "/sweeps/{id}/compare", tags=["sweeps"], response_model=views.Comparison,
    responses=PROBLEMS(401, 403, 404, 422, 503),
)  # fmt: skip
async def compare_jobs(
    engine: TheEngine, who: Reader, sweep: TheSweep,
    observable: Annotated[str, Query(max_length=100, description="A scalar of the history rows.")] = "vacancy_ratio",
    limit: Annotated[int, Query(ge=1, le=CURVES, description="Jobs on the page.")] = CURVES,
    after: Annotated[int, Query(ge=0, le=10**9, description="Points of the sweep before the page; see `next`.")] = 0,
    rows: Annotated[int, Query(ge=2, le=ROWS, description="Points of a curve, at most: spread over its rows.")] = 50,
) -> Response:  # fmt: skip
    """An observable of the jobs over time, with the parameters that differ; page by page, in the order of the sweep."""
    try:
        found = await asyncio.to_thread(compare, engine.store, sweep, observable, Page(after, limit, rows))
    except ObservableError as error:
        wrong = WrongField(parameter="observable", value=observable, detail=str(error))
        raise refused("refused-query", "The query is refused", [wrong]) from None
    link = {} if found.next is None else {"Link": f'<{found.next}>; rel="next"'}
    return Response(found.model_dump_json(), media_type="application/json", headers=link)


CHANGES = PROBLEMS(401, 403, 404, 409, 413, 415, 422, 503)


@api.post("/sweeps/{id}/cancel", tags=["sweeps"], responses=CHANGES)
async def cancel_sweep(engine: TheEngine, who: Submitter, sweep: MySweep, given: GivenKey = None) -> views.SweepView:
    """End all jobs of a sweep that have not ended; of jobs that belong to somebody else, none."""
    await engine.cancel_sweep(sweep.id, who.may, key_of(given, who, "POST /v1/sweeps/cancel", sweep.id))
    return sweep_view(engine, sweep.id)


@api.post("/sweeps/{id}/retry", tags=["sweeps"], responses={**CHANGES, **PROBLEMS(429)})
async def retry_sweep(
    engine: TheEngine, rooms: TheRooms, who: Submitter, sweep: MySweep, given: GivenKey = None
) -> views.SweepView:
    """Queue all jobs of a sweep that ended without success again; of jobs that belong to somebody else, none."""
    key = key_of(given, who, "POST /v1/sweeps/retry", sweep.id)
    if key is None or engine.store.known(key) is None:
        rooms.quotas.admit(who, sum(n for state, n in sweep.states.items() if state in AGAIN))
    await asyncio.wrap_future(engine.store.retry_sweep(sweep.id, who.may, key))
    return sweep_view(engine, sweep.id)


@api.delete("/sweeps/{id}", status_code=204, tags=["sweeps"], responses=PROBLEMS(401, 403, 404, 409, 415, 503))
async def delete_sweep(engine: TheEngine, sweep: MySweep) -> None:
    """Delete a sweep and the jobs that were made with it, but for those that other sweeps refer to.

    All of them must have ended (409).
    """
    await engine.remove_sweep(sweep.id)
