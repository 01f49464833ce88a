"""A run in this process, without files: a case in, arrays out. What scripts and notebooks call.

`simulate` marches as the ranks of `__main__` do, through `run.run`; what differs is who listens. Nothing is written
but what may be thrown away: compiled code and packings in the user's cache.
"""

import shutil
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from .arrays import Array, Floats, Numbers
from .case import Box, Case, load_case, parse_case
from .integrators import Integrator
from .output import Fields
from .pack_store import packed
from .partition import Collector, Ranks
from .run import Ending, RunError, has_moved, piled_up, run
from .setup import Setup, make_setup
from .system import Progress, System

SHOWN_EVERY = 0.25  # seconds between two looks of the progress bar
WIDTH = 24  # characters of the bar,
WIDEST = 120  # and of a notebook's line

Observer = Callable[["Moment"], bool | None]
Given = Case | Mapping[str, Any] | str | Path


class SimulationError(RuntimeError):
    """The fields have become meaningless: time, place and the likely cause; `result` has what was computed before."""

    def __init__(self, message: str, result: "Result") -> None:
        super().__init__(message)
        self.result = result


class Moment:
    """A run at one time: its fields at the nodes, and what can be measured of them.

    What an observer gets is of use until the observer returns; the last state of a result for good.
    """

    def __init__(self, setup: Setup, system: Any, state: Any, u: Floats, at: float, row: dict[str, Any]) -> None:
        """u: the fields as the system has them; row: of the history, empty where there is none of this time."""
        self.time, self.row, self.passed = at, row, False
        self._setup, self._of = setup, (system, state, u)

    @property
    def step(self) -> int:
        """How many steps the run has taken."""
        return int(self._inside()[1].step)

    @property
    def nodes(self) -> Floats:
        """(n, dim) positions, nm; on a lattice along x, then y, then z."""
        return self._setup.positions()

    @property
    def grid(self) -> tuple[int, ...] | None:
        """Nodes along y and x, or z, y and x, of a square or cubic lattice: a shape for its nodal values."""
        return self._setup.grid

    @property
    def rho(self) -> Floats:
        """(n,) concentration: 1 solid, 0 vacancy."""
        return self._fields.rho

    @property
    def particle(self) -> Numbers:
        """(n,) the particle that owns the node, -1 in the vacancy."""
        return self._fields.particle

    @property
    def eta_squared(self) -> Floats:
        """(n,) sum of the squared order parameters: less than 1 on grain boundaries."""
        return self._fields.eta_squared

    def eta(self, particle: int) -> Floats:
        """(n,) the order parameter of a particle, numbered from 0. Raises IndexError."""
        count = len(self._setup.case.particles.centres)
        if not 0 <= particle < count:
            raise IndexError(f"particle = {particle}: must be one of 0 ... {count - 1}")
        return self._setup.order_parameter(*self._inside(), particle)

    @cached_property
    def _fields(self) -> Fields:
        system, state, u = self._inside()
        fields = self._setup.fields(system, state, u, Collector(self._setup.share(system), self._setup.nodes))
        assert fields is not None  # narrows the type: one rank has all blocks
        return fields

    def _inside(self) -> tuple[Any, Any, Floats]:
        if self.passed:
            raise RuntimeError(f"the moment t = {self.time:g} has passed: look at it inside of the observer")
        return self._of


def measure(moment: Moment, vacancy_box: Box | None = None) -> dict[str, Any]:
    """What a history row holds but for the wall time: vacancy ratio, energy, volumes, neck and distance of a pair, ...

    vacancy_box: lower and upper corner, nm, in the place of the case's. Raises `CaseError`.
    """
    setup, (system, state, u) = moment._setup, moment._inside()
    if vacancy_box is not None:
        tree = setup.case.tree()
        vacancy_box = parse_case(tree | {"output": tree["output"] | {"vacancy_box": vacancy_box}}).output.vacancy_box
    row = setup.rows(system, state, vacancy_box).row(system, state, u, moment.time, 0.0)
    del row["wall_time"]
    return row


@dataclass(frozen=True)
class Snapshots:
    """The fields at the times that the case asks for; t times, n nodes."""

    nodes: Floats  # (n, dim) nm
    grid: tuple[int, ...] | None  # see `Moment.grid`
    time: Floats  # (t,)
    rho: Floats  # (t, n)
    particle: Numbers  # (t, n)
    eta_squared: Floats  # (t, n)


@dataclass(frozen=True)
class Result:
    """What a run gives."""

    case: Case  # with every default, and the particles of a packing
    ended: str  # "succeeded", "stopped" by the observer, "interrupted" by Ctrl-C; "failed" in a SimulationError
    rows: list[dict[str, Any]]  # of the history: `pandas.DataFrame(result.rows)`
    snapshots: Snapshots
    final: Moment  # the last state
    notes: list[str]  # what a user should know of it; also given as warnings

    @property
    def history(self) -> dict[str, Array]:
        """Columns of the history: (rows,) numbers, or (rows, particles) as `volumes`; NaN where there is none."""
        names = self.rows[0] if self.rows else {}
        return {
            name: np.array([np.nan if row[name] is None else row[name] for row in self.rows]) for name in names
        }


def simulate(case: Given, observer: Observer | None = None, progress: bool | None = None) -> Result:
    """Run a case here and now, on one core.

    case: a `Case`, its tree as a dict, or the path of a case file. observer: called with the `Moment` of each history
    row; True ends the run after the step under way. progress: whether to show a bar; None: where somebody sees it, in
    a terminal or a notebook.

    Ctrl-C (a notebook's stop button) ends the run after the step under way, and the result so far is returned, `ended`
    "interrupted"; a second one raises KeyboardInterrupt at once, as one before the first step does. Raises `CaseError`,
    `MeshError` or `ShapeError` for a case that cannot be run, and `SimulationError`, which has the result so far.
    """
    placed = with_packing(read_case(case))
    with bar(progress, placed.time.end) as show:
        setup = make_setup(placed, Ranks())
        system, state, integrator = setup.start()
        listener = Listener(setup, system, state, observer, show)
        for remark in setup.remarks():
            listener.note(remark)
        with interruptible(listener):
            try:
                ending = run(system, state, integrator, listener)
            except (RunError, FloatingPointError) as error:
                raise SimulationError(str(error), listener.result(system, state, "failed")) from error
    ended = "succeeded" if ending is Ending.DONE else "interrupted" if listener.interrupted else "stopped"
    return listener.result(system, state, ended)


def read_case(given: Given) -> Case:
    """The case, however it is given. Raises `CaseError`."""
    if isinstance(given, Case):
        return given
    return load_case(given) if isinstance(given, str | Path) else parse_case(given)


def with_packing(case: Case) -> Case:
    """The case with the particles that it asks to be packed."""
    if case.particles.source != "packing":
        return case
    packing = packed(case)
    return case.with_particles(packing.centres, packing.radii)


class Listener:
    """Keeps what a run tells; see `run.Observer`."""

    def __init__(
        self, setup: Setup, system: System, state: Progress, observer: Observer | None,
        show: Callable[[Progress, dict[str, Any]], None],
    ) -> None:
        self.setup, self.observer, self.show = setup, observer, show
        self.observables = setup.rows(system, state)
        self.began = time.monotonic()
        self.stopped = self.interrupted = False
        self.rows: list[dict[str, Any]] = []
        self.times: list[float] = []
        self.fields: list[Fields] = []
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        """Keep, and say, what a user should know."""
        self.notes.append(text)
        warnings.warn(text, stacklevel=3)

    def history(self, system: System, state: Progress, u: Floats, at: float) -> None:
        """Keep a row, and ask the observer."""
        if self.stopped:
            return
        if not self.notes and (pressed := piled_up(system, state)):
            self.note(pressed)
        row = self.observables.row(system, state, u, at, time.monotonic() - self.began)
        self.rows.append(row)
        if self.observer is not None:
            moment = Moment(self.setup, system, state, u, at, row)
            self.stopped = bool(self.observer(moment))
            moment.passed = True

    def snapshot(self, number: int, system: System, state: Progress, u: Floats, at: float) -> None:
        """Keep the fields."""
        if not self.stopped:
            self.times.append(at)
            self.fields.append(Moment(self.setup, system, state, u, at, {})._fields)

    def after_step(self, system: System, state: Progress, integrator: Integrator) -> bool:
        """A row where the vacancy ratio has moved; show how far it is; True once somebody wants it to end."""
        ends = (self.rows[0]["vacancy_ratio"], self.rows[-1]["vacancy_ratio"]) if self.rows else None
        if not self.stopped and has_moved(system, state, self.observables, ends):
            self.history(system, state, system.at(state, integrator.y), state.time)
        self.show(state, self.rows[-1] if self.rows else {})
        return self.stopped or self.interrupted

    def result(self, system: System, state: Progress, ended: str) -> Result:
        """Everything so far."""
        n, setup = self.setup.nodes, self.setup
        rho, eta_squared, particle = (
            np.array([each[k] for each in self.fields], dtype=kind).reshape(-1, n)
            for k, kind in enumerate((float, float, np.int32))
        )
        snapshots = Snapshots(setup.positions(), setup.grid, np.array(self.times), rho, particle, eta_squared)
        final = Moment(setup, system, state, system.at(state, system.vector(state)), state.time, {})
        return Result(setup.case, ended, self.rows, snapshots, final, self.notes)


@contextmanager
def interruptible(listener: Listener) -> Iterator[None]:
    """Ctrl-C is noted, and the run ends by itself; once more, and it raises as ever."""

    def hear(number: int, frame: FrameType | None) -> None:
        if listener.interrupted:
            raise KeyboardInterrupt
        listener.interrupted = True

    mine = threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield  # somebody else decides what Ctrl-C means
        return
    signal.signal(signal.SIGINT, hear)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def bar(wanted: bool | None, end: float) -> Iterator[Callable[[Progress, dict[str, Any]], None]]:
    """A line that is written over and over: on stderr, in a notebook on stdout."""
    notebook = "ipykernel" in sys.modules and not sys.stderr.isatty()
    if not (notebook or sys.stderr.isatty() if wanted is None else wanted):
        yield lambda state, row: None
        return
    stream = sys.stdout if notebook else sys.stderr
    began, shown, length = np.inf, -np.inf, 0  # compiling is no part of a step

    def write(line: str) -> None:
        nonlocal length
        line = line[: WIDEST if notebook else shutil.get_terminal_size().columns - 1]  # none that wraps
        stream.write("\r" + line.ljust(length))
        stream.flush()
        length = len(line)

    def show(state: Progress, row: dict[str, Any]) -> None:
        nonlocal began, shown
        clock = time.monotonic()
        began = min(began, clock)
        if clock - shown >= SHOWN_EVERY or state.time >= end:
            shown = clock
            write(looks(state, row, end, clock - began))

    write("preparing")
    try:
        yield show
    finally:
        stream.write("\n")
        stream.flush()


def looks(state: Progress, row: Mapping[str, Any], end: float, seconds: float) -> str:
    """The bar of a run that has taken so many seconds."""
    part = min(state.time / end, 1.0)
    said = [f"{part:4.0%}", f"t = {state.time:.4g} of {end:g}", f"step {state.step}"]
    if row:
        said.append(f"vacancy ratio {row['vacancy_ratio']:.4f}")
    if 0.0 < part < 1.0 and seconds > 1.0:
        left = round(seconds * (1.0 - part) / part)
        said.append(f"{left // 60}:{left % 60:02d} left")
    filled = int(WIDTH * part)
    return f"[{'#' * filled}{'.' * (WIDTH - filled)}] {', '.join(said)}"
