"""Results from a data folder: real runs of two tiny cases, read back as a table, histories and snapshots."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from asking import TINY, listening
from launching import PAIR, solve

from frit.service import Client
from frit.sweeps import QueryError, open_results
from frit.sweeps.remote import Service


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs to different ends with different history times, and one that has not started."""
    folder = tmp_path_factory.mktemp("data")
    (folder / "runs").mkdir()
    shorter: dict[str, Any] = PAIR | {
        "time": PAIR["time"] | {"end": 0.004},
        "model": {"A": 12.0},
        "output": {"history_every": 0.002, "history_change": 0, "snapshots": [0.0, 0.004]},
    }
    longer: dict[str, Any] = PAIR | {"output": PAIR["output"] | {"history_change": 0}}
    for job, case in (("a", longer), ("b", shorter)):
        solve(case, folder / "runs" / job)
    (folder / "runs" / "c").mkdir()
    shutil.copy(folder / "runs" / "a" / "case.json", folder / "runs" / "c")
    return folder


def test_a_row_per_job_with_its_case_and_its_last_values(data: Path) -> None:
    table = open_results(data).table()
    assert list(table.index) == ["a", "b", "c"]
    assert table.loc["a", "state"] == "succeeded"
    assert table["A"].tolist() == [16.0, 12.0, 16.0]
    assert table["end"].tolist() == [0.01, 0.004, 0.01]
    assert table["nodes_source"].tolist() == ["lattice"] * 3
    assert table.loc[["a", "b"], "time"].tolist() == [0.01, 0.004]
    assert table["vacancy_ratio"].isna().tolist() == [False, False, True]
    assert table.columns.is_unique


def test_queries_narrow_the_runs(data: Path) -> None:
    results = open_results(data)
    assert [run.job for run in results.query("A > 13 and state == 'succeeded'")] == ["a"]
    assert len(results.query("A > 99")) == 0
    assert open_results(data)[1].job == "b"
    assert [run.job for run in results[1:]] == ["b", "c"]


def test_histories_share_their_times(data: Path) -> None:
    found = open_results(data).query("state == 'succeeded'").histories()
    assert found["vacancy_ratio"].dims == ("job", "time")
    assert found["time"].values == pytest.approx(np.arange(11) * 0.001)
    shorter = found["vacancy_ratio"].sel(job="b").values
    assert np.flatnonzero(~np.isnan(shorter)).tolist() == [0, 2, 4]
    assert not np.isnan(found["free_energy"].sel(job="a")).any()


def test_histories_are_interpolated_on_request(data: Path) -> None:
    results = open_results(data).query("job == 'b'")
    energy = results[0].history["free_energy"]
    found = results.histories([0.0, 0.001, 0.004, 0.005])["free_energy"].values[0]
    assert found[:3] == pytest.approx([energy[0], (energy[0] + energy[1]) / 2, energy[2]])
    assert np.isnan(found[3])


def test_runs_without_a_history_are_empty_not_an_error(data: Path) -> None:
    found = open_results(data)[2:]
    assert found.histories().sizes == {"job": 1, "time": 0}
    with pytest.raises(FileNotFoundError):
        found[0].snapshots()


def test_snapshots_are_an_xarray_dataset(data: Path) -> None:
    found = open_results(data)[0].snapshots()
    assert found["rho"].dims == ("time", "node")
    stored = zarr.open_group(data / "runs" / "a" / "snapshots.zarr", mode="r")
    assert found["time"].values.tolist() == [0.0, 0.0035, 0.01]
    np.testing.assert_array_equal(found["rho"][-1].values, np.asarray(stored["rho"])[-1])


def test_nothing_is_written(data: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in data.rglob("*")}
    results = open_results(data)
    results.table()
    results.histories()
    results[0].snapshots().load()
    assert {path: path.stat().st_mtime_ns for path in data.rglob("*")} == before


def test_a_folder_that_is_no_data_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no folder `runs`"):
        open_results(tmp_path)
    (tmp_path / "runs").mkdir()
    assert len(open_results(tmp_path)) == 0
    assert open_results(tmp_path).table().empty
    assert open_results(tmp_path).histories().sizes == {"job": 0, "time": 0}


# --- a sweep, written down as a service does -----------------------------------------------------------------


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two densities, two replicates each, and a job of no sweep."""
    folder = tmp_path_factory.mktemp("swept")
    return write_sweep(folder)


def write_sweep(folder: Path) -> Path:
    lines: list[dict[str, Any]] = []
    for seq, (density, seed, end) in enumerate(
        [(0.5, 1, 0.30), (0.5, 2, 0.34), (0.7, 1, 0.10), (0.7, 2, 0.12), (0.9, 1, 0.0)], start=1
    ):
        directory = folder / "runs" / f"job{seq}"
        directory.mkdir(parents=True)
        particles = {"source": "packing", "packing_density": density, "seed": seed}
        case = {"name": f"n{seq}", "particles": particles, "output": {"history_every": 0.1 * seq}}
        (directory / "case.json").write_text(json.dumps(case))
        (directory / "run.json").write_text(json.dumps({"state": "done", "ranks": 1}))
        rows = [{"time": t, "vacancy_ratio": 0.4 + t * (end - 0.4)} for t in (0.0, 0.5, 1.0)]
        (directory / "history.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        lines.append({"kind": "job", "seq": seq, "id": f"job{seq}"})
    points: list[Any] = [[seq, f"n{seq}", {}] for seq in (3, 1, 4, 2)]
    named = {"kind": "sweep", "name": "density"}
    lines += [{**named, "seq": k, "id": f"s{k}", "points": points[:n]} for k, n in ((1, 2), (2, 4))]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (folder / "submitted.jsonl").write_text(text + '{"kind": "jo')
    return folder


def test_runs_of_a_sweep_by_its_name_or_id(swept: Path) -> None:
    results = open_results(swept)
    assert [run.job for run in results.query(sweep="density")] == ["job3", "job1", "job4", "job2"], "the newest"
    assert [run.job for run in results.query(sweep="s1")] == ["job3", "job1"]
    assert [run.job for run in results.query("seed == 2", sweep="density")] == ["job4", "job2"]
    with pytest.raises(QueryError, match=r"sweep 'densty': there is none; near: \['density'\]"):
        results.query(sweep="densty")


def test_a_wrong_name_is_told_with_the_nearest(swept: Path) -> None:
    with pytest.raises(QueryError, match="packing_densit: no column of that name; near: packing_density"):
        open_results(swept).query("packing_densit > 0.5")
    with pytest.raises(QueryError, match="seed = 1"):
        open_results(swept).query("seed = 1 2")


def test_old_words_and_the_start_are_in_the_table(swept: Path) -> None:
    table = open_results(swept).table()
    assert set(table["state"]) == {"succeeded"}
    assert table["vacancy_ratio_start"].tolist() == [0.4] * 5
    assert table["vacancy_ratio"].tolist() == pytest.approx([0.30, 0.34, 0.10, 0.12, 0.0])


def test_groups_are_means_over_replicates(swept: Path) -> None:
    groups = open_results(swept).query(sweep="density").groups(reach=0.2)
    assert list(groups.index) == ["density 0.7", "density 0.5"]
    assert groups["packing_density"].tolist() == [0.7, 0.5]
    assert groups["final"].tolist() == pytest.approx([0.11, 0.32])
    assert groups["final_error"].tolist() == pytest.approx([0.01, 0.02])
    assert groups["start"].tolist() == [0.4, 0.4]
    assert groups["runs"].tolist() == [2, 2]
    assert groups["reached"].iloc[0] == pytest.approx((0.2 / 0.3 + 0.2 / 0.28) / 2)
    assert np.isnan(groups["reached"].iloc[1])
    assert open_results(swept)[:0].groups().empty


def test_histories_know_the_parameters(swept: Path) -> None:
    found = open_results(swept).histories([0.25])
    dense = found.where(found["packing_density"] > 0.6, drop=True)
    assert dense.sizes["job"] == 3
    assert found["name"].values.tolist() == [f"n{k}" for k in range(1, 6)]
    assert found["seed"].values.tolist() == [1, 2, 1, 2, 1]


def test_the_same_of_a_service(tmp_path: Path) -> None:
    """Table, histories and groups, in few requests; a folder and its service say the same."""
    asked: list[str] = []
    with listening(tmp_path / "data", free_disk=0, cores=1) as url, Client(url) as client:
        client.submit_sweep({"name": "k", "base": TINY, "axes": {"model.k": [50.0, 100.0]}}).wait()
        client.submit({**TINY, "name": "alone"})
        there, here = open_results(url), open_results(tmp_path / "data")
        source = there._source
        assert isinstance(source, Service)
        source._http.event_hooks["request"].append(lambda request: asked.append(str(request.url)))
        swept = there.query("k > 10", sweep="k")
        table, other = swept.table(), here.query(sweep="k").table()
        for key in ("state", "k", "vacancy_ratio", "vacancy_ratio_start", "free_energy", "spacing"):
            assert table[key].to_dict() == other[key].to_dict()
        histories = swept.histories()
        np.testing.assert_array_equal(histories["free_energy"], here.query(sweep="k").histories()["free_energy"])
        assert histories["k"].values.tolist() == [50.0, 100.0]
        groups = swept.groups()
        assert groups["final"].tolist() == here.query(sweep="k").groups()["final"].tolist()
        assert len(asked) == 3, "jobs of the sweep, ends, histories"
        assert swept[0].snapshots()["rho"].dims == ("time", "node")
        with pytest.raises(QueryError, match="near: \\['k'\\]"):
            there.query(sweep="kk")
