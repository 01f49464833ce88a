"""Access tokens: 256 random bits, shown once; the index keeps their SHA-256.

A token is made and revoked by a short transaction of its own, also while a service holds the data folder: the service
looks tokens up at each request, and only its own writer moves the write-ahead log into the database.
"""

import hashlib
import os
import re
import secrets
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from frit.solver.durable import make_private, write_whole

from . import migrations
from .records import NotFoundError, StoreError, Token
from .writer import BUSY

SCOPES = ("read", "submit", "admin")  # each allows all that the ones before allow
PREFIX = "frit_"
NAME = re.compile(r"[\w.@-]{1,100}")
MARK = "tokens-needed"  # a file of the data folder: there is, or was, a token; no index, lost or new, opens it again


def digest(secret: str) -> str:
    """What is kept of a token. 256 random bits need no salt."""
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()


def allows(scope: str, needed: str) -> bool:
    """Whether a token of this scope may do what needs that one."""
    return SCOPES.index(scope) >= SCOPES.index(needed)


def is_marked(folder: Path) -> bool:
    """Whether the data folder has, or had, a token: from then on nobody is served without one."""
    return os.path.lexists(folder / MARK)


def set_mark(folder: Path) -> None:
    """Make the mark durable, before the first token is."""
    if not is_marked(folder):
        make_private(folder)
        write_whole(folder / MARK, b"This folder has or had access tokens: frit serves it only to who brings one.\n")


def create(folder: Path, name: str, scope: str) -> str:
    """The secret of a new token. Raises `ValueError` for a wrong or taken name, `StoreError`."""
    if scope not in SCOPES:
        raise ValueError(f"scope = {scope!r}: must be one of {', '.join(SCOPES)}")
    if not NAME.fullmatch(name):
        raise ValueError(f"name = {name!r}: must be 1 to 100 letters, digits or any of . _ @ -")
    secret = PREFIX + secrets.token_urlsafe(32)
    try:
        set_mark(folder)
    except OSError as error:
        raise StoreError(f"{folder}: {error}") from error
    with _transaction(folder) as connection:
        if connection.execute("SELECT 1 FROM tokens WHERE name = ?", (name,)).fetchone():
            raise ValueError(f"name = {name!r}: is taken, also by a revoked token")
        values = (name, digest(secret), scope, time.time())
        connection.execute("INSERT INTO tokens (name, hash, scope, created) VALUES (?, ?, ?, ?)", values)
    return secret


def revoke(folder: Path, name: str) -> None:
    """Let a token count no more, at once. Raises `NotFoundError`, `StoreError`."""
    with _transaction(folder) as connection:
        statement = "UPDATE tokens SET revoked = ? WHERE name = ? AND revoked IS NULL"
        if connection.execute(statement, (time.time(), name)).rowcount == 0:
            raise NotFoundError(f"token {name!r}: there is none, or it is revoked")


def listed(folder: Path) -> list[Token]:
    """All tokens, the revoked ones too. Raises `StoreError`."""
    if not (folder / "frit.db").exists():
        return []
    with _transaction(folder) as connection:
        rows = connection.execute("SELECT name, scope, created, revoked FROM tokens ORDER BY seq")
        return [Token(*row) for row in rows]


@contextmanager
def _transaction(folder: Path) -> Iterator[sqlite3.Connection]:
    """Begin immediately, commit to the disk, never checkpoint. An index that is not there is made."""
    path = folder.absolute() / "frit.db"
    try:
        migrations.prepare(path)
        with closing(sqlite3.connect(path, timeout=BUSY, isolation_level=None)) as connection:
            for pragma in ("journal_mode = WAL", "wal_autocheckpoint = 0", "synchronous = FULL"):
                connection.execute(f"PRAGMA {pragma}")
            connection.execute("BEGIN IMMEDIATE")
            with connection:
                yield connection
    except (sqlite3.Error, OSError, migrations.IndexVersionError) as error:
        raise StoreError(f"{path}: {error}") from error
