"""Whose jobs, sweeps and files are, who may change and see them, and how much each token may have."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from asking import TINY, service
from booths import Booths
from fastapi.testclient import TestClient
from requesting import SWEEP, case, kind, upload
from serving import ended, in_state, new_job, settings, submit, until

from frit.service.index import tokens
from frit.service.jobs.engine import Engine
from frit.service.jobs.states import State

CSV = b"6.5,6.2,5.0\n15.4,6.8,4.0\n"


class Members:
    """A client for each token."""

    def __init__(self, client: TestClient, folder: Path) -> None:
        self.client = client
        scopes = {"ann": "submit", "bob": "submit", "eve": "read", "root": "admin"}
        self.secrets = {name: tokens.create(folder, name, scope) for name, scope in scopes.items()}

    def ask(self, who: str, method: str, path: str, **options: Any) -> Any:
        headers = {"Authorization": f"Bearer {self.secrets[who]}", **options.pop("headers", {})}
        return self.client.request(method, f"/v1{path}", headers=headers, **options)

    def job(self, who: str, shift: float = 0.0, **more: Any) -> Any:
        return self.ask(who, "POST", "/jobs", json={"case": case("sleep 0", shift), **more})


def members(folder: Path, **more: Any) -> Iterator[Members]:
    with service(folder, **more) as client:
        yield Members(client, folder)


@pytest.fixture
def open_(tmp_path: Path) -> Iterator[Members]:
    yield from members(tmp_path)


@pytest.fixture
def private(tmp_path: Path) -> Iterator[Members]:
    yield from members(tmp_path, private=True)


def test_all_see_all_and_each_changes_its_own(open_: Members) -> None:
    job = open_.job("ann").json()
    assert job["owner"] == "ann"
    sweep = open_.ask("ann", "POST", "/sweeps", json={"definition": SWEEP}).json()
    assert sweep["owner"] == "ann"
    for who in ("bob", "eve", "root"):
        assert open_.ask(who, "GET", f"/jobs/{job['id']}").json()["owner"] == "ann"
        assert len(open_.ask(who, "GET", "/jobs").json()["jobs"]) == 2  # the sweep shares one
    changes = [
        ("POST", f"/jobs/{job['id']}/cancel"), ("POST", f"/jobs/{job['id']}/retry"), ("DELETE", f"/jobs/{job['id']}"),
        ("PATCH", f"/jobs/{job['id']}"), ("POST", f"/sweeps/{sweep['id']}/cancel"),
        ("POST", f"/sweeps/{sweep['id']}/retry"), ("DELETE", f"/sweeps/{sweep['id']}"),
    ]  # fmt: skip
    for method, path in changes:
        options = {"json": {"name": "mine"}} if method == "PATCH" else {}
        answer = open_.ask("bob", method, path, **options)
        assert kind(answer) == (403, "not-yours"), path
        assert "belongs to 'ann'" in answer.json()["detail"]
        assert open_.ask("eve", method, path, **options).status_code == 403
    assert open_.ask("ann", "PATCH", f"/jobs/{job['id']}", json={"name": "mine"}).json()["name"] == "mine"
    assert open_.ask("root", "POST", f"/jobs/{job['id']}/cancel").json()["state"] == "cancelled"
    rerun = open_.ask("bob", "POST", f"/jobs/{job['id']}/rerun").json()
    assert (rerun["owner"], rerun["origin"]) == ("bob", job["id"])
    assert open_.ask("ann", "DELETE", f"/jobs/{job['id']}").status_code == 204
    assert [row["id"] for row in open_.ask("eve", "GET", "/jobs?owner=bob").json()["jobs"]] == [rerun["id"]]


def test_a_shared_job_is_not_cancelled_nor_deleted_by_the_sweep_of_another(open_: Members) -> None:
    mine = open_.ask("ann", "POST", "/sweeps", json={"definition": SWEEP}).json()["id"]
    yours = open_.ask("bob", "POST", "/sweeps", json={"definition": {**SWEEP, "name": "yours"}}).json()
    assert (yours["new"], yours["reused"]) == (0, 2)
    assert open_.ask("bob", "POST", f"/sweeps/{yours['id']}/cancel").json()["states"] == {"queued": 2}
    assert open_.ask("ann", "POST", f"/sweeps/{mine}/cancel").json()["states"] == {"cancelled": 2}
    [job, _] = [row["id"] for row in open_.ask("ann", "GET", f"/jobs?sweep={mine}").json()["jobs"]]
    assert kind(open_.ask("ann", "DELETE", f"/jobs/{job}")) == (409, "in-use")
    assert kind(open_.ask("root", "DELETE", f"/jobs/{job}")) == (409, "in-use")
    assert open_.ask("bob", "DELETE", f"/sweeps/{yours['id']}").status_code == 204
    assert open_.ask("ann", "DELETE", f"/jobs/{job}").status_code == 204
    assert open_.ask("ann", "GET", f"/sweeps/{mine}").json()["points"] == 1


def test_a_private_service_shows_each_its_own(private: Members) -> None:
    job = private.job("ann").json()["id"]
    sweep = private.ask("ann", "POST", "/sweeps", json={"definition": SWEEP}).json()["id"]
    headers = {"Content-Type": "application/octet-stream"}
    file = private.ask("ann", "POST", "/files?name=a.csv", content=CSV, headers=headers).json()["id"]
    for path in (f"/jobs/{job}", f"/jobs/{job}/history", f"/jobs/{job}/log", f"/jobs/{job}/snapshots.zarr/zarr.json",
                 f"/sweeps/{sweep}", f"/sweeps/{sweep}/compare", f"/jobs?sweep={sweep}"):  # fmt: skip
        assert private.ask("bob", "GET", path).status_code == 404, path
        assert private.ask("eve", "GET", path).status_code == 404, path
    for path, key in (("/jobs", "jobs"), ("/sweeps", "sweeps"), ("/files", "files")):
        assert private.ask("bob", "GET", path).json()[key] == []
        assert private.ask("ann", "GET", path).json()[key] != []
        assert len(private.ask("root", "GET", path).json()[key]) == len(private.ask("ann", "GET", path).json()[key])
    with_file = {**TINY, "particles": {"source": "file", "path": file}}
    assert private.ask("ann", "POST", "/jobs", json={"case": with_file}).status_code == 201
    assert kind(private.ask("bob", "POST", "/jobs", json={"case": with_file})) == (422, "refused-path")
    # jobs of others are not shared: that would tell what they compute
    theirs = private.ask("bob", "POST", "/sweeps", json={"definition": SWEEP}).json()
    assert (theirs["new"], theirs["reused"]) == (2, 0)
    assert private.ask("bob", "POST", "/plan", json={"definition": SWEEP}).json()["done"] == 0


def test_the_same_file_may_be_two_tokens(open_: Members, tmp_path: Path) -> None:
    headers = {"Content-Type": "application/octet-stream"}
    ids = {open_.ask(who, "POST", f"/files?name={who}.csv", content=CSV, headers=headers).json()["id"]
           for who in ("ann", "bob")}  # fmt: skip
    [file] = ids
    names = {row["owner"]: row["name"] for row in open_.ask("eve", "GET", "/files").json()["files"]}
    assert names == {"ann": "ann.csv", "bob": "bob.csv"}
    assert open_.ask("ann", "DELETE", f"/files/{file}").status_code == 204
    assert open_.ask("ann", "DELETE", f"/files/{file}").status_code == 404
    assert (tmp_path / "files" / file).exists()
    assert open_.ask("bob", "DELETE", f"/files/{file}").status_code == 204
    assert not (tmp_path / "files" / file).exists()


# --- quotas -----------------------------------------------------------------------------------------------


def test_a_token_has_as_many_queued_jobs_as_it_may(tmp_path: Path) -> None:
    with service(tmp_path, quota_queued=3, quota_cores=1) as client:
        who = Members(client, tmp_path)
        for k in range(3):
            assert who.job("ann", 0.1 * k).status_code == 201
        answer = who.job("ann", 0.5)
        assert kind(answer) == (429, "over-quota")
        assert answer.json()["detail"] == "queued jobs of token 'ann': 4, must be at most 3"
        assert kind(who.ask("ann", "POST", "/sweeps", json={"definition": SWEEP})) == (429, "over-quota")
        assert kind(who.job("bob", 0.5, ranks=2)) == (422, "over-limit")
        assert who.job("bob", 0.5).status_code == 201
        limits = who.ask("ann", "GET", "/limits").json()
        assert limits["token"] == "ann"
        assert limits["quotas"]["queued_jobs"] == {"used": 3, "limit": 3, "left": 0}
        assert limits["quotas"]["core_hours"] == {"used": 0, "limit": None, "left": None}


def test_core_hours_and_bytes_are_counted_also_of_what_is_deleted(tmp_path: Path) -> None:
    with service(tmp_path, quota_core_hours=0.01, quota_bytes=10**9) as client:
        who = Members(client, tmp_path)
        job = who.job("ann").json()["id"]
        store = client.app.state.engine.store  # type: ignore[attr-defined]

        def over(seconds: float, size: int) -> None:
            from frit.service.jobs.states import Exit, Move

            [claimed] = store.claim([(store.job(job).seq, (0,))]).result()
            end = Exit(claimed.attempt, Move.SUCCEED, None, 1.0, seconds)
            store.finish(job, end, 3, None, size).result()

        over(30.0, 2 * 10**9)
        client.app.state.rooms.quotas._of.clear()  # type: ignore[attr-defined]  # a second later
        answer = who.job("ann", 0.1)
        assert (kind(answer), answer.json()["detail"][:5]) == ((429, "over-quota"), "bytes")
        assert who.ask("ann", "DELETE", f"/jobs/{job}").status_code == 204
        client.app.state.rooms.quotas._of.clear()  # type: ignore[attr-defined]
        job = who.job("ann", 0.1).json()["id"]
        over(30.0, 10)
        client.app.state.rooms.quotas._of.clear()  # type: ignore[attr-defined]
        answer = who.job("ann", 0.2)
        assert kind(answer) == (429, "over-quota")
        assert answer.json()["detail"] == "core-hours of token 'ann': 0.0166667, must be at most 0.01"
        quotas = who.ask("ann", "GET", "/limits").json()["quotas"]
        assert quotas["core_hours"]["used"] == pytest.approx(60 / 3600)
        assert quotas["bytes"] == {"used": 10, "limit": 10**9, "left": 10**9 - 10}


def test_nobody_has_more_cores_at_once_than_a_token_may(tmp_path: Path) -> None:
    """However far behind in the queue others' jobs are."""

    async def main() -> None:
        booths = Booths(6)
        async with Engine(settings(tmp_path / "data", quota_cores=2), booths) as engine:
            mine = await submit(engine, *(new_job("sleep 0.6", 0.005 * k, owner="me") for k in range(300)))
            [yours] = await submit(engine, new_job("sleep 0", 1.9, owner="you"))
            assert (await ended(engine, yours))[0].state is State.SUCCEEDED
            most = 0

            def looked() -> bool:
                nonlocal most
                most = max(most, sum(booths.taken.values()))
                return engine.store.count(State.SUCCEEDED) > 6

            await in_state(engine, mine[0], State.SUCCEEDED)
            await until(engine, looked)
            assert most == 2

    asyncio.run(main())


def test_uploads_of_a_token_count(open_: Members) -> None:
    assert upload(open_.client, CSV, "a.csv", Authorization=f"Bearer {open_.secrets['ann']}").status_code == 201
    assert open_.ask("ann", "GET", "/limits").json()["quotas"]["bytes"]["used"] == len(CSV)
    assert open_.ask("bob", "GET", "/limits").json()["quotas"]["bytes"]["used"] == 0
