"""The coefficients of the fields that a run starts from.

Maximum-entropy functions smooth: coefficients set to (34) give fields whose interfaces are wider, and necks that are
wider still. So the coefficients are chosen for the fields: the best fit at the material points, approached by

    u_a <- u_a + 1/m_a sum_p w_p N_a(x_p) [ f(x_p) - u(x_p) ]

Each step leaves sum_a m_a u_a = sum_p w_p f(x_p), the mass of (34). A few steps fit an interface; what many more would
add are oscillations.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from . import sampling
from .arrays import Floats
from .discretisation import Discretisation
from .state import State, initial_state

STEPS = 2
BLOCK = 1 << 17  # points at a time: keeps scratch arrays small


def project(d: Discretisation, state: State) -> None:
    """Replace coefficients that are values of (34) by those whose fields are. Collective.

    An order parameter stays 0 where it has no owner.
    """
    used, centre = 1 + state.owner.shape[1], 0.5 * np.asarray(d.case.domain.size)
    kept = np.column_stack([np.ones(d.nodes, dtype=bool), state.owner >= 0])
    wanted = gathered(d, used, lambda part: initial_state(d.case, d.x[part] + centre).u[:, :used])
    for _ in range(STEPS):
        u = np.ascontiguousarray(state.u[:, :used])
        missing = wanted - gathered(d, used, partial(d.sample, u))
        d.share.halo.add(missing)
        state.u[:, :used] += np.where(kept, missing / d.mass[:, None], 0.0)


def gathered(d: Discretisation, columns: int, values: Callable[[slice], Floats]) -> Floats:
    """sum_p w_p N_a(x_p) f(x_p) over this rank's points (n, columns); values(part): f at some of them."""
    sums = np.zeros((d.nodes, columns))
    for start in range(0, d.shape.points, BLOCK):
        part = slice(start, min(start + BLOCK, d.shape.points))
        table = d.shape.part(part)
        weights = d.weights[part]
        sampling.spread(
            sums, np.ascontiguousarray(values(part)), weights, table.offsets, table.nodes, table.rows, table.table
        )
    return sums
