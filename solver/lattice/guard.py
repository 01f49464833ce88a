"""What a run on a lattice asks between steps: whether windows still fit, and whether the fields still mean anything."""

import numpy as np

from ..arrays import Floats
from ..run import (
    HIGHEST,
    HIGHEST_AT_WALL,
    LOWEST,
    PRESSED,
    REFRESH,
    RunError,
    check,
    first_said,
    likely_cause,
    piled_up,
    renew,
)
from . import loops, windows
from .scheme import LatticeScheme, LatticeState
from .start import fitting_boxes, move

RIM = 1.0  # eps_eta: windows are fitted anew when an order parameter has come to that at the rim of its own


@renew.register
def _(scheme: LatticeScheme, state: LatticeState, y: Floats) -> bool:
    """Fit the windows to the order parameters when one has reached its rim, and every `REFRESH` steps."""
    switch, g = scheme.case.activation, scheme.lattice
    if state.step == 0 or not switch.few_order_parameters:
        return False
    most = np.array([windows.rim(y, scheme.layout, np.array(g.nodes), 1)])
    g.ranks.max(most)
    if most[0] < RIM * switch.eps_eta and state.step % REFRESH:
        return False
    with g.ranks.watch("live points"):
        (state.y,) = move(scheme, fitting_boxes(scheme, y, switch.eps_eta), y)
    return True


@check.register
def _(scheme: LatticeScheme, state: LatticeState, y: Floats) -> None:
    """Raise RunError where rho at a point, or an eta, is none or out of range. Collective."""
    g, found = scheme.lattice, extremes(scheme)
    etas = y[scheme.rho :]
    least = max(-found[0], -etas.min(initial=0.0))
    bad = np.array([least, found[1], max(found[2], 0.0), etas.max(initial=0.0), found[3]])
    bad = np.where(np.isnan(bad), np.inf, bad)
    g.ranks.max(bad)
    if bad[0] <= -LOWEST and bad[1] <= HIGHEST and bad[2] <= HIGHEST_AT_WALL and bad[3] <= HIGHEST and bad[4] == 0.0:
        return
    cause = likely_cause(scheme.case, pressed=bool(bad[1] <= HIGHEST and bad[2] > HIGHEST_AT_WALL))
    place = place_of(scheme, float(max(bad[1], bad[2])), found)
    raise RunError(
        f"at t = {state.time:.6g}, step {state.step}{place}: fields left [{LOWEST:g}, {HIGHEST:g}]: rho = "
        f"{max(bad[1], bad[2]):.4g} at most, eta up to {bad[3]:.4g}, the least {-bad[0]:.4g}; likely cause: {cause}"
    )


@piled_up.register
def _(scheme: LatticeScheme, state: LatticeState) -> str | None:
    """Where rho exceeds `HIGHEST` at a wall, or None. Collective."""
    found = extremes(scheme)
    most = scheme.ranks.max(np.array([found[2]]))
    if not most[0] > HIGHEST:
        return None
    place = place_of(scheme, float(most[0]), found)
    return f"at t = {state.time:.6g}, step {state.step}{place}: rho = {most[0]:.4g}, at a wall: {PRESSED}"


def extremes(scheme: LatticeScheme) -> Floats:
    """(4,) of rho at this rank's points when the rates were last asked for; see `loops.extremes`."""
    g, found = scheme.lattice, np.array([np.inf, -np.inf, -np.inf, 0.0])
    edges = np.array([g.layers.start == 0, g.layers.stop == g.axes[0].cells], dtype=float)
    cells = 1 if g.axes[1] is None else g.axes[1].cells
    loops.extremes(found, scheme.points.rho, len(g.layers), cells, g.column, g.axes[2].cells, edges)
    return found


def place_of(scheme: LatticeScheme, value: float, found: Floats) -> str:
    """Where rho has that value at a point, the same text on all ranks; nothing where it is at none. Collective."""
    g = scheme.lattice
    said = None
    if value in (found[1], found[2]):
        slow, middle, fast = g.axes
        rows = scheme.points.rho[:, g.column : g.column + fast.cells]
        row, c = divmod(int((rows == value).argmax()), fast.cells)
        p, k, j = (int(i) for i in np.unravel_index(row, (2, len(g.layers), 1 if middle is None else middle.cells)))
        between = [] if middle is None else [middle.points[p, j]]
        at = [fast.points[p, c], *between, slow.points[p, g.layers[k]]]
        said = f", at ({', '.join(f'{x:.3f}' for x in at)}) nm"
    return first_said(g.ranks, said) or ""
