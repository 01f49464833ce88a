"""What every test shares: floating point that complains, and the communicator of a single rank."""

import os
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serving import stand_in

from frit.solver.geometry import GMSH_LIBRARIES
from frit.solver.partition import Ranks


@pytest.fixture(autouse=True)
def _floating_point_errors_raise() -> Iterator[None]:
    """Division by zero, overflow, underflow and invalid operations in numpy end a test."""
    with np.errstate(all="raise"):
        yield


@pytest.fixture(scope="session")
def ranks() -> Ranks:
    """One rank, without MPI."""
    return Ranks()


@pytest.fixture
def standing_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs do what their names say, and no more."""
    monkeypatch.setenv("FRIT_MPIRUN", stand_in(tmp_path))


@pytest.fixture
def gmsh() -> Any:
    """gmsh, or skip; with FRIT_REQUIRE_ALL=1 a machine that cannot import it fails instead."""
    try:
        return import_module("gmsh")
    except (ImportError, OSError) as error:
        if os.environ.get("FRIT_REQUIRE_ALL") == "1":
            raise
        pytest.skip(f"{error}: {GMSH_LIBRARIES}")
