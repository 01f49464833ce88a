"""Files that outlive a crash: written beside, flushed, renamed. The only place where that is done."""

import itertools
import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

numbers = itertools.count()  # of the files that this process has written beside others


def write_json(path: Path, tree: Any, durable: bool = True) -> None:
    """A JSON file; see `write_whole`."""
    write_whole(path, json.dumps(tree).encode(), durable)


def write_whole(path: Path, content: bytes, durable: bool = True) -> None:
    """A reader sees the old file or the new one; durable: the new one is on the disk when this returns.

    Any number of threads and processes may write the same file at once: the last one stands.
    """
    make_whole(path, lambda beside: _put(beside, content), durable)


def make_whole(path: Path, make: Callable[[Path], object], durable: bool = True) -> None:
    """As `write_whole`, of a file that `make` writes at the path it is given; where that fails, nothing is left."""
    beside = path.with_name(f"{path.name}.{os.getpid()}.{next(numbers)}.new")
    try:
        make(beside)
        if durable:
            replace_durably(beside, path)
        else:
            os.replace(beside, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(beside)
        raise


def replace_durably(beside: Path, path: Path) -> None:
    """Make a finished file durable and put it in the place of the old one: a reader sees the one or the other."""
    flush(beside)
    os.replace(beside, path)
    flush(path.parent)


def write_new(path: Path, content: bytes) -> None:
    """A file that was not there; `FileExistsError` where it was. On the disk when this returns, but for its name."""
    with open(path, "xb") as file:
        file.write(content)
    flush(path)


def flush(path: Path) -> None:
    """Have the content of a file, or the names in a folder, on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_private(folder: Path) -> None:
    """Make a data folder that only its owner may look into; one that is there stays as open as somebody made it."""
    folder.mkdir(0o700, parents=True, exist_ok=True)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a file; empty where there is none or it is torn."""
    try:
        tree = json.loads(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return {}
    return tree if isinstance(tree, dict) else {}


def stamp(path: Path) -> tuple[int, int] | None:
    """Differs once the file is replaced or written anew; None: there is none."""
    with suppress(FileNotFoundError, NotADirectoryError):
        status = path.stat()
        return status.st_ino, status.st_mtime_ns
    return None


def _put(path: Path, content: bytes) -> None:
    with open(path, "wb") as file:
        file.write(content)
