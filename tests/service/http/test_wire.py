"""What a stranger may cost: heads of limited size and time, bodies that end, connections that are counted."""

import http.client
import json
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import psutil
import pytest
from asking import TINY, listening

from frit.service.http import wire
from frit.service.index import tokens

MEGABYTE = 1_000_000


@pytest.fixture
def url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A service that nobody enters without a token, and that waits a second for a head."""
    monkeypatch.setattr(wire, "HEAD_TIME", 1.0)
    tokens.create(tmp_path, "me", "submit")
    with listening(tmp_path, connections_limit=20, body_limit=MEGABYTE) as found:
        yield found


def place(url: str) -> tuple[str, int]:
    found = urlsplit(url)
    assert found.hostname is not None
    assert found.port is not None
    return found.hostname, found.port


def said(url: str, *pieces: bytes) -> bytes:
    """All that the service answers to these bytes, until it hangs up or is silent for long."""
    with closing(socket.create_connection(place(url), timeout=30)) as connection:
        with suppress(ConnectionResetError, BrokenPipeError):
            for piece in pieces:
                connection.sendall(piece)
        answer = b""
        with suppress(ConnectionResetError):
            while piece := connection.recv(65_536):
                answer += piece
        return answer


def alive(url: str) -> bool:
    with closing(http.client.HTTPConnection(*place(url), timeout=30)) as connection:
        connection.request("GET", "/livez")
        return connection.getresponse().status == 200


@pytest.mark.parametrize("piece", [b"a: b\r\n" * 10_000, b"a" * 60_000])
@pytest.mark.parametrize("start", [b"GET /v1/jobs HTTP/1.1\r\nHost: x\r\nA: ", b"GET /", b"GET /v1/jobs HTTP/1.1\r\n"])
def test_a_head_without_end_is_cut(url: str, start: bytes, piece: bytes) -> None:
    before = psutil.Process().memory_info().rss
    answer = said(url, start, *[piece] * 1000)
    assert answer == b"" or answer.startswith(b"HTTP/1.1 400 ")
    assert psutil.Process().memory_info().rss - before < 30 * MEGABYTE
    assert alive(url)


@pytest.mark.parametrize("start", [b"", b"G", b"GET /livez HTTP/1.1\r\nHost: x\r\n"])
def test_a_head_that_does_not_come_is_not_waited_for(url: str, start: bytes) -> None:
    assert said(url, *([start] if start else [])) == b"", "hung up"


def test_a_head_in_pieces_is_a_head(url: str) -> None:
    """Each slow, all within the time."""
    pieces = [b"GET /livez HTTP/1.1\r\n", b"Host: ", b"x\r\n", b"Connection: close\r\n", b"\r\n"]
    with closing(socket.create_connection(place(url), timeout=30)) as connection:
        for piece in pieces:
            connection.sendall(piece)
            time.sleep(0.05)
        assert connection.recv(1000).startswith(b"HTTP/1.1 200 ")


def test_what_comes_behind_a_body_is_not_kept(url: str, tmp_path: Path) -> None:
    secret = tokens.create(tmp_path, "you", "submit")
    body = json.dumps({"case": TINY}).encode()
    head = f"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {secret}\r\nContent-Type: application/json\r\n"
    framed = f"Transfer-Encoding: chunked\r\n\r\n{len(body):x}\r\n".encode() + body + b"\r\n0\r\n"
    before = psutil.Process().memory_info().rss
    said(url, head.encode() + framed, *[b"a: b\r\n" * 10_000] * 500)
    assert psutil.Process().memory_info().rss - before < 30 * MEGABYTE
    assert said(url, head.encode() + b"Connection: close\r\n" + framed + b"\r\n").startswith(b"HTTP/1.1 201 ")


def test_a_stranger_without_a_length_is_hung_up_on(url: str) -> None:
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n"
    answer = said(url, head, b"5\r\n[1,2,")
    assert answer.startswith(b"HTTP/1.1 401 ")


def test_a_client_that_hangs_up_in_its_body_is_no_error(
    url: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    secret = tokens.create(tmp_path, "you", "submit")
    head = f"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {secret}\r\nContent-Type: application/json\r\n"
    with closing(socket.create_connection(place(url), timeout=30)) as connection:
        connection.sendall(f"{head}Content-Length: 1000\r\n\r\n{{".encode())
        time.sleep(0.3)
    time.sleep(0.5)
    assert alive(url)
    assert "Traceback" not in capfd.readouterr().err


def test_more_connections_than_are_allowed_are_turned_away_and_come_again(url: str) -> None:
    with ExitStack() as stack:
        for _ in range(25):
            stack.enter_context(closing(socket.create_connection(place(url), timeout=30)))
        with closing(http.client.HTTPConnection(*place(url), timeout=30)) as connection:
            connection.request("GET", "/livez")
            assert connection.getresponse().status == 503
    for _ in range(200):  # those that left are noticed soon
        if alive(url):
            return
        time.sleep(0.05)
    pytest.fail("no connection was given back")


def test_web_sockets_are_nothing_here(url: str) -> None:
    head = b"GET /v1/jobs HTTP/1.1\r\nHost: x\r\nConnection: Upgrade, close\r\nUpgrade: websocket\r\n"
    key = b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: x\r\n\r\n"
    assert said(url, head + key).startswith(b"HTTP/1.1 401 ")
