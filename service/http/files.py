"""Routes of files that are uploaded by themselves."""

import asyncio
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from frit.solver.characters import HIDDEN

from . import openapi, shown, views
from .asking import TheEngine, TheRooms, made
from .security import Reader, Submitter
from .uploads import SUFFIXES

PROBLEMS = openapi.problems

NAME = rf"^[^{HIDDEN}]*\.({'|'.join(suffix[1:] for suffix in SUFFIXES)})$"

api = APIRouter(prefix="/v1")


@api.post(
    "/files", status_code=201, tags=["files"], response_model=views.FileView, openapi_extra=openapi.OCTETS,
    responses=openapi.created(401, 403, 413, 415, 422, 429, 503),
)  # fmt: skip
async def upload_file(
    request: Request, rooms: TheRooms, who: Submitter,
    name: Annotated[str, Query(max_length=200, pattern=NAME, description="As `mesh.msh`.")],
) -> Response:  # fmt: skip
    """Upload a mesh or particle file as it is, however large. Its `id` then does for `path` in a case or sweep."""
    await asyncio.to_thread(rooms.quotas.admit, who, 0)
    file = await rooms.stored.receive(name, request.stream(), who.label)
    return made(shown.file_view(file), f"/v1/files/{file.id}")


@api.get("/files", tags=["files"], responses=PROBLEMS(401, 403, 422, 503))
async def list_files(
    rooms: TheRooms, who: Reader,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    after: Annotated[int, Query(ge=0, le=10**9, description="Files before the page; see `next`.")] = 0,
) -> views.FilePage:  # fmt: skip
    """Files that were uploaded by themselves, newest first."""
    found = await asyncio.to_thread(rooms.stored.listed, who.sees)
    rest = len(found) > after + limit
    listed = [shown.file_view(file) for file in found[after : after + limit]]
    return views.FilePage(files=listed, next=f"/v1/files?limit={limit}&after={after + limit}" if rest else None)


@api.delete("/files/{id}", status_code=204, tags=["files"], responses=PROBLEMS(401, 403, 404, 409, 415, 503))
async def delete_file(id: str, engine: TheEngine, rooms: TheRooms, who: Submitter) -> None:
    """Remove a file; not while a job or a sweep refers to it (409)."""
    await asyncio.to_thread(rooms.stored.remove, id, who.may, engine.store.files_used)
