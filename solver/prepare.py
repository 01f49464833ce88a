"""From a case to a scheme and a state: mesh, initial fields, division among the ranks."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from .case import LATTICES, Case
from .discretisation import activity, discretise
from .geometry import Mesh, make_mesh
from .integrators import Integrator, integrator_of
from .partition import Ranks
from .points import on_mesh, with_points
from .project import project
from .scheme import Scheme
from .state import State, initial_state


def build_mesh(case: Case, ranks: Ranks, rows: bool = True) -> Mesh:
    """The case's mesh on every rank. A lattice is built by each; a generated or read mesh comes from rank 0.

    rows: see `geometry.lattice`.
    """
    size, linear = case.domain.size, case.shape_functions.kind == "linear"
    if case.nodes.source in LATTICES:
        return with_points(case, make_mesh(case.nodes, size, rows))
    cells = linear or case.points.source == "cells"
    mesh: Mesh = ranks.from_root(with_points(case, make_mesh(case.nodes, size, rows, cells)) if ranks.root else None)
    return mesh


def prepare(case: Case, mesh: Mesh, ranks: Ranks, whole: State | None = None) -> tuple[Scheme, State]:
    """The scheme and the state on this rank; `whole` is the state to go on from, on all nodes (None: the initial one).

    Collective. The division follows the work expected for that state.
    """
    fresh = whole is None
    if whole is None:
        whole = initial_state(case, mesh.nodes)
    eps = min(case.activation.eps_rho, case.activation.eps_eta)
    d = discretise(case, mesh, ranks, activity(mesh, whole.u, eps))
    nodes = d.share.nodes
    state = replace(whole, u=whole.u[nodes].copy(), owner=whole.owner[nodes].copy(), slot_of=whole.slot_of.copy())
    if fresh and not on_mesh(case):
        project(d, state)
    return Scheme(d, state), state


def make_integrator(case: Case, mesh: Mesh, memory: dict[str, float] | None = None) -> Integrator:
    """The integrator that the case asks for; memory: what a checkpoint kept of it."""
    return integrator_of(case, shortest_distance(case, mesh), memory)


def shortest_distance(case: Case, mesh: Mesh) -> float:
    """d_min of the paper's step rule, nm: the width of the functions; for linear ones the spacing of a lattice, else
    the smallest distance between two nodes.

    Nodes may be nearer to each other, as they are along two walls of a lattice: functions of one width do not see it.
    """
    if case.shape_functions.kind != "linear":
        return mesh.width
    if case.nodes.source in LATTICES:
        return float(mesh.spacing.min())
    distance, _ = cKDTree(mesh.nodes).query(mesh.nodes, k=2)
    return float(np.min(np.asarray(distance)[:, 1]))
