"""The box that a pack has for itself: the vacancy box, drawn in as the particles' centres have been.

A box that stays in its place counts the space around a shrinking pack as pores; this one moves with the pack.
"""

import numpy as np

from .arrays import Floats
from .case import Case

SPREAD = 0.1  # of the box's edge: centres nearer to a plane than that do not tell how the pack shrinks across it


class PackBox:
    """Along each axis centres move as x -> y_0 + s (x - x_0), fitted by least squares with the volumes for weights."""

    def __init__(self, case: Case) -> None:
        self.low, self.high = (np.asarray(corner, dtype=float) for corner in case.output.vacancy_box)
        self.size = np.asarray(case.domain.size, dtype=float)
        self.before = np.asarray(case.particles.centres, dtype=float)

    def now(self, moments: Floats) -> tuple[Floats, Floats]:
        """Lower and upper corner, nm; moments (particles, 1 + dim): V_a and int r eta_a, r from the domain's centre."""
        there = moments[:, 0] > 1.0
        if not there.any():
            return self.low, self.high
        weight = moments[there, 0] / moments[there, 0].sum()
        x, y = self.before[there], 0.5 * self.size + moments[there, 1:] / moments[there, :1]
        x_0, y_0 = weight @ x, weight @ y
        spread = weight @ (x - x_0) ** 2
        told = spread > (SPREAD * (self.high - self.low)) ** 2
        s = np.where(told, (weight @ ((x - x_0) * (y - y_0))) / np.where(told, spread, 1.0), 1.0)
        low, high = (np.clip(y_0 + s * (corner - x_0), 0.0, self.size) for corner in (self.low, self.high))
        return (low, high) if (low < high).all() else (self.low, self.high)


def overlap(x: Floats, edge: Floats | float, low: Floats | float, high: Floats | float) -> Floats:
    """The part of the interval around x, `edge` long, that is between low and high."""
    return np.asarray(np.clip((np.minimum(x + 0.5 * edge, high) - np.maximum(x - 0.5 * edge, low)) / edge, 0.0, 1.0))
