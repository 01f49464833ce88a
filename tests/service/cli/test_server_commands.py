"""The commands of the service, as a user types them: a real `frit serve`, real files, real signals."""

import json
import os
import re
import signal
import sqlite3
import subprocess
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from commands import CASE, SWEEP, WAIT, command, frit, serving, typed
from soak import of_data


def test_submit_look_cancel_retry(folder: Path) -> None:
    with serving(folder):
        done = typed("submit", "case.toml", "--wait", "--tag", "first", "--name", "sleep 0.1")
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
        assert "in use by process" in typed("serve", "--data", "data", "--port", "0", status=2)
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
    new = typed("sweep", "plan", file, "--data", "new/data")
    assert re.search(r"to run\s+3", new)
    assert not Path("new").exists()
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
        frit("submit", "case.toml", "--again")
    assert len(list((data / "runs").glob("*/calls"))) == 6


def test_ctrl_c_writes_checkpoints_and_the_same_command_goes_on(folder: Path) -> None:
    words: Sequence[str] = ("sweep", "run", sweep(folder, "sleep 2"), "--data", "data", "--cores", "2")
    process = subprocess.Popen(command(*words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while len(list((folder / "data").glob("runs/*/calls"))) < 2:
        assert process.poll() is None
        time.sleep(0.02)
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
    said = typed("sweep", "run", str(file), "--data", "data", status=1)
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
