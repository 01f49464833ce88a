"""Files that come with requests: looked at, meshes converted once in a child of their own, kept under their hash.

What a stranger sends is read by frit's own process only as particles, a few lines of text. A mesh goes through meshio
in a process that the kernel limits (`frit.solver.convert`): it costs half a second of imports, only where there is a
mesh, so nothing is kept running for it. The runs read what comes out of it, frit's own mesh file, and nothing else.
"""

import asyncio
import base64
import binascii
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from frit.solver.case import CaseError, Problem
from frit.solver.durable import replace_durably, write_new
from frit.solver.mesh_file import SUFFIX

from ..settings import Settings
from .problems import HttpError, WrongField, escaped, refused, shown, unavailable
from .sniffing import PARTICLES, Content, UnknownFileError, kind_of
from .views import FileContent

SUFFIXES = (".msh", ".vtk", ".vtu", ".mesh", ".su2", ".csv", ".cloud")
WAITING = 20  # requests that may wait for a conversion
LONGEST_LINE = 1000  # bytes of a line of particles
SPARE_LINES = 1000  # of comments, beside one per particle
UNUSED = 86_400.0  # seconds after which a file that nothing uses is removed
BESIDE = ".new-"  # what a folder of unfinished work begins with
T = TypeVar("T")
SAID = 200  # characters that are told of what a reader says


@dataclass(frozen=True)
class Uploads:
    """Where the files of a request are kept: the server's path by the name that the request has for it."""

    paths: Mapping[str, str] = field(default_factory=dict)

    def hide(self, error: CaseError) -> CaseError:
        """The error in the request's own names."""
        names = {path: name for name, path in self.paths.items()}
        hidden = (
            Problem(p.key, names.get(p.value, p.value) if isinstance(p.value, str) else p.value, p.allowed)
            for p in error.problems
        )
        return CaseError(hidden, error.more)


class Shelf:
    """The folder of uploads. What requests under way use is held; what a refused one brought is removed again."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.folder = settings.data.absolute() / "files"
        self._door = threading.Lock()  # of the names in the folder and of the two below
        self._held: Counter[str] = Counter()  # by path: how many requests use it now
        self._fresh: set[str] = set()  # paths that are there for requests under way only
        self._pool = ThreadPoolExecutor(settings.conversions, thread_name_prefix="frit-upload")
        self._waiting = 0

    def close(self) -> None:
        """Let what is under way end."""
        self._pool.shutdown(cancel_futures=True)

    @asynccontextmanager
    async def taken(
        self, files: Mapping[str, FileContent], stored: Mapping[str, str] | None = None
    ) -> AsyncIterator[Uploads]:
        """The files, kept from the end of the block on unless it raises. Raises `HttpError` for what is not taken.

        stored: paths of files that are here already, by the names that the request has for them.
        """
        if not files and not stored:
            yield Uploads()
            return
        held, accepted = self.hold((stored or {}).values()), False
        try:
            if len(held) < len(stored or {}):
                raise refused("refused-path", "A path is refused", [WrongField(detail="a file was removed meanwhile")])
            paths = await self.aside(lambda: self.take(files)) if files else {}
            try:
                yield Uploads({**(stored or {}), **paths})
                accepted = True
            finally:
                self.release(paths.values(), accepted)
        finally:
            self.release(held, accepted=True)

    @contextmanager
    def holding(self, files: Mapping[str, FileContent]) -> Iterator[Uploads]:
        """`taken` for a thread."""
        paths, accepted = self.take(files), False
        try:
            yield Uploads(paths)
            accepted = True
        finally:
            self.release(paths.values(), accepted)

    def take(self, files: Mapping[str, FileContent]) -> dict[str, str]:
        """Read, convert and hold the files: paths by name, to be released. Raises `HttpError`."""
        contents = {name: content_of(name, file) for name, file in files.items()}
        kinds = {name: self.kind(name, content) for name, content in contents.items()}
        if not files:
            return {}
        self.folder.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=BESIDE, dir=self.folder))
        try:
            sources = {name: work / f"{number}.in" for number, name in enumerate(contents)}
            for name, source in sources.items():
                write_new(source, contents[name])
            return self.placed(sources, kinds, work)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    async def aside(self, work: Callable[[], T]) -> T:
        """Have it done where files are read. Raises `HttpError` where too many wait for that."""
        if self._waiting >= WAITING:
            raise unavailable("too many uploads wait to be read")
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._pool, work)
        finally:
            self._waiting -= 1

    def kind(self, name: str, content: Content) -> str:
        """What a file is. Raises `HttpError` for one that is not taken."""
        try:
            kind = kind_of(content)
        except UnknownFileError as error:
            raise not_taken(name, str(error)) from None
        if kind == PARTICLES:
            most = self.settings.particles_limit
            if len(content) > (most + SPARE_LINES) * LONGEST_LINE:
                raise not_taken(name, f"has {len(content)} bytes, too many for {most} particles")
            text = content[:].rstrip(b"\r\n")
            lines = text.count(b"\n") + text.count(b"\r") - text.count(b"\r\n") + 1
            if lines > most + SPARE_LINES:
                raise not_taken(name, f"has {lines} lines, must be at most {most} particles")
            if max(map(len, text.splitlines()), default=0) > LONGEST_LINE:
                raise not_taken(name, f"has a line longer than {LONGEST_LINE} bytes")
        return kind

    def placed(self, sources: Mapping[str, Path], kinds: Mapping[str, str], work: Path) -> dict[str, str]:
        """Have meshes converted, and hold all under the hash of what they are now: paths by name, to be released."""
        meshes = {name: source for name, source in sources.items() if kinds[name] != PARTICLES}
        made = convert(meshes, kinds, work, self.settings) if meshes else {}
        for name in sources.keys() - meshes.keys():
            made[name] = sources[name].rename(sources[name].with_suffix(".csv"))
        return {name: str(self._place(made[name])) for name in sources}

    def _place(self, made: Path) -> Path:
        """Move a finished file to its name, once for each content, and hold it."""
        with open(made, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        path = self.folder / f"{digest}{made.suffix}"
        with self._door:
            if path.exists():
                os.utime(path)
            else:
                replace_durably(made, path)
                self._fresh.add(str(path))
            self._held[str(path)] += 1
        return path

    def hold(self, paths: Iterable[str]) -> list[str]:
        """Keep files that are there from being removed, until they are released; those that are there."""
        with self._door:
            found = [path for path in paths if os.path.exists(path)]
            self._held.update(found)
        return found

    def discard(self, path: Path) -> bool:
        """Remove a file, unless a request under way uses it."""
        with self._door:
            if self._held[str(path)]:
                return False
            path.unlink(missing_ok=True)
        return True

    def release(self, paths: Iterable[str], accepted: bool) -> None:
        """A request under way is over; what it alone brought is removed unless it was accepted."""
        with self._door:
            for path in paths:
                self._held[path] -= 1
                if accepted:
                    self._fresh.discard(path)
                if self._held[path] <= 0:
                    del self._held[path]
                    if path in self._fresh:
                        self._fresh.discard(path)
                        with suppress(FileNotFoundError):
                            os.unlink(path)

    def tidy(self, used: Iterable[str], age: float = UNUSED) -> list[str]:
        """Remove files that are older than that and not among the used, by name; the names of what was removed."""
        kept, removed, before = set(used), [], time.time() - age
        cards = {path.name for path in self.folder.glob("*.card")}  # of files that were uploaded by themselves
        kept |= cards | {name.removesuffix(".card") for name in cards}
        with suppress(FileNotFoundError), os.scandir(self.folder) as entries:
            for entry in entries:
                with self._door, suppress(FileNotFoundError):
                    old = entry.stat(follow_symlinks=False).st_mtime < before
                    if not old or entry.name in kept or self._held[entry.path]:
                        continue
                    if entry.is_dir(follow_symlinks=False):
                        shutil.rmtree(entry.path, ignore_errors=True)
                    else:
                        os.unlink(entry.path)
                    removed.append(entry.name)
        return removed


def content_of(name: str, file: FileContent) -> bytes:
    """The file's bytes. Raises `HttpError`."""
    suffix = re.sub(r"^.*(?=\.)", "", name, flags=re.DOTALL).lower()
    if suffix not in SUFFIXES:
        raise not_taken(name, f"must end in one of {', '.join(SUFFIXES)}", shown(name))
    try:
        return file.content.encode() if file.encoding == "text" else base64.b64decode(file.content, validate=True)
    except (binascii.Error, ValueError):
        raise not_taken(name, f"is not {file.encoding}", pointer="/content") from None


def not_taken(name: str, why: str, value: object = None, pointer: str = "") -> HttpError:
    """The problem of a file."""
    wrong = WrongField(pointer=f"/files/{escaped(name)}{pointer}", value=value, detail=why)
    return refused("refused-file", "A file is refused", [wrong])


def convert(sources: Mapping[str, Path], kinds: Mapping[str, str], work: Path, settings: Settings) -> dict[str, Path]:
    """frit's own mesh files for meshes in the folder, there as well. Raises `HttpError`."""
    names = list(sources)
    tasks = [[source.name, kinds[name], f"{source.stem}{SUFFIX}"] for name, source in sources.items()]
    answers = ask_child(tasks, work, settings)
    if len(answers) < len(names):
        limits = f"{settings.upload_seconds:g} s or the {settings.upload_memory:.3g} bytes of memory"
        raise not_taken(names[len(answers)], f"takes more than the {limits} that are allowed")
    for name, wrong in zip(names, answers, strict=True):
        if wrong is not None:
            raise not_taken(name, sentence(wrong))
    return {name: work / task[2] for name, task in zip(names, tasks, strict=True)}


def ask_child(tasks: Sequence[Sequence[str]], work: Path, settings: Settings) -> list[str | None]:
    """What the child says of each task, as far as it came; its whole group is gone when this returns."""
    seconds = settings.upload_seconds
    limits = map(str, (settings.upload_memory, int(seconds) + 1, settings.upload_bytes))
    child = subprocess.Popen(
        [sys.executable, "-P", "-m", "frit.solver.convert", *limits],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        cwd=work, env=child_environment(work), start_new_session=True,
    )  # fmt: skip
    try:
        said, _ = child.communicate(json.dumps(tasks).encode() + b"\n", timeout=seconds)
    except subprocess.TimeoutExpired:
        said = b""
        end(child)
        with suppress(ValueError, OSError):
            said = child.communicate()[0]
    finally:
        end(child)
        child.wait()
    answers: list[str | None] = []
    for line in said.splitlines():
        with suppress(ValueError):
            answers.append(json.loads(line))
    return answers


def end(child: "subprocess.Popen[bytes]") -> None:
    """Kill it and its group, unless it has ended: then it has started nothing that could live."""
    if child.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


def child_environment(work: Path) -> dict[str, str]:
    """As little as an interpreter needs: nothing that the service was told."""
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return dict.fromkeys(threads, "1") | {"PATH": os.defpath, "TMPDIR": str(work), "PYTHONDONTWRITEBYTECODE": "1"}


def sentence(said: str) -> str:
    """What a reader says, in printable ASCII, short, without anything that looks like a path."""
    text = "".join(c if " " <= c <= "~" else " " for c in said)
    words = ["..." if re.search(r"[/\\]", word) else word for word in text.split()]
    short = " ".join(words)
    return f"{short[: SAID - 3]}..." if len(short) > SAID else short
