"""A service from a script: submit, wait, look.

What fails on the way (no connection, a service that restarts or cannot write now) is tried again with the same
idempotency key: nothing is submitted twice.
"""

import base64
import json
import os
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import httpx2

from .remote import LONGEST_PAUSE, RemoteJob, RemoteSweep

QUIET = 60.0  # seconds without a sign of life of a stream before it is opened anew; signs come every 15
PASSING = (502, 503, 504)
HERE = "http://127.0.0.1:8000"
LARGE = 5_000_000  # bytes of a file that is not sent along with a case, but before it

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


class Client:
    """Speaks to one service; also a context manager."""

    Problem = ProblemError

    def __init__(
        self, url: str | None = None, token: str | None = None, *, timeout: float = 30.0, patience: float = 60.0
    ) -> None:
        """url: of the environment's FRIT_URL, else this machine's port 8000; token: of FRIT_TOKEN, where that is set.

        timeout: seconds for one answer; patience: seconds for which what fails on the way is tried again.
        """
        token = token or os.environ.get("FRIT_TOKEN")
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self.url, self.patience = (url or os.environ.get("FRIT_URL") or HERE).rstrip("/"), patience
        self._http = httpx2.Client(base_url=self.url, headers=self._headers, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def storage_options(self) -> Tree:
        """What zarr and xarray need to open the address of a store here."""
        return {"headers": self._headers} if self._headers else {}

    # --- submitting ---------------------------------------------------------------------------------------

    def submit(
        self, what: str | Path | Mapping[str, Any], *, ranks: int | None = None, name: str | None = None,
        priority: int | None = None, tags: Sequence[str] | None = None, time_limit: float | None = None,
        recompute: bool = False, reuse: bool = False,
    ) -> RemoteJob | RemoteSweep:  # fmt: skip
        """Submit a case, or a sweep, which has a base: a TOML or JSON file, or a tree of plain values.

        Mesh and particle files that it names are read here and sent along. time_limit: wall-clock seconds. reuse: of a
        case, take the job that there is, if any (points of a sweep always do). recompute: not one that an older
        revision of the solver computed.
        Raises `CaseError` for what is wrong here already, `ProblemError` for what the service refuses.
        """
        kind, tree, files = self._sendable(what)
        options: Tree = {"ranks": ranks, "name": name, "priority": priority, "time_limit": time_limit}
        given = {key: value for key, value in options.items() if value is not None}
        given |= {} if tags is None else {"tags": list(tags)}
        given |= {"recompute": True} if recompute else {}
        if kind == "definition":
            return RemoteSweep(self, self.post("/v1/sweeps", {"definition": tree, "files": files, **given}))
        given |= {"reuse": True} if reuse else {}
        return RemoteJob(self, self.post("/v1/jobs", {"case": tree, "files": files, **given}))

    def _sendable(self, what: str | Path | Mapping[str, Any]) -> tuple[str, Tree, Tree]:
        """Whether it is a `case` or a `definition`, the resolved tree with names of files, and the files."""
        from frit.solver.case import parse_case, read_tree
        from frit.sweeps.definition import parse_sweep

        tree = dict(what) if isinstance(what, Mapping) else read_tree(what)
        folder = Path() if isinstance(what, Mapping) else Path(what).parent
        if isinstance(tree, Mapping) and "base" in tree:
            return "definition", *self._with_files(json.loads(parse_sweep(tree, base=folder).resolved_json()))
        return "case", *self._with_files(parse_case(tree, base=folder).tree())

    def _with_files(self, tree: Tree) -> tuple[Tree, Tree]:
        """The tree with names in the place of paths, and the files by these names; large ones are uploaded before."""
        files: Tree = {}
        names: dict[str, str] = {}

        def name_of(path: str) -> str:
            if path not in names and Path(path).stat().st_size > LARGE:
                names[path] = self.upload(path)["id"]
            elif path not in names:
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

    def submit_sweep(self, definition: str | Path | Mapping[str, Any], **options: Any) -> RemoteSweep:
        """As `submit`, of what is a sweep."""
        submitted = self.submit(definition, **options)
        assert isinstance(submitted, RemoteSweep)  # anything else has been refused
        return submitted

    # --- looking ------------------------------------------------------------------------------------------

    def job(self, identifier: str) -> RemoteJob:
        """A job by its id."""
        return RemoteJob(self, self.get(f"/v1/jobs/{identifier}"))

    def jobs(self, **filters: Any) -> Iterator[RemoteJob]:
        """Jobs that fit, newest first, page by page as they are used.

        Filters and `order` as in HTTP, with __ in the place of a dot: `jobs(particles__mean_radius__ge=9, tag="a")`.
        """
        for row in self._pages("/v1/jobs", "jobs", filters):
            yield RemoteJob(self, row)

    def sweep(self, identifier: str) -> RemoteSweep:
        """A sweep by its id or name."""
        return RemoteSweep(self, self.get(f"/v1/sweeps/{identifier}"))

    def sweeps(self) -> Iterator[RemoteSweep]:
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

    def plan(self, what: str | Path | Mapping[str, Any], *, ranks: int | None = None) -> Tree:
        """What a case or sweep would cost; nothing is submitted. Raises as `submit` does."""
        kind, tree, files = self._sendable(what)
        return self.post("/v1/plan", {kind: tree, "files": files, **({} if ranks is None else {"ranks": ranks})})

    def schema(self, of: str = "case") -> Tree:
        """JSON Schema of a case, or of a `sweep`."""
        return self.get("/v1/schema", params={"of": of})

    def news(self, since: int | None = None) -> "Iterator[Event]":
        """What happens to all jobs, without end: `state` and `deleted`; since: after that event, 0: from the first."""
        path = "/v1/events" if since is None else f"/v1/events?since={since}"
        return (event for event in self.events(path) if event.kind != "begin")

    # --- files --------------------------------------------------------------------------------------------

    def upload(self, path: str | Path, name: str | None = None) -> Tree:
        """Upload a mesh or particle file by itself; its `id` then does for `path` in a case or sweep."""
        with open(path, "rb") as file:
            size, kind = os.fstat(file.fileno()).st_size, "application/octet-stream"
            headers = {"Content-Type": kind, "Content-Length": str(size)}
            query = {"name": name or Path(path).name}
            found: Tree = self.request("POST", "/v1/files", params=query, content=file, headers=headers).json()
        return found

    def files(self) -> Iterator[Tree]:
        """Files that were uploaded by themselves, newest first."""
        return self._pages("/v1/files", "files", {})

    def remove_file(self, identifier: str) -> None:
        """Of those that nothing refers to."""
        self.delete(f"/v1/files/{identifier}")

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

    def delete(self, path: str) -> None:
        """A DELETE; where the answer to an earlier try was lost, what is not there was deleted by that."""
        self.request("DELETE", path)

    def request(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """A good response; what fails on the way is tried again."""
        lost = False
        for last in self._tries():
            if (file := options.get("content")) is not None:
                file.seek(0)
            try:
                response = self._http.request(method, path, **options)
            except httpx2.TransportError:
                if last:
                    raise
                lost = True
                continue
            if lost and method == "DELETE" and response.status_code == 404:
                return response
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


# --- helpers ----------------------------------------------------------------------------------------------


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
