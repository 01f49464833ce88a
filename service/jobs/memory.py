"""Memory: how much of the machine belongs to a core, and how much a process and all below it take."""

import ctypes
import os
from contextlib import suppress
from pathlib import Path

import psutil

LEAST = 500_000_000  # bytes; an idle rank takes half of that
MOUNTS = Path("/sys/fs/cgroup")
M_MMAP_THRESHOLD, M_ARENA_MAX = -3, -8  # of glibc's mallopt
LIMITS = {"": "memory.max", "memory": "memory.limit_in_bytes"}  # by the controllers of a line in /proc/self/cgroup


def memory_per_core() -> int:
    """The machine's memory, or what a container may take of it, over the processors; at least `LEAST`, bytes."""
    allowed = min([psutil.virtual_memory().total, *limits_of(Path("/proc/self/cgroup"), MOUNTS)])
    return max(LEAST, int(allowed) // (os.cpu_count() or 1))


def limits_of(groups: Path, mounts: Path) -> list[int]:
    """The limits, bytes, of the control groups in a file like /proc/self/cgroup and of all groups above them."""
    found = []
    with suppress(OSError):
        for line in groups.read_text().splitlines():
            _, controllers, name = line.split(":", 2)
            if (file := LIMITS.get(controllers)) is not None:
                own = Path(name.lstrip("/"))
                for folder in (own, *own.parents):
                    with suppress(OSError, ValueError):  # in a container the path may be that of outside; "max": none
                        found.append(int((mounts / controllers / folder / file).read_text()))
    return found


def memory_below(pid: int, enough: int) -> int:
    """Bytes that all processes below this one take; what several share counts once, if that decides about `enough`."""
    tree = []
    with suppress(psutil.Error):
        tree = psutil.Process(pid).children(recursive=True)
    resident = _sum(tree, shared_once=False)
    return resident if resident <= enough else _sum(tree, shared_once=True)


def _sum(tree: list[psutil.Process], shared_once: bool) -> int:
    total = 0
    for process in tree:
        with suppress(psutil.Error):  # it has ended meanwhile
            info = process.memory_full_info() if shared_once else process.memory_info()
            total += info.pss if shared_once else info.rss
    return total


def keep_little() -> None:
    """Have large blocks, and what threads have used, go back to the machine when they are free; with glibc."""
    with suppress(AttributeError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, 1 << 20)
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 2)
