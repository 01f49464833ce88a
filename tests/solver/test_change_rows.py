"""Rows where things happen: one whenever the vacancy ratio has moved. In the real solver."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from launching import PAIR, different, history, interrupted, resume, solve

from frit.solver.case import CaseError, parse_case
from frit.solver.pack_box import PackBox, overlap

# One row at the end alone, but for those of the vacancy ratio.
SPARSE: dict[str, Any] = PAIR | {"output": {"history_every": 0.01, "snapshots": [0.0]}}


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return solve(SPARSE, tmp_path_factory.mktemp("rows") / "1")


def test_no_row_is_far_from_the_one_before(alone: Path) -> None:
    """A step of 1e-4 moves the ratio by less than another 0.5 % of its first value: the limit is met that closely."""
    rows = history(alone)
    times, ratio = (np.array([row[key] for row in rows]) for key in ("time", "vacancy_ratio"))
    assert len(rows) > 3, "the first row after 0 hides nothing"
    assert (np.diff(times) > 0).all()
    moved = np.abs(np.diff(ratio)) / ratio[0]
    assert (moved[:-1] >= 0.02).all(), "no more rows than are asked for; the last one is the end"
    assert moved.max() < 0.025


@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_agree_on_the_rows(alone: Path, ranks: int) -> None:
    assert different(alone, solve(SPARSE, alone.with_name(str(ranks)), ranks), 1e-10) == {}


def test_a_resumed_run_has_the_rows_of_an_uninterrupted_one(alone: Path) -> None:
    """It is cut between two such rows: the last one before counts on."""
    cut = interrupted(SPARSE, alone.with_name("cut"), step=17)
    assert len(history(cut)) < len(history(alone))
    assert different(alone, resume(cut), 0.0) == {}


def test_the_key_leaves_identities_as_they_were_and_is_checked() -> None:
    tree = {**PAIR, "output": {"history_every": 0.1}}
    default, same, other = (
        parse_case({**tree, "output": {**tree["output"], **more}}).identity()
        for more in ({}, {"history_change": 0.02}, {"history_change": 0.01})
    )
    assert default == same == "66b7650f70e3dd2cc3064f9f0fd9b38340b9e28bc144f36356bf6a447f8eee17"
    assert other != default
    with pytest.raises(CaseError, match=r"output.history_change = 0.0001: must be 0 or between 0.001 and 1"):
        parse_case({**tree, "output": {"history_change": 1e-4}})


def test_the_box_of_a_pack_follows_its_centres() -> None:
    """Four discs that come together by 10 % along x and 20 % along y, and move by (1, 2) nm."""
    centres = np.array([[20.0, 20.0], [60.0, 20.0], [20.0, 60.0], [60.0, 60.0]])
    case = parse_case({
        "domain": {"size": [80.0, 80.0]}, "nodes": {"spacing": 1.0}, "time": {"end": 1.0},
        "particles": {"centres": centres.tolist(), "radii": [10.0] * 4},
        "output": {"vacancy_box": [[20.0, 10.0], [60.0, 70.0]]},
    })  # fmt: skip
    moved = 40.0 + (centres - 40.0) * [0.9, 0.8] + [1.0, 2.0]
    moments = np.column_stack([np.full(4, 300.0), 300.0 * (moved - 40.0)])
    low, high = PackBox(case).now(moments)
    np.testing.assert_allclose(low, [23.0, 18.0])
    np.testing.assert_allclose(high, [59.0, 66.0])
    assert overlap(np.array([0.0, 1.0, 2.0]), 1.0, 0.25, 1.75).tolist() == [0.25, 1.0, 0.25]


def test_centres_on_a_line_tell_nothing_across_it(alone: Path) -> None:
    """The pair's box keeps its height; along the pair it shrinks as the centres come together."""
    rows = history(alone)
    assert rows[0]["pack_porosity"] == pytest.approx(rows[0]["vacancy_ratio"], abs=1e-3)
    assert rows[-1]["centre_distance"] < 0.99 * rows[0]["centre_distance"]
    assert rows[-1]["pack_porosity"] < rows[-1]["vacancy_ratio"]
