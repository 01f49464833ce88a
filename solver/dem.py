"""Discrete elements: the loops. Spheres, or discs in the plane z = 0, with linear contacts between flat smooth walls.

Units of these loops: the mean radius is 1, the contact stiffness is 1, and so is the mass of a particle of mean radius.
Arrays have three components in the plane too. Gravity and the press act along the last axis, `dim - 1`.

    normal force     f = d - c v_n - a                 overlap d >= 0; c = 2 zeta sqrt(m_ij); cohesion a
                     f = -a (1 - gap / reach)          apart by less than `reach`
    tangential       |t| <= mu f, t = -(2/7) s - c v_t  with s the slip since the contact was made

A heap is chaotic: the last bit decides where a particle ends. So everything here is `exact`, and what the system's
library gives elsewhere (powers, logarithms) is rounded first, see `radii.steady`.
"""

import math
from typing import NamedTuple

import numpy as np

from .arrays import Floats, Integers
from .jit import exact, exact_inlined

TANGENTIAL = 2.0 / 7.0  # stiffness over that of the normal: equal frequencies of both for a solid sphere
SKIN = 0.3  # pairs nearer than this are listed; the list lasts while nobody has moved by a quarter of it, see `moved`


class Physics(NamedTuple):
    """What acts on the particles; `steps` of `dt` with these are one call of `march`."""

    dim: int
    gravity: float  # weight of a particle of mean radius
    friction: float  # mu
    cohesion: float  # a
    reach: float  # at most half of SKIN
    damping: float  # zeta, a fraction of the critical damping of a contact
    drag: float  # of the medium: dv/dt = -drag v
    squeeze: float  # the box and the particles in it lose this fraction of their height per step
    lid: bool  # whether there is an upper wall
    dt: float


class Contacts(NamedTuple):
    """Pairs that may touch: particle i with partner[start[i]:start[i + 1]]; slip (pairs, 3); x at the last search."""

    start: Integers
    partner: Integers
    slip: Floats
    x: Floats
    squeezed: Floats  # (1,) by which part since then


class Strain(NamedTuple):
    """The state after a march."""

    overlap: float  # the largest, walls included
    force: float  # mean normal force of pairs that overlap
    speed: float  # of the fastest particle
    work: int  # listed pairs, summed over the steps


def no_contacts() -> Contacts:
    """Before the first search."""
    return Contacts(np.zeros(1, np.int64), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)), np.zeros(1))


@exact
def deposit(x: Floats, r: Floats, place: Floats, low: Floats, high: Floats, dim: int, level: float) -> None:
    """Ballistic deposition: each particle falls straight down and stays where it first touches.

    place (n, tries, dim - 1) in [0, 1) picks places between the side walls. A particle that would stay above the level
    tries the next place; if all are above, it takes the lowest. So the pile has an even top.
    """
    n, tries, up, size = len(r), place.shape[1], dim - 1, 2.0 * r.max()
    nx = max(1, int((high[0] - low[0]) / size))
    ny = max(1, int((high[1] - low[1]) / size)) if dim == 3 else 1
    head, below = np.full((nx, ny), -1, np.int64), np.full(n, -1, np.int64)
    wx, wy = (high[0] - low[0]) / nx, (high[1] - low[1]) / ny
    spot = np.zeros(3)
    for i in range(n):
        x[i] = 0.0
        x[i, up] = np.inf
        for t in range(tries):
            for k in range(up):
                spot[k] = low[k] + r[i] + place[i, t, k] * (high[k] - low[k] - 2.0 * r[i])
            spot[up] = low[up] + r[i]
            cx = min(nx - 1, int((spot[0] - low[0]) / wx))
            cy = min(ny - 1, int((spot[1] - low[1]) / wy)) if dim == 3 else 0
            for a in range(max(0, cx - 1), min(nx, cx + 2)):
                for b in range(max(0, cy - 1), min(ny, cy + 2)):
                    j = head[a, b]
                    while j >= 0:
                        free = (r[i] + r[j]) ** 2
                        for k in range(up):
                            free -= (spot[k] - x[j, k]) ** 2
                        if free > 0.0:
                            spot[up] = max(spot[up], x[j, up] + math.sqrt(free))
                        j = below[j]
            if spot[up] < x[i, up]:
                x[i] = spot
            if x[i, up] + r[i] <= level:
                break
        cx = min(nx - 1, int((x[i, 0] - low[0]) / wx))
        cy = min(ny - 1, int((x[i, 1] - low[1]) / wy)) if dim == 3 else 0
        below[i] = head[cx, cy]
        head[cx, cy] = i


@exact
def search(x: Floats, r: Floats, old: Contacts) -> Contacts:
    """List the pairs nearer than SKIN by a grid of cells, at a cost linear in n; pairs in touch keep their slip."""
    n, size = len(r), 2.0 * r.max() + SKIN
    low, shape = np.empty(3), np.empty(3, np.int64)
    for k in range(3):
        low[k] = x[:, k].min()
        shape[k] = 1 + int((x[:, k].max() - low[k]) / size)
    cell, first = np.empty((n, 3), np.int64), np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    flat, members = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        for k in range(3):
            cell[i, k] = int((x[i, k] - low[k]) / size)
        flat[i] = (cell[i, 0] * shape[1] + cell[i, 1]) * shape[2] + cell[i, 2]
        first[flat[i]] += 1
    for c in range(len(first) - 1, 0, -1):
        first[c] = first[c - 1]
    first[0] = 0
    for c in range(1, len(first)):
        first[c] += first[c - 1]
    place = first.copy()
    for i in range(n):
        members[place[flat[i]]] = i
        place[flat[i]] += 1
    start, partner, found = np.zeros(n + 1, np.int64), np.empty(12 * n, np.int64), 0
    for i in range(n):
        for a in range(max(0, cell[i, 0] - 1), min(shape[0], cell[i, 0] + 2)):
            for b in range(max(0, cell[i, 1] - 1), min(shape[1], cell[i, 1] + 2)):
                row = (a * shape[1] + b) * shape[2]
                begin, end = row + max(0, cell[i, 2] - 1), row + min(shape[2], cell[i, 2] + 2)
                for m in range(first[begin], first[end]):
                    j = members[m]
                    near = r[i] + r[j] + SKIN
                    apart = (x[i, 0] - x[j, 0]) ** 2 + (x[i, 1] - x[j, 1]) ** 2 + (x[i, 2] - x[j, 2]) ** 2
                    if j > i and apart < near * near:
                        if found == len(partner):
                            longer = np.empty(2 * found, np.int64)
                            longer[:found] = partner
                            partner = longer
                        partner[found] = j
                        found += 1
        start[i + 1] = found
    slip = np.zeros((found, 3))
    for i in range(len(old.start) - 1):
        for p in range(old.start[i], old.start[i + 1]):
            if old.slip[p, 0] != 0.0 or old.slip[p, 1] != 0.0 or old.slip[p, 2] != 0.0:
                for q in range(start[i], start[i + 1]):
                    if partner[q] == old.partner[p]:
                        slip[q] = old.slip[p]
    return Contacts(start, partner[:found].copy(), slip, x.copy(), np.zeros(1))


@exact
def moved(x: Floats, r: Floats, contacts: Contacts) -> bool:
    """Whether a pair that is not listed may have come within reach: by motions, and by what squeezing has added."""
    if len(contacts.x) != len(x):
        return True
    allowed = 0.25 * SKIN - 0.5 * contacts.squeezed[0] * (2.0 * r.max() + SKIN)
    if allowed <= 0.0:
        return True
    for i in range(len(x)):
        d = 0.0
        for k in range(3):
            d += (x[i, k] - contacts.x[i, k]) ** 2
        if d > allowed**2:
            return True
    return False


@exact
def squeeze(x: Floats, low: Floats, high: Floats, up: int, part: float, contacts: Contacts) -> None:
    """The box and all in it lose this part of their height. The places of the last search follow, so that only what
    moves against its surroundings asks for the next one."""
    high[up] = low[up] + (high[up] - low[up]) * (1.0 - part)
    for places in (x, contacts.x):
        for i in range(len(places)):
            places[i, up] = low[up] + (places[i, up] - low[up]) * (1.0 - part)
    contacts.squeezed[0] += part


@exact
def march(
    x: Floats, v: Floats, spin: Floats, r: Floats, low: Floats, high: Floats, physics: Physics,
    contacts: Contacts, steps: int,
) -> tuple[Contacts, Strain]:  # fmt: skip
    """`steps` steps of semi-implicit Euler in place: v += dt f / m, x += dt v; `high` follows the squeeze."""
    n, dim, dt, up = len(r), physics.dim, physics.dt, physics.dim - 1
    mass = np.empty(n)
    for i in range(n):
        mass[i] = max(r[i] ** dim, 0.3)  # light ones are as heavy as this: they would ask for shorter steps
    inertia = 0.4 if dim == 3 else 0.5
    slowed = 1.0 / (1.0 + dt * physics.drag)
    force, torque = np.zeros((n, 3)), np.zeros((n, 3))
    overlap, pushed, pairs, work = 0.0, 0.0, 0, 0
    for _ in range(steps):
        if physics.squeeze != 0.0:
            squeeze(x, low, high, up, physics.squeeze, contacts)
        if moved(x, r, contacts):
            contacts = search(x, r, contacts)
        work += len(contacts.partner)
        force[:] = 0.0
        if physics.friction > 0.0:
            torque[:] = 0.0
        overlap, pushed, pairs = pair_forces(force, torque, x, v, spin, r, mass, contacts, physics)
        overlap = max(overlap, wall_forces(force, x, v, r, mass, low, high, physics))
        for i in range(n):
            force[i, up] -= physics.gravity * mass[i]
            push = dt / mass[i]
            for k in range(3):
                v[i, k] = (v[i, k] + push * force[i, k]) * slowed
                x[i, k] += dt * v[i, k]
        if physics.friction > 0.0:
            for i in range(n):
                push = dt / (inertia * mass[i] * r[i] ** 2)
                for k in range(3):
                    spin[i, k] = (spin[i, k] + push * torque[i, k]) * slowed
    speed = 0.0
    for i in range(n):
        speed = max(speed, math.sqrt(v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2))
    return contacts, Strain(overlap, pushed / max(pairs, 1), speed, work)


@exact
def pair_forces(
    force: Floats, torque: Floats, x: Floats, v: Floats, spin: Floats, r: Floats, mass: Floats,
    contacts: Contacts, physics: Physics,
) -> tuple[float, float, int]:  # fmt: skip
    """Add what particles do to each other; the largest overlap, the sum of the normal forces, their number."""
    largest, pushed, pairs = 0.0, 0.0, 0
    reach, friction, cohesion = physics.reach, physics.friction, physics.cohesion
    fade, start, partner = cohesion / max(reach, 1e-12), contacts.start, contacts.partner
    for i in range(len(r)):
        x0, x1, x2, radius = x[i, 0], x[i, 1], x[i, 2], r[i]
        f0, f1, f2 = 0.0, 0.0, 0.0
        for p in range(start[i], start[i + 1]):
            j = partner[p]
            n0, n1, n2 = x0 - x[j, 0], x1 - x[j, 1], x2 - x[j, 2]
            apart, touching = n0 * n0 + n1 * n1 + n2 * n2, radius + r[j]
            if apart >= (touching + reach) ** 2:
                if friction > 0.0:
                    contacts.slip[p] = 0.0
                continue
            apart = max(math.sqrt(apart), 1e-12)
            gap = apart - touching
            n0, n1, n2 = n0 / apart, n1 / apart, n2 / apart
            if gap >= 0.0:
                f = fade * gap - cohesion
                if friction > 0.0:
                    contacts.slip[p] = 0.0
            else:
                damping = 2.0 * physics.damping * math.sqrt(mass[i] * mass[j] / (mass[i] + mass[j]))
                closing = -((v[i, 0] - v[j, 0]) * n0 + (v[i, 1] - v[j, 1]) * n1 + (v[i, 2] - v[j, 2]) * n2)
                f = max(-gap + damping * closing, 0.0) - cohesion
                largest, pushed, pairs = max(largest, -gap), pushed - gap, pairs + 1
                if friction > 0.0:
                    slip = contacts.slip[p]
                    rub(force, torque, i, j, v, spin, r, (n0, n1, n2), closing, damping, -gap, slip, physics)
            f0, f1, f2 = f0 + f * n0, f1 + f * n1, f2 + f * n2
            force[j, 0] -= f * n0
            force[j, 1] -= f * n1
            force[j, 2] -= f * n2
        force[i, 0] += f0
        force[i, 1] += f1
        force[i, 2] += f2
    return largest, pushed, pairs


@exact_inlined
def rub(
    force: Floats, torque: Floats, i: int, j: int, v: Floats, spin: Floats, r: Floats,
    normal: tuple[float, float, float], closing: float, damping: float, overlap: float, slip: Floats, physics: Physics,
) -> None:  # fmt: skip
    """Add the tangential force of the contact of i and j, and let its slip (3,) follow.

    Slip velocity at the contact: v_i - v_j + closing n - (R_i w_i + R_j w_j) x n, for n pointing from j to i.
    """
    n0, n1, n2 = normal
    w0, w1, w2 = (
        r[i] * spin[i, 0] + r[j] * spin[j, 0], r[i] * spin[i, 1] + r[j] * spin[j, 1],
        r[i] * spin[i, 2] + r[j] * spin[j, 2],
    )  # fmt: skip
    u0 = v[i, 0] - v[j, 0] + closing * n0 - (w1 * n2 - w2 * n1)
    u1 = v[i, 1] - v[j, 1] + closing * n1 - (w2 * n0 - w0 * n2)
    u2 = v[i, 2] - v[j, 2] + closing * n2 - (w0 * n1 - w1 * n0)
    # The slip stays in the plane of the contact.
    along = slip[0] * n0 + slip[1] * n1 + slip[2] * n2
    s0, s1, s2 = (
        slip[0] + physics.dt * u0 - along * n0, slip[1] + physics.dt * u1 - along * n1,
        slip[2] + physics.dt * u2 - along * n2,
    )  # fmt: skip
    t0, t1, t2 = -TANGENTIAL * s0 - damping * u0, -TANGENTIAL * s1 - damping * u1, -TANGENTIAL * s2 - damping * u2
    size, limit = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2), physics.friction * overlap
    if size > limit:
        scale = limit / size
        t0, t1, t2 = scale * t0, scale * t1, scale * t2
        s0, s1, s2 = -t0 / TANGENTIAL, -t1 / TANGENTIAL, -t2 / TANGENTIAL
    slip[0], slip[1], slip[2] = s0, s1, s2
    force[i, 0] += t0
    force[i, 1] += t1
    force[i, 2] += t2
    force[j, 0] -= t0
    force[j, 1] -= t1
    force[j, 2] -= t2
    m0, m1, m2 = n1 * t2 - n2 * t1, n2 * t0 - n0 * t2, n0 * t1 - n1 * t0
    torque[i, 0] -= r[i] * m0
    torque[i, 1] -= r[i] * m1
    torque[i, 2] -= r[i] * m2
    torque[j, 0] -= r[j] * m0
    torque[j, 1] -= r[j] * m1
    torque[j, 2] -= r[j] * m2


@exact
def wall_forces(
    force: Floats, x: Floats, v: Floats, r: Floats, mass: Floats, low: Floats, high: Floats, physics: Physics
) -> float:
    """Add what the walls do; the largest overlap. Walls are smooth, and as cohesive as particles."""
    largest = 0.0
    for i in range(len(r)):
        damping = 2.0 * physics.damping * math.sqrt(mass[i])
        for k in range(physics.dim):
            for side in range(1 if k == physics.dim - 1 and not physics.lid else 2):
                inward = 1.0 - 2.0 * side
                gap = (x[i, k] - low[k] if side == 0 else high[k] - x[i, k]) - r[i]
                if gap < 0.0:
                    f = max(-gap - damping * inward * v[i, k], 0.0) - physics.cohesion
                    largest = max(largest, -gap)
                elif gap < physics.reach:
                    f = -physics.cohesion * (1.0 - gap / max(physics.reach, 1e-12))
                else:
                    continue
                force[i, k] += inward * f
    return largest


@exact
def exchange(
    x: Floats, r: Floats, low: Floats, high: Floats, dim: int, seed: int, trials: int, heat: float
) -> None:
    """Swap the radii of random pairs by Metropolis' rule: the swap move of Monte Carlo on glasses, at a temperature.

    The energy is that of the overlaps, sum d^2 / 2. Small particles find the small holes; equal ones gain nothing.
    """
    np.random.seed(seed)
    n, size = len(r), 2.0 * r.max()
    origin, shape = np.empty(3), np.empty(3, np.int64)
    for k in range(3):
        origin[k] = x[:, k].min()
        shape[k] = 1 + int((x[:, k].max() - origin[k]) / size)
    head = np.full((shape[0], shape[1], shape[2]), -1, np.int64)
    below, cell = np.empty(n, np.int64), np.empty((n, 3), np.int64)
    for i in range(n):
        for k in range(3):
            cell[i, k] = int((x[i, k] - origin[k]) / size)
        below[i] = head[cell[i, 0], cell[i, 1], cell[i, 2]]
        head[cell[i, 0], cell[i, 1], cell[i, 2]] = i
    for _ in range(trials):
        i, j = np.random.randint(n), np.random.randint(n)
        if r[i] == r[j]:
            continue
        gain = 0.0
        for sign in (1.0, -1.0):
            gain += sign * overlap_energy(x, r, i, low, high, dim, head, below, cell)
            gain += sign * overlap_energy(x, r, j, low, high, dim, head, below, cell)
            r[i], r[j] = r[j], r[i]
        # The radii are back where they were.
        if gain >= 0.0 or (heat > 0.0 and np.random.random() < math.exp(gain / heat)):
            r[i], r[j] = r[j], r[i]


@exact
def overlap_energy(
    x: Floats, r: Floats, i: int, low: Floats, high: Floats, dim: int, head: Integers, below: Integers, cell: Integers
) -> float:
    """Sum of d^2 / 2 over what particle i overlaps."""
    energy = 0.0
    for k in range(dim):
        energy += max(r[i] - x[i, k] + low[k], 0.0) ** 2 + max(r[i] + x[i, k] - high[k], 0.0) ** 2
    for a in range(max(0, cell[i, 0] - 1), min(head.shape[0], cell[i, 0] + 2)):
        for b in range(max(0, cell[i, 1] - 1), min(head.shape[1], cell[i, 1] + 2)):
            for c in range(max(0, cell[i, 2] - 1), min(head.shape[2], cell[i, 2] + 2)):
                j = head[a, b, c]
                while j >= 0:
                    near = r[i] + r[j]
                    apart = (x[i, 0] - x[j, 0]) ** 2 + (x[i, 1] - x[j, 1]) ** 2 + (x[i, 2] - x[j, 2]) ** 2
                    if j != i and apart < near * near:
                        energy += (near - math.sqrt(apart)) ** 2
                    j = below[j]
    return 0.5 * energy
