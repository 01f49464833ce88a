"""Kill anything at any moment: every job succeeds exactly once, nothing is lost, histories are those of calm runs."""

from collections import Counter
from pathlib import Path

import pytest
from soak import (
    disturb,
    histories,
    jobs_of,
    new_jobs,
    of_data,
    run_undisturbed,
    runners,
    service,
    submit,
    successes,
    wait,
)

from frit.service.jobs import State


def soak(folder: Path, count: int, kills: int, steps: int, pause: float) -> Counter[str]:
    """Run the same jobs calmly and under fire; how many of each kind were killed."""
    jobs = new_jobs(count, steps)
    run_undisturbed(folder / "calm", jobs, seconds=1200.0)
    submit(folder / "wild", jobs)
    with service(folder / "wild") as running:
        killed = disturb(running, kills, pause, seed=7)
        wait(folder / "wild", seconds=1200.0)
        assert not of_data(folder / "wild")
        assert not runners(folder / "wild")
    assert {job.state for job in jobs_of(folder / "wild")} == {State.SUCCEEDED}
    assert set(successes(folder / "wild").values()) == {1}
    assert histories(folder / "wild") == histories(folder / "calm")
    return killed


def test_a_few_kills(tmp_path: Path) -> None:
    killed = soak(tmp_path, count=2, kills=6, steps=1500, pause=1.0)
    assert sum(killed.values()) >= 3  # two quick jobs may be done before


@pytest.mark.slow
def test_two_hundred_kills_over_twenty_jobs(tmp_path: Path) -> None:
    killed = soak(tmp_path, count=20, kills=200, steps=6000, pause=0.8)
    assert sum(killed.values()) == 200, killed
    assert len(killed) == 4
    print(dict(killed), [job.attempt for job in jobs_of(tmp_path / "wild")])
