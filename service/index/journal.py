"""submitted.jsonl: what was asked and decided, line by line; a lost index is made again from it."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from frit.solver.durable import flush


class Journal:
    """Only ever appended to, by the one who writes the index."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def appending(self) -> Iterator[Callable[[str, bool], None]]:
        """Append to the journal; what was appended is taken back where the block ends badly.

        A crash in between leaves lines that the database does not have, of what nobody was told.
        """
        before: list[int] = []
        try:
            yield lambda text, durable: before.append(self.append(text, durable)) if text else None
        except BaseException:
            if before:
                with suppress(OSError):
                    os.truncate(self.path, before[0])
            raise

    def append(self, text: str, durable: bool = True) -> int:
        """Lines of their own, whatever a crash has left before them; how long the journal was."""
        fresh = not self.path.exists()
        with open(self.path, "a+b", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            torn = size > 0 and os.pread(file.fileno(), 1, size - 1) != b"\n"
            try:
                data = memoryview((b"\n" if torn else b"") + text.encode())
                while data:
                    data = data[file.write(data) :]
                if durable:
                    os.fsync(file.fileno())
            except BaseException:
                with suppress(OSError):
                    os.truncate(self.path, size)
                raise
        if fresh:
            flush(self.path.parent)
        return size
