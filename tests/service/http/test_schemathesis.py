"""The interface keeps what its own document says, whatever is sent: generated requests against the real service."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx2
import pytest
import schemathesis
from asking import PACKING, TINY, listening, settings_in
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from schemathesis.checks import not_a_server_error

from frit.service.http.app import create_app
from frit.service.index import tokens

SWEEP = {"name": "s", "base": PACKING, "axes": {"particles.mean_radius": [8.0, 10.0]}}


class Known:
    """What a module's tests ask about: set by the fixture, read by the hook."""

    secret = ""
    job = ""
    sweep = ""


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service with a token, a job and a sweep; it starts nothing."""
    folder: Path = tmp_path_factory.mktemp("data")
    with listening(folder, body_limit=200_000, nodes_limit=100_000, points_limit=50) as found:
        Known.job = httpx2.post(f"{found}/v1/jobs", json={"case": TINY}).json()["id"]
        Known.sweep = httpx2.post(f"{found}/v1/sweeps", json={"definition": SWEEP}).json()["id"]
        Known.secret = tokens.create(folder, "all", "submit")
        yield found


schemathesis.openapi.media_type("application/octet-stream", st.just(b"6.5,6.2,5.0\n"))  # a file that is taken
schema = schemathesis.openapi.from_dict(create_app(settings_in(Path("unused"))).openapi())


@schema.hook
def map_path_parameters(context: Any, path_parameters: Any) -> Any:
    """Most requests are about something that is there; streams of a job that does not end never do."""
    path = context.operation.path
    if isinstance(path_parameters, dict) and "id" in path_parameters and not path.endswith("/events"):
        known = Known.sweep if path.startswith("/v1/sweeps") else Known.job
        if len(str(path_parameters["id"])) % 4:
            return {**path_parameters, "id": known}
    return path_parameters


@schema.hook
def map_query(context: Any, query: Any) -> Any:
    """A cursor comes from a page before, and observables are those of the runs: no type says which there are."""
    if isinstance(query, dict):
        query = {key: value for key, value in query.items() if key != "cursor"}
        if "observable" in query:
            query["observable"] = "neck_length"
    return query


@schema.hook
def map_body(context: Any, body: Any) -> Any:
    """What is possible within a case, a sweep or a file no schema says: these are good, all else is generated."""
    if not isinstance(body, dict):
        return body
    good = {"case": TINY, "definition": SWEEP}
    body = {key: good[key] if key in good and isinstance(value, dict) else value for key, value in body.items()}
    files = body.get("files")
    if isinstance(files, dict) and all(map(is_file, files.values())):
        body["files"] = {}
    return body


def is_file(content: Any) -> bool:
    """Whether it is one by its schema."""
    known = isinstance(content, dict) and content.keys() <= {"content", "encoding"}
    return known and isinstance(content.get("content"), str) and content.get("encoding", "text") in ("text", "base64")


@schema.exclude(path="/v1/events").parametrize()  # an answer that has no end; test_verbs.py has it
@settings(
    max_examples=10, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
def test_every_answer_is_one_that_the_document_has(case: schemathesis.Case[Any], url: str) -> None:
    # not ready is an answer, and nothing is started here
    excluded: list[Any] = [not_a_server_error] if case.operation.path == "/readyz" else []
    headers = {"Authorization": f"Bearer {Known.secret}"}
    key = str(dict(case.headers or {}).get("Idempotency-Key", ""))
    if re.fullmatch("[!-~]{1,255}", key):  # one of an earlier request would be refused with this one
        headers["Idempotency-Key"] = str(uuid4())
    case.call_and_validate(base_url=url, headers=headers, excluded_checks=excluded)
