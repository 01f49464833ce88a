"""The commands of the service, as a user types them: a real `frit serve`, real files, real signals."""

import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from serving import stand_in
from soak import of_data

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


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder in which jobs do what their names say."""
    monkeypatch.setenv("FRIT_MPIRUN", stand_in(tmp_path))
    monkeypatch.delenv("FRIT_TOKEN", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "case.toml").write_text(CASE)
    (tmp_path / "long.toml").write_text(CASE.replace("sleep 0", "sleep 60").replace("15.4", "15.5"))
    return tmp_path


def command(*words: str) -> list[str]:
    return [sys.executable, "-P", "-c", "from frit.service.cli.main import main; main()", *words]


def frit(*words: str, status: int = 0) -> str:
    """What a command prints; its exit status must be the one that is expected."""
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
        os.environ["FRIT_URL"] = found[1]
        yield process
    finally:
        os.environ.pop("FRIT_URL", None)
        process.send_signal(signal.SIGINT)
        process.wait(WAIT)
        for left in of_data(folder / "data"):
            left.kill()


def test_submit_look_cancel_retry(folder: Path) -> None:
    with serving(folder):
        done = frit("submit", "case.toml", "--wait", "--tag", "first", "--name", "sleep 0.1")
        identifier = done.split()[0]
        assert "succeeded" in done
        (row,) = json.loads(frit("jobs", "tag=first", "--json"))
        assert (row["id"], row["name"], row["state"]) == (identifier, "sleep 0.1", "succeeded")
        shown = json.loads(frit("show", identifier[:6], "--json"))
        assert shown["sentence"] == "The solver reached the end of the case."
        assert frit("log", identifier) == ""  # the stand-in has none
        long = frit("submit", "long.toml").strip()
        assert frit("cancel", long).split() in ([long, "stopping"], [long, "cancelled"])
        frit("log", long, "-f")  # stays to its end
        assert json.loads(frit("show", long, "--json"))["state"] == "cancelled"
        assert frit("retry", long).split() == [long, "queued"]
        frit("cancel", long)
        assert "possible only from" in frit("cancel", identifier, status=2)


def test_what_is_refused(folder: Path) -> None:
    (folder / "wrong.toml").write_text(CASE.replace("radii = [5.0, 4.0]", "radii = [5.0, -4.0]"))
    with serving(folder):
        assert "wrong.toml: particles.radii[1] = -4.0: must be greater than 0" in frit("submit", "wrong.toml", status=2)
        assert "ranks" in frit("submit", "case.toml", "--ranks", "3", status=2)
        assert "none" in frit("show", "nothing", status=2)
        assert "particles.mean_radius" in frit("jobs", "particles.mean_radio.ge=3", status=2)
        assert "must be KEY=VALUE" in frit("jobs", "running", status=2)
        assert "in use by process" in frit("serve", "--data", "data", "--port", "0", status=2)
        assert "in use by process" in frit("sweep", "run", sweep(folder, "sleep 0"), "--data", "data", status=2)
    assert "no service answers" in frit("jobs", "--url", "http://127.0.0.1:9", status=1)
    assert "access token" in frit("serve", "--data", "data", "--host", "0.0.0.0", "--port", "0", status=2)


def test_tokens(folder: Path) -> None:
    (folder / "data").mkdir()
    submit = frit("token", "create", "--name", "me", "--scope", "submit", "--data", "data").strip()
    read = frit("token", "create", "--name", "guest", "--scope", "read", "--data", "data").strip()
    assert submit not in frit("token", "list", "--data", "data")
    with serving(folder, "--host", "0.0.0.0"):
        os.environ["FRIT_URL"] = os.environ["FRIT_URL"].replace("0.0.0.0", "127.0.0.1")
        frit("submit", "case.toml", status=2)
        frit("submit", "case.toml", "--token", read, status=2)
        frit("submit", "case.toml", "--token", submit, "--wait")
        frit("token", "revoke", "me", "--data", "data")
        frit("submit", "case.toml", "--token", submit, status=2)
        assert json.loads(frit("jobs", "--token", read, "--json"))[0]["state"] == "succeeded"


def sweep(folder: Path, name: str) -> str:
    """A sweep file whose points do what `name` says: the stand-in reads the first words of a point's name."""
    file = folder / "sweep.toml"
    file.write_text(SWEEP % name)
    return str(file)


def test_a_sweep_without_a_server_runs_only_what_is_missing(folder: Path) -> None:
    file = sweep(folder, "sleep 0")
    assert re.search(r"to run\s+3", frit("sweep", "plan", file, "--data", "data"))
    rows = json.loads(frit("sweep", "run", file, "--data", "data", "--json"))
    assert [(row["D_surf"], row["state"]) for row in rows] == [(d, "succeeded") for d in (2.0, 4.0, 6.0)]
    plan = json.loads(frit("sweep", "plan", file, "--data", "data", "--json"))
    assert (plan["points"], plan["to_run"]) == (3, 0)
    Path(file).write_text(Path(file).read_text().replace("6.0]", "6.0, 8.0]"))
    frit("sweep", "run", file, "--data", "data")
    runs = sorted((folder / "data" / "runs").glob("*/calls"))
    assert [len(path.read_text().splitlines()) for path in runs] == [1, 1, 1, 1]
    with serving(folder):
        assert frit("submit", file, "--wait").splitlines()[0] == "s3"
        assert [len(path.read_text().splitlines()) for path in runs] == [1, 1, 1, 1]


def test_what_an_older_solver_computed_is_told_and_computed_anew_when_asked(folder: Path) -> None:
    file, data = sweep(folder, "sleep 0"), folder / "data"
    before = json.loads(frit("sweep", "run", file, "--data", "data", "--json"))
    with closing(sqlite3.connect(data / "frit.db")) as index:
        (count,) = index.execute("SELECT count(*) FROM jobs WHERE json_extract(result, '$.revision') = 1").fetchone()
        assert count == 3
        change = "UPDATE jobs SET result = json_set(result, '$.revision', 0) WHERE id IN (?, ?)"
        index.execute(change, [row["job"] for row in before[:2]])
        index.commit()
    plan = json.loads(frit("sweep", "plan", file, "--data", "data", "--json"))
    assert (plan["done"], plan["older"], plan["to_run"]) == (1, {"0": 2}, 0)
    assert "2 by revision 0; --recompute computes them anew" in frit("sweep", "plan", file, "--data", "data")
    anew = json.loads(frit("sweep", "plan", file, "--data", "data", "--recompute", "--json"))
    assert (anew["done"], anew["older"], anew["to_run"]) == (1, {}, 2)
    told = "2 of 3 jobs were computed by an older revision of the solver (0)"
    assert told in frit("sweep", "run", file, "--data", "data")
    assert told in frit("compare", "sleep 0", "--data", "data")
    after = json.loads(frit("sweep", "run", file, "--data", "data", "--recompute", "--json"))
    assert [row["job"] for row in after] == [f"{before[0]['job']}-2", f"{before[1]['job']}-2", before[2]["job"]]
    assert [row["older_revision"] for row in after] == [None] * 3
    assert told not in frit("compare", "sleep 0", "--data", "data")  # of a name, the newest
    with serving(folder):
        assert frit("submit", file, "--recompute", "--wait").splitlines()[0] == "s4"
        frit("submit", "case.toml", "--recompute")
    assert len(list((data / "runs").glob("*/calls"))) == 6


def test_ctrl_c_writes_checkpoints_and_the_same_command_goes_on(folder: Path) -> None:
    words: Sequence[str] = ("sweep", "run", sweep(folder, "sleep 2"), "--data", "data", "--cores", "2")
    process = subprocess.Popen(command(*words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while len(list((folder / "data").glob("runs/*/calls"))) < 2:
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=WAIT)
    assert (process.returncode, "the same command goes on" in said) == (130, True)
    stopped = [path.parent for path in (folder / "data").glob("runs/*/calls")]
    assert all((path / "checkpoint.h5").exists() for path in stopped)
    assert not of_data(folder / "data")
    frit(*words)
    assert all("2" in (path / "attempt.json").read_text() for path in stopped)


def test_a_failed_point_is_told_and_does_not_stop_the_others(folder: Path) -> None:
    file = Path(sweep(folder, "says-no 1"))
    said = frit("sweep", "run", str(file), "--data", "data", status=1)
    assert said.count("failed") >= 3
    assert "fields left [-0.5, 1.5]" in said


def test_comparing_real_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Curves as a picture, a page and a table, from the data folder and from a service."""
    monkeypatch.chdir(tmp_path)
    file = sweep(tmp_path, "surface")
    frit("sweep", "run", file, "--data", "data")
    said = frit("compare", "surface", "--data", "data", "--out", "curves.csv")
    assert "packs of equal size" in said
    lines = (tmp_path / "curves.csv").read_text().splitlines()
    assert lines[0] == "job,name,model.D_surf,time,vacancy_ratio"
    assert len(lines) > 3 * 101
    assert "lowest vacancy ratio: D surf" in said
    for name in ("curves.png", "curves.html"):
        frit("compare", "surface", "--data", "data", "--out", name)
        assert (tmp_path / name).stat().st_size > 10_000
    assert "live_fraction" in frit("compare", "surface", "--data", "data", "--observable", "vacancy", status=2)
    assert "must end in" in frit("compare", "surface", "--data", "data", "--out", "curves.gif", status=2)
    with serving(tmp_path):
        found: dict[str, Any] = json.loads(frit("compare", "surface", "--json"))
    here = json.loads(frit("compare", "surface", "--data", "data", "--json"))
    assert found == here
    assert all(curve["values"][0] > curve["values"][-1] for curve in found["curves"])
