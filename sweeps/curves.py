"""Curves of a sweep in one picture, page or table: an observable against time, a line for each point."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from frit.solver.arrays import Array

from .labels import words
from .ranking import Outcome, Point, Ranking

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_NAMED = 16  # lines that a legend names; where there are more, or a long scale of one axis, a colour bar tells them
SCALE = 6  # points along a single axis of numbers that make a scale
NOTE = "Compare packs of equal size: with rigid motion, shrinkage depends on the number of particles (Seiz 2023)."
BAND = "bands: mean ± standard error over the replicates"
LABELS = {
    "vacancy_ratio": "vacancy ratio", "pack_porosity": "porosity of the pack", "free_energy": "free energy",
    "neck_length": "neck (nm)",
}  # fmt: skip
TIME = "time (model units)"


class Look(NamedTuple):
    """How curves are drawn."""

    runs: bool = False
    """single runs as well, thin"""
    log_time: bool = False


@dataclass(frozen=True)
class Line:
    """A point: the mean over its replicates at all their times, and its standard error, NaN of a single run."""

    point: Point
    time: Array
    mean: Array
    error: Array
    colour: str

    @property
    def label(self) -> str:
        """Of the point; how it ended where none of its runs did well."""
        states = sorted({run.state for run in self.point.runs})
        return self.point.label if self.point.done else f"{self.point.label} ({', '.join(states)})"


def drawn(point: Point) -> list[Outcome]:
    """The runs of a point that have a curve: those that reached their end, or all where none did."""
    return point.done or [run for run in point.runs if len(run.curve[0])]


def write(out: Path, observable: str, ranking: Ranking, look: Look = Look()) -> None:  # noqa: B008  (is immutable)
    """Into a file whose suffix says how: .csv, .html or a picture."""
    if out.suffix == ".csv":
        return write_csv(out, observable, ranking)
    if out.suffix == ".html":
        return write_page(out, observable, ranking, look)
    figure(observable, ranking, look).savefig(out)


def lines(ranking: Ranking) -> list[Line]:
    """A line for each point that has any curve, the highest at the end first, as a legend reads."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    made = []
    for point, share in zip(ranking.points, shares(ranking), strict=True):
        if runs := drawn(point):
            time, mean, error = averaged(runs)
            made.append(Line(point, time, mean, error, to_hex(colormaps["viridis"](0.92 * share))))
    return sorted(made, key=lambda line: -line.mean[-1])


def averaged(runs: Sequence[Outcome]) -> tuple[Array, Array, Array]:
    """Times, mean and standard error up to the end that all runs reach; between rows a run is a straight line."""
    curves = [run.curve for run in runs]
    every = np.unique(np.concatenate([time for time, _ in curves]))
    first, last = max(time[0] for time, _ in curves), min(time[-1] for time, _ in curves)
    time = every[(every >= first) & (every <= last)]
    values = np.array([np.interp(time, *curve) for curve in curves])
    error = values.std(axis=0, ddof=1) / np.sqrt(len(runs)) if len(runs) > 1 else np.full(len(time), np.nan)
    return time, values.mean(axis=0), error


def scale(ranking: Ranking) -> str | None:
    """The axis that a colour bar shows, where one tells more than a legend would."""
    strongest = ranking.strongest()
    alone = len(ranking.axes) == 1 and len(ranking.points) >= SCALE
    return strongest if alone or len(ranking.points) > MOST_NAMED else None


def shares(ranking: Ranking) -> list[float]:
    """The place of each point along the scale of colours, 0 to 1: by the axis of the colour bar, or one after another
    in the order of their values.
    """
    if (axis := scale(ranking)) is not None:
        values = np.array([point.parameters[axis] for point in ranking.points], float)
        return [float(x) for x in (values - values.min()) / (np.ptp(values) or 1.0)]
    order = sorted(range(len(ranking.points)), key=lambda k: _sortable(ranking.points[k], ranking.axes))
    places = {k: place for place, k in enumerate(order)}
    return [places[k] / max(len(order) - 1, 1) for k in range(len(order))]


def _sortable(point: Point, axes: Sequence[str]) -> list[tuple[float, str]]:
    values = [point.parameters.get(axis) for axis in axes]
    return [(float(v), "") if isinstance(v, int | float) else (0.0, str(v)) for v in values]


def figure(observable: str, ranking: Ranking, look: Look = Look()) -> "Figure":  # noqa: B008
    """The curves over model time, with a legend or a colour bar beside them."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(7.4, 4.2), dpi=160, layout="constrained")
    ax, many = made.subplots(), scale(ranking) is not None
    every = lines(ranking)
    for number, line in enumerate(every):
        if look.runs and len(drawn(line.point)) > 1:
            for run in drawn(line.point):
                ax.plot(*run.curve, color=line.colour, lw=0.5, alpha=0.6)
        label = line.label if not many and number < MOST_NAMED else None
        marker = "." if len(line.time) < 2 else None
        dashes = "-" if line.point.done else (0, (2, 1.5))
        ax.plot(line.time, line.mean, color=line.colour, lw=1.5, marker=marker, label=label, ls=dashes)
        if np.isfinite(line.error).all():
            ax.fill_between(
                line.time, line.mean - line.error, line.mean + line.error, color=line.colour, alpha=0.22, lw=0
            )
    if ranking.level is not None:
        ax.axhline(ranking.level, color="#444444", lw=0.7, ls=(0, (4, 3)))
    if look.log_time:
        ax.set_xscale("log", nonpositive="mask")
    ax.set_xlabel(TIME, fontsize=9)
    ax.set_ylabel(LABELS.get(observable, observable.replace("_", " ")), fontsize=9)
    ax.tick_params(labelsize=8)
    ax.grid(alpha=0.25, lw=0.5)
    ax.margins(x=0.01)
    _tell(made, ranking, every)
    return made


def _tell(made: "Figure", ranking: Ranking, every: Sequence[Line]) -> None:
    """Which line is which, and what the bands are."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    ax = made.axes[0]
    if (axis := scale(ranking)) is not None:
        values = [point.parameters[axis] for point in ranking.points]
        shown = ListedColormap(colormaps["viridis"](np.linspace(0.0, 0.92, 256)))
        bar = made.colorbar(ScalarMappable(Normalize(min(values), max(values)), shown), ax=ax, pad=0.02)
        bar.set_label(words(ranking.axes)[axis], fontsize=9)
        bar.ax.tick_params(labelsize=8)
    elif len(every) > 1:
        legend = made.legend(loc="outside right upper", fontsize=7.5, frameon=False)
        for text in legend.get_texts():
            text.set_parse_math(False)  # a dollar in a name begins no formula
        if len(every) > MOST_NAMED:
            made.text(0.99, 0.01, f"and {len(every) - MOST_NAMED} more lines", fontsize=7, ha="right")
    if any(np.isfinite(line.error).all() for line in every):
        ax.set_title(BAND, fontsize=7.5, loc="right", color="#555555")


def write_csv(out: Path, observable: str, ranking: Ranking) -> None:
    """A row per job and time: name, parameters, time, value."""
    runs = [run for point in ranking.points for run in point.runs]
    keys = list(dict.fromkeys(key for run in runs for key in run.parameters))
    with open(out, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["job", "name", *keys, "time", observable])
        for run in runs:
            fixed = [run.job, run.name, *(run.parameters.get(key) for key in keys)]
            writer.writerows([*fixed, t, value] for t, value in zip(run.time, run.values, strict=True))


def write_page(out: Path, observable: str, ranking: Ranking, look: Look = Look()) -> None:  # noqa: B008
    """One file that needs no network: curves that can be switched on and off, and zoomed."""
    import plotly.graph_objects as go

    page, axis = go.Figure(), scale(ranking)
    for line in lines(ranking):
        own: dict[str, Any] = {"legendgroup": line.label, "line": {"color": line.colour}}
        faint: dict[str, Any] = {"legendgroup": line.label, "showlegend": False, "hoverinfo": "skip"}
        if np.isfinite(line.error).all():
            edges = np.concatenate([line.mean + line.error, (line.mean - line.error)[::-1]])
            page.add_trace(go.Scatter(
                x=[*line.time, *line.time[::-1]], y=edges.tolist(), fill="toself", opacity=0.3, fillcolor=line.colour,
                line={"width": 0}, **faint,
            ))  # fmt: skip
        if look.runs and len(drawn(line.point)) > 1:
            for run in drawn(line.point):
                x, y = run.curve
                page.add_trace(go.Scatter(x=x, y=y, line={"color": line.colour, "width": 0.6}, opacity=0.6, **faint))
        name = line.label.replace("<", "&lt;")  # a legend understands some marks
        page.add_trace(go.Scatter(x=line.time, y=line.mean, name=name, showlegend=axis is None, **own))
    if axis is not None:
        values = [point.parameters[axis] for point in ranking.points]
        bar = {"title": {"text": words(ranking.axes)[axis]}}
        marker = {"color": [min(values), max(values)], "colorscale": "Viridis", "showscale": True, "colorbar": bar}
        page.add_trace(go.Scatter(x=[None, None], y=[None, None], mode="markers", marker=marker, showlegend=False))
    label = LABELS.get(observable, observable.replace("_", " "))
    page.update_layout(xaxis_title=TIME, yaxis_title=label, title={"text": NOTE, "font": {"size": 12}})
    page.update_xaxes(type="log" if look.log_time else "linear")
    if ranking.level is not None:
        page.add_hline(y=ranking.level, line={"dash": "dash", "width": 1})
    page.write_html(out, include_plotlyjs=True, full_html=True)
