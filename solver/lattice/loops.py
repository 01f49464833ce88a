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
from ..jit import lean, lean_jit
from ..simd import (
    LANES,
    Pack,
    fetch,
    flush_denormals,
    from_lane,
    get,
    load,
    place,
    positive,
    put,
    restore_denormals,
    splat,
    store,
    total,
)
from .axis import GHOSTS as GHOSTS
from .windows import Layout

PAD = 24  # places on both sides of a row of work space
SIX = 6  # taps of the default functions: loops of that length are unrolled
RHO = cast(int, np.int32(0))  # rho's window, of the type that others have: a literal 0 would be compiled once more


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
    inner: Floats  # (2, 1, taps) N along the fast axis far from walls
    d_inner: Floats
    x: Floats  # (2, cells + ghosts) position of the points along the fast axis, from the domain's centre; see `column`
    y: Floats  # (2, cells) along the middle axis
    z: Floats  # (2, cells) along the slow axis
    weight: float  # w_p, nm^dim


class Room(NamedTuple):
    """Work space for one layer: of windows `rows` node rows, of the layer `cells` rows of cells."""

    Z: Floats  # (4 rows, width) sums along the slow axis: N and dN of point 0, of point 1
    Q: Floats  # (4 rows, width) what goes back along the slow axis
    Y: Floats  # (3, width) sums along the middle axis: value, derivatives along the middle and the slow axis
    F: Floats  # (4, width) of a row of points: source and flux along fast, middle, slow axis
    nothing: Floats  # (1, width) zeros, in the place of rows that a window does not have
    waste: Floats  # (1, width) what goes back to such rows
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


class Rows(NamedTuple):
    """Addresses of a row's place 0: of what is summed along the fast axis for values and derivatives."""

    value: int
    middle: int
    slow: int


Six = tuple[Pack, Pack, Pack, Pack, Pack, Pack]  # functions in registers
BYTES = 8  # of a number
PACK = BYTES * LANES


@lean
def six(table: Floats, p: int, k: int, t: int) -> Six:
    """The functions of taps t ... t + 5, each in every lane."""
    return (
        splat(table[p, k, t]), splat(table[p, k, t + 1]), splat(table[p, k, t + 2]),
        splat(table[p, k, t + 3]), splat(table[p, k, t + 4]), splat(table[p, k, t + 5]),
    )  # fmt: skip


@lean
def dot(N: Six, u: Six) -> Pack:
    """The sum over six taps."""
    return N[0] * u[0] + N[1] * u[1] + N[2] * u[2] + N[3] * u[3] + N[4] * u[4] + N[5] * u[5]


@lean
def plane(array: Floats, w: int, s: int, L: Layout, instead: Floats) -> tuple[int, int]:
    """Where the window's plane s begins, and the bytes from row to row; without such a plane the row `instead`."""
    if 0 <= s < L.size[w, 0]:
        return place(array, 0, L.offset[w] + s * L.size[w, 1] * L.size[w, 2]), BYTES * L.size[w, 2]
    return place(instead, 0, PAD), 0


@lean
def row_of(array: Floats, f: int, r: int, nm: int, instead: Floats) -> int:
    """Where row r of the f-th of four arrays begins; without such a row `instead`."""
    return place(array, f * (array.shape[0] // 4) + r, PAD) if 0 <= r < nm else place(instead, 0, PAD)


@lean
def along_slow(slopes: bool, y: Floats, w: int, k: int, L: Layout, T: Tables, room: Room) -> tuple[int, int]:
    """Z = sum_t N_t u of the planes that layer k sees, for both points; with dN, too, where slopes are wanted.

    Z is 0 beside a row's span, as far as any other's reaches, which is returned.
    """
    Z, spans = room.Z, L.spans
    rows = Z.shape[0] // 4
    nm = L.size[w, 1]
    taps = T.slow.shape[2]
    first = k - taps // 2 + 1 - L.low[w, 0]
    seen = L.span[w] + (k - L.layer[w]) * nm
    B, E = L.size[w, 2] // LANES, 0
    for r in range(nm):
        if spans[seen + r, 1] > spans[seen + r, 0]:
            B, E = min(B, int(spans[seen + r, 0])), max(E, int(spans[seen + r, 1]))
    for t in range(0, taps, SIX):
        at0, step0 = plane(y, w, first + t, L, room.nothing)
        at1, step1 = plane(y, w, first + t + 1, L, room.nothing)
        at2, step2 = plane(y, w, first + t + 2, L, room.nothing)
        at3, step3 = plane(y, w, first + t + 3, L, room.nothing)
        at4, step4 = plane(y, w, first + t + 4, L, room.nothing)
        at5, step5 = plane(y, w, first + t + 5, L, room.nothing)
        N, M = six(T.slow, 0, k, t), six(T.slow, 1, k, t)
        dN, dM = six(T.d_slow, 0, k, t), six(T.d_slow, 1, k, t)
        for r in range(nm):
            to0, to1 = place(Z, r, PAD), place(Z, rows + r, PAD)
            to2, to3 = place(Z, 2 * rows + r, PAD), place(Z, 3 * rows + r, PAD)
            for o in range(PACK * spans[seen + r, 0], PACK * spans[seen + r, 1], PACK):
                u = (
                    get(at0 + r * step0 + o), get(at1 + r * step1 + o), get(at2 + r * step2 + o),
                    get(at3 + r * step3 + o), get(at4 + r * step4 + o), get(at5 + r * step5 + o),
                )  # fmt: skip
                fetch(at5 + (r + 2) * step5 + o)
                keep(to0 + o, dot(N, u), t)
                keep(to2 + o, dot(M, u), t)
                if slopes:
                    keep(to1 + o, dot(dN, u), t)
                    keep(to3 + o, dot(dM, u), t)
    for r in range(nm):
        clear_four(Z, r, B - 2, min(spans[seen + r, 0], E + 2))
        clear_four(Z, r, max(B - 2, spans[seen + r, 1]), E + 2)
    return B, E


@lean
def keep(at: int, sums: Pack, t: int) -> None:
    """Write the sums over the first taps, add those over more."""
    put(at, sums if t == 0 else get(at) + sums)


@lean
def clear_four(array: Floats, r: int, first: int, last: int) -> None:
    """Set packs first ... last - 1 of row r to 0 in four arrays."""
    rows = array.shape[0] // 4
    one, two = place(array, r, PAD), place(array, rows + r, PAD)
    three, four = place(array, 2 * rows + r, PAD), place(array, 3 * rows + r, PAD)
    for o in range(PACK * first, PACK * last, PACK):
        put(one + o, splat(0.0))
        put(two + o, splat(0.0))
        put(three + o, splat(0.0))
        put(four + o, splat(0.0))


@lean
def along_middle(slopes: bool, w: int, k: int, j: int, p: int, L: Layout, T: Tables, room: Room) -> Rows:
    """The sums along the middle axis for the row j of cells, of the rows of nodes that it sees.

    They are 0 two packs beyond what they hold. In the plane there is no such axis, and Z is all.
    """
    Z, Y, nm = room.Z, room.Y, L.size[w, 1]
    taps = T.middle.shape[2]
    if taps == 1:
        value = row_of(Z, 2 * p, 0, nm, room.nothing)
        return Rows(value, value, row_of(Z, 2 * p + 1, 0, nm, room.nothing))
    first = j - taps // 2 + 1 - L.low[w, 1]
    cells = row_of_cells(w, k, j, L, T)
    begin, end = int(L.cells[cells, 2]), int(L.cells[cells, 3])
    to = Rows(place(Y, 0, PAD), place(Y, 1, PAD), place(Y, 2, PAD))
    for t in range(0, taps, SIX):
        r = first + t
        a0, d0 = row_of(Z, 2 * p, r, nm, room.nothing), row_of(Z, 2 * p + 1, r, nm, room.nothing)
        a1, d1 = row_of(Z, 2 * p, r + 1, nm, room.nothing), row_of(Z, 2 * p + 1, r + 1, nm, room.nothing)
        a2, d2 = row_of(Z, 2 * p, r + 2, nm, room.nothing), row_of(Z, 2 * p + 1, r + 2, nm, room.nothing)
        a3, d3 = row_of(Z, 2 * p, r + 3, nm, room.nothing), row_of(Z, 2 * p + 1, r + 3, nm, room.nothing)
        a4, d4 = row_of(Z, 2 * p, r + 4, nm, room.nothing), row_of(Z, 2 * p + 1, r + 4, nm, room.nothing)
        a5, d5 = row_of(Z, 2 * p, r + 5, nm, room.nothing), row_of(Z, 2 * p + 1, r + 5, nm, room.nothing)
        N, dN = six(T.middle, p, j, t), six(T.d_middle, p, j, t)
        for o in range(PACK * begin, PACK * end, PACK):
            u = get(a0 + o), get(a1 + o), get(a2 + o), get(a3 + o), get(a4 + o), get(a5 + o)
            keep(to.value + o, dot(N, u), t)
            if slopes:
                keep(to.middle + o, dot(dN, u), t)
                v = get(d0 + o), get(d1 + o), get(d2 + o), get(d3 + o), get(d4 + o), get(d5 + o)
                keep(to.slow + o, dot(N, v), t)
    for at in to:
        clear_beside(at, begin, end)
    return to


@lean
def clear_beside(at: int, begin: int, end: int) -> None:
    """Set two packs on either side of packs begin ... end - 1 of a row to 0."""
    put(at + PACK * (begin - 2), splat(0.0))
    put(at + PACK * (begin - 1), splat(0.0))
    put(at + PACK * end, splat(0.0))
    put(at + PACK * (end + 1), splat(0.0))


@lean
def column(c: int, T: Tables) -> int:
    """Where cell c is in rows of points: so that packs, which begin `reach` nodes before a whole one, lie in lines."""
    return int(GHOSTS + T.fast.shape[0] // 4 + c)


@lean
def inner(c: int, T: Tables) -> bool:
    """Whether the eight cells from c on have six taps each and see no wall: functions are alike there."""
    cells = T.fast.shape[1] - 2 * GHOSTS
    return T.inner.shape[2] == SIX and c >= SIX and c + LANES + SIX <= cells


@lean_jit
def sum_taps(u: int, step: int, N: int, row: int, taps: int) -> Pack:
    """sum_t N_t u_t; u: the address of the first, step: the bytes to the next; N and row: likewise."""
    value = splat(0.0)
    for t in range(taps):
        value = value + get(N + t * row) * get(u + t * step)
    return value


@lean
def ahead(at: int) -> Six:
    """The packs that begin 2, 1 places before the address, there, and 1, 2, 3 behind it."""
    left, here, right = get(at - PACK), get(at), get(at + PACK)
    return (
        from_lane(left, here, 6), from_lane(left, here, 7), here,
        from_lane(here, right, 1), from_lane(here, right, 2), from_lane(here, right, 3),
    )  # fmt: skip


@lean
def behind(at: int) -> Six:
    """The packs that begin 2, 1 places behind the address, there, and 1, 2, 3 before it."""
    left, here, right = get(at - PACK), get(at), get(at + PACK)
    return (
        from_lane(here, right, 2), from_lane(here, right, 1), here,
        from_lane(left, here, 7), from_lane(left, here, 6), from_lane(left, here, 5),
    )  # fmt: skip


@lean
def value_at(u: int, c: int, p: int, N: Six, T: Tables) -> Pack:
    """u_p of the eight cells from c on; u: the address of theirs, N: of the functions far from walls."""
    taps = T.fast.shape[0] // 2
    at = u - BYTES * (taps // 2 - 1)
    if inner(c, T):
        return dot(N, ahead(u))
    return sum_taps(at, BYTES, place(T.fast, p * taps, GHOSTS + c), BYTES * T.fast.shape[1], taps)


@lean
def all_at(u: Rows, o: int, c: int, p: int, N: Six, dN: Six, T: Tables) -> tuple[Pack, Pack, Pack, Pack]:
    """u_p and its derivatives along fast, middle and slow axis, o bytes from the beginning of the rows."""
    taps = T.fast.shape[0] // 2
    first = o - BYTES * (taps // 2 - 1)
    space = T.middle.shape[2] > 1
    middle = splat(0.0)
    if inner(c, T):
        values = ahead(u.value + o)
        if space:
            middle = dot(N, ahead(u.middle + o))
        return dot(N, values), dot(dN, values), middle, dot(N, ahead(u.slow + o))
    row = BYTES * T.fast.shape[1]
    N_c, dN_c = place(T.fast, p * taps, GHOSTS + c), place(T.d_fast, p * taps, GHOSTS + c)
    value = sum_taps(u.value + first, BYTES, N_c, row, taps)
    fast = sum_taps(u.value + first, BYTES, dN_c, row, taps)
    if space:
        middle = sum_taps(u.middle + first, BYTES, N_c, row, taps)
    return value, fast, middle, sum_taps(u.slow + first, BYTES, N_c, row, taps)


@lean
def add_to(array: Floats, row: int, column: int, more: Pack) -> None:
    """Add to a pack in place."""
    store(array, row, column, load(array, row, column) + more)


@lean
def row_of_cells(w: int, k: int, j: int, L: Layout, T: Tables) -> int:
    """Which row of `Layout.cells` the row j of layer k has."""
    m = j - L.low[w, 1] + 1 if T.middle.shape[2] > 1 else 0
    return int(L.cell[w] + (k - L.layer[w]) * (L.size[w, 1] + 1) + m)


@lean
def cells_of(w: int, k: int, j: int, L: Layout, T: Tables) -> tuple[int, int]:
    """Packs of the row j of layer k in which a cell has a corner in the window, counted as the window's places."""
    row = row_of_cells(w, k, j, L, T)
    return int(L.cells[row, 0]), int(L.cells[row, 1])


@lean
def back(w: int, k: int, j: int, p: int, b: int, e: int, L: Layout, T: Tables, room: Room) -> None:
    """Q += what the row's packs b ... e - 1 of sources and fluxes give along the fast and the middle axis."""
    Q, F, nm = room.Q, room.F, L.size[w, 1]
    taps = T.middle.shape[2]
    first = j - (taps - 1) // 2 - L.low[w, 1]
    cells = row_of_cells(w, k, j, L, T)
    begin, end = max(int(L.cells[cells, 2]), b - 1), min(int(L.cells[cells, 3]), e + 1)
    for f in range(4):
        clear_beside(place(F, f, PAD), b, e)
    N, dN = six(T.inner, p, 0, 0), six(T.d_inner, p, 0, 0)
    if taps == 1:
        one, two = row_of(Q, 2 * p, 0, nm, room.waste), row_of(Q, 2 * p + 1, 0, nm, room.waste)
        for q in range(begin, end):
            source, _, slow = back_fast(F, q, L.low[w, 2] + LANES * q, p, N, dN, T)
            put(one + PACK * q, source)
            put(two + PACK * q, slow)
        return
    for t in range(0, taps, SIX):
        r = first + t
        a0, d0 = row_of(Q, 2 * p, r, nm, room.waste), row_of(Q, 2 * p + 1, r, nm, room.waste)
        a1, d1 = row_of(Q, 2 * p, r + 1, nm, room.waste), row_of(Q, 2 * p + 1, r + 1, nm, room.waste)
        a2, d2 = row_of(Q, 2 * p, r + 2, nm, room.waste), row_of(Q, 2 * p + 1, r + 2, nm, room.waste)
        a3, d3 = row_of(Q, 2 * p, r + 3, nm, room.waste), row_of(Q, 2 * p + 1, r + 3, nm, room.waste)
        a4, d4 = row_of(Q, 2 * p, r + 4, nm, room.waste), row_of(Q, 2 * p + 1, r + 4, nm, room.waste)
        a5, d5 = row_of(Q, 2 * p, r + 5, nm, room.waste), row_of(Q, 2 * p + 1, r + 5, nm, room.waste)
        M, dM = six(T.middle, p, j, t), six(T.d_middle, p, j, t)
        for q in range(begin, end):
            source, middle, slow = back_fast(F, q, L.low[w, 2] + LANES * q, p, N, dN, T)
            o = PACK * q
            more(a0 + o, M[0] * source + dM[0] * middle)
            more(a1 + o, M[1] * source + dM[1] * middle)
            more(a2 + o, M[2] * source + dM[2] * middle)
            more(a3 + o, M[3] * source + dM[3] * middle)
            more(a4 + o, M[4] * source + dM[4] * middle)
            more(a5 + o, M[5] * source + dM[5] * middle)
            more(d0 + o, M[0] * slow)
            more(d1 + o, M[1] * slow)
            more(d2 + o, M[2] * slow)
            more(d3 + o, M[3] * slow)
            more(d4 + o, M[4] * slow)
            more(d5 + o, M[5] * slow)


@lean
def more(at: int, sums: Pack) -> None:
    """Add to a pack in place."""
    put(at, get(at) + sums)


@lean
def back_fast(F: Floats, q: int, node: int, p: int, N: Six, dN: Six, T: Tables) -> tuple[Pack, Pack, Pack]:
    """What a row of points gives to eight nodes: as such, along the middle axis' slopes, along the slow axis'."""
    taps = T.fast.shape[0] // 2
    at = PAD + LANES * q + taps // 2 - 1
    space = T.middle.shape[2] > 1
    middle = splat(0.0)
    if inner(node, T):
        here = PAD + LANES * q
        source = dot(N, behind(place(F, 0, here))) + dot(dN, behind(place(F, 1, here)))
        if space:
            middle = dot(N, behind(place(F, 2, here)))
        return source, middle, dot(N, behind(place(F, 3, here)))
    row = BYTES * T.fast_back.shape[1]
    N_i, dN_i = place(T.fast_back, p * taps, GHOSTS + node), place(T.d_fast_back, p * taps, GHOSTS + node)
    source = sum_taps(place(F, 0, at), -BYTES, N_i, row, taps) + sum_taps(place(F, 1, at), -BYTES, dN_i, row, taps)
    if space:
        middle = sum_taps(place(F, 2, at), -BYTES, N_i, row, taps)
    return source, middle, sum_taps(place(F, 3, at), -BYTES, N_i, row, taps)


@lean
def back_slow(rate: Floats, w: int, k: int, L: Layout, T: Tables, room: Room) -> None:
    """rate += what Q gives to the planes of nodes that layer k sees."""
    Q, spans = room.Q, L.spans
    rows = Q.shape[0] // 4
    seen = L.span[w] + (k - L.layer[w]) * L.size[w, 1]
    taps = T.slow.shape[2]
    first = k - taps // 2 + 1 - L.low[w, 0]
    for t in range(0, taps, SIX):
        at0, step0 = plane(rate, w, first + t, L, room.waste)
        at1, step1 = plane(rate, w, first + t + 1, L, room.waste)
        at2, step2 = plane(rate, w, first + t + 2, L, room.waste)
        at3, step3 = plane(rate, w, first + t + 3, L, room.waste)
        at4, step4 = plane(rate, w, first + t + 4, L, room.waste)
        at5, step5 = plane(rate, w, first + t + 5, L, room.waste)
        N, M = six(T.slow, 0, k, t), six(T.slow, 1, k, t)
        dN, dM = six(T.d_slow, 0, k, t), six(T.d_slow, 1, k, t)
        for r in range(L.size[w, 1]):
            of0, of1 = place(Q, r, PAD), place(Q, rows + r, PAD)
            of2, of3 = place(Q, 2 * rows + r, PAD), place(Q, 3 * rows + r, PAD)
            for o in range(PACK * spans[seen + r, 0], PACK * spans[seen + r, 1], PACK):
                fetch(at5 + (r + 2) * step5 + o)
                a, da, b, db = get(of0 + o), get(of1 + o), get(of2 + o), get(of3 + o)
                more(at0 + r * step0 + o, N[0] * a + dN[0] * da + M[0] * b + dM[0] * db)
                more(at1 + r * step1 + o, N[1] * a + dN[1] * da + M[1] * b + dM[1] * db)
                more(at2 + r * step2 + o, N[2] * a + dN[2] * da + M[2] * b + dM[2] * db)
                more(at3 + r * step3 + o, N[3] * a + dN[3] * da + M[3] * b + dM[3] * db)
                more(at4 + r * step4 + o, N[4] * a + dN[4] * da + M[4] * b + dM[4] * db)
                more(at5 + r * step5 + o, N[5] * a + dN[5] * da + M[5] * b + dM[5] * db)


@lean
def clear_all(array: Floats, nm: int, first: int, last: int) -> None:
    """Set packs first ... last - 1 of all rows of four arrays to 0."""
    for r in range(nm):
        clear_four(array, r, first, last)


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
        B, E = along_slow(True, y, RHO, k, L, T, room)
        clear_all(room.Q, L.size[0, 1], B, E)
        for j in range(count):
            b, e = cells_of(RHO, k, j, L, T)
            for p in range(2):
                kept = (p * layers + k - first_layer) * count + j
                u = along_middle(True, RHO, k, j, p, L, T, room)
                N, dN = six(T.inner, p, 0, 0), six(T.d_inner, p, 0, 0)
                touching = splat(0.0)
                for q in range(b, e):
                    c = L.low[0, 2] + LANES * q
                    at = column(c, T)
                    rho, d_fast, d_middle, d_slow = all_at(u, PACK * q, c, p, N, dN, T)
                    overlap = load(room.sums, (2 + p) * count + j, at)
                    S2 = load(room.sums, (4 + p) * count + j, at)
                    S3 = load(room.sums, (6 + p) * count + j, at)
                    store(points.rho, kept, at, rho)
                    store(points.S2, kept, at, S2)
                    store(points.D, kept, at, mobility(rho, overlap, m))
                    store(room.F, 0, PAD + LANES * q, w_p * df_drho(rho, S2, S3, m))
                    store(room.F, 1, PAD + LANES * q, (w_p * m.kappa_rho) * d_fast)
                    store(room.F, 2, PAD + LANES * q, (w_p * m.kappa_rho) * d_middle)
                    store(room.F, 3, PAD + LANES * q, (w_p * m.kappa_rho) * d_slow)
                    touching = touching + positive(overlap - m.c)
                if rigid and total(touching) > 0.0:
                    meet_row(found, where, points, y, kept, k, j, p, first_layer, L, T, room, m)
                back(RHO, k, j, p, b, e, L, T, room)
        back_slow(W, RHO, k, L, T, room)
    restore_denormals(mode)


@lean
def add_sums(w: int, k: int, y: Floats, L: Layout, T: Tables, room: Room) -> None:
    """Add one order parameter to the sums of a layer's points."""
    count = T.middle.shape[1]
    along_slow(False, y, w, k, L, T, room)
    for j in range(max(0, L.low[w, 1] - 1), min(count, L.low[w, 1] + L.size[w, 1])):
        b, e = cells_of(w, k, j, L, T)
        if e <= b:
            continue
        for p in range(2):
            u = along_middle(False, w, k, j, p, L, T, room).value
            N = six(T.inner, p, 0, 0)
            for q in range(b, e):
                c = L.low[w, 2] + LANES * q
                at = column(c, T)
                eta = value_at(u + PACK * q, c, p, N, T)
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
    b, e = cells_of(RHO, k, j, L, T)
    for q in range(b, e):
        c = L.low[0, 2] + LANES * q
        if not total(positive(load(room.sums, (2 + p) * count + j, column(c, T)) - m.c)) > 0.0:
            continue
        seen = np.int64(0)  # a literal would be compiled once more
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
                        fields[0, 0] = points.rho[kept, column(c, T) + lane]
                        for f in range(width):
                            fields[width + f, 0] = here[one, f * LANES + lane]
                            fields[2 * width + f, 0] = here[two, f * LANES + lane]
                        r = found.number[0]
                        add_contact(
                            found, fields, 0, 0, width, 0, 2 * width, 0, particle[one], particle[two], r, T.weight, m.c
                        )
                        if found.number[0] > r and r < len(where):
                            where[r, 0] = T.x[p, column(c, T) + lane]
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
                    u = u + T.inner[p, 0, f] * v
                    du = du + T.d_inner[p, 0, f] * v
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
        B, E = along_slow(True, W, RHO, k, L, T, room)
        clear_all(room.Q, L.size[0, 1], B, E)
        for j in range(count):
            b, e = cells_of(RHO, k, j, L, T)
            for p in range(2):
                kept = (p * layers + k - first_layer) * count + j
                u = along_middle(True, RHO, k, j, p, L, T, room)
                N, dN = six(T.inner, p, 0, 0), six(T.d_inner, p, 0, 0)
                for q in range(b, e):
                    c = L.low[0, 2] + LANES * q
                    at = column(c, T)
                    _, fast, middle, slow = all_at(u, PACK * q, c, p, N, dN, T)
                    D = load(points.D, kept, at)
                    fast = splat(0.0) - D * fast
                    middle = splat(0.0) - D * middle
                    slow = splat(0.0) - D * slow
                    if rigid:
                        rho = load(points.rho, kept, at)
                        fast = fast + rho * load(room.swept, p * count + j, at)
                        middle = middle + rho * load(room.swept, (2 + p) * count + j, at)
                        slow = slow + rho * load(room.swept, (4 + p) * count + j, at)
                    store(room.F, 0, PAD + LANES * q, splat(0.0))
                    store(room.F, 1, PAD + LANES * q, w_p * fast)
                    store(room.F, 2, PAD + LANES * q, w_p * middle)
                    store(room.F, 3, PAD + LANES * q, w_p * slow)
                back(RHO, k, j, p, b, e, L, T, room)
        back_slow(rate, RHO, k, L, T, room)
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
    B, E = along_slow(True, y, w, k, L, T, room)
    clear_all(room.Q, L.size[w, 1], B, E)
    for j in range(max(0, L.low[w, 1] - 1), min(count, L.low[w, 1] + L.size[w, 1])):
        b, e = cells_of(w, k, j, L, T)
        if e <= b:
            continue
        for p in range(2):
            kept = (p * layers + k - first_layer) * count + j
            u = along_middle(True, w, k, j, p, L, T, room)
            N, dN = six(T.inner, p, 0, 0), six(T.d_inner, p, 0, 0)
            height, depth = (T.z[p, k], 0.0) if plane else (T.y[p, j], T.z[p, k])
            v_x = motion[a, 0] + motion[a, 4] * depth - motion[a, 5] * height
            for q in range(b, e):
                c = L.low[w, 2] + LANES * q
                at = column(c, T)
                eta, fast, middle, slow = all_at(u, PACK * q, c, p, N, dN, T)
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
                store(room.F, 0, PAD + LANES * q, (-m.L * w_p) * df_deta(eta, rho, S2, m))
                store(room.F, 1, PAD + LANES * q, fast)
                store(room.F, 2, PAD + LANES * q, middle)
                store(room.F, 3, PAD + LANES * q, slow)
            back(w, k, j, p, b, e, L, T, room)
    back_slow(rate, w, k, L, T, room)


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
            along_slow(True, y, w, k, L, T, room)
            for j in range(max(0, L.low[w, 1] - 1), min(count, L.low[w, 1] + L.size[w, 1])):
                b, e = cells_of(w, k, j, L, T)
                for p in range(2):
                    u = along_middle(True, w, k, j, p, L, T, room)
                    N, dN = six(T.inner, p, 0, 0), six(T.d_inner, p, 0, 0)
                    for q in range(b, e):
                        c = L.low[w, 2] + LANES * q
                        eta, x, v, z = all_at(u, PACK * q, c, p, N, dN, T)
                        at, square = column(c, T), x * x + v * v + z * z
                        for f, more in ((0, square), (4, eta * eta), (6, eta * eta * eta)):
                            add_to(room.sums, (f + p) * count + j, at, more)
                        steep = load(room.sums, (2 + p) * count + j, at) + positive(square - eps_eta * eps_eta)
                        store(room.sums, (2 + p) * count + j, at, steep)
        along_slow(True, y, RHO, k, L, T, room)
        for j in range(count):
            b, e = cells_of(RHO, k, j, L, T)
            for p in range(2):
                u = along_middle(True, RHO, k, j, p, L, T, room)
                N, dN = six(T.inner, p, 0, 0), six(T.d_inner, p, 0, 0)
                for q in range(b, e):
                    c = L.low[0, 2] + LANES * q
                    at = column(c, T)
                    rho, x, v, z = all_at(u, PACK * q, c, p, N, dN, T)
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
def extremes(found: Floats, values: Floats, layers: int, count: int, first: int, cells: int, edges: Floats) -> None:
    """found = least value, largest, largest next to a wall of `Points.rho`, and 1 where one is not a number.

    edges (2,): whether the rank's first and last layer are at a wall; count: rows of cells in a layer; first: column of
    the first cell.
    """
    for p in range(2):
        for k in range(layers):
            for j in range(count):
                row = values[(p * layers + k) * count + j]
                wall = (k == 0 and edges[0] > 0.0) or (k == layers - 1 and edges[1] > 0.0)
                wall |= count > 1 and (j == 0 or j == count - 1)
                for i in range(first, first + cells):
                    value = row[i]
                    if value != value:
                        found[3] = 1.0
                    found[0] = min(found[0], value)
                    if wall or i == first or i == first + cells - 1:
                        found[2] = max(found[2], value)
                    else:
                        found[1] = max(found[1], value)
