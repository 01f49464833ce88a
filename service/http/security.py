"""Who may do what: addresses to listen on, peers, the Host and Origin of a request, tokens and their scopes.

A service that was started on a loopback address, on a folder that never had a token, answers without one, and only to
peers on this machine; not to web pages: a request must name a loopback host (else a page could reach it by DNS
rebinding), and a page of another origin cannot POST. The first token ends that for good. Nothing else opens a service.
"""

import ipaddress
import os
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Depends, Request
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..index.migrations import IndexVersionError
from ..index.records import StoreError, Token
from ..index.store import Store
from ..index.tokens import allows, digest, is_marked, set_mark
from ..jobs.engine import EngineError, take
from ..settings import Settings
from .problems import HttpError, as_problem

LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
WHO = "frit.token"  # of a request's scope: the token it was let in by; None: it needed none
AGAIN = "frit.again"  # of a request's scope: asks anew whether it is let in
READING = ("GET", "HEAD", "OPTIONS")
FILES = "/v1/files"  # takes files as they are
OPEN = ("/livez", "/readyz")  # they tell nothing: health checks need neither token nor name
DOCUMENTS = ("/", "/docs", "/openapi.json")  # the same for every service of this version: no token


class AddressError(ValueError):
    """An address that may not be listened on."""


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the address, or it is one of this machine's own to itself."""
    if host == "localhost":
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def way_in(settings: Settings) -> str:
    """How to make a token."""
    return f"`frit token create --name NAME --scope submit --data {settings.data}` makes one"


def check_address(settings: Settings, store: Store) -> str | None:
    """Refuse to listen where others can reach the service while no token is active; what else is worth saying.

    Raises `AddressError`, `StoreError`.
    """
    if store.active_tokens():
        return None
    if not is_loopback(settings.host):
        allowed = f"without an access token only a loopback address is allowed: {way_in(settings)}"
        raise AddressError(f"host = {settings.host!r}: {allowed}")
    if is_marked(settings.data) or store.had_tokens():
        return f"every request needs a token, and none is active: {way_in(settings)}"
    return None


def check(settings: Settings) -> str | None:
    """Say early why a service cannot be started, or answers nobody. Raises `EngineError`, `AddressError`."""
    lock = take(settings.data)
    try:
        store = Store(settings.data)
        try:
            return check_address(settings, store)
        finally:
            store.close()
    except (IndexVersionError, StoreError) as error:
        raise EngineError(str(error)) from error
    finally:
        os.close(lock)


class Door:
    """Whether requests are answered without a token. Once shut it stays shut."""

    def __init__(self, settings: Settings) -> None:
        self._folder = settings.data
        self._open = is_loopback(settings.host)
        self._asked = False  # whether the index has had tokens

    def is_open(self, store: Store, active: Mapping[str, Token]) -> bool:
        """`active`: the tokens that count now. Raises `OSError`, `StoreError`."""
        if not self._open or is_marked(self._folder):
            self._open = False
        elif active or (not self._asked and store.had_tokens()):
            set_mark(self._folder)  # tokens were made by a frit that knew no mark
            self._open = False
        self._asked = True
        return self._open


class Gate:
    """ASGI middleware: asks who it is before anything of the body is read, and turns away what no route should see."""

    def __init__(self, app: ASGIApp, settings: Settings, store: Callable[[], Store]) -> None:
        """store: the index, open once the app has started."""
        self.app, self.settings, self.store, self.door = app, settings, store, Door(settings)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, or answer with a problem."""
        if scope["type"] == "http":
            try:
                self._check(scope)
            except (HttpError, HTTPException, StoreError, OSError) as error:
                trouble = StoreError(str(error)) if isinstance(error, OSError) else error
                answer = as_problem(trouble).response()
                if "transfer-encoding" in Headers(scope=scope):  # nobody knows when that would end
                    answer.headers["Connection"] = "close"
                await answer(scope, receive, send)
                return
            receive = self._counted(receive, body_limit(scope["path"], self.settings))
        await self.app(scope, receive, send)

    def _counted(self, receive: Receive, most: int) -> Receive:
        """A body without a Content-Length, or with a wrong one, ends where it becomes too large."""
        came = 0

        async def counted() -> Message:
            nonlocal came
            message = await receive()
            came += len(message.get("body", b""))
            if came > most:
                raise HTTPException(413, f"more than {most} bytes came")  # passes through the route
            return message

        return counted

    def _check(self, scope: Scope) -> None:
        headers, reads = Headers(scope=scope), scope["method"] in READING
        if scope["path"] not in OPEN:
            scope[WHO] = self.admitted(scope, headers)
            scope[AGAIN] = lambda: self.admitted(scope, headers)
        if not reads:
            check_body(headers, scope["path"], body_limit(scope["path"], self.settings))

    def admitted(self, scope: Scope, headers: Headers) -> Token | None:
        """The token that a request came in by, None where it needs none. Raises `HttpError` for all others."""
        store, reads = self.store(), scope["method"] in READING
        active = store.active_tokens()
        if self.door.is_open(store, active):
            check_peer(scope)
            check_host(headers, self.settings)
            if not reads:
                check_origin(headers)
            return None
        if reads and scope["path"] in DOCUMENTS:
            return None
        token = bearer(headers, active)
        check_scope(token, "read" if reads else "submit")
        return token


def body_limit(path: str, settings: Settings) -> int:
    """Bytes of a body, at most."""
    return settings.file_limit if path == FILES else settings.body_limit


def check_body(headers: Headers, path: str, most: int) -> None:
    """Refuse a body that is too large, or of another kind."""
    length, kind = headers.get("content-length", "0"), headers.get("content-type")
    if length.isdigit() and int(length) > most:
        raise HTTPException(413, f"{length} bytes, must be at most {most}")
    if kind is None and length == "0" and "transfer-encoding" not in headers:
        return
    wanted = "application/octet-stream" if path == FILES else "application/json"
    if (kind or "").partition(";")[0].strip().lower() != wanted:
        detail = f"Content-Type = {kind!r}: must be {wanted}"
        raise HttpError(415, "unsupported-media-type", "The body is of the wrong kind", detail)


def bearer(headers: Headers, active: Mapping[str, Token]) -> Token:
    """The token that a request brings. Raises `HttpError`."""
    kind, _, secret = headers.get("authorization", "").partition(" ")
    given = active.get(digest(secret.strip())) if kind.lower() == "bearer" else None
    if given is None:
        detail = "the token is unknown or revoked" if kind.lower() == "bearer" else "a bearer token is needed"
        detail += "; `frit token create` makes one"
        challenge = {"WWW-Authenticate": 'Bearer realm="frit"'}
        raise HttpError(401, "unauthorized", "Who are you?", detail, headers=challenge)
    return given


def check_scope(token: Token, needed: str) -> None:
    """Refuse what the token does not allow."""
    if not allows(token.scope, needed):
        detail = f"token {token.name!r} has scope {token.scope}, this needs {needed}"
        raise HttpError(403, "forbidden", "The token does not allow this", detail)


def check_peer(scope: Scope) -> None:
    """Refuse who is not on this machine, whatever it says of itself."""
    peer = scope.get("client")
    if peer is None or not is_loopback(peer[0]):
        detail = "without tokens only this machine is served; `frit token create` makes one"
        raise HttpError(403, "not-local", "The request comes from another machine", detail)


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
    if (origin is not None and not same_host(origin, host)) or headers.get("sec-fetch-site", "none") not in (
        "none", "same-origin"
    ):  # fmt: skip
        detail = f"Origin = {origin!r}: pages of another origin than {host!r} may not send requests"
        raise HttpError(403, "cross-site", "A request from another site", detail)


def same_host(origin: str, host: str) -> bool:
    """Whether a page of this origin came from this host and port."""
    try:
        return urlsplit(origin).netloc == host
    except ValueError:  # no origin at all
        return False


def still_admitted(request: Request) -> bool:
    """Whether a request that is answered for long would still be let in: its token may be revoked meanwhile."""
    try:
        request.scope[AGAIN]()
    except (HttpError, StoreError, OSError):
        return False
    return True


@dataclass(frozen=True)
class Who:
    """Who asks: the label of the token, None where none was needed and so there are no labels."""

    label: str | None
    admin: bool
    private: bool  # whether this service shows everybody only what is their own

    @property
    def name(self) -> str:
        """Keeps the idempotency keys of one apart from another's."""
        return self.label or "-"

    @property
    def only(self) -> str | None:
        """The owner whose things are all that is seen; None: everybody's."""
        return self.label if self.private and not self.admin else None

    def may(self, owner: str | None) -> bool:
        """Whether this one may change what that one has made; what was made without a token is everybody's."""
        return self.admin or owner is None or owner == self.label

    def sees(self, owner: str | None) -> bool:
        """Whether this one may look at it."""
        return self.only is None or owner == self.label

    def check(self, owner: str | None, what: str) -> None:
        """Refuse to change what is another's."""
        if not self.may(owner):
            detail = f"{what}: belongs to {owner!r}; only that token and those of scope admin may change it"
            raise HttpError(403, "not-yours", "It belongs to somebody else", detail)


def needs(scope: str) -> Callable[..., Awaitable[Who]]:
    """A dependency that gives who asks."""

    async def check(request: Request) -> Who:
        token, private = request.scope[WHO], request.app.state.settings.private
        if token is None:
            return Who(None, True, private)
        check_scope(token, scope)
        return Who(token.name, token.scope == "admin", private)

    return check


Reader = Annotated[Who, Depends(needs("read"))]
Submitter = Annotated[Who, Depends(needs("submit"))]
