"""Particles that touch: where, by how much, with which forces, and how these answer to motion   (6), (25)-(27)."""

from typing import NamedTuple

import numpy as np

from .arrays import Floats, Integers, Numbers
from .energy import Coefficients
from .jit import inlined, jit

FAR = 0.5  # of c: no cell counts as so large that the level c reaches it where eta_a eta_b is this far from c


class Contacts(NamedTuple):
    """Row r < number[0]: particles between[r] = (a, b), a < b, touch at point where[r]."""

    values: Floats  # (R, 3 (1 + dim)): rho, grad rho, eta_a, grad eta_a, eta_b, grad eta_b
    between: Numbers  # (R, 2)
    where: Integers  # (R,)
    share: Floats  # (R,) w_p times `touching_share`
    number: Integers  # (1,) those for which there is no row are counted, too


def room(rows: int, dim: int) -> Contacts:
    """Room for that many contacts, and none yet."""
    return Contacts(
        np.empty((rows, 3 * (1 + dim))),
        np.empty((rows, 2), dtype=np.int32),
        np.empty(rows, dtype=np.int64),
        np.empty(rows),
        np.zeros(1, dtype=np.int64),
    )


@inlined
def touching_share(product: float, square: float, w: float, dim: int, c: float) -> float:
    """The share of a point's cell in which eta_a eta_b > c, for the product there and the square of its gradient.

    The cell counts as a ball of its volume w, and the product as linear in it: with d the distance of the level c from
    the point in radii, 1/2 + d (3 - d^2) / 4 of the ball are above it. As an interface sweeps over the points the
    contact force then follows it without jumps; as the cells shrink, it becomes the bracket of (6).
    """
    share = 1.0 if product > c else 0.0
    if abs(product - c) < (1.0 - FAR) * c:
        radius = np.sqrt(w / np.pi) if dim == 2 else np.cbrt(0.75 * w / np.pi)
        reach = min(radius * np.sqrt(square), (1.0 - FAR) * c)
        if abs(product - c) < reach:
            d = (product - c) / reach
            share = 0.5 + 0.25 * d * (3.0 - d * d)
    return share


@jit
def add_contact(
    found: Contacts, fields: Floats, row: int, column: int, row_a: int, column_a: int, row_b: int, column_b: int,
    a: int, b: int, p: int, w: float, c: float,
) -> None:
    """Add the particles a and b at point p, if they touch there.

    The point's fields: rho is fields[row, column], the next dim rows hold its gradient, and so on with the others'.
    """
    values = found.values
    width = values.shape[1] // 3
    eta_a, eta_b = fields[row_a, column_a], fields[row_b, column_b]
    square = 0.0
    for k in range(1, width):
        slope = eta_a * fields[row_b + k, column_b] + eta_b * fields[row_a + k, column_a]
        square += slope * slope
    share = touching_share(eta_a * eta_b, square, w, width - 1, c)
    if share > 0.0:
        r = found.number[0]
        found.number[0] += 1
        if r < found.share.size:
            if a > b:
                a, b, row_a, row_b, column_a, column_b = b, a, row_b, row_a, column_b, column_a
            found.between[r, 0] = a
            found.between[r, 1] = b
            found.where[r] = p
            found.share[r] = w * share
            for k in range(width):
                values[r, k] = fields[row + k, column]
                values[r, width + k] = fields[row_a + k, column_a]
                values[r, 2 * width + k] = fields[row_b + k, column_b]


@jit
def contact_forces(force: Floats, found: Contacts, x: Floats, m: Coefficients) -> None:
    """Add b_a w_p and (x_p cross b_a) w_p of every contact to the forces and torques   (25)-(27)

    b_a = k sum_{b != a} (rho - rho_0) [eta_a eta_b > c] (grad eta_a - grad eta_b), the bracket as `touching_share`.
    force (particles, dim + rotations); x is measured from the origin that `rigid.velocities` moves to the particle's
    centre.
    """
    dim = x.shape[1]
    values, between = found.values, found.between
    push = np.zeros(6)
    for r in range(found.number[0]):
        pull = found.share[r] * m.k * (values[r, 0] - m.rho_0)
        for k in range(dim):
            push[k] = pull * (values[r, 2 + dim + k] - values[r, 3 + 2 * dim + k])
        turn(push, x, found.where[r])
        for k in range(force.shape[1]):
            force[between[r, 0], k] += push[k]
            force[between[r, 1], k] -= push[k]


@jit
def contact_stiffness(
    stiffness: Floats, keys: Integers, found: Contacts, x: Floats, particles: int, m: Coefficients, huang: bool
) -> None:
    """How the contact forces answer to rigid motion: stiffness[pair] += w_p k e_p (d_a, d_b) over the contacts.

    Moving particle c with (v, omega) changes rho at x by -(v, omega) . d_c, d_c = (grad q, x cross grad q) with
    q = rho eta_c^2 [`wang`: rho eta_c]; the force on a is k (rho - rho_0) e, e = (g, x cross g) with
    g = grad eta_a - grad eta_b.
    stiffness (pairs, 2, dim + rotations, dim + rotations); keys (pairs,) sorted a particles + b with a < b.
    """
    dim = x.shape[1]
    size = stiffness.shape[2]
    values, between = found.values, found.between
    direction = np.zeros(6)
    answer_a = np.zeros(6)
    answer_b = np.zeros(6)
    pair = np.int64(0)
    for r in range(found.number[0]):
        for k in range(dim):
            direction[k] = values[r, 2 + dim + k] - values[r, 3 + 2 * dim + k]
            answer_a[k] = carried_slope(values, r, 1 + dim, k, huang)
            answer_b[k] = carried_slope(values, r, 2 + 2 * dim, k, huang)
        turn(direction, x, found.where[r])
        turn(answer_a, x, found.where[r])
        turn(answer_b, x, found.where[r])
        key = np.int64(between[r, 0]) * particles + between[r, 1]
        if keys[pair] != key:
            pair = np.searchsorted(keys, key)
        for i in range(size):
            scaled = found.share[r] * m.k * direction[i]
            for j in range(size):
                stiffness[pair, 0, i, j] += scaled * answer_a[j]
                stiffness[pair, 1, i, j] += scaled * answer_b[j]


@jit
def carried_slope(values: Floats, r: int, column: int, k: int, huang: bool) -> float:
    """Component k of grad(rho eta^2) [`wang`: grad(rho eta)] for the particle whose eta is in that column."""
    rho = values[r, 0]
    eta = values[r, column]
    if huang:
        return float(eta * eta * values[r, 1 + k] + 2.0 * rho * eta * values[r, column + 1 + k])
    return float(eta * values[r, 1 + k] + rho * values[r, column + 1 + k])


@jit
def turn(vector: Floats, x: Floats, p: int) -> None:
    """Append x_p cross v to v: one number in the plane, three in space."""
    if x.shape[1] == 2:
        vector[2] = x[p, 0] * vector[1] - x[p, 1] * vector[0]
        return
    vector[3] = x[p, 1] * vector[2] - x[p, 2] * vector[1]
    vector[4] = x[p, 2] * vector[0] - x[p, 0] * vector[2]
    vector[5] = x[p, 0] * vector[1] - x[p, 1] * vector[0]
