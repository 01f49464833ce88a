"""What may come in: uploaded files, paths that name them, and sizes that this service can bear."""

import base64
import binascii
import hashlib
import json
import math
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from frit.solver.case import Case, CaseError, Particles, Problem, Table, parse_case
from frit.solver.variations import Texts, case_text, identity, written
from frit.sweeps.definition import parse_sweep
from frit.sweeps.expand import expand

from .jobs import NewJob, State
from .problems import HttpError, WrongField, escaped, refused, refused_case, shown
from .settings import Settings
from .store import NewPoint, Store
from .views import FileContent, JobSubmission, SweepSubmission

SUFFIXES = (".msh", ".vtk", ".vtu", ".inp", ".mesh", ".med", ".su2", ".csv")  # formats that refer to no other file
QUEUE_COUNT = 1.0  # seconds for which a count of the queue holds
DEPTH = 6  # of tables in a case or sweep, more than there are
Tree = dict[str, Any]


def job_of(submission: JobSubmission, settings: Settings) -> NewJob:
    """The job that a request asks for. Raises `HttpError`."""
    check_ranks(submission.ranks, settings, "/ranks")
    tree, uploads = with_uploads(submission.case, submission.files, settings, "/case")
    try:
        case = checked(tree)
    except CaseError as error:
        raise refused_case(uploads.hide(error), "/case") from None
    if (nodes := estimated_nodes(case.domain.size, case.nodes.spacing)) > settings.nodes_limit:
        raise too_many_nodes(nodes, settings, "/case/nodes/spacing", case.nodes.spacing)
    texts = {name: texts_of(table) for name, table in case.tables().items()}
    return NewJob(
        case=case_text(case.name, texts), identity=identity(texts), ranks=submission.ranks,
        priority=submission.priority, tags=tuple(submission.tags), time_limit=submission.time_limit,
        name=case.name if submission.name is None else submission.name,
    )  # fmt: skip


def texts_of(table: Table) -> Texts:
    """The table as JSON; most requests have most tables in common. A mesh is known by a path that names its content."""
    return written(table) if isinstance(table, Particles) else _known(table)


@lru_cache(maxsize=256)
def _known(table: Table) -> Texts:
    return written(table)


def checked(tree: Tree) -> Case:
    """The case, unless it would be too much work to check it. Raises `CaseError`."""
    try:
        return parse_case(tree)
    except RecursionError:
        raise CaseError([Problem("case", None, "is nested too deeply")]) from None


# --- sweeps -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NewSweep:
    """A sweep that was let in."""

    name: str
    definition: str
    points: Sequence[NewPoint]
    duplicates: int


def sweep_of(submission: SweepSubmission, settings: Settings) -> NewSweep:
    """The sweep that a request asks for, with all its points. Takes seconds for many. Raises `HttpError`."""
    given = submission.model_dump(include={"ranks", "name", "priority", "tags"}, exclude_none=True)
    tree, uploads = with_uploads({**submission.definition, **given}, submission.files, settings, "/definition")
    try:
        sweep = parse_sweep(tree)
        check_ranks(sweep.ranks, settings, "/definition/ranks" if submission.ranks is None else "/ranks")
        expansion = expand(sweep, settings.points_limit)
    except CaseError as error:
        raise refused_case(uploads.hide(error), "/definition", "The sweep is refused") from None
    except RecursionError:
        deep = CaseError([Problem("base", None, "is nested too deeply")])
        raise refused_case(deep, "/definition", "The sweep is refused") from None
    points = []
    for point in expansion.points:
        case = json.loads(point.case)
        if (nodes := estimated_nodes(case["domain"]["size"], case["nodes"].get("spacing"))) > settings.nodes_limit:
            raise too_many_nodes(nodes, settings, "/definition", None, f" ({point.name})")
        job = NewJob(
            case=point.case, identity=point.identity, name=point.name, ranks=sweep.ranks, priority=sweep.priority,
            tags=tuple(sweep.tags), time_limit=submission.time_limit,
        )  # fmt: skip
        points.append(NewPoint(job, point.parameters))
    return NewSweep(sweep.name, sweep.resolved_json(), points, expansion.duplicates)


# --- limits -----------------------------------------------------------------------------------------------


def check_ranks(ranks: int, settings: Settings, pointer: str) -> None:
    """A job that needs more cores than there are would wait for ever."""
    if ranks > settings.cores:
        allowed = f"must be at most {settings.cores}, the cores there are"
        raise over_limit(WrongField(pointer=pointer, value=ranks, detail=allowed))


def estimated_nodes(size: Sequence[float], spacing: float | None) -> float:
    """Nodes of the lattice of nearest neighbours h in the box, its walls included; 0 for a mesh from a file.

    Triangular: rows h sqrt(3)/2 apart; body-centred: two per cube of edge 2h / sqrt(3).
    """
    if spacing is None:
        return 0.0
    pitch = [spacing, spacing * math.sqrt(3) / 2] if len(size) == 2 else [2 * spacing / math.sqrt(3)] * 3
    counts = [length / step + 1 for length, step in zip(size, pitch, strict=True)]
    return math.prod(counts) * (1 if len(size) == 2 else 2)


def too_many_nodes(nodes: float, settings: Settings, pointer: str, value: Any, where: str = "") -> HttpError:
    """The problem of a case that is too large."""
    allowed = f"gives about {nodes:.3g} nodes, must be at most {settings.nodes_limit}{where}"
    return over_limit(WrongField(pointer=pointer, value=value, detail=allowed))


def over_limit(wrong: WrongField) -> HttpError:
    """The problem of a request that wants too much."""
    return refused("over-limit", "More than this service allows", [wrong])


@dataclass
class QueueLimit:
    """Counts the queue at most once a second and what came in since; so it never lets in too many."""

    store: Store
    limit: int
    queued: int = 0
    counted: float = field(default=-math.inf)

    def admit(self, jobs: int) -> None:
        """Raises `HttpError` where the queue is full."""
        if (now := time.monotonic()) > self.counted + QUEUE_COUNT:
            self.queued, self.counted = self.store.count(State.QUEUED), now
        if self.queued + jobs > self.limit:
            detail = f"{self.queued} jobs are queued and {jobs} more came, must be at most {self.limit} together"
            raise HttpError(429, "queue-full", "The queue is full", detail, headers={"Retry-After": "30"})
        self.queued += jobs


# --- files ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Uploads:
    """Where the files of a request are kept: the server's path by the name that the request has for it."""

    paths: Mapping[str, str]

    def hide(self, error: CaseError) -> CaseError:
        """The error in the request's own names."""
        names = {path: name for name, path in self.paths.items()}
        shown = (
            Problem(p.key, names.get(p.value, p.value) if isinstance(p.value, str) else p.value, p.allowed)
            for p in error.problems
        )
        return CaseError(shown, error.more)


def with_uploads(
    tree: Mapping[str, Any], files: Mapping[str, FileContent], settings: Settings, pointer: str
) -> tuple[Tree, Uploads]:
    """The tree with server paths for the names of files. Raises `HttpError` for a path that is not such a name."""
    if wrong := [
        WrongField(pointer=pointer + place, value=shown(value), detail=_allowed(files))
        for place, value in _paths(tree)
        if value not in files
    ]:
        raise refused("refused-path", "A path is refused", wrong)
    uploads = Uploads({name: str(keep(name, file, settings.data)) for name, file in files.items()})
    return (dict(tree) if not files else _replaced(tree, uploads.paths)), uploads


def _allowed(files: Mapping[str, FileContent]) -> str:
    known = f": {', '.join(map(repr, files))}" if files else ", and there are none"
    return f"must be the name of an uploaded file, a key of `files`{known}"


def _paths(tree: Any, key: str = "", place: str = "") -> Iterator[tuple[str, str]]:
    """Every string under a key `path`, also as values of an axis such as `nodes.path`: pointer, value.

    No case or sweep has one deeper than `DEPTH`, nor in a list of lists.
    """
    if isinstance(tree, Mapping) and place.count("/") < DEPTH:
        for name, value in tree.items():
            if isinstance(value, dict | list) or (isinstance(value, str) and str(name).endswith("path")):
                yield from _paths(value, str(name), f"{place}/{escaped(str(name))}")
    elif isinstance(tree, list):
        for number, value in enumerate(tree):
            if isinstance(value, str | Mapping):
                yield from _paths(value, key, f"{place}/{number}")
    elif isinstance(tree, str) and key.rpartition(".")[2] == "path":
        yield place, tree


def _replaced(tree: Any, paths: Mapping[str, str], key: str = "", depth: int = 0) -> Any:
    if isinstance(tree, Mapping) and depth < DEPTH:
        return {name: _replaced(value, paths, str(name), depth + 1) for name, value in tree.items()}
    if isinstance(tree, list):
        return [_replaced(v, paths, key, depth + 1) if isinstance(v, str | Mapping) else v for v in tree]
    if isinstance(tree, str) and key.rpartition(".")[2] == "path":
        return paths[tree]
    return tree


def keep(name: str, file: FileContent, data: Path) -> Path:
    """Store the content under its hash, once; written beside, made durable, renamed."""
    place = f"/files/{escaped(name)}"
    suffix = re.sub(r"^.*(?=\.)", "", name, flags=re.DOTALL).lower()
    if suffix not in SUFFIXES:
        wrong = WrongField(pointer=place, value=shown(name), detail=f"must end in one of {', '.join(SUFFIXES)}")
        raise refused("refused-file", "A file is refused", [wrong])
    try:
        content = file.content.encode() if file.encoding == "text" else base64.b64decode(file.content, validate=True)
    except (binascii.Error, ValueError) as error:
        wrong = WrongField(pointer=f"{place}/content", detail=f"not {file.encoding}: {error}")
        raise refused("refused-file", "A file is refused", [wrong]) from None
    folder = data.absolute() / "files"
    path = folder / (hashlib.sha256(content).hexdigest() + suffix)
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        beside = folder / f".{path.name}.{os.getpid()}.{time.monotonic_ns()}"
        with open(beside, "wb") as handle:
            handle.write(content)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(beside, path)
    return path
