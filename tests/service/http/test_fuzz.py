"""Thousands of nasty requests: no error of the service's own, none slow, nobody else kept waiting, no memory lost."""

from pathlib import Path

import httpx2
import pytest
from asking import PACKING, TINY
from engines import stand_in
from fuzz import BLOCKED, SLOW, Found, Target, fire, target
from nasty import KINDS, nasties

from frit.service.index import tokens

SEED = 20
GROWTH = 100_000_000  # bytes


def under_fire(folder: Path, count: int) -> Found:
    """Send so many; what came of it."""
    secret, found = tokens.create(folder / "data", "fuzz", "submit"), Found()
    with target(folder / "data", secret, folder / "service.log") as at:
        prepare(at)
        fire(at, nasties(SEED - 1, 3 * len(KINDS)), Found())  # all that is imported or filled once
        found.first = at.memory()
        fire(at, nasties(SEED, count), found)
        found.last = at.memory()
    return found


def prepare(at: Target) -> None:
    """A job and a sweep to ask about."""
    with httpx2.Client(
        base_url=f"http://127.0.0.1:{at.port}", headers={"Authorization": f"Bearer {at.secret}"}
    ) as client:
        at.places["{job}"] = client.post("/v1/jobs", json={"case": TINY}).json()["id"]
        definition = {"base": PACKING, "axes": {"particles.seed": [1, 2]}}
        at.places["{sweep}"] = client.post("/v1/sweeps", json={"definition": definition}).json()["id"]


def check(found: Found) -> None:
    assert not found.broken, "\n".join(found.broken[:20])
    assert {kind: s for kind, s in found.slowest.items() if s > SLOW} == {}
    assert {kind: s for kind, s in found.blocked.items() if s > BLOCKED} == {}
    assert found.last - found.first < GROWTH, (found.first, found.last)


@pytest.fixture(autouse=True)
def _standing_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is accepted need not be solved."""
    monkeypatch.setenv("FRIT_MPIRUN", str(stand_in(tmp_path / "solver")))


def test_some_nasty_requests(tmp_path: Path) -> None:
    check(under_fire(tmp_path, 4 * len(KINDS)))


@pytest.mark.slow
def test_five_thousand_nasty_requests(tmp_path: Path) -> None:
    found = under_fire(tmp_path, 5000)
    print(dict(found.statuses), f"{found.first / 1e6:.0f} to {found.last / 1e6:.0f} MB")
    for kind in found.slowest:
        print(f"{kind:20}{found.slowest[kind]:8.3f} s{found.blocked[kind]:8.3f} s")
    check(found)
