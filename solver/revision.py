"""The revision of the results: a number that grows when results change beyond tolerance.

A change of the solver after which the same case gives other results adds a line to `CHANGES`, with the cases that it
concerns: results of all others stay what they are. "Computed already" means the same case and the same revision.
"""

from collections.abc import Callable, Mapping
from typing import Any

Tree = Mapping[str, Any]
FIRST = 1  # of what was computed before revisions were recorded


def on_free_nodes(case: Tree) -> bool:
    """Whether maximum-entropy functions stand on nodes that are no lattice."""
    nodes, functions = case["nodes"]["source"], case["shape_functions"]["kind"]
    return bool(nodes in ("gmsh", "file") and functions == "lme")


CHANGES: Mapping[int, Callable[[Tree], bool]] = {
    FIRST: lambda case: True,
    2: on_free_nodes,  # points of their own, one width, projected start
    3: lambda case: bool(case["particles"]["source"] == "packing"),  # the same packing on every processor
    4: lambda case: bool(case["nodes"]["source"] == "lattice"),  # square and cubic; it was triangular before
}
REVISION = max(CHANGES)


def revision_of(case: Tree) -> int:
    """The last revision that changed the results of a resolved case, as a tree of plain values."""
    return max(number for number, concerns in CHANGES.items() if concerns(case))


def recorded(record: Mapping[str, Any]) -> int | None:
    """The revision that a run.json has; None where it is empty: nothing has been computed."""
    return int(record.get("revision", FIRST)) if record else None
