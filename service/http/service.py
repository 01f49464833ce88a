"""Routes of the service itself: what it allows, plans without submitting, its schema, what happens to all jobs."""

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request
from fastapi.sse import EventSourceResponse, ServerSentEvent

from frit.solver.case import case_schema
from frit.sweeps.cost import Measured, plan
from frit.sweeps.definition import sweep_schema
from frit.sweeps.expand import Expansion, Point

from ..index.store import Store
from ..jobs.states import SENTENCES, State
from ..settings import Settings
from . import admission, filters, openapi, reckoning, shown, stream, views
from .asking import LastEvent, Rooms, TheEngine, TheRooms, hidden
from .bodies import LimitedRoute
from .problems import WrongField, refused, unavailable
from .security import Reader, Submitter, Who, still_admitted

PROBLEMS = openapi.problems

api = APIRouter(prefix="/v1", route_class=LimitedRoute)
plain = APIRouter()


@api.get("/limits", tags=["service"], responses=PROBLEMS(401, 403, 503))
async def show_limits(engine: TheEngine, rooms: TheRooms, who: Reader) -> views.Limits:
    """What this service allows, what is left of that to the token of the request, and what the states mean."""
    s = engine.settings
    quotas = {} if who.label is None else await asyncio.to_thread(quotas_of, s, rooms, who.label)
    return views.Limits(
        cores=s.cores, ranks=s.cores, body_bytes=s.body_limit, file_bytes=s.file_limit,
        points_per_sweep=s.points_limit, values_per_body=s.values_limit, nodes_per_case=s.nodes_limit,
        particles_per_case=s.particles_limit, rows_per_case=s.rows_limit, snapshots_per_case=s.snapshots_limit,
        memory_bytes_per_core=s.memory_limit, disk_bytes_per_case=s.disk_limit, bytes_per_sweep=s.sweep_limit,
        queued_jobs=s.queue_limit, page=filters.LARGEST_PAGE, private=s.private, token=who.label, quotas=quotas,
        states={str(state): sentence for state, sentence in SENTENCES.items()},
    )  # fmt: skip


def quotas_of(s: Settings, rooms: Rooms, label: str) -> dict[str, views.Quota]:
    """What a token may have, has, and has left."""
    used = rooms.quotas.usage(label)
    known: dict[str, tuple[float, float | None]] = {
        "queued_jobs": (used.queued, s.quota_queued), "cores": (used.cores, s.quota_cores),
        "core_hours": (used.core_seconds / 3600, s.quota_core_hours), "bytes": (used.bytes, s.quota_bytes),
    }  # fmt: skip
    return {
        name: views.Quota(used=now, limit=most, left=None if most is None else max(0.0, most - now))
        for name, (now, most) in known.items()
    }


@api.post("/plan", tags=["service"], responses=PROBLEMS(401, 403, 413, 415, 422, 503))
async def make_plan(wanted: views.PlanRequest, engine: TheEngine, rooms: TheRooms, who: Submitter) -> views.Plan:
    """What a case or sweep would cost, checked as if it were submitted; nothing is."""
    if (wanted.case is None) == (wanted.definition is None):
        raise refused("refused-request", "The request is refused", [WrongField(pointer="", detail=ONE_OF)])
    tree, pointer = (wanted.definition, "/definition") if wanted.case is None else (wanted.case, "/case")
    async with admission.taken(tree or {}, wanted.files, pointer, rooms, who) as uploads:
        check = _case if wanted.definition is None else _sweep
        expansion, need = await asyncio.to_thread(check, wanted, engine.settings, uploads)
    made = await asyncio.to_thread(_planned, expansion, engine.store, who)
    return views.Plan(**made, need=need)


ONE_OF = "must have either `case` or `definition`"


def _case(wanted: views.PlanRequest, settings: Settings, uploads: Any) -> tuple[Expansion, views.Need | None]:
    submission = views.JobSubmission(case=wanted.case or {}, ranks=wanted.ranks or 1, files=wanted.files)
    job = admission.job_of(submission, settings, uploads)
    found = reckoning.need(json.loads(job.case), job.ranks)
    need = views.Need(
        nodes=found.nodes, points=found.points, particles=found.particles, memory_bytes=found.memory,
        disk_bytes=found.disk,
    )  # fmt: skip
    return Expansion((Point(job.identity, job.case, job.name, {}),), 0), need


def _sweep(wanted: views.PlanRequest, settings: Settings, uploads: Any) -> tuple[Expansion, views.Need | None]:
    submission = views.SweepSubmission(definition=wanted.definition or {}, ranks=wanted.ranks, files=wanted.files)
    return admission.sweep_of(submission, settings, uploads).expansion, None


def _planned(expansion: Expansion, store: Store, who: Who) -> dict[str, Any]:
    """Private services reckon with everybody's times, which tell nothing, but not with others' jobs."""
    past = [Measured(json.loads(case), seconds) for case, seconds in store.measured()]
    known = store.identities([point.identity for point in expansion.points])
    done = {name for name, job in known.items() if job.state is State.SUCCEEDED and who.sees(job.owner)}
    return plan(expansion, past, done).as_dict()


@api.get("/schema", tags=["service"], responses=PROBLEMS(401, 403, 422))
async def show_schema(
    _who: Reader, of: Annotated[Literal["case", "sweep"], Query(description="Of which file.")] = "case"
) -> dict[str, Any]:
    """JSON Schema of a case, or of a sweep."""
    return case_schema() if of == "case" else sweep_schema()


@api.get("/events", tags=["service"], response_class=EventSourceResponse, responses=PROBLEMS(401, 403, 422, 503))
async def follow_all(
    request: Request, engine: TheEngine, who: Reader, last_event_id: LastEvent = None,
    since: Annotated[int | None, Query(ge=0, lt=10**18, description="Begin after this event; 0: the first.")] = None,
) -> AsyncIterator[ServerSentEvent]:  # fmt: skip
    """Changes of state of all jobs (`state`), and jobs and sweeps that are deleted (`deleted`), as they come.

    Last-Event-ID goes on after the event of that id; without it and `since`, what happens from now on is told.
    """
    async for event in stream.all_events(engine, last_event_id, since, who.only, lambda: still_admitted(request)):
        yield event


@plain.get("/livez", tags=["service"])
async def live() -> views.Health:
    """Whether the process answers."""
    return views.Health(status="alive")


@plain.get("/readyz", tags=["service"], responses=PROBLEMS(503))
async def ready(engine: TheEngine) -> views.Health:
    """Whether jobs can be started and recorded; if not, why."""
    if (reason := engine.trouble()) is not None:
        raise unavailable(shown.without_path(reason, hidden(engine)) or "")
    return views.Health(status="ready")
