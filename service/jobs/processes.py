"""Who a process is, locks that end with their holder, and what a process that was killed has left half written."""

import fcntl
import os
from functools import cache
from pathlib import Path


def remove_torn(folder: Path) -> None:
    """Remove what `frit.solver.durable` was writing in the folder for a process that has ended in the middle of it."""
    for path in folder.glob("*.*.*.new"):
        writer = path.name.split(".")[-3]
        if writer.isdecimal() and start_of(int(writer)) is None:
            path.unlink(missing_ok=True)


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
