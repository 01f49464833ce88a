"""The command line with the solver behind it, as a user types it. What it says in each situation: test_cli.py."""

import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from launching import PAIR, PRESSED, TIMEOUT, different, history, interrupted, record

from frit.solver.profile import PHASES

# On a terminal it becomes that of its session, as a shell's would be.
FRIT = """
import fcntl, os, termios
if os.isatty(0):
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from frit.service.cli.main import main
main()
"""
# Long enough to be interrupted wherever it runs; nobody waits for its end.
ENDLESS = {
    "time": {"integrator": "rk2", "end": 1000.0, "step": 1e-4},
    "output": {"history_every": 0.001, "history_change": 0, "snapshots": [0.0, 1000.0]},
}
SHOWN = re.compile(r"t [\d.e-]+/1000 step \d+ [\d.e+]+ ev/s live \d+% vacancy 0\.\d{4} [\d:, a-z]+ left")

CASE = """
name = "a pair"
[domain]
size = [22.0, 13.0]
[nodes]
spacing = 1.0
[particles]
centres = [[6.5, 6.2], [15.4, 6.8]]
radii = [5.0, 4.0]
[time]
integrator = "rk2"
end = 0.01
step = 1e-4
[output]
history_every = 0.001
snapshots = [0.0, 0.0035, 0.01]
keep_checkpoint = true
"""


@contextmanager
def started(folder: Path, *arguments: str, **streams: Any) -> Iterator["subprocess.Popen[str]"]:
    """frit in a session of its own. A test that fails meanwhile ends it as a user would."""
    command = [sys.executable, "-P", "-c", FRIT, *arguments]
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "120"}
    with subprocess.Popen(
        command, cwd=folder, text=True, start_new_session=True, env=environment, **streams
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)


def frit(folder: Path, *arguments: str) -> tuple[int, str, str]:
    """Exit status, stdout, stderr."""
    with started(folder, *arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        out, err = process.communicate(timeout=TIMEOUT)
    return process.returncode, out, err


def until_rows(directory: Path, process: "subprocess.Popen[str]", count: int) -> None:
    deadline = time.monotonic() + TIMEOUT
    while len(history(directory)) < count:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder with cases, and with one that has been run."""
    folder = tmp_path_factory.mktemp("commands")
    (folder / "pair.toml").write_text(CASE)
    (folder / "endless.json").write_text(json.dumps(PAIR | ENDLESS))
    (folder / "wrong.toml").write_text(CASE.replace("radii = [5.0", "radii = [-5.0"))
    unstable = PAIR | {"time": {"integrator": "rk2", "end": 10.0, "step": 0.5}, "output": {"history_every": 0.5}}
    (folder / "unstable.json").write_text(json.dumps(unstable))
    (folder / "pressed.json").write_text(json.dumps(PRESSED))
    status, out, err = frit(folder, "run", "pair.toml")
    assert (status, err) == (0, ""), out + err
    (folder / "said").write_text(out)
    return folder


def test_run_ends_with_a_summary_and_nothing_else(folder: Path) -> None:
    """Nobody looks at a pipe: no bar, no control codes."""
    rows = history(folder / "runs/pair")
    said = (folder / "said").read_text()
    words = dict(line.split(maxsplit=1) for line in said.splitlines())
    assert (words["state"], words["steps"], words["evaluations"]) == ("succeeded", "100", "200")
    assert words["directory"] == "runs/pair"
    assert said.count(f"{rows[0]['vacancy_ratio']:.6g} -> {rows[-1]['vacancy_ratio']:.6g}") == 1
    assert "\x1b" not in said
    assert record(folder / "runs/pair")["name"] == "a pair"


def test_profile_tells_where_the_time_of_each_rank_went(folder: Path) -> None:
    """Every phase has its line and every rank its column; together they are no more than the wall's seconds."""
    began = time.monotonic()
    status, out, err = frit(folder, "run", "pair.toml", "--ranks", "2", "--out", "runs/profiled", "--profile")
    wall = time.monotonic() - began
    assert (status, err) == (0, "")
    table = out.split("\n\n")[1].splitlines()
    assert table[0].split() == ["seconds", "rank", "0", "rank", "1", "share"]
    ranks = record(folder / "runs/profiled")["profile"]
    assert len(ranks) == 2
    for phase in (*PHASES, "memory, GB"):
        (line,) = (line for line in table if line.startswith(phase))
        shown = line.removeprefix(phase).split()[:2]
        key = phase.removesuffix(", GB")
        assert [float(value) for value in shown] == pytest.approx([rank[key] for rank in ranks], abs=0.0051)
        assert all(rank[key] > 0.0 for rank in ranks)
    for rank in ranks:
        assert sum(rank.values()) - rank["memory"] <= wall


def test_plots_of_a_real_run(folder: Path) -> None:
    status, out, err = frit(folder, "plot", "runs/pair")
    assert (status, out, err) == (0, "runs/pair/history.png: history\n", "")
    status, out, err = frit(folder, "plot", "runs/pair", "--time", "0.004", "--out", "fields.png")
    assert (status, out, err) == (0, "fields.png: snapshot at t = 0.0035\n", "")
    for picture in ("runs/pair/history.png", "fields.png"):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")


def test_a_finished_run_is_neither_run_nor_resumed_again(folder: Path) -> None:
    before = record(folder / "runs/pair")
    status, out, err = frit(folder, "run", "pair.toml")
    assert (status, out) == (2, "")
    assert "frit resume runs/pair" in err
    status, out, err = frit(folder, "resume", "runs/pair", "--json")
    assert status == 0
    assert "done already" in err
    assert json.loads(out)["steps"] == 100
    assert record(folder / "runs/pair") == before


def test_what_is_refused_ends_with_2_and_leaves_nothing(folder: Path) -> None:
    status, out, err = frit(folder, "run", "wrong.toml")
    assert (status, out) == (2, "")
    assert "particles.radii" in err
    assert "-5.0" in err
    assert not (folder / "runs/wrong").exists()


def test_a_run_that_fails_ends_with_1_and_the_reason(folder: Path) -> None:
    status, out, err = frit(folder, "run", "unstable.json", "--json")
    assert status == 1
    assert json.loads(out)["state"] == "failed"
    for words in ("step 1, at (", "likely cause", "see runs/unstable/log.txt"):
        assert words in err


def test_a_particle_pressed_against_a_wall_is_noted_once(folder: Path) -> None:
    """By a run on two ranks."""
    status, out, err = frit(folder, "run", "pressed.json", "--ranks", "2")
    assert status == 0, out + err
    (note,) = record(folder / "runs/pressed")["notes"]
    assert re.fullmatch(r"at t = 0\.\d+, step \d+, at \(.*\) nm: rho = 1\.\d+, .*: a particle is pressed .*", note)
    assert err == f"note: {note}\n"
    log = (folder / "runs/pressed/log.txt").read_text()
    assert log.count("note: ") == log.count(note) == 1


def test_ctrl_c_ends_with_130_and_the_way_to_go_on(folder: Path) -> None:
    """INT to frit alone, as from another program."""
    directory = folder / "long"
    arguments = ("run", "endless.json", "--ranks", "2", "--out", "long")
    with started(folder, *arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        until_rows(directory, process, 3)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 130
    assert "interrupted" in out
    assert "`frit resume long` goes on" in err
    assert record(directory)["state"] == "interrupted"
    assert [row["time"] for row in history(directory)] == [k * 0.001 for k in range(len(history(directory)))]


def test_resume_ends_like_an_undisturbed_run(folder: Path) -> None:
    """On as many ranks as before, without being told."""
    cut = interrupted(PAIR, folder / "cut", ranks=2)
    status, out, err = frit(folder, "resume", "cut", "--json")
    assert (status, err) == (0, "")
    assert {key: json.loads(out)[key] for key in ("state", "steps", "directory")} == {
        "state": "succeeded",
        "steps": 100,
        "directory": "cut",
    }
    assert record(cut)["ranks"] == 2
    assert different(folder / "runs/pair", cut, 1e-10) == {}  # see test_ranks.py


def test_progress_on_a_terminal(folder: Path) -> None:
    """Time, step, evaluations per second, live fraction, vacancy ratio, time left; and Ctrl-C typed there."""
    here, there = os.openpty()
    fcntl.ioctl(there, termios.TIOCSWINSZ, np.array([24, 120, 0, 0], dtype=np.uint16).tobytes())
    arguments = ("run", "endless.json", "--out", "watched")
    with started(folder, *arguments, stdin=there, stdout=there, stderr=there) as process:
        os.close(there)
        screen = ""
        while not SHOWN.search(screen):
            screen += os.read(here, 4096).decode(errors="replace")
        os.write(here, b"\x03")
        with suppress(OSError):  # how a terminal ends that nobody holds any more
            while True:
                screen += os.read(here, 4096).decode(errors="replace")
        process.wait(TIMEOUT)
    os.close(here)
    assert process.returncode == 130
    assert "writing a checkpoint; Ctrl-C again kills" in screen
    assert record(folder / "watched")["state"] == "interrupted"


def test_schema_describes_the_case_that_runs(folder: Path) -> None:
    status, out, err = frit(folder, "schema")
    assert (status, err) == (0, "")
    schema = json.loads(out)
    case = json.loads((folder / "runs/pair/case.json").read_text())
    assert schema["type"] == "object"
    assert set(case) == set(schema["properties"])
    for table, values in case.items():
        if isinstance(values, dict):
            properties = schema["$defs"][schema["properties"][table]["$ref"].rpartition("/")[2]]["properties"]
            assert set(values) <= set(properties)
