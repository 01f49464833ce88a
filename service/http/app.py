"""The HTTP interface as one app: its rooms, its routes, who is let in."""

import asyncio
import gc
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import Depends, FastAPI

from ..jobs.engine import Engine
from ..settings import Settings
from . import documents, files, jobs, metrics, openapi, service, sweeps
from .asking import Rooms
from .bodies import AT_ONCE
from .problems import handle_problems
from .security import Gate, needs

ROUTERS = (jobs.api, sweeps.api, files.api, service.api, service.plain)


def create_app(settings: Settings) -> FastAPI:
    """The service of one data folder; it runs jobs from its start-up to its shutdown."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with Engine(settings) as engine, Rooms(engine) as rooms:
            app.state.engine, app.state.settings, app.state.rooms = engine, settings, rooms
            app.state.large_bodies = asyncio.Semaphore(AT_ONCE)
            gc.collect()
            gc.freeze()  # what is there now stays: a collection of what requests leave need not look through it
            yield
            if settings.release:
                await engine.scheduler.release()

    app = FastAPI(
        title="frit", version=openapi.version(), description=openapi.DESCRIPTION, lifespan=lifespan,
        generate_unique_id_function=lambda route: route.name, docs_url=None, redoc_url=None,
    )  # fmt: skip
    handle_problems(app, [route for router in ROUTERS for route in router.routes])
    for router in ROUTERS:
        app.include_router(router)

    def engine() -> Engine:
        started: Engine = app.state.engine
        return started

    refusals = openapi.problems(401, 403)
    metrics.expose(app, engine, dependencies=[Depends(needs("read"))], tags=["service"], responses=refusals)
    app.add_middleware(Gate, settings=settings, store=lambda: engine().store)
    openapi.complete(app, settings.cores)
    documents.expose(app)
    return app
