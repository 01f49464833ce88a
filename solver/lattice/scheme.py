"""The rates of change of all fields on a square or cubic lattice: the algorithm of `..scheme`, axis by axis."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .. import contacts, elimination, rigid
from ..arrays import Floats, Integers, zeros
from ..case import Case
from ..energy import Coefficients
from ..geometry import MeshError
from ..partition import Halo, Places, Ranks, Share
from ..simd import LANES
from . import loops, windows
from .axis import GHOSTS, Axis, make_axis
from .loops import PAD, Points, Room, Tables
from .windows import Boxes, Layout

Axes = tuple[Axis, Axis | None, Axis]  # slow, middle, fast; in the plane there is no middle one


@dataclass(frozen=True)
class Lattice:
    """One rank's part of the lattice: the layers of cells that it sums over, and the planes of nodes that these see."""

    case: Case
    ranks: Ranks
    axes: Axes
    layers: range
    cuts: tuple[int, ...]  # the layers where each rank's begin, and the end
    tables: Tables
    inverse_mass: Floats  # 1 / m_a in rho's window, 0 beside the nodes   (22)
    moments: tuple[Floats, Floats, Floats]  # per axis (2, 2, n): sums of N and x N over its points
    coefficients: Coefficients

    @property
    def dim(self) -> int:
        """2 or 3."""
        return 2 if self.axes[1] is None else 3

    @property
    def reach(self) -> int:
        """How many nodes on each side a point sees."""
        return self.axes[0].reach

    @property
    def column(self) -> int:
        """Where the first cell is in rows of points; see `loops.column`."""
        return GHOSTS + self.axes[2].reach

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Nodes of the whole lattice along slow, middle and fast axis."""
        return nodes_of(self.axes)

    def planes_of(self, rank: int) -> range:
        """The planes of nodes that a rank holds."""
        first, end = self.cuts[rank], self.cuts[rank + 1]
        return range(max(0, first - self.reach + 1), min(self.nodes[0], end + self.reach))

    @property
    def planes(self) -> range:
        """The planes of nodes that this rank holds."""
        return self.planes_of(self.ranks.rank)

    @property
    def owned(self) -> range:
        """The planes of nodes that this rank counts: together with the others' each once."""
        last = self.ranks.rank == self.ranks.size - 1
        return range(self.layers.start, self.layers.stop + last)

    @property
    def row(self) -> int:
        """The length of a row of rho's window."""
        return windows.whole_packs(self.nodes[2] + 2 * self.reach)

    def share(self) -> Share:
        """This rank's nodes, for those who collect nodal values."""
        plane = self.nodes[1] * self.nodes[2]
        held, owned = self.planes, np.zeros(len(self.planes) * plane, dtype=bool)
        owned[(self.owned.start - held.start) * plane : (self.owned.stop - held.start) * plane] = True
        halo = Halo(self.ranks, owned.size, [])
        halo.owned = owned
        numbers = np.arange(held.start * plane, held.stop * plane)
        return Share(self.ranks, np.empty(0, dtype=np.int64), numbers, halo, self.nodes[0] * plane)

    def values(self, window: Floats) -> Floats:
        """What rho's window holds, at the nodes alone: (planes, middle, fast)."""
        whole = window[: len(self.planes) * self.nodes[1] * self.row].reshape(-1, self.nodes[1], self.row)
        return whole[:, :, self.reach : self.reach + self.nodes[2]]

    def halo(self, layout: Layout) -> Halo:
        """The entries of a vector of the layout, or of rho's alone, that other ranks hold, too."""
        neighbours: list[tuple[int, Places]] = []
        for rank in range(self.ranks.size):
            theirs = self.planes_of(rank)
            if rank == self.ranks.rank or theirs.stop <= self.planes.start or self.planes.stop <= theirs.start:
                continue
            parts: list[slice] = []
            for offset, low, size in zip(layout.offset, layout.low, layout.size, strict=False):
                begin, end = max(low[0], theirs.start), min(low[0] + size[0], theirs.stop)
                if (plane := size[1] * size[2]) and begin < end:
                    parts.append(slice(int(offset + (begin - low[0]) * plane), int(offset + (end - low[0]) * plane)))
            if parts:
                neighbours.append((rank, parts))
        return Halo(self.ranks, int(layout.offset[-1]), neighbours)


def nodes_of(axes: Axes) -> tuple[int, int, int]:
    """Nodes of the whole lattice along slow, middle and fast axis."""
    slow, middle, fast = axes
    return slow.cells + 1, 1 if middle is None else middle.cells + 1, fast.cells + 1


def axes_of(case: Case) -> Axes:
    """Slow, middle and fast axis of the case's lattice. Raises `ShapeError`."""
    given, spacing = case.shape_functions, case.nodes.spacing
    assert spacing is not None  # narrows the type: the case was checked
    shape = given.gamma, given.tolerance, given.width
    axes = [make_axis(length, spacing, *shape) for length in reversed(case.domain.size)]
    return (axes[0], None, axes[1]) if len(axes) == 2 else (axes[0], axes[1], axes[2])


def cut(work: Floats, parts: int) -> tuple[int, ...]:
    """Where each part of the layers begins, and the end: parts of about equal work, of one layer at least."""
    if parts > len(work):
        raise MeshError(f"{parts} ranks: this lattice has {len(work)} layers of cells, and each rank needs one")
    whole = np.concatenate([[0.0], np.cumsum(work)])
    cuts = [0]
    for part in range(1, parts):
        best = int(np.abs(whole - whole[-1] * part / parts).argmin())
        cuts.append(min(max(best, cuts[-1] + 1), len(work) - parts + part))
    return (*cuts, len(work))


def make_lattice(case: Case, axes: Axes, ranks: Ranks, work: Floats) -> Lattice:
    """This rank's part; work (layers,): what an evaluation costs in each."""
    slow, middle, fast = axes
    cuts = cut(work, ranks.size)
    layers = range(cuts[ranks.rank], cuts[ranks.rank + 1])
    weight = 0.5 * float(np.prod([axis.step for axis in axes if axis is not None]))
    one, none = np.ones((2, 1, 1)), np.zeros((2, 1, 1))

    def centred(axis: Axis | None) -> Floats:
        return np.zeros((2, 1)) if axis is None else axis.points - 0.5 * axis.length

    tables = Tables(
        slow.N, slow.dN, one if middle is None else middle.N, none if middle is None else middle.dN,
        fast.by_cell(fast.N), fast.by_cell(fast.dN), fast.by_node(fast.N), fast.by_node(fast.dN),
        fast.N[:, fast.cells // 2, None].copy(), fast.dN[:, fast.cells // 2, None].copy(),
        np.pad(centred(fast), ((0, 0), (GHOSTS + fast.reach, GHOSTS))), centred(middle), centred(slow), weight,
    )  # fmt: skip
    alone = np.array([[[1.0], [1.0]], [[0.0], [0.0]]])
    sums = [
        alone if axis is None else np.stack([axis.sums(np.ones((2, 1))), axis.sums(centred(axis))]) for axis in axes
    ]
    sums[0] *= weight
    found = Lattice(
        case, ranks, axes, layers, cuts, tables, np.empty(0), (sums[0], sums[1], sums[2]),
        Coefficients(*(getattr(case.model, name) for name in Coefficients._fields)),
    )
    held, reach, row = found.planes, found.reach, found.row
    mass = np.einsum("ps,pm,pf->smf", sums[0][0][:, held.start : held.stop], sums[1][0], sums[2][0])
    inverse = np.zeros((*mass.shape[:2], row))
    inverse[:, :, reach : reach + mass.shape[2]] = 1.0 / mass
    object.__setattr__(found, "inverse_mass", np.append(inverse, np.zeros(8 * LANES)))
    return found


@dataclass
class LatticeState:
    """Everything that a run goes on from: the fields as one vector, in the windows of the scheme."""

    time: float
    step: int
    evaluations: int
    y: Floats


class LatticeScheme:
    """dy/dt = rates(y) on one rank's part of a lattice, y a vector of a `Layout`."""

    def __init__(self, lattice: Lattice, boxes: Boxes) -> None:
        self.lattice = lattice
        self.particles = len(boxes.low)
        self.relax: Callable[[Floats], Floats] = lambda motion: motion
        self.motion = np.zeros((self.particles, lattice.dim + rigid.rotations(lattice.dim)))
        self.carried = self.motion
        self.order = elimination.plan(np.empty((0, 2), dtype=np.int64), self.particles)
        self.contacts = contacts.room(64, lattice.dim)
        self.where = np.zeros((64, lattice.dim))
        self.at_nodes: dict[int, Floats] = {}  # functions at the nodes of an axis, by its number
        self.lay_out(boxes)

    def lay_out(self, boxes: Boxes) -> None:
        """Go over to other windows. Collective."""
        g = self.lattice
        self.boxes = boxes
        held = g.planes
        self.layout = windows.lay_out(boxes, g.nodes, g.reach, (held.start, held.stop), g.layers)
        self.rho = int(self.layout.offset[1])
        self.pairs = meeting(boxes)
        rows, width = int(self.layout.size[:, 1].max()), int(self.layout.size[:, 2].max()) + 2 * PAD
        cells = 1 if g.axes[1] is None else g.axes[1].cells
        P = windows.whole_packs(g.tables.fast.shape[1])
        self.room = Room(
            zeros(4 * rows, width), zeros(4 * rows, width), zeros(3, width), zeros(4, width), zeros(1, width),
            zeros(1, width), zeros(8 * cells, P), zeros(6 * cells, P),
            np.zeros((12, 1)), zeros(64, 4 * LANES),
            np.zeros(64, dtype=np.int64),
        )  # fmt: skip
        if not hasattr(self, "points"):
            self.points = Points(*(zeros(2 * len(g.layers) * cells, P) for _ in range(3)))
            self.W = zeros(1, self.rho)
            low, size = self.layout.low[:1], self.layout.size[:1]
            self.halo_W = g.halo(self.layout._replace(offset=self.layout.offset[:2], low=low, size=size))
        self.halo = g.halo(self.layout)

    @property
    def case(self) -> Case:
        """What is computed."""
        return self.lattice.case

    @property
    def ranks(self) -> Ranks:
        """All ranks."""
        return self.lattice.ranks

    def rates(self, y: Floats, rate: Floats, tau: float | None = None) -> None:
        """Write d rho/dt (3) and d eta/dt (4) into rate. Collective. tau: as in `frit.solver.scheme.Scheme.rates`."""
        g, m, layout = self.lattice, self.lattice.coefficients, self.layout
        fields, first, count = y.reshape(1, -1), g.layers.start, len(g.layers)
        moving = g.case.model.rigid_motion
        watch = g.ranks.watch
        before = watch.enter("gather")

        # Fields and gradients at the points (17), mobility (5), and the potential (24)
        #   W_a = 1/m_a sum_p w_p [ N_a df/drho + kappa_rho grad N_a . grad rho_p ]
        while True:
            self.W[:] = 0.0
            self.contacts.number[0] = 0
            loops.potential(
                self.W, self.points, self.contacts, self.where, fields, layout, g.tables, self.room, m, moving,
                first, count, g.layers.start, g.layers.stop,
            )  # fmt: skip
            if self.contacts.number[0] <= self.contacts.share.size:
                break
            self.contacts = contacts.room(2 * int(self.contacts.number[0]), g.dim)
            self.where = np.zeros((self.contacts.share.size, g.dim))
        loops.divide(self.W, g.inverse_mass, layout, 0, 1)
        self.halo_W.add(self.W[0])

        # Contact forces (25)-(27) and rigid motion (8)-(10): V_a(r) = [ m_t F_a + m_r T_a x (r - r_a) ] / V_a
        watch.enter("rigid motion")
        if moving:
            forces, moments = self.bodies(y)
            free = rigid.velocities(forces, moments, m)
            if tau is not None and len(self.pairs):
                self.carried = self.motion
                huang = g.case.model.advection == "huang"
                stiffness, self.order = rigid.stiffness_of(
                    self.contacts, self.where, self.pairs, self.order, m, huang, g.ranks
                )
                self.relax = rigid.relaxation(stiffness, self.order, moments, m, tau, self.carried)
            self.motion = self.relax(free)

        # Fluxes (20), (21)
        #   rate rho_a = 1/m_a sum_p w_p [ -D grad N_a . grad W_p + rho_p grad N_a . v_adv ]
        #   rate eta_a = 1/m_a sum_p w_p [ -L N_a df/deta + grad N_a . ( -L kappa_eta grad eta_p + eta_p v_a ) ]
        watch.enter("scatter")
        changes = rate.reshape(1, -1)
        changes[:] = 0.0
        loops.divergence(
            changes, self.points, self.W, rigid.in_space(self.motion), fields, layout, g.tables, self.room, m, moving,
            g.case.model.advection == "huang", first, count, g.layers.start, g.layers.stop,
        )  # fmt: skip
        loops.divide(changes, g.inverse_mass, layout, 0, 1 + self.particles)
        self.halo.add(rate)
        watch.enter(before)

    def vector(self, state: LatticeState) -> Floats:
        """A copy of the state's fields."""
        y = zeros(state.y.size)
        y[:] = state.y
        return y

    def keep(self, state: LatticeState, y: Floats) -> None:
        """Make y the state's fields."""
        state.y[:] = y

    def at(self, state: LatticeState, y: Floats) -> Floats:
        """y itself."""
        return y

    def squares(self, y: Floats) -> float:
        """sum y^2 over the nodes that this rank owns."""
        return float(loops.add_squares(y, self.layout, self.lattice.owned.start, self.lattice.owned.stop))

    def step_error(
        self, new: Floats, old: Floats, rate_1: Floats, rate_0: Floats, dt: float, tolerance: float
    ) -> Floats:
        """See `system.System`."""
        sums, owned = np.empty(2), self.lattice.owned
        loops.step_error(
            sums, new, old, rate_1, rate_0, dt, tolerance, self.lattice.inverse_mass, self.layout,
            owned.start, owned.stop,
        )  # fmt: skip
        return sums

    def scramble(self, direction: Floats, rate: Floats) -> None:
        """Make direction the rate with signs that change from node to node."""
        windows.scramble(direction, rate, self.layout, np.array(self.lattice.nodes))

    def imbalance(self) -> float:
        """The layers are cut once, by the windows of the start."""
        return 0.0

    def moments(self, y: Floats) -> Floats:
        """(particles, 1 + dim) this rank's part of V_a = int eta_a and int r eta_a, r from the domain's centre."""
        g = self.lattice
        found = np.zeros((self.particles, 1 + g.dim))
        loops.add_moments(found, y.reshape(1, -1), self.layout, *g.moments, g.owned.start, g.owned.stop)
        return found

    def bodies(self, y: Floats) -> tuple[Floats, Floats]:
        """Contact forces and moments of all particles, summed over the ranks, of the last sums over points."""
        g = self.lattice
        size = self.motion.shape[1]
        sums = np.zeros((self.particles, size + 1 + g.dim))
        contacts.contact_forces(sums[:, :size], self.contacts, self.where, g.coefficients)
        sums[:, size:] += self.moments(y)
        g.ranks.sum(sums)
        return sums[:, :size], sums[:, size:]


def meeting(boxes: Boxes) -> Integers:
    """Pairs a < b of particles whose windows have cells in common: (pairs, 2), sorted."""
    low, high = boxes.low - 1, boxes.low + boxes.size + 1
    order = np.argsort(low[:, 0], kind="stable")
    found = []
    for i, a in enumerate(order):
        if not boxes.size[a, 0]:
            continue
        near = order[i + 1 :][: np.searchsorted(low[order[i + 1 :], 0], high[a, 0])]
        near = near[((low[near] < high[a]) & (low[a] < high[near]) & (boxes.size[near] > 0)).all(axis=1)]
        found.append(np.stack([np.minimum(a, near), np.maximum(a, near)], axis=1))
    pairs = np.concatenate([np.empty((0, 2), dtype=np.int64), *found])
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
