"""The client against the real service behind a real socket, through restarts of it."""

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.metadata import requires
from pathlib import Path
from typing import Any

import httpx2
import meshio
import numpy as np
import pandas as pd
import pytest
from asking import LONG, PACKING, TINY, Process, free_port, gmsh_text, listening, until
from packaging.requirements import Requirement

from frit.service import Client, ProblemError, RemoteJob, RemoteSweep
from frit.service import client as module
from frit.solver.case import CaseError, parse_case

TOML = """
name = "from a file"
[domain]
size = [22.0, 13.0]
[nodes]
spacing = 1.0
[particles]
source = "file"
path = "particles.csv"
[time]
integrator = "rk2"
end = 0.001
step = 1e-4
[output]
history_every = 0.0002
"""


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Of a service that runs jobs."""
    with listening(tmp_path_factory.mktemp("data"), free_disk=0, cores=1) as url, Client(url) as opened:
        yield opened


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Of one that starts none."""
    with listening(tmp_path_factory.mktemp("idle")) as url, Client(url) as opened:
        yield opened


def job_of(submitted: RemoteJob | RemoteSweep) -> RemoteJob:
    assert isinstance(submitted, RemoteJob)
    return submitted


def test_importing_the_package_imports_nothing_else() -> None:
    code = "import sys, frit.service; print(sum(m.startswith(('frit', 'httpx2', 'pandas')) for m in sys.modules))"
    shown = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["2"]


@pytest.mark.parametrize("name", ["fsspec", "aiohttp", "xarray", "zarr"])
def test_a_plain_install_brings_what_snapshots_by_url_need(name: str) -> None:
    """xarray.open_zarr(job.zarr_url), as the README has it."""
    plain = [Requirement(text) for text in requires("frit") or () if "extra ==" not in text]
    assert name in {requirement.name for requirement in plain}


def test_submit_wait_history_as_in_the_contract(client: Client, tmp_path: Path) -> None:
    (tmp_path / "case.toml").write_text(TOML)
    (tmp_path / "particles.csv").write_text("x,y,radius\n6.5,6.2,5.0\n15.4,6.8,4.0\n")
    job = client.submit(tmp_path / "case.toml", tags=["from a file"])
    job.wait()
    job = job_of(job)
    assert (job.state, job.final, job.name, job.message) == ("succeeded", True, "from a file", None)
    history = job.history()
    assert isinstance(history, pd.DataFrame)
    assert history.time.tolist() == pytest.approx([0.0, 2e-4, 4e-4, 6e-4, 8e-4, 1e-3])
    assert job.result["vacancy_ratio"] == history.vacancy_ratio.iloc[-1]
    assert [snapshot.time for snapshot in job.snapshots()] == [0.0, 0.001]
    assert httpx2.get(f"{job.zarr_url}/zarr.json").status_code == 200
    assert job.open_zarr()["rho"].shape[0] == 2
    log = job.log_bytes()
    assert log == job.log().encode()
    assert job.log_bytes(10) == log[10:]
    assert job.log_bytes(len(log)) == b""
    events = list(job.stream())
    assert [event.data["state"] for event in events if event.kind == "state"][-1] == "succeeded"
    assert pd.DataFrame([event.data for event in events if event.kind == "history"]).equals(history)
    assert [found.id for found in client.jobs(tag="from a file")] == [job.id]
    assert client.job(job.id).data == job.refresh().data


def test_a_mesh_is_read_here_and_computed_on_there(client: Client, tmp_path: Path) -> None:
    x, y = np.meshgrid(np.linspace(0, 22, 23), np.linspace(0, 13, 14), indexing="ij")
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (number[i : i + 22, j : j + 13].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    meshio.write_points_cells(tmp_path / "own.vtk", points, [("triangle", triangles)])
    (tmp_path / "case.json").write_text(json.dumps({**TINY, "nodes": {"source": "file", "path": "own.vtk"}}))
    job = job_of(client.submit(tmp_path / "case.json").wait())
    assert job.state == "succeeded", job.message
    assert job.parameters["nodes.path"].endswith(".fritmesh"), "converted there"


def test_what_is_wrong_here_already_is_not_sent(idle: Client, tmp_path: Path) -> None:
    with pytest.raises(CaseError, match=r"nodes.spacing = -1.0: must be greater than 0"):
        idle.submit({**TINY, "nodes": {"spacing": -1.0}})
    with pytest.raises(CaseError, match="cannot be read"):
        idle.submit(tmp_path / "none.toml")
    assert list(idle.jobs()) == []


def test_what_the_service_refuses_is_a_problem(idle: Client) -> None:
    with pytest.raises(ProblemError, match="must be at most 2, the cores there are") as refused:
        idle.submit(TINY, ranks=3)
    assert refused.value.status == 422
    assert refused.value.problem["errors"][0]["pointer"] == "/ranks"
    with pytest.raises(ProblemError, match="there is none"):
        idle.job("none")


def test_jobs_are_moved_and_found(idle: Client) -> None:
    job = job_of(idle.submit(TINY, name="mine", priority=2, tags=["a"], ranks=2, time_limit=60.0))
    assert (job.name, job.data["priority"], job.data["ranks"], job.data["time_limit"]) == ("mine", 2, 2, 60.0)
    assert job.cancel().state == "cancelled"
    assert job.retry().state == "queued"
    with pytest.raises(ProblemError) as refused:
        job.retry()
    assert (refused.value.status, refused.value.problem["state"]) == (409, "queued")
    for _ in range(3):
        idle.submit(TINY, tags=["many"])
    assert len(list(idle.jobs(tag="many", limit=2))) == 3
    assert len(list(idle.jobs(tag="many", nodes__spacing__in=[1.0, 2.0], activation__enabled=True))) == 3
    assert list(idle.jobs(nodes__spacing__gt=1)) == []
    with pytest.raises(TimeoutError):
        job.wait(timeout=0.1)
    assert idle.limits()["cores"] == 2


def test_a_sweep_is_told_by_its_base(idle: Client, tmp_path: Path) -> None:
    (tmp_path / "case.json").write_text(json.dumps(PACKING))
    sweep = {"name": "radius", "base": "case.json", "axes": {"particles.mean_radius": [8.0, 10.0]}}
    (tmp_path / "sweep.json").write_text(json.dumps(sweep))
    made = idle.submit(tmp_path / "sweep.json", tags=["swept"])
    assert isinstance(made, RemoteSweep)
    assert [job.parameters["particles.mean_radius"] for job in made.jobs()] == [8.0, 10.0]
    assert [job.data["tags"] for job in made.jobs()] == [["swept"]] * 2
    assert made.states == {"queued": 2}
    assert [found.id for found in idle.sweeps()] == [made.id]
    assert made.compare()["differing"] == ["particles.mean_radius"]
    assert made.cancel().states == {"cancelled": 2}
    again = idle.submit_sweep(tmp_path / "sweep.json")
    assert idle.sweep("radius").id == again.id
    assert (again.data["new"], again.states) == (0, {"queued": 2}), "what was cancelled is tried again"
    with pytest.raises(TimeoutError):
        again.wait(timeout=0.1)


def test_a_sweep_uploads_the_meshes_along_its_axes(idle: Client, tmp_path: Path) -> None:
    for name in ("a.msh", "bb.msh"):
        (tmp_path / name).write_bytes(gmsh_text([[0.0, 0.0], [22.0, 0.0], [22.0, 13.0 + len(name)]], [[0, 1, 2]]))
    base: dict[str, Any] = {**TINY, "nodes": {"source": "file"}}
    (tmp_path / "s.json").write_text(json.dumps({"base": base, "axes": {"nodes.path": ["a.msh", "bb.msh"]}}))
    made = idle.submit_sweep(tmp_path / "s.json")
    assert made.data["points"] == 2
    assert str(tmp_path) not in json.dumps(made.refresh().data)


@pytest.mark.slow
def test_nothing_is_lost_or_submitted_twice_while_the_service_restarts(tmp_path: Path) -> None:
    """Submissions go on while the service is killed and started again; a stream goes on where it was."""
    server = Process(tmp_path / "data")
    server.start()
    with Client(server.url) as client:
        long = job_of(client.submit(LONG))
        seen: list[module.Event] = []
        done: list[RemoteJob] = []

        def watch() -> None:
            with Client(server.url) as other:
                seen.extend(other.job(long.id).stream())

        def submit() -> None:
            with Client(server.url) as other:
                for number in range(25):
                    done.append(job_of(other.submit(TINY, name=str(number), priority=-1)))

        threads = [threading.Thread(target=work) for work in (watch, submit)]
        for thread in threads:
            thread.start()
        try:
            for number in (signal.SIGKILL, signal.SIGTERM):
                before = len(done)
                until(lambda before=before: len(done) > before + 5)
                server.end(number)
                server.start()
            threads[1].join()
            until(lambda: client.job(long.id).state == "running")
            until(lambda: len(long.history()) > 20)
            long.cancel()
            threads[0].join()
            names = [job.name for job in client.jobs(limit=500) if job.id != long.id]
            assert sorted(names, key=int) == [str(number) for number in range(25)], "each came once"
            rows = [event.data["time"] for event in seen if event.kind == "history"]
            assert rows == long.history().time.tolist(), "without loss or repeat"
            assert seen[-1].kind == "end"
            for job in client.jobs(state="queued"):
                job.cancel()
            until(lambda: all(job.final for job in client.jobs(limit=500)))
        finally:
            server.end()


def test_patience_has_an_end() -> None:
    with Client(f"http://127.0.0.1:{free_port()}", patience=0.3) as client, pytest.raises(httpx2.ConnectError):
        client.limits()


def test_a_case_sent_back_is_the_same_case(idle: Client) -> None:
    job = job_of(idle.submit(TINY))
    assert parse_case(job.refresh().data["case"]) == parse_case(TINY)
    assert job_of(idle.submit(job.data["case"])).data["identity"] == job.data["identity"]


def test_the_same_case_is_one_job_where_it_is_reused(idle: Client) -> None:
    tree = {**TINY, "model": {"k": 61.0}}
    first = job_of(idle.submit(tree))
    assert job_of(idle.submit({**tree, "name": "other words"}, reuse=True)).id == first.id
    assert job_of(idle.submit(tree)).id != first.id, "as before, unless it is asked for"
    newest = job_of(idle.submit(tree, reuse=True)).cancel()
    again = job_of(idle.submit(tree, reuse=True, recompute=True))
    assert again.id != newest.id, "one that waits is of more use than one that was cancelled"
    for job in idle.jobs(model__k=61):
        if not job.final:
            job.cancel()
    assert job_of(idle.submit(tree, reuse=True)).state == "queued", "what was cancelled is tried again"
    assert sum(1 for _ in idle.jobs(model__k=61)) == 2


def test_histories_of_several_jobs_are_asked_for_within_limits(idle: Client) -> None:
    one, two = (job_of(idle.submit(TINY)).id for _ in range(2))
    assert idle.get("/v1/histories", params={"id": f"{two},{one}"}) == {
        "histories": [{"job": two, "rows": []}, {"job": one, "rows": []}]
    }
    with pytest.raises(ProblemError, match="refused") as refused:
        idle.get("/v1/histories", params={"id": ",".join([one] * 11), "rows": 10_000})
    assert "at most 100 jobs, and at most 100000 rows together: 11 times 10000" in str(refused.value.problem)
    with pytest.raises(ProblemError, match="there is none"):
        idle.get("/v1/histories", params={"id": f"{one},ffff"})


def test_the_environment_tells_where_and_who(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRIT_URL", "http://there:1/")
    monkeypatch.setenv("FRIT_TOKEN", "secret")
    with Client() as client:
        assert client.url == "http://there:1"
        assert client.storage_options() == {"headers": {"Authorization": "Bearer secret"}}
    monkeypatch.delenv("FRIT_TOKEN")
    with Client("http://here:2") as client:
        assert (client.url, client.storage_options()) == ("http://here:2", {})
