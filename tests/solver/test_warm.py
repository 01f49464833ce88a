"""Compiled code before the first case: the warm-up reaches all of it, and an installation can bring it along."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from simulate import merged

from frit.service.jobs.launch import mpirun_command
from frit.solver import jit, warm
from frit.solver.case import parse_case


@pytest.fixture
def brought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A seed with one file of compiled code under the name "hash"."""
    folder = tmp_path / "seed" / "hash" / "solver"
    folder.mkdir(parents=True)
    (folder / "kernel.nbc").write_bytes(b"code")
    monkeypatch.setenv("FRIT_CACHE_SEED", str(tmp_path / "seed"))
    return tmp_path / "seed"


@pytest.mark.usefixtures("brought")
def test_a_missing_cache_folder_starts_as_a_copy_of_the_seed(tmp_path: Path) -> None:
    folder = tmp_path / "not" / "there" / "hash"
    jit.seed(folder)
    assert (folder / "solver" / "kernel.nbc").read_bytes() == b"code"
    assert os.listdir(folder.parent) == ["hash"]


@pytest.mark.usefixtures("brought")
def test_a_cache_folder_that_is_there_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "hash").mkdir()
    jit.seed(tmp_path / "hash")
    assert os.listdir(tmp_path / "hash") == []


@pytest.mark.usefixtures("brought")
def test_a_seed_of_other_sources_is_not_taken(tmp_path: Path) -> None:
    jit.seed(tmp_path / "cache" / "other")
    assert not (tmp_path / "cache").exists()


@pytest.mark.usefixtures("brought")
def test_a_cache_that_cannot_be_written_is_no_error_yet(tmp_path: Path) -> None:
    (tmp_path / "cache").touch()  # a file where the folder should be
    jit.seed(tmp_path / "cache" / "hash")


ASK = "import numba; from frit.solver import jit; print(jit.cache_folder(), numba.config.CACHE_DIR)"


def chosen(root: Path) -> tuple[Path, Path, str]:
    """The cache folder by its name, the one that numba is given, and what is said on stderr."""
    environment, command = {**os.environ, "FRIT_CACHE_DIR": str(root)}, [sys.executable, "-P", "-c", ASK]
    asked = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    named, given = map(Path, asked.stdout.split())
    return named, given, asked.stderr


def test_a_cache_is_made_for_its_user_alone(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        named, given, said = chosen(tmp_path / "deep" / "cache")
    finally:
        os.umask(before)
    assert (named, said) == (given, "")
    assert {folder.stat().st_mode & 0o777 for folder in (named, named.parent)} == {0o700}
    assert chosen(tmp_path / "deep" / "cache")[1] == named


@pytest.mark.parametrize("which", ["folder", "parent", "link", "file"])
def test_a_cache_that_others_may_write_is_not_used(tmp_path: Path, which: str) -> None:
    """numba would run whatever they have put there."""
    named, _, _ = chosen(tmp_path / "cache")
    if which in ("folder", "parent"):
        (named if which == "folder" else named.parent).chmod(0o777)
    else:
        named.rmdir()
        if which == "link":
            (tmp_path / "elsewhere").mkdir()
            named.symlink_to(tmp_path / "elsewhere")
        else:
            named.touch()
    _, given, said = chosen(tmp_path / "cache")
    if which != "file":
        assert "others may write there" in said
        assert given != named
        assert not given.exists(), "it lasts as long as the process"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give folders away")
def test_a_cache_of_another_user_is_not_used(tmp_path: Path) -> None:
    named, _, _ = chosen(tmp_path / "cache")
    os.chown(named, 12345, 12345)
    assert chosen(tmp_path / "cache")[1] != named


def test_a_seed_that_others_may_write_is_not_taken(brought: Path, tmp_path: Path) -> None:
    (brought / "hash").chmod(0o777)
    jit.seed(tmp_path / "cache" / "hash")
    assert not (tmp_path / "cache").exists()


def test_the_cases_of_the_warm_up_are_accepted() -> None:
    assert [parse_case(tree).name for tree in warm.CASES] == [tree["name"] for tree in warm.CASES]


DISCS, SPHERES = warm.DISCS, warm.SPHERES
RK2 = {"integrator": "rk2", "step": 1e-4, "end": 0.004}
SPAN = {"output": {"history_every": 0.002, "snapshots": [0.0, 0.004]}}
OTHERS: list[tuple[int, dict[str, Any]]] = [
    (1, merged(DISCS, model={"advection": "wang"}, activation={"enabled": False})),
    (1, {**DISCS, "particles": {"shape": "box", "centres": [[6.5, 6.2], [15.4, 6.8]], "sizes": [[8.0, 8.0]] * 2}}),
    (2, {**SPHERES, **SPAN, "time": RK2}),
    (1, {**SPHERES, "particles": {"centres": [[3.5, 4.5, 4.5]], "radii": [3.0]}, "model": {"rigid_motion": False}}),
    (2, merged(DISCS, output={"vacancy_box": [[2.0, 2.0], [9.3, 8.1]]})),
    (2, {**DISCS, "nodes": {"source": "gmsh", "spacing": 1.0}}),
]


def test_every_file_with_compiled_code_names_the_cache() -> None:
    """Else an edit to it would leave old code in the folder."""
    folder = Path(jit.__file__).parent
    decorated = re.compile(r"^@(jit|inlined|lean|exact|numba)", re.MULTILINE)
    marked = {str(path.relative_to(folder)) for path in folder.rglob("*.py") if decorated.search(path.read_text())}
    assert len(marked) > 10
    assert marked <= set(jit.COMPILED)
    assert all((folder / name).exists() for name in jit.COMPILED)


@pytest.mark.slow
def test_after_the_warm_up_nothing_is_compiled_any_more(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    environment = {**os.environ, "FRIT_CACHE_DIR": str(cache)}
    subprocess.run([sys.executable, "-P", "-m", "frit.solver.warm"], env=environment, check=True)
    before = {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb?")}
    assert compiled_functions() == {path.name.partition("-")[0] for path in before}
    for number, (ranks, tree) in enumerate(OTHERS):
        case = tmp_path / f"{number}.json"
        case.write_text(json.dumps(tree))
        out = str(tmp_path / str(number))
        subprocess.run(mpirun_command(ranks, [str(case), "--out", out]), env=environment, check=True)
        assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb?")} == before


def compiled_functions() -> set[str]:
    """Every function with compiled code of its own, as numba names its files."""
    found = set()
    for name in jit.COMPILED:
        module = importlib.import_module(f"frit.solver.{name.removesuffix('.py').replace('/', '.')}")
        for value in vars(module).values():
            options = getattr(value, "targetoptions", None)
            if options is not None and value.__module__ == module.__name__:
                found.add(f"{Path(name).stem}.{value.__name__}")
    return found
