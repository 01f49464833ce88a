"""A folder to type commands in."""

from pathlib import Path

import pytest
from commands import CASE
from serving import stand_in


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder in which jobs do what their names say."""
    monkeypatch.setenv("FRIT_MPIRUN", stand_in(tmp_path))
    monkeypatch.delenv("FRIT_TOKEN", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "case.toml").write_text(CASE)
    (tmp_path / "long.toml").write_text(CASE.replace("sleep 0", "sleep 60").replace("15.4", "15.5"))
    return tmp_path
