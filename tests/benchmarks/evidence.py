"""The evidence for frit's defaults, two figures: `python tests/benchmarks/evidence.py [precision | resolution]`.

precision.png   error against evaluations for `rk2` and `adaptive`, a pair of discs with rigid motion
resolution.png  neck error against the time of one core, for gamma 0.8 ... 4 and linear functions at several spacings

The numbers behind them go to stdout; seconds are of this machine, their ratios are what counts.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from bench import Loop, two_discs
from bench_paper import NECK

from frit.solver.case import Case, parse_case
from frit.solver.integrators import paper_step
from frit.solver.run import RunError

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

HERE = Path(__file__).parent


def pair(**time: Any) -> Case:
    """Two touching discs of radius 10 nm with rigid motion, to t = 1."""
    return parse_case({
        "domain": {"size": [60.0, 40.0]},
        "nodes": {"spacing": 1.0},
        "particles": {"centres": [[20.0, 20.0], [40.0, 20.0]], "radii": [10.0, 10.0]},
        "time": {"end": 1.0} | time,
        "output": {"history_every": 1.0, "snapshots": []},
    })  # fmt: skip


def errors(loop: Loop, exact: Loop) -> tuple[float, float]:
    """Relative errors of neck and distance."""
    return abs(loop.neck / exact.neck - 1.0), abs(loop.distance / exact.distance - 1.0)


def finish(axes: Axes, x: str, y: str, name: str) -> None:
    """Label the axes and write the picture beside this file."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(which="both", alpha=0.3)
    axes.legend()
    plt.savefig(HERE / name, dpi=110)


def precision() -> None:
    """Both integrators against `rk2` at a fiftieth of its stable step."""
    exact = Loop(pair(integrator="rk2", step=2e-5))
    _, axes = plt.subplots(figsize=(6.0, 4.2), layout="constrained")
    for name, key, values in (
        ("rk2", "step", (1e-3, 5e-4, 2e-4, 1e-4)),
        ("adaptive", "tolerance", (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5)),
    ):
        loops = [Loop(pair(integrator=name, **{key: value})) for value in values]
        found = np.array([errors(loop, exact) for loop in loops])
        counts = [loop.evaluations for loop in loops]
        for value, count, (neck, distance) in zip(values, counts, found, strict=True):
            print(f"{name:10}{key} {value:7.0e}  {count:6} evaluations  neck {neck:.1e}  distance {distance:.1e}")
        for column, label, style in ((0, "neck", "-o"), (1, "distance", "--s")):
            colour = "tab:blue" if name == "adaptive" else "tab:red"
            axes.loglog(counts, found[:, column], style, color=colour, label=f"{name}, {label}")
    axes.set_title("A pair of discs of radius 10 nm with rigid motion")
    finish(axes, "evaluations of the rates to t = 1", "relative error at t = 1", "precision.png")


def resolution() -> None:
    """Neck error at t = 10 against seconds, each curve one gamma over the spacings."""
    _, axes = plt.subplots(figsize=(6.0, 4.2), layout="constrained")
    kinds: list[tuple[str, dict[str, Any]]] = [
        *((f"gamma {gamma}", {"gamma": gamma}) for gamma in (0.8, 1.2, 1.8, 2.5, 4.0)),
        ("linear", {"kind": "linear"}),
    ]
    for name, given in kinds:
        seconds, error = [], []
        for spacing in (2.0, 1.4, 1.0, 0.7):
            case = two_discs(
                nodes={"spacing": spacing}, shape_functions=given, time={"end": 10.0, "integrator": "adaptive"}
            )
            try:
                loop = Loop(case)
            except RunError as failure:
                print(f"{name:10}spacing {spacing}  fails: {str(failure)[:60]} ...")
                continue
            seconds.append(loop.seconds)
            error.append(abs(loop.neck / NECK - 1.0))
            step = paper_step(spacing, case)
            print(
                f"{name:10}spacing {spacing}  {loop.evaluations:5} evaluations  {loop.seconds:6.2f} s  "
                f"neck {loop.neck / NECK - 1.0:+.2%}  (the paper's step: {2 * round(10 / step)} evaluations)"
            )
        axes.loglog(seconds, error, "-o", label=name)
    axes.axhline(0.01, color="grey", linewidth=0.8)
    axes.set_title("Two discs of radius 20 nm, spacing 2, 1.4, 1, 0.7 nm")
    finish(axes, "seconds of one core to t = 10", "relative error of the neck at t = 10", "resolution.png")


FIGURES: dict[str, Callable[[], None]] = {"precision": precision, "resolution": resolution}

if __name__ == "__main__":
    for chosen in sys.argv[1:] or FIGURES:
        FIGURES[chosen]()
