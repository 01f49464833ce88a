"""Who may do what: addresses, names, origins, tokens; and that no name leads out of a folder."""

import http.client
import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from asking import TINY, Process, listening, service
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from frit.service.cli import token as commands_token
from frit.service.http.delivery import open_beneath
from frit.service.http.security import AddressError, check_address, is_loopback
from frit.service.index import tokens
from frit.service.index.records import NotFoundError, StoreError
from frit.service.index.store import Store
from frit.service.settings import Settings

JOB = {"case": TINY}


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    with service(tmp_path) as found:
        yield found


def bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


# --- without tokens


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:8000", "[::1]", "[::1]:80", "LOCALHOST:1"])
def test_without_tokens_names_of_loopback_are_served(client: TestClient, host: str) -> None:
    assert client.get("/v1/jobs", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8000", "", "[::1", "10.0.0.1"]
)
def test_without_tokens_other_names_are_refused(client: TestClient, host: str) -> None:
    """A page whose name was made to point to this machine still sends its own name."""
    for path in ("/v1/jobs", "/metrics", "/docs", "/openapi.json"):
        assert client.get(path, headers={"Host": host}).status_code == 421, path
    assert client.get("/livez", headers={"Host": host}).status_code == 200, "tells nothing"


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"}, {"Origin": "null"}, {"Origin": "http://localhost:3000"},
        {"Origin": "http://127.0.0.1"}, {"Sec-Fetch-Site": "cross-site"}, {"Sec-Fetch-Site": "same-site"},
    ],
)  # fmt: skip
def test_a_page_of_another_origin_cannot_post(client: TestClient, headers: dict[str, str]) -> None:
    assert client.post("/v1/jobs", json=JOB, headers=headers).status_code == 403
    assert client.get("/v1/jobs").json()["jobs"] == []


def test_a_page_of_the_service_itself_can(client: TestClient) -> None:
    headers = {"Origin": "http://localhost", "Sec-Fetch-Site": "same-origin"}
    assert client.post("/v1/jobs", json=JOB, headers=headers).status_code == 201


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", "", "json"])
def test_a_body_that_forms_can_send_is_refused(client: TestClient, kind: str) -> None:
    answer = client.post("/v1/jobs", content=json.dumps(JOB), headers={"Content-Type": kind})
    assert answer.status_code == 415
    made = client.post("/v1/jobs", json=JOB).json()["id"]
    assert client.post(f"/v1/jobs/{made}/cancel", headers={"Content-Type": kind}).status_code == 415


# --- addresses


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_loopback_needs_no_token(tmp_path: Path, host: str) -> None:
    assert is_loopback(host)
    with closing(Store(tmp_path)) as store:
        check_address(Settings(data=tmp_path, host=host), store)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.1.2.3", "node7", "localhost.example"])
def test_any_other_address_needs_a_token(tmp_path: Path, host: str) -> None:
    settings = Settings(data=tmp_path, host=host)
    with closing(Store(tmp_path)) as store:
        with pytest.raises(AddressError, match="frit token create"):
            check_address(settings, store)
        tokens.create(tmp_path, "a", "read")
        check_address(settings, store)
        tokens.revoke(tmp_path, "a")
        with pytest.raises(AddressError):
            check_address(settings, store)


# --- tokens


def test_of_a_token_only_its_hash_is_kept(tmp_path: Path) -> None:
    secret = tokens.create(tmp_path, "me", "submit")
    assert secret.startswith("frit_")
    assert len(secret) >= 5 + 43, "256 bits in base 64"
    assert secret != tokens.create(tmp_path, "you", "submit")
    everything = b"".join(path.read_bytes() for path in tmp_path.iterdir())
    assert secret.encode() not in everything
    assert tokens.digest(secret).encode() in everything


def test_scopes_allow_what_the_ones_before_allow(client: TestClient, tmp_path: Path) -> None:
    job = client.post("/v1/jobs", json=JOB).json()["id"]
    secrets = {scope: tokens.create(tmp_path, scope, scope) for scope in tokens.SCOPES}
    reading = ("/v1/jobs", f"/v1/jobs/{job}", f"/v1/jobs/{job}/log", "/v1/sweeps", "/v1/limits", "/metrics")
    for scope, secret in secrets.items():
        for path in reading:
            assert client.get(path, headers=bearer(secret)).status_code == 200, (scope, path)
        allowed = 403 if scope == "read" else 201
        assert client.post("/v1/jobs", json=JOB, headers=bearer(secret)).status_code == allowed
        allowed = 403 if scope == "read" else 200
        assert client.post(f"/v1/jobs/{job}/cancel", headers=bearer(secret)).status_code == allowed
    for path in reading:
        answer = client.get(path)
        assert answer.status_code == 401, path
        assert answer.headers["www-authenticate"].startswith("Bearer")
        assert answer.headers["content-type"] == "application/problem+json"
    for wrong in ("frit_" + "A" * 43, "", "\u00e9", secrets["admin"][:-1]):
        headers = [(b"authorization", b"Bearer " + wrong.encode())]
        assert client.get("/v1/jobs", headers=headers).status_code == 401
    named = {**bearer(secrets["read"]), "Host": "frit.example"}
    assert client.get("/v1/jobs", headers=named).status_code == 200, "who has a token may use any name"


def test_keys_of_two_users_are_apart(client: TestClient, tmp_path: Path) -> None:
    made = set()
    for name in ("a", "b"):
        secret = tokens.create(tmp_path, name, "submit")
        headers = {**bearer(secret), "Idempotency-Key": "same"}
        made.add(client.post("/v1/jobs", json=JOB, headers=headers).json()["id"])
    assert len(made) == 2


def test_a_running_service_sees_a_new_and_a_revoked_token_at_once(tmp_path: Path) -> None:
    """Tokens are written by another process, which leaves the write-ahead log to the service's writer."""
    server = Process(tmp_path)
    server.start()
    run = CliRunner()

    def asked(secret: str | None) -> int:
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
        with closing(connection):
            connection.request("GET", "/v1/jobs", headers={} if secret is None else bearer(secret))
            return connection.getresponse().status

    try:
        assert asked(None) == 200
        made = run.invoke(commands_token.app, ["create", "--name", "me", "--scope", "read", "--data", str(tmp_path)])
        assert made.exit_code == 0, made.output
        assert (asked(made.stdout.strip()), asked(None)) == (200, 401)
        logged = (tmp_path / "frit.db-wal").stat().st_size
        assert logged > 0, "the log was left alone"
        other = tokens.create(tmp_path, "other", "read")
        gone = run.invoke(commands_token.app, ["revoke", "me", "--data", str(tmp_path)])
        assert gone.exit_code == 0, gone.output
        assert (asked(made.stdout.strip()), asked(other)) == (401, 200)
        assert (tmp_path / "frit.db-wal").stat().st_size >= logged
    finally:
        server.end()


def test_the_commands_of_tokens(tmp_path: Path) -> None:
    run, data = CliRunner(), ["--data", str(tmp_path / "new")]
    missing = run.invoke(commands_token.app, ["list", "--json", *data])
    assert (missing.exit_code, missing.stdout) == (2, "")
    assert str(tmp_path / "new") in missing.stderr
    (tmp_path / "new").mkdir()
    empty = run.invoke(commands_token.app, ["list", "--json", *data])
    assert (empty.exit_code, json.loads(empty.stdout)) == (0, [])
    made = run.invoke(commands_token.app, ["create", "--name", "me", "--scope", "admin", "--json", *data])
    assert json.loads(made.stdout)["token"].startswith("frit_")
    for name, scope in (("me", "read"), ("x", "root"), ("a b", "read")):
        refused = run.invoke(commands_token.app, ["create", "--name", name, "--scope", scope, *data])
        assert refused.exit_code == 2
        assert "must be" in refused.stderr or "is taken" in refused.stderr
    assert run.invoke(commands_token.app, ["revoke", "you", *data]).exit_code == 2
    assert run.invoke(commands_token.app, ["revoke", "me", *data]).exit_code == 0
    (row,) = json.loads(run.invoke(commands_token.app, ["list", "--json", *data]).stdout)
    assert (row["name"], row["scope"], row["revoked"] is not None) == ("me", "admin", True)
    assert "token" not in row
    assert "me" in run.invoke(commands_token.app, ["list", *data]).stdout


def test_a_token_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tokens, "BUSY", 0.1)
    tokens.create(tmp_path, "first", "read")
    with closing(sqlite3.connect(tmp_path / "frit.db", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError, match="locked"):
            tokens.create(tmp_path, "a", "read")
    with pytest.raises(NotFoundError):
        tokens.revoke(tmp_path, "a")


# --- no name leads out of a folder


@pytest.fixture(scope="module")
def exposed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """A URL, and the path of a job's store there, with links that lead out of it."""
    data = tmp_path_factory.mktemp("exposed")
    with listening(data) as url, closing(http.client.HTTPConnection(urlsplit(url).netloc)) as connection:
        connection.request("POST", "/v1/jobs", json.dumps(JOB), {"Content-Type": "application/json"})
        job = json.loads(connection.getresponse().read())["id"]
        store = data / "runs" / job / "snapshots.zarr"
        (store / "rho").mkdir(parents=True)
        (store / "zarr.json").write_text("{}")
        (data / "secret").write_text("secret")
        (store / "link").symlink_to(data / "secret")
        (store / "folder").symlink_to(data)
        (store / "rho" / "up").symlink_to("..")
        os.mkfifo(store / "pipe")
        yield url, f"/v1/jobs/{job}/snapshots.zarr"


@pytest.mark.parametrize(
    "key",
    [
        "../../../secret", "..%2f..%2f..%2fsecret", "%2e%2e/%2e%2e/%2e%2e/secret", "rho/../zarr.json", "./zarr.json",
        "link", "folder/secret", "rho/up/zarr.json", "/zarr.json", "//etc/passwd", "%2fetc%2fpasswd", "zarr.json/",
        "rho", "pipe", "zarr.json%00", "%ff%fe", "a" * 5000, "..\\secret", "%252e%252e/secret",
    ],
)  # fmt: skip
def test_no_key_leads_out_of_the_store(exposed: tuple[str, str], key: str) -> None:
    """Sent as it is: a client library would tidy it first."""
    url, path = exposed
    for method in ("GET", "HEAD"):
        with closing(http.client.HTTPConnection(urlsplit(url).netloc, timeout=30)) as connection:
            connection.putrequest(method, f"{path}/{key}")
            connection.endheaders()
            answer = connection.getresponse()
            body = answer.read()
        assert answer.status == 404, (method, body)
        assert b"secret" not in body
    with closing(http.client.HTTPConnection(urlsplit(url).netloc)) as connection:
        connection.request("GET", f"{path}/zarr.json")
        assert connection.getresponse().read() == b"{}"


def test_a_log_that_is_a_link_is_none(exposed: tuple[str, str], tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "log.txt").symlink_to("/etc/hostname")
    assert open_beneath(tmp_path / "run", ["log.txt"]) is None
    for parts in ([], [""], ["."], [".."], ["a/b"], ["\0"]):
        assert open_beneath(tmp_path, parts) is None
