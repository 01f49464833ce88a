"""`frit serve --release`: where nothing outlives the service, its end takes the jobs along, with a checkpoint."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import httpx2
import pytest
from asking import TIMEOUT, TINY, free_port, until
from serving import stand_in

from frit.service.client import Client
from frit.service.index.store import Store
from frit.service.jobs.states import State


@pytest.mark.parametrize("how", ["option", "setting"])
def test_term_releases_the_jobs_even_while_somebody_listens(tmp_path: Path, how: str) -> None:
    data, port = tmp_path / "data", free_port()
    command = [sys.executable, "-P", "-c", "from frit.service.cli.main import main; main()", "serve"]
    command += ["--data", str(data), "--port", str(port), "--cores", "1", *(["--release"] if how == "option" else [])]
    environment = {**os.environ, "FRIT_MPIRUN": stand_in(tmp_path), "FRIT_FREE_DISK": "0", "FRIT_GRACE": "20"}
    environment |= {"FRIT_RELEASE": "1"} if how == "setting" else {}
    url = f"http://127.0.0.1:{port}"
    with subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL) as process:
        try:
            until(lambda: process.poll() is not None or answers(url))
            with Client(url) as client:
                running, waiting = (client.submit({**TINY, "name": f"sleep {k}00"}, name=f"{k}") for k in (1, 2))
            until(lambda: (data / "runs" / running.id / "calls").exists())
            listener = threading.Thread(target=listen, args=(f"{url}/v1/jobs/{running.id}/events",))
            listener.start()
            process.send_signal(signal.SIGTERM)
            assert process.wait(TIMEOUT) in (0, -signal.SIGTERM)
            listener.join(TIMEOUT)
        finally:
            process.kill()
    assert (data / "runs" / running.id / "checkpoint.h5").exists()
    store = Store(data, writable=False)
    try:
        assert [store.job(job.id).state for job in (running, waiting)] == [State.QUEUED] * 2
    finally:
        store.close()


def answers(url: str) -> bool:
    try:
        return httpx2.get(f"{url}/readyz").status_code == 200
    except httpx2.TransportError:
        return False


def listen(url: str) -> None:
    """To a stream that the service ends, in whatever way."""
    try:
        with httpx2.stream("GET", url, timeout=TIMEOUT) as response:
            for _ in response.iter_lines():
                pass
    except httpx2.TransportError:
        pass
