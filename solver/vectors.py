"""The integrators' sums of vectors: what a stage is made of, one pass each, without temporaries."""

from .arrays import Floats
from .jit import jit
from .simd import flush_denormals, restore_denormals


@jit
def advance(new: Floats, old: Floats, dt: float, rate: Floats) -> None:
    """new = old + dt rate."""
    mode = flush_denormals()
    for i in range(new.size):
        new[i] = old[i] + dt * rate[i]
    restore_denormals(mode)


@jit
def chebyshev_stage(
    new: Floats, old: Floats, before: Floats, last: Floats, rate: Floats, rate_0: Floats, c: Floats
) -> None:
    """new = c_0 Y_0 + c_1 Y_{j-1} + c_2 Y_{j-2} + c_3 F_{j-1} + c_4 F_0."""
    mode = flush_denormals()
    c0, c1, c2, c3, c4 = c[0], c[1], c[2], c[3], c[4]
    for i in range(new.size):
        new[i] = c0 * old[i] + c1 * last[i] + c2 * before[i] + c3 * rate[i] + c4 * rate_0[i]
    restore_denormals(mode)


@jit
def hermite(
    new: Floats, old: Floats, rate_0: Floats, y: Floats, rate_1: Floats, dt: float, theta: float
) -> None:
    """The cubic through (old, rate_0) and (y, rate_1) a step dt apart, at the fraction theta of the step."""
    h00 = (1.0 + 2.0 * theta) * (1.0 - theta) ** 2
    h10 = theta * (1.0 - theta) ** 2 * dt
    h01 = theta * theta * (3.0 - 2.0 * theta)
    h11 = theta * theta * (theta - 1.0) * dt
    for i in range(new.size):
        new[i] = h00 * old[i] + h10 * rate_0[i] + h01 * y[i] + h11 * rate_1[i]


@jit
def largest_change(y: Floats, reference: Floats, weight: Floats) -> float:
    """max weight |y - reference|, 0 of nothing."""
    largest = 0.0
    for i in range(y.size):
        largest = max(largest, weight[i] * abs(y[i] - reference[i]))
    return largest


@jit
def within(y: Floats, low: float, high: float) -> bool:
    """Whether all values are numbers in [low, high]."""
    inside = True
    for i in range(y.size):
        inside &= low <= y[i] <= high
    return inside
