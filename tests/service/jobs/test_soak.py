"""Kill anything at any moment: every job succeeds exactly once, nothing is lost, histories are those of calm runs."""

from pathlib import Path

import pytest
from soak import VICTIMS, soak


def test_a_few_kills(tmp_path: Path) -> None:
    soak(tmp_path, count=2, kills=6, steps=3000)


@pytest.mark.slow
def test_three_hundred_kills_over_thirty_jobs(tmp_path: Path) -> None:
    report = soak(tmp_path, count=30, kills=300, steps=3000)
    assert set(report.killed) == set(VICTIMS)
    print(report)
