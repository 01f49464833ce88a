"""The algorithm: the rates of change of all nodal fields, equation by equation.

Nodes carry rho and eta, material points only integrate (Huang et al. 2023, section 2.2). No loop over points is here:
`kernels` has them, `active` says which points are live, `rigid` turns contact forces into velocities.
"""

from collections.abc import Callable

import numpy as np

from . import kernels, rigid
from .active import Active, activate
from .arrays import Floats
from .discretisation import Discretisation
from .state import State


class Scheme:
    """du/dt = rates(u) on one rank's nodes, for the live points of the moment."""

    def __init__(self, d: Discretisation, state: State) -> None:
        self.d = d
        self.particles = len(state.slot_of)
        self.relax: Callable[[Floats], Floats] = lambda motion: motion
        self.motion = np.zeros((self.particles, d.dim + rigid.rotations(d.dim)))
        self.activate(state)

    def activate(self, state: State) -> None:
        """Choose the live points and slots for this state (it may move slots), and fit the work arrays. Collective."""
        with self.d.share.ranks.watch("live points"):
            self._activate(state)

    def _activate(self, state: State) -> None:
        self.point = np.empty((0, 0))  # free the largest array before the next one is made
        self.active: Active = activate(self.d, state)
        points = self.active.live.size
        self.slot_of, self.node_owner = state.slot_of, state.owner
        self.W = np.zeros(self.d.nodes)
        self.inverse_mass = np.zeros_like(state.u)  # 1 / m_a; 0 in slots that no particle has at the node
        self.inverse_mass[:, 0] = 1.0
        self.inverse_mass[:, 1 : 1 + state.owner.shape[1]] = state.owner >= 0
        self.inverse_mass /= self.d.mass[:, None]
        self.D, self.S2 = np.empty((2, points))
        self.touching, self.touches = np.empty(points, dtype=np.int64), 0
        self.point = np.zeros((points * (1 + self.d.dim), state.u.shape[1]))
        size = self.motion.shape[1]
        self.sums = np.zeros((self.particles, size + 1 + self.d.dim))
        self.forces, self.moments = self.sums[:, :size], self.sums[:, size:]
        self.carried = self.motion  # what contacts measured next carry on from: a resumed run needs it
        self.work = np.empty((1, self.d.shape.longest))
        self.velocity = np.zeros((self.d.dim, state.u.shape[1]))

    def rates(self, u: Floats, rate: Floats, tau: float | None = None) -> None:
        """Write d rho/dt (3) and d eta/dt (4) at the live nodes into rate (n, F). Collective.

        tau: measure the contacts' stiffness here, and from now on let them relax no faster than 1 / tau around the
        motion of the evaluation before; see `rigid.Relaxation`.
        """
        d, a, m, table = self.d, self.active, self.d.coefficients, self.d.shape
        moving = d.case.model.rigid_motion
        watch = d.share.ranks.watch
        before = watch.enter("gather")

        # Fields and gradients at the points (17), mobility (5), and the potential (24)
        #   W_a = 1/m_a sum_p w_p [ N_a df/drho + kappa_rho grad N_a . grad rho_p ]
        self._gather(u)
        d.share.halo.add(self.W)
        kernels.divide_values(self.W, d.mass, a.nodes)

        # Contact forces (25)-(27) and rigid motion (8)-(10): V_a(r) = [ m_t F_a + m_r T_a x (r - r_a) ] / V_a
        watch.enter("rigid motion")
        if moving:
            forces, moments = self._bodies(u)
            free = rigid.velocities(forces, moments, m)
            if tau is not None and len(a.pairs):
                self.carried = self.motion
                self.relax = rigid.relaxation(self._stiffness(), a.pairs, moments, m, tau, self.carried)
            self.motion = self.relax(free)

        # Fluxes (20), (21)
        #   rate rho_a = 1/m_a sum_p w_p [ -D grad N_a . grad W_p + rho_p grad N_a . v_adv ]
        #   rate eta_a = 1/m_a sum_p w_p [ -L N_a df/deta + grad N_a . ( -L kappa_eta grad eta_p + eta_p v_a ) ]
        watch.enter("scatter")
        kernels.clear(rate, a.nodes)
        kernels.divergence(
            rate, self.point, self.D, self.S2, self.W, self.motion, self.velocity,
            a.live, a.owner, a.present, d.weights, d.x,
            table.offsets, table.nodes, table.rows, table.table, self.work, m, moving, d.huang,
        )
        if moving:
            kernels.add_still_drift(rate, a.drift, a.edge_nodes, a.edge_particle, self.slot_of, self.motion)
        d.share.halo.add(rate)
        kernels.scale(rate, self.inverse_mass, a.nodes)
        watch.enter(before)

    def _stiffness(self) -> Floats:
        """How the contact forces answer to rigid motion, (pairs, 2, k, k) summed over the ranks, after `_gather`."""
        d, a = self.d, self.active
        size = self.motion.shape[1]
        stiffness = np.zeros((len(a.pairs), 2, size, size))
        keys = a.pairs[:, 0] * self.particles + a.pairs[:, 1]
        kernels.contact_stiffness(
            stiffness, keys, self.touching[: self.touches], self.point, a.live, a.owner, d.weights, d.x,
            self.particles, d.coefficients, d.huang,
        )
        return d.share.ranks.sum(stiffness)

    def _gather(self, u: Floats) -> None:
        """Fields and D of this rank's points, and its part of W, in the work arrays."""
        d, a, table = self.d, self.active, self.d.shape
        kernels.start(self.W, a.potential, a.nodes)
        self.touches = kernels.potential(
            self.W, self.touching, self.point, self.D, self.S2, u, a.live, a.mask, a.present, a.several,
            d.weights, table.offsets, table.nodes, table.rows, table.table, self.work, d.coefficients,
        )

    def _bodies(self, u: Floats) -> tuple[Floats, Floats]:
        """Contact forces and moments of all particles, summed over the ranks, after `_gather`."""
        d, a = self.d, self.active
        self.sums[:] = 0.0
        kernels.contact_forces(
            self.forces, self.touching[: self.touches], self.point, a.live, a.owner, d.weights, d.x, d.coefficients
        )
        self.moments += a.moments
        kernels.add_moments(self.moments, u, a.owned, self.node_owner, d.mass, d.first_moment)
        d.share.ranks.sum(self.sums)
        return self.forces, self.moments
