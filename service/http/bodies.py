"""Bodies of requests: measured before they are parsed, parsed and looked through off the event loop.

A body that anybody sends may be anything. Its depth and how many values it has are found by arrays of bytes, at no
more than memory's speed and without holding the interpreter; only then is it parsed. Who sends large ones waits for
the others.
"""

import asyncio
import json
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from fastapi import Request, Response
from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect

from frit.solver.characters import UNSHOWABLE

from ..settings import Settings
from .problems import MOST_ERRORS, HttpError, WrongField, escaped, refused, shown

SMALL = 50_000  # bytes of a body that is looked at in place
LARGE = 1_000_000  # bytes of a body that waits for the others of this kind
AT_ONCE = 4  # large bodies in memory
ARRIVAL = 60.0  # seconds in which a body must come
PIECE = 1 << 18  # bytes measured at a time
DEPTH = 24  # of objects and lists within each other, several times what a case or sweep has
KEYS = 1000  # of an object
ALL_KEYS = 20_000  # of all objects of a body
QUOTE, BACKSLASH, COMMA, COLON = b'"\\,:'
DEEPER = (str, list, dict)  # types of values that may hold text
DECODER = json.JSONDecoder()  # NaN and Infinity come through: the field that has them is named later


@dataclass(frozen=True, slots=True)
class Size:
    """Of a JSON text: values, counted by what stands before them; keys; objects and lists within each other."""

    values: int
    keys: int
    depth: int


def measure(body: bytes) -> Size:
    """The size of a JSON text; of anything else, nothing sensible."""
    values, keys, level, deepest, inside, slashes = 1, 0, 0, 0, 0, 0
    for start in range(0, len(body), PIECE):
        text = np.frombuffer(body, np.uint8, min(PIECE, len(body) - start), start)
        places = np.arange(len(text), dtype=np.int32)
        # An odd number of backslashes before a quote makes it part of the string; `slashes` end the piece before.
        last = np.maximum.accumulate(np.where(text != BACKSLASH, places, -1 - slashes))
        run = np.concatenate([[slashes], places - last])
        quotes = (text == QUOTE) & (run[:-1] % 2 == 0)
        within = (np.cumsum(quotes, dtype=np.int32) + inside) % 2 == 1
        text = np.where(within, 0, text)
        opening = (text == ord("[")) | (text == ord("{"))
        levels = level + np.cumsum(opening.astype(np.int32) - ((text == ord("]")) | (text == ord("}"))))
        values += int(np.count_nonzero(opening) + np.count_nonzero(text == COMMA))
        keys += int(np.count_nonzero(text == COLON))
        deepest = max(deepest, int(levels.max()))
        level, inside, slashes = int(levels[-1]), int(within[-1]), int(run[-1])
    return Size(values, keys, deepest)


def parsed(body: bytes, most: int) -> Any:
    """The JSON value in a body that is not too large to be parsed, with no text that cannot be shown.

    most: values, at most. Raises `HttpError`.
    """
    size = measure(body)
    if size.values > most:
        raise _too_much("", f"has {size.values} values, must be at most {most}: upload lists of particles as a file")
    if size.keys > ALL_KEYS:
        raise _too_much("", f"has {size.keys} keys in all objects together, must be at most {ALL_KEYS}")
    if size.depth > DEPTH:
        raise _too_much("", f"is nested {size.depth} deep, must be at most {DEPTH}")
    try:
        tree = DECODER.decode(body.decode())
    except json.JSONDecodeError as error:
        raise _not_json(f"not valid JSON at character {error.pos}: {error.msg}") from None
    except UnicodeDecodeError as error:
        raise _not_json(f"not valid JSON: byte {error.start} is not UTF-8", 400) from None
    except (ValueError, RecursionError) as error:  # a number of too many digits
        raise _not_json(f"not valid JSON: {str(error)[:100]}") from None
    if isinstance(tree, DEEPER) and (wrong := [*islice(unshowable(tree), MOST_ERRORS)]):
        raise refused("refused-request", "The request is refused", wrong)
    return tree


def unshowable(tree: Any) -> Iterator[WrongField]:
    """Objects of too many keys, and strings with characters that a terminal would obey; not the contents of files."""
    yield from _unshowable(tree, ())


def _unshowable(value: Any, path: tuple[str | int, ...]) -> Iterator[WrongField]:
    if isinstance(value, str):
        if UNSHOWABLE.search(value) and not is_content(path):
            wrong = shown(ascii(value))
            yield WrongField(pointer=_pointer(path), value=wrong, detail="must have no control characters")
    elif isinstance(value, list):
        for number, item in enumerate(value):
            if isinstance(item, DEEPER):
                yield from _unshowable(item, (*path, number))
    elif len(value) > KEYS:
        yield WrongField(pointer=_pointer(path), detail=f"has {len(value)} keys, must be at most {KEYS}")
    else:
        for key, item in value.items():
            if UNSHOWABLE.search(key):
                yield WrongField(pointer=_pointer(path), value=shown(ascii(key)), detail="a key has control characters")
            elif isinstance(item, DEEPER):
                yield from _unshowable(item, (*path, key))


def is_content(path: tuple[str | int, ...]) -> bool:
    """Whether it is the content of an uploaded file: the one string that is never shown."""
    return len(path) == 3 and path[0] == "files" and path[2] == "content"


def _pointer(path: tuple[str | int, ...]) -> str:
    return "".join(f"/{escaped(str(part))}" for part in path)


def _too_much(pointer: str, detail: str) -> HttpError:
    return refused("over-limit", "More than this service allows", [WrongField(pointer=pointer, detail=detail)])


def _not_json(detail: str, status: int = 422) -> HttpError:
    return refused("refused-request", "The request is refused", [WrongField(pointer="", detail=detail)], status)


# --- in the place of FastAPI's own reading ----------------------------------------------------------------


class LimitedRequest(Request):
    """A request whose body is parsed within limits."""

    _tree: Any = None

    async def load(self, most: int) -> None:
        """Read and parse; once. Raises `HttpError`."""
        try:
            async with asyncio.timeout(ARRIVAL):
                body = await self.body()
        except TimeoutError:
            detail = f"the body must come within {ARRIVAL:g} s"
            raise HttpError(408, "request-timeout", "The body did not come", detail) from None
        except ClientDisconnect:  # nobody hears it
            raise HttpError(400, "disconnected", "The body did not come", "the client has hung up") from None
        if not body:
            return
        self._tree = parsed(body, most) if len(body) < SMALL else await asyncio.to_thread(parsed, body, most)

    async def json(self) -> Any:
        """What `load` has found."""
        return self._tree


class LimitedRoute(APIRoute):
    """A route that takes bodies of limited size, depth and number of values; few large ones at once."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """FastAPI's handler, given a `LimitedRequest` that is loaded."""
        handler = super().get_route_handler()
        if self.body_field is None:
            return handler

        async def limited(request: Request) -> Response:
            settings: Settings = request.app.state.settings
            loaded = LimitedRequest(request.scope, request.receive)
            if declared(loaded) < LARGE:
                await loaded.load(settings.values_limit)
                return await handler(loaded)
            async with request.app.state.large_bodies:
                await loaded.load(settings.values_limit)
                return await handler(loaded)

        return limited


def declared(request: Request) -> int:
    """Bytes that are said to come; `LARGE` where nothing is said."""
    length = request.headers.get("content-length", "")
    return int(length) if length.isdigit() and len(length) < 19 else LARGE
