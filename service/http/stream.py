"""The life of a job as server-sent events.

An event that is in the index has the id "<event>-<rows>": the number of the last change of state and of history rows
that the client has then. A client that comes back with it gets what followed, without loss or repeat.
"""

import re
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import anyio
from fastapi.sse import ServerSentEvent

from ..index.records import NotFoundError, StoreError
from ..jobs.engine import Engine
from .shown import moment, without_path

PATIENCE = 2.0  # seconds between two looks when nothing is notified
PAUSE = 0.05  # seconds between two looks, at least
ROWS = 500  # history rows read at once
LAST_EVENT_ID = re.compile(r"(\d{1,18})-(\d{1,18})")


def place(last_event_id: str | None) -> tuple[int, int]:
    """(event, rows) that a client has already; what is no id of ours is the beginning."""
    found = LAST_EVENT_ID.fullmatch(last_event_id or "")
    return (int(found[1]), int(found[2])) if found else (0, 0)


async def events(
    engine: Engine, identifier: str, last_event_id: str | None, admitted: Callable[[], bool]
) -> AsyncIterator[ServerSentEvent]:
    """`state`, `history`, `progress`, and `end` once the job is final; no more once the client is not admitted."""
    store, (event, rows), told = engine.store, place(last_event_id), None
    hidden = str(engine.settings.data.absolute())
    while True:
        looked = time.monotonic()
        async with engine.notifier.turn():
            if not admitted():
                return
            try:
                job = store.job(identifier)
                changes = store.events(identifier, event)
                added = store.history(identifier, rows, ROWS)
            except (StoreError, NotFoundError):  # the client comes back
                return
        complete = len(added) < ROWS
        # the end of a job is told after its last row, whatever it was; so keep the last change back
        kept = changes[-1:] if job.final or not complete else []
        for change in changes[: len(changes) - len(kept)]:
            event = change.seq
            yield _state(change, rows, hidden)
        for number, line in added:
            rows = number + 1
            yield ServerSentEvent(event="history", raw_data=line, id=f"{event}-{rows}")
        if not complete:
            continue
        for change in kept:
            event = change.seq
            yield _state(change, rows, hidden)
        if job.final:
            yield ServerSentEvent(event="end", data={"state": job.state}, id=f"{event}-{rows}")
            return
        if (progress := engine.progress(identifier)) is not None and progress != told:
            told = progress
            yield ServerSentEvent(event="progress", data=progress)
        await engine.notifier.wait(PATIENCE)
        await anyio.sleep(max(0.0, looked + PAUSE - time.monotonic()))


async def all_events(
    engine: Engine, last_event_id: str | None, since: int | None, owner: str | None, admitted: Callable[[], bool]
) -> AsyncIterator[ServerSentEvent]:
    """`state` and `deleted` of all jobs, or of an owner's; the id is the number of the event."""
    store, hidden = engine.store, str(engine.settings.data.absolute())
    known = re.fullmatch(r"\d{1,18}", last_event_id or "")
    last = int(known[0]) if known else since
    if last is None:
        last = store.last_event()
        yield ServerSentEvent(event="begin", data={}, id=str(last))
    while True:
        looked = time.monotonic()
        async with engine.notifier.turn():
            if not admitted():
                return
            try:
                news = store.news(last, ROWS, owner)
            except StoreError:  # the client comes back
                return
        for each in news:
            last, gone = each.seq, each.state in ("job", "sweep")
            data = {"at": moment(each.at).isoformat().replace("+00:00", "Z")}
            more = {each.state: each.id} if gone else {
                "job": each.id, "name": each.name, "state": each.state, "message": without_path(each.message, hidden)
            }  # fmt: skip
            yield ServerSentEvent(event="deleted" if gone else "state", data={**data, **more}, id=str(last))
        if len(news) < ROWS:
            await engine.notifier.wait(PATIENCE)
            await anyio.sleep(max(0.0, looked + PAUSE - time.monotonic()))


def _state(change: Any, rows: int, hidden: str) -> ServerSentEvent:
    at = moment(change.at).isoformat().replace("+00:00", "Z")
    data = {
        "state": change.state, "sentence": change.state.sentence, "at": at,
        "message": without_path(change.message, hidden),
    }  # fmt: skip
    return ServerSentEvent(event="state", data=data, id=f"{change.seq}-{rows}")
