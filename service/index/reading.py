"""Connections that can only read, each of which sees one moment of the index."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection
from sqlalchemy.exc import DBAPIError

from .records import StoreError
from .writer import make_engine, words_of


class Reading:
    """What questions are asked through."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = make_engine(path, writer=False)

    def close(self) -> None:
        """Close the connections."""
        self._reader.dispose()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that sees one moment of the database and cannot change it. Raises `StoreError`."""
        try:
            with self._reader.connect() as connection:
                yield connection
        except (DBAPIError, sa.exc.TimeoutError) as error:
            raise StoreError(f"{self.path}: {words_of(error)}") from error

    def _ask(self, query: str, values: Sequence[Any] = ()) -> list[Any]:
        """What is asked all the time: no layer between it and SQLite."""
        try:
            connection = self._reader.raw_connection()
            try:
                found: list[Any] = connection.cursor().execute(query, values).fetchall()
                return found
            finally:
                connection.close()
        except (DBAPIError, sqlite3.Error, sa.exc.TimeoutError) as error:
            raise StoreError(f"{self.path}: {error}") from error
