"""Which packing is densest, fastest: curves whose ends and crossings are known, with replicates, failures and axes."""

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from frit.sweeps import curves, labels
from frit.sweeps.curves import Look
from frit.sweeps.ranking import Mean, Outcome, Ranking, rank, with_error

DENSITY, SPREAD, SEED = "particles.packing_density", "particles.std_radius", labels.REPLICATE


def straight(end: float, state: str = "succeeded", start: float = 0.4, **parameters: Any) -> Outcome:
    """From start to end along a straight line in the time 1."""
    keys = {"density": DENSITY, "spread": SPREAD, "seed": SEED}
    named = {keys.get(key, key): value for key, value in parameters.items()}
    name = " ".join(f"{key}={value}" for key, value in named.items())
    return Outcome(f"{state} {name}", name, state, named, [0.0, 0.5, 1.0], [start, (start + end) / 2, end], end - 0.01)


@pytest.fixture
def sweep() -> Ranking:
    """Two axes, two replicates: 0.75 is denser, the spread does little; one run failed."""
    runs = [
        straight(end + shift, state, density=density, spread=spread, seed=seed)
        for density, spread, end in ((0.55, 0.5, 0.30), (0.55, 1.0, 0.32), (0.75, 0.5, 0.10), (0.75, 1.0, 0.14))
        for seed, shift, state in ((1, 0.0, "succeeded"), (2, 0.02, "failed" if end == 0.14 else "succeeded"))
    ]
    return rank(runs, 0.2)


def test_points_come_in_the_order_of_their_means(sweep: Ranking) -> None:
    assert [point.label for point in sweep.points] == [
        "density 0.75, spread 0.5", "density 0.75, spread 1", "density 0.55, spread 0.5", "density 0.55, spread 1",
    ]  # fmt: skip
    first, second = sweep.points[:2]
    assert first.final.value == pytest.approx(0.11)
    assert first.final.error == pytest.approx(0.01)  # 0.10 and 0.12: deviation 0.0141, by the root of two
    assert first.drop.value == pytest.approx(0.29)
    assert first.porosity.value == pytest.approx(0.10)
    assert second.final.value == pytest.approx(0.14)
    assert second.final.error is None


def test_what_failed_is_named_and_counts_for_nothing(sweep: Ranking) -> None:
    assert [(run.state, run.parameters[SEED]) for run in sweep.left_out] == [("failed", 2)]
    row = next(row for row in sweep.rows("vacancy ratio") if row["runs"] == "1 of 2")
    assert (row["spread"], row["not done"]) == (1.0, "failed")
    assert rank([straight(0.1, "lost", density=0.5), straight(0.2, density=0.6)]).points[-1].final.value is None


def test_the_time_to_a_level_is_between_rows(sweep: Ranking) -> None:
    """0.4 to 0.1 in the time 1 comes to 0.2 at two thirds; 0.4 to 0.12 at 0.714."""
    first = sweep.points[0]
    assert first.times == [pytest.approx(2 / 3), pytest.approx(0.2 / 0.28)]
    assert sweep.fastest is first
    assert sweep.points[3].time_in_words() == "not reached"
    half = rank([straight(0.1, a=1, seed=1), straight(0.3, a=1, seed=2)], 0.2)
    assert half.points[0].time_in_words() == "reached by 1 of 2"
    assert half.fastest is None
    assert straight(0.1, start=0.15).reached(0.2) == 0.0, "it is there from the start"
    assert straight(0.4, start=0.1).reached(0.25) == pytest.approx(0.5), "what rises comes from below"


def test_what_each_axis_does_is_a_mean_over_the_others(sweep: Ranking) -> None:
    effects = {(effect.axis, effect.value): effect.final for effect in sweep.effects()}
    assert effects[DENSITY, "0.55"].value == pytest.approx((0.31 + 0.33) / 2)
    assert effects[DENSITY, "0.75"].value == pytest.approx((0.11 + 0.14) / 2)
    assert effects[SPREAD, "0.5"].value == pytest.approx((0.31 + 0.11) / 2)
    assert effects[DENSITY, "0.55"].error == pytest.approx(math.hypot(0.01, 0.01) / 2), "of replicates, not of points"
    assert sweep.strongest() == DENSITY
    drawn = rank([straight(1 - x, density=float(x)) for x in np.linspace(0.1, 0.9, 20)])
    assert [(effect.value, effect.points) for effect in drawn.effects()] == [("0.1 to 0.479", 10), ("0.521 to 0.9", 10)]


def test_the_answer_in_words(sweep: Ranking) -> None:
    assert sweep.answer("vacancy ratio") == [
        "lowest vacancy ratio: density 0.75, spread 0.5 (0.110 ± 0.010)",
        "first at 0.2: density 0.75, spread 0.5 (t = 0.690 ± 0.024)",
    ]
    assert with_error(Mean(0.123456, 0.00034)) == "0.12346 ± 0.00034"
    assert with_error(Mean(None)) is None


def test_labels_are_short_and_unique() -> None:
    assert labels.words(["particles.std_radius", "time.tolerance", "shape_functions.tolerance"]) == {
        "particles.std_radius": "spread",
        "time.tolerance": "time.tolerance",
        "shape_functions.tolerance": "shape functions.tolerance",
    }
    points = [{DENSITY: 0.65, SPREAD: 0.50001}, {DENSITY: 0.65, SPREAD: 0.50002}]
    assert labels.labels(points) == ["spread 0.50001", "spread 0.50002"]
    long = [{"particles": "x" * 50 + "a"}, {"particles": "x" * 50 + "b"}]
    assert len(set(labels.labels(long))) == 2
    assert labels.labels([{SEED: 1}]) == [""]


def test_lines_are_means_over_the_replicates(sweep: Ranking) -> None:
    made = {line.label: line for line in curves.lines(sweep)}
    line = made["density 0.75, spread 0.5"]
    assert line.mean.tolist() == pytest.approx([0.4, 0.255, 0.11])
    assert line.error[-1] == pytest.approx(0.01)
    assert np.isnan(made["density 0.75, spread 1"].error).all()
    assert len({line.colour for line in made.values()}) == 4
    lost = rank([straight(0.1, "lost", density=0.5), straight(0.2, density=0.6)])
    assert {line.label for line in curves.lines(lost)} == {"density 0.5 (lost)", "density 0.6"}


def test_replicates_with_other_times_are_averaged_where_all_are() -> None:
    a = Outcome("a", "a", "succeeded", {SEED: 1}, [0.0, 1.0, 2.0], [1.0, 0.5, 0.0])
    b = Outcome("b", "b", "succeeded", {SEED: 2}, [0.0, 0.5, 1.5], [1.0, None, 0.25])
    time, mean, _ = curves.averaged([a, b])
    assert time.tolist() == [0.0, 1.0, 1.5]
    assert mean.tolist() == pytest.approx([1.0, 0.5, 0.25])


def test_a_long_axis_gets_a_colour_bar_and_a_short_one_a_legend(sweep: Ranking) -> None:
    assert curves.scale(sweep) is None
    places = np.random.default_rng(1).random((20, 2)).tolist()
    drawn = rank([straight(1 - x, density=x, spread=y) for x, y in places])
    assert curves.scale(drawn) == DENSITY
    figure = curves.figure("vacancy_ratio", drawn)
    assert figure.axes[1].get_ylabel() == "density"
    assert figure.legends == []
    named = curves.figure("vacancy_ratio", sweep, Look(runs=True, log_time=True))
    assert named.axes[0].get_xscale() == "log"
    assert named.legends[0].get_texts()[0].get_text() == "density 0.55, spread 1"


def test_files_of_curves(sweep: Ranking, tmp_path: Path) -> None:
    for name in ("a.png", "a.html", "a.csv"):
        curves.write(tmp_path / name, "vacancy_ratio", sweep, Look(runs=True))
    assert imread(tmp_path / "a.png").shape[1] > 1000
    page = (tmp_path / "a.html").read_text()
    assert "density 0.75, spread 0.5" in page
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 * 3, "all runs, also the failed one"
    assert list(rows[0]) == ["job", "name", DENSITY, SPREAD, SEED, "time", "vacancy_ratio"]
