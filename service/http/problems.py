"""Errors over HTTP: RFC 9457 problem details with a JSON pointer to each wrong field of the request."""

import http
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import BaseRoute

from frit.solver.case import CaseError

from ..index.records import KeyReusedError, NotFoundError, StoreError
from ..index.removals import InUseError
from ..jobs.states import TransitionError

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER = 5  # seconds
SHOWN = 200  # characters of a refused value
TOLD = 500  # characters of a pointer, a detail or a parameter's name
MOST_ERRORS = 50  # wrong fields that are told; the others are counted
MOST_BYTES = 64_000  # of a problem
PART = re.compile(r'"([^"]*)"|\[(\d+)\]|([^.\[\]"]+)')


class WrongField(BaseModel):
    """One wrong field. `pointer` leads into the request's body (RFC 6901); `parameter` names one outside of it."""

    pointer: str | None = None
    parameter: str | None = None
    value: Any = None
    detail: str


class ProblemDetails(BaseModel):
    """An error. `type` tells errors apart; `errors` has an entry per wrong field of the request."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "type": "/problems/refused-case",
                    "title": "The case is refused",
                    "status": 422,
                    "detail": "particles.radii[0] = -1.0: must be greater than 0",
                    "errors": [
                        {"pointer": "/case/particles/radii/0", "value": -1.0, "detail": "must be greater than 0"}
                    ],
                }
            ]
        }
    )

    type: str
    title: str
    status: int
    detail: str
    errors: list[WrongField] = []
    more: int = 0
    """wrong fields beyond those in `errors`; at least as many"""
    state: str | None = None


class HttpError(Exception):
    """An error on its way to the client."""

    def __init__(
        self, status: int, kind: str, title: str, detail: str, errors: Iterable[WrongField] = (),
        headers: Mapping[str, str] | None = None, state: str | None = None, more: int = 0,
    ) -> None:  # fmt: skip
        super().__init__(detail)
        fields = list(errors)
        self.details = ProblemDetails(
            type=f"/problems/{kind}", title=title, status=status, detail=cut(detail), state=state,
            errors=[short(field) for field in fields[:MOST_ERRORS]], more=more + len(fields[MOST_ERRORS:]),
        )  # fmt: skip
        self.headers = dict(headers or {})

    def response(self) -> Response:
        """As it is sent: ASCII, so that no text of a request can break it, and of limited length."""
        details = self.details
        while len(body := json.dumps(self._tree(details))) > MOST_BYTES:
            half = len(details.errors) // 2
            more = details.more + len(details.errors) - half
            details = details.model_copy(update={"errors": details.errors[:half], "more": more})
        return Response(body, details.status, self.headers, MEDIA_TYPE)

    @staticmethod
    def _tree(details: ProblemDetails) -> dict[str, Any]:
        return {key: value for key, value in details.model_dump(exclude_none=True).items() if value not in ([], 0)}


def cut(text: str, most: int = TOLD) -> str:
    """The text, or its beginning and three dots."""
    return text if len(text) <= most else text[: most - 3] + "..."


def short(field: WrongField) -> WrongField:
    """A wrong field whose words are of limited length, whatever the request had for names."""
    words = {"pointer": field.pointer, "parameter": field.parameter, "detail": field.detail}
    return field.model_copy(update={key: cut(text) for key, text in words.items() if text is not None})


def refused(kind: str, title: str, fields: Sequence[WrongField], status: int = 422, more: int = 0) -> HttpError:
    """A request with wrong fields."""
    told = map(short, fields[:MOST_ERRORS])
    places = (f"{field.parameter or field.pointer or 'body'}: {field.detail}" for field in told)
    return HttpError(status, kind, title, "; ".join(places), fields, more=more)


def refused_case(error: CaseError, pointer: str, title: str = "The case is refused") -> HttpError:
    """A case or sweep at `pointer` in the body that says what is wrong with it."""
    kind = "refused-case" if pointer == "/case" else "refused-sweep"
    fields = [
        WrongField(pointer=pointer + pointer_to(problem.key), value=shown(problem.value), detail=problem.allowed)
        for problem in error.problems
    ]
    return HttpError(422, kind, title, str(error), fields, more=error.more)


def unavailable(detail: str) -> HttpError:
    """The service cannot do it now; trying again later is right."""
    title = "The service cannot do this now"
    return HttpError(503, "unavailable", title, detail, headers={"Retry-After": str(RETRY_AFTER)})


def not_found(detail: str) -> HttpError:
    """There is no such thing."""
    return HttpError(404, "not-found", "There is no such thing", detail)


def pointer_to(key: str) -> str:
    """The JSON pointer of a dotted key such as `particles.radii[0]` or `axes."particles.mean_radius"`; `case`: all."""
    if key == "case":
        return ""
    parts = ["".join(found) for found in PART.findall(key)]
    return "".join(f"/{escaped(part)}" for part in parts)


def escaped(part: str) -> str:
    """A part of a JSON pointer."""
    return part.replace("~", "~0").replace("/", "~1")


def shown(value: Any) -> Any:
    """A refused value as it may be sent: short, and without numbers that JSON does not know."""
    if value is None or isinstance(value, bool) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if isinstance(value, int):
        return value if value.bit_length() < 64 else cut(f"{value:#x}", SHOWN)
    if isinstance(value, str):
        return cut(value, SHOWN)
    if isinstance(value, list | tuple | dict):
        text, whole = beginning(value, SHOWN)
        return value if whole else cut(text, SHOWN)
    return cut(repr(value), SHOWN)


def beginning(value: Any, most: int) -> tuple[str, bool]:
    """The first characters of a value's JSON, however large it is, and whether they are all of it as JSON has it."""
    text = ""
    try:
        for piece in json.JSONEncoder(allow_nan=False).iterencode(value):
            text += piece[: most + 1]
            if len(text) > most:
                return text, False
    except (TypeError, ValueError, RecursionError):
        return cut(text or type(value).__name__, most), False
    return text, True


def handle_problems(app: FastAPI, routes: Sequence[BaseRoute]) -> None:
    """Have every error of the app answered as a problem."""

    async def problem(request: Request, error: Exception) -> Response:
        problem = as_problem(error)
        if problem.details.status == 405:  # a route knows only its own method
            fitting = [r for r in routes if isinstance(r, APIRoute) and r.path_regex.match(request.url.path)]
            methods = {method for route in fitting for method in route.methods or ()}
            problem.headers["Allow"] = ", ".join(sorted(methods))
        return problem.response()

    kinds = (HttpError, RequestValidationError, HTTPException, StoreError, NotFoundError, KeyReusedError, InUseError)
    for kind in (*kinds, TransitionError, Exception):
        app.add_exception_handler(kind, problem)


def as_problem(error: Exception) -> HttpError:
    """What the client is told of an error; nothing of one that was not foreseen."""
    if isinstance(error, HttpError):
        return error
    if isinstance(error, RequestValidationError):
        entries = error.errors()
        fields = [_wrong(entry) for entry in entries[:MOST_ERRORS]]
        return refused("refused-request", "The request is refused", fields, more=len(entries[MOST_ERRORS:]))
    if isinstance(error, StoreError):
        return unavailable("the index cannot be used now")
    if isinstance(error, NotFoundError):
        return not_found(str(error))
    if isinstance(error, KeyReusedError):
        field = WrongField(parameter="Idempotency-Key", detail=str(error))
        return HttpError(422, "key-reused", "The key came before, with another request", str(error), [field])
    if isinstance(error, InUseError):
        return HttpError(409, "in-use", "It is in use", str(error))
    if isinstance(error, TransitionError):
        title = "The job's state does not allow this"
        return HttpError(409, "wrong-state", title, str(error), state=str(error.state))
    if isinstance(error, HTTPException):
        if error.status_code == 413:
            return HttpError(413, "content-too-large", "The body is too large", error.detail)
        title = http.HTTPStatus(error.status_code).phrase
        kind = title.lower().replace(" ", "-").replace("'", "")
        return HttpError(error.status_code, kind, title, str(error.detail), headers=error.headers)
    return HttpError(500, "internal-error", "The service broke", "an error that was not foreseen; it is in the log")


def _wrong(entry: Mapping[str, Any]) -> WrongField:
    """Of pydantic's errors: the first part of the place says where the value came from."""
    where, *parts = entry["loc"]
    value = None if entry["type"] == "missing" else shown(entry["input"])
    if where == "body":
        pointer = "".join(f"/{escaped(str(part))}" for part in parts)
        return WrongField(pointer=pointer, value=value, detail=entry["msg"])
    return WrongField(parameter=".".join(map(str, parts)), value=value, detail=entry["msg"])
