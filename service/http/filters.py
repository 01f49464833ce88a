"""From query parameters to SQL: which jobs, in which order, from where on.

A filter is `key=value` or `key.operator=value`. Keys are columns of a job, scalars of its case such as
`particles.mean_radius`, or of its result such as `result.vacancy_ratio`; keys and types of the case are those of its
schema. The SQL of a scalar is word for word that of the indices in schema.py, or SQLite would not use them.
"""

import base64
import binascii
import difflib
import json
import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from typing import Any

import sqlalchemy as sa

from frit.solver.case import case_schema

from ..index.schema import job_tags, jobs, sweep_jobs
from ..jobs.states import Job, State
from .problems import WrongField, refused

Condition = sa.ColumnElement[bool]
PAGE = 50  # jobs on a page, unless asked for
LARGEST_PAGE = 500
MOST = 200  # values of all filters of a query together: SQLite takes no deeper conditions than a thousand
NEAR = 1000  # jobs that are looked at before a range is sorted
ORDERING = ("lt", "le", "gt", "ge")
OPERATORS = ("eq", "ne", *ORDERING, "in")

COMPARE: Mapping[str, Callable[[Any, Any], Any]] = {
    name: getattr(operator, name) for name in ("eq", "ne", *ORDERING)
}  # fmt: skip
INDEXED = ("particles.mean_radius", "particles.std_radius", "particles.packing_density", "result.vacancy_ratio")
RESULTS = ("time", "step", "vacancy_ratio", "solid_mass", "free_energy", "live_fraction", "particles", "evaluations",
           "wall_time", "pack_porosity", "neck_length", "centre_distance")  # fmt: skip
NATIVE = (*INDEXED, "id", "identity", "name", "state", "owner")  # what the schema has an index of
PACKING = re.compile(r"result\.packing(\.[A-Za-z_][A-Za-z0-9_]*){1,3}")


# The state as SQLite does not look it up in an index: another one is better.
AFTER_OTHERS: sa.ColumnElement[Any] = sa.literal_column("+jobs.state")
AFTER_RANGE: sa.ColumnElement[Any] = sa.literal_column("+jobs.seq")


@dataclass(frozen=True)
class Scalar:
    """Something to filter or order by; `kind`: number, integer, string, boolean, time."""

    key: str
    kind: str
    sql: sa.ColumnElement[Any]


@dataclass(frozen=True)
class Selection:
    """What a list of jobs is made of."""

    where: Condition
    order: tuple[sa.ColumnElement[Any], ...]
    limit: int
    by: str
    scalar: Scalar | None
    """what is ordered by before the order of submission"""
    few: tuple[Condition, ...]
    """what indices have in another order: where one of these gives few jobs, they are the ones to look at"""
    near: sa.Select[Any] | None
    """where a range of one index is all that is asked: the first jobs after the cursor, which may be enough"""


class WrongQueryError(ValueError):
    """A query parameter that cannot be."""

    def __init__(self, parameter: str, value: Any, allowed: str) -> None:
        self.field = WrongField(parameter=parameter, value=value, detail=allowed)
        super().__init__(allowed)


# --- keys -------------------------------------------------------------------------------------------------


@cache
def columns() -> dict[str, Scalar]:
    """Columns of a job."""
    kinds = {
        "id": "string", "name": "string", "identity": "string", "state": "string", "priority": "integer",
        "ranks": "integer", "attempt": "integer", "created": "time", "started": "time", "ended": "time",
        "core_seconds": "number", "bytes": "integer", "owner": "string", "origin": "string",
    }  # fmt: skip
    return {key: Scalar(key, kind, jobs.c[key]) for key, kind in kinds.items()}


@cache
def case_keys() -> dict[str, Scalar]:
    """Scalars of the case, by dotted key."""
    schema = case_schema()
    return {key: _scalar("case", key, kind) for key, kind in _scalars(schema, schema, "") if key != "name"}


def _scalars(node: Mapping[str, Any], schema: Mapping[str, Any], key: str) -> Iterator[tuple[str, str]]:
    if "$ref" in node:
        node = schema["$defs"][node["$ref"].rpartition("/")[2]]
    for form in (*node.get("anyOf", ()), *node.get("oneOf", ())):
        yield from _scalars(form, schema, key)
    for name, child in node.get("properties", {}).items():
        yield from _scalars(child, schema, f"{key}.{name}" if key else name)
    if (kind := node.get("type")) in ("number", "integer", "string", "boolean"):
        yield key, kind


def _scalar(column: str, key: str, kind: str) -> Scalar:
    prefix = "result." if column == "result" else ""
    quoted = '"case"' if column == "case" else column
    return Scalar(prefix + key, kind, sa.literal_column(f"json_extract({quoted}, '$.{key}')"))


@cache
def result_keys() -> dict[str, Scalar]:
    """Scalars of the last history row; those of a packing are whatever `run.json` has."""
    return {f"result.{key}": _scalar("result", key, "number") for key in RESULTS}


def known() -> dict[str, Scalar]:
    """All that can be named, but for the results of packings."""
    return {**columns(), **case_keys(), **result_keys()}


def find(key: str, parameter: str) -> Scalar:
    """The scalar of a key. Raises `WrongQueryError` with the nearest key there is."""
    if PACKING.fullmatch(key):
        return _scalar("result", key.removeprefix("result."), "number")
    if (found := known().get(key)) is None:
        names = [*known(), "sweep", "tag"]
        close = difflib.get_close_matches(key, names, n=1) or [n for n in names if n.rpartition(".")[2] == key][:1]
        hint = f" (did you mean {close[0]}?)" if close else ""
        allowed = f"unknown key {key!r}: a job's columns, scalars of its case and result.* are known{hint}"
        raise WrongQueryError(parameter, None, allowed)
    return found


# --- conditions -------------------------------------------------------------------------------------------


def native(scalar: Scalar) -> bool:
    """Whether the schema has an index of it."""
    return scalar.key in NATIVE


def select(
    parameters: Iterable[tuple[str, str]], sweep: Callable[[str], int], owner: str | None = None
) -> Selection:
    """What the query parameters ask for; `sweep` gives the seq of a sweep. Raises `HttpError`.

    owner: whose jobs are seen; None: everybody's.
    """
    wrong: list[WrongField] = []
    where: list[Condition] = [] if owner is None else [jobs.c.owner == owner]
    given: dict[str, list[str]] = {}
    for name, value in parameters:
        given.setdefault(name, []).append(value)
    if (values := sum(1 + value.count(",") for found in given.values() for value in found)) > MOST:
        allowed = f"has {values} values in all filters together, must be at most {MOST}"
        raise refused("refused-query", "The query is refused", [WrongField(parameter="filters", detail=allowed)])
    by = given.get("order", ["-created"])[-1]
    asked = [name for name in given if name not in ("order", "limit", "cursor")]
    found = {name: scalar for name in asked if (scalar := _scalar_of(name)) is not None and native(scalar)}
    limit, scalar, ordered = PAGE, None, False
    try:
        scalar = _order(by)
        ordered = scalar is not None and native(scalar)
        limit = _limit(given.get("limit", [str(PAGE)])[-1])
    except WrongQueryError as error:
        wrong.append(error.field)
    state = AFTER_OTHERS if found or ordered else jobs.c.state
    for name in asked:
        try:
            where.extend(_conditions(name, given[name], sweep, state, name in found))
        except WrongQueryError as error:
            wrong.append(error.field)
    # A range of one index has all that is asked: it is sorted, which moves numbers only, and not left for the order.
    alone = scalar is None and len({key.key for key in found.values()}) == 1 and len(found) == len(asked)
    ranged = alone and any(_parts(name)[1] != "eq" for name in found)
    seq: sa.ColumnElement[Any] = AFTER_RANGE if ranged else jobs.c.seq
    near: Condition = sa.true()
    few = () if alone or not (found or "tag" in given or scalar is not None) else tuple(_few(given, found, sweep))
    try:
        if place := given.get("cursor", [""])[-1]:
            where.append(_after(place, by, scalar, seq))
            near = _after(place, by, scalar, jobs.c.seq)
    except WrongQueryError as error:
        wrong.append(error.field)
    if wrong:
        raise refused("refused-query", "The query is refused", wrong)
    direction = sa.desc if by.startswith("-") else sa.asc
    order = (direction(seq),) if scalar is None else (direction(scalar.sql), direction(seq))
    first = sa.select(jobs.c.seq).where(near).order_by(direction(jobs.c.seq)).limit(NEAR) if ranged else None
    return Selection(sa.and_(sa.true(), *where), order, limit, by, scalar, few, first)


def _few(
    given: Mapping[str, list[str]], found: Mapping[str, Scalar], sweep: Callable[[str], int]
) -> Iterator[Condition]:
    """Each filter that an index answers, by itself; what is wrong is told elsewhere."""
    for name, values in given.items():
        if name in found or name in ("state", "sweep", "tag"):
            with suppress(WrongQueryError):
                yield sa.and_(sa.true(), *_conditions(name, values, sweep, jobs.c.state, name in found))


def _parts(name: str) -> tuple[str, str]:
    """The key and the operator of a filter."""
    key, dot, verb = name.rpartition(".")
    return (key, verb) if dot and verb in OPERATORS and name not in known() else (name, "eq")


def _scalar_of(name: str) -> Scalar | None:
    """What a filter compares; None for a list of its own, and for a key that there is not."""
    if name in ("state", "sweep", "tag"):
        return None
    try:
        return find(_parts(name)[0], name)
    except WrongQueryError:
        return None


def _conditions(
    name: str, values: list[str], sweep: Callable[[str], int], state: sa.ColumnElement[Any], found: bool
) -> Iterator[Condition]:
    """`found`: by an index."""
    if name == "state":
        states = [state for value in values for state in value.split(",")]
        if unknown := [state for state in states if state not in list(State)]:
            raise WrongQueryError(name, unknown[0], f"must be one of {', '.join(State)}")
        yield state == states[0] if len(states) == 1 else state.in_(states)
    elif name == "sweep":
        for value in values:
            yield jobs.c.seq.in_(sa.select(sweep_jobs.c.job).where(sweep_jobs.c.sweep == sweep(value)))
    elif name == "tag":
        for value in values:
            yield jobs.c.seq.in_(sa.select(job_tags.c.job).where(job_tags.c.tag == value))
    else:
        key, verb = _parts(name)
        scalar = find(key, name)
        for value in values:
            yield _condition(scalar, verb, value, name, found)


def _condition(scalar: Scalar, verb: str, text: str, parameter: str, found: bool) -> Condition:
    if verb in ORDERING and scalar.kind in ("string", "boolean"):
        raise WrongQueryError(parameter, text, f"{scalar.key} is a {scalar.kind}: only eq, ne and in are possible")
    if verb == "in":
        return scalar.sql.in_([_typed(scalar, part, parameter) for part in text.split(",")])
    value = _typed(scalar, text, parameter)
    if verb == "ne" and found:  # an index has ranges
        return _condition_of(scalar, "lt", value) | _condition_of(scalar, "gt", value)
    return _condition_of(scalar, verb, value)


def _condition_of(scalar: Scalar, verb: str, value: Any) -> Condition:
    return sa.type_coerce(COMPARE[verb](scalar.sql, sa.bindparam(None, value)), sa.Boolean)


def _typed(scalar: Scalar, text: str, parameter: str) -> str | float | int:
    """The value as its column or the schema has it. Whole numbers beyond 64 bits are compared as floats."""
    if scalar.kind == "string":
        return text
    if scalar.kind == "boolean":
        if text not in ("true", "false"):
            raise WrongQueryError(parameter, text, "must be true or false")
        return int(text == "true")
    try:
        if scalar.kind == "integer" and re.fullmatch(r"[+-]?[0-9]{1,18}", text):
            return int(text)
        number = float(text)
    except ValueError:
        number = _seconds(text) if scalar.kind == "time" else math.nan
    if not math.isfinite(number):
        word = "a time, ISO 8601 or seconds since 1970" if scalar.kind == "time" else "a finite number"
        raise WrongQueryError(parameter, text, f"must be {word}")
    return number


def _seconds(text: str) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        return math.nan


# --- order and place --------------------------------------------------------------------------------------


def _order(by: str) -> Scalar | None:
    """The scalar to order by; None for the order of submission, which `created` is."""
    key = by.removeprefix("-")
    return None if key == "created" else find(key, "order")


def _limit(text: str) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", text) or not 1 <= int(text) <= LARGEST_PAGE:
        raise WrongQueryError("limit", text, f"must be a whole number from 1 to {LARGEST_PAGE}")
    return int(text)


def cursor(selection: Selection, last: Job, value: Any) -> str:
    """Where the next page begins: after this job, whose value in the order is given."""
    place = json.dumps([selection.by, last.seq, value], separators=(",", ":"))
    return base64.urlsafe_b64encode(place.encode()).decode().rstrip("=")


def _after(text: str, by: str, scalar: Scalar | None, at: sa.ColumnElement[Any]) -> Condition:
    """Jobs that come after the cursor's. NULL is the smallest value, as SQLite orders it."""
    try:
        place = json.loads(base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True))
        ordered, seq, value = place
        good = ordered == by and type(seq) is int and abs(seq) < 2**63 and isinstance(value, str | int | float | None)
    except (binascii.Error, ValueError, TypeError, RecursionError):
        good = False
    if not good:
        raise WrongQueryError("cursor", text, f"must come from the page before, with the same order ({by})")
    descending = by.startswith("-")
    later: Condition = at < seq if descending else at > seq
    if scalar is None:
        return later
    e = scalar.sql
    if value is None:
        tied: Condition = e.is_(None) & later
        return tied if descending else tied | e.is_not(None)
    wide = isinstance(value, int) and abs(value) >= 2**63
    bound: sa.BindParameter[Any] = sa.bindparam(None, float(value) if wide else value)
    tied = (e == bound) & later
    after: Condition = (e < bound) | e.is_(None) | tied if descending else (e > bound) | tied
    return after
