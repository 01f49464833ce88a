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
        self.activate(state)

    def activate(self, state: State) -> None:
        """Choose the live points and slots for this state (it may move slots), and fit the work arrays. Collective."""
        self.point = np.empty((0, 0))  # free the largest array before the next one is made
        self.active: Active = activate(self.d, state)
        points = self.active.live.size
        self.slot_of, self.node_owner = state.slot_of, state.owner
        self.W = np.zeros(self.d.nodes)
        self.D, self.S2 = np.empty((2, points))
        self.point = np.zeros((points * (1 + self.d.dim), state.u.shape[1]))
        bodies = self.d.dim + rigid.rotations(self.d.dim), 1 + self.d.dim
        self.sums = np.zeros((self.particles, sum(bodies)))
        self.forces, self.moments = self.sums[:, : bodies[0]], self.sums[:, bodies[0] :]
        self.motion = np.zeros((self.particles, bodies[0]))
        self.work = np.empty((1, self.d.shape.longest))
        self.velocity = np.zeros((self.d.dim, state.u.shape[1]))

    def rates(self, u: Floats, rate: Floats) -> None:
        """Write d rho/dt (3) and d eta/dt (4) at the live nodes into rate (n, F). Collective."""
        d, a, m, table = self.d, self.active, self.d.coefficients, self.d.shape
        moving = d.case.model.rigid_motion

        # Fields and gradients at the points (17), mobility (5), contact forces (25)-(27), and the potential (24)
        #   W_a = 1/m_a sum_p w_p [ N_a df/drho + kappa_rho grad N_a . grad rho_p ]
        self._gather(u)
        d.share.halo.add(self.W)
        self.W[a.nodes] /= d.mass[a.nodes]

        # Rigid motion of each particle (8)-(10): V_a(r) = [ m_t F_a + m_r T_a x (r - r_a) ] / V_a
        if moving:
            self.motion = self.relax(rigid.velocities(*self._bodies(u), m))

        # Fluxes (20), (21)
        #   rate rho_a = 1/m_a sum_p w_p [ -D grad N_a . grad W_p + rho_p grad N_a . v_adv ]
        #   rate eta_a = 1/m_a sum_p w_p [ -L N_a df/deta + grad N_a . ( -L kappa_eta grad eta_p + eta_p v_a ) ]
        kernels.clear(rate, a.nodes)
        kernels.divergence(
            rate, self.point, self.D, self.S2, self.W, self.motion, self.velocity,
            a.live, a.owner, a.present, d.weights, d.x,
            table.offsets, table.nodes, table.rows, table.table, self.work, m, moving, d.huang,
        )
        if moving:
            kernels.add_still_drift(rate, a.drift, a.edge_nodes, a.edge_particle, self.slot_of, self.motion)
        d.share.halo.add(rate)
        kernels.divide(rate, d.mass, a.nodes)

    def relax_contacts(self, u: Floats, tau: float) -> None:
        """From now on, contacts relax no faster than 1 / tau; see `rigid.relaxation`. Collective."""
        d, a = self.d, self.active
        if not (d.case.model.rigid_motion and len(a.pairs)):
            return
        self._gather(u)
        stiffness = np.zeros((len(a.pairs), 2, *2 * self.motion.shape[1:]))
        keys = a.pairs[:, 0] * self.particles + a.pairs[:, 1]
        kernels.contact_stiffness(
            stiffness, keys, self.point, a.live, a.owner, a.several, d.weights, d.x,
            self.particles, d.coefficients, d.huang,
        )
        _, moments = self._bodies(u)
        self.relax = rigid.relaxation(d.share.ranks.sum(stiffness), a.pairs, moments, d.coefficients, tau)

    def _gather(self, u: Floats) -> None:
        """Fields, D and contact forces of this rank's points, and its part of W, in the work arrays."""
        d, a, table = self.d, self.active, self.d.shape
        kernels.start(self.W, a.potential, a.nodes)
        self.sums[:] = 0.0
        kernels.potential(
            self.W, self.forces, self.point, self.D, self.S2, u, a.live, a.owner, a.mask, a.present, a.several,
            d.weights, d.x, table.offsets, table.nodes, table.rows, table.table, self.work, d.coefficients,
            d.case.model.rigid_motion,
        )

    def _bodies(self, u: Floats) -> tuple[Floats, Floats]:
        """Forces and moments of all particles, summed over the ranks, after `_gather`."""
        d, a = self.d, self.active
        self.moments += a.moments
        kernels.add_moments(self.moments, u, a.owned, self.node_owner, d.mass, d.first_moment)
        d.share.ranks.sum(self.sums)
        return self.forces, self.moments
