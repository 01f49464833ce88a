"""Curves of several jobs in one picture, page or table: an observable against time, named by what differs."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_NAMED = 16  # curves that a picture's legend names
NOTE = "Compare packs of equal size: with rigid motion, shrinkage depends on the number of particles (Seiz 2023)."
LABELS = {"vacancy_ratio": "vacancy ratio", "free_energy": "free energy", "neck_length": "neck (nm)"}
REPLICATE = "particles.seed"  # curves that differ in this alone have one colour


@dataclass(frozen=True)
class Curve:
    """One job: its name, the parameters in which jobs differ, and the observable's values at model times [1]."""

    name: str
    parameters: Mapping[str, Any]
    time: Sequence[float]
    values: Sequence[float | None]

    @property
    def label(self) -> str:
        """The parameters in words; the name where there are none."""
        return ", ".join(f"{key.rsplit('.', 1)[-1]} {value}" for key, value in self.parameters.items()) or self.name

    @property
    def group(self) -> str:
        """Equal for replicates."""
        return repr([(key, value) for key, value in self.parameters.items() if key != REPLICATE])


def write(out: Path, observable: str, curves: Sequence[Curve]) -> None:
    """Into a file whose suffix says how: .csv, .html or a picture."""
    if out.suffix == ".csv":
        return write_csv(out, observable, curves)
    if out.suffix == ".html":
        return write_page(out, observable, curves)
    figure(observable, curves).savefig(out)


def colours(curves: Sequence[Curve]) -> list[str]:
    """One per curve: along viridis in the order of the groups, so that an axis of the sweep is a scale of colour."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    groups = list(dict.fromkeys(curve.group for curve in curves))
    at = {group: 0.92 * k / max(len(groups) - 1, 1) for k, group in enumerate(groups)}
    return [to_hex(colormaps["viridis"](at[curve.group])) for curve in curves]


def figure(observable: str, curves: Sequence[Curve]) -> "Figure":
    """The curves over model time, with a legend beside them."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(7.0, 4.2), dpi=160, layout="constrained")
    ax = made.subplots()
    named = set[str]()
    for curve, colour in zip(curves, colours(curves), strict=True):
        values = [float("nan") if value is None else value for value in curve.values]
        label = None if curve.group in named or len(named) >= MOST_NAMED else curve.label
        named.add(curve.group)
        marker = "." if len(values) < 2 else None
        ax.plot(curve.time, values, color=colour, lw=1.5, marker=marker, label=label)
    ax.set_xlabel("time (model units)", fontsize=9)
    ax.set_ylabel(LABELS.get(observable, observable.replace("_", " ")), fontsize=9)
    ax.tick_params(labelsize=8)
    ax.grid(alpha=0.25, lw=0.5)
    ax.margins(x=0.01)
    if len(curves) > 1:
        legend = made.legend(loc="outside right upper", fontsize=7.5, frameon=False)
        for text in legend.get_texts():
            text.set_parse_math(False)  # a dollar in a name begins no formula
    return made


def write_csv(out: Path, observable: str, curves: Sequence[Curve]) -> None:
    """A row per job and time: name, parameters, time, value."""
    keys = list(dict.fromkeys(key for curve in curves for key in curve.parameters))
    with open(out, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["name", *keys, "time", observable])
        for curve in curves:
            fixed = [curve.name, *(curve.parameters.get(key) for key in keys)]
            writer.writerows([*fixed, t, value] for t, value in zip(curve.time, curve.values, strict=True))


def write_page(out: Path, observable: str, curves: Sequence[Curve]) -> None:
    """One file that needs no network: curves that can be switched on and off, and zoomed."""
    import plotly.graph_objects as go

    page = go.Figure()
    for curve, colour in zip(curves, colours(curves), strict=True):
        page.add_trace(go.Scatter(x=list(curve.time), y=list(curve.values), name=curve.label, line={"color": colour}))
    label = LABELS.get(observable, observable.replace("_", " "))
    page.update_layout(xaxis_title="time (model units)", yaxis_title=label, title={"text": NOTE, "font": {"size": 12}})
    page.write_html(out, include_plotlyjs=True, full_html=True)
