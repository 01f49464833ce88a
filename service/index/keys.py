"""Idempotency keys: what a request with the same key has made before."""

import time

import sqlalchemy as sa

from .records import Key, KeyReusedError
from .schema import idempotency
from .writer import Transaction


def known(t: Transaction, key: Key | None) -> str | None:
    """What a key made before; `KeyReusedError` where it came with another request."""
    if key is None:
        return None
    query = sa.select(idempotency).where(idempotency.c.key == f"{key.scope} {key.value}")
    if (row := t.run(query).first()) is None:
        return None
    if row.fingerprint != key.fingerprint:
        raise reused(key)
    return str(row.resource)


def remember(t: Transaction, key: Key | None, resource: str) -> None:
    """What the key has made now."""
    if key is not None:
        named = {"key": f"{key.scope} {key.value}", "fingerprint": key.fingerprint, "resource": resource}
        row = {**named, "created": time.time()}
        t.run(idempotency.insert(), [row])
        t.note("key", **row)


def reused(key: Key) -> KeyReusedError:
    """To be raised, or answered."""
    return KeyReusedError(f"Idempotency-Key {key.value!r}: came before, with another request")
