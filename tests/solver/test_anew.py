"""Resuming a run that was killed before its first checkpoint, and ends that would come again."""

import asyncio
import errno
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from launching import PAIR, TIMEOUT, Case, Tree, different, history, launch, record, resume, solve
from serving import ended, new_job, settings, submit

from frit.service.jobs.engine import Engine
from frit.service.jobs.states import LONGEST_MESSAGE, NewJob, State, one_sentence
from frit.solver import output
from frit.solver.failure import comes_again, told
from frit.solver.slots import SlotError

PACK: Case = {
    "domain": {"size": [30.0, 20.0]},
    "nodes": {"spacing": 1.0},
    "particles": {
        "source": "packing", "mean_radius": 4.0, "std_radius": 0.3, "packing_density": 0.5, "seed": 5,
        "container": [[1.0, 1.0], [29.0, 19.0]],
    },
    "time": {"integrator": "rk2", "end": 0.003, "step": 1e-4},
    "output": {"history_every": 0.001, "snapshots": [0.0, 0.003]},
}  # fmt: skip

# Killed with a first row and a first snapshot, and without the checkpoint that follows them.
KILLED = """
import os, signal, sys
from frit.solver import __main__ as solver

solver.Recorder.after_step = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
sys.exit(solver.main())
"""


def killed(case: Case, directory: Path) -> Path:
    with launch(case, directory, script=KILLED) as tree:
        tree.ended()
    assert not (directory / "checkpoint.h5").exists()
    assert len(history(directory)) == 1
    return directory


@pytest.mark.parametrize("case", [PAIR, PACK], ids=["list", "packing"])
def test_a_run_without_a_checkpoint_is_begun_anew(tmp_path: Path, case: Case) -> None:
    """And is the one that nobody stopped, whatever the first try has left."""
    whole, directory = solve(case, tmp_path / "whole"), killed(case, tmp_path / "run")
    with open(directory / "history.jsonl", "a") as file:
        file.write(json.dumps(history(directory)[0]) + '\n{"time": 0.0')
    resume(directory)
    assert different(whole, directory, 1e-12) == {}
    told = record(directory)
    assert told["resumed"] == []
    assert told["notes"] == ["it was stopped before its first checkpoint: begun anew from case.json"]
    assert told["packing"] == record(whole)["packing"]
    if case is PACK:
        assert (directory / "particles.csv").read_bytes() == (whole / "particles.csv").read_bytes()


def test_the_case_alone_is_enough(tmp_path: Path) -> None:
    """As the command says, too."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "case.json").write_text(json.dumps(PAIR))
    command = [sys.executable, "-P", "-c", "from frit.service.cli.main import main; main()", "resume", "run"]
    ended_ = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    assert ended_.returncode == 0, ended_.stderr
    assert "run has no checkpoint yet: it is begun anew from its case.json" in ended_.stderr
    assert [row["step"] for row in history(tmp_path / "run") if row["step"] % 10 == 0] == list(range(0, 101, 10))


@pytest.mark.parametrize(("text", "words"), [(None, "no case.json"), ('{"domain": ', "not valid JSON")])
def test_without_a_whole_case_it_is_refused(tmp_path: Path, text: str | None, words: str) -> None:
    (tmp_path / "run").mkdir()
    if text is not None:
        (tmp_path / "run" / "case.json").write_text(text)
    with Tree(1, "--resume", tmp_path / "run") as tree:
        status, printed = tree.ended()
    assert status == 2
    assert words in printed


def test_nobody_begins_anew_what_runs(tmp_path: Path) -> None:
    script = KILLED.replace("os.kill(os.getpid(), signal.SIGKILL)", "signal.pause()")
    with launch(PAIR, tmp_path / "run", script=script) as first:
        first.until(lambda: len(history(tmp_path / "run")) == 1)
        with Tree(1, "--resume", tmp_path / "run") as second:
            status, printed = second.ended()
        assert status == 2
        assert "another process is running here" in printed


def test_only_the_solvers_own_torn_files_are_removed(tmp_path: Path) -> None:
    """Another's is about to be renamed."""
    for name in ("run.json.7.new", "case.json.7.new", "checkpoint.h5.new", "request.json.7.1.new"):
        (tmp_path / name).touch()
    output.remove_torn(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["request.json.7.1.new"]


# --- ends that would come again ---------------------------------------------------------------------------


def compile_wrongly() -> BaseException:
    """numba's own error."""
    from numba.core.errors import TypingError

    return TypingError("no")


@pytest.mark.parametrize(
    ("error", "again"),
    [
        (OverflowError("too large"), True), (ZeroDivisionError(), True), (FloatingPointError(), True),
        (ValueError("x"), True), (np.linalg.LinAlgError("singular"), True), (TypeError(), True), (KeyError("a"), True),
        (IndexError(), True), (MemoryError(), True), (RecursionError(), True), (AttributeError(), True),
        (SlotError("63 particles meet"), True), (compile_wrongly(), True), (OSError(errno.ENOMEM, "no memory"), True),
        (OSError(errno.ENOSPC, "full"), False), (OSError(errno.EIO, "broken"), False), (BrokenPipeError(), False),
        (RuntimeError("MPI"), False), (ImportError(), False), (EOFError(), False), (KeyboardInterrupt(), False),
    ],
)  # fmt: skip
def test_what_the_case_or_the_code_decides_comes_again(error: BaseException, again: bool) -> None:
    assert comes_again(error) is again


def test_an_error_is_told_in_a_line_without_its_path() -> None:
    assert told(OSError(errno.ENOSPC, "No space left on device", "/data/x")) == "OSError: No space left on device"
    assert told(ValueError("two\n  lines")) == "ValueError: two lines"
    assert told(KeyError()) == "KeyError"
    assert told(MemoryError("Unable to allocate 8 GiB")) == "there is not enough memory: Unable to allocate 8 GiB"
    assert told(OSError(errno.ENOMEM, "Cannot allocate memory", "/x")) == "there is not enough memory"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("/data/runs/a1/case.json: not valid", "case.json: not valid"),
        ("cannot open '/tmp/x y/mesh.inp' (see /var/log/a)", "cannot open 'x y/mesh.inp' (see a)"),
        ("radius 3 nm/s, and/or 1/2 at [0, 1]", "radius 3 nm/s, and/or 1/2 at [0, 1]"),
        ("one\ntwo\x1b[31m\x00three\u202e", "one; two [31m three"),
        ("x" * 1000, "x" * (LONGEST_MESSAGE - 3) + "..."),
    ],
)
def test_a_message_is_one_sentence(text: str, sentence: str) -> None:
    assert one_sentence(text) == sentence


def altered(**tables: dict[str, float]) -> NewJob:
    """A case that admission would refuse."""
    job = new_job("never")
    tree = json.loads(job.case)
    for table, values in tables.items():
        tree[table] |= values
    return NewJob(json.dumps(tree), "0" * 64, "never")


@pytest.mark.parametrize("job", [altered(time={"end": 1e308}), altered(output={"history_every": 5e-324})])
def test_a_job_that_can_never_work_has_failed_at_once(tmp_path: Path, job: NewJob) -> None:
    async def main() -> None:
        async with Engine(settings(tmp_path / "data", memory_limit=2_000_000_000)) as engine:
            (over,) = await ended(engine, *await submit(engine, job))
            assert (over.state, over.attempt) == (State.FAILED, 1), over.message
            assert over.message
            assert "\n" not in over.message
            assert "Traceback" not in over.message
            assert "/" not in over.message
            refused = record(engine.run_directory(over.id))["state"] == "refused"
            assert refused or "Traceback" in (engine.run_directory(over.id) / "log.txt").read_text()

    asyncio.run(main())


# The solver may take 300 MB more than it has once all is loaded.
NARROW = """
import resource, sys
from pathlib import Path
from frit.solver import __main__ as solver

taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + 300_000_000,) * 2)
sys.exit(solver.main())
"""


def test_a_solver_without_memory_says_so_and_is_not_tried_again(tmp_path: Path) -> None:
    case = PAIR | {"domain": {"size": [800.0, 800.0]}, "nodes": {"spacing": 0.25}}
    with launch(case, tmp_path / "run", script=NARROW) as tree:
        _, printed = tree.ended()
    end = record(tmp_path / "run")
    assert (end["state"], end["retry"]) == ("failed", False), printed
    assert end["message"].startswith("there is not enough memory")
