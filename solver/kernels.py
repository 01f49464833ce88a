"""The loops over material points: gather nodal fields, evaluate the physics, scatter to the nodes.

Layout. `u` (n, F) holds a node's fields side by side: column 0 is rho, column 1 + s is slot s of eta, F is a multiple
of LANES. The shape-function table is compressed by rows: point p sees nodes[offsets[p] : offsets[p + 1]], and
table[e] = (N, dN/dx, dN/dy[, dN/dz]) belongs to entry e. `live` lists the points that are integrated, l counts along
it, and owner[l, s] is the particle that slot s means at that point, or -1: such a slot does not exist there.
Point fields are kept in `point` (L (1 + dim), F): row l (1 + dim) holds the values at live point l, the next dim rows
their derivatives.
"""

import numpy as np

from .energy import df_deta, df_drho, free_energy_density, mobility
from .jit import jit
from .simd import LANES, fma, load, splat, store


@jit
def gather(point, u, row, first, last, nodes, table, column):
    """u_p = sum_a N_a(x_p) u_a and grad u_p = sum_a grad N_a(x_p) u_a for one point and one pack of fields   (17)"""
    dim = table.shape[1] - 1
    value = splat(0.0)
    x = splat(0.0)
    y = splat(0.0)
    z = splat(0.0)
    for e in range(first, last):
        field = load(u, nodes[e], column)
        value = fma(table[e, 0], field, value)
        x = fma(table[e, 1], field, x)
        y = fma(table[e, 2], field, y)
        if dim == 3:
            z = fma(table[e, 3], field, z)
    store(point, row, column, value)
    store(point, row + 1, column, x)
    store(point, row + 2, column, y)
    if dim == 3:
        store(point, row + 3, column, z)


@jit
def scatter(rate, point, row, first, last, nodes, table, column):
    """rate_a += N_a(x_p) s_p + grad N_a(x_p) . j_p for one point's sources s and fluxes j (the rows of `point`)."""
    dim = table.shape[1] - 1
    source = load(point, row, column)
    x = load(point, row + 1, column)
    y = load(point, row + 2, column)
    z = source
    if dim == 3:
        z = load(point, row + 3, column)
    for e in range(first, last):
        a = nodes[e]
        new = fma(table[e, 0], source, fma(table[e, 1], x, fma(table[e, 2], y, load(rate, a, column))))
        if dim == 3:
            new = fma(table[e, 3], z, new)
        store(rate, a, column, new)


@jit
def has_fields(owner, l, column):
    """Whether the pack that starts at `column` holds rho or a slot with an owner at live point l."""
    if column == 0:
        return True
    for s in range(column - 1, column - 1 + LANES):
        if owner[l, s] >= 0:
            return True
    return False


@jit
def add_potential(W, w, row, point, S2, S3, first, last, nodes, table, m):
    """W_a += w_p [ N_a df/drho + kappa_rho grad N_a . grad rho_p ]: one point's share of (24), before the 1/m_a."""
    dim = table.shape[1] - 1
    source = w * df_drho(point[row, 0], S2, S3, m)
    x = w * m.kappa_rho * point[row + 1, 0]
    y = w * m.kappa_rho * point[row + 2, 0]
    z = w * m.kappa_rho * point[row + dim, 0]
    for e in range(first, last):
        share = table[e, 0] * source + table[e, 1] * x + table[e, 2] * y
        if dim == 3:
            share += table[e, 3] * z
        W[nodes[e]] += share


@jit
def add_contact(force, point, row, l, owner, w, x, m):
    """Add b_a w_p and (x_p cross b_a) w_p of every touching pair to the particles' forces and torques   (25)-(27)

    b_a = k sum_{b != a} (rho - rho_0) [eta_a eta_b > c] (grad eta_a - grad eta_b). force (particles, dim + rotations);
    x is measured from the origin that `rigid.velocities` moves to the particle's centre.
    """
    dim = x.shape[0]
    slots = owner.shape[1]
    for s in range(slots):
        a = owner[l, s]
        if a < 0 or point[row, 1 + s] <= 0.0:
            continue
        for t in range(s + 1, slots):
            b = owner[l, t]
            if b < 0 or point[row, 1 + s] * point[row, 1 + t] <= m.c:
                continue
            pull = w * m.k * (point[row, 0] - m.rho_0)
            fx = pull * (point[row + 1, 1 + s] - point[row + 1, 1 + t])
            fy = pull * (point[row + 2, 1 + s] - point[row + 2, 1 + t])
            force[a, 0] += fx
            force[a, 1] += fy
            force[b, 0] -= fx
            force[b, 1] -= fy
            torque = x[0] * fy - x[1] * fx
            if dim == 2:
                force[a, 2] += torque
                force[b, 2] -= torque
            else:
                fz = pull * (point[row + 3, 1 + s] - point[row + 3, 1 + t])
                force[a, 2] += fz
                force[b, 2] -= fz
                force[a, 3] += x[1] * fz - x[2] * fy
                force[b, 3] -= x[1] * fz - x[2] * fy
                force[a, 4] += x[2] * fx - x[0] * fz
                force[b, 4] -= x[2] * fx - x[0] * fz
                force[a, 5] += torque
                force[b, 5] -= torque


@jit
def potential(W, force, point, D, u, live, owner, weights, x, offsets, nodes, table, m, rigid):
    """First half of an evaluation: fields at the live points, D, their shares of W, and the contact forces.

    W (n,) gets partial sums, force (particles, dim + rotations) is added to where `rigid`; point and D are filled.
    """
    width = 1 + x.shape[1]
    slots = owner.shape[1]
    for l in range(live.size):
        p = live[l]
        row = l * width
        first = offsets[p]
        last = offsets[p + 1]
        for column in range(0, u.shape[1], LANES):
            if has_fields(owner, l, column):
                gather(point, u, row, first, last, nodes, table, column)
        S1 = 0.0
        S2 = 0.0
        S3 = 0.0
        P2 = 0.0
        grains = 0
        for s in range(slots):
            if owner[l, s] >= 0:
                eta = point[row, 1 + s]
                S2 += eta * eta
                S3 += eta * eta * eta
                positive = max(eta, 0.0)
                S1 += positive
                P2 += positive * positive
                grains += 1
        D[l] = mobility(point[row, 0], S1 * S1 - P2, m)
        add_potential(W, weights[p], row, point, S2, S3, first, last, nodes, table, m)
        if rigid and grains > 1:
            add_contact(force, point, row, l, owner, weights[p], x[p], m)


@jit
def rigid_velocity(motion, a, x, k, dim):
    """Component k of V_a(x) = v_a + omega_a cross x; motion[a] = (v_a, omega_a), v_a taken at the origin of x."""
    if dim == 2:
        return motion[a, 0] - motion[a, 2] * x[1] if k == 0 else motion[a, 1] + motion[a, 2] * x[0]
    i = (k + 1) % 3
    j = (k + 2) % 3
    return motion[a, k] + motion[a, 3 + i] * x[j] - motion[a, 3 + j] * x[i]


@jit
def divergence(rate, point, D, W, motion, live, owner, weights, x, offsets, nodes, table, m, rigid, huang):
    """Second half of an evaluation: the fluxes at the live points, scattered to the nodes   (20), (21)

    rate (n, F) gets partial sums, before the 1/m_a. The rows of `point` are turned from fields into sources and fluxes:
    rho:   source 0,               flux -D grad W + rho v_adv
    eta_a: source -L df/deta_a,    flux -L kappa_eta grad eta_a + eta_a v_a,    v_a = V_a(x) eta_a
    """
    dim = x.shape[1]
    slots = owner.shape[1]
    advection = np.zeros(3)
    for l in range(live.size):
        p = live[l]
        row = l * (1 + dim)
        first = offsets[p]
        last = offsets[p + 1]
        w = weights[p]
        gx = 0.0
        gy = 0.0
        gz = 0.0
        for e in range(first, last):
            value = W[nodes[e]]
            gx += table[e, 1] * value
            gy += table[e, 2] * value
            if dim == 3:
                gz += table[e, 3] * value
        rho = point[row, 0]
        S2 = 0.0
        for s in range(slots):
            if owner[l, s] >= 0:
                S2 += point[row, 1 + s] ** 2
        advection[:] = 0.0
        for s in range(slots):
            a = owner[l, s]
            column = 1 + s
            if a < 0:
                for k in range(1 + dim):
                    point[row + k, column] = 0.0
                continue
            eta = point[row, column]
            point[row, column] = -w * m.L * df_deta(eta, rho, S2, m)
            for k in range(dim):
                flux = -m.L * m.kappa_eta * point[row + 1 + k, column]
                if rigid:
                    v = rigid_velocity(motion, a, x[p], k, dim) * eta
                    flux += eta * v
                    advection[k] += eta * v if huang else v
                point[row + 1 + k, column] = w * flux
        point[row, 0] = 0.0
        point[row + 1, 0] = w * (rho * advection[0] - D[l] * gx)
        point[row + 2, 0] = w * (rho * advection[1] - D[l] * gy)
        if dim == 3:
            point[row + 3, 0] = w * (rho * advection[2] - D[l] * gz)
        for column in range(0, rate.shape[1], LANES):
            if has_fields(owner, l, column):
                scatter(rate, point, row, first, last, nodes, table, column)


@jit
def free_energy(u, weights, dim, offsets, nodes, table, m):
    """F = sum_p w_p [ f + kappa_rho/2 |grad rho|^2 + kappa_eta/2 sum |grad eta|^2 ] over all points of this rank   (1)"""
    point = np.empty((1 + dim, u.shape[1]))
    total = 0.0
    for p in range(weights.size):
        for column in range(0, u.shape[1], LANES):
            gather(point, u, 0, offsets[p], offsets[p + 1], nodes, table, column)
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
def sense(flags, owner, clash, u, node_owner, eps_rho, eps_eta, dim, offsets, nodes, table):
    """Mark the points where something happens and name the particles that their slots mean (section 2.4).

    flags[p] = 1 where |grad rho| >= eps_rho or any |grad eta| >= eps_eta. owner[p, s] is the particle found in slot s
    of the point's nodes; where two different ones share a slot of a marked point, clash[p] = (one, other).
    """
    point = np.empty((1 + dim, u.shape[1]))
    slots = node_owner.shape[1]
    for p in range(flags.size):
        for column in range(0, u.shape[1], LANES):
            gather(point, u, 0, offsets[p], offsets[p + 1], nodes, table, column)
        flags[p] = 0
        for c in range(1 + slots):
            square = 0.0
            for k in range(dim):
                square += point[1 + k, c] ** 2
            limit = eps_rho if c == 0 else eps_eta
            if square >= limit * limit:
                flags[p] = 1
        clash[p, 0] = -1
        for s in range(slots):
            found = -1
            for e in range(offsets[p], offsets[p + 1]):
                a = node_owner[nodes[e], s]
                if a >= 0 and found >= 0 and a != found:
                    clash[p, 0] = min(a, found)
                    clash[p, 1] = max(a, found)
                found = max(found, a)
            owner[p, s] = found


@jit
def claim(node_owner, clash, marked, owner, offsets, nodes):
    """Let the marked points' particles claim the nodes they scatter to: one ring of room to grow.

    Where a node's slot is already another particle's, clash[l] = (one, other).
    """
    for l in range(marked.size):
        clash[l, 0] = -1
        for s in range(owner.shape[1]):
            a = owner[l, s]
            if a < 0:
                continue
            for e in range(offsets[marked[l]], offsets[marked[l] + 1]):
                holder = node_owner[nodes[e], s]
                if holder < 0:
                    node_owner[nodes[e], s] = a
                elif holder != a:
                    clash[l, 0] = min(a, holder)
                    clash[l, 1] = max(a, holder)


@jit
def interiors(low, high, flags, owner, u, offsets, nodes, table):
    """low[a], high[a]: smallest and largest particle number whose switched-off interior (eta > 1/2) reaches node a."""
    for p in range(flags.size):
        if flags[p]:
            continue
        slot = interior_slot(u, p, owner, offsets, nodes, table)
        if slot >= 0:
            for e in range(offsets[p], offsets[p + 1]):
                low[nodes[e]] = min(low[nodes[e]], owner[p, slot])
                high[nodes[e]] = max(high[nodes[e]], owner[p, slot])


@jit
def interior_slot(u, p, owner, offsets, nodes, table):
    """The slot with eta_p > 1/2 at point p, or -1."""
    for s in range(owner.shape[1]):
        if owner[p, s] >= 0:
            eta = 0.0
            for e in range(offsets[p], offsets[p + 1]):
                eta += table[e, 0] * u[nodes[e], 1 + s]
            if eta > 0.5:
                return s
    return -1


@jit
def watch_nodes(watch, flags, owner, node_owner, offsets, nodes):
    """watch[a]: bit 0 where a switched-off point needs node a, bit 1 + s where slot s is missing at a live point of it.

    These nodal values decide whether the set of live points and slots still holds.
    """
    for p in range(flags.size):
        for e in range(offsets[p], offsets[p + 1]):
            a = nodes[e]
            if not flags[p]:
                watch[a] |= 1
                continue
            for s in range(owner.shape[1]):
                if node_owner[a, s] >= 0 and owner[p, s] != node_owner[a, s]:
                    watch[a] |= np.int64(1) << (1 + s)


@jit
def still_shares(W, drift, flags, edge, owner, u, weights, x, offsets, nodes, table, m, huang):
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
        first = offsets[p]
        last = offsets[p + 1]
        for column in range(0, u.shape[1], LANES):
            gather(point, u, 0, first, last, nodes, table, column)
        S2 = 0.0
        S3 = 0.0
        for c in range(1, u.shape[1]):
            S2 += point[0, c] ** 2
            S3 += point[0, c] ** 3
        add_potential(W, weights[p], 0, point, S2, S3, first, last, nodes, table, m)
        slot = interior_slot(u, p, owner, offsets, nodes, table)
        if slot < 0:
            continue
        eta = point[0, 1 + slot]
        carried = weights[p] * point[0, 0] * (eta * eta if huang else eta)
        for e in range(first, last):
            if edge[nodes[e]] >= 0:
                add_drift(drift[edge[nodes[e]]], carried, weights[p] * eta * eta, table[e], x[p])


@jit
def add_drift(drift, carried, swept, entry, x):
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
def add_still_drift(rate, drift, edge_nodes, edge_particle, slot_of, motion):
    """rate += drift . motion at the nodes between live and switched-off interior points; see `still_shares`."""
    for i in range(edge_nodes.size):
        a = edge_particle[i]
        if a < 0:
            continue
        for k in range(motion.shape[1]):
            rate[edge_nodes[i], 0] += drift[i, 0, k] * motion[a, k]
            rate[edge_nodes[i], 1 + slot_of[a]] += drift[i, 1, k] * motion[a, k]


@jit
def add_moments(moments, u, listed, node_owner, mass, first_moment):
    """moments[a] += (m_b eta_b, q_b eta_b) over the listed nodes b: V_a and int r eta_a as exact nodal sums."""
    for i in range(listed.size):
        b = listed[i]
        for s in range(node_owner.shape[1]):
            a = node_owner[b, s]
            if a >= 0:
                eta = u[b, 1 + s]
                moments[a, 0] += mass[b] * eta
                for k in range(first_moment.shape[1]):
                    moments[a, 1 + k] += first_moment[b, k] * eta


@jit
def start(array, values, listed):
    """array[a] = values[a] at the listed nodes."""
    for i in range(listed.size):
        array[listed[i]] = values[listed[i]]


@jit
def clear(array, listed):
    """array[a, :] = 0 at the listed nodes."""
    for i in range(listed.size):
        for column in range(0, array.shape[1], LANES):
            store(array, listed[i], column, splat(0.0))


@jit
def divide(array, mass, listed):
    """array[a, :] /= m_a at the listed nodes."""
    for i in range(listed.size):
        a = listed[i]
        inverse = 1.0 / mass[a]
        for column in range(0, array.shape[1], LANES):
            store(array, a, column, fma(inverse, load(array, a, column), splat(0.0)))


@jit
def advance(new, old, dt, rate, listed):
    """new = old + dt rate at the listed nodes."""
    for i in range(listed.size):
        a = listed[i]
        for column in range(0, new.shape[1], LANES):
            store(new, a, column, fma(dt, load(rate, a, column), load(old, a, column)))


@jit
def largest_change(u, reference, watched, watch, eps_rho, eps_eta):
    """max |u - reference| / eps over the watched nodes and the fields that are watched there."""
    largest = 0.0
    for i in range(watched.size):
        a = watched[i]
        bits = watch[a]
        if bits & 1:
            largest = max(largest, abs(u[a, 0] - reference[a, 0]) / eps_rho)
        for c in range(1, u.shape[1]):
            if bits & 1 or bits & (np.int64(1) << c):
                largest = max(largest, abs(u[a, c] - reference[a, c]) / eps_eta)
    return largest


@jit
def first_outside(u, listed, low, high):
    """The first listed node with a field outside [low, high] or not a number, or -1."""
    for i in range(listed.size):
        a = listed[i]
        for c in range(u.shape[1]):
            if not (low <= u[a, c] <= high):
                return a
    return -1


@jit
def chebyshev_stage(new, first, before, last, rate, rate_0, c, listed):
    """new = c_0 Y_0 + c_1 Y_{j-1} + c_2 Y_{j-2} + c_3 F_{j-1} + c_4 F_0 at the listed nodes."""
    for i in range(listed.size):
        a = listed[i]
        for column in range(0, new.shape[1], LANES):
            y = fma(c[0], load(first, a, column), fma(c[1], load(last, a, column), splat(0.0)))
            y = fma(c[2], load(before, a, column), fma(c[3], load(rate, a, column), y))
            store(new, a, column, fma(c[4], load(rate_0, a, column), y))


@jit
def chebyshev_error(new, old, rate_1, rate_0, dt, mass, tolerance, listed):
    """sum_a m_a sum_fields (e / (tolerance (1 + |u|)))^2, e = 0.8 (y_n - y_{n+1}) + 0.4 dt (F_n + F_{n+1})."""
    total = 0.0
    for i in range(listed.size):
        a = listed[i]
        square = 0.0
        for c in range(new.shape[1]):
            error = 0.8 * (old[a, c] - new[a, c]) + 0.4 * dt * (rate_0[a, c] + rate_1[a, c])
            error /= tolerance * (1.0 + abs(new[a, c]))
            square += error * error
        total += mass[a] * square
    return total


@jit
def squares(u, listed):
    """sum u^2 over the listed nodes and all fields."""
    total = 0.0
    for i in range(listed.size):
        for c in range(u.shape[1]):
            total += u[listed[i], c] * u[listed[i], c]
    return total


@jit
def difference(new, a, b, factor, listed):
    """new = factor (a - b) at the listed nodes."""
    for i in range(listed.size):
        for c in range(new.shape[1]):
            new[listed[i], c] = factor * (a[listed[i], c] - b[listed[i], c])


@jit
def hermite(new, old, rate_0, u, rate_1, dt, theta, listed):
    """The cubic through (old, rate_0) and (u, rate_1) a step dt apart, at the fraction theta of the step."""
    h00 = (1.0 + 2.0 * theta) * (1.0 - theta) ** 2
    h10 = theta * (1.0 - theta) ** 2 * dt
    h01 = theta * theta * (3.0 - 2.0 * theta)
    h11 = theta * theta * (theta - 1.0) * dt
    for i in range(listed.size):
        a = listed[i]
        for c in range(new.shape[1]):
            new[a, c] = h00 * old[a, c] + h10 * rate_0[a, c] + h01 * u[a, c] + h11 * rate_1[a, c]
