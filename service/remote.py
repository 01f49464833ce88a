"""Jobs and sweeps of a service, as a script holds them."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, ClassVar, Self

if TYPE_CHECKING:
    import pandas as pd

    from .client import Client, Event

Tree = dict[str, Any]
LONGEST_PAUSE = 2.0  # seconds between two looks at a job


@dataclass(frozen=True)
class Snapshot:
    """A complete snapshot: its place along the arrays' first axis, and its model time."""

    number: int
    time: float


class Remote:
    """A job or a sweep as the service last told it; `refresh` asks again."""

    KIND: ClassVar[str]  # in the service's paths

    def __init__(self, client: "Client", data: Tree) -> None:
        self.client, self.data = client, data

    @property
    def id(self) -> str:
        """What the service calls it."""
        return str(self.data["id"])

    @property
    def name(self) -> str:
        """What its owner calls it."""
        return str(self.data["name"])

    @property
    def path(self) -> str:
        """Where the service has it."""
        return f"/v1/{self.KIND}/{self.id}"

    def refresh(self) -> Self:
        """Ask again."""
        self.data = self.client.get(self.path)
        return self

    def cancel(self) -> Self:
        """Ask for its end; of a sweep, for that of all its jobs that have not ended."""
        self.data = self.client.post(f"{self.path}/cancel")
        return self

    def retry(self) -> Self:
        """Queue it again, to go on from its checkpoint; of a sweep, all its jobs that ended without success."""
        self.data = self.client.post(f"{self.path}/retry")
        return self

    def delete(self) -> None:
        """Delete it for good, with all files; of a sweep, also the jobs made with it that no other one refers to."""
        self.client.delete(self.path)


class RemoteJob(Remote):
    """A job."""

    KIND = "jobs"

    def __repr__(self) -> str:
        return f"<job {self.id} {self.name!r}: {self.state}>"

    @property
    def state(self) -> str:
        """queued, starting, running, succeeded, failed, error, cancelled, timed_out or lost."""
        return str(self.data["state"])

    @property
    def final(self) -> bool:
        """Whether nothing more happens by itself."""
        return bool(self.data["final"])

    @property
    def ended(self) -> float | None:
        """When, in seconds since 1970."""
        return None if self.data["ended"] is None else datetime.fromisoformat(self.data["ended"]).timestamp()

    @property
    def message(self) -> str | None:
        """What was said at its end."""
        message: str | None = self.data["message"]
        return message

    @property
    def parameters(self) -> Tree:
        """Every scalar of the case by dotted key."""
        parameters: Tree = self.data["parameters"]
        return parameters

    @property
    def result(self) -> Tree:
        """Scalars of the last history row."""
        result: Tree = self.data["result"]
        return result

    @property
    def zarr_url(self) -> str:
        """What zarr and xarray open: `xarray.open_zarr(job.zarr_url)`."""
        return f"{self.client.url}{self.path}/snapshots.zarr"

    def wait(self, timeout: float | None = None, tell: "Callable[[Self], None]" = lambda _: None) -> Self:
        """Until it is final, whatever it then is: see `state`. Raises `TimeoutError` after that many seconds.

        tell: called after each look, say to show `progress`.
        """
        for _ in looks(timeout, f"job {self.id}"):
            tell(self.refresh())
            if self.final:
                break
        return self

    @property
    def progress(self) -> Tree | None:
        """The last line of progress while it runs."""
        progress: Tree | None = self.data["progress"]
        return progress

    def open_zarr(self, **options: Any) -> Any:
        """The snapshots as an xarray Dataset, lazily read, with the token of the client; options: of `open_zarr`."""
        import xarray

        return xarray.open_zarr(self.zarr_url, storage_options=self.client.storage_options(), **options)

    def history(self) -> "pd.DataFrame":
        """The history rows so far, a column per key."""
        import pandas as pd

        return pd.DataFrame(self.client.request("GET", f"{self.path}/history").json())

    def stream(self) -> "Iterator[Event]":
        """What has happened and happens, up to its end."""
        return self.client.events(f"{self.path}/events")

    def log(self, offset: int = 0) -> str:
        """The solver's log from that byte on."""
        return self.log_bytes(offset).decode(errors="replace")

    def log_bytes(self, offset: int = 0) -> bytes:
        """The same, to be counted: the next offset is the old one and its length."""
        headers = {"Range": f"bytes={offset}-"} if offset else {}
        try:
            response = self.client.request("GET", f"{self.path}/log", headers=headers)
        except self.client.Problem as error:
            if error.status == 416:  # nothing new
                return b""
            raise
        return response.content if response.status_code == 206 or not offset else response.content[offset:]

    def snapshots(self) -> list[Snapshot]:
        """The complete snapshots; their fields are at `zarr_url`."""
        found = self.client.get(f"{self.path}/snapshots")["snapshots"]
        return [Snapshot(row["number"], row["time"]) for row in found]

    def rerun(self) -> "RemoteJob":
        """Queue its case as a new job, from the start."""
        return RemoteJob(self.client, self.client.post(f"{self.path}/rerun"))

    def change(
        self, *, name: str | None = None, priority: int | None = None, tags: Sequence[str] | None = None
    ) -> Self:
        """Give it another name, priority or other tags."""
        changes = {"name": name, "priority": priority, "tags": None if tags is None else list(tags)}
        given = {key: value for key, value in changes.items() if value is not None}
        self.data = self.client.request("PATCH", self.path, json=given).json()
        return self


class RemoteSweep(Remote):
    """A sweep."""

    KIND = "sweeps"

    def __repr__(self) -> str:
        return f"<sweep {self.id} {self.name!r}: {self.states}>"

    @property
    def states(self) -> dict[str, int]:
        """How many of its jobs are in which state."""
        states: dict[str, int] = self.data["states"]
        return states

    def jobs(self, **filters: Any) -> Iterator[RemoteJob]:
        """Its jobs, in the order of their submission."""
        return self.client.jobs(sweep=self.id, **{"order": "created", **filters})

    def wait(self, timeout: float | None = None, tell: "Callable[[Self], None]" = lambda _: None) -> Self:
        """Until every job is final. Raises `TimeoutError` after that many seconds. tell: called after each look."""
        for _ in looks(timeout, f"sweep {self.id}"):
            going = self._unfinished()
            tell(self)
            if not going:
                break
        return self.refresh()

    def _unfinished(self) -> bool:
        going = {"queued", "starting", "running"} & self.refresh().states.keys()
        return bool(going) or any(not job.final for job in self.jobs(state="error,lost"))

    def history(self) -> "pd.DataFrame":
        """The history rows of all its jobs, with a column `job`."""
        import pandas as pd

        tables = [job.history().assign(job=job.id) for job in self.jobs()]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def compare(self, observable: str = "vacancy_ratio", rows: int = 10_000) -> Tree:
        """An observable of all its jobs over time, in at most so many rows, with the parameters that differ."""
        found = self.client.get(f"{self.path}/compare", params={"observable": observable, "rows": rows})
        while (following := found["next"]) is not None:
            page = self.client.get(following)
            found = {**page, "curves": found["curves"] + page["curves"]}
        return found


def looks(timeout: float | None, what: str) -> Iterator[None]:
    """Again and again, with growing pauses. Raises `TimeoutError`."""
    start, pause = time.monotonic(), 0.05
    while True:
        yield
        left = pause if timeout is None else start + timeout - time.monotonic()
        if left <= 0:
            raise TimeoutError(f"{what}: not done after {timeout} s")
        time.sleep(min(pause, left))
        pause = min(1.5 * pause, LONGEST_PAUSE)
