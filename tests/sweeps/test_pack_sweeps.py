"""A sweep over packings, end to end: asked for, packed, sintered, and found by what was asked and realised."""

import json
import os
from pathlib import Path

import pytest
from commands import frit, serving

from frit.service.client import Client
from frit.sweeps import open_results

SWEEP = """
name = "packs"
[base]
domain = { size = [44.0, 38.0] }
nodes = { spacing = 1.25 }
time = { end = 0.01 }
[base.particles]
source = "packing"
packing_density = 0.6
seed = 3
container = [[2.0, 2.0], [42.0, 36.0]]
[axes]
"particles.mean_radius" = [2.5, 3.0]
"particles.std_radius" = [0.25, 0.5]
[sample]
replicates = 2
"""


def test_found_by_what_was_asked_and_by_what_was_realised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "packs.toml").write_text(SWEEP)
    rows = json.loads(frit("sweep", "run", "packs.toml", "--data", "data", "--json"))
    assert [(row["mean_radius"], row["std_radius"], row["state"]) for row in rows] == [
        (mean, std, "succeeded") for mean in (2.5, 3.0) for std in (0.25, 0.5) for _ in range(2)
    ]
    assert len({row["seed"] for row in rows}) == 2  # one per replicate, the same at every point

    results = open_results("data")
    table = results.query("mean_radius > 2.7 and std_radius == 0.5").table()
    assert len(table) == 2
    assert table.realised_mean_radius.to_numpy() == pytest.approx(3.0, rel=1e-6)
    assert table.realised_std_radius.to_numpy() == pytest.approx(0.5, rel=1e-6)
    everything = results.table()
    assert (abs(everything.realised_vacancy_box_density - 0.6) <= 0.005).all()
    assert (everything.query("mean_radius == 2.5").realised_count > 20).all()
    assert len(results.query("realised_count < 30")) == (everything.realised_count < 30).sum() > 0

    with serving(tmp_path), Client(os.environ["FRIT_URL"]) as client:
        found = list(client.jobs(**{"particles.std_radius": 0.25, "result.packing.count.ge": 30}))
        wanted = everything[(everything.std_radius == 0.25) & (everything.realised_count >= 30)]
        assert {job.id for job in found} == set(wanted.index)
        assert len(found) > 0
