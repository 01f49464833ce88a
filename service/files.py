"""Small files that outlive a crash: written beside and renamed; locks that end with their holder; who a process is."""

import fcntl
import itertools
import json
import os
from contextlib import suppress
from functools import cache
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
    beside = f"{path}.{os.getpid()}.{next(numbers)}.new"
    try:
        with open(beside, "wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError:
        with suppress(OSError):
            os.unlink(beside)
        raise
    if durable:
        flush_folder(path.parent)


def remove_torn(folder: Path) -> None:
    """Remove what `write_whole` was writing in the folder for a process that has ended in the middle of it."""
    for path in folder.glob("*.*.*.new"):
        writer = path.name.split(".")[-3]
        if writer.isdecimal() and start_of(int(writer)) is None:
            path.unlink(missing_ok=True)


def make_private(folder: Path) -> None:
    """Make a data folder that only its owner may look into; one that is there stays as open as somebody made it."""
    folder.mkdir(0o700, parents=True, exist_ok=True)


def flush_folder(folder: Path) -> None:
    """Make new names in it durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


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


def try_lock(path: Path, make: bool = True) -> int | None:
    """A descriptor that holds the lock as long as it, or a copy of it in any process, is open; None: it is held.

    make: whether to make the file where there is none; if not, that is a `FileNotFoundError`.
    """
    handle = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if make else 0), 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    return handle


@cache
def boot() -> str:
    """The kernel's name for this boot of this machine."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def is_at(handle: int, path: Path) -> bool:
    """Whether an open file is still the one of that name: false once it, or a folder above it, is gone or another."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # nobody can tell now
        return True


def start_of(pid: int) -> int | None:
    """When a process started, in clock ticks after boot; None where there is no such process."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return int(stat[stat.rindex(")") + 2 :].split()[19])
