"""What may come in: uploaded files, paths that name them, and sizes that this service can bear."""

import asyncio
import json
import os
from collections.abc import AsyncIterator, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from frit.solver.case import Case, CaseError, Particles, Problem, Table, parse_case
from frit.solver.variations import Texts, case_text, identity, written
from frit.sweeps.definition import parse_sweep
from frit.sweeps.expand import Expansion, expand

from ..index.records import Key, NewPoint, SweepRecord
from ..index.store import Store
from ..jobs.states import NewJob
from ..settings import Settings
from .problems import HttpError, WrongField, escaped, pointer_to, refused, refused_case, shown
from .reckoning import Excess, excesses, too_long
from .security import Who
from .stored import Stored
from .uploads import Uploads
from .views import FileContent, JobSubmission, SweepSubmission

if TYPE_CHECKING:
    from .asking import Rooms

NONE = Uploads()
DEPTH = 6  # of tables in a case or sweep, more than there are
Tree = dict[str, Any]


def job_of(
    submission: JobSubmission, settings: Settings, uploads: Uploads = NONE, owner: str | None = None
) -> NewJob:
    """The job that a request asks for, with its files where they are kept. Raises `HttpError`."""
    check_ranks(submission.ranks, settings, "/ranks")
    check_paths(submission.case, uploads.paths or submission.files, "/case")
    refuse_excesses(too_long(submission.case.get("particles"), settings), "/case")
    tree = _replaced(submission.case, uploads.paths) if uploads.paths else dict(submission.case)
    try:
        case = checked(tree)
    except CaseError as error:
        raise refused_case(uploads.hide(error), "/case") from None
    check_mesh(case.nodes.path, settings, "/case/nodes/path")
    texts = {name: texts_of(table) for name, table in case.tables().items()}
    text = case_text(case.name, texts)
    refuse_excesses(excesses(json.loads(text), submission.ranks, settings), "/case")
    return NewJob(
        case=text, identity=identity(texts), ranks=submission.ranks,
        priority=submission.priority, tags=tuple(submission.tags), time_limit=submission.time_limit,
        owner=owner, name=case.name if submission.name is None else submission.name,
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
    expansion: Expansion
    owner: str | None

    def queued(self, store: Store, key: Key | None, shared: bool, recompute: bool) -> "Future[SweepRecord]":
        """Queue what is missing of it; shared: whether others' jobs of the same case count.

        recompute: what another revision of the solver computed does not.
        """
        return store.submit_sweep(
            self.name, self.definition, self.points, self.expansion.duplicates, key, self.owner, shared, recompute
        )


def sweep_of(
    submission: SweepSubmission, settings: Settings, uploads: Uploads = NONE, owner: str | None = None
) -> NewSweep:
    """The sweep that a request asks for, with all its points. Takes seconds for many. Raises `HttpError`."""
    check_paths(submission.definition, uploads.paths or submission.files, "/definition")
    refuse_excesses(_long_lists(submission.definition, settings), "/definition")
    given = submission.model_dump(include={"ranks", "name", "priority", "tags"}, exclude_none=True)
    tree = {**submission.definition, **given}
    try:
        sweep = parse_sweep(_replaced(tree, uploads.paths) if uploads.paths else tree)
        check_ranks(sweep.ranks, settings, "/definition/ranks" if submission.ranks is None else "/ranks")
        expansion = expand(sweep, settings.points_limit, settings.sweep_limit)
    except CaseError as error:
        raise refused_case(uploads.hide(error), "/definition", "The sweep is refused") from None
    except RecursionError:
        deep = CaseError([Problem("base", None, "is nested too deeply")])
        raise refused_case(deep, "/definition", "The sweep is refused") from None
    points = []
    for point in expansion.points:
        case = json.loads(point.case)
        check_mesh(case["nodes"].get("path"), settings, "/definition")
        refuse_excesses(excesses(case, sweep.ranks, settings), "/definition", point.name)
        job = NewJob(
            case=point.case, identity=point.identity, name=point.name, ranks=sweep.ranks, priority=sweep.priority,
            tags=tuple(sweep.tags), time_limit=submission.time_limit, owner=owner,
        )  # fmt: skip
        points.append(NewPoint(job, point.parameters))
    return NewSweep(sweep.name, sweep.resolved_json(), points, expansion, owner)


def _long_lists(definition: Mapping[str, Any], settings: Settings) -> Iterator[Excess]:
    base, axes = definition.get("base"), definition.get("axes")
    if isinstance(base, Mapping):
        yield from too_long(base.get("particles"), settings, "base.particles")
    if isinstance(axes, Mapping):
        yield from too_long(axes.get("particles"), settings, "axes.particles")


# --- limits -----------------------------------------------------------------------------------------------


def check_ranks(ranks: int, settings: Settings, pointer: str) -> None:
    """A job that needs more cores than there are would wait for ever."""
    if ranks > settings.cores:
        allowed = f"must be at most {settings.cores}, the cores there are"
        raise over_limit(WrongField(pointer=pointer, value=ranks, detail=allowed))


def refuse_excesses(found: Iterable[Excess], pointer: str, point: str | None = None) -> None:
    """Raises `HttpError` where there are any. Of a point of a sweep words tell the key: an axis may have set it."""
    wrong = []
    for excess in found:
        place, words = pointer + pointer_to(excess.key), excess.allowed
        if point is not None:
            place, words = pointer, f"{excess.key} {words} ({point})"
        wrong.append(WrongField(pointer=place, value=shown(excess.value), detail=words))
    if wrong:
        raise over_limit(*wrong)


def check_mesh(path: str | None, settings: Settings, pointer: str) -> None:
    """No case of a request names a file that did not come with one, whatever looked at its paths before."""
    folder = settings.data.absolute() / "files"
    if path is not None and Path(os.path.realpath(path)).parent != Path(os.path.realpath(folder)):
        raise refused("refused-path", "A path is refused", [WrongField(pointer=pointer, detail=_allowed({}))])


def over_limit(*wrong: WrongField) -> HttpError:
    """The problem of a request that wants too much."""
    return refused("over-limit", "More than this service allows", wrong)


# --- files ------------------------------------------------------------------------------------------------


def needs_files(tree: Mapping[str, Any], files: Collection[str]) -> bool:
    """Whether a case brings files, or names any."""
    return bool(files) or next(_paths(tree), None) is not None


@asynccontextmanager
async def taken(
    tree: Mapping[str, Any], files: Mapping[str, FileContent], pointer: str, rooms: "Rooms", who: Who
) -> AsyncIterator[Uploads]:
    """The files that came along with a case or sweep, and those that it names by their ids. Raises `HttpError`."""
    stored = await asyncio.to_thread(stored_in, tree, files, rooms.stored, who)
    await asyncio.to_thread(check_paths, tree, [*files, *stored], pointer)
    async with rooms.shelf.taken(files, stored) as uploads:
        yield uploads


def stored_in(tree: Mapping[str, Any], files: Collection[str], stored: Stored, who: Who) -> dict[str, str]:
    """Where the files are that a case or sweep names by their ids, having been uploaded before."""
    return stored.paths({value for _, value in _paths(tree) if value not in files}, who.sees)


def check_paths(tree: Mapping[str, Any], files: Collection[str], pointer: str) -> None:
    """Raises `HttpError` for a path that is not the name of a file that came along, or came before."""
    if wrong := [
        WrongField(pointer=pointer + place, value=shown(value), detail=_allowed(files))
        for place, value in _paths(tree)
        if value not in files
    ]:
        raise refused("refused-path", "A path is refused", wrong)


def _allowed(files: Collection[str]) -> str:
    known = f": {', '.join(map(repr, files))}" if files else ", and there are none"
    return f"must be the name of an uploaded file, a key of `files`{known}; or the id of one that was uploaded before"


def _paths(tree: Any, key: str = "", place: str = "") -> Iterator[tuple[str, str]]:
    """Every string under a key `path`, also as values of an axis such as `nodes.path`: pointer, value.

    No case or sweep has one deeper than `DEPTH`, nor in a list of lists.
    """
    if isinstance(tree, Mapping) and place.count("/") < DEPTH:
        for name, value in tree.items():
            if isinstance(value, dict | list) or (isinstance(value, str) and str(name).endswith("path")):
                yield from _paths(value, str(name), f"{place}/{escaped(str(name))}")
    elif isinstance(tree, list):
        looked = (str, Mapping) if key.rpartition(".")[2] == "path" else Mapping  # lists may be long
        for number, value in enumerate(tree):
            if isinstance(value, looked):
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
