"""How frit compiles its loops: one decorator, one cache that cannot go stale.

numba keeps compiled code beside the source file and looks only at that file's time stamp, so a kernel that calls a
function of another file would keep the old callee after an edit. frit therefore names its cache folder after the
content of every solver file that holds compiled code: an edit to any of them opens a fresh folder.

numba needs a folder it can write into, for what it finds compiled for another processor or not at all. An installation
that only reads its own files (an image) therefore brings compiled code along in `FRIT_CACHE_SEED`, and the first start
copies it.

numba runs what it finds in the cache, so the folder must be the user's own, or root's, and nobody else's to write into.
One that is not is left alone, and all is compiled into a folder that lasts as long as the process.
"""

import atexit
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

COMPILED = (
    "simd.py", "energy.py", "kernels.py", "blocks.py", "block_kernels.py", "neighbours.py", "shape.py", "clip.py",
    "unknowns.py", "vectors.py", "contacts.py", "elimination.py", "rigid.py", "box.py", "slots.py", "dem.py", "jit.py",
    "sampling.py", "lattice/windows.py", "lattice/loops.py",
)

# Reassociation, contraction and reciprocals, but NaN and infinity keep their meaning: a bad state must be seen.
FASTMATH = {"reassoc", "contract", "arcp", "nsz"}


def cache_root() -> Path:
    """Where frit keeps what it can make again: `FRIT_CACHE_DIR`, or `frit` in the user's cache."""
    default = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "frit"
    return Path(os.environ.get("FRIT_CACHE_DIR", default))


def cache_folder() -> Path:
    """The folder of the compiled code: a hash of the compiled sources names it."""
    here = Path(__file__).parent
    digest = hashlib.sha256(numba.__version__.encode())
    for name in COMPILED:
        if (here / name).exists():
            digest.update((here / name).read_bytes())
    return cache_root() / digest.hexdigest()[:16]


def is_trusted(folder: Path) -> bool:
    """Whether it is a folder of this user or of root in which nobody else may write."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid in (0, os.geteuid()) and not status.st_mode & 0o022


def trusted_folder() -> Path:
    """The folder of the compiled code, made where it is not there; one for this process if it is not to be trusted."""
    folder = cache_folder()
    with suppress(OSError):  # it cannot be made: numba finds none, and compiles
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        seed(folder)
        folder.mkdir(mode=0o700, exist_ok=True)
        if not (is_trusted(folder) and is_trusted(folder.parent)):
            own = tempfile.mkdtemp(prefix="frit-compiled-")
            atexit.register(shutil.rmtree, own, ignore_errors=True)
            print(f"{folder}: others may write there, so its compiled code is not used", file=sys.stderr, flush=True)
            return Path(own)
    return folder


def seed(folder: Path) -> None:
    """Make a cache folder that is not there from the one of its name in `FRIT_CACHE_SEED`, whole or not at all."""
    source = Path(os.environ.get("FRIT_CACHE_SEED", os.devnull)) / folder.name
    if folder.exists() or not is_trusted(source):
        return
    with suppress(OSError):  # another process was quicker; or no room, and then all is compiled or numba complains
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as beside:
            copy = Path(beside) / "whole"
            shutil.copytree(source, copy)
            copy.rename(folder)


numba.config.CACHE_DIR = str(trusted_folder())  # type: ignore[attr-defined]  # numba makes its settings at import

Function = TypeVar("Function", bound=Callable[..., Any])
# For arguments of compiled functions: each is compiled once more for a literal 0.
ZERO, ONE = cast(int, np.int64(0)), cast(int, np.int64(1))

EXACT: dict[str, Any] = {"cache": True, "error_model": "numpy"}
OPTIONS: dict[str, Any] = EXACT | {"fastmath": FASTMATH}


def jit(function: Function) -> Function:
    """Compile a module-level function of arrays and scalars: cached, division by zero gives infinity, no Python."""
    return cast(Function, numba.njit(**OPTIONS)(function))


def inlined(function: Function) -> Function:
    """`jit` for the innermost functions: a call that passes five arrays costs as much as the loop inside."""
    return cast(Function, numba.njit(forceinline=True, **OPTIONS)(function))


LEAN: dict[str, Any] = {"_nrt": False}


def lean(function: Function) -> Function:
    """`inlined` for functions that make no arrays, without numba's counting of references.

    It counts atomically each time an array is taken out of a named tuple: five times the work of a short inner loop.
    """
    return cast(Function, numba.njit(forceinline=True, **(OPTIONS | LEAN))(function))


def lean_jit(function: Function) -> Function:
    """`jit` for functions that make no arrays, see `lean`."""
    return cast(Function, numba.njit(**(OPTIONS | LEAN))(function))


def exact(function: Function) -> Function:
    """`jit` where every operation is done as written: every processor gives the same numbers, to the last bit."""
    return cast(Function, numba.njit(**EXACT)(function))


def exact_inlined(function: Function) -> Function:
    """`inlined`, likewise."""
    return cast(Function, numba.njit(forceinline=True, **EXACT)(function))
