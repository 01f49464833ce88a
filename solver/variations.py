"""Cases that have most of their tables in common: each distinct value is validated and written out once."""

import json
from collections.abc import Callable, Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast, get_type_hints

from pydantic import TypeAdapter, ValidationError

from .case import (
    Case,
    Domain,
    Output,
    Particles,
    Table,
    canonical,
    disagreements,
    filled_in,
    fingerprint,
    parse_case,
    wrong_dimensions,
)

PLAIN = (float, int, bool, str, tuple, list)  # types of values that are written as they are, once they are checked
Pattern = str  # for %
T = TypeVar("T", bound=Table)
MOST = 500  # tables that are remembered before all are forgotten: those that come back soon are worth it


class Texts(NamedTuple):
    """A table as canonical JSON: all of it, and what changes the result."""

    tree: str
    essence: str


class Kin:
    """A finished table and its plain form; others that differ from it in fields that stand alone are made from it."""

    def __init__(self, plain: Mapping[str, Any], table: Table) -> None:
        self.plain, self.table = plain, table
        self._trees = trees(table)
        self._patterns: dict[tuple[str, ...], tuple[Pattern, ...]] = {}

    def changes(self, plain: object) -> dict[str, Any] | None:
        """What is different in another plain table; None where that does not stand alone."""
        mine = self.plain
        if type(plain) is not dict or plain.keys() != mine.keys():
            return None
        changes = {key: value for key, value in plain.items() if value is not mine[key]}
        for key, value in changes.items():
            if key not in self.table.alone or type(value) not in PLAIN or mine[key] is None:
                return None
        return changes

    def changed(self, changes: Mapping[str, Any]) -> tuple[Table, Texts]:
        """The finished table with other values in some fields. Raises `ValidationError`."""
        checks = _fields(type(self.table))
        values = {key: checks[key](value) for key, value in changes.items()}
        if (patterns := self._patterns.get(keys := tuple(values))) is None:
            patterns = self._patterns[keys] = tuple(pattern(tree, keys) for tree in self._trees)
        new = {key: text_of(value) for key, value in values.items()}
        text, *essence = [form % new for form in patterns]
        return like(self.table, values), Texts(text, *(essence or [text]))


def like(table: T, values: Mapping[str, Any]) -> T:
    """A copy with other values, which are right: what `model_copy` does at a fourth of the time."""
    new = object.__new__(type(table))
    for name, value in (
        ("__dict__", {**table.__dict__, **values}), ("__pydantic_fields_set__", table.__pydantic_fields_set__),
        ("__pydantic_extra__", None), ("__pydantic_private__", None),
    ):  # fmt: skip
        object.__setattr__(new, name, value)
    return new


@cache
def _fields(table: type[Table]) -> dict[str, Callable[[Any], Any]]:
    """Of each field that stands alone, the validator."""
    hints = get_type_hints(table, include_extras=True)
    return {name: TypeAdapter(hints[name]).validator.validate_python for name in table.alone}


def text_of(value: Any) -> str:
    """The canonical text of a checked value."""
    if type(value) is float:
        return repr(value)
    if type(value) is tuple and all(type(part) is float for part in value):
        return f"[{', '.join(map(repr, value))}]"
    return canonical(value)


def pattern(tree: Mapping[str, Any], keys: Collection[str]) -> Pattern:
    """The canonical text of a tree with gaps, `%(key)s`, for the values of some keys."""
    texts = {key: f"%({key})s" if key in keys else canonical(tree[key]).replace("%", "%%") for key in sorted(tree)}
    return "{" + ", ".join([f'"{key}": {text}' for key, text in texts.items()]) + "}"


class Variations:
    """Reads trees as `parse_case` does, to equal cases and equal refusals.

    A table that is the same object as in an earlier tree is not looked at again: leave what was passed in unchanged.
    Of one that differs from an earlier one in fields that stand alone, only these are. Memos go by `id`, and keep what
    has it alive.
    """

    def __init__(self, base: Path | None = None) -> None:
        """Relative paths start from `base`."""
        self.base = base
        self._whole: tuple[Mapping[str, Any], Case] | None = None  # the last tree that was read whole
        self._kin: dict[str, Kin] = {}  # by name: a table that others may be like
        self._finished: dict[tuple[str, int], tuple[object, Table]] = {}  # by name and plain table
        self._outputs: dict[tuple[Any, ...], tuple[object, Output]] = {}  # by plain table and what defaults rest on
        self._boxes: dict[tuple[Any, ...], tuple[object, Any]] = {}  # by domain and container: the default
        self._agreed: dict[tuple[int, ...], object] = {}  # domain, particles and output that fit
        self._written: dict[int, tuple[Table, Texts]] = {}  # by finished table

    def case(self, tree: Mapping[str, Any]) -> Case:
        """The case in a tree of plain values. Raises `CaseError`."""
        if len(self._finished) > MOST:
            for memo in (self._finished, self._outputs, self._boxes, self._agreed, self._written):
                memo.clear()
        if (case := self._assembled(tree)) is None:
            case = parse_case(tree, self.base)
            self._whole = tree, case
            for key in TABLES & tree.keys():
                self._finished[key, id(tree[key])] = tree[key], getattr(case, key)
            self._agreed[agreement(case)] = case
        return case

    def _assembled(self, tree: Mapping[str, Any]) -> Case | None:
        """The case put together from finished tables, where that is possible and nothing is wrong with it."""
        whole = self._whole
        if whole is None or tree.keys() != whole[0].keys() or tree.get("name") is not whole[0].get("name"):
            return None
        try:
            tables: dict[str, Any] = {key: self._table(key, tree[key]) for key in tree if key in TABLES}
            if None in tables.values():
                return None
            if (output := self._output(tree.get("output"), tables)) is None:
                return None
            tables["output"] = output
        except ValidationError:
            return None
        case = like(whole[1], tables)
        agreed = (key := agreement(case)) in self._agreed
        if not agreed and any(any(wrong_dimensions(table, case.dim)) for table in (case.particles, case.output)):
            return None
        if any(disagreements(case, agreed)):
            return None
        self._agreed[key] = case
        return case

    def _table(self, name: str, plain: object) -> Table | None:
        """The finished table; None where it names a file, which has to be found or read."""
        if (seen := self._finished.get((name, id(plain)))) is not None:
            return seen[1]
        table = self._like(name, plain)
        if table is None:
            table = CLASSES[name].model_validate(plain)
            if vars(table).get("path") is not None:
                return None
            self._remember(name, plain, table)
        self._finished[name, id(plain)] = plain, table
        return table

    def _like(self, name: str, plain: object) -> Table | None:
        """The finished table made from an earlier one, where that is possible."""
        kin = self._kin.get(name)
        if kin is None or (changes := kin.changes(plain)) is None:
            return None
        table, texts = kin.changed(changes)
        self._written[id(table)] = table, texts
        return table

    def _remember(self, name: str, plain: object, table: Table) -> None:
        if isinstance(plain, dict):
            self._kin[name] = Kin(plain, table)

    def _output(self, plain: object, tables: Mapping[str, Any]) -> Output | None:
        """The finished table; None where its default box has no sense."""
        end, domain, particles = tables["time"].end, tables["domain"], tables["particles"]
        key = id(plain), end, domain.size, particles.container or id(particles)
        if (seen := self._outputs.get(key)) is None:
            given = {**plain} if isinstance(plain, Mapping) else {}
            if given.get("vacancy_box") is None:
                given["vacancy_box"] = self._box(domain, particles)
            if given["vacancy_box"] is None:
                return None
            filled = filled_in(given, end, domain, particles)
            output = self._like("output", filled)
            if output is None:
                output = Output.model_validate(filled)
                self._remember("output", filled, output)
            seen = self._outputs[key] = (plain, particles), cast("Output", output)
        return seen[1]

    def _box(self, domain: Domain, particles: Particles) -> Any:
        """The default of `output.vacancy_box`, the same object for the same container; None: of other dimensions."""
        key = domain.size, particles.container or id(particles)
        if (seen := self._boxes.get(key)) is None:
            if any(wrong_dimensions(particles, len(domain.size))):
                return None
            seen = self._boxes[key] = particles, filled_in({}, 1.0, domain, particles)["vacancy_box"]
        return seen[1]

    def texts(self, case: Case) -> dict[str, Texts]:
        """Every table of a case as JSON."""
        return {name: self._texts(table) for name, table in vars(case).items() if name != "name"}

    def _texts(self, table: Table) -> Texts:
        if (known := self._written.get(id(table))) is None:
            known = self._written[id(table)] = table, written(table)
        return known[1]


def agreement(case: Case) -> tuple[int, ...]:
    """What tells a case's geometry: the tuples of numbers that have to fit each other, by `id`."""
    given = case.particles
    parts = (case.domain, given.centres, given.radii, given.sizes, given.container, case.output.vacancy_box)
    return tuple([id(part) for part in parts])


CLASSES: dict[str, type[Table]] = {
    name: table
    for name, field in Case.model_fields.items()
    if isinstance(table := field.annotation, type) and issubclass(table, Table)
}
TABLES = CLASSES.keys() - {"output"}  # its defaults come from the others


def trees(table: Table) -> tuple[dict[str, Any], ...]:
    """The tree of a table, and its essence where that is another."""
    tree = table.tree()
    essence = table.essence(tree)
    return (tree,) if essence is tree else (tree, essence)


def written(table: Table) -> Texts:
    """The texts of one table."""
    text, *essence = map(canonical, trees(table))
    return Texts(text, *(essence or [text]))


def case_text(name: str, texts: Mapping[str, Texts]) -> str:
    """The tree of a case of this name as JSON in one line."""
    tables = [f'"{key}": {text.tree}' for key, text in texts.items()]
    return "{" + ", ".join([f'"name": {json.dumps(name)}', *tables]) + "}"


def identity(texts: Mapping[str, Texts]) -> str:
    """`Case.identity` of the case that has these tables."""
    return fingerprint({key: text.essence for key, text in texts.items()})
