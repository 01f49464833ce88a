"""Small files that outlive a crash: written beside and renamed; locks that end with their holder; who a process is."""

import fcntl
import json
import os
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any


def write_json(path: Path, tree: Any, durable: bool = True) -> None:
    """A reader sees the old file or the new one; durable: the new one is on the disk when this returns."""
    beside = f"{path}.{os.getpid()}.new"
    try:
        with open(beside, "wb") as file:
            file.write(json.dumps(tree).encode())
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
    with suppress(FileNotFoundError):
        status = path.stat()
        return status.st_ino, status.st_mtime_ns
    return None


def try_lock(path: Path) -> int | None:
    """A descriptor that holds the lock as long as it, or a copy of it in any process, is open; None: it is held."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
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


def start_of(pid: int) -> int | None:
    """When a process started, in clock ticks after boot; None where there is no such process."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return int(stat[stat.rindex(")") + 2 :].split()[19])
