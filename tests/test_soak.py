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


def soak(folder: Path, count: int, kills: int, steps: int) -> Counter[str]:
    """Run the same jobs calmly and under fire; how many of each kind were killed.

    The kills fall within nine tenths of the time that the calm jobs took, on this machine: there is always a victim.
    """
    jobs = new_jobs(count, steps)
    run_undisturbed(folder / "warm", new_jobs(1, 20), seconds=300.0)  # compiled, or read from disk
    seconds = run_undisturbed(folder / "calm", jobs, seconds=1200.0)
    submit(folder / "wild", jobs)
    with service(folder / "wild") as running:
        killed = disturb(running, kills, 0.9 * seconds, seed=7)
        wait(folder / "wild", seconds=1200.0)
        assert not of_data(folder / "wild")
        assert not runners(folder / "wild")
    assert sum(killed.values()) == kills, killed
    assert {job.state for job in jobs_of(folder / "wild")} == {State.SUCCEEDED}
    assert set(successes(folder / "wild").values()) == {1}
    assert histories(folder / "wild") == histories(folder / "calm")
    return killed


def test_a_few_kills(tmp_path: Path) -> None:
    soak(tmp_path, count=2, kills=6, steps=3000)


@pytest.mark.slow
def test_two_hundred_kills_over_twenty_jobs(tmp_path: Path) -> None:
    killed = soak(tmp_path, count=20, kills=200, steps=12_000)
    assert len(killed) == 4
    print(dict(killed), [job.attempt for job in jobs_of(tmp_path / "wild")])
