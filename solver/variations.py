"""Cases that have most of their tables in common: each distinct table is validated and written out once."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

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

MOST = 500  # tables that are remembered before all are forgotten: those that come back soon are worth it


class Texts(NamedTuple):
    """A table as canonical JSON: all of it, and what changes the result."""

    tree: str
    essence: str


class Variations:
    """Reads trees as `parse_case` does, to equal cases and equal refusals.

    A table that is the same object as in an earlier tree is not looked at again: leave what was passed in unchanged.
    Memos go by `id`, and keep what has it alive.
    """

    def __init__(self, base: Path | None = None) -> None:
        """Relative paths start from `base`."""
        self.base = base
        self._whole: tuple[Mapping[str, Any], Case] | None = None  # the last tree that was read whole
        self._finished: dict[tuple[str, int], tuple[object, Table]] = {}  # by name and plain table
        self._outputs: dict[tuple[Any, ...], tuple[object, Output]] = {}  # by plain table and what defaults rest on
        self._agreed: dict[tuple[int, int], tuple[Table, Table]] = {}  # domain and particles that fit
        self._written: dict[int, tuple[Table, Texts]] = {}  # by finished table

    def case(self, tree: Mapping[str, Any]) -> Case:
        """The case in a tree of plain values. Raises `CaseError`."""
        if len(self._finished) > MOST:
            for memo in (self._finished, self._outputs, self._agreed, self._written):
                memo.clear()
        if (case := self._assembled(tree)) is None:
            case = parse_case(tree, self.base)
            self._whole = tree, case
            for key in TABLES & tree.keys():
                self._finished[key, id(tree[key])] = tree[key], getattr(case, key)
        self._agreed[id(case.domain), id(case.particles)] = case.domain, case.particles
        return case

    def _assembled(self, tree: Mapping[str, Any]) -> Case | None:
        """The case put together from finished tables, where that is possible and nothing is wrong with it."""
        whole = self._whole
        if whole is None or tree.keys() != whole[0].keys() or tree.get("name") is not whole[0].get("name"):
            return None
        try:
            tables: dict[str, Any] = {key: self._table(key, tree[key]) for key in TABLES & tree.keys()}
            if None in tables.values():
                return None
            domain, particles = tables["domain"], tables["particles"]
            agreed = (id(domain), id(particles)) in self._agreed
            if not agreed and any(wrong_dimensions(particles, len(domain.size))):
                return None
            output = self._output(tree.get("output"), tables["time"].end, domain, particles)
        except ValidationError:
            return None
        if output is None:
            return None
        case = whole[1].model_copy(update={**tables, "output": output})
        return None if any(disagreements(case, agreed)) else case

    def _table(self, name: str, plain: object) -> Table | None:
        """The finished table; None where it names a file, which has to be found or read."""
        if (seen := self._finished.get((name, id(plain)))) is not None:
            return seen[1]
        table = CLASSES[name].model_validate(plain)
        if vars(table).get("path") is not None:
            return None
        self._finished[name, id(plain)] = plain, table
        return table

    def _output(self, plain: object, end: float, domain: Domain, particles: Particles) -> Output | None:
        """The finished table; None where its box has other dimensions than the domain."""
        key = id(plain), end, domain.size, particles.container or id(particles)
        if (seen := self._outputs.get(key)) is None:
            filled = filled_in(plain if isinstance(plain, Mapping) else {}, end, domain, particles)
            output = Output.model_validate(filled)
            if any(wrong_dimensions(output, len(domain.size))):
                return None
            seen = self._outputs[key] = (plain, particles), output
        return seen[1]

    def texts(self, case: Case) -> dict[str, Texts]:
        """Every table of a case as JSON."""
        return {name: self._texts(table) for name, table in case.tables().items()}

    def _texts(self, table: Table) -> Texts:
        if (known := self._written.get(id(table))) is None:
            known = self._written[id(table)] = table, written(table)
        return known[1]


CLASSES: dict[str, type[Table]] = {
    name: table
    for name, field in Case.model_fields.items()
    if isinstance(table := field.annotation, type) and issubclass(table, Table)
}
TABLES = CLASSES.keys() - {"output"}  # its defaults come from the others


def written(table: Table) -> Texts:
    """The texts of one table."""
    tree = table.tree()
    essence = table.essence(tree)
    text = canonical(tree)
    return Texts(text, text if essence is tree else canonical(essence))


def case_text(name: str, texts: Mapping[str, Texts]) -> str:
    """The tree of a case of this name as JSON in one line."""
    tables = [f'"{key}": {text.tree}' for key, text in texts.items()]
    return "{" + ", ".join([f'"name": {json.dumps(name)}', *tables]) + "}"


def identity(texts: Mapping[str, Texts]) -> str:
    """`Case.identity` of the case that has these tables."""
    return fingerprint({key: text.essence for key, text in texts.items()})
