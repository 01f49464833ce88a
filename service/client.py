"""A service from a script: submit, wait, look.

What fails on the way (no connection, a service that restarts or cannot write now) is tried again with the same
idempotency key: nothing is submitted twice.
"""

import base64
import json
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import httpx2

if TYPE_CHECKING:
    import pandas as pd

LONGEST_PAUSE = 2.0  # seconds between two tries, or two looks at a job
QUIET = 60.0  # seconds without a sign of life of a stream before it is opened anew; signs come every 15
PASSING = (502, 503, 504)

Tree = dict[str, Any]
Options = Mapping[str, Any]


class ProblemError(Exception):
    """The service said no; `problem` has its words: type, title, status, detail, and errors with pointers."""

    def __init__(self, problem: Tree) -> None:
        self.problem = problem
        super().__init__(f"{problem.get('title')}: {problem.get('detail')}")

    @property
    def status(self) -> int:
        """Of HTTP."""
        return int(self.problem["status"])


@dataclass(frozen=True)
class Event:
    """Something that happened to a job: `kind` is state, history, progress or end."""

    kind: str
    data: Tree
    id: str


@dataclass(frozen=True)
class Snapshot:
    """A complete snapshot: its place along the arrays' first axis, and its model time."""

    number: int
    time: float


class Client:
    """Speaks to one service; also a context manager."""

    def __init__(
        self, url: str = "http://127.0.0.1:8000", token: str | None = None, *, timeout: float = 30.0,
        patience: float = 60.0,
    ) -> None:  # fmt: skip
        """timeout: seconds for one answer; patience: seconds for which what fails on the way is tried again."""
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self.url, self.patience = url.rstrip("/"), patience
        self._http = httpx2.Client(base_url=self.url, headers=headers, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    # --- submitting ---------------------------------------------------------------------------------------

    def submit(
        self, what: str | Path | Mapping[str, Any], *, ranks: int | None = None, name: str | None = None,
        priority: int | None = None, tags: Sequence[str] | None = None, time_limit: float | None = None,
        recompute: bool = False,
    ) -> "RemoteJob | RemoteSweep":  # fmt: skip
        """Submit a case, or a sweep, which has a base: a TOML or JSON file, or a tree of plain values.

        Mesh and particle files that it names are read here and sent along. time_limit: wall-clock seconds. recompute:
        of a sweep also what an older revision of the solver computed; a case is computed at any rate.
        Raises `CaseError` for what is wrong here already, `ProblemError` for what the service refuses.
        """
        from frit.solver.case import read_tree

        tree = dict(what) if isinstance(what, Mapping) else read_tree(what)
        folder = Path() if isinstance(what, Mapping) else Path(what).parent
        options: Tree = {"ranks": ranks, "name": name, "priority": priority, "time_limit": time_limit}
        given = {key: value for key, value in options.items() if value is not None}
        given |= {} if tags is None else {"tags": list(tags)}
        if isinstance(tree, Mapping) and "base" in tree:
            return self._submit_sweep(tree, folder, given | ({"recompute": True} if recompute else {}))
        return self._submit_case(tree, folder, given)

    def submit_sweep(self, definition: str | Path | Mapping[str, Any], **options: Any) -> "RemoteSweep":
        """As `submit`, of what is a sweep."""
        submitted = self.submit(definition, **options)
        assert isinstance(submitted, RemoteSweep)  # anything else has been refused
        return submitted

    def _submit_case(self, tree: Any, folder: Path, given: Options) -> "RemoteJob":
        from frit.solver.case import parse_case

        case, files = with_files(parse_case(tree, base=folder).tree())
        return RemoteJob(self, self.post("/v1/jobs", {"case": case, "files": files, **given}))

    def _submit_sweep(self, tree: Mapping[str, Any], folder: Path, given: Options) -> "RemoteSweep":
        from frit.sweeps.definition import parse_sweep

        definition, files = with_files(json.loads(parse_sweep(tree, base=folder).resolved_json()))
        return RemoteSweep(self, self.post("/v1/sweeps", {"definition": definition, "files": files, **given}))

    # --- looking ------------------------------------------------------------------------------------------

    def job(self, identifier: str) -> "RemoteJob":
        """A job by its id."""
        return RemoteJob(self, self.get(f"/v1/jobs/{identifier}"))

    def jobs(self, **filters: Any) -> Iterator["RemoteJob"]:
        """Jobs that fit, newest first, page by page as they are used.

        Filters and `order` as in HTTP, with __ in the place of a dot: `jobs(particles__mean_radius__ge=9, tag="a")`.
        """
        for row in self._pages("/v1/jobs", "jobs", filters):
            yield RemoteJob(self, row)

    def sweep(self, identifier: str) -> "RemoteSweep":
        """A sweep by its id or name."""
        return RemoteSweep(self, self.get(f"/v1/sweeps/{identifier}"))

    def sweeps(self) -> Iterator["RemoteSweep"]:
        """Sweeps, newest first."""
        for row in self._pages("/v1/sweeps", "sweeps", {}):
            yield RemoteSweep(self, row)

    def limits(self) -> Tree:
        """What the service allows."""
        return self.get("/v1/limits")

    def _pages(self, path: str, name: str, filters: Options) -> Iterator[Tree]:
        parameters = {key.replace("__", "."): spelled(value) for key, value in filters.items() if value is not None}
        page = self.get(path, params=parameters)
        yield from page[name]
        while page["next"] is not None:
            page = self.get(page["next"])
            yield from page[name]

    # --- requests -----------------------------------------------------------------------------------------

    def get(self, path: str, **options: Any) -> Tree:
        """The JSON of an answer. Raises `ProblemError`, and httpx2's `TransportError` when patience is over."""
        found: Tree = self.request("GET", path, **options).json()
        return found

    def post(self, path: str, body: Tree | None = None) -> Tree:
        """The same of a POST, which counts once however often it is sent."""
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        answer: Tree = self.request("POST", path, json=body, headers=headers).json()
        return answer

    def request(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """A good response; what fails on the way is tried again."""
        for last in self._tries():
            try:
                response = self._http.request(method, path, **options)
            except httpx2.TransportError:
                if last:
                    raise
                continue
            if response.status_code in PASSING and not last:
                continue
            if response.is_error:
                raise ProblemError(problem_of(response))
            return response
        raise AssertionError("the last try returns or raises")

    def _tries(self) -> Iterator[bool]:
        """Whether a try is the last one; pauses double between them."""
        start, pause = time.monotonic(), 0.1
        while time.monotonic() - start < self.patience:
            yield False
            time.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE)
        yield True

    def events(self, path: str) -> Iterator[Event]:
        """Server-sent events up to `end`; a broken stream goes on after the last event that came."""
        last = ""
        while True:
            for final in self._tries():  # anew once it was open
                opened = False
                try:
                    for event in self._stream(path, last):
                        opened = True
                        if event is not None:
                            last = event.id
                            yield event
                            if event.kind == "end":
                                return
                except httpx2.TransportError:
                    if final and not opened:
                        raise
                if opened:
                    break
            time.sleep(0.1)

    def _stream(self, path: str, last: str) -> Iterator[Event | None]:
        """None once it is open, then the events."""
        headers = {"Last-Event-ID": last} if last else {}
        with self._http.sse(path, headers=headers, timeout=httpx2.Timeout(QUIET)) as source:
            if source.response.status_code in PASSING:
                raise httpx2.ReadError("the service is not ready")
            if source.response.is_error:
                source.response.read()
                raise ProblemError(problem_of(source.response))
            yield None
            for event in source:
                yield Event(event.event, json.loads(event.data), event.id or last)


class RemoteJob:
    """A job as the service last told it; `refresh` asks again."""

    def __init__(self, client: Client, data: Tree) -> None:
        self.client, self.data = client, data

    def __repr__(self) -> str:
        return f"<job {self.id} {self.name!r}: {self.state}>"

    @property
    def id(self) -> str:
        """Of the job."""
        return str(self.data["id"])

    @property
    def name(self) -> str:
        """Of the job."""
        return str(self.data["name"])

    @property
    def state(self) -> str:
        """queued, starting, running, succeeded, failed, error, cancelled, timed_out or lost."""
        return str(self.data["state"])

    @property
    def final(self) -> bool:
        """Whether nothing more happens by itself."""
        return bool(self.data["final"])

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
        return f"{self.client.url}/v1/jobs/{self.id}/snapshots.zarr"

    def refresh(self) -> Self:
        """Ask again."""
        self.data = self.client.get(f"/v1/jobs/{self.id}")
        return self

    def wait(self, timeout: float | None = None) -> Self:
        """Until it is final, whatever it then is: see `state`. Raises `TimeoutError` after that many seconds."""
        for _ in looks(timeout, f"job {self.id}"):
            if self.refresh().final:
                break
        return self

    def history(self) -> "pd.DataFrame":
        """The history rows so far, a column per key."""
        import pandas as pd

        return pd.DataFrame(self.client.request("GET", f"/v1/jobs/{self.id}/history").json())

    def stream(self) -> Iterator[Event]:
        """What has happened and happens, up to its end."""
        return self.client.events(f"/v1/jobs/{self.id}/events")

    def log(self, offset: int = 0) -> str:
        """The solver's log from that byte on."""
        return self.log_bytes(offset).decode(errors="replace")

    def log_bytes(self, offset: int = 0) -> bytes:
        """The same, to be counted: the next offset is the old one and its length."""
        headers = {"Range": f"bytes={offset}-"} if offset else {}
        try:
            response = self.client.request("GET", f"/v1/jobs/{self.id}/log", headers=headers)
        except ProblemError as error:
            if error.status == 416:  # nothing new
                return b""
            raise
        return response.content if response.status_code == 206 or not offset else response.content[offset:]

    def snapshots(self) -> list[Snapshot]:
        """The complete snapshots; their fields are at `zarr_url`."""
        found = self.client.get(f"/v1/jobs/{self.id}/snapshots")["snapshots"]
        return [Snapshot(row["number"], row["time"]) for row in found]

    def cancel(self) -> Self:
        """Ask for its end."""
        self.data = self.client.post(f"/v1/jobs/{self.id}/cancel")
        return self

    def retry(self) -> Self:
        """Queue it again."""
        self.data = self.client.post(f"/v1/jobs/{self.id}/retry")
        return self


class RemoteSweep:
    """A sweep as the service last told it; `refresh` asks again."""

    def __init__(self, client: Client, data: Tree) -> None:
        self.client, self.data = client, data

    def __repr__(self) -> str:
        return f"<sweep {self.id} {self.name!r}: {self.states}>"

    @property
    def id(self) -> str:
        """Of the sweep."""
        return str(self.data["id"])

    @property
    def name(self) -> str:
        """Of the sweep."""
        return str(self.data["name"])

    @property
    def states(self) -> dict[str, int]:
        """How many of its jobs are in which state."""
        states: dict[str, int] = self.data["states"]
        return states

    def refresh(self) -> Self:
        """Ask again."""
        self.data = self.client.get(f"/v1/sweeps/{self.id}")
        return self

    def jobs(self, **filters: Any) -> Iterator[RemoteJob]:
        """Its jobs, in the order of their submission."""
        return self.client.jobs(sweep=self.id, **{"order": "created", **filters})

    def wait(self, timeout: float | None = None) -> Self:
        """Until every job is final. Raises `TimeoutError` after that many seconds."""
        for _ in looks(timeout, f"sweep {self.id}"):
            if not self._unfinished():
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

    def compare(self, observable: str = "vacancy_ratio") -> Tree:
        """An observable of all its jobs over time, with the parameters that differ."""
        return self.client.get(f"/v1/sweeps/{self.id}/compare", params={"observable": observable})

    def cancel(self) -> Self:
        """Ask for the end of all its jobs that have not ended."""
        for job in self.jobs(state="queued,starting,running"):
            job.cancel()
        return self.refresh()


# --- helpers ----------------------------------------------------------------------------------------------


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


def spelled(value: Any) -> str:
    """A value as query parameters have it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ",".join(map(spelled, value))
    return str(value)


def problem_of(response: httpx2.Response) -> Tree:
    """What the service said; of something else in its place, its status and first words."""
    try:
        tree = response.json()
        if isinstance(tree, dict) and "status" in tree:
            return tree
    except ValueError:
        pass
    return {"title": response.reason_phrase, "status": response.status_code, "detail": response.text[:200]}


def with_files(tree: Tree) -> tuple[Tree, Tree]:
    """The tree with names in the place of paths, and the files by these names."""
    files: Tree = {}
    names: dict[str, str] = {}

    def name_of(path: str) -> str:
        if path not in names:
            names[path] = f"{len(names)}-{Path(path).name}"
            content = base64.b64encode(Path(path).read_bytes()).decode()
            files[names[path]] = {"content": content, "encoding": "base64"}
        return names[path]

    def replaced(node: Any, key: str = "") -> Any:
        if isinstance(node, dict):
            return {name: replaced(value, name) for name, value in node.items()}
        if isinstance(node, list):
            return [replaced(value, key) for value in node]
        return name_of(node) if isinstance(node, str) and key.rpartition(".")[2] == "path" else node

    return replaced(tree), files
