"""One run directory: its history as curves, its snapshots as sections through the pack; `pictures` puts these together.

matplotlib and zarr are imported where a figure is made, for read_history() must stay quick; pyplot is not, so
that a notebook's or a server's own backend is left alone.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frit.solver.arrays import Array, Floats, Integers

if TYPE_CHECKING:
    import zarr
    from matplotlib.figure import Figure
    from scipy.spatial import cKDTree

# Paul Tol's light scheme: told apart with any colour vision, and dark lines show on all of it.
PALETTE = ("#77aadd", "#ee8866", "#eedd88", "#44bb99", "#ffaabb", "#bbcc33", "#99ddff", "#aaaa00")
NO_OWNER = "#dddddd"
BOUNDARY = np.array([0.12, 0.12, 0.16])  # colour of a grain boundary
NEIGHBOURS = {2: 9, 3: 16}  # nodes that a pixel is interpolated from
PIXELS = {2: 700, 3: 400}  # along the longest edge of the domain
PANELS = (
    ("vacancy_ratio", "vacancy ratio", "vacancy ratio"),
    ("free_energy", "free energy", "free energy"),
    ("live_fraction", "live fraction", "live fraction"),
    ("neck_length", "neck (nm)", "neck (nm²)"),
)


class PlotError(ValueError):
    """There is nothing to draw: no snapshot, no history."""


# --- history --------------------------------------------------------------------------------------------


def read_history(directory: Path) -> dict[str, Array]:
    """The scalar columns of history.jsonl, NaN where a row has none; a torn last line is left out."""
    path = directory / "history.jsonl"
    lines = path.read_bytes().split(b"\n")[:-1] if path.exists() else []  # a whole line ends with a newline
    rows = [_row(line, f"{path}, line {number}") for number, line in enumerate(lines, 1)]
    keys = dict.fromkeys(key for row in rows for key, value in row.items() if isinstance(value, int | float))
    return {key: np.array([np.nan if row.get(key) is None else row[key] for row in rows]) for key in keys}


def _row(line: bytes, where: str) -> dict[str, Any]:
    try:
        return dict(json.loads(line))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from None


def plot_history(directory: Path, out: Path) -> None:
    """Vacancy ratio against time and, below it, what else the history has of PANELS."""
    history = read_history(directory)
    if not history:
        raise PlotError(f"{directory} has no history to draw")
    case = read_case(directory)
    flat = len(case["domain"]["size"]) == 2
    panels = [(key, plane if flat else solid) for key, plane, solid in PANELS if key in history]
    heights = [2.0 if key == "vacancy_ratio" else 1.0 for key, _ in panels]
    figure = new_figure(5.2, 1.15 * sum(heights) + 0.7)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for ax, (key, label) in zip(axes, panels, strict=True):
        marker = "." if len(history[key]) < 2 else None
        ax.plot(history["time"], history[key], color="#20639b", lw=1.4, marker=marker)
        ax.set_ylabel(label)
        ax.grid(alpha=0.25, lw=0.5)
        ax.margins(x=0.01)
    axes[0].set_title(case["name"], parse_math=False)
    axes[-1].set_xlabel("time (model units)")
    figure.align_ylabels(list(axes))
    save(figure, out)


# --- snapshots ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Snapshot:
    """Fields at the nodes; `first_owner` is the owner in the first snapshot, which fixes the colours."""

    time: float
    nodes: Floats
    rho: Floats
    eta_squared: Floats
    owner: Integers
    first_owner: Integers


def nearest_time(directory: Path, time: float) -> float:
    """The time of the snapshot that is nearest to `time`."""
    times = snapshot_times(directory)
    return times[_nearest(times, time, directory)]


def snapshot_times(directory: Path) -> list[float]:
    """The times of all snapshots. Raises `PlotError` where there are none."""
    times = np.asarray(_array(_open(directory), "time")[:], float).tolist()
    if not times:
        raise PlotError(f"{directory} has no snapshots to draw")
    return list(times)


def far_away(directory: Path, time: float) -> str | None:
    """What to say where no snapshot is near a time: nearer than half the way to its next one."""
    times = snapshot_times(directory)
    nearest = min(times, key=lambda t: abs(t - time))
    others = [abs(t - nearest) for t in times if t != nearest]
    if abs(nearest - time) <= 0.5 * min(others, default=0.0) + 1e-9 * max(times):
        return None
    said = ", ".join(f"{t:g}" for t in times[:12]) + (", ..." if len(times) > 12 else "")
    return f"there is no snapshot near t = {time:g}: the nearest is at t = {nearest:g}; there are {said}"


def read_snapshot(directory: Path, time: float) -> Snapshot:
    """The snapshot nearest to `time`; the store is opened read-only."""
    group = _open(directory)
    times = np.asarray(_array(group, "time")[:], float)
    row = _nearest(times, time, directory)
    return Snapshot(
        time=float(times[row]),
        nodes=np.asarray(_array(group, "nodes")[:], float),
        rho=np.asarray(_array(group, "rho")[row], float),
        eta_squared=np.asarray(_array(group, "eta_squared")[row], float),
        owner=np.asarray(_array(group, "particle")[row], int),
        first_owner=np.asarray(_array(group, "particle")[0], int),
    )


def particle_colours(nodes: Floats, owner: Integers, last: int = 0) -> Floats:
    """Red, green, blue per particle (rows to `last` at least), grey for owner -1.

    Largest first, each takes the colour whose nearest holder is farthest away: those that can touch differ.
    """
    from matplotlib.colors import to_rgb

    mine, rows = owner >= 0, max(int(owner.max(initial=0)), last) + 1
    count = np.bincount(owner[mine], minlength=rows)
    sums = [np.bincount(owner[mine], x[mine], minlength=rows) for x in nodes.T]
    centre = np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None]
    dim, cell = nodes.shape[1], np.prod(np.ptp(nodes, axis=0)) / len(nodes)
    radius = (count * cell / {2: np.pi, 3: 4 / 3 * np.pi}[dim]) ** (1 / dim)
    gap_to_colour = np.full((rows, len(PALETTE)), np.inf)
    chosen = np.zeros(rows, int)
    for a in np.argsort(-count, kind="stable"):
        chosen[a] = c = gap_to_colour[a].argmax()
        gap = np.linalg.norm(centre - centre[a], axis=1) - radius - radius[a]
        gap_to_colour[:, c] = np.minimum(gap_to_colour[:, c], gap)
    palette: Floats = np.array([to_rgb(colour) for colour in (*PALETTE, NO_OWNER)])
    return palette[[*chosen, len(PALETTE)]]


def interpolation(tree: "cKDTree", at: Floats) -> tuple[Integers, Floats]:
    """Nodes (p, k) near points (p, dim), and weights by moving least squares: exact for linear fields.

    weight_a = w_a P_a . M^-1 (1, 0..), M = sum w P P^T, P = (1, x_a - x), w = (1 - d^2 / reach^2)^2
    """
    found = tree.query(at, min(NEIGHBOURS[tree.m] + 1, tree.n))
    distance, near = np.asarray(found[0])[..., None], np.asarray(found[1])[:, :-1]
    reach = distance[:, -1:]
    P = np.concatenate([np.ones((*near.shape, 1)), (tree.data[near] - at[:, None]) / reach], axis=-1)
    w = (1 - (distance[:, :-1] / reach) ** 2) ** 2
    M = (w * P).swapaxes(1, 2) @ P + 1e-9 * np.eye(P.shape[-1])
    return near, (w * (P @ np.linalg.solve(M, np.eye(P.shape[-1])[:, :1])))[..., 0]


def thinned(nodes: Floats) -> Array:
    """Flags of at most one node in each cube of half a mean distance: where they crowd, all that are near may lie on a
    line, and say nothing of the field across it. Of good meshes none is left out.
    """
    edge = 0.5 * (np.prod(np.ptp(nodes, axis=0)) / len(nodes)) ** (1 / nodes.shape[1])
    _, first = np.unique(np.floor((nodes - nodes.min(axis=0)) / edge).astype(np.int64), axis=0, return_index=True)
    kept = np.full(len(nodes), False)
    kept[first] = True
    return kept


class Section:
    """A plane through the domain, in 3-D through its middle: its pixels, and which nodes they are interpolated from."""

    def __init__(self, nodes: Floats, size: Floats, plane: tuple[int, int], fineness: float = 1.0) -> None:
        """fineness: times the pixels of a picture that stands alone."""
        from scipy.spatial import cKDTree

        pitch = size.max() / (fineness * PIXELS[len(size)])
        self.x, self.y = (np.linspace(0, size[k], round(size[k] / pitch)) for k in plane)
        at = np.tile(size / 2, (len(self.x) * len(self.y), 1))
        at[:, plane] = np.stack(np.meshgrid(self.x, self.y), axis=-1).reshape(-1, 2)
        close = thinned(nodes)
        for k in set(range(len(size))) - set(plane):
            spacing = (np.prod(size) / len(close)) ** (1 / len(size))
            close &= abs(nodes[:, k] - size[k] / 2) < 4 * spacing
        self.close, tree = np.flatnonzero(close), cKDTree(nodes[close])
        self.parts = [interpolation(tree, part) for part in np.array_split(at, len(at) // 20_000 + 1)]

    def shown(self, snapshot: Snapshot, colours: Floats) -> tuple[Floats, Floats]:
        """rho (ny, nx) and picture (ny, nx, 3)."""
        density, order, owner = snapshot.rho[self.close], snapshot.eta_squared[self.close], snapshot.owner[self.close]
        found = [_shade(weight, density[near], order[near], owner[near], colours) for near, weight in self.parts]
        rho, picture = (np.concatenate(parts) for parts in zip(*found, strict=True))
        shape = len(self.y), len(self.x)
        return rho.reshape(shape), picture.reshape(*shape, 3)


def _shade(
    weight: Floats, rho: Floats, eta_squared: Floats, owner: Integers, colours: Floats
) -> tuple[Floats, Floats]:
    """rho (p,) and colour (p, 3) of pixels from their nodes (p, k): vacancy white, grain boundaries dark.

    Where two grains meet eta_a + eta_b = rho: the owner leads by eta_a - eta_b = sqrt(2 sum eta^2 - rho^2).
    Interpolated with the sign of its owner, the lead is smooth across a boundary: its zero is the dark line.
    """
    owned = owner >= 0
    lead = np.sqrt((2 * eta_squared - rho**2).clip(0, rho.clip(0) ** 2))
    alike = (owner[:, :, None] == owner[:, None]) & owned[:, None]
    share = (alike @ (weight * lead)[..., None])[..., 0]
    first = np.take_along_axis(owner, share.argmax(axis=1)[:, None], axis=1)
    ahead = share.max(axis=1) - np.where(owner == first, 0.0, share).max(axis=1)
    here = (weight * rho).sum(axis=1)
    behind = ((weight * rho * owned).sum(axis=1) - ahead) / here.clip(0.5)
    dark = (1 - (1 - behind).clip(0, 1) ** 2) ** 2
    solid = (4 * here - 1.5).clip(0, 1)
    colour = colours[first[:, 0]]
    return here, 1 + solid[:, None] * (colour + dark[:, None] * (BOUNDARY - colour) - 1)


def new_figure(width: float, height: float) -> "Figure":
    """Inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=200, layout="constrained")


def save(figure: "Figure", out: Path) -> None:
    """In the sizes of a printed column; set here, for matplotlib's global settings are not ours."""
    for ax in figure.axes:
        ax.tick_params(labelsize=8, width=0.6)
        ax.title.set_fontsize(9)
        for axis in (ax.xaxis, ax.yaxis):
            axis.label.set_fontsize(8.5)
            axis.get_offset_text().set_fontsize(7)
        for spine in ax.spines.values():
            spine.set_linewidth(0.6)
    figure.savefig(out)


# --- files ----------------------------------------------------------------------------------------------


def read_case(directory: Path) -> dict[str, Any]:
    """case.json of a run directory."""
    case: dict[str, Any] = json.loads((directory / "case.json").read_text())
    return case


def _open(directory: Path) -> "zarr.Group":
    import zarr

    if not (directory / "snapshots.zarr").is_dir():
        raise PlotError(f"{directory} has no snapshots to draw")
    return zarr.open_group(directory / "snapshots.zarr", mode="r")


def _array(group: "zarr.Group", name: str) -> "zarr.Array[Any]":
    import zarr

    if not isinstance(array := group[name], zarr.Array):
        raise PlotError(f"snapshots.zarr: {name} is not an array")
    return array


def _nearest(times: Sequence[float] | Floats, time: float, directory: Path) -> int:
    if not len(times):
        raise PlotError(f"{directory} has no snapshots to draw")
    return int(np.argmin(abs(np.asarray(times) - time)))
