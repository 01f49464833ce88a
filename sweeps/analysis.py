"""Results of a data folder, read-only and without a server, or of a service: a table, histories, groups, snapshots."""

import difflib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from frit.solver.arrays import Array
from frit.solver.ended import read_run

from .plots import read_history
from .ranking import Outcome, Ranking, rank

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

SAME_TIME = 1e-9  # relative: history times nearer than this are one


class QueryError(ValueError):
    """A query that means nothing; of a wrong name the message has the nearest ones."""


class Run:
    """A job as its results have it. Where they are kept is up to the two kinds of it, `Folder` and `remote.Remote`."""

    @property
    def job(self) -> str:
        """Its id, which is the name of its run directory."""
        raise NotImplementedError

    @property
    def name(self) -> str:
        """What its owner calls it."""
        raise NotImplementedError

    @property
    def record(self) -> Mapping[str, Any]:
        """run.json: `state` (running, succeeded, failed, interrupted, refused), ranks, revision, packing, message."""
        raise NotImplementedError

    @property
    def parameters(self) -> dict[str, Any]:
        """Scalars of the case by dotted key."""
        raise NotImplementedError

    @property
    def history(self) -> dict[str, Array]:
        """Scalar columns of the history by name; empty before the first row."""
        raise NotImplementedError

    def ends(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The first and the last row of the history; empty before there is one."""
        first, last = ({key: column[k] for key, column in self.history.items()} for k in (0, -1))
        return first, last

    def snapshots(self) -> "xr.Dataset":
        """Fields at the snapshot times; values are read when they are used. FileNotFoundError where there are none."""
        raise NotImplementedError

    def row(self) -> dict[str, Any]:
        """Job, name, what run.json tells in a word, every scalar of the case, what its packing realised, the first
        vacancy ratio, the last row of the history.
        """
        told = {key: self.record.get(key) for key in ("state", "ranks", "revision")}
        about = {"job": self.job, "name": self.name} | told
        packing = self.record.get("packing") or {}
        realised = {f"realised_{key}": value for key, value in packing.items() if isinstance(value, str | int | float)}
        first, last = self.ends()
        start = {"vacancy_ratio_start": first["vacancy_ratio"]} if "vacancy_ratio" in first else {}
        return about | self.columns() | realised | start | last

    def columns(self) -> dict[str, Any]:
        """Scalars of the case by the names of a table's columns."""
        return {_column(key): value for key, value in self.parameters.items()}

    def outcome(self, observable: str) -> Outcome:
        """As a ranking takes it."""
        history = self.history
        time, values = (history.get(key, np.empty(0)).tolist() for key in ("time", observable))
        own = {key: value for key, value in self.parameters.items() if not key.startswith("output.")}
        porosity = self.ends()[1].get("pack_porosity")
        state, message = str(self.record.get("state", "queued")), self.record.get("message")
        return Outcome(self.job, self.name, state, own, time, values, porosity, message)


@dataclass(frozen=True)
class Folder(Run):
    """A run directory."""

    directory: Path

    @property
    def job(self) -> str:
        """See `Run`."""
        return self.directory.name

    @property
    def name(self) -> str:
        """See `Run`."""
        return str(self.case["name"])

    @cached_property
    def case(self) -> dict[str, Any]:
        """The resolved case as plain values."""
        return _read_json(self.directory / "case.json")

    @cached_property
    def record(self) -> dict[str, Any]:
        """See `Run`; empty before the solver has started."""
        return read_run(self.directory)

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """See `Run`."""
        return {
            f"{table}.{key}": value
            for table, values in self.case.items() if isinstance(values, dict)
            for key, value in values.items() if isinstance(value, str | int | float)
        }  # fmt: skip

    @cached_property
    def history(self) -> dict[str, Array]:
        """See `Run`."""
        return read_history(self.directory)

    def snapshots(self) -> "xr.Dataset":
        """See `Run`."""
        import xarray as xr

        return xr.open_dataset(self.directory / "snapshots.zarr", engine="zarr", chunks=None)


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


def _column(dotted: str) -> str:
    """The key alone where only one table has it, else table_key: `mean_radius`, but `time_tolerance`."""
    table, _, key = dotted.partition(".")
    return _names().get((table, key), dotted.replace(".", "_"))


class Results(Sequence[Run]):
    """Runs, by number or in a loop; a query gives fewer of them."""

    def __init__(self, runs: Sequence[Run], source: "Source") -> None:
        """source: where they are, which knows the sweeps."""
        self._runs, self._source = tuple(runs), source

    def __len__(self) -> int:
        return len(self._runs)

    def __iter__(self) -> Iterator[Run]:
        return iter(self._runs)

    def __getitem__(self, number: Any) -> Any:
        """A run, or with a slice some of them."""
        found = self._runs[number]
        return Results(found, self._source) if isinstance(number, slice) else found

    def __repr__(self) -> str:
        return f"<{len(self)} runs>"

    def table(self) -> "pd.DataFrame":
        """A row per job; the index is its id. Columns as `Run.row`, empty where a run has none."""
        import pandas as pd

        self._source.prepare(self, ends=True)
        rows = [run.row() for run in self]
        columns = list(dict.fromkeys(key for row in rows for key in row)) or ["job"]
        return pd.DataFrame(rows, columns=columns).set_index("job")

    def query(self, expression: str | None = None, *, sweep: str | None = None) -> "Results":
        """The runs whose row fits an expression of pandas: "mean_radius > 9 and packing_density == 0.65".

        sweep: those of that id or name (of a name, the newest). Raises `QueryError`.
        """
        runs = self._runs
        if sweep is not None:
            by = {run.job: run for run in self}
            runs = tuple(by[job] for job in self._source.sweep(sweep) if job in by)
        chosen = Results(runs, self._source)
        if expression is None:
            return chosen
        found = set(_asked(chosen.table(), expression).index)
        return Results([run for run in runs if run.job in found], self._source)

    def histories(self, times: Sequence[float] | Array | None = None) -> "xr.Dataset":
        """Scalar columns of the histories, dimensions (job, time); names, states and parameters are coordinates.

        On `times` they are interpolated linearly, NaN outside of a run; else time has every time that any run has,
        and a run is NaN at times of others.
        """
        import pandas as pd
        import xarray as xr

        self._source.prepare(self)
        asked = times is not None
        grid = np.unique(np.asarray(times, float)) if asked else _merged([run.history for run in self])
        names = dict.fromkeys(key for run in self for key in run.history if key != "time")
        columns = {
            name: (("job", "time"), np.array([_on(grid, run.history, name, asked) for run in self])) for name in names
        }
        parameters = pd.DataFrame([run.columns() for run in self])
        told: dict[str, Any] = {"name": [run.name for run in self]}
        told |= {"state": [str(run.record.get("state")) for run in self]}
        taken = {*names, *told, "job", "time"}
        told |= {str(key): parameters[key].to_numpy() for key in parameters if key not in taken}
        places = {key: ("job", values) for key, values in told.items()}
        return xr.Dataset(columns, {"job": [run.job for run in self], "time": grid, **places})

    def ranking(self, observable: str = "vacancy_ratio", reach: float | None = None) -> Ranking:
        """The points, replicates together, the lowest last value first; reach: a value to which times are told."""
        self._source.prepare(self)
        return rank([run.outcome(observable) for run in self], reach)

    def groups(self, observable: str = "vacancy_ratio", reach: float | None = None) -> "pd.DataFrame":
        """A row per point, replicates together: how many `runs`, mean and `_error` (of the mean) of the observable's
        `start`, `final` and `drop`, of the pack's `porosity`, and of the time at which it `reached` a value.

        The index are labels of what differs; a column per parameter of the case that differs. As `ranking` orders them.
        """
        import pandas as pd

        ranking = self.ranking(observable, reach)
        axes = set(ranking.axes)
        rows = [
            {_column(key) if key in axes else key: value for key, value in point.row().items()
             if key in axes or "." not in key}
            for point in ranking.points
        ]  # fmt: skip
        return pd.DataFrame(rows).set_index("label") if rows else pd.DataFrame(index=pd.Index([], name="label"))


def _asked(table: "pd.DataFrame", expression: str) -> "pd.DataFrame":
    """The rows that fit. Raises `QueryError`."""
    from pandas.errors import UndefinedVariableError

    try:
        return table.query(expression)
    except UndefinedVariableError as error:
        name = str(error).split("'")[1]
        known = [str(column) for column in table.columns]
        near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
        near += [column for column in known if name in column and column not in near][:3]
        hint = f"; near: {', '.join(near)}" if near else f"; there are {', '.join(known)}"
        raise QueryError(f"{name}: no column of that name{hint}") from None
    except (SyntaxError, ValueError, TypeError, KeyError) as error:
        raise QueryError(f"{expression}: {error}") from None


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


class Source(Protocol):
    """Where runs are."""

    def sweep(self, name: str) -> list[str]:
        """Ids of the jobs of a sweep, by its id or name. Raises `QueryError`."""

    def prepare(self, runs: Sequence[Run], ends: bool = False) -> None:
        """Their histories are about to be read; ends: the first and the last row alone."""


@dataclass(frozen=True)
class Data:
    """A data folder; its journal tells the sweeps."""

    folder: Path

    def sweep(self, name: str) -> list[str]:
        """See `Source`."""
        jobs: dict[int, str] = {}
        sweeps: dict[int, dict[str, Any]] = {}
        path = self.folder / "submitted.jsonl"
        for text in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else ():
            try:
                line = json.loads(text)
                if line["kind"] == "job":
                    jobs[line["seq"]] = line["id"]
                elif line["kind"] == "sweep":
                    sweeps[line["seq"]] = line
                elif line["kind"] == "gone":
                    (sweeps if line["what"] == "sweep" else jobs).pop(line["seq"], None)
            except (ValueError, LookupError, TypeError):
                continue  # torn by a crash: `frit reindex` tells
        for key in ("id", "name"):
            if found := [sweep for _, sweep in sorted(sweeps.items()) if sweep[key] == name]:
                return [jobs[seq] for seq, _, _ in found[-1]["points"] if seq in jobs]
        raise QueryError(no_sweep(name, [sweep["name"] for sweep in sweeps.values()]))

    def prepare(self, runs: Sequence[Run], ends: bool = False) -> None:
        """Nothing: files are read when they are used."""


def no_sweep(name: str, known: Iterable[str]) -> str:
    """What to say of a name that no sweep has."""
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.4) or names[-5:]
    return f"sweep {name!r}: there is none; {f'near: {near}' if near else 'there are no sweeps here'}"


def open_results(where: Path | str, token: str | None = None) -> Results:
    """The runs of a data folder, in the order of their names, or those of a service at http://... (token: its own).

    Raises FileNotFoundError for another folder.
    """
    if str(where).startswith(("http://", "https://")):
        from .remote import Service

        service = Service(str(where), token)
        return Results(service.runs(), service)
    runs = Path(where) / "runs"
    if not runs.is_dir():
        raise FileNotFoundError(f"{where} has no folder `runs`: it is not the data of frit")
    return Results([Folder(path.parent) for path in sorted(runs.glob("*/case.json"))], Data(Path(where)))
