"""`frit pack`: the solver packs in a process of its own; here its report becomes tables and a picture."""

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from ..jobs.launch import clean_environment

BAR = 30  # characters


class PackRefusedError(ValueError):
    """The case cannot be packed; the message has a line per problem."""


def pack(case: Path, out: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Pack the particles of a case into a CSV; the solver's report (see frit.solver.pack)."""
    command = [sys.executable, "-P", "-m", "frit.solver.pack", str(case), "--out", str(out)]
    ended = subprocess.run(command, capture_output=True, text=True, env=clean_environment(environment), check=False)
    if ended.returncode:
        raise PackRefusedError(ended.stderr.strip() or f"the solver ended with {ended.returncode}")
    found: dict[str, Any] = json.loads(ended.stdout)
    return found


def draw(particles: Path, report: dict[str, Any], title: str, out: Path) -> None:
    """The picture."""
    from frit.sweeps.packing_plots import plot_packing

    plot_packing(particles, np.array(report["container"]), title, out)


def tables(report: dict[str, Any]) -> Iterator[Table]:
    """What was realised; distribution of the radii; solid fraction by height; number of contacts."""
    yield _table(("realised", ""), [(key.replace("_", " "), _shown(v)) for key, v in report["packing"].items()])
    radii, profile = report["radii"], report["profile"]
    edges = [f"{a:.4g} - {b:.4g}" for a, b in zip(radii["edges"][:-1], radii["edges"][1:], strict=True)]
    yield _bars(("radius, nm", "particles"), edges, radii["counts"], "d")
    heights = [f"{height:.4g}" for height in reversed(profile["height"])]
    yield _bars(("height, nm", "solid fraction"), heights, list(reversed(profile["solid_fraction"])), ".3f")
    contacts = report["coordination"]
    yield _bars(("contacts", "particles"), [str(count) for count in range(len(contacts))], contacts, "d")


def _shown(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


def _bars(head: tuple[str, str], names: Sequence[str], values: Sequence[float], form: str) -> Table:
    unit = BAR / max(max(values), 1e-12)
    rows = [(name, format(value, form), "█" * round(value * unit)) for name, value in zip(names, values, strict=True)]
    return _table((*head, ""), rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column, name in enumerate(head):
        table.add_column(name, justify="right" if column == 1 and len(head) == 3 else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table
