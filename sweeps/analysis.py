"""Results from a data folder, read-only and without a server: a table, histories, snapshots."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frit.solver.arrays import Array

from .plots import read_history

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

SAME_TIME = 1e-9  # relative: history times nearer than this are one


@dataclass(frozen=True)
class Run:
    """A run directory."""

    directory: Path

    @property
    def job(self) -> str:
        """Its name, which is the id of the job."""
        return self.directory.name

    @cached_property
    def case(self) -> dict[str, Any]:
        """The resolved case as plain values."""
        return _read_json(self.directory / "case.json")

    @cached_property
    def record(self) -> dict[str, Any]:
        """run.json: versions, host, ranks, seeds, start and end, state; empty before the solver has started."""
        path = self.directory / "run.json"
        return _read_json(path) if path.exists() else {}

    @cached_property
    def history(self) -> dict[str, Array]:
        """Scalar columns of the history by name; empty before the first row."""
        return read_history(self.directory)

    def snapshots(self) -> "xr.Dataset":
        """Fields at the snapshot times; values are read when they are used. FileNotFoundError where there are none."""
        import xarray as xr

        return xr.open_dataset(self.directory / "snapshots.zarr", engine="zarr", chunks=None)

    def row(self) -> dict[str, Any]:
        """Job, name, what run.json tells in a word, every scalar of the case, what its packing realised, the last row
        of the history.
        """
        told = {key: self.record.get(key) for key in ("state", "ranks", "revision")}
        about = {"job": self.job, "name": self.case["name"]} | told
        scalars = {
            _column(table, key): value
            for table, values in self.case.items()
            if isinstance(values, dict)
            for key, value in values.items()
            if isinstance(value, str | int | float)
        }
        packing = self.record.get("packing") or {}
        realised = {f"realised_{key}": value for key, value in packing.items() if isinstance(value, str | int | float)}
        return about | scalars | realised | {key: column[-1] for key, column in self.history.items()}


def _read_json(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


# Names that stand for more than one key of a case, or for something of the history or the run as well.
TAKEN = {"job", "name", "state", "ranks", "time", "step", "particles"}


@cache
def _names() -> dict[tuple[str, str], str]:
    from frit.solver.case import Case  # takes a while to import

    tables = {name: field.annotation for name, field in Case.model_fields.items()}
    keys = [(name, key) for name, table in tables.items() for key in getattr(table, "model_fields", ())]
    often = Counter(key for _, key in keys)
    return {(name, key): key if often[key] == 1 and key not in TAKEN else f"{name}_{key}" for name, key in keys}


def _column(table: str, key: str) -> str:
    """The key alone where only one table has it, else table_key: `mean_radius`, but `time_tolerance`."""
    return _names().get((table, key), f"{table}_{key}")


class Results(Sequence[Run]):
    """Runs, by number or in a loop; a query gives fewer of them."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self._runs = tuple(runs)

    def __len__(self) -> int:
        return len(self._runs)

    def __iter__(self) -> Iterator[Run]:
        return iter(self._runs)

    def __getitem__(self, number: Any) -> Any:
        """A run, or with a slice some of them."""
        found = self._runs[number]
        return Results(found) if isinstance(number, slice) else found

    def __repr__(self) -> str:
        return f"<{len(self)} runs>"

    def table(self) -> "pd.DataFrame":
        """A row per job; the index is its id. Columns as `Run.row`, empty where a run has none."""
        import pandas as pd

        rows = [run.row() for run in self]
        columns = list(dict.fromkeys(key for row in rows for key in row)) or ["job"]
        return pd.DataFrame(rows, columns=columns).set_index("job")

    def query(self, expression: str) -> "Results":
        """The runs whose row fits an expression of pandas: "mean_radius > 9 and packing_density == 0.65"."""
        found = set(self.table().query(expression).index)
        return Results([run for run in self if run.job in found])

    def histories(self, times: Sequence[float] | Array | None = None) -> "xr.Dataset":
        """Scalar columns of the histories, dimensions (job, time).

        On `times` they are interpolated linearly, NaN outside of a run; else time has every time that any run has,
        and a run is NaN at times of others.
        """
        import xarray as xr

        asked = times is not None
        grid = np.unique(np.asarray(times, float)) if asked else _merged([run.history for run in self])
        names = dict.fromkeys(key for run in self for key in run.history if key != "time")
        columns = {
            name: (("job", "time"), np.array([_on(grid, run.history, name, asked) for run in self])) for name in names
        }
        jobs = [run.job for run in self]
        titles = ("job", [run.case["name"] for run in self])
        return xr.Dataset(columns, {"job": jobs, "time": grid, "name": titles})


def _merged(histories: Sequence[dict[str, Array]]) -> Array:
    """All times, each once."""
    every = np.unique(np.concatenate([np.empty(0), *(h["time"] for h in histories if "time" in h)]))
    apart = np.diff(every, prepend=-np.inf) > SAME_TIME * np.maximum(np.abs(every), SAME_TIME)
    return np.asarray(every[apart])


def _on(grid: Array, history: dict[str, Array], name: str, between: bool) -> Array:
    values = np.full(grid.shape, np.nan)
    if name not in history:
        return values
    time, column = history["time"], history[name]
    if between:
        return np.interp(grid, time, column, left=np.nan, right=np.nan)
    at = np.searchsorted(grid, time * (1 + SAME_TIME), side="right") - 1
    values[at] = column
    return values


def open_results(folder: Path | str) -> Results:
    """The runs of a data folder, in the order of their names. Raises FileNotFoundError for another folder."""
    runs = Path(folder) / "runs"
    if not runs.is_dir():
        raise FileNotFoundError(f"{folder} has no folder `runs`: it is not the data of frit")
    return Results([Run(path.parent) for path in sorted(runs.glob("*/case.json"))])
