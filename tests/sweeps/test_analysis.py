"""Results from a data folder: real runs of two tiny cases, read back as a table, histories and snapshots."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from launching import PAIR, solve

from frit.sweeps import open_results


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs to different ends with different history times, and one that has not started."""
    folder = tmp_path_factory.mktemp("data")
    (folder / "runs").mkdir()
    shorter: dict[str, Any] = PAIR | {
        "time": PAIR["time"] | {"end": 0.004},
        "model": {"A": 12.0},
        "output": {"history_every": 0.002, "snapshots": [0.0, 0.004]},
    }
    for job, case in (("a", PAIR), ("b", shorter)):
        solve(case, folder / "runs" / job)
    (folder / "runs" / "c").mkdir()
    shutil.copy(folder / "runs" / "a" / "case.json", folder / "runs" / "c")
    return folder


def test_a_row_per_job_with_its_case_and_its_last_values(data: Path) -> None:
    table = open_results(data).table()
    assert list(table.index) == ["a", "b", "c"]
    assert table.loc["a", "state"] == "done"
    assert table["A"].tolist() == [16.0, 12.0, 16.0]
    assert table["end"].tolist() == [0.01, 0.004, 0.01]
    assert table["nodes_source"].tolist() == ["lattice"] * 3
    assert table.loc[["a", "b"], "time"].tolist() == [0.01, 0.004]
    assert table["vacancy_ratio"].isna().tolist() == [False, False, True]
    assert table.columns.is_unique


def test_queries_narrow_the_runs(data: Path) -> None:
    results = open_results(data)
    assert [run.job for run in results.query("A > 13 and state == 'done'")] == ["a"]
    assert len(results.query("A > 99")) == 0
    assert open_results(data)[1].job == "b"
    assert [run.job for run in results[1:]] == ["b", "c"]


def test_histories_share_their_times(data: Path) -> None:
    found = open_results(data).query("state == 'done'").histories()
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
