"""One rank's nodes, material points and shape functions: all that does not change during a run."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from . import kernels, sampling
from .arrays import Array, Flags, Floats, Integers
from .blocks import Blocks, find_blocks, find_upright
from .case import Case
from .energy import Coefficients
from .geometry import Mesh
from .neighbours import Grid
from .partition import Halo, Ranks, Share, bisect
from .shape import Nearest, ShapeError, ShapeTable, linear, lme, nearest

# Points rest only where no more than this part of all must live. A boundary between resting and live points costs, too:
# what moves at it slowly has to be looked after, and each new choice is a small jolt to the steps in time.
WORTH = 0.6
FIXED_WORK = 1.0  # of a live point, in units of the work for one field: W goes to the nodes and back
RESTING_WORK = 0.1
NEAR = 1e-3  # nodes with a smaller N_a(x_p) do not decide who shares a slot: what they bring is below eps


@dataclass(frozen=True)
class Discretisation:
    """x (p, dim) are the points' positions measured from the centre of the domain, in nm."""

    case: Case
    share: Share
    shape: ShapeTable
    blocks: Blocks  # along x
    upright: Blocks  # along y, of points in none of those
    nearest: Nearest
    steepest: float  # the largest of sum_a |N_a| = 1 and sum_a |grad N_a| at any point of any rank, 1/nm
    positions: Floats  # (n, dim) of this rank's nodes, nm
    x: Floats  # (p, dim)
    at_wall: Flags  # (p,) points within one spacing of a wall
    weights: Floats  # (p,) nm^dim
    mass: Floats  # (n,) m_a = sum_p w_p N_a(x_p) over all ranks   (22)
    first_moment: Floats  # (n, dim) q_a = sum_p w_p x_p N_a(x_p) over all ranks
    coefficients: Coefficients

    @property
    def dim(self) -> int:
        """2 or 3."""
        return int(self.x.shape[1])

    @property
    def nodes(self) -> int:
        """The number of nodes that this rank holds."""
        return len(self.positions)

    def sample(self, u: Floats, points: slice | None = None) -> Floats:
        """The fields (p, F) of the coefficients u (n, F) at this rank's points, or some of them   (17)"""
        table = self.shape if points is None else self.shape.part(points)
        values = np.empty((table.points, u.shape[1]))
        sampling.sample(values, u, table.offsets, table.nodes, table.rows, table.table)
        return values

    @property
    def huang(self) -> bool:
        """Whether v_adv = sum eta_a v_a (11); else Wang's v_adv = sum v_a."""
        return self.case.model.advection == "huang"


def shape_table(case: Case, mesh: Mesh, points: Integers) -> ShapeTable:
    """The shape functions that the case asks for, at some of the mesh's points."""
    if case.shape_functions.kind == "linear":
        return linear(mesh.points[points], mesh.cells[points], mesh.nodes)
    return lme_at(case, mesh, mesh.points[points])


def lme_at(case: Case, mesh: Mesh, x: Floats, grid: Grid | None = None) -> ShapeTable:
    """The case's maximum-entropy functions anywhere; grid: of the nodes, if it exists."""
    given = case.shape_functions
    return lme(x, np.full(len(x), mesh.width), mesh.nodes, given.gamma, given.tolerance, grid)


def discretise(case: Case, mesh: Mesh, ranks: Ranks, activity: Floats) -> Discretisation:
    """This rank's share of the mesh; `activity` (p,) > 0 is the expected work of each point. Collective."""
    part = bisect(mesh.points, activity, ranks.size)
    points = np.flatnonzero(part == ranks.rank)
    table = shape_table(case, mesh, points)
    seen = np.zeros(len(mesh.nodes), dtype=np.int8)
    kernels.touch(seen, np.ones(points.size, dtype=bool), table.offsets, table.nodes)
    nodes = np.flatnonzero(seen)
    local = np.full(len(mesh.nodes), -1, dtype=np.int32)
    local[nodes] = np.arange(nodes.size, dtype=np.int32)
    kernels.renumber(table.nodes, local)
    share = Share(ranks, points, nodes, Halo.of_nodes(ranks, nodes), len(mesh.nodes))
    size = np.asarray(case.domain.size)
    x = mesh.points[points] - 0.5 * size
    weights = np.ascontiguousarray(mesh.weights[points])
    mass, first_moment = np.zeros(nodes.size), np.zeros((nodes.size, x.shape[1]))
    kernels.nodal_moments(mass, first_moment, weights, x, table.offsets, table.nodes, table.rows, table.table)
    shared = np.zeros(nodes.size, dtype=bool)
    shared[share.halo.shared] = True
    share.halo.add(mass)
    share.halo.add(first_moment)
    _check_mass(mesh, share, mass)
    positions = mesh.nodes[nodes]
    at_wall = np.asarray((0.5 * size - np.abs(x) <= mesh.spacing.max()).any(axis=1))
    blocks = find_blocks(table, x, shared)
    upright = find_upright(table, x, positions, blocks)
    return Discretisation(
        case, share, table, blocks, upright, nearest(table, NEAR), steepest(table, ranks),
        positions, x, at_wall, weights, mass, first_moment,
        Coefficients(*(getattr(case.model, name) for name in Coefficients._fields)),
    )


def steepest(table: ShapeTable, ranks: Ranks) -> float:
    """The largest of 1 and of sum_a |grad N_a| (all components' absolute values) over the points of all ranks."""
    most = np.ones(1)
    kernels.largest_slope(most, table.table, np.unique(table.rows), table.longest)
    return float(ranks.max(most)[0])


def _check_mass(mesh: Mesh, share: Share, mass: Floats) -> None:
    """Every node must be seen by some point with a weight worth the name."""
    held = np.zeros(share.total)
    held[share.nodes] = mass
    share.ranks.max(held)
    if not (held > 0.0).all():
        a = int(np.argmin(held))
        raise ShapeError(
            f"node {a} at {np.array2string(mesh.nodes[a], precision=6)} nm is in range of no material point: "
            "its volume m_a is 0"
        )


def activity(mesh: Mesh, u: Floats, eps: float) -> Floats:
    """Expected work of each point (p,): `FIXED_WORK` and the fields that exist there, or `RESTING_WORK` where it rests.

    A point rests where no field varies over its cell by more than eps per nm. Where resting does not pay (`WORTH`) all
    points live.
    """
    varies, fields = np.zeros(len(mesh.cells), dtype=bool), np.zeros(len(mesh.cells), dtype=np.int32)
    spacing = mesh.spacing if mesh.in_cells else np.full(len(mesh.cells), mesh.width)
    kernels.variation(varies, fields, mesh.cells, u, eps * spacing, eps)
    if not mesh.in_cells:
        varies, fields = (_at_points(mesh, values) for values in (varies, fields))
    return np.where(varies | (varies.mean() > WORTH), FIXED_WORK + fields, RESTING_WORK)


def _at_points(mesh: Mesh, values: Array) -> Array:
    """The largest of the values of the cells around the node that is nearest to each point."""
    at_nodes = np.zeros(len(mesh.nodes), dtype=values.dtype)
    for column in mesh.cells.T:
        np.maximum.at(at_nodes, column, values)
    return at_nodes[np.asarray(cKDTree(mesh.nodes).query(mesh.points)[1])]
