"""The launcher against real mpirun trees of a stand-in solver, with real signals."""

import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from frit.service.jobs import launch
from frit.service.jobs.launch import Launch, LaunchError
from frit.solver.ended import read_run

STAND_IN = """
import json, os, signal, sys, time
from pathlib import Path

directory, act = Path(sys.argv[1]), sys.argv[2]
rank = int(os.environ["PMI_RANK"])
asked, end = False, ""

def say(**progress):
    if rank == 0:
        print(json.dumps(progress), flush=True)

def record(state, message=None):
    if rank == 0:
        (directory / "new.json").write_text(json.dumps({"state": state, "message": message}))
        (directory / "new.json").rename(directory / "run.json")

def on_usr1(*_):  # only a flag: a print inside an interrupted print is an error
    global asked
    asked = True

def on_term(*_):
    global end
    end = "interrupted"

signal.signal(signal.SIGUSR1, on_usr1)
signal.signal(signal.SIGTERM, signal.SIG_IGN if act == "stubborn" else on_term)
(directory / f"{rank}.new").write_text(str(os.getpid()))
(directory / f"{rank}.new").rename(directory / f"{rank}.pid")
if act == "steps":
    print("a stray line", flush=True)
    print("a word on stderr", file=sys.stderr, flush=True)
    keys = ("OMP_NUM_THREADS", "SLURM_STEP_ID", "PMI_SIZE")
    say(environment={key: os.environ.get(key) for key in keys})
    for step in range(3):
        say(time=0.5 * step)
    record("succeeded")
elif act == "says no":
    record("failed", "NaN at step 7")
    sys.exit(1)
elif act == "in use":
    print("another process is running here", file=sys.stderr)
    sys.exit(2)
elif act in ("waits", "stubborn"):
    record("running")
    say(ready=True)
    while not end:
        time.sleep(0.01)
        if asked:
            say(checkpoint=True)
            asked = False
    if rank == 0:
        (directory / "checkpoint.h5").touch()
    record(end)
elif act == "dies":
    say(ready=True)
    time.sleep(0.1)
    if rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60)
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run directory, which is also the stand-in's first argument."""
    script = tmp_path / "stand_in.py"
    script.write_text(STAND_IN)
    (tmp_path / "run").mkdir()
    command = [sys.executable, str(script), str(tmp_path / "run")]
    monkeypatch.setattr(launch, "solver_arguments", lambda: command)
    return tmp_path / "run"


def pids(run: Path, ranks: int) -> list[int]:
    return [int((run / f"{rank}.pid").read_text()) for rank in range(ranks)]


def status(pid: int) -> tuple[str, int]:
    """State letter and parent."""
    state, parent, *_ = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return state, int(parent)


def alive(pid: int) -> bool:
    """A zombie is not, though a container whose first process reaps nobody keeps it."""
    try:
        return status(pid)[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def all_end(run: Path, ranks: int = 2) -> bool:
    """A killed process needs a moment to end."""
    deadline = time.monotonic() + 2
    while any(map(alive, pids(run, ranks))) and time.monotonic() < deadline:
        time.sleep(0.01)
    return not any(map(alive, pids(run, ranks)))


def until_ready(progress: Iterator[dict[str, object]], run: Path, ranks: int = 2) -> None:
    """Rank 0 says so itself, the others by their pid."""
    assert next(progress) == {"ready": True}
    deadline = time.monotonic() + 20
    while not all((run / f"{rank}.pid").exists() for rank in range(ranks)):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_command_finds_mpirun_beside_python() -> None:
    command = launch.mpirun_command(3, ["case.toml", "--out", "x"])
    assert command[0] == str(Path(sys.executable).parent / "mpirun")
    assert command[1:] == ["-n", "3", sys.executable, "-P", "-m", "frit.solver", "case.toml", "--out", "x"]


def test_open_mpi_gets_its_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mpirun = tmp_path / "mpirun"
    mpirun.write_text("#!/bin/sh\necho 'mpirun (Open MPI) 5.0.8'\n")
    mpirun.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    command = launch.mpirun_command(2, [])
    assert command[:6] == [str(mpirun), "--oversubscribe", "--bind-to", "none", "-n", "2"]


def test_no_mpirun_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LaunchError, match="pip install mpich"):
        Launch(1, [], tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_environment_is_scrubbed_and_threads_are_one_unless_set() -> None:
    outer = {"PMI_RANK": "3", "PMIX_ID": "x", "OMPI_COMM_WORLD_RANK": "1", "SLURM_STEP_ID": "0", "FRIT_TOKEN": "x"}
    clean = launch.clean_environment(
        outer | {"SLURM_JOB_ID": "7", "OMP_NUM_THREADS": "4", "OMPI_MCA_pml": "ucx", "HOME": "/root"}
    )
    assert clean == {
        "SLURM_JOB_ID": "7",
        "OMP_NUM_THREADS": "4",
        "NUMBA_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "OMPI_MCA_pml": "ucx",
        "HOME": "/root",
    }


def test_progress_stray_lines_and_a_good_end(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    monkeypatch.setenv("SLURM_STEP_ID", "0")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    with Launch(2, ["steps"], run) as started:
        progress = list(started)
        outcome = started.wait()
    environment = {"OMP_NUM_THREADS": "1", "SLURM_STEP_ID": None, "PMI_SIZE": "2"}
    assert progress == [{"environment": environment}, {"time": 0.0}, {"time": 0.5}, {"time": 1.0}]
    assert (outcome.state, outcome.message, outcome.returncode) == ("succeeded", None, 0)
    assert {"a stray line", "a word on stderr"} <= set(outcome.errors.splitlines())


def test_wait_alone_also_ends(run: Path) -> None:
    with Launch(1, ["says no"], run) as started:
        outcome = started.wait()
    assert (outcome.state, outcome.message) == ("failed", "NaN at step 7")
    assert outcome.returncode != 0


def test_a_checkpoint_then_a_stop(run: Path) -> None:
    with Launch(2, ["waits"], run) as started:
        progress = iter(started)
        until_ready(progress, run)
        started.checkpoint()
        assert next(progress) == {"checkpoint": True}
        started.stop(grace=60)
        started.stop(grace=60)
        outcome = started.wait()
    assert (outcome.state, outcome.message) == ("interrupted", None)
    assert all_end(run)


@pytest.mark.parametrize(
    ("checkpoint", "state", "word"),
    [(True, "interrupted", "last one"), (False, "interrupted", "before the first")],
)
def test_ranks_that_ignore_a_stop_are_killed(run: Path, checkpoint: bool, state: str, word: str) -> None:
    """With an earlier checkpoint the run can go on from that, else anew."""
    if checkpoint:
        (run / "checkpoint.h5").touch()
    with Launch(2, ["stubborn"], run) as started:
        until_ready(iter(started), run)
        started.stop(grace=0.2)
        outcome = started.wait()
    assert outcome.state == state
    assert word in str(outcome.message)
    assert all_end(run)


def test_a_rank_that_dies_takes_all_with_it(run: Path) -> None:
    with Launch(2, ["dies"], run) as started:
        outcome = started.wait()
    assert outcome.state == "failed"
    assert "no word of the solver" in (outcome.message or "")
    assert all_end(run)


def test_no_orphans_when_mpirun_is_killed(run: Path) -> None:
    with Launch(2, ["stubborn"], run) as started:
        until_ready(iter(started), run)
        proxy = status(pids(run, 1)[0])[1]
        os.kill(status(proxy)[1], signal.SIGKILL)
        assert started.wait().state == "failed"
    assert all_end(run)


def test_ranks_out_of_mpiruns_reach_are_killed_with_it(run: Path) -> None:
    """mpich's mpirun notices nothing while ranks live whose proxy was killed, and no longer reaches them."""
    with Launch(2, ["stubborn"], run) as started:
        until_ready(iter(started), run)
        os.kill(status(pids(run, 1)[0])[1], signal.SIGKILL)
        started.stop(grace=0.2)
        started.wait()
    assert all_end(run)


def test_leaving_the_block_kills(run: Path) -> None:
    def leave() -> None:
        with Launch(2, ["stubborn"], run) as started:
            until_ready(iter(started), run)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        leave()
    assert all_end(run)


@pytest.mark.parametrize("state", ["done", "interrupted"])
def test_the_record_of_an_earlier_run_is_not_this_ones(run: Path, state: str) -> None:
    (run / "run.json").write_text(json.dumps({"state": state}))
    with Launch(1, ["writes nothing"], run) as started:
        assert started.wait().state == "failed"


def test_a_refusal_that_leaves_the_record_alone(run: Path) -> None:
    (run / "run.json").write_text(json.dumps({"state": "running"}))
    with Launch(2, ["in use"], run) as started:
        outcome = started.wait()
    assert outcome.state == "refused"
    assert "another process is running here" in outcome.errors


def test_a_torn_or_missing_record_is_empty(tmp_path: Path) -> None:
    assert read_run(tmp_path) == {}
    (tmp_path / "run.json").write_text('{"state": "do')
    assert read_run(tmp_path) == {}


def test_words_of_earlier_versions_are_understood(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"state": "done", "ranks": 2}')
    assert read_run(tmp_path) == {"state": "succeeded", "ranks": 2}
