"""The command line as users meet it: exit statuses, words on the right stream, signals, a terminal.

`frit run` starts real mpirun trees of a stand-in solver; the solver itself is tested elsewhere.
"""

import fcntl
import json
import os
import signal
import subprocess
import sys
import termios
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from typer.testing import CliRunner, Result

from frit.service.cli import main as cli
from frit.service.jobs import launch
from frit.solver.ended import read_run

STAND_IN = """
import json, os, signal, sys, time
from pathlib import Path

act = os.environ["FRIT_STAND_IN"]
arguments = sys.argv[1:]
fresh = "--out" in arguments
directory = Path(arguments[arguments.index("--out" if fresh else "--resume") + 1])
ranks, root = int(os.environ["PMI_SIZE"]), os.environ["PMI_RANK"] == "0"
stop = False

def record(state, message=None):
    if root:
        (directory / "new").write_text(json.dumps({"state": state, "message": message, "ranks": ranks}))
        (directory / "new").rename(directory / "run.json")

def row(step):
    if root:
        line = {"time": 0.1 * step, "step": step, "vacancy_ratio": 0.3 - 0.01 * step}
        line["evaluations"] = 4 * step
        with open(directory / "history.jsonl", "a") as file:
            file.write(json.dumps(line) + chr(10))
        print(json.dumps(line | {"end": 0.3, "evaluations_per_second": 12.5, "live_fraction": 0.4,
                                 "remaining": None if step == 0 else 75.0}), flush=True)

def on_term(*_):
    global stop
    stop = True

signal.signal(signal.SIGTERM, signal.SIG_IGN if act == "stubborn" else on_term)
(directory / os.environ["PMI_RANK"]).touch()
record("running")
if act == "refuses":
    record("refused", "nodes.path: no such mesh")
elif act == "fails":
    print("Traceback: ...", file=sys.stderr)
    record("failed", "NaN at step 7")
    sys.exit(1)
elif act in ("waits", "stubborn"):
    row(0)
    while not stop:
        time.sleep(0.01)
    row(1)
    (directory / "checkpoint.h5").touch()
    record("interrupted", "checkpoint at t = 0.1")
else:
    for step in range(0 if fresh else 2, 4):
        row(step)
    record("succeeded")
"""

CASE = """
name = "two equal discs"
[domain]
size = [50.0, 30.0]
[nodes]
source = "lattice"
spacing = 1.0
[particles]
source = "list"
centres = [[15.0, 15.0], [35.0, 15.0]]
radii = [10.0, 10.0]
[time]
end = 0.3
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a case and a stand-in solver that ends well."""
    (tmp_path / "two.toml").write_text(CASE)
    (tmp_path / "stand_in.py").write_text(STAND_IN)
    command = [sys.executable, str(tmp_path / "stand_in.py")]
    monkeypatch.setattr(launch, "solver_arguments", lambda: command)
    monkeypatch.setenv("FRIT_STAND_IN", "ends")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def frit(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def record(directory: Path, **entries: Any) -> Path:
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "run.json").write_text(json.dumps(entries))
    return directory


# --- run and resume -------------------------------------------------------------------------------------


def test_run_ends_with_a_summary_and_0(folder: Path) -> None:
    result = frit("run", "two.toml", "--ranks", "2")
    assert result.exit_code == 0, result.output
    assert (result.stderr, read_run(folder / "runs/two")["ranks"]) == ("", 2)
    words = result.stdout.split()
    assert {"succeeded", "0.3", "12", "runs/two"} <= set(words)
    assert "0.3 -> 0.27" in result.stdout


def test_run_json_is_the_summary_and_nothing_else(folder: Path) -> None:
    result = frit("run", "two.toml", "--out", folder / "here", "--json")
    summary = json.loads(result.stdout)
    assert summary.pop("wall_time") > 0
    assert summary.pop("time") == pytest.approx(0.3)
    assert summary == {
        "state": "succeeded",
        "message": None,
        "steps": 3,
        "evaluations": 12,
        "vacancy_ratio": [0.3, 0.27],
        "directory": str(folder / "here"),
    }


def test_a_wrong_case_starts_nothing(folder: Path) -> None:
    bad = CASE.replace("radii = [10.0", "radii = [-1.0").replace("end =", "ende =")
    (folder / "bad.toml").write_text(bad)
    result = frit("run", "bad.toml")
    assert (result.exit_code, result.stdout) == (2, "")
    lines = result.stderr.splitlines()
    assert all(line.startswith("bad.toml: ") for line in lines)
    assert any("particles.radii" in line and "-1.0" in line for line in lines)
    assert any("time.ende" in line for line in lines)
    assert not (folder / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "two.toml", "--ranks", "0"], ["--ranks", "0", "1 or more"]),
        (["run", "missing.toml"], ["missing.toml"]),
        (["run", "two.toml", "--out", "two.toml"], ["two.toml"]),
        (["resume", "nowhere"], ["nowhere"]),
        (["plot", "nowhere"], ["nowhere"]),
        (["plot", ".", "--time", "soon"], ["--time"]),
    ],
)
def test_wrong_arguments_are_refused_by_name(folder: Path, arguments: list[str], words: list[str]) -> None:
    result = frit(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert all(word in result.stderr for word in words)


def test_run_leaves_another_run_alone(folder: Path) -> None:
    before = record(folder / "runs/two", state="failed")
    result = frit("run", "two.toml")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "no checkpoint" in result.stderr
    (before / "checkpoint.h5").touch()
    assert "frit resume runs/two" in frit("run", "two.toml").stderr
    assert read_run(before) == {"state": "failed"}


def test_a_refused_run_may_be_run_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRIT_STAND_IN", "refuses")
    result = frit("run", "two.toml")
    assert result.exit_code == 2
    assert "nodes.path: no such mesh" in result.stderr
    monkeypatch.setenv("FRIT_STAND_IN", "ends")
    assert frit("run", "two.toml").exit_code == 0


def test_a_failed_run_says_why_and_where(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRIT_STAND_IN", "fails")
    result = frit("run", "two.toml", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["message"] == "NaN at step 7"
    assert "Traceback: ..." in result.stderr


def test_no_mpirun_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    monkeypatch.setenv("PATH", "/nowhere")
    result = frit("run", "two.toml")
    assert result.exit_code == 2
    assert "pip install mpich" in result.stderr


def test_resume_takes_the_ranks_of_before(folder: Path) -> None:
    directory = record(folder / "old", state="interrupted", ranks=2)
    (directory / "checkpoint.h5").touch()
    assert frit("resume", "old").exit_code == 0
    assert read_run(directory) == {"state": "succeeded", "message": None, "ranks": 2}
    record(directory, state="interrupted", ranks=2)
    assert frit("resume", "old", "--ranks", "1").exit_code == 0
    assert read_run(directory)["ranks"] == 1


def test_resume_needs_a_checkpoint(folder: Path) -> None:
    record(folder / "old", state="failed", ranks=2)
    result = frit("resume", "old")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "checkpoint.h5" in result.stderr


def test_resume_of_a_done_run_says_so(folder: Path) -> None:
    frit("run", "two.toml")
    result = frit("resume", "runs/two", "--json")
    assert result.exit_code == 0
    assert "done already" in result.stderr
    assert json.loads(result.stdout)["vacancy_ratio"] == [0.3, 0.27]


# --- signals --------------------------------------------------------------------------------------------


def started(folder: Path, act: str, **streams: Any) -> "subprocess.Popen[str]":
    """frit in a process and a session of its own; a terminal on its standard input becomes that session's."""
    script = (
        "import fcntl, os, termios\n"
        "if os.isatty(0): fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"
        "from frit.service.cli import main as cli\nfrom frit.service.jobs import launch\n"
        f"launch.solver_arguments = lambda: {launch.solver_arguments()!r}\n"
        "cli.main()\n"
    )
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", script, "run", "two.toml", "--ranks", "2"],
        env=os.environ | {"FRIT_STAND_IN": act, "TERM": "xterm", "COLUMNS": "100"},
        text=True,
        start_new_session=True,
        **streams,
    )


def until_both_ranks_run(directory: Path) -> None:
    """They listen to signals, and rank 0 has been once through its loop."""
    deadline = time.monotonic() + 20
    while not all((directory / name).exists() for name in ("0", "1", "history.jsonl")):
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_in_a_checkpoint_and_130(folder: Path, number: signal.Signals) -> None:
    with started(folder, "waits", stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        until_both_ranks_run(folder / "runs/two")
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
    assert process.returncode == 130, err
    assert err == "interrupted (checkpoint at t = 0.1); `frit resume runs/two` goes on\n"
    assert "interrupted" in out
    assert (folder / "runs/two/checkpoint.h5").exists()


def test_nohup_is_heeded(folder: Path) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        process = started(folder, "waits", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    until_both_ranks_run(folder / "runs/two")
    process.send_signal(signal.SIGHUP)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.3)
    process.terminate()
    assert process.wait(20) == 130


def test_a_second_interrupt_kills(folder: Path) -> None:
    """Ranks that do not listen leave no checkpoint here, and say nothing; run.json does not stay `running`."""
    with started(folder, "stubborn", stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        until_both_ranks_run(folder / "runs/two")
        process.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.3)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    said = "stopped before the first checkpoint was written"
    assert err == f"interrupted ({said}); `frit resume runs/two` goes on\n"
    assert read_run(folder / "runs/two")["state"] == "interrupted"


def test_ctrl_c_on_a_terminal(folder: Path) -> None:
    """The kernel sends INT to the whole foreground, and the ranks must not be in it."""
    here, there = os.openpty()
    fcntl.ioctl(there, termios.TIOCSWINSZ, np.array([24, 100, 0, 0], dtype=np.uint16).tobytes())
    with started(folder, "waits", stdin=there, stdout=there, stderr=there) as process:
        os.close(there)
        screen = b""
        while b"ev/s" not in screen:
            screen += os.read(here, 4096)
        until_both_ranks_run(folder / "runs/two")
        os.write(here, b"\x03")
        with suppress(OSError):  # how a terminal ends that nobody holds any more
            while True:
                screen += os.read(here, 4096)
    os.close(here)
    assert process.returncode == 130
    shown = screen.decode()
    assert "t 0/0.3 step 0 12.5 ev/s live 40% vacancy 0.3000 - left" in shown
    assert "writing a checkpoint; Ctrl-C again kills" in shown


# --- plot, schema, help ---------------------------------------------------------------------------------


@pytest.fixture
def results(folder: Path) -> Path:
    """A run directory with a history and snapshots of a single disc, 1 nm apart."""
    assert frit("run", "two.toml").exit_code == 0
    directory = folder / "runs/two"
    case = {"name": "one disc", "domain": {"size": [12.0, 12.0]}}
    (directory / "case.json").write_text(json.dumps(case))
    nodes = np.stack(np.meshgrid(np.arange(13.0), np.arange(13.0)), axis=-1).reshape(-1, 2)
    rho = 0.5 * (1 - np.tanh(np.linalg.norm(nodes - 6.0, axis=1) - 4))
    group = zarr.create_group(directory / "snapshots.zarr")
    columns = {"rho": rho, "eta_squared": rho**2, "particle": np.where(rho > 0.5, 0, -1)}
    for name, column in ({"nodes": nodes, "time": np.array([0.0, 2.5])} | columns).items():
        group.create_array(name, data=np.stack([column, column]) if name in columns else column)
    return directory


def test_plot_of_a_snapshot_names_its_time_and_file(results: Path) -> None:
    result = frit("plot", "runs/two", "--time", "9")
    assert result.exit_code == 0, result.output
    assert result.stdout == "runs/two/snapshot-2.5.png: snapshot at t = 2.5\n"
    assert (results / "snapshot-2.5.png").read_bytes().startswith(b"\x89PNG")


def test_plot_without_time_is_the_history(results: Path) -> None:
    assert frit("plot", "runs/two").exit_code == 0
    assert (results / "history.png").read_bytes().startswith(b"\x89PNG")
    assert frit("plot", "runs/two", "--out", "curves.pdf").exit_code == 0
    assert Path("curves.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("arguments", [["--time", "0"], [], ["--out", "picture.xyz"]])
def test_plot_of_nothing_or_into_nothing_is_refused(folder: Path, arguments: list[str]) -> None:
    directory = record(folder / "empty", state="running")
    case = {"name": "empty", "domain": {"size": [1.0, 1.0]}}
    (directory / "case.json").write_text(json.dumps(case))
    if "--out" in arguments:
        (directory / "history.jsonl").write_text('{"time": 0.0, "vacancy_ratio": 0.1}\n')
    result = frit("plot", "empty", *arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert any(word in result.stderr for word in ("no snapshots", "no history", "xyz"))


def test_schema_is_a_json_schema() -> None:
    schema = json.loads(frit("schema").stdout)
    assert {"domain", "particles", "time"} <= set(schema["properties"])


def test_help_loads_nothing_heavy_and_version_is_one_line() -> None:
    """mpi4py and the kernels must never be loaded here; the others cost a second."""
    script = (
        "import sys, frit.service.cli\n"
        "heavy = ['mpi4py', 'numba', 'numpy', 'matplotlib', 'zarr', 'pydantic', 'scipy']\n"
        "sys.exit(str([name for name in heavy if name in sys.modules]))\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert ended.stderr == "[]\n"
    result = frit("--version")
    assert result.exit_code == 0
    assert result.stdout.startswith("frit")
    assert all(command in frit("--help").stdout for command in ("run", "resume", "plot", "schema"))
