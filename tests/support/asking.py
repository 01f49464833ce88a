"""The real service for tests: in this process for quick questions, as a process of its own to be killed."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import uvicorn
from fastapi.testclient import TestClient

from frit.service.http.app import create_app
from frit.service.http.wire import options
from frit.service.settings import Settings

Tree = dict[str, Any]

TIMEOUT = 120.0  # seconds; there for hangs

# Solved in a moment once the kernels are compiled: 10 steps of two touching discs.
TINY: Tree = {
    "name": "tiny",
    "domain": {"size": [22.0, 13.0]},
    "nodes": {"spacing": 1.0},
    "particles": {"centres": [[6.5, 6.2], [15.4, 6.8]], "radii": [5.0, 4.0]},
    "time": {"integrator": "rk2", "end": 0.001, "step": 1e-4},
    "output": {"history_every": 0.0002, "snapshots": [0.0, 0.001]},
}
# Never solved: it is cancelled long before.
LONG: Tree = {**TINY, "name": "long", "time": {"integrator": "rk2", "end": 10.0, "step": 1e-4}}
PACKING: Tree = {
    "name": "pack",
    "domain": {"size": [100.0, 60.0]},
    "nodes": {"spacing": 1.0},
    "particles": {
        "source": "packing", "mean_radius": 8.0, "packing_density": 0.4, "container": [[5.0, 5.0], [95.0, 55.0]]
    },
    "time": {"end": 1.0},
}  # fmt: skip

SERVER = """
import sys, uvicorn
from pathlib import Path
from frit.service.http.app import create_app
from frit.service.settings import Settings
settings = Settings(data=Path(sys.argv[1]), cores=1, free_disk=int(sys.argv[3]), poll=0.05)
uvicorn.run(create_app(settings), port=int(sys.argv[2]), log_level="warning", timeout_graceful_shutdown=1)
"""


def settings_in(folder: Path, **more: Any) -> Settings:
    """Of a service that runs nothing by itself: the disk is never free enough. `free_disk=0` lets it."""
    return Settings(**{"data": folder, "cores": 2, "free_disk": 1 << 62, "poll": 0.05, **more})


@contextmanager
def service(folder: Path, **more: Any) -> Iterator[TestClient]:
    """The app in this process, asked without a socket."""
    app = create_app(settings_in(folder, **more))
    here = ("127.0.0.1", 50000)
    with TestClient(app, base_url="http://localhost", raise_server_exceptions=False, client=here) as client:
        yield client


@contextmanager
def listening(folder: Path, **more: Any) -> Iterator[str]:
    """The app in a thread behind a real socket; gives its URL."""
    settings = settings_in(folder, **more)
    config = uvicorn.Config(
        create_app(settings), port=0, log_level="error", **options(settings) | {"timeout_graceful_shutdown": 1}
    )
    server = uvicorn.Server(config)
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        until(lambda: server.started or not thread.is_alive())
        assert thread.is_alive(), "the server did not start"
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(TIMEOUT)
        listener.close()


class Process:
    """The service as a process of its own, on one port through all its lives."""

    def __init__(self, folder: Path, free_disk: int = 0) -> None:
        self.folder, self.port, self.free_disk = folder, free_port(), free_disk
        self.url = f"http://127.0.0.1:{self.port}"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Until it is ready, or says why not."""
        command = [sys.executable, "-P", "-c", SERVER, str(self.folder), str(self.port), str(self.free_disk)]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        until(self._ready)

    def _ready(self) -> bool:
        assert self.process is not None  # started
        assert self.process.poll() is None, "the server has ended"
        try:
            return httpx2.get(f"{self.url}/readyz").status_code in (200, 503)
        except httpx2.TransportError:
            return False

    def end(self, number: signal.Signals = signal.SIGTERM) -> None:
        """By a signal; to the end."""
        if self.process is not None:
            os.kill(self.process.pid, number)
            self.process.wait(TIMEOUT)
            self.process = None


def free_port() -> int:
    """One that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def until(happened: Any) -> None:
    """Wait; the limit is there for hangs."""
    deadline = time.monotonic() + TIMEOUT
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def final(client: TestClient, identifier: str) -> Tree:
    """The job once it is final."""
    found: Tree = {}

    def done() -> bool:
        found.update(client.get(f"/v1/jobs/{identifier}").json())
        return bool(found["final"])

    until(done)
    return found


def gmsh_text(nodes: list[list[float]], triangles: list[list[int]]) -> bytes:
    """A mesh of triangles (node numbers from 0) as gmsh writes it, version 2.2."""
    places = "\n".join(f"{k} {x!r} {y!r} 0.0" for k, (x, y) in enumerate(nodes, start=1))
    cells = "\n".join(f"{k} 2 0 {a + 1} {b + 1} {c + 1}" for k, (a, b, c) in enumerate(triangles, start=1))
    return (
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{len(nodes)}\n{places}\n$EndNodes\n"
        f"$Elements\n{len(triangles)}\n{cells}\n$EndElements\n"
    ).encode()
