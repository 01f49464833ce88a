"""The loops over blocks of points: `kernels` for eight points at a time, one lane each.

`columns` (F, n + LANES) holds the fields of the nodes one below the other, so that a field's values at the nodes of a
block's lanes are one pack: the lanes of entry i see nodes[begin + i] ... nodes[begin + i] + 7. Point fields are kept in
`fields` (E (1 + dim), LANES): row e (1 + dim) holds the values of entry e of `LiveBlocks`, the next dim rows its
derivatives. Lanes without a live point have the weight 0: they see some nodes, and add zeros to them.
"""

import numpy as np

from .arrays import Flags, Floats, Integers, Numbers
from .contacts import FAR, Contacts, add_contact
from .energy import Coefficients, df_deta, df_drho, free_energy_density, mobility
from .jit import inlined, jit
from .kernels import x_velocity, y_velocity, z_velocity
from .simd import LANES, flush_denormals, load, positive, restore_denormals, splat, store, total, transpose
from .slots import MOST_SLOTS

SMALLEST = float(np.finfo(np.float64).tiny)  # what is smaller counts as 0
NOBODY = 1e9  # more than any number of a particle: those of several are compared as floats, eight at a time


@inlined
def gather(
    fields: Floats, row: int, columns: Floats, column: int,
    begin: int, count: int, start: int, nodes: Numbers, table: Floats,
) -> None:
    """u_p = sum_a N_a(x_p) u_a and grad u_p = sum_a grad N_a(x_p) u_a for one field of a block   (17)"""
    dim = table.shape[0] - 1
    value = splat(0.0)
    x = splat(0.0)
    y = splat(0.0)
    z = splat(0.0)
    for i in range(count):
        e = start + i
        field = load(columns, column, nodes[begin + i])
        value = value + table[0, e] * field
        x = x + table[1, e] * field
        y = y + table[2, e] * field
        if dim == 3:
            z = z + table[3, e] * field
    store(fields, row, 0, value)
    store(fields, row + 1, 0, x)
    store(fields, row + 2, 0, y)
    if dim == 3:
        store(fields, row + 3, 0, z)


@inlined
def gather_two(
    fields: Floats, row: int, columns: Floats, column: int, other: int,
    begin: int, count: int, start: int, nodes: Numbers, table: Floats,
) -> None:
    """`gather` for two fields, of neighbouring entries: twice as many sums that do not wait for each other."""
    dim = table.shape[0] - 1
    value = splat(0.0)
    x = splat(0.0)
    y = splat(0.0)
    z = splat(0.0)
    other_value = splat(0.0)
    other_x = splat(0.0)
    other_y = splat(0.0)
    other_z = splat(0.0)
    for i in range(count):
        e = start + i
        a = nodes[begin + i]
        field = load(columns, column, a)
        second = load(columns, other, a)
        value = value + table[0, e] * field
        other_value = other_value + table[0, e] * second
        x = x + table[1, e] * field
        other_x = other_x + table[1, e] * second
        y = y + table[2, e] * field
        other_y = other_y + table[2, e] * second
        if dim == 3:
            z = z + table[3, e] * field
            other_z = other_z + table[3, e] * second
    store(fields, row, 0, value)
    store(fields, row + 1, 0, x)
    store(fields, row + 2, 0, y)
    next_row = row + 1 + dim
    store(fields, next_row, 0, other_value)
    store(fields, next_row + 1, 0, other_x)
    store(fields, next_row + 2, 0, other_y)
    if dim == 3:
        store(fields, row + 3, 0, z)
        store(fields, next_row + 3, 0, other_z)


@inlined
def scatter(
    columns: Floats, column: int, flow: Floats, row: int,
    begin: int, count: int, start: int, nodes: Numbers, table: Floats,
) -> None:
    """columns_a += N_a(x_p) s_p + grad N_a(x_p) . j_p for a block's source s and flux j, four rows of `flow`."""
    dim = table.shape[0] - 1
    source = load(flow, row, 0)
    x = load(flow, row + 1, 0)
    y = load(flow, row + 2, 0)
    z = load(flow, row + 3, 0)
    for i in range(count):
        e = start + i
        a = nodes[begin + i]
        new = load(columns, column, a) + table[0, e] * source + table[1, e] * x + table[2, e] * y
        if dim == 3:
            new = new + table[3, e] * z
        store(columns, column, a, new)


@inlined
def scatter_two(
    columns: Floats, column: int, other: int, flow: Floats,
    begin: int, count: int, start: int, nodes: Numbers, table: Floats,
) -> None:
    """`scatter` for two fields, rows 0 to 3 and 4 to 7 of `flow`."""
    dim = table.shape[0] - 1
    source = load(flow, 0, 0)
    x = load(flow, 1, 0)
    y = load(flow, 2, 0)
    z = load(flow, 3, 0)
    other_source = load(flow, 4, 0)
    other_x = load(flow, 5, 0)
    other_y = load(flow, 6, 0)
    other_z = load(flow, 7, 0)
    for i in range(count):
        e = start + i
        a = nodes[begin + i]
        new = load(columns, column, a) + table[0, e] * source + table[1, e] * x + table[2, e] * y
        second = load(columns, other, a) + table[0, e] * other_source + table[1, e] * other_x + table[2, e] * other_y
        if dim == 3:
            new = new + table[3, e] * z
            second = second + table[3, e] * other_z
        store(columns, column, a, new)
        store(columns, other, a, second)


@jit
def potential(
    W: Floats, touching: Integers, fields: Floats, D: Floats, squares: Floats, columns: Floats,
    blocks: Integers, live_weights: Floats, first: Integers, column: Numbers, owner: Numbers, partial: Flags,
    begins: Integers, counts: Integers, starts: Integers, nodes: Numbers, table: Floats, m: Coefficients,
    low: int, high: int,
) -> int:
    """First half of an evaluation, as `kernels.potential`: fields, D and S2 of live blocks low ... high - 1.

    W (1, n + LANES) gets their shares, touching the l of the blocks in which particles may touch; their number is
    returned.
    """
    mode = flush_denormals()
    width = table.shape[0]
    there = np.empty((1, LANES))
    flow = np.empty((4, LANES))
    touches = 0
    for l in range(low, high):
        b = blocks[l]
        begin = begins[b]
        count = counts[b]
        start = starts[b]
        e = first[l]
        end = first[l + 1]
        while e + 1 < end:
            gather_two(fields, e * width, columns, column[e], column[e + 1], begin, count, start, nodes, table)
            e += 2
        if e < end:
            gather(fields, e * width, columns, column[e], begin, count, start, nodes, table)
        row = first[l] * width
        rho = load(fields, row, 0)
        S1 = splat(0.0)
        S2 = splat(0.0)
        S3 = splat(0.0)
        P2 = splat(0.0)
        for e in range(first[l] + 1, end):
            eta = load(fields, e * width, 0)
            if partial[e]:
                for j in range(LANES):
                    there[0, j] = 1.0 if owner[e, j] >= 0 else 0.0
                exists = load(there, 0, 0)
                eta = exists * eta
                store(fields, e * width, 0, eta)
                for k in range(1, width):
                    store(fields, e * width + k, 0, exists * load(fields, e * width + k, 0))
            inside = positive(eta)
            S1 = S1 + inside
            P2 = P2 + inside * inside
            S2 = S2 + eta * eta
            S3 = S3 + eta * eta * eta
        overlap = S1 * S1 - P2
        store(D, l, 0, mobility(rho, overlap, m))
        store(squares, l, 0, S2)
        w = load(live_weights, l, 0)
        store(flow, 0, 0, w * df_drho(rho, S2, S3, m))
        for k in range(1, width):
            store(flow, k, 0, (w * m.kappa_rho) * load(fields, row + k, 0))
        scatter(W, 0, flow, 0, begin, count, start, nodes, table)
        if end - first[l] > 2 and total(w * positive(overlap - m.c)) > 0.0:
            touching[touches] = l
            touches += 1
    restore_denormals(mode)
    return touches


@jit
def meet(
    found: Contacts, fields: Floats, blocks: Integers, live_weights: Floats, first: Integers, owner: Numbers,
    points: Numbers, touching: Integers, c: float,
) -> None:
    """`kernels.meet` for the points in the live blocks `touching`: fields are 0 in lanes where they do not exist."""
    width = found.values.shape[1] // 3
    products = np.empty((1, LANES))
    for l in touching:
        for e in range(first[l] + 1, first[l + 1]):
            for g in range(e + 1, first[l + 1]):
                product = load(fields, e * width, 0) * load(fields, g * width, 0)
                if not total(positive(product - FAR * c)) > 0.0:
                    continue
                store(products, 0, 0, product)
                for j in range(LANES):
                    if products[0, j] > FAR * c and fields[e * width, j] > 0.0:
                        add_contact(
                            found, fields, first[l] * width, j, e * width, j, g * width, j,
                            owner[e, j], owner[g, j], points[blocks[l], j], live_weights[l, j], c,
                        )


@jit
def fetch(columns: Floats, source: Floats, at: Integers) -> None:
    """columns[c, i] = source[c, at[i]]."""
    for c in range(columns.shape[0]):
        for i in range(at.size):
            columns[c, i] = source[c, at[i]]


@jit
def give(target: Floats, columns: Floats, at: Integers) -> None:
    """target[c, at[i]] += columns[c, i], and columns[c, i] = 0."""
    for c in range(columns.shape[0]):
        for i in range(at.size):
            target[c, at[i]] += columns[c, i]
            columns[c, i] = 0.0


@jit
def fill_velocities(velocity: Floats, motion: Floats, owner: Numbers, e: int, x: Floats, row: int) -> None:
    """velocity[k, j] = component k of V_a(x) in lane j, a = owner[e, j]; 0 where there is none."""
    for j in range(LANES):
        a = owner[e, j]
        for k in range(3):
            velocity[k, j] = 0.0
        if a >= 0:
            velocity[0, j] = x_velocity(motion, a, x[row + 1, j], x[row + 2, j])
            velocity[1, j] = y_velocity(motion, a, x[row, j], x[row + 2, j])
            velocity[2, j] = z_velocity(motion, a, x[row, j], x[row + 1, j])


@jit
def divergence(
    rate: Floats, fields: Floats, D: Floats, squares: Floats, W: Floats, motion: Floats,
    blocks: Integers, live_weights: Floats, first: Integers, column: Numbers, particle: Numbers, owner: Numbers,
    x: Floats, begins: Integers, counts: Integers, starts: Integers, nodes: Numbers, table: Floats,
    m: Coefficients, rigid: bool, huang: bool, low: int, high: int,
) -> None:
    """Second half, as `kernels.divergence`: fluxes of live blocks low ... high - 1, scattered to rate (F, n + LANES).

    Fields go two by two, rho last: its flux needs what all order parameters are swept along with.
    """
    mode = flush_denormals()
    width = table.shape[0]
    dim = width - 1
    slope = np.empty((width, LANES))
    work = np.empty((3, LANES))
    flow = np.empty((8, LANES))
    for l in range(low, high):
        b = blocks[l]
        begin = begins[b]
        count = counts[b]
        start = starts[b]
        row = first[l] * width
        w = load(live_weights, l, 0)
        rho = load(fields, row, 0)
        S2 = load(squares, l, 0)
        gather(slope, 0, W, 0, begin, count, start, nodes, table)
        x_advection = splat(0.0)
        y_advection = splat(0.0)
        z_advection = splat(0.0)
        spread = (-m.L * m.kappa_eta) * w
        held = -1
        for e in range(first[l] + 1, first[l + 1]):
            at = e * width
            to = 0 if held < 0 else 4
            eta = load(fields, at, 0)
            store(flow, to, 0, (-m.L * w) * df_deta(eta, rho, S2, m))
            x_flux = spread * load(fields, at + 1, 0)
            y_flux = spread * load(fields, at + 2, 0)
            z_flux = spread * load(fields, at + dim, 0)
            if rigid:
                a = particle[e]
                if a >= 0:
                    x_swept = eta * x_velocity(motion, a, load(x, 3 * b + 1, 0), load(x, 3 * b + 2, 0))
                    y_swept = eta * y_velocity(motion, a, load(x, 3 * b, 0), load(x, 3 * b + 2, 0))
                    z_swept = eta * z_velocity(motion, a, load(x, 3 * b, 0), load(x, 3 * b + 1, 0))
                else:
                    fill_velocities(work, motion, owner, e, x, 3 * b)
                    x_swept = eta * load(work, 0, 0)
                    y_swept = eta * load(work, 1, 0)
                    z_swept = eta * load(work, 2, 0)
                share = eta if huang else splat(1.0)
                x_flux = x_flux + w * eta * x_swept
                y_flux = y_flux + w * eta * y_swept
                z_flux = z_flux + w * eta * z_swept
                x_advection = x_advection + share * x_swept
                y_advection = y_advection + share * y_swept
                z_advection = z_advection + share * z_swept
            store(flow, to + 1, 0, x_flux)
            store(flow, to + 2, 0, y_flux)
            store(flow, to + 3, 0, z_flux)
            if held < 0:
                held = e
            else:
                scatter_two(rate, column[held], column[e], flow, begin, count, start, nodes, table)
                held = -1
        to = 0 if held < 0 else 4
        D_p = load(D, l, 0)
        store(flow, to, 0, splat(0.0))
        store(flow, to + 1, 0, w * (rho * x_advection - D_p * load(slope, 1, 0)))
        store(flow, to + 2, 0, w * (rho * y_advection - D_p * load(slope, 2, 0)))
        store(flow, to + 3, 0, w * (rho * z_advection - D_p * load(slope, dim, 0)))
        if held < 0:
            scatter(rate, 0, flow, 0, begin, count, start, nodes, table)
        else:
            scatter_two(rate, column[held], 0, flow, begin, count, start, nodes, table)
    restore_denormals(mode)


@jit
def free_energy(
    columns: Floats, points: Numbers, weights: Floats,
    begins: Integers, counts: Integers, starts: Integers, nodes: Numbers, table: Floats, m: Coefficients,
) -> float:
    """`kernels.free_energy` for the points in blocks: of all fields that are not 0 at a node that a block sees."""
    mode = flush_denormals()
    width = table.shape[0]
    slots = columns.shape[0] - 1
    held = np.zeros(columns.shape[1] - LANES, dtype=np.int64)
    fields_of_eight(held, columns, slots, SMALLEST, np.zeros(held.size, dtype=np.bool_))
    fields = np.empty((2 * width, LANES))
    present = np.empty(1 + slots, dtype=np.int64)
    share = np.empty((1, LANES))
    energy = 0.0
    for b in range(points.shape[0]):
        begin, count, start = begins[b], counts[b], starts[b]
        some = np.int64(0)
        for e in range(begin, begin + count):
            some |= held[nodes[e]]
        here = 0
        for column in range(1 + slots):
            present[here] = column
            here += column == 0 or some >> bit(column) & 1 == 1
        rho = splat(0.0)
        S2 = splat(0.0)
        S3 = splat(0.0)
        gradients = splat(0.0)
        for i in range(here):
            if i % 2 == 0 and i + 1 < here:
                gather_two(fields, 0, columns, present[i], present[i + 1], begin, count, start, nodes, table)
            elif i % 2 == 0:
                gather(fields, 0, columns, present[i], begin, count, start, nodes, table)
            row = i % 2 * width
            value = load(fields, row, 0)
            kappa = m.kappa_rho if i == 0 else m.kappa_eta
            for k in range(1, width):
                slope = load(fields, row + k, 0)
                gradients = gradients + kappa * slope * slope
            if i == 0:
                rho = value
            else:
                S2 = S2 + value * value
                S3 = S3 + value * value * value
        for j in range(LANES):
            p = points[b, j]
            share[0, j] = weights[p] if p >= 0 else 0.0
        energy += total(load(share, 0, 0) * (free_energy_density(rho, S2, S3, m) + 0.5 * gradients))
    restore_denormals(mode)
    return energy


@jit
def sense(
    flags: Numbers, owner: Numbers, clash: Integers, columns: Floats, high: Floats, low: Floats,
    eps_rho: float, eps_eta: float, least: float, negligible: float, points: Numbers, changed: Flags,
    begins: Integers, counts: Integers, block_starts: Integers, nodes: Numbers, table: Floats,
    kind: Integers, starts: Integers, places: Numbers,
) -> None:
    """`kernels.sense` for the points in blocks.

    high, low (slots, n + LANES): the owners of the nodes' slots, -1 and `NOBODY` where there is none. Fields whose
    nodal values are below `negligible` all over a block cannot come to `least`, nor can their gradients.
    """
    held = np.zeros(changed.size, dtype=np.int64)
    fields_of_eight(held, columns, owner.shape[1], negligible, changed)
    width = table.shape[0]
    fields = np.empty((2 * width, LANES))
    present = np.empty(1 + owner.shape[1], dtype=np.int64)
    found = np.empty((2, LANES))
    exists = np.empty(LANES, dtype=np.bool_)
    for b in range(points.shape[0]):
        begin = begins[b]
        some = np.int64(0)
        for e in range(begin, begin + counts[b]):
            some |= held[nodes[e]]
        if not some & 1:
            continue
        for j in range(LANES):
            p = points[b, j]
            if p >= 0:
                flags[p] = 0
                clash[p, 0] = -1
                for s in range(owner.shape[1]):
                    owner[p, s] = -1
        pattern = kind[points[b, 0]]
        fields_here = 0
        for column in range(1 + owner.shape[1]):
            if column == 0 or some >> bit(column) & 1:
                present[fields_here] = column
                fields_here += 1
        for i in range(fields_here):
            column = present[i]
            if i % 2 == 0 and i + 1 < fields_here:
                gather_two(
                    fields, 0, columns, column, present[i + 1], begin, counts[b], block_starts[b], nodes, table
                )
            elif i % 2 == 0:
                gather(fields, 0, columns, column, begin, counts[b], block_starts[b], nodes, table)
            row = i % 2 * width
            eps = eps_rho if column == 0 else eps_eta
            several = False
            for j in range(LANES):
                square = 0.0
                for k in range(1, width):
                    square += fields[row + k, j] * fields[row + k, j]
                exists[j] = column > 0 and (square >= least * least or abs(fields[row, j]) >= least)
                if exists[j]:
                    several = True
                if square >= eps * eps and points[b, j] >= 0:
                    flags[points[b, j]] = 1
            if not several:
                continue
            largest = splat(-1.0)
            smallest = splat(NOBODY)
            for e in range(starts[pattern], starts[pattern + 1]):
                a = nodes[begin + places[e]]
                largest = largest + positive(load(high, column - 1, a) - largest)
                smallest = smallest - positive(smallest - load(low, column - 1, a))
            store(found, 0, 0, largest)
            store(found, 1, 0, smallest)
            for j in range(LANES):
                p = points[b, j]
                if p >= 0 and exists[j]:
                    owner[p, column - 1] = np.int32(found[0, j])
                    if 0.0 <= found[1, j] < found[0, j]:
                        clash[p, 0] = np.int64(found[1, j])
                        clash[p, 1] = np.int64(found[0, j])


@jit
def claim(
    high: Floats, low: Floats, owner: Numbers, points: Numbers,
    begins: Integers, nodes: Numbers, kind: Integers, starts: Integers, places: Numbers,
) -> None:
    """`kernels.claim` for the points in blocks; high and low (slots, n + LANES)."""
    mine = np.empty((2, LANES))
    for b in range(points.shape[0]):
        pattern = kind[points[b, 0]]
        for s in range(owner.shape[1]):
            some = False
            for j in range(LANES):
                p = points[b, j]
                particle = owner[p, s] if p >= 0 else np.int32(-1)
                mine[0, j] = particle
                mine[1, j] = particle if particle >= 0 else NOBODY
                if particle >= 0:
                    some = True
            if not some:
                continue
            largest = load(mine, 0, 0)
            smallest = load(mine, 1, 0)
            for e in range(starts[pattern], starts[pattern + 1]):
                a = nodes[begins[b] + places[e]]
                before = load(high, s, a)
                store(high, s, a, before + positive(largest - before))
                before = load(low, s, a)
                store(low, s, a, before - positive(before - smallest))


@jit
def fields_of_eight(held: Integers, columns: Floats, slots: int, least: float, changed: Flags) -> None:
    """held[a], of the nodes a ... a + LANES - 1: bit 0: one has changed; `bit` of a column: it is at least `least`."""
    for a in range(held.size):
        held[a] = changed[a]
    for column in range(1, 1 + slots):
        for a in range(held.size):
            held[a] |= np.int64(abs(columns[column, a]) >= least) << bit(column)
    for a in range(held.size):
        for j in range(1, min(LANES, held.size - a)):
            held[a] |= held[a + j]


@inlined
def bit(column: int) -> int:
    """The bit of an order parameter's column in `fields_of_eight`: with more than `MOST_SLOTS` some share theirs."""
    return int(np.int64(1 + (column - 1) % MOST_SLOTS))


@jit
def by_node(values: Numbers, columns: Floats) -> None:
    """values[a, s] = columns[s, a]."""
    for a in range(values.shape[0]):
        for s in range(values.shape[1]):
            values[a, s] = np.int32(columns[s, a])


@jit
def by_column(high: Floats, low: Floats, node_owner: Numbers) -> None:
    """high[s, a] and low[s, a] (slots, n + LANES) = node_owner[a, s], or -1 and `NOBODY` where that is -1."""
    n = node_owner.shape[0]
    for some in range(0, n, 256):  # what is read of `node_owner` is still at hand for the next slot
        for s in range(node_owner.shape[1]):
            for a in range(some, min(some + 256, n)):
                high[s, a] = node_owner[a, s]
                low[s, a] = node_owner[a, s] if node_owner[a, s] >= 0 else NOBODY
    high[:, n:], low[:, n:] = -1.0, NOBODY


@jit
def watch_nodes(
    watch: Integers, owned: Integers, blocks: Integers, live_weights: Floats, first: Integers, column: Numbers,
    owner: Numbers, points: Numbers, begins: Integers, block_starts: Integers, nodes: Numbers, table: Floats,
    kind: Integers, starts: Integers, places: Numbers,
) -> None:
    """`kernels.watch_nodes` for the live points in blocks; owned[a]: `kernels.slots_of` node a."""
    missing = np.empty(LANES, dtype=np.int64)
    for l in range(blocks.size):
        b = blocks[l]
        for j in range(LANES):
            missing[j] = -1 if live_weights[l, j] > 0.0 else 0
        for e in range(first[l] + 1, first[l + 1]):
            here = np.int64(1) << np.int64(column[e])
            for j in range(LANES):
                if owner[e, j] >= 0:
                    missing[j] &= ~here
        pattern = kind[points[b, 0]]
        largest = table[0, block_starts[b] + places[starts[pattern]]]
        for e in range(starts[pattern], starts[pattern + 1]):
            if table[0, block_starts[b] + places[e]] < 0.5 * largest:
                break
            a = nodes[begins[b] + places[e]]
            for j in range(min(LANES, owned.size - a)):
                watch[a + j] |= owned[a + j] & missing[j]


@jit
def to_columns(columns: Floats, u: Floats) -> None:
    """columns (F, n + LANES) = u (n, F) with rows and columns exchanged, and 0 in the last LANES columns."""
    n = u.shape[0]
    for c in range(0, u.shape[1], LANES):
        for a in range(0, n - n % LANES, LANES):
            transpose(u, a, c, columns, c, a)
        for k in range(c, c + LANES):
            for a in range(n - n % LANES, n):
                columns[k, a] = u[a, k]
            for a in range(n, n + LANES):
                columns[k, a] = 0.0
