"""Pictures of the snapshots of one run: one, several beside each other, or all of them as a movie."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from frit.solver.arrays import Floats

from . import plots
from .plots import PlotError, Snapshot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Colour = Literal["particle", "radius", "rho", "boundary"]
COLOURS: tuple[Colour, ...] = ("particle", "radius", "rho", "boundary")
PALE = np.array([0.86, 0.86, 0.84])  # of grains where their boundaries are what is shown
NONE = np.array([0.87, 0.87, 0.87])
SCALES = {"radius": "radius at the start (nm)", "rho": "concentration"}
MOST_PANELS = 12
SMALL = 0.6  # of the pixels of a picture that stands alone: for panels and frames
FRAMES = 10  # of a movie, in a second


class Look(NamedTuple):
    """How a snapshot is drawn."""

    colour: Colour = "particle"
    sections: bool = False
    """of spheres: the three mid-planes, not the surface"""


class Scene:
    """What all snapshots of a run have in common: sizes, colours, the box."""

    def __init__(self, directory: Path, look: Look, fineness: float = 1.0) -> None:
        """fineness: see `plots.Section`."""
        self.directory, self.look, self.case = directory, look, plots.read_case(directory)
        self.size = np.asarray(self.case["domain"]["size"], float)
        self.box = (self.case.get("output") or {}).get("vacancy_box")
        first = plots.read_snapshot(directory, -np.inf)
        last = max(int(first.owner.max(initial=0)), int(first.first_owner.max(initial=0)))
        self.radii = radii_of(first, self.size, last + 1)
        self.colours = self._colours(first, last)
        self.fineness = fineness
        self.cuts: dict[tuple[int, int], plots.Section] = {}

    def _colours(self, first: Snapshot, last: int) -> Floats:
        """A row per particle, the last one for none."""
        from matplotlib import colormaps

        if self.look.colour == "boundary":
            return np.tile(PALE, (last + 2, 1))
        if self.look.colour == "radius":
            low, high = self.limits()
            found = np.asarray(colormaps["viridis"]((self.radii - low) / (high - low)))[:, :3]
            return np.vstack([found, NONE])
        return plots.particle_colours(first.nodes, first.first_owner, last)

    def limits(self) -> tuple[float, float]:
        """Of the colour bar."""
        if self.look.colour == "rho":
            return 0.0, 1.0
        low, high = float(self.radii.min()), float(self.radii.max())
        return (low, high) if high - low > 1e-6 * high else (0.9 * low, 1.1 * high)

    @property
    def planes(self) -> list[tuple[int, int]]:
        """The sections of one snapshot; none: its surface."""
        if len(self.size) == 2:
            return [(0, 1)]
        return [(0, 1), (0, 2), (1, 2)] if self.look.sections or self.look.colour == "rho" else []

    def ratio(self) -> float:
        """Height over width of one snapshot."""
        if self.planes:
            return float(max(self.size[j] for _, j in self.planes) / sum(self.size[i] for i, _ in self.planes))
        return 1.0

    def draw(self, axes: Sequence["Axes"], snapshot: Snapshot) -> None:
        """Into one axes for each plane, or into a single one."""
        if not self.planes:
            return self._surface(axes[0], snapshot)
        for ax, plane in zip(axes, self.planes, strict=True):
            self._section(ax, snapshot, plane)

    def _section(self, ax: "Axes", snapshot: Snapshot, plane: tuple[int, int]) -> None:
        (i, j), names = plane, "xyz"
        if plane not in self.cuts:
            self.cuts[plane] = plots.Section(snapshot.nodes, self.size, plane, self.fineness)
        cut = self.cuts[plane]
        rho, picture = cut.shown(snapshot, self.colours)
        shown: Any = {"X": picture} if self.look.colour != "rho" else {"X": rho, "cmap": "magma", "vmin": 0, "vmax": 1}
        ax.imshow(**shown, origin="lower", extent=(0, self.size[i], 0, self.size[j]), interpolation="bilinear")
        if rho.min() < 0.5 < rho.max() and self.look.colour != "rho":
            ax.contour(cut.x, cut.y, rho, [0.5], colors="black", linewidths=0.6)
        ax.set(xlabel=f"{names[i]} (nm)", ylabel=f"{names[j]} (nm)", aspect="equal", anchor="S")
        if self.box is not None:
            draw_box(ax, np.asarray(self.box, float), plane)
        scale_bar(ax, self.size[i], self.size[j], 0.0, 0.0, "white" if self.look.colour == "rho" else "black")

    def _surface(self, ax: "Axes", snapshot: Snapshot) -> None:
        from .surface import gridded, seen

        grid = gridded(snapshot.nodes, snapshot.rho, snapshot.owner, self.size)
        picture, extent, edges = seen(grid, self.size, self.colours)
        for (x_0, y_0), (x_1, y_1) in edges:
            ax.plot([x_0, x_1], [y_0, y_1], color="#bbbbbb", lw=0.6, zorder=0)
        ax.imshow(picture, origin="lower", extent=extent, interpolation="bilinear", zorder=1)
        width, height = extent[1] - extent[0], extent[3] - extent[2]
        ax.set_xlim(extent[0] - 0.02 * width, extent[1] + 0.02 * width)
        ax.set_ylim(extent[2] - 0.08 * height, extent[3] + 0.02 * height)
        ax.set_axis_off()
        scale_bar(ax, width, height, extent[0], extent[2] - 0.08 * height)

    def bar(self, figure: "Figure", axes: Sequence["Axes"]) -> None:
        """The colour bar of colours that are numbers."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        if (label := SCALES.get(self.look.colour)) is None:
            return
        shown = ScalarMappable(Normalize(*self.limits()), "magma" if self.look.colour == "rho" else "viridis")
        bar = figure.colorbar(shown, ax=list(axes), shrink=0.8, pad=0.02)
        bar.set_label(label, fontsize=8.5)


def draw_panels(directory: Path, times: Sequence[float], out: Path, look: Look = Look()) -> list[float]:  # noqa: B008
    """Draw the snapshots nearest to these times beside each other; returns their times."""
    if len(times) > MOST_PANELS:
        raise PlotError(f"{len(times)} snapshots in one figure: must be at most {MOST_PANELS}")
    found = list(dict.fromkeys(plots.nearest_time(directory, time) for time in times))
    scene = Scene(directory, look, 1.0 if len(found) == 1 else SMALL)
    figure, panels = _laid_out(scene, len(found))
    for axes, time in zip(panels, found, strict=True):
        scene.draw(axes, plots.read_snapshot(directory, time))
        middle = axes[len(axes) // 2]
        middle.set_title(f"t = {time:g}")
        if len(found) > 1:
            for ax in axes:
                ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
    if len(found) == 1:
        panels[0][len(panels[0]) // 2].set_title(f"{scene.case['name']}, t = {found[0]:g}", parse_math=False)
    else:
        figure.suptitle(scene.case["name"], fontsize=9.5, parse_math=False)
    scene.bar(figure, [ax for axes in panels for ax in axes])
    plots.save(figure, out)
    return found


def _laid_out(scene: Scene, count: int) -> tuple["Figure", list[list["Axes"]]]:
    """A figure with room for so many snapshots, each with an axes per plane."""
    across = max(len(scene.planes), 1)
    columns = min(count, 4) if across == 1 else 1
    rows = -(-count // columns)
    each = {1: 6.0, 2: 3.6}.get(columns, 2.9) if across == 1 else 9.0
    figure = plots.new_figure(each * columns, rows * (each * scene.ratio() + 0.35) + 0.45)
    widths = [scene.size[i] for i, _ in scene.planes] or [1.0]
    grid = figure.subplots(rows, columns * across, squeeze=False, width_ratios=widths * columns)
    panels = [list(row[k * across : (k + 1) * across]) for row in grid for k in range(columns)]
    for axes in panels[count:]:
        for ax in axes:
            ax.set_axis_off()
    return figure, panels[:count]


def movie(directory: Path, out: Path | None, look: Look = Look(), frames: int = FRAMES) -> Path:  # noqa: B008
    """All snapshots, one after the other: an MP4 where there is ffmpeg, else a GIF. Returns its path."""
    from matplotlib.animation import FFMpegWriter, PillowWriter, writers

    can = writers.is_available("ffmpeg")
    out = out or directory / ("movie.mp4" if can else "movie.gif")
    if out.suffix != ".gif" and not can:
        raise PlotError(f"{out}: without ffmpeg a movie must end in .gif")
    scene, times = Scene(directory, look, SMALL), plots.snapshot_times(directory)
    figure, [axes] = _laid_out(scene, 1)
    figure.set_dpi(110)
    scene.bar(figure, axes)
    writer = PillowWriter(fps=frames) if out.suffix == ".gif" else FFMpegWriter(fps=frames)
    with writer.saving(figure, str(out), dpi=110):
        for time in times:
            for ax in axes:
                ax.clear()
            scene.draw(axes, plots.read_snapshot(directory, time))
            title = f"{scene.case['name']}, t = {time:.4g}"
            axes[len(axes) // 2].set_title(title, fontsize=9, parse_math=False)
            writer.grab_frame()
    return out


def radii_of(first: Snapshot, size: Floats, particles: int) -> Floats:
    """Of discs or spheres as large as each particle's nodes at the start."""
    mine = first.first_owner >= 0
    count = np.bincount(first.first_owner[mine], minlength=particles)
    volume = count * np.prod(size) / len(first.nodes)
    return np.asarray((volume / {2: np.pi, 3: 4 / 3 * np.pi}[len(size)]) ** (1 / len(size)))


def scale_bar(ax: "Axes", width: float, height: float, left: float, bottom: float, colour: str = "black") -> None:
    """A bar of a round length, about a fifth of the picture, in its lower left corner."""
    rough = 0.25 * width
    power = 10.0 ** np.floor(np.log10(rough))
    length = power * max(step for step in (1, 2, 5) if step * power <= rough)
    x, y = left + 0.03 * width, bottom + 0.03 * height
    ax.plot([x, x + length], [y, y], color=colour, lw=2.2, solid_capstyle="butt", zorder=5)
    ax.annotate(
        f"{length:g} nm", (x + 0.5 * length, y), (0, 2.5), textcoords="offset points", ha="center", va="bottom",
        fontsize=7, color=colour, zorder=5,
    )  # fmt: skip


def draw_box(ax: "Axes", box: Floats, plane: tuple[int, int]) -> None:
    """The vacancy box, dashed."""
    from matplotlib.patches import Rectangle

    (x, y), (width, height) = box[0, list(plane)], (box[1] - box[0])[list(plane)]
    ax.add_patch(Rectangle((x, y), width, height, fill=False, ec="#444444", lw=0.8, ls=(0, (4, 3))))
