"""The algorithm: the rates of change of all nodal fields, equation by equation.

Nodes carry rho and eta, material points only integrate (Huang et al. 2023, section 2.2). No loop over points is here:
`kernels` has them, `active` says which points are live, `rigid` turns contact forces into velocities.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from . import block_kernels, contacts, elimination, kernels, rigid, unknowns
from .active import Active, activate
from .arrays import Floats, Integers
from .case import Case
from .discretisation import Discretisation
from .layers import PIECE, Layer
from .partition import Exchange, Ranks, pieces
from .simd import LANES
from .state import State


class Scheme:
    """dy/dt = rates(y): what changes on one rank's nodes (`unknowns`), for the live points of the moment."""

    def __init__(self, d: Discretisation, state: State) -> None:
        self.d = d
        self.particles = len(state.slot_of)
        self.relax: Callable[[Floats], Floats] = lambda motion: motion
        self.motion = np.zeros((self.particles, d.dim + rigid.rotations(d.dim)))
        self.order = elimination.plan(np.empty((0, 2), dtype=np.int64), self.particles)
        self.contacts = contacts.room(64, d.dim)
        self.rooms: dict[str, Floats] = {}
        self.activate(state)

    @property
    def case(self) -> Case:
        """What is computed."""
        return self.d.case

    @property
    def ranks(self) -> Ranks:
        """All ranks."""
        return self.d.share.ranks

    def activate(self, state: State) -> None:
        """Choose the live points and slots for this state (it may move slots), and fit the work arrays. Collective."""
        with self.d.share.ranks.watch("live points"):
            # What is chosen from; a resumed run chooses from it again, and comes to the same.
            self.before = replace(state, u=state.u.copy(), owner=state.owner.copy(), slot_of=state.slot_of.copy())
            if hasattr(self, "active"):
                del self.active, self.layers, self.main  # hundreds of bytes per point, in the way of the next
            self._activate(state)

    def _activate(self, state: State) -> None:
        self.active: Active = activate(self.d, state, partial(self._room, "along"))
        d, a, columns = self.d, self.active, state.u.shape[1]
        self.slot_of = state.slot_of

        # Blocks, and the nodes' fields, rates and W by columns
        self.layers = [
            Layer(d, blocks, live, columns, partial(self._room, name, columns=LANES))
            for name, blocks, live in (("along", d.blocks, a.blocks), ("upright", d.upright, a.upright))
        ]
        self.main = self.layers[0]
        self.W = self.main.W[0, : d.nodes]

        # Loose points: their fields, D and S2; the nodes' fields, and rates (0 between evaluations), by rows
        self.D, self.S2 = np.empty((2, a.loose.size))
        self.touching = np.empty(a.loose.size, dtype=np.int64)
        self.point = self._room("point", a.loose.size * (1 + d.dim), columns)
        self.u_rows, self.rate_rows = np.zeros((2, d.nodes, columns))
        self.work = np.empty((1, d.shape.longest))
        self.velocity = np.zeros((d.dim, columns))

        # Particles: forces and moments, and what contacts measured next carry on from: a resumed run needs it
        size = self.motion.shape[1]
        self.sums = np.zeros((self.particles, size + 1 + d.dim))
        self.forces, self.moments = self.sums[:, :size], self.sums[:, size:]
        self.carried = self.motion

    def _room(self, name: str, rows: int, columns: int) -> Floats:
        """Work space: what `name` had before where that is enough, for new memory has to be cleared page by page."""
        if (kept := self.rooms.get(name)) is None or kept.size < rows * columns:
            kept = self.rooms[name] = np.zeros(rows * columns + rows * columns // 16)
        return kept[: rows * columns].reshape(rows, columns)

    def rates(self, y: Floats, rate: Floats, tau: float | None = None) -> None:
        """Write d rho/dt (3) and d eta/dt (4) into rate, a vector as y: `unknowns`. Collective.

        tau: measure the contacts' stiffness here, and from now on let them relax no faster than 1 / tau around the
        motion of the evaluation before; see `rigid.Relaxation`.
        """
        d, a, m = self.d, self.active, self.d.coefficients
        moving = d.case.model.rigid_motion
        watch = d.share.ranks.watch
        before = watch.enter("gather")

        # Fields and gradients at the points (17), mobility (5), and the potential (24)
        #   W_a = 1/m_a sum_p w_p [ N_a df/drho + kappa_rho grad N_a . grad rho_p ]
        self._gather(y)
        kernels.divide_values(self.W, d.mass, a.nodes)

        # Contact forces (25)-(27) and rigid motion (8)-(10): V_a(r) = [ m_t F_a + m_r T_a x (r - r_a) ] / V_a
        watch.enter("rigid motion")
        if moving:
            forces, moments = self._bodies(y)
            free = rigid.velocities(forces, moments, m)
            if tau is not None and len(a.pairs):
                self.carried = self.motion
                stiffness, self.order = rigid.stiffness_of(
                    self.contacts, d.x, a.pairs, self.order, m, d.huang, d.share.ranks
                )
                self.relax = rigid.relaxation(stiffness, self.order, moments, m, tau, self.carried)
            self.motion = self.relax(free)

        # Fluxes (20), (21)
        #   rate rho_a = 1/m_a sum_p w_p [ -D grad N_a . grad W_p + rho_p grad N_a . v_adv ]
        #   rate eta_a = 1/m_a sum_p w_p [ -L N_a df/deta + grad N_a . ( -L kappa_eta grad eta_p + eta_p v_a ) ]
        watch.enter("scatter")
        self._scatter(rate)
        watch.enter(before)

    def vector(self, state: State) -> Floats:
        """y of the state's fields."""
        return self.active.unknowns.take(state.u)

    def keep(self, state: State, y: Floats) -> None:
        """Make y the state's fields."""
        self.active.unknowns.put(state.u, y)

    def at(self, state: State, y: Floats) -> Floats:
        """The fields (n, F) with y in them."""
        return self.active.unknowns.put(state.u.copy(), y)

    def squares(self, y: Floats) -> float:
        """sum y^2 over the nodes that this rank owns."""
        return float(unknowns.squares(y, self.active.unknowns.strips))

    def step_error(
        self, new: Floats, old: Floats, rate_1: Floats, rate_0: Floats, dt: float, tolerance: float
    ) -> Floats:
        """See `system.System`."""
        sums, strips = np.empty(2), self.active.unknowns.strips
        unknowns.step_error(sums, new, old, rate_1, rate_0, dt, tolerance, self.d.mass, strips)
        return sums

    def scramble(self, direction: Floats, rate: Floats) -> None:
        """Make direction the rate with signs that change from node to node."""
        flipped = self.d.share.nodes[self.active.unknowns.nodes] * 2654435761 % 2**32 >= 2**31
        np.copyto(direction, np.where(flipped, -rate, rate))

    def imbalance(self) -> float:
        """By how much the busiest rank's work exceeds the mean, as a part of it; 0 on one rank. Collective."""
        work, ranks = np.array([self.active.work()]), self.d.share.ranks
        return float(ranks.max(work.copy())[0] * ranks.size / ranks.sum(work)[0] - 1.0)

    def _gather(self, y: Floats) -> None:
        """Fields and D of this rank's points in the work arrays, and W summed over the ranks."""
        d, a = self.d, self.active
        unknowns.spread(self.main.u, self.u_rows, y, a.unknowns.strips)
        for layer in self.layers:
            block_kernels.fetch(layer.u, self.main.u, layer.at)
            layer.W[:] = 0.0
        kernels.start(self.W, a.potential, a.nodes)
        self.contacts.number[0] = 0
        self._potential(border=True, under_way=None)
        under_way = d.share.halo.start(self.W)  # what goes to shared nodes is complete; the rest is done meanwhile
        self._potential(border=False, under_way=under_way)
        if self.contacts.number[0] > self.contacts.share.size:
            self._meet_again()
        d.share.halo.finish(self.W, under_way)

    def _potential(self, border: bool, under_way: Exchange | None) -> None:
        """The part of `_gather` for the points at the border of the rank, or for the others."""
        d, a, table = self.d, self.active, self.d.shape
        for piece in pieces(*self._range(border), LANES * PIECE, under_way):
            touches = kernels.potential(
                self.W, self.touching, self.point, self.D, self.S2, self.u_rows, a.loose, a.mask, a.present, a.several,
                d.weights, table.offsets, table.nodes, table.rows, table.table, self.work, d.coefficients, *piece,
            )
            if d.case.model.rigid_motion:
                self._meet(self.touching[:touches])
        for layer in self.layers:
            layer.potential(self.contacts, border, under_way)
            block_kernels.give(self.main.W, layer.W, layer.at)

    def _scatter(self, rate: Floats) -> None:
        """Sources and fluxes of all points in rate, after `_gather` and once the motion is known."""
        d, a = self.d, self.active
        for layer in self.layers:
            block_kernels.fetch(layer.W, self.main.W, layer.at)
        if d.case.model.rigid_motion:
            kernels.add_still_drift(
                self.rate_rows, a.drift, a.edge_nodes, a.edge_particle, self.slot_of, self.motion
            )
        motion = rigid.in_space(self.motion)
        sums, strips = (self.main.rate, self.rate_rows, d.mass), a.unknowns.strips
        self._divergence(motion, border=True, under_way=None)
        unknowns.collect(rate, *sums, strips, 0, a.unknowns.shared)
        under_way = a.unknowns.halo.start(rate)
        self._divergence(motion, border=False, under_way=under_way)
        unknowns.collect(rate, *sums, strips, a.unknowns.shared, strips.node.size)
        a.unknowns.halo.finish(rate, under_way)

    def _divergence(self, motion: Floats, border: bool, under_way: Exchange | None) -> None:
        """The part of `_scatter` for the points at the border of the rank, or for the others; before the 1/m_a."""
        d, a, table = self.d, self.active, self.d.shape
        for piece in pieces(*self._range(border), LANES * PIECE, under_way):
            kernels.divergence(
                self.rate_rows, self.point, self.D, self.S2, self.W, motion, self.velocity,
                a.loose, a.owner, a.present, d.weights, d.x,
                table.offsets, table.nodes, table.rows, table.table, self.work, d.coefficients,
                d.case.model.rigid_motion, d.huang, *piece,
            )
        for layer in self.layers:
            layer.divergence(motion, border, under_way)
            block_kernels.give(self.main.rate, layer.rate, layer.at)

    def _range(self, border: bool) -> tuple[int, int]:
        """The loose points at the border of the rank, or the others."""
        return (0, self.active.loose_border) if border else (self.active.loose_border, self.active.loose.size)

    def _meet(self, touching: Integers) -> None:
        """Add the contacts of loose points."""
        a, d = self.active, self.d
        kernels.meet(self.contacts, self.point, a.loose, a.owner, d.weights, touching, d.coefficients.c)

    def _meet_again(self) -> None:
        """All contacts, in the same order, in more room: there was not enough."""
        self.contacts = contacts.room(2 * int(self.contacts.number[0]), self.d.dim)
        for border in (True, False):
            self._meet(np.arange(*self._range(border)))
            for layer in self.layers:
                layer.meet(self.contacts, np.arange(*layer.range(border)))

    def _bodies(self, y: Floats) -> tuple[Floats, Floats]:
        """Contact forces and moments of all particles, summed over the ranks, after `_gather`."""
        d, a = self.d, self.active
        self.sums[:] = 0.0
        contacts.contact_forces(self.forces, self.contacts, d.x, d.coefficients)
        self.moments += a.moments
        unknowns.add_moments(self.moments, y, d.mass, d.first_moment, a.unknowns.strips)
        d.share.ranks.sum(self.sums)
        return self.forces, self.moments
