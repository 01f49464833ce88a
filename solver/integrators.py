"""Steps in time: `rk2` as the paper prints it, and `adaptive`, a stabilised Runge-Kutta-Chebyshev method.

An integrator sees the problem only through `System.rates`, a function of vectors (`unknowns`). It owns its work arrays;
`memory` holds what a checkpoint needs so that a resumed run takes the same steps.
"""

from math import ceil, sqrt
from typing import Protocol

import numpy as np

from . import amounts, vectors
from .arrays import Floats, zeros
from .case import Case
from .partition import Ranks
from .system import Progress, System


class Integrator(Protocol):
    """What the run needs of a method."""

    stops_at_events: bool  # whether a step must end at each output time, or `at` interpolates
    y: Floats  # the state's unknowns

    def step(self, system: System, state: Progress, limit: float) -> None:
        """Advance the state by one step, not beyond `limit`."""

    def at(self, system: System, state: Progress, time: float) -> Floats:
        """The fields (n, F) at a time within the last step."""

    def restart(self, system: System, state: Progress) -> None:
        """The set of live points or the layout of the slots has changed."""

    @property
    def memory(self) -> dict[str, float]:
        """Numbers to keep in a checkpoint."""


def paper_step(shortest: float, case: Case) -> float:
    """dt = 0.1 d_min^2 / (2 L kappa_eta), d_min the smallest distance between nodes: the paper's rule (2.3)."""
    return amounts.paper_step(shortest, case.model.L, case.model.kappa_eta)


def contact_time(shortest: float, case: Case) -> float:
    """tau = dt / 2 (tolerance / 10^-3) with the paper's dt: the shortest time in which `Chebyshev` lets contacts relax.

    At the default tolerance contacts are then never much stiffer than the diffusion on the same nodes. A much longer
    time (10 dt) lets particles swing about their places.
    """
    tolerance = case.time.tolerance
    return 0.5 * paper_step(shortest, case) * (1.0 if tolerance is None else tolerance / 1e-3)


class RK2:
    """Two half Euler steps (32): u' = u + dt/2 F(u), then u' + dt/2 F(u'). First order, stable for dt |lambda| < 4."""

    stops_at_events = True

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self.y = self.rate = np.empty(0)

    def step(self, system: System, state: Progress, limit: float) -> None:
        """One step of the equal steps, at most dt, that lead to the limit."""
        remaining = limit - state.time
        count = max(1, ceil(remaining / self.dt - 1e-9))
        dt = remaining / count
        for _ in range(2):
            system.rates(self.y, self.rate)
            vectors.advance(self.y, self.y, 0.5 * dt, self.rate)
        system.keep(state, self.y)
        state.evaluations += 2
        state.time = limit if count == 1 else state.time + dt
        state.step += 1

    def at(self, system: System, state: Progress, time: float) -> Floats:
        """Every output time ends a step: the fields themselves."""
        return system.at(state, self.y)

    def restart(self, system: System, state: Progress) -> None:
        """Go on from the state's fields."""
        self.y = system.vector(state)
        self.rate = zeros(self.y.size)

    @property
    def memory(self) -> dict[str, float]:
        """Nothing: the step is fixed."""
        return {}


SAFETY = 0.8
GROWTH = 5.0  # largest factor between two steps
SHRINK = 0.1
MOST_STAGES = 200
ESTIMATE_EVERY = 25  # accepted steps between two estimates of the spectral radius
THETA = 0.5  # contacts may relax within this part of a step
MARGIN = 1.2  # factor on an estimate of the spectral radius


class Chebyshev:
    """Runge-Kutta-Chebyshev of order 2 with error control (Sommeijer, Shampine & Verwer 1997).

    s stages are stable for dt |lambda| < 0.65 (s^2 - 1) on the negative real axis: the cost of a step grows with the
    square root of its length. The error of a step is estimated from its end points; steps aim at `tolerance` in the
    volume-weighted root mean square of e / (1 + |u|) over the nodes that change.

    Contacts are far stiffer than diffusion, and a contact that forms pulls its particles together in an instant. Their
    stiffness is measured at the end of each step, and during the next they relax within `THETA` of the step, linearly
    implicit in the few unknowns of the rigid motion: what would take hundreds of stages takes none.
    """

    stops_at_events = False

    def __init__(self, tolerance: float, tau: float, memory: dict[str, float] | None = None) -> None:
        """tau: shortest time in which contacts may relax, see `System.rates`."""
        self.tolerance, self.least_tau = tolerance, tau
        kept = memory or {}
        self.repeats = kept.get("fresh", 0.0) > 0.0  # the first rate was known, and counted, before the checkpoint
        self.tau = kept.get("tau", tau)
        self.dt = kept.get("dt", 0.0)
        self.radius = kept.get("radius", 0.0)
        self.age = kept.get("age", 0.0)
        self.error_before = kept.get("error_before", 0.0)
        self.dt_before = kept.get("dt_before", 0.0)
        self.work: list[Floats] = []
        self.y = self.old = self.rate_0 = self.rate_1 = np.empty(0)  # after a step and before it, and their rates
        self.fresh = False  # whether rate_1 is F(y)
        self.start = 0.0

    @property
    def memory(self) -> dict[str, float]:
        """The step that comes next, and the spectral radius."""
        return {
            "tau": self.tau, "dt": self.dt, "radius": self.radius, "age": self.age,
            "error_before": self.error_before, "dt_before": self.dt_before, "fresh": float(self.fresh),
        }  # fmt: skip

    def restart(self, system: System, state: Progress) -> None:
        """Go on from the state's fields; rates known before hold no more."""
        self.y = self.old = self.rate_0 = self.rate_1 = np.empty(0)  # gives their memory back before more is taken
        self.work = []
        self.y = system.vector(state)
        self.old, self.rate_0, self.rate_1, *self.work = (zeros(self.y.size) for _ in range(5))
        self.fresh = False

    def step(self, system: System, state: Progress, limit: float) -> None:
        """Try steps until one is accepted."""
        self.old, self.y = self.y, self.old
        if self.fresh:
            self.rate_0, self.rate_1 = self.rate_1, self.rate_0
        else:
            system.rates(self.old, self.rate_0, self.tau)
            state.evaluations += 0 if self.repeats else 1
        self.repeats = False
        if self.radius == 0.0 or self.age >= ESTIMATE_EVERY:
            self._estimate(system, state)
        if self.dt == 0.0:
            self.dt = 0.1 / self.radius
        relax, rejected = system.relax, False
        while True:
            dt = self._fit(limit - state.time)
            error = self._try(system, state, dt)
            if error <= 1.0:
                break
            system.relax = relax
            self.dt = dt * max(SHRINK, SAFETY * error ** (-1.0 / 3.0)) if np.isfinite(error) else 0.1 * dt
            if rejected:  # twice in a row: perhaps the step was not stable
                self._estimate(system, state)
            rejected = True
            if not self.dt > 1e-12 * max(limit, 1.0):
                raise FloatingPointError(f"step size fell to {self.dt:.1e} at t = {state.time:.6g}")
        system.keep(state, self.y)
        self._accept(state, dt, error, limit)

    def at(self, system: System, state: Progress, time: float) -> Floats:
        """The cubic Hermite interpolant of the last step: of higher order than the method."""
        dt = state.time - self.start
        theta = (time - self.start) / dt
        vectors.hermite(self.work[0], self.old, self.rate_0, self.y, self.rate_1, dt, theta)
        return system.at(state, self.work[0])

    def _fit(self, remaining: float) -> float:
        """The next step: at most what `MOST_STAGES` can do, and no sliver left before the limit."""
        dt = min(self.dt, 0.65 * (MOST_STAGES - 1) ** 2 / self.radius)
        if dt >= remaining * (1.0 - 1e-9):
            return remaining
        return min(dt, 0.5 * remaining) if dt > 0.5 * remaining else dt

    def _try(self, system: System, state: Progress, dt: float) -> float:
        """Fill y with the new fields and rate_1 with their rate; the error in units of the tolerance."""
        stages = max(2, 1 + int(sqrt(1.0 + 1.54 * dt * self.radius)))
        before, last = self.work
        new, rate = self.y, self.rate_1  # what is in them is needed no more
        before[:] = self.old
        for j, c in enumerate(coefficients(stages, dt), start=1):
            if j == 1:
                vectors.advance(last, self.old, c[4], self.rate_0)
                continue
            system.rates(last, rate)
            vectors.chebyshev_stage(new, self.old, before, last, rate, self.rate_0, c)
            before, last, new = last, new, before
        self.y, self.work = last, [before, new]
        self.tau = max(self.least_tau, THETA * dt)
        system.rates(self.y, self.rate_1, self.tau)
        state.evaluations += stages
        sums = system.step_error(self.y, self.old, self.rate_1, self.rate_0, dt, self.tolerance)
        system.ranks.sum(sums)
        return float(np.sqrt(sums[0] / sums[1])) if sums[1] > 0.0 else 0.0

    def _accept(self, state: Progress, dt: float, error: float, limit: float) -> None:
        error = max(error, 1e-10)
        factor = SAFETY * error ** (-1.0 / 3.0)
        if self.error_before > 0.0:
            factor = min(factor, factor * dt / self.dt_before * (self.error_before / error) ** (1.0 / 3.0))
        self.error_before, self.dt_before = error, dt
        self.start = state.time
        state.time = limit if dt == limit - state.time else state.time + dt
        state.step += 1
        self.dt = max(self.dt, dt) if dt < self.dt and factor >= 1.0 else dt * min(max(factor, SHRINK), GROWTH)
        self.age += 1
        self.fresh = True

    def _estimate(self, system: System, state: Progress) -> None:
        """Spectral radius of the Jacobian by the nonlinear power method.

        It starts from the rate with signs that change from node to node: the stiffest modes are among the shortest.
        """
        ranks = system.ranks
        (moved, direction), rate = self.work, self.rate_1
        size = sqrt(_total(ranks, system.squares(self.old)))
        length = sqrt(_total(ranks, system.squares(self.rate_0)))
        if length == 0.0:
            self.radius, self.age = 1.0, 0
            return
        delta = 1e-7 * max(size, 1.0)
        system.scramble(direction, self.rate_0)
        radius = 0.0
        for _ in range(50):
            vectors.advance(moved, self.old, delta / length, direction)
            system.rates(moved, rate)
            state.evaluations += 1
            np.subtract(rate, self.rate_0, out=direction)
            length = sqrt(_total(ranks, system.squares(direction)))
            previous, radius = radius, length / delta
            if abs(radius - previous) <= 0.01 * radius or length == 0.0:
                break
        self.radius, self.age = max(MARGIN * radius, 1.0), 0


def integrator_of(case: Case, shortest: float, memory: dict[str, float] | None = None) -> Integrator:
    """The one that the case asks for; shortest: d_min of the paper's step; memory: what a checkpoint kept of it."""
    if (tolerance := case.time.tolerance) is not None:  # the adaptive integrator has one, rk2 has none
        return Chebyshev(tolerance, contact_time(shortest, case), memory)
    return RK2(case.time.step or paper_step(shortest, case))


def _total(ranks: Ranks, value: float) -> float:
    return float(ranks.sum(np.array([value]))[0])


def coefficients(stages: int, dt: float) -> Floats:
    """Rows c (stages, 5) of Y_j = c_0 Y_0 + c_1 Y_{j-1} + c_2 Y_{j-2} + c_3 F_{j-1} + c_4 F_0.

    Row 0 is Y_1 = Y_0 + c_4 F_0. From Chebyshev polynomials at w_0 = 1 + (2/13) / s^2, damped so that the stability
    region is a strip (RKC, eq. 2.6).
    """
    w0 = 1.0 + 2.0 / (13.0 * stages**2)
    T, dT, ddT = np.zeros((3, stages + 1))
    T[:2], dT[1] = (1.0, w0), 1.0
    for j in range(2, stages + 1):
        T[j] = 2.0 * w0 * T[j - 1] - T[j - 2]
        dT[j] = 2.0 * T[j - 1] + 2.0 * w0 * dT[j - 1] - dT[j - 2]
        ddT[j] = 4.0 * dT[j - 1] + 2.0 * w0 * ddT[j - 1] - ddT[j - 2]
    w1 = dT[stages] / ddT[stages]
    b = np.empty(stages + 1)
    b[2:] = ddT[2:] / dT[2:] ** 2
    b[0], b[1] = b[2], 1.0 / w0
    a = 1.0 - b * T
    c = np.zeros((stages, 5))
    c[0, 4] = dt * b[1] * w1
    for j in range(2, stages + 1):
        mu, nu = 2.0 * b[j] * w0 / b[j - 1], -b[j] / b[j - 2]
        mu_rate = 2.0 * b[j] * w1 / b[j - 1]
        c[j - 1] = 1.0 - mu - nu, mu, nu, dt * mu_rate, -dt * a[j - 1] * mu_rate
    return c
