"""`frit` as a user types it: its commands, in this process or in one of their own, and a real `frit serve`."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from soak import of_data
from typer.testing import CliRunner

from frit.service.cli.main import app

CASE = """
name = "sleep 0"
domain = { size = [22.0, 13.0] }
nodes = { source = "triangular", spacing = 1.0 }
particles = { centres = [[6.5, 6.2], [15.4, 6.8]], radii = [5.0, 4.0] }
time = { end = 0.01 }
"""
TABLES = re.sub(r"(?m)^(domain|nodes|particles|time|name) =", r"base.\1 =", CASE)
SWEEP = f"""
name = "%s"
{TABLES}
[axes]
"model.D_surf" = [2.0, 4.0, 6.0]
"""
WAIT = 120.0  # seconds; for hangs alone


def command(*words: str) -> list[str]:
    return [sys.executable, "-P", "-c", "from frit.service.cli.main import main; main()", *words]


def frit(*words: str, status: int = 0) -> str:
    """What a command prints, run in this process; its exit status must be the one that is expected."""
    done = CliRunner().invoke(app, words)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == status, done.output
    return done.stdout if status == 0 else done.output


def typed(*words: str, status: int = 0) -> str:
    """`frit` in a process of its own, which takes a second to start."""
    done = subprocess.run(command(*words), capture_output=True, text=True, timeout=WAIT, check=False)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout if status == 0 else done.stdout + done.stderr


@contextmanager
def serving(folder: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """`frit serve` on a free port, which FRIT_URL then names."""
    log = folder / "serve.log"
    with open(log, "w") as out:
        process = subprocess.Popen(
            command("serve", "--data", "data", "--cores", "2", "--port", "0", *words), stdout=out, stderr=out, text=True
        )
    try:
        while (found := re.search(r"running on (http://\S+)", log.read_text())) is None:
            assert process.poll() is None, log.read_text()
            time.sleep(0.02)
        os.environ["FRIT_URL"] = found[1]
        yield process
    finally:
        os.environ.pop("FRIT_URL", None)
        process.send_signal(signal.SIGINT)
        process.wait(WAIT)
        for left in of_data(folder / "data"):
            left.kill()
