"""What can be done to jobs, sweeps and files beside submitting them, over HTTP."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asking import TINY, final, gmsh_text, service
from fastapi.testclient import TestClient
from requesting import SWEEP, case, kind, upload
from serving import stand_in

from frit.service.index.store import Store

Tree = dict[str, Any]
@pytest.fixture
def idle(tmp_path: Path) -> Iterator[TestClient]:
    """Starts nothing."""
    with service(tmp_path / "data") as client:
        yield client


@pytest.fixture
def busy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """Jobs do what their names say."""
    monkeypatch.setenv("FRIT_MPIRUN", stand_in(tmp_path))
    with service(tmp_path / "data", free_disk=0) as client:
        yield client


def submit(client: TestClient, name: str, shift: float = 0.0, **more: Any) -> str:
    answer = client.post("/v1/jobs", json={"case": case(name, shift), **more})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


# --- deleting ---------------------------------------------------------------------------------------------


def test_a_job_that_has_ended_is_deleted_with_its_folder_and_its_id_is_not_given_again(
    busy: TestClient, tmp_path: Path
) -> None:
    job, other = submit(busy, "sleep 0"), submit(busy, "sleep 0")
    for each in (job, other):
        assert final(busy, each)["state"] == "succeeded"
    folder = tmp_path / "data" / "runs" / job
    assert (folder / "exit.json").exists()
    assert busy.delete(f"/v1/jobs/{job}").status_code == 204
    assert not folder.exists()
    for way in ("", "/history", "/log", "/snapshots"):  # its id is the beginning of the other's
        assert kind(busy.get(f"/v1/jobs/{job}{way}")) == (404, "not-found")
    assert kind(busy.delete(f"/v1/jobs/{job}")) == (404, "not-found")
    assert [row["id"] for row in busy.get("/v1/jobs").json()["jobs"]] == [other]
    again = submit(busy, "sleep 0")
    assert again == f"{job}-3"
    assert final(busy, other)["state"] == "succeeded"


def test_a_job_that_has_not_ended_is_not_deleted(busy: TestClient) -> None:
    job = submit(busy, "sleep 60")
    answer = busy.delete(f"/v1/jobs/{job}")
    assert kind(answer) == (409, "wrong-state")
    assert "delete is possible only from succeeded, failed" in answer.json()["detail"]
    busy.post(f"/v1/jobs/{job}/cancel")
    final(busy, job)
    assert busy.delete(f"/v1/jobs/{job}").status_code == 204


def test_a_sweep_is_deleted_with_its_jobs_but_not_with_those_of_another(busy: TestClient, tmp_path: Path) -> None:
    first = busy.post("/v1/sweeps", json={"definition": SWEEP}).json()["id"]
    longer = {**SWEEP, "axes": {"model.D_surf": [4.0, 6.0]}}
    second = busy.post("/v1/sweeps", json={"definition": longer}).json()["id"]
    ids = [row["id"] for row in busy.get("/v1/jobs?order=created").json()["jobs"]]
    for each in ids:
        final(busy, each)
    assert busy.delete(f"/v1/sweeps/{first}").status_code == 204
    assert busy.get(f"/v1/sweeps/{first}").status_code == 404
    left = [row["id"] for row in busy.get("/v1/jobs?order=created").json()["jobs"]]
    assert left == ids[1:]  # the one of 4.0 is the second sweep's too
    assert sorted(path.name for path in (tmp_path / "data" / "runs").iterdir() if path.is_dir()) == sorted(left)
    assert busy.get(f"/v1/sweeps/{second}").json()["states"] == {"succeeded": 2}
    assert busy.post("/v1/sweeps", json={"definition": SWEEP}).json()["id"] == "s3"  # no id comes again


def test_a_sweep_with_a_job_that_has_not_ended_stays_whole(idle: TestClient) -> None:
    sweep = idle.post("/v1/sweeps", json={"definition": SWEEP}).json()["id"]
    first = idle.get(f"/v1/jobs?sweep={sweep}").json()["jobs"][0]["id"]
    idle.post(f"/v1/jobs/{first}/cancel")
    assert kind(idle.delete(f"/v1/sweeps/{sweep}")) == (409, "wrong-state")
    assert idle.get(f"/v1/sweeps/{sweep}").json()["states"] == {"cancelled": 1, "queued": 1}


# --- changing, and once more ------------------------------------------------------------------------------


def test_name_tags_and_priority_are_changed_and_found(idle: TestClient) -> None:
    job = submit(idle, "sleep 0", tags=["old"])
    ahead = submit(idle, "sleep 0", 0.1)
    changes = {"name": "better", "tags": ["new", "newer"], "priority": 7}
    shown = idle.patch(f"/v1/jobs/{job}", json=changes).json()
    assert {key: shown[key] for key in changes} == changes
    assert [row["id"] for row in idle.get("/v1/jobs?tag=newer").json()["jobs"]] == [job]
    assert idle.get("/v1/jobs?tag=old").json()["jobs"] == []
    assert [row["id"] for row in idle.get("/v1/jobs?order=-priority").json()["jobs"]] == [job, ahead]
    assert idle.patch(f"/v1/jobs/{job}", json={"priority": 0}).json()["name"] == "better"
    answer = idle.patch(f"/v1/jobs/{job}", json={"ranks": 2, "priority": "high"})
    assert kind(answer) == (422, "refused-request")
    assert {wrong["pointer"] for wrong in answer.json()["errors"]} == {"/ranks", "/priority"}


def test_a_rerun_is_a_new_job_from_the_start(busy: TestClient, tmp_path: Path) -> None:
    job = submit(busy, "sleep 0", tags=["a"], priority=3)
    final(busy, job)
    headers = {"Idempotency-Key": "once"}
    answer = busy.post(f"/v1/jobs/{job}/rerun", headers=headers)
    assert answer.status_code == 201
    new = answer.json()
    assert (new["id"], new["origin"], new["tags"], new["priority"]) == (f"{job}-2", job, ["a"], 3)
    assert answer.headers["Location"] == f"/v1/jobs/{new['id']}"
    assert busy.post(f"/v1/jobs/{job}/rerun", headers=headers).json()["id"] == new["id"]
    assert final(busy, new["id"])["attempt"] == 1
    assert [row["id"] for row in busy.get(f"/v1/jobs?origin={job}").json()["jobs"]] == [new["id"]]
    assert (tmp_path / "data" / "runs" / job / "exit.json").exists()
    assert final(busy, job)["attempt"] == 1


def test_a_sweep_is_cancelled_and_tried_again_whole(busy: TestClient) -> None:
    definition = {**SWEEP, "base": {**TINY, "name": "sleep 60"}, "name": "sleep 60"}
    sweep = busy.post("/v1/sweeps", json={"definition": definition}).json()["id"]
    headers = {"Idempotency-Key": "k"}
    assert busy.post(f"/v1/sweeps/{sweep}/cancel", headers=headers).status_code == 200
    ids = [row["id"] for row in busy.get(f"/v1/jobs?sweep={sweep}").json()["jobs"]]
    for each in ids:
        assert final(busy, each)["state"] == "cancelled"
    assert sum(busy.post(f"/v1/sweeps/{sweep}/retry").json()["states"].values()) == 2
    assert "cancelled" not in busy.get(f"/v1/sweeps/{sweep}").json()["states"]
    busy.post(f"/v1/sweeps/{sweep}/cancel", headers=headers)  # the same request: it does nothing twice
    assert "cancelled" not in busy.get(f"/v1/sweeps/{sweep}").json()["states"]
    busy.post(f"/v1/sweeps/{sweep}/cancel")
    for each in ids:
        assert final(busy, each)["state"] == "cancelled"


# --- looking ahead ----------------------------------------------------------------------------------------


def test_a_plan_costs_nothing_and_tells_what_it_would(idle: TestClient) -> None:
    found = idle.post("/v1/plan", json={"case": TINY}).json()
    assert (found["points"], found["to_run"], found["done"]) == (1, 1, 0)
    assert found["core_hours"] > 0
    assert found["need"]["nodes"] == pytest.approx(23 * 14, rel=0.2)
    swept = idle.post("/v1/plan", json={"definition": SWEEP}).json()
    assert (swept["points"], swept["to_run"], swept["need"]) == (2, 2, None)
    assert idle.get("/v1/jobs").json()["jobs"] == []
    wrong = idle.post("/v1/plan", json={"case": {**TINY, "particles": {"centres": [[1.0, 1.0]], "radii": [-1.0]}}})
    assert wrong.status_code == 422
    assert wrong.json()["errors"][0]["pointer"] == "/case/particles/radii/0"
    for body in ({}, {"case": TINY, "definition": SWEEP}):
        assert kind(idle.post("/v1/plan", json=body)) == (422, "refused-request")


def test_the_schema_is_that_of_the_files(idle: TestClient) -> None:
    assert {"domain", "particles"} <= idle.get("/v1/schema").json()["properties"].keys()
    assert {"base", "axes"} <= idle.get("/v1/schema?of=sweep").json()["properties"].keys()
    assert idle.get("/v1/schema?of=mesh").status_code == 422


# --- files ------------------------------------------------------------------------------------------------


def square(size: int) -> bytes:
    """A mesh of a rectangle as large as the domain of `TINY`, with that many nodes along it."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 22, size), np.linspace(0, 13, size), indexing="ij"))
    first = [i * size + j for i in range(size - 1) for j in range(size - 1)]
    cells = [[k, k + size, k + 1] for k in first] + [[k + size, k + size + 1, k + 1] for k in first]
    return gmsh_text(np.column_stack([x, y]).tolist(), cells)


def with_mesh(path: str) -> Tree:
    return {**TINY, "nodes": {"source": "file", "path": path}}


def test_a_mesh_is_uploaded_by_itself_used_by_its_id_and_kept_while_it_is(idle: TestClient, tmp_path: Path) -> None:
    answer = upload(idle, square(30))
    assert answer.status_code == 201, answer.text
    file = answer.json()
    assert answer.headers["Location"] == f"/v1/files/{file['id']}"
    assert [row["name"] for row in idle.get("/v1/files").json()["files"]] == ["mesh.msh"]
    job = idle.post("/v1/jobs", json={"case": with_mesh(file["id"])})
    assert job.status_code == 201, job.text
    assert job.json()["case"]["nodes"]["path"] == file["id"]
    assert kind(idle.delete(f"/v1/files/{file['id']}")) == (409, "in-use")
    idle.post(f"/v1/jobs/{job.json()['id']}/cancel")
    assert idle.delete(f"/v1/jobs/{job.json()['id']}").status_code == 204
    assert idle.delete(f"/v1/files/{file['id']}").status_code == 204
    assert idle.get("/v1/files").json()["files"] == []
    assert list((tmp_path / "data" / "files").iterdir()) == []
    assert kind(idle.delete(f"/v1/files/{file['id']}")) == (404, "not-found")
    assert kind(idle.post("/v1/jobs", json={"case": with_mesh(file["id"])})) == (422, "refused-path")


def test_a_file_may_be_larger_than_a_body_and_not_larger_than_its_own_limit(tmp_path: Path) -> None:
    with service(tmp_path / "data", body_limit=10_000, file_limit=60_000) as client:
        small, large = square(20), square(50)
        assert 10_000 < len(small) < 60_000 < len(large)
        assert upload(client, small).status_code == 201
        assert upload(client, large).status_code == 413
        pieces = (large[k : k + 1000] for k in range(0, len(large), 1000))
        assert upload(client, pieces).status_code == 413  # type: ignore[arg-type]  # no length is told
        assert len(list((tmp_path / "data" / "files").iterdir())) == 2  # the small one and its card


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (b"", "a.msh", "is empty"),
        (b"MZ certainly no mesh", "a.msh", "none of the known"),
        (b"\x89HDF\r\n\x1a\n" * 9, "a.msh", "is HDF5"),
        (b"<VTKFile><!DOCTYPE x></VTKFile>", "a.vtu", "declares or includes"),
        (b"<VTKFile>" + b" " * ((1 << 24) - 14) + b"<!ENTITY x></VTKFile>", "a.vtu", "declares or includes"),
    ],
)
def test_what_is_no_mesh_is_not_kept(idle: TestClient, tmp_path: Path, content: bytes, name: str, words: str) -> None:
    answer = upload(idle, content, name)
    assert kind(answer) == (422, "refused-file")
    assert words in answer.json()["detail"]
    assert answer.json()["errors"][0]["parameter"] == "name"
    folder = tmp_path / "data" / "files"
    assert not folder.exists() or list(folder.iterdir()) == []
    assert upload(idle, content, name, **{"Content-Type": "application/json"}).status_code == 415
    assert kind(upload(idle, content, "a.exe")) == (422, "refused-request")


def test_no_path_leads_out_of_the_files(idle: TestClient) -> None:
    for path in ("../frit.db", "/etc/passwd", "x" * 70, "../" * 22 + "etc/passwd"):
        assert kind(idle.post("/v1/jobs", json={"case": with_mesh(path)})) == (422, "refused-path")
        assert idle.delete(f"/v1/files/{path.replace('/', '%2F')}").status_code == 404


# --- one stream over all ----------------------------------------------------------------------------------


def told(client: TestClient, count: int, query: str = "?since=0", **headers: str) -> list[tuple[int, str, Tree]]:
    """The first events: id, kind, data."""
    found, fields = [], Tree()
    with client.stream("GET", f"/v1/events{query}", headers=headers) as answer:
        for line in answer.iter_lines():
            if line:
                key, _, value = line.partition(": ")
                fields[key] = value
            elif "data" in fields:
                found.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
                fields = {}
                if len(found) == count:
                    return found
    return found


def test_all_events_are_told_in_order_and_again_from_any_place(
    busy: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("frit.service.http.stream.ROWS", 2)  # a few at a time
    jobs = [submit(busy, "sleep 0", 0.1 * k) for k in range(3)]
    for job in jobs:
        final(busy, job)
    busy.delete(f"/v1/jobs/{jobs[1]}")
    whole = told(busy, 9)
    assert [number for number, _, _ in whole] == sorted({number for number, _, _ in whole})
    states = [data["state"] for _, _, data in whole if data.get("job") == jobs[0] and "state" in data]
    assert states == ["queued", "starting", "running", "succeeded"]
    assert [(event, data["job"]) for _, event, data in whole if event == "deleted"] == [("deleted", jobs[1])]
    for k in range(1, 9):
        rest = told(busy, 9 - k, "", **{"Last-Event-ID": str(whole[k - 1][0])})
        assert rest == whole[k:]
    begin = told(busy, 1, "")
    assert begin == [(whole[-1][0], "begin", {})]


# --- what is left -----------------------------------------------------------------------------------------


def test_what_is_gone_is_in_the_index_only_as_gone(busy: TestClient, tmp_path: Path) -> None:
    job = submit(busy, "sleep 0")
    final(busy, job)
    busy.delete(f"/v1/jobs/{job}")
    store = Store(tmp_path / "data", writable=False)
    try:
        assert store.unsettled() == []
        with store.reading() as connection:
            for table in ("jobs", "events", "attempts", "history", "snapshots", "job_tags"):
                assert connection.exec_driver_sql(f"SELECT count(*) FROM {table}").scalar() == 0
            assert connection.exec_driver_sql("SELECT id, done FROM removed").fetchall() == [(job, 1)]
    finally:
        store.close()
    last = (tmp_path / "data" / "submitted.jsonl").read_text().splitlines()[-1]
    assert (json.loads(last)["kind"], json.loads(last)["id"]) == ("gone", job)
