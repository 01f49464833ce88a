"""Versions of the index. An empty one is made by whoever opens it; an old one waits for `frit db upgrade`."""

import sqlite3
from contextlib import closing
from pathlib import Path

import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory

from frit.solver.durable import make_private, replace_durably


class IndexVersionError(RuntimeError):
    """The index is of another version than this frit's, or no index at all."""


def configuration(path: Path) -> Config:
    """alembic's, without a file of its own."""
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent))
    config.set_main_option("path_separator", "os")
    config.attributes["path"] = path
    return config


def versions(path: Path) -> tuple[str | None, str]:
    """The version of the index at `path` (None: empty or not there), and this frit's.

    Raises `IndexVersionError` for what is no index, and for the index of a newer frit.
    """
    scripts = ScriptDirectory.from_config(configuration(path))
    newest = scripts.get_current_head()
    assert newest is not None  # narrows the type: there is a first migration
    if not path.exists():
        return None, newest
    try:
        with sa.create_engine(f"sqlite:///{path}", poolclass=sa.NullPool).connect() as connection:
            connection.exec_driver_sql("BEGIN")  # both looks see the same index, even while another makes it
            present = MigrationContext.configure(connection).get_current_revision()
            if present is None and sa.inspect(connection).get_table_names():
                raise IndexVersionError(f"{path}: a database, but not an index of frit")
    except sa.exc.DatabaseError as error:
        if isinstance(error.orig, sqlite3.OperationalError):
            raise IndexVersionError(f"{path}: cannot be opened: {error.orig}") from error
        way = f"`frit reindex --data {path.parent}` makes a new one from the run directories"
        raise IndexVersionError(f"{path}: not a database: {error.orig}: {way}") from error
    if present is not None and present not in {script.revision for script in scripts.walk_revisions()}:
        raise IndexVersionError(
            f"{path}: version {present}, this frit needs {newest}: a newer frit made it: use that one"
        )
    return present, newest


def prepare(path: Path) -> None:
    """Make an empty index; refuse one of another version. Raises `IndexVersionError`."""
    present, newest = versions(path)
    if present is None:
        upgrade(path)
    elif present != newest:
        way = f"`frit db upgrade --data {path.parent}`"
        raise IndexVersionError(f"{path}: version {present}, this frit needs {newest}: {way}")


def upgrade(path: Path) -> Path | None:
    """Bring the index to this frit's version in one transaction; an older one is copied first: where to, if so.

    Raises `IndexVersionError`; then the index is what it was.
    """
    present, newest = versions(path)
    try:
        copy = keep(path, present) if present not in (None, newest) else None
        make_private(path.parent)
        command.upgrade(configuration(path), "head")
    except (sa.exc.DatabaseError, sqlite3.Error, OSError) as error:
        words = getattr(error, "orig", error)
        raise IndexVersionError(f"{path}: cannot be brought to version {newest}: {words}") from error
    return copy


def keep(path: Path, version: str | None) -> Path:
    """A durable copy beside the index, what its log holds included."""
    copy = path.with_name(f"{path.name}.{version}")
    beside = copy.with_name(f"{copy.name}.new")
    beside.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(beside)) as target:
        source.backup(target)
    replace_durably(beside, copy)
    return copy
