"""What routes share: what they are about, who asks, the key of a request that may come again."""

import asyncio
import hashlib
import json
import os
from contextlib import suppress
from typing import Annotated, Any, Self

from fastapi import Depends, Header, Path, Request, Response
from pydantic import BaseModel

from ..index.records import Key, NotFoundError, StoreError, SweepRecord
from ..jobs.engine import Engine
from ..jobs.states import Job
from . import shown, views
from .quotas import Quotas
from .security import Reader, Submitter, Who
from .stored import Stored
from .uploads import Shelf

TIDY = 3600.0  # seconds between two looks for uploads that nothing uses


class Rooms:
    """What the app holds while it runs, beside the engine."""

    def __init__(self, engine: Engine) -> None:
        self.shelf = Shelf(engine.settings)
        self.stored = Stored(self.shelf)
        self.quotas = Quotas(engine.settings, engine.store, self.stored)
        self.engine = engine

    async def __aenter__(self) -> Self:
        self._tidying = asyncio.create_task(self._tidy())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._tidying.cancel()
        self.shelf.close()

    async def _tidy(self) -> None:
        """Remove, every hour, uploads that nothing uses."""
        while True:
            with suppress(OSError, StoreError):  # it will go better the next time
                await asyncio.to_thread(self._tidy_once)
            await asyncio.sleep(TIDY)

    def _tidy_once(self) -> None:
        """Nothing while there are more run directories than jobs: a lost index does not know what they use."""
        with os.scandir(self.engine.settings.runs) as folders:
            runs = sum(folder.is_dir() for folder in folders)
        if runs <= sum(self.engine.store.counts().values()):
            self.shelf.tidy(self.engine.store.files_used())


def running(request: Request) -> Engine:
    """The engine of the app."""
    engine: Engine = request.app.state.engine
    return engine


def rooms_of(request: Request) -> Rooms:
    """Files and quotas of the app."""
    rooms: Rooms = request.app.state.rooms
    return rooms


async def _engine(request: Request) -> Engine:
    return running(request)


async def _rooms(request: Request) -> Rooms:
    return rooms_of(request)


JobId = Annotated[str, Path(max_length=100, description="Or its beginning.")]
SweepId = Annotated[str, Path(max_length=200, description="Or its name.")]


async def _job(request: Request, id: JobId, who: Reader) -> Job:
    job = running(request).store.job(id)
    if not who.sees(job.owner):
        raise NotFoundError(f"job {id!r}: there is none, or several begin so")
    return job


async def _sweep(request: Request, id: SweepId, who: Reader) -> SweepRecord:
    sweep = running(request).store.sweep(id)
    if not who.sees(sweep.owner):
        raise NotFoundError(f"sweep {id!r}: there is none")
    return sweep


async def _my_job(request: Request, id: JobId, who: Submitter) -> Job:
    job = await _job(request, id, who)
    who.check(job.owner, f"job {job.id}")
    return job


async def _my_sweep(request: Request, id: SweepId, who: Submitter) -> SweepRecord:
    sweep = await _sweep(request, id, who)
    who.check(sweep.owner, f"sweep {sweep.id}")
    return sweep


TheEngine = Annotated[Engine, Depends(_engine)]
TheRooms = Annotated[Rooms, Depends(_rooms)]
TheJob = Annotated[Job, Depends(_job)]
TheSweep = Annotated[SweepRecord, Depends(_sweep)]
MyJob = Annotated[Job, Depends(_my_job)]
MySweep = Annotated[SweepRecord, Depends(_my_sweep)]
GivenKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key", min_length=1, max_length=255, pattern=r"^[\x21-\x7e]+( +[\x21-\x7e]+)*$",
        description="The same key with the same request gives what it gave, and does nothing twice.",
    ),
]  # fmt: skip
LastEvent = Annotated[str | None, Header(alias="Last-Event-ID")]


def key_of(value: str | None, who: Who, route: str, request: Any) -> Key | None:
    """One user's key for one route; the request is told by its content, not by its spelling."""
    if value is None:
        return None
    text = json.dumps(request, sort_keys=True)
    return Key(f"{who.name} {route}", value, hashlib.sha256(text.encode()).hexdigest())


async def key_of_body(value: str | None, who: Who, route: str, body: BaseModel) -> Key | None:
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
    return shown.detail(job, hidden(engine), attempts, engine.progress(job.id))


def sweep_view(engine: Engine, identifier: str) -> views.SweepView:
    """A sweep as it is now."""
    sweep = engine.store.sweep(identifier)
    return shown.sweep_view(sweep, engine.store.new_in_sweeps([sweep.seq])[sweep.seq])


def made(view: BaseModel, address: str) -> Response:
    """201, and where the new thing is."""
    return Response(view.model_dump_json(), 201, {"Location": address}, "application/json")
