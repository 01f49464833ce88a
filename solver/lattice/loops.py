"""The sums over the points of a lattice: layer by layer of cells, axis by axis, eight cells of a row at a time.

u_p = sum_a N_a(x_p) u_a is a sum along the slow axis, of that along the middle one, of that along the fast one; so are
its derivatives, with dN in the place of N along one axis; and what points give back to the nodes goes the same way in
the reverse order. Each of the two points per cell has sums of its own, p = 0 or 1. A layer has the cells between two
planes of nodes; what is kept of it fits into the cache.
"""

from typing import NamedTuple, cast

import numpy as np

from ..arrays import Floats, Integers
from ..contacts import FAR, Contacts, add_contact
from ..energy import Coefficients, df_deta, df_drho, free_energy_density, mobility
from ..jit import ZERO, lean, lean_jit
from ..simd import LANES, Pack, flush_denormals, load, positive, restore_denormals, splat, store, total
from .axis import GHOSTS as GHOSTS
from .windows import Layout

PAD = 24  # places on both sides of a row of work space
SIX = 6  # taps of the default functions: loops of that length are unrolled
RHO = cast(int, np.int32(0))  # the number of rho's window, of the type that others have, see `jit.ZERO`


class Tables(NamedTuple):
    """Shape functions of the three axes, and what else is the same in every evaluation. See `axis.Axis`."""

    slow: Floats  # (2, cells, taps)
    d_slow: Floats
    middle: Floats  # (2, cells, taps); in the plane (2, 1, 1), N = 1 and dN = 0
    d_middle: Floats
    fast: Floats  # (2 taps, cells + ghosts) by cell
    d_fast: Floats
    fast_back: Floats  # (2 taps, nodes + ghosts) by node
    d_fast_back: Floats
    inner: Floats  # (2, taps) N along the fast axis far from walls
    d_inner: Floats
    x: Floats  # (2, cells + ghosts) position of the points along the fast axis, from the domain's centre
    y: Floats  # (2, cells) along the middle axis
    z: Floats  # (2, cells) along the slow axis
    weight: float  # w_p, nm^dim


class Room(NamedTuple):
    """Work space for one layer: of windows `rows` node rows, of the layer `cells` rows of cells."""

    Z: Floats  # (4 rows, width) sums along the slow axis: N and dN of point 0, of point 1
    Q: Floats  # (4 rows, width) what goes back along the slow axis
    Y: Floats  # (6, width) sums along the middle axis, p by p: value, derivatives along the middle and the slow axis
    F: Floats  # (8, width) of a row of points, p by p: source and flux along fast, middle, slow axis
    spans: Integers  # (rows, 2) packs of each row that hold anything
    sums: Floats  # (8 cells, P) S1, sum_(b != a) eta_a eta_b, S2, S3 of points 0 and of points 1
    swept: Floats  # (6 cells, P) v_adv along fast, middle, slow axis
    fields: Floats  # (12, 1) of one contact
    here: Floats  # (64, 4 LANES) order parameters at eight points
    particle: Integers  # (64,) whose they are


class Points(NamedTuple):
    """What the first half of an evaluation keeps for the second: rows of cells, p by p, layer by layer."""

    rho: Floats  # (2 layers cells, P)
    S2: Floats
    D: Floats


@lean
def along_slow(slopes: bool, Z: Floats, spans: Integers, y: Floats, w: int, k: int, L: Layout, T: Tables) -> None:
    """Z = sum_t N_t u of the planes that layer k sees, for both points; with dN, too, where slopes are wanted.

    spans become the packs of each row in which a node of these planes is in the window; elsewhere Z is 0.
    """
    ns, nm, nf = L.size[w, 0], L.size[w, 1], L.size[w, 2]
    taps = T.slow.shape[2]
    first = k - taps // 2 + 1 - L.low[w, 0]
    t0, t1 = max(0, -first), min(taps, ns - first)
    for r in range(nm):
        begin, end = nf, 0
        for t in range(t0, t1):
            row = L.row[w] + (first + t) * nm + r
            if L.end[row] > L.begin[row]:
                begin, end = min(begin, L.begin[row]), max(end, L.end[row])
        b = begin // LANES
        e = max(-(-end // LANES), b)
        spans[r, 0] = b
        spans[r, 1] = e
        at = L.offset[w] + ((first + t0) * nm + r) * nf
        if t1 - t0 == SIX:
            for q in range(b, e):
                sum_slow(slopes, Z, y, at, nm * nf, r, q, k, t0, SIX, T)
        else:
            for q in range(b, e):
                sum_slow(slopes, Z, y, at, nm * nf, r, q, k, t0, t1 - t0, T)
        for q in range(0, b):
            clear_pack(Z, r, q)
        for q in range(e, nf // LANES):
            clear_pack(Z, r, q)


@lean
def sum_slow(
    slopes: bool, Z: Floats, y: Floats, at: int, stride: int, r: int, q: int, k: int, t0: int, taps: int, T: Tables
) -> None:
    """One pack of `along_slow`: of taps t0 ... t0 + taps - 1, the first plane's row at y[at]."""
    rows = Z.shape[0] // 4
    a = splat(0.0)
    c = splat(0.0)
    da = splat(0.0)
    dc = splat(0.0)
    for t in range(taps):
        u = load(y, 0, at + t * stride + LANES * q)
        a = a + T.slow[0, k, t0 + t] * u
        c = c + T.slow[1, k, t0 + t] * u
        if slopes:
            da = da + T.d_slow[0, k, t0 + t] * u
            dc = dc + T.d_slow[1, k, t0 + t] * u
    store(Z, r, PAD + LANES * q, a)
    store(Z, 2 * rows + r, PAD + LANES * q, c)
    if slopes:
        store(Z, rows + r, PAD + LANES * q, da)
        store(Z, 3 * rows + r, PAD + LANES * q, dc)


@lean
def clear_pack(Z: Floats, r: int, q: int) -> None:
    """Set a pack of all four sums of a row to 0."""
    rows = Z.shape[0] // 4
    for f in range(4):
        store(Z, f * rows + r, PAD + LANES * q, splat(0.0))


@lean
def along_middle(
    slopes: bool, Y: Floats, Z: Floats, spans: Integers, w: int, j: int, p: int, L: Layout, T: Tables
) -> None:
    """Y of the row j of cells from Z of the rows of nodes that it sees; 0 two packs beyond what they hold."""
    taps = T.middle.shape[2]
    first = j - (taps - 1) // 2 - L.low[w, 1]
    t0, t1 = max(0, -first), min(taps, L.size[w, 1] - first)
    begin, end = L.size[w, 2], 0
    for r in range(first + t0, first + t1):
        if spans[r, 1] > spans[r, 0]:
            begin, end = min(begin, spans[r, 0]), max(end, spans[r, 1])
    if t1 - t0 == SIX:
        for q in range(begin, end):
            sum_middle(slopes, Y, Z, first + t0, q, j, p, t0, SIX, T)
    else:
        for q in range(begin, end):
            sum_middle(slopes, Y, Z, first + t0, q, j, p, t0, t1 - t0, T)
    if end > begin:
        for q in (begin - 2, begin - 1, end, end + 1):
            store(Y, 3 * p, PAD + LANES * q, splat(0.0))
            if slopes:
                store(Y, 3 * p + 1, PAD + LANES * q, splat(0.0))
                store(Y, 3 * p + 2, PAD + LANES * q, splat(0.0))


@lean
def sum_middle(
    slopes: bool, Y: Floats, Z: Floats, r: int, q: int, j: int, p: int, t0: int, taps: int, T: Tables
) -> None:
    """One pack of `along_middle`: of taps t0 ... t0 + taps - 1, the first one's row r."""
    rows = Z.shape[0] // 4
    value = splat(0.0)
    d_middle = splat(0.0)
    d_slow = splat(0.0)
    for t in range(taps):
        u = load(Z, 2 * p * rows + r + t, PAD + LANES * q)
        value = value + T.middle[p, j, t0 + t] * u
        if slopes:
            d_middle = d_middle + T.d_middle[p, j, t0 + t] * u
            d_slow = d_slow + T.middle[p, j, t0 + t] * load(Z, (2 * p + 1) * rows + r + t, PAD + LANES * q)
    store(Y, 3 * p, PAD + LANES * q, value)
    if slopes:
        store(Y, 3 * p + 1, PAD + LANES * q, d_middle)
        store(Y, 3 * p + 2, PAD + LANES * q, d_slow)


@lean
def inner(c: int, T: Tables) -> bool:
    """Whether the eight cells from c on have six taps each and see no wall: functions are alike there."""
    cells = T.fast.shape[1] - 2 * GHOSTS
    return T.inner.shape[1] == SIX and c >= SIX and c + LANES + SIX <= cells


@lean
def value_at(Y: Floats, q: int, c: int, p: int, T: Tables) -> Pack:
    """u_p of the eight cells from c on, which are places 8 q ... of Y."""
    taps = T.fast.shape[0] // 2
    at = PAD + LANES * q - taps // 2 + 1
    value = splat(0.0)
    if inner(c, T):
        for t in range(SIX):
            value = value + T.inner[p, t] * load(Y, 3 * p, at + t)
    else:
        for t in range(taps):
            value = value + load(T.fast, p * taps + t, GHOSTS + c) * load(Y, 3 * p, at + t)
    return value


@lean
def all_at(Y: Floats, q: int, c: int, p: int, T: Tables) -> tuple[Pack, Pack, Pack, Pack]:
    """u_p and its derivatives along fast, middle and slow axis."""
    taps = T.fast.shape[0] // 2
    at = PAD + LANES * q - taps // 2 + 1
    value = splat(0.0)
    d_fast = splat(0.0)
    d_middle = splat(0.0)
    d_slow = splat(0.0)
    if inner(c, T):
        for t in range(SIX):
            u = load(Y, 3 * p, at + t)
            value = value + T.inner[p, t] * u
            d_fast = d_fast + T.d_inner[p, t] * u
            d_slow = d_slow + T.inner[p, t] * load(Y, 3 * p + 2, at + t)
        if T.middle.shape[2] > 1:
            for t in range(SIX):
                d_middle = d_middle + T.inner[p, t] * load(Y, 3 * p + 1, at + t)
    else:
        for t in range(taps):
            N = load(T.fast, p * taps + t, GHOSTS + c)
            u = load(Y, 3 * p, at + t)
            value = value + N * u
            d_fast = d_fast + load(T.d_fast, p * taps + t, GHOSTS + c) * u
            d_middle = d_middle + N * load(Y, 3 * p + 1, at + t)
            d_slow = d_slow + N * load(Y, 3 * p + 2, at + t)
    return value, d_fast, d_middle, d_slow


@lean
def add_to(array: Floats, row: int, column: int, more: Pack) -> None:
    """Add to a pack in place."""
    store(array, row, column, load(array, row, column) + more)


@lean
def cells_of(w: int, k: int, j: int, L: Layout) -> tuple[int, int]:
    """Packs of the row j of layer k in which a cell has a corner in the window, counted as the window's places."""
    begin, end = 1 << 30, 0
    nm = L.size[w, 1]
    for s in range(max(0, k - L.low[w, 0]), min(L.size[w, 0], k - L.low[w, 0] + 2)):
        for m in range(max(0, j - L.low[w, 1]), min(nm, j - L.low[w, 1] + 2)):
            row = L.row[w] + s * nm + m
            begin, end = min(begin, int(L.begin[row])), max(end, int(L.end[row]))
    return max(begin - 1, 0) // LANES, -(-end // LANES)


@lean
def back(
    Q: Floats, F: Floats, spans: Integers, w: int, j: int, p: int, b: int, e: int, L: Layout, T: Tables
) -> None:
    """Q += what the row's packs b ... e - 1 of sources and fluxes give along the fast and the middle axis."""
    taps = T.middle.shape[2]
    first = j - (taps - 1) // 2 - L.low[w, 1]
    t0, t1 = max(0, -first), min(taps, L.size[w, 1] - first)
    for q in (b - 2, b - 1, e, e + 1):
        for f in range(4):
            store(F, 4 * p + f, PAD + LANES * q, splat(0.0))
    begin, end = e, b
    for r in range(first + t0, first + t1):
        if spans[r, 1] > spans[r, 0]:
            begin, end = min(begin, int(spans[r, 0])), max(end, int(spans[r, 1]))
    for q in range(max(begin, b - 1), min(end, e + 1)):
        source, middle, slow = back_fast(F, q, L.low[w, 2] + LANES * q, p, T)
        if t1 - t0 == SIX:
            back_middle(Q, source, middle, slow, first + t0, q, j, p, t0, SIX, T)
        else:
            back_middle(Q, source, middle, slow, first + t0, q, j, p, t0, t1 - t0, T)


@lean
def back_fast(F: Floats, q: int, node: int, p: int, T: Tables) -> tuple[Pack, Pack, Pack]:
    """What a row of points gives to eight nodes: as such, along the middle axis' slopes, along the slow axis'."""
    taps = T.fast.shape[0] // 2
    at = PAD + LANES * q + taps // 2 - 1
    source = splat(0.0)
    middle = splat(0.0)
    slow = splat(0.0)
    if inner(node, T):
        for t in range(SIX):
            source = source + T.inner[p, t] * load(F, 4 * p, at - t)
            source = source + T.d_inner[p, t] * load(F, 4 * p + 1, at - t)
            slow = slow + T.inner[p, t] * load(F, 4 * p + 3, at - t)
        if T.middle.shape[2] > 1:
            for t in range(SIX):
                middle = middle + T.inner[p, t] * load(F, 4 * p + 2, at - t)
    else:
        for t in range(taps):
            N = load(T.fast_back, p * taps + t, GHOSTS + node)
            source = source + N * load(F, 4 * p, at - t)
            source = source + load(T.d_fast_back, p * taps + t, GHOSTS + node) * load(F, 4 * p + 1, at - t)
            middle = middle + N * load(F, 4 * p + 2, at - t)
            slow = slow + N * load(F, 4 * p + 3, at - t)
    return source, middle, slow


@lean
def back_middle(
    Q: Floats, source: Pack, middle: Pack, slow: Pack, r: int, q: int, j: int, p: int, t0: int, taps: int, T: Tables
) -> None:
    """Add that to the rows of nodes r ..., of taps t0 ... t0 + taps - 1."""
    rows = Q.shape[0] // 4
    place = PAD + LANES * q
    for t in range(taps):
        N, dN = T.middle[p, j, t0 + t], T.d_middle[p, j, t0 + t]
        one, two = 2 * p * rows + r + t, (2 * p + 1) * rows + r + t
        store(Q, one, place, load(Q, one, place) + N * source + dN * middle)
        store(Q, two, place, load(Q, two, place) + N * slow)


@lean
def back_slow(rate: Floats, Q: Floats, spans: Integers, w: int, k: int, L: Layout, T: Tables) -> None:
    """rate += what Q gives to the planes of nodes that layer k sees."""
    ns, nm, nf = L.size[w, 0], L.size[w, 1], L.size[w, 2]
    taps = T.slow.shape[2]
    first = k - taps // 2 + 1 - L.low[w, 0]
    t0, t1 = max(0, -first), min(taps, ns - first)
    for r in range(nm):
        at = L.offset[w] + ((first + t0) * nm + r) * nf
        if t1 - t0 == SIX:
            for q in range(spans[r, 0], spans[r, 1]):
                give_slow(rate, Q, at, nm * nf, r, q, k, t0, SIX, T)
        else:
            for q in range(spans[r, 0], spans[r, 1]):
                give_slow(rate, Q, at, nm * nf, r, q, k, t0, t1 - t0, T)


@lean
def give_slow(
    rate: Floats, Q: Floats, at: int, stride: int, r: int, q: int, k: int, t0: int, taps: int, T: Tables
) -> None:
    """One pack of `back_slow`."""
    rows = Q.shape[0] // 4
    place = PAD + LANES * q
    a, da = load(Q, r, place), load(Q, rows + r, place)
    c, dc = load(Q, 2 * rows + r, place), load(Q, 3 * rows + r, place)
    for t in range(taps):
        node = at + t * stride + LANES * q
        given = load(rate, 0, node) + T.slow[0, k, t0 + t] * a
        given = given + T.d_slow[0, k, t0 + t] * da
        given = given + T.slow[1, k, t0 + t] * c
        store(rate, 0, node, given + T.d_slow[1, k, t0 + t] * dc)


@lean
def clear(Q: Floats, nm: int, nf: int) -> None:
    """Q = 0 for a window of that size."""
    for r in range(nm):
        for q in range(nf // LANES):
            clear_pack(Q, r, q)


@lean_jit
def potential(
    W: Floats, points: Points, found: Contacts, where: Floats, y: Floats, L: Layout, T: Tables, room: Room,
    m: Coefficients, rigid: bool, first_layer: int, layers: int, low: int, high: int,
) -> None:
    """First half of an evaluation, for the layers low ... high - 1: what `points` keeps, contacts, and the sums

    W_a += sum_p w_p [ N_a df/drho + kappa_rho grad N_a . grad rho_p ]   (24), before the 1/m_a, in rho's window.
    where (R, dim): positions of the contacts, as rows of `found`.
    """
    mode = flush_denormals()
    count = T.middle.shape[1]  # rows of cells in a layer
    w_p = T.weight
    for k in range(low, high):
        room.sums[:] = 0.0
        for i in range(L.first[k - first_layer], L.first[k - first_layer + 1]):
            w = L.window[i]
            add_sums(w, k, y, L, T, room)
        along_slow(True, room.Z, room.spans, y, RHO, k, L, T)
        clear(room.Q, L.size[0, 1], L.size[0, 2])
        for j in range(count):
            b, e = cells_of(RHO, k, j, L)
            for p in range(2):
                along_middle(True, room.Y, room.Z, room.spans, RHO, j, p, L, T)
            for p in range(2):
                kept = (p * layers + k - first_layer) * count + j
                touching = False
                for q in range(b, e):
                    c = L.low[0, 2] + LANES * q
                    at = GHOSTS + c
                    rho, d_fast, d_middle, d_slow = all_at(room.Y, q, c, p, T)
                    overlap = load(room.sums, (2 + p) * count + j, at)
                    S2 = load(room.sums, (4 + p) * count + j, at)
                    S3 = load(room.sums, (6 + p) * count + j, at)
                    store(points.rho, kept, at, rho)
                    store(points.S2, kept, at, S2)
                    store(points.D, kept, at, mobility(rho, overlap, m))
                    place = PAD + LANES * q
                    store(room.F, 4 * p, place, w_p * df_drho(rho, S2, S3, m))
                    store(room.F, 4 * p + 1, place, (w_p * m.kappa_rho) * d_fast)
                    store(room.F, 4 * p + 2, place, (w_p * m.kappa_rho) * d_middle)
                    store(room.F, 4 * p + 3, place, (w_p * m.kappa_rho) * d_slow)
                    if rigid and total(positive(overlap - m.c)) > 0.0:
                        touching = True
                if touching:
                    meet_row(found, where, points, y, kept, k, j, p, first_layer, L, T, room, m)
            for p in range(2):
                back(room.Q, room.F, room.spans, RHO, j, p, b, e, L, T)
        back_slow(W, room.Q, room.spans, RHO, k, L, T)
    restore_denormals(mode)


@lean
def add_sums(w: int, k: int, y: Floats, L: Layout, T: Tables, room: Room) -> None:
    """Add one order parameter to the sums of a layer's points."""
    count = T.middle.shape[1]
    along_slow(False, room.Z, room.spans, y, w, k, L, T)
    for j in range(max(0, L.low[w, 1] - 1), min(count, L.low[w, 1] + L.size[w, 1])):
        b, e = cells_of(w, k, j, L)
        if e <= b:
            continue
        for p in range(2):
            along_middle(False, room.Y, room.Z, room.spans, w, j, p, L, T)
        for p in range(2):
            for q in range(b, e):
                c = L.low[w, 2] + LANES * q
                at = GHOSTS + c
                eta = value_at(room.Y, q, c, p, T)
                inside = positive(eta)
                S1 = load(room.sums, p * count + j, at)
                overlap = load(room.sums, (2 + p) * count + j, at)
                store(room.sums, (2 + p) * count + j, at, overlap + 2.0 * inside * S1)
                store(room.sums, p * count + j, at, S1 + inside)
                add_to(room.sums, (4 + p) * count + j, at, eta * eta)
                add_to(room.sums, (6 + p) * count + j, at, eta * eta * eta)


@lean_jit
def meet_row(
    found: Contacts, where: Floats, points: Points, y: Floats, kept: int, k: int, j: int, p: int, first_layer: int,
    L: Layout, T: Tables, room: Room, m: Coefficients,
) -> None:
    """Add the contacts at the points p of a row of cells, where the sum of eta_a eta_b says that there may be some."""
    count = T.middle.shape[1]
    dim = where.shape[1]
    width = 1 + dim
    fields, here, particle = room.fields, room.here, room.particle
    b, e = cells_of(RHO, k, j, L)
    for q in range(b, e):
        c = L.low[0, 2] + LANES * q
        if not total(positive(load(room.sums, (2 + p) * count + j, GHOSTS + c) - m.c)) > 0.0:
            continue
        seen = ZERO
        for i in range(L.first[k - first_layer], L.first[k - first_layer + 1]):
            w = L.window[i]
            if (
                seen < len(particle) and L.low[w, 1] <= j + 1 and j < L.low[w, 1] + L.size[w, 1]
                and L.low[w, 2] <= c < L.low[w, 2] + L.size[w, 2] and is_near(y, w, k, j, c, L, FAR * m.c)
            ):  # fmt: skip
                particle[seen] = w - 1
                eight(here, seen, y, w, k, j, p, c, L, T)
                seen += 1
        for lane in range(LANES):
            for one in range(seen):
                for two in range(one + 1, seen):
                    if here[one, lane] > 0.0 and here[one, lane] * here[two, lane] > FAR * m.c:
                        fields[0, 0] = points.rho[kept, GHOSTS + c + lane]
                        for f in range(width):
                            fields[width + f, 0] = here[one, f * LANES + lane]
                            fields[2 * width + f, 0] = here[two, f * LANES + lane]
                        r = found.number[0]
                        add_contact(
                            found, fields, 0, 0, width, 0, 2 * width, 0, particle[one], particle[two], r, T.weight, m.c
                        )
                        if found.number[0] > r and r < len(where):
                            where[r, 0] = T.x[p, GHOSTS + c + lane]
                            where[r, 1] = T.z[p, k] if dim == 2 else T.y[p, j]
                            where[r, dim - 1] = T.z[p, k]


@lean
def is_near(y: Floats, w: int, k: int, j: int, c: int, L: Layout, least: float) -> bool:
    """Whether eta is at least a quarter of `least` at some corner of eight cells: else it is less than that inside."""
    nm, nf = L.size[w, 1], L.size[w, 2]
    for s in range(max(0, k - L.low[w, 0]), min(L.size[w, 0], k - L.low[w, 0] + 2)):
        for r in range(max(0, j - L.low[w, 1]), min(nm, j - L.low[w, 1] + 2)):
            at = L.offset[w] + (s * nm + r) * nf + c - L.low[w, 2]
            if total(positive(load(y, 0, at) - 0.25 * least)) > 0.0:
                return True
            if total(positive(load(y, 0, at + 1) - 0.25 * least)) > 0.0:
                return True
    return False


@lean
def eight(here: Floats, row: int, y: Floats, w: int, k: int, j: int, p: int, c: int, L: Layout, T: Tables) -> None:
    """One order parameter at eight points straight from its nodes: value, and derivatives along x, y[, z], packs of
    here[row]. The packs of all windows begin at the same cells."""
    ns, nm, nf = L.size[w, 0], L.size[w, 1], L.size[w, 2]
    slow_taps, taps, fast_taps = T.slow.shape[2], T.middle.shape[2], T.fast.shape[0] // 2
    first, first_row = k - slow_taps // 2 + 1 - L.low[w, 0], j - (taps - 1) // 2 - L.low[w, 1]
    left = c - L.low[w, 2] - fast_taps // 2 + 1
    value = splat(0.0)
    d_fast = splat(0.0)
    d_middle = splat(0.0)
    d_slow = splat(0.0)
    is_inner = inner(c, T)
    for t in range(max(0, -first), min(slow_taps, ns - first)):
        for s in range(max(0, -first_row), min(taps, nm - first_row)):
            at = L.offset[w] + ((first + t) * nm + first_row + s) * nf + left
            u = splat(0.0)
            du = splat(0.0)
            if is_inner:
                for f in range(SIX):
                    v = load(y, 0, at + f)
                    u = u + T.inner[p, f] * v
                    du = du + T.d_inner[p, f] * v
            else:
                for f in range(fast_taps):
                    v = load(y, 0, at + f)
                    u = u + load(T.fast, p * fast_taps + f, GHOSTS + c) * v
                    du = du + load(T.d_fast, p * fast_taps + f, GHOSTS + c) * v
            N, dN = T.slow[p, k, t], T.d_slow[p, k, t]
            M, dM = T.middle[p, j, s], T.d_middle[p, j, s]
            value = value + (N * M) * u
            d_fast = d_fast + (N * M) * du
            d_middle = d_middle + (N * dM) * u
            d_slow = d_slow + (dN * M) * u
    store(here, row, 0, value)
    store(here, row, LANES, d_fast)
    if taps == 1:
        store(here, row, 2 * LANES, d_slow)
    else:
        store(here, row, 2 * LANES, d_middle)
        store(here, row, 3 * LANES, d_slow)


@lean_jit
def divergence(
    rate: Floats, points: Points, W: Floats, motion: Floats, y: Floats, L: Layout, T: Tables, room: Room,
    m: Coefficients, rigid: bool, huang: bool, first_layer: int, layers: int, low: int, high: int,
) -> None:
    """Second half: the sums of (20) and (21) over the points of the layers, before the 1/m_a.

    rate rho_a += sum_p w_p [ -D grad N_a . grad W_p + rho_p grad N_a . v_adv ]
    rate eta_a += sum_p w_p [ -L N_a df/deta + grad N_a . ( -L kappa_eta grad eta_p + eta_p v_a ) ]
    motion (particles, 6): V_a(x) = v + omega x x, and v_a = V_a eta_a.
    """
    mode = flush_denormals()
    count = T.middle.shape[1]
    w_p = T.weight
    for k in range(low, high):
        if rigid:
            room.swept[:] = 0.0
        for i in range(L.first[k - first_layer], L.first[k - first_layer + 1]):
            change(L.window[i], k, rate, points, motion, y, L, T, room, m, rigid, huang, first_layer, layers)
        along_slow(True, room.Z, room.spans, W, RHO, k, L, T)
        clear(room.Q, L.size[0, 1], L.size[0, 2])
        for j in range(count):
            b, e = cells_of(RHO, k, j, L)
            for p in range(2):
                along_middle(True, room.Y, room.Z, room.spans, RHO, j, p, L, T)
            for p in range(2):
                kept = (p * layers + k - first_layer) * count + j
                for q in range(b, e):
                    c = L.low[0, 2] + LANES * q
                    at = GHOSTS + c
                    _, fast, middle, slow = all_at(room.Y, q, c, p, T)
                    D = load(points.D, kept, at)
                    fast = splat(0.0) - D * fast
                    middle = splat(0.0) - D * middle
                    slow = splat(0.0) - D * slow
                    if rigid:
                        rho = load(points.rho, kept, at)
                        fast = fast + rho * load(room.swept, p * count + j, at)
                        middle = middle + rho * load(room.swept, (2 + p) * count + j, at)
                        slow = slow + rho * load(room.swept, (4 + p) * count + j, at)
                    place = PAD + LANES * q
                    store(room.F, 4 * p, place, splat(0.0))
                    store(room.F, 4 * p + 1, place, w_p * fast)
                    store(room.F, 4 * p + 2, place, w_p * middle)
                    store(room.F, 4 * p + 3, place, w_p * slow)
            for p in range(2):
                back(room.Q, room.F, room.spans, RHO, j, p, b, e, L, T)
        back_slow(rate, room.Q, room.spans, RHO, k, L, T)
    restore_denormals(mode)


@lean
def change(
    w: int, k: int, rate: Floats, points: Points, motion: Floats, y: Floats, L: Layout, T: Tables, room: Room,
    m: Coefficients, rigid: bool, huang: bool, first_layer: int, layers: int,
) -> None:
    """The part of `divergence` for one order parameter in one layer; adds what it sweeps along to `room.swept`."""
    count = T.middle.shape[1]
    plane = T.middle.shape[2] == 1
    w_p = T.weight
    a = w - 1
    spread = -m.L * m.kappa_eta * w_p
    along_slow(True, room.Z, room.spans, y, w, k, L, T)
    clear(room.Q, L.size[w, 1], L.size[w, 2])
    for j in range(max(0, L.low[w, 1] - 1), min(count, L.low[w, 1] + L.size[w, 1])):
        b, e = cells_of(w, k, j, L)
        if e <= b:
            continue
        for p in range(2):
            along_middle(True, room.Y, room.Z, room.spans, w, j, p, L, T)
        for p in range(2):
            kept = (p * layers + k - first_layer) * count + j
            height, depth = (T.z[p, k], 0.0) if plane else (T.y[p, j], T.z[p, k])
            v_x = motion[a, 0] + motion[a, 4] * depth - motion[a, 5] * height
            for q in range(b, e):
                c = L.low[w, 2] + LANES * q
                at = GHOSTS + c
                eta, fast, middle, slow = all_at(room.Y, q, c, p, T)
                rho, S2 = load(points.rho, kept, at), load(points.S2, kept, at)
                fast = spread * fast
                middle = spread * middle
                slow = spread * slow
                if rigid:
                    x = load(T.x, p, at)
                    v_y = (motion[a, 1] - motion[a, 3] * depth) + motion[a, 5] * x
                    v_z = (motion[a, 2] + motion[a, 3] * height) - motion[a, 4] * x
                    swept = eta * eta if huang else eta
                    square = w_p * eta * eta
                    fast = fast + square * v_x
                    add_to(room.swept, p * count + j, at, swept * v_x)
                    if plane:
                        slow = slow + square * v_y
                        add_to(room.swept, (4 + p) * count + j, at, swept * v_y)
                    else:
                        middle = middle + square * v_y
                        slow = slow + square * v_z
                        add_to(room.swept, (2 + p) * count + j, at, swept * v_y)
                        add_to(room.swept, (4 + p) * count + j, at, swept * v_z)
                place = PAD + LANES * q
                store(room.F, 4 * p, place, (-m.L * w_p) * df_deta(eta, rho, S2, m))
                store(room.F, 4 * p + 1, place, fast)
                store(room.F, 4 * p + 2, place, middle)
                store(room.F, 4 * p + 3, place, slow)
        for p in range(2):
            back(room.Q, room.F, room.spans, w, j, p, b, e, L, T)
    back_slow(rate, room.Q, room.spans, w, k, L, T)


@lean
def below(w: int, s: int, r: int, L: Layout) -> int:
    """Where in rho's window the first place of a row of another window is."""
    z, x = L.low[w, 0] + s - L.low[0, 0], L.low[w, 2] - L.low[0, 2]
    return int((z * L.size[0, 1] + L.low[w, 1] + r) * L.size[0, 2] + x)


@lean_jit
def divide(rate: Floats, inverse_mass: Floats, L: Layout, first: int, last: int) -> None:
    """rate /= m_a at the nodes of windows first ... last - 1, and 0 elsewhere in their boxes."""
    mode = flush_denormals()
    for w in range(first, last):
        ns, nm, nf = L.size[w, 0], L.size[w, 1], L.size[w, 2]
        for s in range(ns):
            for r in range(nm):
                row = L.row[w] + s * nm + r
                at = L.offset[w] + (s * nm + r) * nf
                node = below(w, s, r, L)
                begin, end = min(L.begin[row], nf), max(L.end[row], 0)
                for i in range(begin):
                    rate[0, at + i] = 0.0
                for i in range(begin, end):
                    rate[0, at + i] *= inverse_mass[node + i]
                for i in range(max(begin, end), nf):
                    rate[0, at + i] = 0.0
    restore_denormals(mode)


@lean_jit
def add_moments(
    moments: Floats, y: Floats, L: Layout, slow: Floats, middle: Floats, fast: Floats, first: int, last: int
) -> None:
    """moments[a] += sum_b (m_b, q_b) eta_b over the planes first ... last - 1: V_a and int r eta_a, exactly.

    slow, middle, fast (2, 2, n): the sums over an axis' points of N and of x N at its nodes, the weights in `slow`.
    """
    dim = moments.shape[1] - 1
    for w in range(1, len(L.low)):
        nm, nf = L.size[w, 1], L.size[w, 2]
        for s in range(L.size[w, 0]):
            z = L.low[w, 0] + s
            if z < first or z >= last:
                continue
            for r in range(nm):
                row, m = L.row[w] + s * nm + r, L.low[w, 1] + r
                at = L.offset[w] + (s * nm + r) * nf
                for p in range(2):
                    volume = 0.0
                    moment = 0.0
                    for i in range(L.begin[row], L.end[row]):
                        eta = y[0, at + i]
                        volume += fast[0, p, L.low[w, 2] + i] * eta
                        moment += fast[1, p, L.low[w, 2] + i] * eta
                    moments[w - 1, 0] += slow[0, p, z] * middle[0, p, m] * volume
                    moments[w - 1, 1] += slow[0, p, z] * middle[0, p, m] * moment
                    if dim == 3:
                        moments[w - 1, 2] += slow[0, p, z] * middle[1, p, m] * volume
                    moments[w - 1, dim] += slow[1, p, z] * middle[0, p, m] * volume


@lean_jit
def energy(
    y: Floats, L: Layout, T: Tables, room: Room, m: Coefficients, eps_rho: float, eps_eta: float,
    first_layer: int, low: int, high: int,
) -> tuple[float, float, float, float]:
    """F (1) of the layers, the number of points where |grad rho| >= eps_rho or a |grad eta| >= eps_eta, and the least
    and the largest rho at a point."""
    mode = flush_denormals()
    count = T.middle.shape[1]
    F, live, least, largest = 0.0, 0.0, np.inf, -np.inf
    for k in range(low, high):
        room.sums[:] = 0.0
        for i in range(L.first[k - first_layer], L.first[k - first_layer + 1]):
            w = L.window[i]
            along_slow(True, room.Z, room.spans, y, w, k, L, T)
            for j in range(max(0, L.low[w, 1] - 1), min(count, L.low[w, 1] + L.size[w, 1])):
                b, e = cells_of(w, k, j, L)
                for p in range(2):
                    along_middle(True, room.Y, room.Z, room.spans, w, j, p, L, T)
                for p in range(2):
                    for q in range(b, e):
                        c = L.low[w, 2] + LANES * q
                        eta, x, v, z = all_at(room.Y, q, c, p, T)
                        at, square = GHOSTS + c, x * x + v * v + z * z
                        for f, more in ((0, square), (4, eta * eta), (6, eta * eta * eta)):
                            add_to(room.sums, (f + p) * count + j, at, more)
                        steep = load(room.sums, (2 + p) * count + j, at) + positive(square - eps_eta * eps_eta)
                        store(room.sums, (2 + p) * count + j, at, steep)
        along_slow(True, room.Z, room.spans, y, RHO, k, L, T)
        for j in range(count):
            b, e = cells_of(RHO, k, j, L)
            for p in range(2):
                along_middle(True, room.Y, room.Z, room.spans, RHO, j, p, L, T)
            for p in range(2):
                for q in range(b, e):
                    c = L.low[0, 2] + LANES * q
                    at = GHOSTS + c
                    rho, x, v, z = all_at(room.Y, q, c, p, T)
                    square = x * x + v * v + z * z
                    S2, S3 = load(room.sums, (4 + p) * count + j, at), load(room.sums, (6 + p) * count + j, at)
                    density = free_energy_density(rho, S2, S3, m) + 0.5 * m.kappa_rho * square
                    density = density + 0.5 * m.kappa_eta * load(room.sums, p * count + j, at)
                    steep = load(room.sums, (2 + p) * count + j, at) + positive(square - eps_rho * eps_rho)
                    store(room.F, 0, PAD, density)
                    store(room.F, 1, PAD, steep)
                    store(room.F, 2, PAD, rho)
                    for lane in range(LANES):
                        if 0 <= c + lane < T.fast.shape[1] - 2 * GHOSTS:
                            F += T.weight * room.F[0, PAD + lane]
                            live += room.F[1, PAD + lane] > 0.0
                            least = min(least, room.F[2, PAD + lane])
                            largest = max(largest, room.F[2, PAD + lane])
    restore_denormals(mode)
    return F, live, least, largest


@lean_jit
def add_squares(y: Floats, L: Layout, first: int, last: int) -> float:
    """sum y^2 over the nodes on the planes first ... last - 1."""
    whole = 0.0
    for w in range(len(L.low)):
        nm, nf = L.size[w, 1], L.size[w, 2]
        for s in range(max(0, first - L.low[w, 0]), min(L.size[w, 0], last - L.low[w, 0])):
            at = L.offset[w] + s * nm * nf
            for value in y[at : at + nm * nf]:
                whole += value * value
    return whole


@lean_jit
def step_error(
    sums: Floats, new: Floats, old: Floats, rate_1: Floats, rate_0: Floats, dt: float, tolerance: float,
    inverse_mass: Floats, L: Layout, first: int, last: int,
) -> None:
    """sums = sum_a m_a sum_fields (e / (tolerance (1 + |u|)))^2, sum_a m_a over the nodes on planes first ... last - 1;

    e = 0.8 (y_n - y_{n+1}) + 0.4 dt (F_n + F_{n+1}).
    """
    sums[:] = 0.0
    for w in range(len(L.low)):
        nm, nf = L.size[w, 1], L.size[w, 2]
        for s in range(max(0, first - L.low[w, 0]), min(L.size[w, 0], last - L.low[w, 0])):
            for r in range(nm):
                row = L.row[w] + s * nm + r
                if L.end[row] <= L.begin[row]:
                    continue
                at = L.offset[w] + (s * nm + r) * nf
                node = below(w, s, r, L)
                square = 0.0
                volume = 0.0
                for i in range(L.begin[row], L.end[row]):
                    u_0, u_1 = old[at + i], new[at + i]
                    e = 0.8 * (u_0 - u_1) + 0.4 * dt * (rate_0[at + i] + rate_1[at + i])
                    e = e / (tolerance * (1.0 + abs(u_1)))
                    m = 1.0 / inverse_mass[node + i]
                    square += m * e * e
                    volume += m
                sums[0] += square
                if w == 0:
                    sums[1] += volume


@lean_jit
def extremes(found: Floats, values: Floats, layers: int, count: int, cells: int, edges: Floats) -> None:
    """found = least value, largest, largest next to a wall of `Points.rho`, and 1 where one is not a number.

    edges (2,): whether the rank's first and last layer are at a wall; count: rows of cells in a layer.
    """
    for p in range(2):
        for k in range(layers):
            for j in range(count):
                row = values[(p * layers + k) * count + j]
                wall = (k == 0 and edges[0] > 0.0) or (k == layers - 1 and edges[1] > 0.0)
                wall |= count > 1 and (j == 0 or j == count - 1)
                for i in range(GHOSTS, GHOSTS + cells):
                    value = row[i]
                    if value != value:
                        found[3] = 1.0
                    found[0] = min(found[0], value)
                    if wall or i == GHOSTS or i == GHOSTS + cells - 1:
                        found[2] = max(found[2], value)
                    else:
                        found[1] = max(found[1], value)
