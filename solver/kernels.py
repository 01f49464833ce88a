"""The loops over material points: gather nodal fields, evaluate the physics, scatter to the nodes.

Layout. `u` (n, F) holds a node's fields side by side: column 0 is rho, column 1 + s is slot s of eta, F is a multiple
of LANES. Point p sees nodes[offsets[p] + i] for i < offsets[p + 1] - offsets[p], with the shape functions
table[:, rows[p] + i] = (N, dN/dx, dN/dy[, dN/dz]); on a lattice most points share one row of the table. Rows start at
multiples of LANES and are filled up with zeros. `loose` lists the live points that are in no block (those are for
`block_kernels`), l counts along it, and owner[l, s] is the particle that slot s means at that point, or -1: such a slot
does not exist there, mask[l] is 0 in its column, and present[l, b] tells whether pack b of columns holds anything at
all. Point fields are kept in `point` (L (1 + dim), F): row l (1 + dim) holds the values at point loose[l], the next dim
rows their derivatives.
"""

import numpy as np

from .arrays import Bytes, Flags, Floats, Integers, Numbers
from .contacts import FAR, Contacts, add_contact
from .energy import Coefficients, Field, df_deta, df_drho, free_energy_density, mobility
from .jit import inlined, jit
from .simd import (
    LANES,
    first,
    flush_denormals,
    load,
    positive,
    restore_denormals,
    splat,
    store,
    total,
    with_first,
)


@inlined
def gather(
    point: Floats, u: Floats, row: int,
    begin: int, count: int, start: int, nodes: Numbers, table: Floats, column: int,
) -> None:
    """u_p = sum_a N_a(x_p) u_a and grad u_p = sum_a grad N_a(x_p) u_a for one point and one pack of fields   (17)"""
    dim = table.shape[0] - 1
    value = splat(0.0)
    x = splat(0.0)
    y = splat(0.0)
    z = splat(0.0)
    for i in range(count):
        e = start + i
        field = load(u, nodes[begin + i], column)
        value = value + table[0, e] * field
        x = x + table[1, e] * field
        y = y + table[2, e] * field
        if dim == 3:
            z = z + table[3, e] * field
    store(point, row, column, value)
    store(point, row + 1, column, x)
    store(point, row + 2, column, y)
    if dim == 3:
        store(point, row + 3, column, z)


@inlined
def scatter(
    rate: Floats, point: Floats, row: int,
    begin: int, count: int, start: int, nodes: Numbers, table: Floats, column: int,
) -> None:
    """rate_a += N_a(x_p) s_p + grad N_a(x_p) . j_p for one point's sources s and fluxes j (the rows of `point`)."""
    dim = table.shape[0] - 1
    source = load(point, row, column)
    x = load(point, row + 1, column)
    y = load(point, row + 2, column)
    z = load(point, row + dim, column)
    for i in range(count):
        e = start + i
        a = nodes[begin + i]
        new = load(rate, a, column) + table[0, e] * source + table[1, e] * x + table[2, e] * y
        if dim == 3:
            new = new + table[3, e] * z
        store(rate, a, column, new)


@inlined
def add_potential(
    W: Floats, w: float, row: int, point: Floats, rho: float, S2: float, S3: float,
    begin: int, count: int, start: int, nodes: Numbers, table: Floats, work: Floats, m: Coefficients,
) -> None:
    """W_a += w_p [ N_a df/drho + kappa_rho grad N_a . grad rho_p ]: one point's share of (24), before the 1/m_a.

    work (1, longest row of the table) holds the shares while they are computed in packs along the row.
    """
    dim = table.shape[0] - 1
    source = w * df_drho(rho, S2, S3, m)
    x = w * m.kappa_rho * point[row + 1, 0]
    y = w * m.kappa_rho * point[row + 2, 0]
    z = w * m.kappa_rho * point[row + dim, 0]
    for i in range(0, count, LANES):
        e = start + i
        share = source * load(table, 0, e) + x * load(table, 1, e) + y * load(table, 2, e)
        if dim == 3:
            share = share + z * load(table, 3, e)
        store(work, 0, i, share)
    for i in range(count):
        W[nodes[begin + i]] += work[0, i]


@inlined
def gradient(
    result: Floats, W: Floats, begin: int, count: int, start: int, nodes: Numbers, table: Floats, work: Floats
) -> None:
    """result = sum_a grad N_a(x_p) W_a at one point   (23)"""
    for i in range(count):
        work[0, i] = W[nodes[begin + i]]
    x = splat(0.0)
    y = splat(0.0)
    z = splat(0.0)
    for i in range(0, count, LANES):
        value = load(work, 0, i)
        x = x + value * load(table, 1, start + i)
        y = y + value * load(table, 2, start + i)
        if table.shape[0] == 4:
            z = z + value * load(table, 3, start + i)
    result[0] = total(x)
    result[1] = total(y)
    result[2] = total(z)


@jit
def potential(
    W: Floats, touching: Integers, point: Floats, D: Floats, squares: Floats, u: Floats,
    loose: Integers, mask: Floats, present: Flags, several: Flags, weights: Floats,
    offsets: Integers, nodes: Numbers, rows: Integers, table: Floats, work: Floats, m: Coefficients,
    low: int, high: int,
) -> int:
    """First half of an evaluation: fields and D at the points loose[low] ... loose[high - 1], and their shares of W.

    W (n,) gets partial sums; point, D and squares = S2 are filled, and touching with the l of the points where two
    particles may touch: where sum_{a < b} eta_a eta_b > c / 2. Their number is returned.
    """
    mode = flush_denormals()
    width = table.shape[0]
    touches = 0
    for l in range(low, high):
        p = loose[l]
        row = l * width
        begin = offsets[p]
        count = offsets[p + 1] - begin
        start = rows[p]
        S1 = 0.0
        S2 = 0.0
        S3 = 0.0
        P2 = 0.0
        rho = 0.0
        for b in range(present.shape[1]):
            if not present[l, b]:
                continue
            column = b * LANES
            gather(point, u, row, begin, count, start, nodes, table, column)
            exists = load(mask, l, column)
            eta = exists * load(point, row, column)
            store(point, row, column, eta)
            for k in range(1, width):
                store(point, row + k, column, exists * load(point, row + k, column))
            if b == 0:
                rho = first(eta)
                eta = with_first(eta, 0.0)
            square = eta * eta
            if several[l]:
                inside = positive(eta)
                S1 += total(inside)
                P2 += total(inside * inside)
            S2 += total(square)
            S3 += total(square * eta)
        overlap = S1 * S1 - P2
        squares[l] = S2
        D[l] = mobility(rho, overlap, m)
        add_potential(W, weights[p], row, point, rho, S2, S3, begin, count, start, nodes, table, work, m)
        if overlap > m.c:
            touching[touches] = l
            touches += 1
    restore_denormals(mode)
    return touches


@jit
def meet(
    found: Contacts, point: Floats, loose: Integers, owner: Numbers, weights: Floats, touching: Integers, c: float
) -> None:
    """Add the particles that touch at the points loose[l], l in touching, to the contacts."""
    width = found.values.shape[1] // 3
    for l in touching:
        row = l * width
        for s in range(owner.shape[1]):
            for t in range(s + 1, owner.shape[1]):
                a, b = owner[l, s], owner[l, t]
                product = point[row, 1 + s] * point[row, 1 + t]
                if min(a, b) >= 0 and product > FAR * c and point[row, 1 + s] > 0.0:
                    add_contact(found, point, row, 0, row, 1 + s, row, 1 + t, a, b, loose[l], weights[loose[l]], c)


@inlined
def x_velocity(motion: Floats, a: int, y: Field, z: Field) -> Field:
    """V_x of V_a(r) = v_a + omega_a cross r; motion[a] = (v_a, omega_a), three components each: `rigid.in_space`."""
    v: Field = motion[a, 0] + motion[a, 4] * z - motion[a, 5] * y
    return v


@inlined
def y_velocity(motion: Floats, a: int, x: Field, z: Field) -> Field:
    """V_y, see `x_velocity`."""
    v: Field = motion[a, 1] + motion[a, 5] * x - motion[a, 3] * z
    return v


@inlined
def z_velocity(motion: Floats, a: int, x: Field, y: Field) -> Field:
    """V_z, see `x_velocity`."""
    v: Field = motion[a, 2] + motion[a, 3] * y - motion[a, 4] * x
    return v


@inlined
def fill_velocities(velocity: Floats, motion: Floats, owner: Numbers, l: int, x: Floats) -> None:
    """velocity[k, 1 + s] = component k of V_a(x), a = owner[l, s]; 0 where a slot does not exist."""
    for s in range(owner.shape[1]):
        a = owner[l, s]
        for k in range(velocity.shape[0]):
            velocity[k, 1 + s] = 0.0
        if a >= 0:
            velocity[0, 1 + s] = x_velocity(motion, a, x[1], x[-1])
            velocity[1, 1 + s] = y_velocity(motion, a, x[0], x[-1])
            if x.size == 3:
                velocity[2, 1 + s] = z_velocity(motion, a, x[0], x[1])


@jit
def divergence(
    rate: Floats, point: Floats, D: Floats, squares: Floats, W: Floats, motion: Floats, velocity: Floats,
    loose: Integers, owner: Numbers, present: Flags, weights: Floats, x: Floats,
    offsets: Integers, nodes: Numbers, rows: Integers, table: Floats, work: Floats,
    m: Coefficients, rigid: bool, huang: bool, low: int, high: int,
) -> None:
    """Second half of an evaluation: fluxes at loose[low] ... loose[high - 1], scattered to the nodes   (20), (21)

    rate (n, F) gets partial sums, before the 1/m_a. The rows of `point` are turned from fields into sources and fluxes:
    rho:   source 0,               flux -D grad W + rho v_adv
    eta_a: source -L df/deta_a,    flux -L kappa_eta grad eta_a + eta_a v_a,    v_a = V_a(x) eta_a
    velocity (dim, F) is work space with zeros in column 0.
    """
    mode = flush_denormals()
    dim = x.shape[1]
    advection = np.zeros(3)
    slope = np.zeros(3)
    for l in range(low, high):
        p = loose[l]
        row = l * (1 + dim)
        begin = offsets[p]
        count = offsets[p + 1] - begin
        start = rows[p]
        w = weights[p]
        gradient(slope, W, begin, count, start, nodes, table, work)
        rho = point[row, 0]
        if rigid:
            advection[:] = 0.0
            fill_velocities(velocity, motion, owner, l, x[p])
        for b in range(present.shape[1] - 1, -1, -1):
            if not present[l, b]:
                continue
            column = b * LANES
            eta = load(point, row, column)
            if b == 0:
                eta = with_first(eta, 0.0)
            store(point, row, column, (-w * m.L) * df_deta(eta, rho, squares[l], m))
            for k in range(dim):
                flux = (-m.L * m.kappa_eta) * load(point, row + 1 + k, column)
                if rigid:
                    v = load(velocity, k, column) * eta
                    flux = flux + eta * v
                    advection[k] += total(eta * v) if huang else total(v)
                if b == 0:
                    flux = with_first(flux, rho * advection[k] - D[l] * slope[k])
                store(point, row + 1 + k, column, w * flux)
            scatter(rate, point, row, begin, count, start, nodes, table, column)
    restore_denormals(mode)


@jit
def free_energy(
    u: Floats, weights: Floats, dim: int, loose: Integers,
    offsets: Integers, nodes: Numbers, rows: Integers, table: Floats, m: Coefficients,
) -> float:
    """F = sum_p w_p [ f + kappa_rho/2 |grad rho|^2 + kappa_eta/2 sum |grad eta|^2 ] over the loose points   (1)"""
    point = np.empty((1 + dim, u.shape[1]))
    total = 0.0
    for p in loose:
        for column in range(0, u.shape[1], LANES):
            gather(point, u, 0, offsets[p], offsets[p + 1] - offsets[p], rows[p], nodes, table, column)
        S2 = 0.0
        S3 = 0.0
        squares = 0.0
        for c in range(1, u.shape[1]):
            S2 += point[0, c] ** 2
            S3 += point[0, c] ** 3
            for k in range(dim):
                squares += point[1 + k, c] ** 2
        gradient = 0.0
        for k in range(dim):
            gradient += point[1 + k, 0] ** 2
        density = free_energy_density(point[0, 0], S2, S3, m)
        total += weights[p] * (density + 0.5 * m.kappa_rho * gradient + 0.5 * m.kappa_eta * squares)
    return total


@jit
def sense(
    flags: Numbers, owner: Numbers, clash: Integers, u: Floats, node_owner: Numbers,
    eps_rho: float, eps_eta: float, least: float, dim: int, loose: Integers, changed: Flags,
    offsets: Integers, nodes: Numbers, rows: Integers, table: Floats,
    kind: Integers, starts: Integers, places: Numbers,
) -> None:
    """Mark the loose points where something happens and name the particles that their slots mean (section 2.4).

    flags[p] = 1 where |grad rho| >= eps_rho or any |grad eta| >= eps_eta, else 0. owner[p, s] is the particle found in
    slot s of the point's nearest nodes, if its eta or |grad eta| is at least `least` here, else -1; where there are
    two, clash[p] = (one, other), else -1. Points that see no changed node are left as they are.
    """
    point = np.empty((1 + dim, u.shape[1]))
    for p in loose:
        ask = False
        for e in range(offsets[p], offsets[p + 1]):
            if changed[nodes[e]]:
                ask = True
                break
        if not ask:
            continue
        clash[p, 0] = -1
        for column in range(0, u.shape[1], LANES):
            gather(point, u, 0, offsets[p], offsets[p + 1] - offsets[p], rows[p], nodes, table, column)
        flags[p] = steep(point, 0, eps_rho)
        for s in range(node_owner.shape[1]):
            owner[p, s] = -1
            if steep(point, 1 + s, eps_eta):
                flags[p] = 1
            if steep(point, 1 + s, least) or abs(point[0, 1 + s]) >= least:
                find_owner(owner, clash, p, s, node_owner, offsets, nodes, kind, starts, places)


@inlined
def find_owner(
    owner: Numbers, clash: Integers, p: int, s: int, node_owner: Numbers,
    offsets: Integers, nodes: Numbers, kind: Integers, starts: Integers, places: Numbers,
) -> None:
    """owner[p, s] = the particle in slot s of the point's nearest nodes; see `sense`."""
    found = owner[p, s]
    for e in range(starts[kind[p]], starts[kind[p] + 1]):
        a = node_owner[nodes[offsets[p] + places[e]], s]
        if a >= 0 and found >= 0 and a != found:
            clash[p, 0] = min(a, found)
            clash[p, 1] = max(a, found)
        found = max(a, found)
    owner[p, s] = found


@inlined
def steep(point: Floats, column: int, eps: float) -> bool:
    """Whether the gradient of a field at a point is at least eps."""
    square = 0.0
    for k in range(1, point.shape[0]):
        square += point[k, column] ** 2
    return square >= eps * eps


@jit
def claim(
    high: Floats, low: Floats, owner: Numbers, loose: Integers,
    offsets: Integers, nodes: Numbers, kind: Integers, starts: Integers, places: Numbers,
) -> None:
    """Let the particles claim the nodes of every loose point at which they exist: where they are, and a ring around.

    Only a point's nearest nodes count. high[s, a] and low[s, a] become the largest and the smallest of the particles
    that claim slot s of node a.
    """
    for p in loose:
        for s in range(owner.shape[1]):
            particle = owner[p, s]
            if particle < 0:
                continue
            for e in range(starts[kind[p]], starts[kind[p] + 1]):
                node = nodes[offsets[p] + places[e]]
                high[s, node] = max(high[s, node], particle)
                low[s, node] = min(low[s, node], particle)


@jit
def interiors(
    low: Integers, high: Integers, flags: Numbers, owner: Numbers, u: Floats,
    offsets: Integers, nodes: Numbers, rows: Integers, table: Floats,
) -> None:
    """low[a], high[a]: smallest and largest particle number whose switched-off interior (eta > 1/2) reaches node a."""
    for p in range(flags.size):
        if flags[p]:
            continue
        slot = interior_slot(u, p, owner, offsets, nodes, rows, table)
        if slot >= 0:
            for e in range(offsets[p], offsets[p + 1]):
                low[nodes[e]] = min(low[nodes[e]], owner[p, slot])
                high[nodes[e]] = max(high[nodes[e]], owner[p, slot])


@jit
def interior_slot(
    u: Floats, p: int, owner: Numbers, offsets: Integers, nodes: Numbers, rows: Integers, table: Floats
) -> int:
    """The slot with eta_p > 1/2 at point p, or -1."""
    for s in range(owner.shape[1]):
        if owner[p, s] >= 0:
            eta = 0.0
            for i in range(offsets[p + 1] - offsets[p]):
                eta += table[0, rows[p] + i] * u[nodes[offsets[p] + i], 1 + s]
            if eta > 0.5:
                return s
    return -1


@jit
def watch_nodes(
    watch: Integers, flags: Numbers, owner: Numbers, owned: Integers,
    offsets: Integers, nodes: Numbers, rows: Integers, table: Floats,
    kind: Integers, starts: Integers, places: Numbers, listed: Integers,
) -> None:
    """watch[a]: bit 0 where a switched-off point needs node a, bit 1 + s where a live point near it lacks slot s.

    Of the listed points; owned[a]: `slots_of` node a.

    These nodal values decide whether the set of live points and slots still holds. A node counts as near where its
    N_a(x_p) is at least half the largest of the point: farther ones say little of the slot's value there. A slot that
    exists at the point is the same particle's at the nodes near it.
    """
    for p in listed:
        if not flags[p]:
            for e in range(offsets[p], offsets[p + 1]):
                watch[nodes[e]] |= 1
            continue
        missing = ~slots_of(owner, p)
        largest = table[0, rows[p] + places[starts[kind[p]]]]
        for e in range(starts[kind[p]], starts[kind[p] + 1]):
            if table[0, rows[p] + places[e]] < 0.5 * largest:
                break
            a = nodes[offsets[p] + places[e]]
            watch[a] |= owned[a] & missing


@jit
def all_slots(owned: Integers, owner: Numbers) -> None:
    """`slots_of` every row."""
    for i in range(owned.size):
        owned[i] = slots_of(owner, i)


@inlined
def slots_of(owner: Numbers, i: int) -> int:
    """Bit 1 + s where slot s of row i has an owner."""
    bits = np.int64(0)
    for s in range(owner.shape[1]):
        bits |= np.int64(owner[i, s] >= 0) << np.int64(1 + s)
    return int(bits)


@jit
def still_shares(
    W: Floats, drift: Floats, flags: Numbers, edge: Integers, owner: Numbers, u: Floats, weights: Floats, x: Floats,
    offsets: Integers, nodes: Numbers, rows: Integers, table: Floats, work: Floats, m: Coefficients, huang: bool,
) -> None:
    """What switched-off points owe to the nodes they share with live ones, as long as their fields stand still.

    W (n,) gets their shares of (24). drift (edges, 2, dim + rotations) gets their shares of the advection of rho and of
    eta at the shared nodes (edge[a] = row or -1), per unit of the particle's rigid motion (v, omega):
    sum_p w_p rho eta^2 (grad N_a, x cross grad N_a) and the same without rho [`wang`: rho eta].
    """
    dim = x.shape[1]
    point = np.empty((1 + dim, u.shape[1]))
    for p in range(flags.size):
        if flags[p]:
            continue
        begin = offsets[p]
        count = offsets[p + 1] - begin
        start = rows[p]
        for column in range(0, u.shape[1], LANES):
            gather(point, u, 0, begin, count, start, nodes, table, column)
        S2 = 0.0
        S3 = 0.0
        for c in range(1, u.shape[1]):
            S2 += point[0, c] ** 2
            S3 += point[0, c] ** 3
        add_potential(W, weights[p], 0, point, point[0, 0], S2, S3, begin, count, start, nodes, table, work, m)
        slot = interior_slot(u, p, owner, offsets, nodes, rows, table)
        if slot < 0:
            continue
        eta = point[0, 1 + slot]
        carried = weights[p] * point[0, 0] * (eta * eta if huang else eta)
        for i in range(count):
            at = edge[nodes[begin + i]]
            if at >= 0:
                add_drift(drift[at], carried, weights[p] * eta * eta, table[:, start + i], x[p])


@jit
def add_drift(drift: Floats, carried: float, swept: float, entry: Floats, x: Floats) -> None:
    """Add one table entry's grad N and x cross grad N to the drift of rho (row 0) and of eta (row 1)."""
    dim = x.shape[0]
    for k in range(dim):
        drift[0, k] += carried * entry[1 + k]
        drift[1, k] += swept * entry[1 + k]
    turn = x[0] * entry[2] - x[1] * entry[1]
    if dim == 2:
        drift[0, 2] += carried * turn
        drift[1, 2] += swept * turn
        return
    turn_x = x[1] * entry[3] - x[2] * entry[2]
    turn_y = x[2] * entry[1] - x[0] * entry[3]
    drift[0, 3] += carried * turn_x
    drift[0, 4] += carried * turn_y
    drift[0, 5] += carried * turn
    drift[1, 3] += swept * turn_x
    drift[1, 4] += swept * turn_y
    drift[1, 5] += swept * turn


@jit
def add_still_drift(
    rate: Floats, drift: Floats, edge_nodes: Integers, edge_particle: Numbers, slot_of: Numbers, motion: Floats
) -> None:
    """rate += drift . motion at the nodes between live and switched-off interior points; see `still_shares`."""
    for i in range(edge_nodes.size):
        a = edge_particle[i]
        if a < 0:
            continue
        for k in range(motion.shape[1]):
            rate[edge_nodes[i], 0] += drift[i, 0, k] * motion[a, k]
            rate[edge_nodes[i], 1 + slot_of[a]] += drift[i, 1, k] * motion[a, k]


@jit
def largest_slope(most: Floats, table: Floats, starts: Integers, longest: int) -> None:
    """most[0] becomes the largest sum of |dN/dx| + |dN/dy| [+ |dN/dz|] over a row, starts[i] its first column."""
    for i in range(starts.size):
        end = starts[i + 1] if i + 1 < starts.size else table.shape[1]
        total = 0.0
        for e in range(starts[i], min(end, starts[i] + longest)):
            for k in range(1, table.shape[0]):
                total += abs(table[k, e])
        most[0] = max(most[0], total)


@jit
def nodal_moments(
    mass: Floats, first_moment: Floats, weights: Floats, x: Floats,
    offsets: Integers, nodes: Numbers, rows: Integers, table: Floats,
) -> None:
    """m_a += w_p N_a(x_p) and q_a += w_p x_p N_a(x_p) over this rank's points   (22)"""
    for p in range(weights.size):
        for i in range(offsets[p + 1] - offsets[p]):
            a = nodes[offsets[p] + i]
            share = weights[p] * table[0, rows[p] + i]
            mass[a] += share
            for k in range(x.shape[1]):
                first_moment[a, k] += share * x[p, k]


@jit
def touch(touched: Bytes, chosen: Flags, offsets: Integers, nodes: Numbers) -> None:
    """touched[a] = 1 at the nodes that a chosen point sees."""
    for p in range(chosen.size):
        if chosen[p]:
            for e in range(offsets[p], offsets[p + 1]):
                touched[nodes[e]] = 1


@jit
def switch_on(flags: Numbers, marked: Flags, offsets: Integers, nodes: Numbers) -> None:
    """flags[p] = 1 at the points that see a marked node."""
    if not marked.any():
        return
    for p in range(flags.size):
        for e in range(offsets[p], offsets[p + 1]):
            if marked[nodes[e]]:
                flags[p] = 1
                break


@jit
def renumber(nodes: Numbers, new: Numbers) -> None:
    """Replace every node's number by its new one, in place."""
    for e in range(nodes.size):
        nodes[e] = new[nodes[e]]


@jit
def variation(varies: Flags, fields: Numbers, cells: Numbers, u: Floats, least: Floats, eps: float) -> None:
    """Of each cell c: whether a field differs by more than least[c] in it; how many fields: rho, those above eps."""
    for c in range(cells.shape[0]):
        for column in range(u.shape[1]):
            low = u[cells[c, 0], column]
            high = low
            for k in range(1, cells.shape[1]):
                low = min(low, u[cells[c, k], column])
                high = max(high, u[cells[c, k], column])
            varies[c] |= high - low > least[c]
            fields[c] += column == 0 or high > eps


@jit
def sample(values: Floats, u: Floats, offsets: Integers, nodes: Numbers, rows: Integers, table: Floats) -> None:
    """values[p] = sum_a N_a(x_p) u_a, for all columns of u (n, F)   (17)"""
    for p in range(values.shape[0]):
        for c in range(values.shape[1]):
            values[p, c] = 0.0
        for i in range(offsets[p + 1] - offsets[p]):
            a, share = nodes[offsets[p] + i], table[0, rows[p] + i]
            for c in range(values.shape[1]):
                values[p, c] += share * u[a, c]


@jit
def spread(
    sums: Floats, values: Floats, weights: Floats, offsets: Integers, nodes: Numbers, rows: Integers, table: Floats
) -> None:
    """sums[a] += sum_p w_p N_a(x_p) values[p], for all columns."""
    for p in range(values.shape[0]):
        for i in range(offsets[p + 1] - offsets[p]):
            a, share = nodes[offsets[p] + i], weights[p] * table[0, rows[p] + i]
            for c in range(values.shape[1]):
                sums[a, c] += share * values[p, c]


@jit
def start(array: Floats, values: Floats, listed: Integers) -> None:
    """array[a] = values[a] at the listed nodes."""
    for i in range(listed.size):
        array[listed[i]] = values[listed[i]]


@jit
def divide_values(array: Floats, mass: Floats, listed: Integers) -> None:
    """array[a] /= m_a at the listed nodes, one value each."""
    for i in range(listed.size):
        array[listed[i]] /= mass[listed[i]]
