"""Bytes over HTTP: files of a run directory by Range, histories, entity tags, and what a client accepts."""

import csv
import hashlib
import io
import json
import os
import re
import stat
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import anyio.to_thread
from fastapi import Request
from starlette.responses import Response, StreamingResponse

from ..index.store import Store
from .problems import HttpError, not_found

PIECE = 1 << 18  # bytes read at once
ROWS = 5000  # of a history that are in memory at once
RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


def open_beneath(root: Path, parts: Sequence[str]) -> int | None:
    """A descriptor of the regular file at these parts below `root`; None where there is none.

    Each part is opened by itself in the folder before it, and never through a link: no name leads out of `root`.
    """
    if not parts or any(part in ("", ".", "..") or "/" in part or "\0" in part for part in parts):
        return None
    handle = -1
    try:
        handle = os.open(root, os.O_RDONLY | os.O_DIRECTORY)
        for number, part in enumerate(parts, start=1):
            kind = os.O_DIRECTORY if number < len(parts) else os.O_NONBLOCK
            inner = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | kind, dir_fd=handle)
            os.close(handle)
            handle = inner
        if stat.S_ISREG(os.fstat(handle).st_mode):
            return handle
    except (OSError, ValueError):  # not there, a link, too long a name, no text of this file system
        pass
    if handle >= 0:
        os.close(handle)
    return None


def matches(request: Request, tag: str) -> bool:
    """Whether the client has this version already."""
    given = request.headers.get("if-none-match", "")
    return given.strip() == "*" or tag in [one.strip().removeprefix("W/") for one in given.split(",")]


def tagged(request: Request, body: bytes, media_type: str, headers: Mapping[str, str] | None = None) -> Response:
    """A body with the hash of its content for its tag; 304 where the client has it."""
    tag = f'"{hashlib.blake2b(body, digest_size=16).hexdigest()}"'
    headers = {**(headers or {}), "ETag": tag, "Cache-Control": "no-cache"}
    if matches(request, tag):
        return Response(status_code=304, headers=headers)
    return Response(body, media_type=media_type, headers=headers)


def wanted(header: str | None, size: int) -> tuple[int, int] | None:
    """First byte and the one after the last of a Range header; None: everything. A range that begins too late is empty.

    Several ranges, and what is no range of bytes, are ignored, as RFC 9110 allows.
    """
    if header is None or (found := RANGE.fullmatch(header.strip())) is None or found.groups() == ("", ""):
        return None
    first, last = found.groups()
    if not first:
        return (max(size - int(last), 0), size) if int(last) else (size, size)
    if last and int(last) < int(first):
        return None
    return int(first), min(int(last) + 1, size) if last else size


def file_response(request: Request, handle: int, media_type: str) -> Response:
    """The regular file that `handle` has open, whole or the range that was asked for; closes it."""
    status = os.fstat(handle)
    size, tag = status.st_size, f'"{status.st_ino:x}-{status.st_mtime_ns:x}-{status.st_size:x}"'
    headers = {"Accept-Ranges": "bytes", "ETag": tag, "Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}
    if matches(request, tag):
        os.close(handle)
        return Response(status_code=304, headers=headers)
    conditional = request.headers.get("if-range", tag) == tag
    part = wanted(request.headers.get("range"), size) if conditional else None
    first, after = part or (0, size)
    if part is not None and first >= size:
        os.close(handle)
        headers["Content-Range"] = f"bytes */{size}"
        detail = f"Range = {request.headers['range']!r}: must begin before byte {size}"
        raise HttpError(416, "range-not-satisfiable", "There is nothing in this range", detail, headers=headers)
    headers["Content-Length"] = str(after - first)
    if part is not None:
        headers["Content-Range"] = f"bytes {first}-{after - 1}/{size}"
    code = 200 if part is None else 206
    if request.method == "HEAD":
        os.close(handle)
        return Response(status_code=code, headers=headers, media_type=media_type)
    return StreamingResponse(_pieces(handle, first, after), code, headers, media_type)


async def _pieces(handle: int, first: int, after: int) -> AsyncIterator[bytes]:
    """The bytes; never more than were there when the response began, however the file grows."""
    try:
        while first < after:
            size = min(PIECE, after - first)
            # small files come from the page cache faster than from another thread
            piece = os.pread(handle, size, first) if after <= PIECE else await _read(handle, size, first)
            if not piece:
                raise OSError("the file became shorter while it was sent")
            first += len(piece)
            yield piece
    finally:
        os.close(handle)


async def _read(handle: int, size: int, first: int) -> bytes:
    return await anyio.to_thread.run_sync(os.pread, handle, size, first)


def file_beneath(request: Request, root: Path, path: str, media_type: str) -> Response:
    """The file at `path` below `root`, or the problem that there is none."""
    if (handle := open_beneath(root, path.split("/"))) is None:
        raise not_found("there is no such key in the store")
    return file_response(request, handle, media_type)


def prefers(accept: str, first: str, second: str) -> bool:
    """Whether an Accept header likes the first media type better than the second, which is the default."""

    def weight(media_type: str) -> float:
        best = (-1, 0.0)
        for entry in accept.split(","):
            kind, *parameters = (part.strip() for part in entry.lower().split(";"))
            patterns = ("*/*", media_type.partition("/")[0] + "/*", media_type)
            if kind in patterns:
                quality = next((p[2:] for p in parameters if p.startswith("q=")), "1")
                number = float(quality) if re.fullmatch(r"[01](\.\d{0,3})?", quality) else 0.0
                best = max(best, (patterns.index(kind), number))
        return best[1]

    return weight(first) > weight(second)


# --- histories


def as_csv(rows: Sequence[str]) -> str:
    """The scalar columns of history rows; one that a row does not have is empty there."""
    trees = [json.loads(row) for row in rows]
    columns = {key: None for tree in trees for key, value in tree.items() if not isinstance(value, list | dict)}
    return _table(trees, list(columns), heading=True)


def _table(trees: Sequence[Mapping[str, Any]], columns: Sequence[str], heading: bool) -> str:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, extrasaction="ignore")
    if heading:
        writer.writeheader()
    writer.writerows(trees)
    return text.getvalue()


async def _parts(store: Store, job: str, write: Callable[[list[str], bool], str]) -> AsyncIterator[str]:
    """A history part by part, as `write` writes its rows; it is told which part is the first."""

    def part(since: int) -> tuple[int, str]:
        found = store.history(job, since, ROWS)
        return (found[-1][0] + 1, write([line for _, line in found], since == 0)) if found else (since, "")

    since, text = await anyio.to_thread.run_sync(part, 0)
    while text:
        yield text
        since, text = await anyio.to_thread.run_sync(part, since)


async def long_json(store: Store, job: str) -> AsyncIterator[str]:
    """A history of any length, of which few rows are in memory at a time."""
    yield "["
    async for text in _parts(store, job, lambda rows, first: ("" if first else ",") + ",".join(rows)):
        yield text
    yield "]"


def long_csv(store: Store, job: str, columns: Sequence[str]) -> AsyncIterator[str]:
    """The same as a table."""
    return _parts(store, job, lambda rows, first: _table([json.loads(row) for row in rows], columns, heading=first))
