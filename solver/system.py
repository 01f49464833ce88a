"""What integrators and the run need of the discretised equations: dy/dt = rates(y) for one vector y.

`scheme.Scheme` is one, for nodes anywhere; `lattice.scheme.LatticeScheme` the other, for square and cubic lattices.
"""

from collections.abc import Callable
from typing import Any, Protocol

from .arrays import Floats
from .case import Case
from .partition import Ranks


class Progress(Protocol):
    """How far a run is; a system's own state has the fields beside."""

    time: float
    step: int
    evaluations: int


class System(Protocol):
    """One rank's part of the equations. Every method is collective.

    What a run asks of it between steps are functions with an implementation per system: `run.renew`, `run.check`,
    `run.piled_up`.
    """

    relax: Callable[[Floats], Floats]
    """the motion of the particles from the free one; an integrator takes back what a rejected step made of it"""

    @property
    def case(self) -> Case:
        """What is computed."""

    @property
    def ranks(self) -> Ranks:
        """All ranks."""

    def rates(self, y: Floats, rate: Floats, tau: float | None = None) -> None:
        """Write dy/dt into rate; tau: see `scheme.Scheme.rates`."""

    def vector(self, state: Any) -> Floats:
        """The state's fields as a new vector."""

    def keep(self, state: Any, y: Floats) -> None:
        """Make y the state's fields."""

    def at(self, state: Any, y: Floats) -> Floats:
        """Fields y of a time within a step, as `observe` and `output` take them; the state stays as it is."""

    def squares(self, y: Floats) -> float:
        """sum y^2 over what this rank counts."""

    def step_error(
        self, new: Floats, old: Floats, rate_1: Floats, rate_0: Floats, dt: float, tolerance: float
    ) -> Floats:
        """(2,) this rank's sum of m_a (e / (tolerance (1 + |u|)))^2 over nodes and fields, and of m_a; with
        e = 0.8 (y_n - y_{n+1}) + 0.4 dt (F_n + F_{n+1})."""

    def scramble(self, direction: Floats, rate: Floats) -> None:
        """Make direction the rate with signs that change from node to node, the same on all ranks."""

    def imbalance(self) -> float:
        """By how much the busiest rank's work exceeds the mean, as a part of it; 0 on one rank."""
