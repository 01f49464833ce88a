"""The HTTP interface: what requests are answered, with real runs where running matters."""

import base64
import csv
import io
import json
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx2
import pytest
import xarray as xr
import zarr
from asking import LONG, PACKING, TINY, Tree, final, gmsh_text, listening, service, until
from fastapi.testclient import TestClient

from frit.service.index.store import Store
from frit.solver import amounts, mesh_file
from frit.solver.case import parse_case
from frit.solver.geometry import lattice

SWEEP: Tree = {
    "name": "radius", "base": PACKING, "axes": {"particles.mean_radius": [8.0, 10.0], "particles.seed": [1, 1, 2]}
}  # fmt: skip


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service that takes jobs and starts none."""
    with service(tmp_path_factory.mktemp("idle")) as client:
        yield client


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("running")


@pytest.fixture(scope="module")
def busy(data: Path) -> Iterator[str]:
    """The URL of a service that runs jobs."""
    with listening(data, free_disk=0, cores=1) as url:
        yield url


@pytest.fixture(scope="module")
def done(busy: str) -> Tree:
    """A job that has succeeded."""
    with httpx2.Client(base_url=busy) as client:
        made = client.post("/v1/jobs", json={"case": TINY}).json()
        job = final(client, made["id"])  # type: ignore[arg-type]
    assert job["state"] == "succeeded", job
    return job


def post(client: TestClient, path: str, body: Tree | None = None, key: str | None = None) -> httpx2.Response:
    headers = {} if key is None else {"Idempotency-Key": key}
    return client.post(path, json=body, headers=headers)


def problem(response: Any, status: int) -> Tree:
    """The problem details of an answer that must have them."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    tree: Tree = response.json()
    assert tree["status"] == status
    assert {"type", "title", "detail"} <= tree.keys()
    return tree


# --- submitting


def test_a_job_is_made_and_found_where_location_says(idle: TestClient) -> None:
    body = {"case": TINY, "ranks": 2, "name": "mine", "priority": 3, "tags": ["a", "b"], "time_limit": 60}
    made = post(idle, "/v1/jobs", body)
    assert made.status_code == 201
    job = idle.get(made.headers["location"]).json()
    asked = ("mine", 2, 3, ["a", "b"], 60)
    assert (job["name"], job["ranks"], job["priority"], job["tags"], job["time_limit"]) == asked
    assert (job["state"], job["final"], job["attempts"], job["progress"]) == ("queued", False, [], None)
    assert job["sentence"] == "Accepted and durable; waits for cores."
    assert job == made.json()
    assert job["case"] == parse_case(TINY).tree()
    assert job["parameters"]["nodes.spacing"] == 1.0
    assert job["parameters"]["particles.interface_width"] == 1.0, "defaults are filled in"


def test_the_same_case_again_is_another_job(idle: TestClient) -> None:
    one, two = (post(idle, "/v1/jobs", {"case": TINY}).json() for _ in range(2))
    assert one["id"] != two["id"]
    assert one["identity"] == two["identity"]


def test_every_wrong_field_of_a_case_is_pointed_at(idle: TestClient) -> None:
    case = {**TINY, "particles": {**TINY["particles"], "radii": [5.0, -4.0]}, "time": {"ned": 1.0}}
    tree = problem(post(idle, "/v1/jobs", {"case": case}), 422)
    assert tree["type"] == "/problems/refused-case"
    errors = {error["pointer"]: error for error in tree["errors"]}
    assert errors.keys() == {"/case/particles/radii/1", "/case/time/end", "/case/time/ned"}
    assert errors["/case/particles/radii/1"]["value"] == -4.0
    assert errors["/case/particles/radii/1"]["detail"] == "must be greater than 0"
    assert "did you mean end?" in errors["/case/time/ned"]["detail"]


@pytest.mark.parametrize(
    ("body", "pointer"),
    [
        ({}, "/case"),
        ({"case": 1}, "/case"),
        ({"case": TINY, "ranks": 0}, "/ranks"),
        ({"case": TINY, "ranks": "2"}, "/ranks"),
        ({"case": TINY, "priority": 10**30}, "/priority"),
        ({"case": TINY, "tags": [1]}, "/tags/0"),
        ({"case": TINY, "time_limit": -1}, "/time_limit"),
        ({"case": TINY, "command": "rm"}, "/command"),
        ({"case": TINY, "files": {"a/b~": {"content": 3}}}, "/files/a~1b~0/content"),
    ],
)
def test_every_wrong_field_of_a_request_is_pointed_at(idle: TestClient, body: Tree, pointer: str) -> None:
    tree = problem(post(idle, "/v1/jobs", body), 422)
    assert [error["pointer"] for error in tree["errors"]] == [pointer]


def test_what_is_no_json_is_a_problem(idle: TestClient) -> None:
    headers = {"Content-Type": "application/json"}
    problem(idle.post("/v1/jobs", content=b"{", headers=headers), 422)
    problem(idle.post("/v1/jobs", content=b"\xff", headers=headers), 400)
    nan = json.dumps({"case": {**TINY, "time": {"end": float("nan")}}})
    assert problem(idle.post("/v1/jobs", content=nan, headers=headers), 422)["errors"][0]["value"] == "nan"


def test_what_is_not_there_is_a_problem(idle: TestClient) -> None:
    for path in ("/v1/nothing", "/v1/jobs/none", "/v1/jobs/none/history", "/v1/jobs/none/events", "/v1/sweeps/none"):
        problem(idle.get(path), 404)
    problem(idle.delete("/v1/jobs"), 405)


# --- idempotency


def test_a_key_makes_one_job_however_often_it_comes(idle: TestClient) -> None:
    body = {"case": TINY, "tags": ["once"]}
    answers = [post(idle, "/v1/jobs", body, "k1") for _ in range(3)]
    assert {answer.status_code for answer in answers} == {201}
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert len(idle.get("/v1/jobs?tag=once").json()["jobs"]) == 1
    spelled = json.dumps(dict(reversed(body.items())), indent=3)
    headers = {"Idempotency-Key": "k1", "Content-Type": "application/json"}
    assert idle.post("/v1/jobs", content=spelled, headers=headers).status_code == 201, "the same request, spelled anew"


def test_a_key_with_another_request_is_refused(idle: TestClient) -> None:
    post(idle, "/v1/jobs", {"case": TINY}, "k2")
    tree = problem(post(idle, "/v1/jobs", {"case": TINY, "priority": 1}, "k2"), 422)
    assert tree["type"] == "/problems/key-reused"
    problem(post(idle, "/v1/jobs", {"case": TINY}, "x" * 256), 422)


def test_concurrent_requests_with_one_key_make_one_job(idle: TestClient) -> None:
    answers: list[Tree] = []
    body = {"case": TINY, "tags": ["together"]}

    def submit() -> None:
        answers.append(post(idle, "/v1/jobs", body, "k3").json())

    threads = [threading.Thread(target=submit) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({answer["id"] for answer in answers}) == 1
    assert len(idle.get("/v1/jobs?tag=together").json()["jobs"]) == 1


def test_cancel_and_retry_are_done_once_per_key(idle: TestClient) -> None:
    job = post(idle, "/v1/jobs", {"case": TINY}).json()["id"]
    assert post(idle, f"/v1/jobs/{job}/cancel", key="c1").json()["state"] == "cancelled"
    assert post(idle, f"/v1/jobs/{job}/retry", key="r1").json()["state"] == "queued"
    assert post(idle, f"/v1/jobs/{job}/cancel", key="c1").json()["state"] == "queued", "that cancel was done before"
    assert post(idle, f"/v1/jobs/{job}/cancel", key="c2").json()["state"] == "cancelled"
    assert post(idle, f"/v1/jobs/{job}/retry", key="r1").json()["state"] == "cancelled"
    other = post(idle, "/v1/jobs", {"case": TINY}).json()["id"]
    problem(post(idle, f"/v1/jobs/{other}/cancel", key="c1"), 422)


def test_a_move_that_the_state_does_not_allow_is_a_conflict(idle: TestClient) -> None:
    job = post(idle, "/v1/jobs", {"case": TINY}).json()["id"]
    tree = problem(post(idle, f"/v1/jobs/{job}/retry"), 409)
    assert tree["state"] == "queued"


# --- files


SQUARE = [[0.0, 0.0], [22.0, 0.0], [22.0, 13.0], [0.0, 13.0]]
MESH = gmsh_text(SQUARE, [[0, 1, 2], [0, 2, 3]])


def file_case(path: str) -> Tree:
    return {**TINY, "nodes": {"source": "file", "path": path}}


def test_a_mesh_comes_as_content_and_is_kept_under_its_hash(tmp_path: Path) -> None:
    files = {"bad mesh.msh": {"content": base64.b64encode(MESH).decode(), "encoding": "base64"}}
    with service(tmp_path) as client:
        one = post(client, "/v1/jobs", {"case": file_case("bad mesh.msh"), "files": files})
        assert one.status_code == 201, one.text
        text = {"other.msh": {"content": MESH.decode()}}
        two = post(client, "/v1/jobs", {"case": file_case("other.msh"), "files": text}).json()
    kept = list((tmp_path / "files").iterdir())
    assert [mesh_file.read(file).nodes[:, :2].tolist() for file in kept] == [SQUARE]
    assert one.json()["identity"] == two["identity"], "the name of a file is no part of the case"
    assert one.json()["case"]["nodes"]["path"] == kept[0].name, "the server's folder stays its own"
    assert str(tmp_path) not in one.text


def test_a_particle_file_becomes_a_list(idle: TestClient) -> None:
    case = {**TINY, "particles": {"source": "file", "path": "p.csv"}}
    files = {"p.csv": {"content": "x,y,radius\n6.5,6.2,5.0\n15.4,6.8,4.0\n"}}
    job = post(idle, "/v1/jobs", {"case": case, "files": files}).json()
    assert job["case"]["particles"] == parse_case(TINY).tree()["particles"]
    files = {"p.csv": {"content": "1,2\n"}}
    error = problem(post(idle, "/v1/jobs", {"case": case, "files": files}), 422)["errors"][0]
    assert (error["pointer"], error["value"]) == ("/case/particles/path", "p.csv")


@pytest.mark.parametrize("path", ["/etc/passwd", "../x.msh", "mesh.msh", ""])
def test_a_path_of_the_server_is_refused(idle: TestClient, path: str) -> None:
    for case in (file_case(path), {**TINY, "particles": {"source": "file", "path": path}}):
        tree = problem(post(idle, "/v1/jobs", {"case": case}), 422)
        assert tree["type"] == "/problems/refused-path"
    sweep = {**SWEEP, "base": file_case(path)}
    problem(post(idle, "/v1/sweeps", {"definition": sweep}), 422)
    for axes in ({"nodes.path": [path]}, {"nodes": [{"source": "file", "path": path}]}):
        tree = problem(post(idle, "/v1/sweeps", {"definition": {**SWEEP, "axes": axes}}), 422)
        assert tree["type"] == "/problems/refused-path"
    problem(post(idle, "/v1/sweeps", {"definition": {**SWEEP, "base": path}}), 422)


@pytest.mark.parametrize("name", ["x.xdmf", "x", "x.msh/../../y", "x.h5", "x.inp", "x.med"])
def test_only_files_that_refer_to_no_others_are_taken(idle: TestClient, name: str) -> None:
    tree = problem(post(idle, "/v1/jobs", {"case": TINY, "files": {name: {"content": ""}}}), 422)
    assert tree["type"] == "/problems/refused-file"


# --- limits


def test_limits_are_told_and_kept(tmp_path: Path) -> None:
    with service(tmp_path, nodes_limit=400, points_limit=3, queue_limit=2, body_limit=20_000) as client:
        told = client.get("/v1/limits").json()
        assert (told["nodes_per_case"], told["points_per_sweep"], told["queued_jobs"]) == (400, 3, 2)
        assert (told["body_bytes"], told["cores"], told["ranks"]) == (20_000, 2, 2)
        assert told["states"]["lost"].startswith("Its runner vanished")

        error = problem(post(client, "/v1/jobs", {"case": TINY, "ranks": 3}), 422)["errors"][0]
        assert (error["pointer"], error["detail"]) == ("/ranks", "must be at most 2, the cores there are")
        fine = {**TINY, "nodes": {"spacing": 0.5}}
        error = problem(post(client, "/v1/jobs", {"case": fine}), 422)["errors"][0]
        assert error["pointer"] == "/case/nodes/spacing"
        assert "must be at most 400" in error["detail"]
        tree = problem(post(client, "/v1/sweeps", {"definition": SWEEP}), 422)
        assert "give 6 points, must be at most 3" in tree["detail"]

        large = {"case": {**TINY, "name": "x" * 30_000}}
        problem(post(client, "/v1/jobs", large), 413)
        chunks = iter([b'{"case": "', *[b"x" * 10_000] * 5, b'"}'])
        headers = {"Content-Type": "application/json"}
        problem(client.post("/v1/jobs", content=chunks, headers=headers), 413)

        assert [post(client, "/v1/jobs", {"case": TINY}, f"k{i}").status_code for i in range(2)] == [201, 201]
        full = post(client, "/v1/jobs", {"case": TINY})
        assert problem(full, 429)["type"] == "/problems/queue-full"
        assert int(full.headers["retry-after"]) > 0
        assert post(client, "/v1/jobs", {"case": TINY}, "k1").status_code == 201, "that one is in already"


def test_the_estimate_of_nodes_is_that_of_the_lattice() -> None:
    for size, spacing in [((40.0, 30.0), 1.0), ((22.0, 13.0), 0.5), ((12.0, 14.0, 16.0), 1.0)]:
        nodes = len(lattice(size, spacing).nodes)
        assert amounts.nodes(size, spacing) == pytest.approx(nodes, rel=0.15)
    assert amounts.nodes((1e300, 1e300), 1e-300) == float("inf")


def test_an_index_that_cannot_be_used_is_told_with_a_time_to_come_back(tmp_path: Path) -> None:
    with service(tmp_path, free_disk=0) as client, closing(sqlite3.connect(tmp_path / "frit.db")) as other:
        other.isolation_level = None
        other.execute("BEGIN IMMEDIATE")  # longer than the service waits
        answer = post(client, "/v1/jobs", {"case": TINY}, "k")
        problem(answer, 503)
        assert int(answer.headers["retry-after"]) > 0
        assert str(tmp_path) not in answer.text
        other.execute("ROLLBACK")
        assert post(client, "/v1/jobs", {"case": LONG}, "k2").status_code == 201


# --- a run from start to end


def test_a_finished_job_has_its_results(busy: str, done: Tree) -> None:
    assert done["sentence"] == "The solver reached the end of the case."
    assert done["result"]["time"] == pytest.approx(0.001)
    assert 0.0 < done["result"]["vacancy_ratio"] < 1.0
    assert [attempt["state"] for attempt in done["attempts"]] == ["succeeded"]
    found = httpx2.get(f"{busy}/v1/jobs?result.vacancy_ratio.gt=0&state=succeeded").json()["jobs"]
    assert [job["id"] for job in found] == [done["id"]]


def test_an_unchanged_job_is_not_sent_again(busy: str, done: Tree) -> None:
    url = busy + done["links"]["self"]
    tag = httpx2.get(url).headers["etag"]
    again = httpx2.get(url, headers={"If-None-Match": f'"other", W/{tag}'})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    assert httpx2.get(url, headers={"If-None-Match": '"other"'}).status_code == 200


def test_the_history_is_that_of_the_run_as_json_and_as_csv(busy: str, data: Path, done: Tree) -> None:
    url = busy + done["links"]["history"]
    answer = httpx2.get(url)
    lines = (data / "runs" / done["id"] / "history.jsonl").read_text().splitlines()
    rows = answer.json()
    assert rows == [json.loads(line) for line in lines]
    assert httpx2.get(url, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    kinds = {"text/csv": "text/csv", "text/*, application/json;q=0.5": "text/csv", "*/*": "application/json"}
    for accept, kind in kinds.items():
        answer = httpx2.get(url, headers={"Accept": accept})
        assert answer.headers["content-type"].startswith(kind), accept
    table = list(csv.DictReader(io.StringIO(httpx2.get(url, headers={"Accept": "text/csv"}).text)))
    assert "volumes" not in table[0], "a list is no scalar"
    for key in ("time", "vacancy_ratio", "neck_length"):
        assert [float(row[key]) for row in table] == [row[key] for row in rows]


def test_a_long_history_is_never_whole_in_memory(
    busy: str, done: Tree, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, kinds = busy + done["links"]["history"], ("application/json", "text/csv")
    whole = [httpx2.get(url, headers={"Accept": kind}) for kind in kinds]
    rows = len(whole[0].json())
    look, most = Store.history, []

    def watched(store: Store, identifier: str, since: int = 0, limit: int | None = None) -> list[tuple[int, str]]:
        found = look(store, identifier, since, limit)
        most.append(len(found))
        return found

    monkeypatch.setattr(Store, "history", watched)
    for few in (1, rows - 1):
        monkeypatch.setattr("frit.service.http.delivery.ROWS", few)
        for kind, before in zip(kinds, whole, strict=True):
            answer = httpx2.get(url, headers={"Accept": kind})
            assert (answer.text, answer.headers["content-type"]) == (before.text, before.headers["content-type"])
            assert "etag" not in answer.headers
        assert max(most) == few + 1


def test_the_log_comes_in_parts(busy: str, data: Path, done: Tree) -> None:
    url = busy + done["links"]["log"]
    whole = (data / "runs" / done["id"] / "log.txt").read_bytes()
    answer = httpx2.get(url)
    assert (answer.status_code, answer.content) == (200, whole)
    for header, part in [("bytes=5-", whole[5:]), ("bytes=2-5", whole[2:6]), ("bytes=-4", whole[-4:])]:
        answer = httpx2.get(url, headers={"Range": header})
        assert (answer.status_code, answer.content) == (206, part)
    assert answer.headers["content-range"] == f"bytes {len(whole) - 4}-{len(whole) - 1}/{len(whole)}"
    answer = httpx2.get(url, headers={"Range": f"bytes={len(whole)}-"})
    assert problem(answer, 416)
    assert answer.headers["content-range"] == f"bytes */{len(whole)}"


def test_there_is_an_empty_log_before_there_is_one(idle: TestClient) -> None:
    job = post(idle, "/v1/jobs", {"case": TINY}).json()
    answer = idle.get(job["links"]["log"], headers={"Range": "bytes=0-"})
    assert (answer.status_code, answer.content) == (200, b"")


# --- the zarr store by URL


def test_zarr_and_xarray_open_the_url_of_a_run(busy: str, data: Path, done: Tree) -> None:
    url = busy + done["links"]["zarr"]
    here = zarr.open_group(data / "runs" / done["id"] / "snapshots.zarr", mode="r")
    group = zarr.open_group(url, mode="r")
    assert {name for name, _ in group.arrays()} == {"nodes", "time", "rho", "eta_squared", "particle"}
    there = group["rho"]
    assert isinstance(there, zarr.Array)
    assert isinstance(stored := here["rho"], zarr.Array)
    assert (there[:] == stored[:]).all()  # type: ignore[union-attr]
    with xr.open_zarr(url) as dataset:
        assert dataset.rho.dims == ("time", "node")
        assert dataset.time.values.tolist() == [0.0, 0.001]
        assert (dataset.rho.values == stored[:]).all()
    listed = httpx2.get(busy + done["links"]["snapshots"]).json()
    assert [snapshot["time"] for snapshot in listed["snapshots"]] == [0.0, 0.001]
    assert busy + listed["zarr"] == url


def test_keys_of_the_zarr_store_are_sent_as_they_are(busy: str, data: Path, done: Tree) -> None:
    url = busy + done["links"]["zarr"]
    stored = (data / "runs" / done["id"] / "snapshots.zarr" / "zarr.json").read_bytes()
    answer = httpx2.get(f"{url}/zarr.json")
    assert answer.content == stored
    head = httpx2.head(f"{url}/zarr.json")
    assert (head.status_code, head.content) == (200, b"")
    assert int(head.headers["content-length"]) == len(stored)
    assert httpx2.get(f"{url}/zarr.json", headers={"If-None-Match": head.headers["etag"]}).status_code == 304
    assert httpx2.get(f"{url}/zarr.json", headers={"Range": "bytes=0-9"}).content == stored[:10]
    for missing in ("nothing", "rho/c/99/0", "rho", "", "/", "rho/"):
        problem(httpx2.get(f"{url}/{missing}"), 404)


# --- events


def told(lines: Iterator[str]) -> list[tuple[str, str, Tree]]:
    """(event, id, data) of a stream to its end, without keep-alives and progress."""
    found, event = [], dict[str, str]()
    for line in lines:
        if line:
            key, _, value = line.partition(": ")
            event[key] = value
        elif event.get("event") != "progress" and "event" in event:
            found.append((event["event"], event["id"], json.loads(event["data"])))
            event = {}
        else:
            event = {}
    return found


def stream(url: str, last: str | None = None) -> list[tuple[str, str, Tree]]:
    headers = {} if last is None else {"Last-Event-ID": last}
    with httpx2.stream("GET", url, headers=headers, timeout=60) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        return told(answer.iter_lines())


def test_events_tell_a_job_from_start_to_end(busy: str, done: Tree) -> None:
    url = busy + done["links"]["events"]
    events = stream(url)
    states = [data["state"] for kind, _, data in events if kind == "state"]
    assert states == ["queued", "starting", "running", "succeeded"]
    rows = httpx2.get(busy + done["links"]["history"]).json()
    assert [data for kind, _, data in events if kind == "history"] == rows
    assert [kind for kind, _, _ in events][-2:] == ["state", "end"]
    assert events[-1][2] == {"state": "succeeded"}


def test_a_stream_goes_on_after_any_event_without_loss_or_repeat(busy: str, done: Tree) -> None:
    url = busy + done["links"]["events"]
    events = stream(url)
    assert len({identifier for _, identifier, _ in events}) == len(events) - 1, "only `end` shares its id"
    for number, (kind, identifier, _) in enumerate(events[:-1]):
        assert stream(url, identifier) == events[number + 1 :], (kind, identifier)
    assert stream(url, "nonsense") == events


def test_events_come_while_the_job_runs(busy: str) -> None:
    with httpx2.Client(base_url=busy, timeout=60) as client:
        job = client.post("/v1/jobs", json={"case": LONG}).json()
        kinds = []
        with client.stream("GET", job["links"]["events"]) as answer:
            for line in answer.iter_lines():
                if line.startswith("event: "):
                    kinds.append(line.removeprefix("event: "))
                if kinds.count("history") == 3:
                    break
        shown = client.get(job["links"]["self"]).json()
        assert shown["state"] == "running"
        stopping = client.post(job["links"]["cancel"]).json()
        assert stopping["stopping"] or stopping["final"]
        until(lambda: client.get(job["links"]["self"]).json()["final"])
        ended = client.get(job["links"]["self"]).json()
        assert ended["state"] == "cancelled"
        assert stream(busy + job["links"]["events"])[-1][2] == {"state": "cancelled"}


# --- sweeps


def test_a_sweep_is_queued_and_shares_jobs_with_an_earlier_one(tmp_path: Path) -> None:
    with service(tmp_path) as client:
        made = post(client, "/v1/sweeps", {"definition": SWEEP}, "s")
        assert made.status_code == 201
        sweep = made.json()
        assert (sweep["points"], sweep["duplicates"], sweep["new"], sweep["reused"]) == (4, 2, 4, 0)
        assert sweep["states"] == {"queued": 4}
        assert post(client, "/v1/sweeps", {"definition": SWEEP}, "s").json()["id"] == sweep["id"]
        wider = {**SWEEP, "axes": {"particles.mean_radius": [8.0, 10.0, 12.0], "particles.seed": [1, 2]}}
        again = post(client, "/v1/sweeps", {"definition": wider, "name": "wider", "tags": ["t"]}).json()
        assert (again["points"], again["new"], again["reused"], again["name"]) == (6, 2, 4, "wider")
        assert len(client.get(f"/v1/jobs?sweep={again['id']}").json()["jobs"]) == 6
        assert len(client.get("/v1/jobs?sweep=radius").json()["jobs"]) == 4

        shown = client.get(made.headers["location"])
        assert shown.json()["definition"]["axes"]["particles.seed"] == [1, 1, 2]
        assert client.get("/v1/sweeps/wider", headers={"If-None-Match": shown.headers["etag"]}).status_code == 200
        page = client.get("/v1/sweeps?limit=1")
        assert [row["name"] for row in page.json()["sweeps"]] == ["wider"]
        following = client.get(page.json()["next"]).json()
        assert ([row["name"] for row in following["sweeps"]], following["next"]) == (["radius"], None)
        assert page.headers["link"] == f'<{page.json()["next"]}>; rel="next"'


def test_a_wrong_sweep_is_pointed_at(idle: TestClient) -> None:
    definition = {**SWEEP, "axes": {"particles.mean_radus": [1.0]}}
    tree = problem(post(idle, "/v1/sweeps", {"definition": definition}), 422)
    assert [error["pointer"] for error in tree["errors"]] == ["/definition/axes/particles.mean_radus"]
    problem(post(idle, "/v1/sweeps", {"definition": {**SWEEP, "ranks": 3}}), 422)
    assert problem(post(idle, "/v1/sweeps", {"definition": SWEEP, "ranks": 3}), 422)["errors"][0]["pointer"] == "/ranks"


def test_jobs_of_a_sweep_are_compared(busy: str, done: Tree) -> None:
    definition = {"name": "ends", "base": TINY, "axes": {"model.k": [100.0, 50.0]}}
    with httpx2.Client(base_url=busy) as client:
        sweep = client.post("/v1/sweeps", json={"definition": definition}).json()
        assert (sweep["new"], sweep["reused"]) == (1, 1), "one was run before"
        until(lambda: client.get(sweep["links"]["self"]).json()["states"].get("succeeded") == 2)
        compared = client.get(sweep["links"]["compare"]).json()
        assert compared["differing"] == ["model.k"]
        assert [curve["parameters"] for curve in compared["curves"]] == [{"model.k": 100.0}, {"model.k": 50.0}]
        for curve in compared["curves"]:
            rows = client.get(f"/v1/jobs/{curve['job']}/history").json()
            assert curve["time"] == [row["time"] for row in rows]
            assert curve["values"] == [row["vacancy_ratio"] for row in rows]
            assert curve["final"] == rows[-1]["vacancy_ratio"]
        necks = client.get(sweep["links"]["compare"], params={"observable": "neck_length"}).json()
        assert necks["curves"][0]["final"] > 0
        tree = problem(client.get(sweep["links"]["compare"], params={"observable": "volumes"}), 422)
        assert "vacancy_ratio" in tree["errors"][0]["detail"]


# --- the service


def test_health_metrics_and_documents(tmp_path: Path) -> None:
    with service(tmp_path) as client:
        assert client.get("/livez").json() == {"status": "alive"}
        until(lambda: client.get("/readyz").status_code == 503)  # nothing is started on a full disk
        answer = client.get("/readyz")
        assert "bytes free" in problem(answer, 503)["detail"]
        assert str(tmp_path) not in answer.text
        post(client, "/v1/jobs", {"case": TINY})
        metrics = client.get("/metrics").text
        assert 'frit_jobs{state="queued"} 1.0' in metrics
        assert "frit_ready 0.0" in metrics
        assert 'http_requests_total{handler="/v1/jobs",method="POST",status="2xx"} 1.0' in metrics
        assert client.get("/docs").status_code == 200
    with service(tmp_path, free_disk=0) as client:
        until(lambda: client.get("/readyz").status_code == 200)


def test_the_document_of_the_interface_is_complete(idle: TestClient) -> None:
    document = idle.get("/openapi.json").json()
    paths = document["paths"]
    assert {path for path in paths if path.startswith("/v1")} == {
        "/v1/jobs", "/v1/jobs/{id}", "/v1/jobs/{id}/history", "/v1/jobs/{id}/log", "/v1/jobs/{id}/events",
        "/v1/jobs/{id}/snapshots", "/v1/jobs/{id}/snapshots.zarr/{path}", "/v1/jobs/{id}/cancel", "/v1/jobs/{id}/retry",
        "/v1/jobs/{id}/rerun", "/v1/sweeps", "/v1/sweeps/{id}", "/v1/sweeps/{id}/compare", "/v1/sweeps/{id}/cancel",
        "/v1/sweeps/{id}/retry", "/v1/histories", "/v1/files", "/v1/files/{id}",
        "/v1/plan", "/v1/schema", "/v1/events", "/v1/limits",
    }  # fmt: skip
    assert {"/livez", "/readyz", "/metrics"} <= paths.keys()
    for path, operations in paths.items():
        for method, operation in operations.items():
            assert operation["description"], (method, path)
            for status, response in operation["responses"].items():
                if int(status) >= 400:
                    assert response["content"].keys() == {"application/problem+json"}, (method, path, status)
            if path.startswith("/v1"):
                assert {"401", "403"} <= operation["responses"].keys(), (method, path)
    for name in ("JobSubmission", "SweepSubmission", "PlanRequest", "ProblemDetails"):
        assert document["components"]["schemas"][name]["examples"], name


def test_an_example_of_the_document_is_taken(idle: TestClient) -> None:
    schemas = idle.get("/openapi.json").json()["components"]["schemas"]
    assert post(idle, "/v1/jobs", schemas["JobSubmission"]["examples"][0]).status_code == 201
    assert post(idle, "/v1/sweeps", schemas["SweepSubmission"]["examples"][0]).status_code == 201
