"""The fields that a run on a lattice starts from, and windows that follow the fields."""

import numpy as np

from ..arrays import Floats, Integers, zeros
from ..case import Case
from ..state import TAIL, profile, reach, surface_distance
from . import windows
from .scheme import Axes, Lattice, LatticeScheme, nodes_of
from .windows import NONE, Boxes, Layout

MARGIN = 2  # nodes around those where an order parameter is worth keeping


def slow_first(place: Floats) -> list[float]:
    """A place along slow, middle and fast axis: z, y, x, or y, 0, x."""
    return [place[-1], place[1] if len(place) == 3 else 0.0, place[0]]


def first_boxes(case: Case, axes: Axes) -> Boxes:
    """Windows that hold all nodes where the initial eta (34) reaches eps_eta; where few are not wanted, all nodes."""
    n = nodes_of(axes)
    centres = np.asarray(case.particles.centres)
    extent = reach(case) + 0.5 * case.particles.interface_width * np.log(1.0 / max(case.activation.eps_eta, TAIL))
    steps = [axis.step if axis is not None else 1.0 for axis in axes]
    begins, ends, lows = [], [], []
    for centre, radius in zip(centres, extent, strict=True):
        at = slow_first(centre)
        if case.activation.few_order_parameters:
            low = [max(0, int(np.floor((at[k] - radius) / steps[k]))) for k in range(3)]
            high = [min(n[k], int(np.ceil((at[k] + radius) / steps[k])) + 1) for k in range(3)]
        else:
            low, high = [0, 0, 0], list(n)
        if axes[1] is None:
            low[1], high[1] = 0, 1
        shape = (max(0, high[0] - low[0]), max(0, high[1] - low[1]))
        begins.append(np.full(shape, low[2]))
        ends.append(np.full(shape, high[2]))
        lows.append(np.array(low[:2]))
    return windows.boxes_of(begins, ends, lows, axes[0].reach)


def initial_fields(case: Case, lattice: Lattice, layout: Layout) -> Floats:
    """The fields (34) at the nodes: rho = min(sum eta, 1), and eta_a in its window where it is at least eps_eta."""
    y = zeros(int(layout.offset[-1]))
    few, xi, radii = case.activation.few_order_parameters, case.particles.interface_width, reach(case)
    cut = max(case.activation.eps_eta, TAIL)
    n, held = lattice.nodes, lattice.planes
    rho = np.zeros((len(held), n[1], n[2]))
    axes = [axis.nodes if axis is not None else np.zeros(1) for axis in lattice.axes]
    beyond = radii + 0.5 * xi * np.log(1.0 / TAIL)
    for a, centre in enumerate(np.asarray(case.particles.centres)):
        at = slow_first(centre)
        ranges: list[Integers] = []
        for k in range(3):
            near = np.flatnonzero(np.abs(axes[k] - at[k]) <= beyond[a])
            ranges.append(near[(near >= held.start) & (near < held.stop)] if k == 0 else near)
        if any(near.size == 0 for near in ranges):
            continue
        grid = np.meshgrid(*(axes[k][near] for k, near in enumerate(ranges)), indexing="ij")
        x = np.stack([grid[2], grid[1], grid[0]] if lattice.dim == 3 else [grid[2], grid[0]], axis=-1)
        eta = profile(surface_distance(case, a, x.reshape(-1, lattice.dim)), xi).reshape(grid[0].shape)
        rho[np.ix_(ranges[0] - held.start, ranges[1], ranges[2])] += eta
        w, size = 1 + a, layout.size[1 + a]
        if not size[0]:
            continue
        window = y[layout.offset[w] : layout.offset[w + 1]].reshape(size)
        inside = [(near >= layout.low[w, k]) & (near < layout.low[w, k] + size[k]) for k, near in enumerate(ranges)]
        kept = [near[keep] - layout.low[w, k] for k, (near, keep) in enumerate(zip(ranges, inside, strict=True))]
        window[np.ix_(*kept)] = eta[np.ix_(*inside)]
        if few:
            window[window < cut] = 0.0
    np.minimum(rho, 1.0, out=rho)
    lattice.values(y)[...] = rho
    return y


def fitting_boxes(scheme: LatticeScheme, y: Floats, least: float) -> Boxes:
    """Windows that hold all nodes where |eta| >= least and `MARGIN` more in every direction. Collective."""
    g, boxes = scheme.lattice, scheme.boxes
    begin, end = np.full(boxes.begin.size, NONE, dtype=np.int32), np.zeros(boxes.begin.size, dtype=np.int32)
    windows.intervals(
        begin, end, y, scheme.layout, boxes.low, boxes.size, boxes.row, least, g.owned.start, g.owned.stop
    )
    bounds = np.concatenate([-begin.astype(float), end.astype(float)])
    g.ranks.max(bounds)
    begin, end = (-bounds[: begin.size]).astype(np.int64), bounds[begin.size :].astype(np.int64)
    begins: list[Integers] = []
    ends: list[Integers] = []
    lows: list[Integers] = []
    for a in range(len(boxes.low)):
        rows, shape = slice(boxes.row[a], boxes.row[a + 1]), tuple(boxes.size[a, :2])
        found = begin[rows].reshape(shape), end[rows].reshape(shape)
        b, e, low = windows.widened(*found, boxes.low[a, :2], g.nodes, MARGIN)
        begins.append(b)
        ends.append(e)
        lows.append(low)
    return windows.boxes_of(begins, ends, lows, g.reach)


def move(scheme: LatticeScheme, boxes: Boxes, *vectors: Floats) -> list[Floats]:
    """Go over to other windows, and the vectors with it. Collective."""
    old = scheme.layout
    scheme.lay_out(boxes)
    moved = []
    for vector in vectors:
        new = zeros(int(scheme.layout.offset[-1]))
        windows.carry(new, scheme.layout, vector, old)
        moved.append(new)
    return moved
