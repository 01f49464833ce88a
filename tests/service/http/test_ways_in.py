"""A service is open to a request or not by its address at start and the token of the request, by nothing else."""

import http.client
import json
import signal
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest
from asking import LONG, TINY, free_port, listening, service, settings_in, until
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from frit.service.cli import token as commands_token
from frit.service.http.app import create_app
from frit.service.http.security import check
from frit.service.index import tokens
from frit.service.index.reindex import rebuild
from frit.service.settings import Settings

JOB = {"case": TINY}


def bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


def status(port: int, method: str, path: str, body: object = None, **headers: str) -> int:
    """Of the answer to a request on a connection of its own."""
    text = None if body is None else json.dumps(body)
    given = {"Content-Type": "application/json", "Host": "127.0.0.1", **headers}
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
        connection.request(method, path, text, given)
        return connection.getresponse().status


# --- the first token shuts the door for good


def test_revoking_the_last_token_opens_nothing_on_an_open_address(tmp_path: Path) -> None:
    """As it was found: 0.0.0.0, one token, revoked, and a Host that looks local."""
    port, secret = free_port(), tokens.create(tmp_path, "me", "submit")
    frit = Path(sys.executable).parent / "frit"
    command = [str(frit), "serve", "--data", str(tmp_path), "--host", "0.0.0.0", "--port", str(port)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as server:
        try:
            until(lambda: server.poll() is not None or listens(port))
            assert status(port, "GET", "/v1/jobs", **bearer(secret)) == 200
            tokens.revoke(tmp_path, "me")
            assert status(port, "GET", "/v1/jobs") == 401
            assert status(port, "GET", "/v1/jobs", **bearer(secret)) == 401
            assert status(port, "POST", "/v1/jobs", JOB) == 401
            other = tokens.create(tmp_path, "you", "submit")
            assert status(port, "GET", "/v1/jobs", **bearer(other)) == 200
        finally:
            server.send_signal(signal.SIGTERM)
            server.wait(60)


def listens(port: int) -> bool:
    with suppress(OSError):
        return status(port, "GET", "/livez") == 200
    return False


@pytest.mark.parametrize("lost", [False, True])
def test_neither_revoking_nor_a_lost_index_opens_a_loopback_service(tmp_path: Path, lost: bool) -> None:
    with service(tmp_path) as client:
        assert client.get("/v1/jobs").status_code == 200
        tokens.create(tmp_path, "me", "read")
        assert client.get("/v1/jobs").status_code == 401
        tokens.revoke(tmp_path, "me")
        assert client.get("/v1/jobs").status_code == 401
        (tmp_path / tokens.MARK).unlink()  # the service that runs does not forget
        assert client.get("/v1/jobs").status_code == 401
    tokens.set_mark(tmp_path)
    if lost:
        for path in tmp_path.glob("frit.db*"):
            path.unlink()
        rebuild(tmp_path, 5)
    with service(tmp_path) as client:
        assert client.get("/v1/jobs").status_code == 401
        assert "frit token create" in client.get("/v1/jobs").json()["detail"]
    assert "frit token create" in (check(Settings(data=tmp_path)) or "")


def test_tokens_of_a_folder_without_the_mark_make_it(tmp_path: Path) -> None:
    """An older frit made them."""
    tokens.create(tmp_path, "me", "read")
    tokens.revoke(tmp_path, "me")
    (tmp_path / tokens.MARK).unlink()
    with service(tmp_path) as client:
        assert client.get("/v1/jobs").status_code == 401
    assert tokens.is_marked(tmp_path)


def test_the_mark_is_there_before_the_first_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed in between, the folder is shut and has no token: the other way round it would be open and have one."""

    def killed(folder: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tokens, "_transaction", killed)
    with pytest.raises(KeyboardInterrupt):
        tokens.create(tmp_path, "me", "read")
    assert tokens.is_marked(tmp_path)


def test_who_has_revoked_the_last_token_is_told_what_to_do(tmp_path: Path) -> None:
    run, data = CliRunner(), ["--data", str(tmp_path)]
    assert run.invoke(commands_token.app, ["list", *data]).stderr == ""
    tokens.create(tmp_path, "me", "read")
    tokens.create(tmp_path, "you", "read")
    assert run.invoke(commands_token.app, ["revoke", "me", *data]).stderr == ""
    for words in (["revoke", "you"], ["list"], ["list", "--json"]):
        assert "frit token create" in run.invoke(commands_token.app, [*words, *data]).stderr


# --- peers


@pytest.mark.parametrize("peer", ["10.1.2.3", "192.168.1.2", "::ffff:10.1.2.3", "2001:db8::1", "testclient"])
def test_without_a_token_only_this_machine_is_served(tmp_path: Path, peer: str) -> None:
    app = create_app(settings_in(tmp_path))
    with TestClient(app, base_url="http://127.0.0.1", client=(peer, 4)) as client:
        assert client.get("/v1/jobs").status_code == 403
        assert client.post("/v1/jobs", json=JOB).status_code == 403
        secret = tokens.create(tmp_path, "me", "submit")
        assert client.get("/v1/jobs", headers=bearer(secret)).status_code == 200


@pytest.mark.parametrize("peer", ["127.0.0.1", "127.8.8.8", "::1", "::ffff:127.0.0.1"])
def test_peers_on_this_machine_are(tmp_path: Path, peer: str) -> None:
    app = create_app(settings_in(tmp_path))
    with TestClient(app, base_url="http://127.0.0.1", client=(peer, 4)) as client:
        assert client.get("/v1/jobs").status_code == 200


# --- who asks comes before what is asked


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/sweeps", "/v1/nothing", "/v1/jobs/abcd/cancel"])
@pytest.mark.parametrize("body", [b"{", b"\xff", b"[" * 100_000, b"{},", b""])
def test_who_has_no_token_is_told_nothing_of_the_body(tmp_path: Path, path: str, body: bytes) -> None:
    with service(tmp_path) as client:
        reader = tokens.create(tmp_path, "me", "read")
        for kind in ("application/json", "text/plain"):
            headers = {"Content-Type": kind}
            assert client.post(path, content=body, headers=headers).status_code == 401
            assert client.post(path, content=body, headers=headers | bearer("frit_no")).status_code == 401
            assert client.post(path, content=body, headers=headers | bearer(reader)).status_code == 403


def test_a_body_of_a_stranger_is_not_waited_for(tmp_path: Path) -> None:
    """Answered by its headers alone: of the 19 MB that are announced not a byte has come."""
    with listening(tmp_path) as url:
        tokens.create(tmp_path, "me", "submit")
        with closing(http.client.HTTPConnection(url.removeprefix("http://"), timeout=60)) as connection:
            connection.putrequest("POST", "/v1/jobs")
            connection.putheader("Content-Type", "application/json")
            connection.putheader("Content-Length", "19000000")
            connection.endheaders()
            assert connection.getresponse().status == 401


def test_a_stream_ends_with_its_token(tmp_path: Path) -> None:
    with listening(tmp_path) as url:
        secret = tokens.create(tmp_path, "me", "submit")
        host = url.removeprefix("http://")
        with closing(http.client.HTTPConnection(host, timeout=60)) as connection:
            headers = {"Content-Type": "application/json", **bearer(secret)}
            connection.request("POST", "/v1/jobs", json.dumps({"case": LONG}), headers)
            job = json.loads(connection.getresponse().read())["id"]
            connection.request("GET", f"/v1/jobs/{job}/events", headers=bearer(secret))
            answer = connection.getresponse()
            assert answer.status == 200
            assert b"queued" in answer.read1(1000)
            tokens.revoke(tmp_path, "me")
            began = time.monotonic()
            while answer.read1(1000):
                assert time.monotonic() - began < 60.0


# --- names that are none


@pytest.mark.parametrize("origin", ["http://[::1", "http://[", "//", "http://a]b", "null", ""])
def test_an_origin_that_is_none_is_refused(tmp_path: Path, origin: str) -> None:
    with service(tmp_path) as client:
        assert client.post("/v1/jobs", json=JOB, headers={"Origin": origin}).status_code == 403
