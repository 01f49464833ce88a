"""Who may do what: addresses to listen on, the Host and Origin of a request, tokens and their scopes.

Without tokens the service listens on loopback only and answers everybody there, except web pages: a request must name
a loopback host (else a page could reach it by DNS rebinding), and a page of another origin cannot POST.
"""

import ipaddress
from collections.abc import Awaitable, Callable
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Depends, Request
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .problems import HttpError, as_problem
from .settings import Settings
from .store import Store, StoreError, Token
from .tokens import allows, digest

LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
TOKENS = "frit.tokens"  # of a request's scope: those that count while it is answered
OPEN = ("/livez", "/readyz")  # they tell nothing: health checks need neither token nor name


class AddressError(ValueError):
    """An address that may not be listened on."""


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_address(settings: Settings, store: Store) -> None:
    """Refuse to listen where others can reach the service while it has no tokens. Raises `AddressError`."""
    if not is_loopback(settings.host) and not store.active_tokens():
        way = f"`frit token create --name NAME --scope submit --data {settings.data}` makes one"
        raise AddressError(
            f"host = {settings.host!r}: without an access token only a loopback address is allowed: {way}"
        )


class Gate:
    """ASGI middleware: turns away what no route should see."""

    def __init__(self, app: ASGIApp, settings: Settings, store: Callable[[], Store]) -> None:
        """store: the index, open once the app has started."""
        self.app, self.settings, self.store = app, settings, store

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, or answer with a problem."""
        if scope["type"] == "http":
            try:
                self._check(scope)
            except (HttpError, HTTPException, StoreError) as error:
                await as_problem(error).response()(scope, receive, send)
                return
            receive = self._counted(receive)
        await self.app(scope, receive, send)

    def _counted(self, receive: Receive) -> Receive:
        """A body without a Content-Length, or with a wrong one, ends where it becomes too large."""
        came = 0

        async def counted() -> Message:
            nonlocal came
            message = await receive()
            came += len(message.get("body", b""))
            if came > self.settings.body_limit:
                raise HTTPException(413, f"more than {self.settings.body_limit} bytes came")  # passes through the route
            return message

        return counted

    def _check(self, scope: Scope) -> None:
        headers = Headers(scope=scope)
        posted = scope["method"] not in ("GET", "HEAD", "OPTIONS")
        if posted:
            self._check_body(headers)
        if scope["path"] in OPEN:
            return
        scope[TOKENS] = active = self.store().active_tokens()
        if not active:
            check_host(headers, self.settings)
            if posted:
                check_origin(headers)

    def _check_body(self, headers: Headers) -> None:
        length, kind = headers.get("content-length", "0"), headers.get("content-type")
        chunked = "transfer-encoding" in headers
        if length.isdigit() and int(length) > self.settings.body_limit:
            raise HTTPException(413, f"{length} bytes, must be at most {self.settings.body_limit}")
        if kind is None and length == "0" and not chunked:
            return
        if (kind or "").partition(";")[0].strip().lower() != "application/json":
            detail = f"Content-Type = {kind!r}: must be application/json"
            raise HttpError(415, "unsupported-media-type", "The body must be JSON", detail)


def host_name(netloc: str) -> str | None:
    """Without port and brackets; None where it is no host."""
    try:
        return urlsplit(f"//{netloc}").hostname
    except ValueError:
        return None


def check_host(headers: Headers, settings: Settings) -> None:
    """Refuse a name that is not of loopback."""
    name = host_name(headers.get("host", ""))
    if name not in LOCAL_NAMES and name != settings.host:
        detail = f"Host = {headers.get('host')!r}: without tokens only localhost, 127.0.0.1 and [::1] are served"
        raise HttpError(421, "misdirected", "The service does not answer to this name", detail)


def check_origin(headers: Headers) -> None:
    """Refuse what a page of another origin sends."""
    origin, host = headers.get("origin"), headers.get("host", "")
    other = origin is not None and urlsplit(origin).netloc != host
    if other or headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
        detail = f"Origin = {origin!r}: pages of another origin than {host!r} may not send requests"
        raise HttpError(403, "cross-site", "A request from another site", detail)


def needs(scope: str) -> Callable[..., Awaitable[str]]:
    """A dependency that gives the name of the token, "-" where there are no tokens and so no names."""

    async def check(request: Request) -> str:
        active: dict[str, Token] = request.scope[TOKENS]
        if not active:
            return "-"
        kind, _, secret = request.headers.get("authorization", "").partition(" ")
        bearer = kind.lower() == "bearer"
        given = active.get(digest(secret.strip())) if bearer else None
        if given is None:
            detail = "the token is unknown or revoked" if bearer else "a bearer token is needed"
            challenge = {"WWW-Authenticate": 'Bearer realm="frit"'}
            raise HttpError(401, "unauthorized", "Who are you?", detail, headers=challenge)
        if not allows(given.scope, scope):
            detail = f"token {given.name!r} has scope {given.scope}, this needs {scope}"
            raise HttpError(403, "forbidden", "The token does not allow this", detail)
        return given.name

    return check


Reader = Annotated[str, Depends(needs("read"))]
Submitter = Annotated[str, Depends(needs("submit"))]
