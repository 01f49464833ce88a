"""Connections: what a stranger may cost before it is known who asks.

uvicorn's parser takes heads of any length and waits for them for ever; here they have a limit and a time, and there
are so many connections at once and no more.
"""

import asyncio
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from ..settings import Settings
from .security import body_limit

HEAD = 65_536  # bytes of a request's line and headers; one more piece of the network's may come with them
HEAD_TIME = 30.0  # seconds in which they must come
LINGER = 3  # seconds for open answers when the service ends; a stream of events has no end of its own
TOO_LARGE = "The head of the request is too large."


class LimitedProtocol(HttpToolsProtocol):
    """HTTP/1.1 whose heads are of limited size and come in limited time."""

    settings: Settings
    _most = 0  # bytes of the request that is read now
    _head: int | None = 0  # bytes of a head that is not complete; None: none is awaited
    _came = 0  # bytes of the request, with what frames its body
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first head."""
        super().connection_made(transport)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        self._end_wait()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        """The head of a request begins."""
        super().on_message_begin()
        self._await_head()
        self._came = 0

    def on_header(self, name: bytes, value: bytes) -> None:
        """A header; what comes behind a body is nobody's."""
        if self._head is not None:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """The head is there."""
        self._end_wait()
        super().on_headers_complete()
        self._most = 2 * body_limit(self.scope["path"], self.settings) + HEAD  # with what frames the body

    def data_received(self, data: bytes) -> None:
        """Parse what came, and count it while there is no whole head."""
        super().data_received(data)
        self._came += len(data)
        if self._head is not None and not self.transport.is_closing():
            self._head += len(data)
            if self._head > HEAD:
                self._end_wait()
                self.send_400_response(TOO_LARGE)
        elif self._came > self._most:  # the route has refused it long ago
            self.transport.abort()

    def _await_head(self) -> None:
        self._end_wait()
        self._head = 0
        self._timer = self.loop.call_later(HEAD_TIME, self.transport.close)

    def _end_wait(self) -> None:
        self._head = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def options(settings: Settings) -> dict[str, Any]:
    """What uvicorn is told, however it is started."""
    protocol = type("Protocol", (LimitedProtocol,), {"settings": settings})
    return {
        "http": protocol, "ws": "none", "limit_concurrency": settings.connections_limit,
        "server_header": False, "timeout_graceful_shutdown": LINGER,
    }  # fmt: skip
