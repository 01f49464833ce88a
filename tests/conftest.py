"""What every test shares: floating point that complains, and the communicator of a single rank."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from serving import stand_in

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
