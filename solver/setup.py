"""From a case to what a run needs: nodes anywhere with a mesh between them, or a lattice whose sums go axis by axis."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np

from . import checkpoint
from .arrays import Floats
from .case import Box, Case
from .field import at_nodes
from .geometry import Mesh
from .integrators import Integrator
from .lattice.setup import LatticeSetup
from .observe import Observables
from .output import Fields, fields_of
from .partition import Collector, Ranks, Share
from .points import remarks
from .prepare import build_mesh, make_integrator, prepare
from .scheme import Scheme
from .slots import repack
from .state import State


class Rows(Protocol):
    """Computes history rows."""

    def row(self, system: Any, state: Any, u: Floats, time: float, wall_time: float) -> dict[str, Any]:
        """One row; collective, and of use on rank 0 alone."""

    def vacancy_ratio(self, state: Any) -> float:
        """Of the state's own fields. Collective."""


class Setup(Protocol):
    """All that depends on where the nodes are. Every method but `positions` and `order_parameter` is collective."""

    @property
    def case(self) -> Case:
        """With its particles."""

    @property
    def nodes(self) -> int:
        """How many there are."""

    @property
    def grid(self) -> tuple[int, ...] | None:
        """Nodes along y and x, or z, y and x, where they are rows of a lattice, in their order."""

    def positions(self, nodes: slice = slice(None)) -> Floats:
        """(n, dim) of these nodes, nm."""

    def start(self, kept: Any = None) -> tuple[Any, Any, Integrator]:
        """System, state and integrator of a fresh run, or of one that goes on from what `read` has given."""

    def share(self, system: Any) -> Share:
        """This rank's nodes."""

    def rows(self, system: Any, state: Any, box: Box | None = None) -> Rows:
        """What computes the history; box: the vacancy box, if not the case's."""

    def fields(self, system: Any, state: Any, u: Floats, collector: Collector) -> Fields | None:
        """What a snapshot holds of the nodes of this rank's blocks."""

    def order_parameter(self, system: Any, state: Any, u: Floats, particle: int) -> Floats:
        """(n,) eta of a particle at all nodes; on a single rank."""

    def remarks(self) -> list[str]:
        """What a user should know before the run."""

    def keep(self, directory: Path, system: Any, state: Any, collector: Collector, notes: dict[str, Any]) -> None:
        """Write the checkpoint."""

    def read(self, directory: Path, identity: str) -> Any:
        """The checkpoint, with its `wall_time`, on all ranks. Raises `CheckpointError`."""


def make_setup(case: Case, ranks: Ranks, rows: bool = True) -> Setup:
    """The setup that the case asks for. rows: see `geometry.lattice`."""
    if case.nodes.source == "lattice" and case.shape_functions.kind == "lme":
        return LatticeSetup(case, ranks)
    return MeshSetup(case, ranks, rows)


class MeshSetup:
    """Nodes anywhere; material points in the cells between them."""

    def __init__(self, case: Case, ranks: Ranks, rows: bool = True) -> None:
        self.case, self.ranks = case, ranks
        self.mesh: Mesh = build_mesh(case, ranks, rows)

    @property
    def nodes(self) -> int:
        """How many there are."""
        return len(self.mesh.nodes)

    @property
    def grid(self) -> tuple[int, ...] | None:
        """See `Setup`: that of linear functions on a square or cubic lattice."""
        if self.case.nodes.source != "lattice":
            return None
        return tuple(len(np.unique(column)) for column in self.mesh.nodes.T[::-1])

    def positions(self, nodes: slice = slice(None)) -> Floats:
        """See `Setup`."""
        return self.mesh.nodes[nodes]

    def start(self, kept: checkpoint.Checkpoint | None = None) -> tuple[Scheme, State, Integrator]:
        """See `Setup`."""
        scheme, state = prepare(self.case, self.mesh, self.ranks, kept.reference if kept else None)
        if kept:
            nodes = scheme.d.share.nodes  # the slots that this run gives to the particles need not be those it had
            state.u[:], _ = repack(kept.state.u[nodes], kept.state.owner[nodes], state.slot_of, state.u.shape[1])
            if kept.motion is not None:
                scheme.motion = scheme.carried = kept.motion
        return scheme, state, make_integrator(self.case, self.mesh, kept.memory if kept else None)

    def share(self, system: Scheme) -> Share:
        """This rank's nodes."""
        return system.d.share

    def rows(self, system: Scheme, state: State, box: Box | None = None) -> Observables:
        """What computes the history."""
        return Observables(self.case, self.mesh, system.d, len(state.slot_of), box)

    def fields(self, system: Scheme, state: State, u: Floats, collector: Collector) -> Fields | None:
        """See `Setup`."""
        owner = collector.blocks(state.owner)
        whole = collector.whole(np.ascontiguousarray(u[:, : 1 + owner.shape[1]]), everywhere=True)
        if whole is None or collector.first == collector.last:
            return None
        return fields_of(at_nodes(self.case, self.mesh, slice(collector.first, collector.last), whole), owner)

    def order_parameter(self, system: Scheme, state: State, u: Floats, particle: int) -> Floats:
        """See `Setup`."""
        slot = state.slot_of[particle]
        column = np.where(state.owner[:, slot] == particle, u[:, 1 + slot], 0.0)[:, None]
        return at_nodes(self.case, self.mesh, slice(None), column)[:, 0]

    def remarks(self) -> list[str]:
        """See `Setup`."""
        return list(remarks(self.case, self.mesh))

    def keep(self, directory: Path, system: Scheme, state: State, collector: Collector, notes: dict[str, Any]) -> None:
        """Write the checkpoint."""
        checkpoint.write(directory, system, state, collector, self.mesh, notes)

    def read(self, directory: Path, identity: str) -> checkpoint.Checkpoint:
        """See `Setup`."""
        found: checkpoint.Checkpoint = self.ranks.from_root(
            checkpoint.read(directory, identity, self.mesh) if self.ranks.root else None
        )
        return found
