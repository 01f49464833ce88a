"""Picture of a packing: its discs, or the three mid-planes of its spheres. A circle's colour tells the radius."""

import itertools
from pathlib import Path

import numpy as np

from frit.solver.arrays import Floats
from frit.solver.particle_file import read


def plot_packing(particles: Path, container: Floats, title: str, out: Path) -> None:
    """Draw the particles of a CSV in their container, (2, dim), nm."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    dim = container.shape[1]
    x, r = read(particles, dim)
    low, size = container[0], container[1] - container[0]
    planes = list(itertools.combinations(range(dim), 2))
    width, height = sum(size[i] for i, _ in planes), max(size[j] for _, j in planes)
    inches = 4.6 if dim == 2 else 9.0
    tall = (inches - 0.9 * len(planes)) * height / width + 0.6
    figure = Figure(figsize=(inches, tall), dpi=200, layout="constrained")
    axes = figure.subplots(1, len(planes), squeeze=False, width_ratios=[size[i] for i, _ in planes])[0]
    colours = ScalarMappable(Normalize(*_limits(r)), "viridis")
    for ax, (i, j) in zip(axes, planes, strict=True):
        radius = r if dim == 2 else _section(x, r, low + 0.5 * size, ({0, 1, 2} - {i, j}).pop())
        cut = np.flatnonzero(radius > 0.0)
        wide, places = 2.0 * radius[cut], x[cut][:, [i, j]]
        circles = EllipseCollection(
            wide, wide, np.zeros(cut.size), units="x", offsets=places, offset_transform=ax.transData,
            facecolors=colours.to_rgba(r[cut]), edgecolors="#222222", linewidths=0.4,
        )  # fmt: skip
        ax.add_collection(circles)
        ax.add_patch(Rectangle((low[i], low[j]), size[i], size[j], fill=False, lw=0.8))
        margin = 0.02 * size.max()
        ax.set_xlim(low[i] - margin, low[i] + size[i] + margin)
        ax.set_ylim(low[j] - margin, low[j] + size[j] + margin)
        ax.set_aspect("equal")
        ax.set_xlabel(f"{'xyz'[i]} (nm)", fontsize=8.5)
        ax.set_ylabel(f"{'xyz'[j]} (nm)", fontsize=8.5)
        ax.tick_params(labelsize=8, width=0.6)
    bar = figure.colorbar(colours, ax=list(axes), shrink=0.8, pad=0.01)
    bar.set_label("radius (nm)", fontsize=8.5)
    bar.ax.tick_params(labelsize=8)
    figure.suptitle(title, fontsize=9.5, parse_math=False)
    figure.savefig(out)


def _section(x: Floats, r: Floats, middle: Floats, axis: int) -> Floats:
    """Radii of the circles in which the plane across `axis` at the middle cuts the spheres; 0: it does not."""
    return np.asarray(np.sqrt(np.maximum(r**2 - (x[:, axis] - middle[axis]) ** 2, 0.0)))


def _limits(r: Floats) -> tuple[float, float]:
    return (float(r.min()), float(r.max())) if np.ptp(r) > 1e-9 else (0.9 * float(r.min()), 1.1 * float(r.max()))
