"""`python -P -m frit.solver.convert LIMITS` turns meshes into frit's own file, in a process that can do little.

It is for files of strangers. A line of JSON on stdin has what to convert: lists of file, format and new file, all in
the working folder. For each a line of JSON comes back: null, or what is wrong in one sentence. LIMITS are bytes of
memory, seconds of processor time and bytes of a file, which the kernel keeps; beyond the files asked for, none can be
opened any more once the first is read, nor a program or a connection.
"""

import json
import re
import resource
import sys
from typing import Any

COUNT = re.compile(rb"^[ \t]*[A-Za-z]+[ \t]*=?\s{0,99}(\d{1,20})", re.MULTILINE)
FORBIDDEN = ("subprocess.", "os.exec", "os.fork", "os.posix_spawn", "os.system", "socket.", "ctypes.", "shutil.")


def main() -> int:
    """Convert one after the other."""
    memory, seconds, size = map(int, sys.argv[1:])
    for limit, most in (
        (resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds), (resource.RLIMIT_FSIZE, size),
        (resource.RLIMIT_CORE, 0), (resource.RLIMIT_NOFILE, 64),
    ):  # fmt: skip
        resource.setrlimit(limit, (most, most))
    from . import mesh_file
    from .geometry import MeshError, read_foreign

    asked = json.loads(sys.stdin.readline())
    prepare()
    confine({name for source, _, target in asked for name in (source, target)})
    for source, kind, target in asked:
        try:
            check_counts(source, kind)
            mesh_file.write(target, read_foreign(source, kind))
            wrong = None
        except MemoryError:
            wrong = f"needs more than the {memory:.3g} bytes of memory that are allowed"
        except (MeshError, OSError) as error:
            wrong = str(error).removeprefix(f"{source}: ")
        print(json.dumps(wrong), flush=True)
    return 0


def check_counts(source: str, kind: str) -> None:
    """Refuse a text that announces more of something than it has bytes: a reader of it may look for them for ever."""
    from .geometry import MeshError

    if kind in ("medit", "su2"):
        with open(source, "rb") as file:
            content = file.read()
        for found in COUNT.finditer(content):
            if int(found[1]) > len(content):
                raise MeshError(f"announces {found[1].decode()} of something, more than it has bytes")


def prepare() -> None:
    """Import what readers import late: afterwards nothing is read from disk."""
    import encodings.ascii
    import encodings.latin_1
    import encodings.utf_8
    import lzma
    import xml.etree.ElementTree
    import zlib

    import meshio  # noqa: F401

    assert all((encodings, lzma, xml, zlib))


def confine(names: set[str]) -> None:
    """Refuse, for the rest of the process's life, whatever a reader of meshes has no need of."""

    def watch(event: str, details: tuple[Any, ...]) -> None:
        if (event == "open" and details[0] not in names) or event.startswith(FORBIDDEN):
            raise PermissionError("asks for another file")

    sys.addaudithook(watch)


if __name__ == "__main__":
    sys.exit(main())
