"""Bodies of requests: measured before they are parsed, errors without end cut, nothing that a terminal obeys."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
from asking import TINY, service
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from frit.service.cli.terminal import cell
from frit.service.http import bodies
from frit.service.http.bodies import measure, unshowable
from frit.service.http.problems import MOST_BYTES, MOST_ERRORS, beginning, shown
from frit.service.http.views import JobSubmission
from frit.solver.case import CaseError, parse_case
from frit.solver.characters import visible
from frit.sweeps.definition import parse_sweep

JSON = {"Content-Type": "application/json"}
SWEEP = {"name": "s", "base": TINY, "axes": {"time.end": [0.001, 0.002]}}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    with service(tmp_path_factory.mktemp("data"), values_limit=20_000) as found:
        yield found


def refusal(client: TestClient, content: bytes | dict[str, Any], path: str = "/v1/jobs", status: int = 422) -> Any:
    """The problem of a request that must be refused; never long."""
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    answer = client.post(path, content=body, headers=JSON)
    assert answer.status_code == status, answer.text[:1000]
    assert len(answer.content) <= MOST_BYTES
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert len(problem.get("errors", [])) <= MOST_ERRORS
    return problem


# --- measured


leaves = st.none() | st.booleans() | st.integers() | st.text(alphabet='ab"\\,[]{}:\n\u00e9') | st.just("\\" * 7 + '"')
trees = st.recursive(leaves, lambda inner: st.lists(inner) | st.dictionaries(st.text('k"\\,['), inner), max_leaves=40)


def plainly(tree: Any) -> tuple[int, int, int]:
    """Commas and brackets outside of strings; keys; brackets within each other."""
    if not isinstance(tree, list | dict):
        return 0, 0, 0
    found = [plainly(inner) for inner in (tree.values() if isinstance(tree, dict) else tree)]
    values = 1 + max(len(tree) - 1, 0) + sum(v for v, _, _ in found)
    keys = (len(tree) if isinstance(tree, dict) else 0) + sum(k for _, k, _ in found)
    return values, keys, 1 + max((d for _, _, d in found), default=0)


@given(trees, st.sampled_from([7, 8, 64, 1 << 18]), st.booleans())
def test_the_measure_is_that_of_the_tree(tree: Any, piece: int, ascii_: bool) -> None:
    before = bodies.PIECE
    bodies.PIECE = piece
    try:
        size = measure(json.dumps(tree, ensure_ascii=ascii_).encode())
    finally:
        bodies.PIECE = before
    values, keys, depth = plainly(tree)
    assert (size.values, size.keys, size.depth) == (values + 1, keys, depth)


@pytest.mark.parametrize("body", [b"", b"]]]]", b'"', b"\\\\\\", b'"' * 1001, bytes(range(256))])
def test_what_is_no_json_is_measured_all_the_same(body: bytes) -> None:
    measure(body)


# --- refused before it is parsed


@pytest.mark.parametrize(
    "body",
    [
        b"[" * 200_000,
        b'{"case":' * 5000 + b"1" + b"}" * 5000,
        b"[" + b"{}," * 300_000 + b"{}]",
        b'{"case": [' + b"1," * 30_000 + b"1]}",
        b'{"case": [' + b'{"a":1,"b":"c:d"},' * 7000 + b'{"c":1,"d":1,"e":1}]}',
        b'{"case": {"particles": {"radii": [' + b'"x",' * 30_000 + b"1]}}}",
    ],
)
def test_too_deep_and_too_many_values_are_never_parsed(
    client: TestClient, body: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bodies, "DECODER", None)
    assert refusal(client, body)["type"] == "/problems/over-limit"


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b'{"case": 1' + b"1" * 5000 + b"}", 422), (b'{"case": NaN}', 422), (b'{"case": Infinity}', 422),
        (b'{"case": {}', 422), (json.dumps({"case": TINY}).encode("utf-16"), 400), (b'{"case": "\xff"}', 400),
        (b"null", 422), (b"[]", 422), (b'"x"', 422), (b" ", 422),
    ],
)  # fmt: skip
def test_what_json_does_not_have_is_refused(client: TestClient, body: bytes, status: int) -> None:
    refusal(client, body, status=status)


def test_the_content_of_a_file_is_one_value(client: TestClient) -> None:
    """A CSV of many commas counts as one."""
    lines = "".join(f"{6.5 + 3 * k},6.2,1.0\n" for k in range(4)) + "\n" * 200_000 + "x,y,radius," * 100_000
    problem = refusal(client, {"case": TINY, "files": {"a.csv": {"content": lines}}, "nonsense": 1})
    assert problem["errors"][0]["pointer"] == "/nonsense"


# --- errors without end


def test_many_wrong_fields_are_counted_not_told(client: TestClient) -> None:
    case = {**TINY, **{f"table {k}": {} for k in range(900)}}
    problem = refusal(client, {"case": case})
    assert (len(problem["errors"]), problem["more"]) == (MOST_ERRORS, 900 - MOST_ERRORS)
    problem = refusal(client, {"case": TINY, **{f"key {k}": 1 for k in range(900)}})
    assert problem["more"] == 900 - MOST_ERRORS


def test_wrong_paths_beyond_the_told_ones_are_counted(client: TestClient) -> None:
    sweep = {**SWEEP, "axes": {"nodes.path": [f"mesh {k}" for k in range(80)]}}
    problem = refusal(client, {"definition": sweep}, "/v1/sweeps")
    assert (len(problem["errors"]), problem["more"]) == (MOST_ERRORS, 80 - MOST_ERRORS)


@pytest.mark.parametrize("place", ["", "case", "nodes"])
def test_an_object_of_very_many_keys_is_one_error(client: TestClient, place: str) -> None:
    many = {f"key {k}": k for k in range(5000)}
    case = {**TINY, "nodes": many} if place == "nodes" else many if place == "case" else TINY
    problem = refusal(client, {"case": case, **(many if not place else {})})
    assert len(problem["errors"]) == 1
    assert "keys" in problem["errors"][0]["detail"]


@pytest.mark.parametrize("tags", [["x" * 101] * 15_000, [1] * 15_000, ["a"] * 15_000, [[]] * 5000])
def test_many_tags_are_refused_by_the_first_that_is_wrong(client: TestClient, tags: list[Any]) -> None:
    assert len(refusal(client, {"case": TINY, "tags": tags})["errors"]) == 1


@pytest.mark.parametrize("length", [1000, 20_000])
def test_long_names_make_no_long_answer(client: TestClient, length: int) -> None:
    """Also where every character takes six."""
    for name in ("k" * length, "\u00e9" * length, "~" * length):
        refusal(client, {"case": {**TINY, name: 1, "nodes": {name: name}}, name: {name: name}})
        refusal(client, {"case": {**TINY, **{f"{name}{k}": 1 for k in range(60)}}})
        refusal(client, {"case": {**TINY, "name": name, "time": name, "domain": {"size": [name] * 50}}})
        refusal(client, {"definition": {**SWEEP, "axes": {name: [1]}}}, "/v1/sweeps")


def test_only_the_beginning_of_a_large_value_is_written_out() -> None:
    """Not the whole of it, to cut it then."""

    class Told(dict[str, int]):
        asked = 0

        def items(self) -> Any:
            for pair in super().items():
                Told.asked += 1
                yield pair

    text, whole = beginning(Told({f"key {k}": k for k in range(100_000)}), 200)
    assert (len(text) > 200, whole) == (True, False)
    assert Told.asked < 100
    assert shown([1, 2]) == [1, 2]
    assert len(shown([1] * 1000)) == 200
    assert shown(float("nan")) == "nan"
    assert len(shown(10**10_000)) == 200


# --- nothing that a terminal obeys


RED = "\x1b[31mRED"
NO_TEXT = "must have no control characters|must be a valid string"  # half a surrogate pair is no text at all


@pytest.mark.parametrize("bad", [RED, "a\nb", "\x9b31m", "\u202egnp.exe", "a\u2028b", "\x00", "\x7f", "\ud800"])
def test_no_string_that_is_shown_has_control_characters(client: TestClient, bad: str) -> None:
    for body in (
        {"case": {**TINY, "name": bad}}, {"case": TINY, "name": bad}, {"case": TINY, "tags": [bad]},
        {"case": {**TINY, bad: {}}}, {"case": {**TINY, "nodes": {"spacing": bad}}},
        {"case": TINY, "files": {bad: {"content": "x"}}},
        {"case": TINY, "files": {"x": {"content": "x", "encoding": bad}}},
    ):  # fmt: skip
        answer = json.dumps(refusal(client, body), ensure_ascii=False)
        assert bad not in answer
        assert not unshowable_in(answer)
    for changes in ({"name": bad}, {"tags": [bad]}, {"axes": {bad: [1]}}, {"axes": {"particles.path": [bad]}}):
        refusal(client, {"definition": {**SWEEP, **changes}}, "/v1/sweeps")
    with pytest.raises(CaseError, match=NO_TEXT):
        parse_case({**TINY, "name": bad})
    with pytest.raises(CaseError, match=NO_TEXT):
        parse_sweep({**SWEEP, "name": bad})


def unshowable_in(text: str) -> list[Any]:
    return list(unshowable(text))


def test_the_content_of_a_file_may_have_lines() -> None:
    tree = {"files": {"a.csv": {"content": "x\ny\x1b"}}, "case": {"files": {"a": {"content": "x\n"}}}}
    assert [field.pointer for field in unshowable(tree)] == ["/case/files/a/content"]
    listed = {"files": {"a/b": {"content": ["x\n"]}}}
    assert [field.pointer for field in unshowable(listed)] == ["/files/a~1b/content/0"]


def test_what_older_jobs_have_is_written_out() -> None:
    """Names that came in before control characters were refused, logs, and a server that is not to be trusted."""
    assert cell(RED) == r"\x1b[31mRED"
    assert visible("a\tb\nc\x9b", keep="\n\t") == "a\tb\nc\\x9b"
    assert visible("\ud800é\u202e") == r"\ud800é\u202e"


def test_the_document_says_what_a_name_may_have() -> None:
    pattern = JobSubmission.model_json_schema()["properties"]["name"]["anyOf"][0]["pattern"]
    assert r"\x00-\x1f" in pattern


# --- queries


@pytest.mark.parametrize(
    "query",
    [
        "&".join(f"particles.mean_radius.ge={k}" for k in range(1000)), "&".join(f"tag={k}" for k in range(1000)),
        "particles.seed.in=" + ",".join(map(str, range(5000))), "state=" + ",".join(["queued"] * 2000),
        "&".join(f"k{k}=1" for k in range(1000)), "&".join(f"sweep=s{k}" for k in range(1000)),
    ],
)  # fmt: skip
def test_a_query_of_very_many_conditions_is_refused(client: TestClient, query: str) -> None:
    answer = client.get(f"/v1/jobs?{query}")
    assert answer.status_code == 422
    assert len(answer.content) <= MOST_BYTES
