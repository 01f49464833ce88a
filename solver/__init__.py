"""What runs one case. From Python: `simulate` takes a case and gives arrays, `measure` looks at a state of it; ranks of
a parallel run are `__main__`. What is here is imported when it is asked for: `import frit.solver` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .case import Case, CaseError, load_case, parse_case
    from .door import Moment, Result, SimulationError, Snapshots, measure, simulate

__all__ = [
    "Case", "CaseError", "Moment", "Result", "SimulationError", "Snapshots", "load_case", "measure", "parse_case",
    "simulate",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = "case" if name in ("Case", "CaseError", "load_case", "parse_case") else "door"
    return getattr(import_module(f".{home}", __name__), name)
