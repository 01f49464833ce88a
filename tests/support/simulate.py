"""Run a case inside the test's process, on one rank, and keep its history rows and fields."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frit.solver.arrays import Floats
from frit.solver.case import Case, parse_case
from frit.solver.geometry import Mesh
from frit.solver.integrators import Integrator
from frit.solver.observe import Observables
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh, make_integrator, prepare
from frit.solver.run import run
from frit.solver.scheme import Scheme
from frit.solver.state import State


@dataclass
class Result:
    """What a run left behind: also the observer that collects it."""

    case: Case
    mesh: Mesh
    scheme: Scheme
    state: State
    observables: Observables
    rows: list[dict[str, Any]] = field(default_factory=list)

    def history(self, scheme: Scheme, state: State, u: Floats, time: float) -> None:
        """Keep a row."""
        self.rows.append(self.observables.row(scheme, state, u, time, 0.0))

    def snapshot(self, number: int, scheme: Scheme, state: State, u: Floats, time: float) -> None:
        """No snapshots."""

    def after_step(self, scheme: Scheme, state: State, integrator: Integrator) -> bool:
        """Go on to the end."""
        return False

    def column(self, name: str) -> Floats:
        """A column of the history."""
        return np.array([row[name] for row in self.rows], dtype=float)

    def at(self, name: str, time: float) -> float:
        """An entry of the history at one of its times."""
        return float(self.column(name)[np.argmin(np.abs(self.column("time") - time))])

    def field(self, particle: int) -> Floats:
        """The order parameter of a particle at the nodes."""
        slot = self.state.slot_of[particle]
        return np.where(self.state.owner[:, slot] == particle, self.state.u[:, 1 + slot], 0.0)


def rates_of(scheme: Scheme, state: State, tau: float | None = None) -> Floats:
    """The rates of change of all fields (n, F); 0 where nothing changes."""
    places = scheme.active.unknowns
    rate = np.full(places.size, np.nan)
    scheme.rates(places.take(state.u), rate, tau)
    return places.put(np.zeros_like(state.u), rate)


def simulate(tree: dict[str, Any]) -> Result:
    """Run the case of this tree."""
    case, ranks = parse_case(tree), Ranks()
    mesh = build_mesh(case, ranks)
    scheme, state = prepare(case, mesh, ranks)
    result = Result(case, mesh, scheme, state, Observables(case, mesh, scheme.d, len(state.slot_of)))
    run(scheme, state, make_integrator(case, mesh), result)
    return result


def merged(tree: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A copy of a tree with some tables changed key by key: merged(tree, time={"end": 1.0})."""
    return {key: {**value} if isinstance(value, dict) else value for key, value in tree.items()} | {
        key: {**tree.get(key, {}), **value} for key, value in changes.items()
    }
