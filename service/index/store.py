"""The index of one data folder: what can be done to it, and what it can be asked."""

from pathlib import Path

from . import migrations
from .changes import Changes
from .journal import Journal
from .queries import Queries
from .removals import Removals
from .submissions import Submissions
from .writer import Writer


class Store(Submissions, Changes, Removals, Queries):
    """Methods that change it give a future, done once the change is durable."""

    def __init__(self, folder: Path, writable: bool = True) -> None:
        """Open an up-to-date index; make it where there is none. Raises `IndexVersionError`, `StoreError`.

        writable: False for a look beside the service that writes; there can be one writer only.
        """
        path = folder.absolute() / "frit.db"
        migrations.prepare(path)
        Writer.__init__(self, path, Journal(folder.absolute() / "submitted.jsonl"), writable)
        Queries.__init__(self, path)

    def close(self) -> None:
        """Finish what waits, and close."""
        Writer.close(self)
        Queries.close(self)
