"""Results of a service, over HTTP: jobs page by page, histories of many jobs at once."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from frit.solver.arrays import Array

from .analysis import QueryError, Run, no_sweep

if TYPE_CHECKING:
    import xarray as xr

PAGE = 500  # jobs
TOGETHER = 100  # histories in one answer
ROWS = 100_000  # of all histories in one answer
LONGEST = 10_000  # rows of one history: of longer ones as many, spread evenly


@dataclass(eq=False)
class Remote(Run):
    """A job of a service."""

    data: dict[str, Any]
    url: str
    rows: list[dict[str, Any]] | None = field(default=None, repr=False)
    first_and_last: list[dict[str, Any]] | None = field(default=None, repr=False)

    @property
    def job(self) -> str:
        """See `Run`."""
        return str(self.data["id"])

    @property
    def name(self) -> str:
        """See `Run`."""
        return str(self.data["name"])

    @property
    def record(self) -> dict[str, Any]:
        """See `Run`; the state is that of the job."""
        result = self.data["result"]
        told = {key: self.data[key] for key in ("state", "ranks", "message")}
        return {**told, "revision": result.get("revision"), "packing": result.get("packing")}

    @property
    def parameters(self) -> dict[str, Any]:
        """See `Run`."""
        found = self.data["parameters"]
        return {key: value for key, value in found.items() if "." in key and isinstance(value, str | int | float)}

    @property
    def history(self) -> dict[str, Array]:
        """See `Run`; `Results` asks for many at once."""
        rows = self.rows or []
        keys = dict.fromkeys(key for row in rows for key, value in row.items() if isinstance(value, int | float))
        return {key: np.array([np.nan if row.get(key) is None else row[key] for row in rows]) for key in keys}

    def ends(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """See `Run`."""
        rows = self.rows if self.rows is not None else self.first_and_last or []
        scalars = [{k: v for k, v in row.items() if isinstance(v, int | float)} for row in rows]
        return (scalars[0], scalars[-1]) if scalars else ({}, {})

    def snapshots(self) -> "xr.Dataset":
        """See `Run`."""
        import xarray as xr

        found: xr.Dataset = xr.open_zarr(f"{self.url}{self.data['links']['zarr']}", chunks=None)
        return found


class Service:
    """What answers at a URL; see `analysis.Source`."""

    def __init__(self, url: str, token: str | None = None) -> None:
        """token: default: FRIT_TOKEN."""
        import httpx2

        token = token or os.environ.get("FRIT_TOKEN")
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self.url = url.rstrip("/")
        alone = httpx2.Limits(max_keepalive_connections=0)  # nobody closes this: no connection outlives its answer
        self._http = httpx2.Client(base_url=self.url, headers=headers, timeout=60.0, limits=alone)

    def _get(self, path: str, **parameters: Any) -> dict[str, Any]:
        response = self._http.get(path, params=parameters or None)
        if response.is_error:
            try:
                words = response.json()["detail"]
            except (ValueError, LookupError, TypeError):
                words = response.reason_phrase
            kind = FileNotFoundError if response.status_code == 404 else QueryError
            raise kind(f"{self.url}: {words}")
        found: dict[str, Any] = response.json()
        return found

    def _jobs(self, **filters: Any) -> list[dict[str, Any]]:
        page = self._get("/v1/jobs", limit=PAGE, order="created", **filters)
        found: list[dict[str, Any]] = page["jobs"]
        while page["next"] is not None:
            page = self._get(page["next"])
            found += page["jobs"]
        return found

    def runs(self) -> list[Run]:
        """Of all jobs that may be seen, the oldest first."""
        return [Remote(job, self.url) for job in self._jobs()]

    def sweep(self, name: str) -> list[str]:
        """See `analysis.Source`."""
        try:
            return [job["id"] for job in self._jobs(sweep=name)]
        except FileNotFoundError:
            page = self._get("/v1/sweeps", limit=PAGE)
            raise QueryError(no_sweep(name, [sweep["name"] for sweep in page["sweeps"]])) from None

    def prepare(self, runs: Sequence[Run], ends: bool = False) -> None:
        """Fetch what is missing of their histories, many in one request."""
        missing = [run for run in runs if isinstance(run, Remote) and run.rows is None]
        if ends:
            missing = [run for run in missing if run.first_and_last is None]
        rows = 2 if ends else LONGEST
        many = min(TOGETHER, ROWS // rows)
        for k in range(0, len(missing), many):
            part = missing[k : k + many]
            answer = self._get("/v1/histories", id=",".join(run.job for run in part), rows=rows)
            for run, found in zip(part, answer["histories"], strict=True):
                if ends:
                    run.first_and_last = found["rows"]
                else:
                    run.rows = found["rows"]
