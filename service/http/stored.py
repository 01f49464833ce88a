"""Files that are uploaded by themselves: streamed to the disk, looked at and converted as those of requests are, kept.

A card beside each (`<id>.json`) tells who has it under which name; so it outlives a lost index. A case names it by its
id, in the place of the name of a file that came along.
"""

import mmap
import os
import shutil
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import anyio.to_thread

from frit.solver.durable import flush, read_json, write_json

from .problems import HttpError, WrongField, not_found, refused, shown
from .uploads import BESIDE, Shelf

CARD = ".card"  # the last suffix of a card


class StoredFile(NamedTuple):
    """A file as one owner has it; `bytes` are those of what is kept of it."""

    id: str
    name: str
    owner: str | None
    bytes: int
    created: float


class Stored:
    """The files of a shelf that have a card."""

    def __init__(self, shelf: Shelf) -> None:
        self.shelf, self._cards = shelf, threading.Lock()

    async def receive(self, name: str, pieces: AsyncIterator[bytes], owner: str | None) -> StoredFile:
        """Take a file as it comes. Raises `HttpError` for one that is refused; nothing of it is left then."""
        try:
            self.shelf.folder.mkdir(parents=True, exist_ok=True)
            work = Path(tempfile.mkdtemp(prefix=BESIDE, dir=self.shelf.folder))
            try:
                with open(work / "0.in", "xb") as file:
                    async for piece in pieces:
                        await anyio.to_thread.run_sync(file.write, piece)
                path = await self.shelf.aside(lambda: self._placed(name, work))
            finally:
                await anyio.to_thread.run_sync(lambda: shutil.rmtree(work, ignore_errors=True))
        except HttpError as error:
            if error.details.status != 422:
                raise
            wrong = [WrongField(parameter="name", value=shown(name), detail=e.detail) for e in error.details.errors]
            raise refused("refused-file", "The file is refused", wrong) from None
        try:
            return await anyio.to_thread.run_sync(lambda: self._keep(Path(path), name, owner))
        finally:
            self.shelf.release([path], accepted=True)

    def _placed(self, name: str, work: Path) -> str:
        with open(work / "0.in", "rb") as file:
            if not os.fstat(file.fileno()).st_size:
                raise refused("refused-file", "The file is refused", [WrongField(detail="is empty")])
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                kind = self.shelf.kind(name, content)
        flush(work / "0.in")
        return self.shelf.placed({name: work / "0.in"}, {name: kind}, work)[name]

    def _keep(self, path: Path, name: str, owner: str | None) -> StoredFile:
        with self._cards:
            card = read_json(self._card(path.name))
            card[owner or ""] = {"name": name, "created": time.time()}
            write_json(self._card(path.name), card)
        return self._of(path.name, card, owner or "")

    def listed(self, sees: Callable[[str | None], bool]) -> list[StoredFile]:
        """Those that one may see, newest first."""
        found = []
        for path in self.shelf.folder.glob(f"*{CARD}"):
            with suppress(OSError):  # it was removed meanwhile
                card, identifier = read_json(path), path.name.removesuffix(CARD)
                found += [self._of(identifier, card, owner) for owner in card if sees(owner or None)]
        return sorted(found, key=lambda file: (-file.created, file.id))

    def paths(self, identifiers: Iterable[str], sees: Callable[[str | None], bool]) -> dict[str, str]:
        """Where those are that there are and that one may see, by id."""
        found = {}
        for identifier in identifiers:
            if self._is_id(identifier) and any(sees(owner or None) for owner in read_json(self._card(identifier))):
                found[identifier] = str(self.shelf.folder / identifier)
        return found

    def remove(self, identifier: str, may: Callable[[str | None], bool], used: Callable[[], set[str]]) -> None:
        """Of those that one may change. Raises `HttpError` where there is none, or while a job or sweep uses it."""
        with self._cards:
            card = read_json(self._card(identifier)) if self._is_id(identifier) else {}
            kept = {owner: entry for owner, entry in card.items() if not may(owner or None)}
            if len(kept) == len(card):
                raise not_found(f"file {identifier!r}: there is none of yours")
            if kept:
                return write_json(self._card(identifier), kept)
            if identifier in used() or not self.shelf.discard(self.shelf.folder / identifier):
                raise HttpError(409, "in-use", "It is in use", f"file {identifier}: a job or a sweep refers to it")
            self._card(identifier).unlink()
            flush(self.shelf.folder)

    def _card(self, identifier: str) -> Path:
        return self.shelf.folder / f"{identifier}{CARD}"

    @staticmethod
    def _is_id(identifier: str) -> bool:
        return "/" not in identifier and "\0" not in identifier and 64 < len(identifier) < 80

    def _of(self, identifier: str, card: dict[str, Any], owner: str) -> StoredFile:
        size = (self.shelf.folder / identifier).stat().st_size
        entry = card[owner]
        return StoredFile(identifier, entry["name"], owner or None, size, entry["created"])
