"""Cases as trees, to be changed key by key, and the tables they are made of."""

import copy
from collections.abc import Mapping
from typing import Any

from frit.solver.case import Table

Tree = dict[str, Any]


def minimal() -> Tree:
    """Only what has no default."""
    return {
        "domain": {"size": [100, 60]},
        "nodes": {"spacing": 1},
        "particles": {"centres": [[30, 30], [70, 30]], "radii": [20, 20]},
        "time": {"end": 10},
    }


def altered(changes: Mapping[str, Any]) -> Tree:
    """The minimal case with dotted keys set; None takes the key away."""
    tree = minimal()
    for key, value in changes.items():
        *tables, last = key.split(".")
        table = tree
        for name in tables:
            table = table.setdefault(name, {})
        table[last] = copy.deepcopy(value)
        if value is None:
            del table[last]
    return tree


def tables(table: type[Table] = Table) -> list[type[Table]]:
    return [sub for direct in table.__subclasses__() for sub in (direct, *tables(direct))]
