"""What the OpenAPI document says beyond the routes' types: errors, headers, filters, who may use a route."""

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed
from typing import Any

from fastapi import FastAPI

from ..jobs.states import State
from . import filters
from .problems import MEDIA_TYPE, ProblemDetails
from .security import OPEN

DESCRIPTION = """Runs sintering cases and sweeps of them, and keeps what they give findable.

Errors are problem details (RFC 9457) with a JSON pointer to each wrong field. `Idempotency-Key` on a POST makes it safe
to send again. Lengths are nm; time and energy are the model's own units."""

TITLES = {
    400: "The body cannot be read",
    401: "A bearer token is needed",
    403: "The token, or the site the request comes from, does not allow it",
    404: "There is no such thing",
    409: "The job's state does not allow it",
    413: "The body is too large",
    415: "The body is of the wrong kind",
    416: "There is nothing in this range",
    421: "The service does not answer to this host name",
    422: "The request is refused",
    429: "The queue is full",
    503: "The index cannot be used now",
}
RETRY = {"Retry-After": {"description": "Seconds to wait.", "schema": {"type": "integer"}}}
TOKEN = {
    "type": "http", "scheme": "bearer",
    "description": "`frit token create` makes one. Needed as soon as one is active.",
}  # fmt: skip
READING = (401, 403, 404, 503)
Responses = dict[int | str, dict[str, Any]]


def version() -> str:
    """Of frit."""
    try:
        return installed("frit")
    except PackageNotFoundError:
        return "0"


def problems(*statuses: int) -> Responses:
    """Documented errors; the Gate may refuse any request, and a body may be no JSON."""
    more = {421} | ({400} if 415 in statuses else set())
    return {
        status: {
            "description": TITLES[status],
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDetails"}}},
            **({"headers": RETRY} if status in (429, 503) else {}),
        }
        for status in sorted({*statuses, *more})
    }


def created(*statuses: int) -> Responses:
    """201 with the address of what is new."""
    location = {"description": "Address of what was made.", "schema": {"type": "string"}}
    return {201: {"headers": {"Location": location}}, **problems(*statuses)}


def cached() -> Responses:
    """200 with a tag, 304 for who has it."""
    tag = {"ETag": {"description": "Changes with the content.", "schema": {"type": "string"}}}
    return {200: {"headers": tag}, 304: {"description": "Unchanged: If-None-Match has its tag"}, **problems(*READING)}


def history() -> Responses:
    """JSON or CSV."""
    row = {"type": "object", "example": {"time": 0.1, "step": 3, "vacancy_ratio": 0.31, "volumes": [1256.6, 1256.6]}}
    content = {
        "application/json": {"schema": {"type": "array", "items": row}},
        "text/csv": {"schema": {"type": "string"}},
    }
    return {**cached(), 200: {"description": "History rows", "content": content}}


def file(media_type: str) -> Responses:
    """A file, or a part of it."""
    schema: Mapping[str, Any] = {"type": "string"} if media_type.startswith("text/") else {}
    content = {media_type: {"schema": schema}, "application/json": {"schema": {}}}
    if media_type.startswith("text/"):
        del content["application/json"]
    return {
        200: {"description": "The whole file", "content": content},
        206: {"description": "The range that was asked for", "content": content},
        304: {"description": "Unchanged: If-None-Match has its tag"},
        **problems(416, *READING),
    }


OCTETS = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}


def _filters() -> dict[str, Any]:
    """Query parameters of the list of jobs."""
    one = f"({'|'.join(State)})"
    states = {"type": "string", "pattern": f"^{one}(,{one})*$", "example": "queued,running"}
    orders = f"^-?({'|'.join(key.replace('.', '[.]') for key in filters.known())})$"
    named: list[tuple[str, dict[str, Any], str]] = [
        ("state", states, "Jobs in one of these states."),
        ("sweep", {"type": "string"}, "Jobs of a sweep, by its id or name."),
        ("tag", {"type": "string"}, "Jobs with a tag."),
        ("order", {"type": "string", "pattern": orders, "default": "-created"}, "A key; -: the largest first."),
        ("limit", {"type": "integer", "minimum": 1, "maximum": filters.LARGEST_PAGE}, "Jobs on the page."),
        ("cursor", {"type": "string"}, "From `next` of the page before."),
    ]
    parameters = [
        {"name": name, "in": "query", "required": False, "schema": schema, "description": words}
        for name, schema, words in named
    ]
    free = {
        "name": "filters", "in": "query", "required": False, "style": "form", "explode": True,
        "description": f"`key=value` or `key.operator=value`; keys: {', '.join(filters.known())}.",
        "schema": {"type": "object", "properties": _keys(), "additionalProperties": False},
        "example": {"particles.mean_radius.ge": 9, "result.vacancy_ratio.le": 0.1},
    }  # fmt: skip
    return {"parameters": [*parameters, free]}


def _keys() -> dict[str, Any]:
    """The keys that an index has, with the operators that mean most."""
    return {f"{key}{verb}": {"type": "number"} for key in filters.INDEXED for verb in ("", ".le", ".ge")}


FILTERS = _filters()


def complete(app: FastAPI, cores: int) -> None:
    """Add what the routes do not say to the document, once it is asked for."""
    plain = app.openapi

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = plain()
            schemas = schema["components"]["schemas"]
            details = ProblemDetails.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= details.pop("$defs", {}) | {"ProblemDetails": details}
            ranks = schemas["JobSubmission"]["properties"]["ranks"]
            others = [schemas[name]["properties"]["ranks"]["anyOf"][0] for name in ("SweepSubmission", "PlanRequest")]
            for form in (ranks, *others):
                form["maximum"] = cores
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            schema["components"]["securitySchemes"] = {"token": TOKEN}
            for path, operations in schema["paths"].items():
                for operation in operations.values():
                    _complete(operation)
                    if path not in OPEN:
                        operation["security"] = [{"token": []}, {}]
        return app.openapi_schema or {}

    app.openapi = document  # type: ignore[method-assign]


def _complete(operation: dict[str, Any]) -> None:
    """Errors are problems everywhere."""
    for status, response in operation["responses"].items():
        if "application/json" in response.get("content", {}) and status == "422":
            response["content"] = problems(422)[422]["content"]
