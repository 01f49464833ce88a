"""The run: from one output time to the next, with the checks between steps."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from functools import singledispatch
from typing import Any, Protocol

import numpy as np

from . import vectors
from .arrays import Floats, Integers
from .case import Case
from .discretisation import Discretisation
from .integrators import Integrator
from .partition import Ranks
from .scheme import Scheme
from .state import State
from .system import Progress, System

LOWEST, HIGHEST = -0.5, 1.5  # fields outside these are not physics any more
HIGHEST_AT_WALL = 3.0  # but for rho at a wall: nothing there holds a particle that is pressed on; see `piled_up`
SAME_TIME = 1e-9  # of the end: output times nearer than this are one
LAG = 300.0  # eps that a watched value may move before the set of live points is made anew
UNEVEN = 0.1  # growth of the imbalance, as a part of the mean work, after which the mesh is divided anew
PRESSED = "a particle is pressed against the wall, which holds nothing back: leave room between particles and walls"
REFRESH = 50  # steps after which points that have come to rest are switched off


class Ending(Enum):
    """Why `run` came back."""

    DONE = "the end of the case"
    STOPPED = "the observer"
    UNBALANCED = "some ranks have come to have more work than others"


class RunError(RuntimeError):
    """The fields have become meaningless; the message names time, step, place and the likely cause."""


@dataclass(frozen=True)
class Event:
    """An output time: a history row, and perhaps the snapshot of this number."""

    time: float
    history: bool
    snapshot: int | None


class Observer(Protocol):
    """What listens to a run. All ranks call every method at the same moment."""

    def history(self, scheme: Any, state: Any, u: Floats, time: float) -> None:
        """A history time has been reached; u are the fields there."""

    def snapshot(self, number: int, scheme: Any, state: Any, u: Floats, time: float) -> None:
        """A snapshot time has been reached."""

    def after_step(self, scheme: Any, state: Any, integrator: Integrator) -> bool:
        """A step has ended well: time for checkpoints and progress. True ends the run here."""


def events(case: Case) -> list[Event]:
    """All output times of a case, in order; the first is 0, the last the end."""
    end, every = case.time.end, case.output.history_every
    rows = [k * every for k in range(int(end / every * (1.0 + SAME_TIME)) + 1)]
    snapshots = list(case.output.snapshot_times(end))
    marks = [(t, True, None) for t in [*rows, end]] + [(t, False, k) for k, t in enumerate(snapshots)]
    merged: list[Event] = []
    for time, history, snapshot in sorted(marks, key=lambda mark: mark[0]):
        last = merged[-1] if merged else None
        near = last is not None and time - last.time <= SAME_TIME * end
        if last is not None and near and (snapshot is None or last.snapshot is None):
            number = last.snapshot if snapshot is None else snapshot
            merged[-1] = Event(last.time, last.history or history, number)
        else:
            merged.append(Event(time, history, snapshot))
    return merged


def run(system: System, state: Progress, integrator: Integrator, observer: Observer) -> Ending:
    """March from the state's time to the end of the case, or until the observer ends it.

    A fresh state first gives the events of time 0; a resumed one goes on behind its time. Where the work has moved
    from rank to rank (`UNEVEN`), the run ends as well, to be divided anew and resumed.
    """
    case = system.case
    waiting = [event for event in events(case) if event.time > state.time or state.step == 0]
    integrator.restart(system, state)
    watch = system.ranks.watch
    watch.enter("steps")
    even = system.imbalance()
    while waiting:
        limit = waiting[0].time if integrator.stops_at_events else waiting[-1].time
        if state.time < waiting[0].time:
            integrator.step(system, state, limit)
            check(system, state, integrator.y)
        for event in reached(waiting, state.time):
            with watch("output"):
                u = integrator.at(system, state, event.time) if state.step else system.at(state, integrator.y)
                if event.history:
                    observer.history(system, state, u, event.time)
                if event.snapshot is not None:
                    observer.snapshot(event.snapshot, system, state, u, event.time)
        if renewed := renew(system, state, integrator.y):
            integrator.restart(system, state)
        with watch("output"):
            ended = observer.after_step(system, state, integrator)
        if ended and waiting:
            return Ending.STOPPED
        if renewed and waiting and system.imbalance() > even + UNEVEN:
            return Ending.UNBALANCED
    return Ending.DONE


def has_moved(system: System, state: Progress, rows: Any, ends: tuple[float, float] | None) -> bool:
    """Whether the vacancy ratio is `output.history_change` of its first value away from that of the last row.

    rows: what computes them; ends: the ratios of the first and the last row. Collective.
    """
    change = system.case.output.history_change
    if not change or not state.step or ends is None:
        return False
    first, last = ends
    return first > 0.0 and bool(abs(rows.vacancy_ratio(state) - last) >= change * first)


def reached(waiting: list[Event], time: float) -> Iterator[Event]:
    """Take the events up to a time off the list."""
    while waiting and waiting[0].time <= time:
        yield waiting.pop(0)


@singledispatch
def renew(scheme: Any, state: Any, y: Floats) -> bool:
    """Make the set of live points anew when a value that it rests on has moved, and every `REFRESH` steps.

    True where that happened: rates computed before no longer hold. Collective.
    """
    switch = scheme.d.case.activation
    if state.step == 0 or not (switch.enabled or switch.few_order_parameters):
        return False
    moved = np.array([scheme.active.stale(y)])
    scheme.d.share.ranks.max(moved)
    if moved[0] < LAG and state.step % REFRESH:
        return False
    scheme.activate(state)
    return True


@singledispatch
def check(scheme: Any, state: Any, y: Floats) -> None:
    """Raise RunError on every rank where a field of the state is no number, or out of range; y: its unknowns.

    Collective. Fields are means of coefficients: where all of these are in range, nothing else has to be looked at.
    """
    d = scheme.d
    if d.share.ranks.max(np.array([not vectors.within(y, LOWEST, HIGHEST)], dtype=float))[0] == 0.0:
        return
    fields = d.sample(np.ascontiguousarray(state.u[:, : 1 + state.owner.shape[1]]))
    most = np.where(d.at_wall[:, None] & (np.arange(fields.shape[1]) == 0), HIGHEST_AT_WALL, HIGHEST)
    bad = np.flatnonzero(~((fields >= LOWEST) & (fields <= most)).all(axis=1))
    if (first := _lowest(d, bad)) is not None:
        here = np.flatnonzero(d.share.points == first)
        raise RunError(first_said(d.share.ranks, describe(scheme, state, int(here[0])) if here.size else None))


def _lowest(d: Discretisation, points: Integers) -> int | None:
    """The lowest number of the given points of all ranks. Collective."""
    mine = -float(d.share.points[points[0]]) if points.size else -np.inf
    found = d.share.ranks.max(np.array([mine]))[0]
    return int(-found) if np.isfinite(found) else None


@singledispatch
def piled_up(scheme: Any, state: Any) -> str | None:
    """Where rho exceeds `HIGHEST` at a wall, or None. Collective.

    The flux through a wall is zero, but nothing stops a particle that its neighbours push there: what it carries
    piles up in the outermost nodes, and spreads again when the push ends. That is the model, so the run goes on.
    """
    d = scheme.d
    if not d.share.ranks.max(np.array([state.rho.max(initial=-np.inf)]))[0] > HIGHEST:
        return None
    rho = np.where(d.at_wall, d.sample(np.ascontiguousarray(state.u[:, :1]))[:, 0], -np.inf)
    most = d.share.ranks.max(np.array([rho.max(initial=-np.inf)]))
    if not most[0] > HIGHEST:
        return None
    here = np.flatnonzero(rho == most[0])
    return first_said(d.share.ranks, f"{fields_at(scheme, state, int(here[0]))}: {PRESSED}" if here.size else None)


def first_said(ranks: Ranks, mine: str | None) -> str | None:
    """What the first rank that has something to say says; None where nobody has. Collective."""
    texts = (text[0] for text in ranks.everyones(np.array([mine], dtype=object)))
    return next((text for text in texts if text is not None), None)


def likely_cause(case: Case, pressed: bool) -> str:
    """Of fields out of range; pressed: only rho at a wall is."""
    cause = "the time step is too long for the interface: choose a smaller time.step or time.tolerance"
    if not case.model.rigid_motion:
        return cause
    cause += ", or the rigid motion is too stiff for it: choose a smaller model.m_t"
    return f"{PRESSED}, or {cause}" if pressed else cause


def fields_at(scheme: Scheme, state: State, point: int) -> str:
    """Time, step, place and fields of a point of this rank."""
    d, entries = scheme.d, scheme.d.shape.of(point)
    place = ", ".join(f"{x:.3f}" for x in d.x[point] + 0.5 * np.asarray(d.case.domain.size))
    values = entries[1] @ state.u[entries[0]]
    fields = [f"rho = {values[0]:.4g}"]
    for slot, owner in enumerate(state.owner[entries[0]].T):
        if (owner >= 0).any():
            particle = owner[np.argmax(np.where(owner >= 0, entries[1], -1.0))]
            fields.append(f"eta of particle {particle} = {values[1 + slot]:.4g}")
    return f"at t = {state.time:.6g}, step {state.step}, at ({place}) nm: {', '.join(fields)}"


def describe(scheme: Scheme, state: State, point: int) -> str:
    """Time, step, place and likely cause of a bad field at a point of this rank."""
    nodes, shares = scheme.d.shape.of(point)
    pressed = bool(scheme.d.at_wall[point] and shares @ state.rho[nodes] > HIGHEST_AT_WALL)
    highest, cause = HIGHEST_AT_WALL if pressed else HIGHEST, likely_cause(scheme.d.case, pressed)
    return f"{fields_at(scheme, state, point)} left [{LOWEST:g}, {highest:g}]; likely cause: {cause}"
