"""Rows of points that look alike: on a lattice eight neighbouring points see eight neighbouring nodes.

Points of one lattice row have the same shape functions, and where nodes are numbered along x the next point sees the
next nodes. Eight such points make a block, one lane of a pack each: an entry of the table then serves all eight, and a
field's values at their eight nodes lie side by side. What a block costs depends on the fields that exist there, not on
the columns that all particles of the case need.

Near the walls at the ends of x points have no such neighbours, but along y they do: `find_upright` numbers the nodes
that they see along y, for blocks of their own. Points without either (in corners, on other meshes) are loose.
"""

from dataclasses import dataclass, replace

import numpy as np

from .arrays import Bytes, Flags, Floats, Integers, Numbers
from .jit import jit
from .shape import ShapeTable
from .simd import LANES

NONE = np.empty(0, dtype=np.int64)
MIXED = -2  # in `LiveBlocks.particle`: not one particle in all lanes


@dataclass(frozen=True)
class Blocks:
    """Lane j of block b is points[b, j], -1: nothing is there. The first lane's nodes are nodes[begin[b] + i]."""

    points: Numbers  # (b, LANES)
    begin: Integers  # (b,) into `nodes`
    count: Integers  # (b,) of them
    start: Integers  # (b,) column of the shape table
    x: Floats  # (3 b, LANES) row 3 b + k: component k of the points' places, 0 along an axis that is not there
    border: Flags  # (b,) whether its points see a node that another rank holds, too
    nodes: Numbers  # those of the shape table; where `at` is not empty, their places in it
    at: Integers  # the nodes that the points see, one after the other along y; empty: all nodes in their own order
    loose: Integers  # points in no block, those that see such a node first
    loose_border: int  # how many of them do


    @property
    def seen(self) -> Integers | slice:
        """The nodes that the points see, as an index of arrays of nodes."""
        return self.at if self.at.size else slice(None)


@dataclass(frozen=True)
class LiveBlocks:
    """The blocks with live points, and the fields that exist there.

    Block blocks[l] has the entries first[l] ... first[l + 1] - 1: rho, and each order parameter that exists in one of
    its lanes.
    """

    blocks: Integers  # (L,) the first `border` of them lie there: see `Blocks.border`
    border: int
    weights: Floats  # (L, LANES) w_p of the live points, else 0
    first: Integers  # (L + 1,)
    column: Numbers  # (E,) column of u
    particle: Numbers  # (E,) the particle of all lanes; -1: rho, MIXED: see owner
    owner: Numbers  # (E, LANES) the particle in each lane, -1: it does not exist there
    partial: Flags  # (E,) whether it is missing in a lane


def find_blocks(table: ShapeTable, x: Floats, shared: Flags) -> Blocks:
    """The blocks of a rank's points at x (p, dim) along x; shared (n,): nodes that other ranks hold, too."""
    border = np.zeros(table.points, dtype=bool)
    see(border, shared, table.offsets, table.nodes)
    return _group(np.arange(table.points), table.offsets, table.nodes, table.rows, x, border, NONE)


def find_upright(table: ShapeTable, x: Floats, positions: Floats, along: Blocks) -> Blocks:
    """The blocks along y of the points that are loose in those along x; positions (n, dim) of the nodes."""
    chosen = np.sort(along.loose)
    offsets = np.append(0, np.cumsum(table.offsets[chosen + 1] - table.offsets[chosen]))
    nodes = np.empty(int(offsets[-1]), dtype=np.int32)
    copy_lists(nodes, offsets, chosen, table.offsets, table.nodes)
    seen = np.zeros(len(positions), dtype=bool)
    seen[nodes] = True
    at = np.flatnonzero(seen)
    at = at[np.lexsort(_up(positions[at], _period(x[chosen], table.rows[chosen])))]
    number = np.full(len(positions), -1, dtype=np.int32)
    number[at] = np.arange(at.size)
    border = np.isin(chosen, along.loose[: along.loose_border])
    found = _group(chosen, offsets, number[nodes], table.rows[chosen], x, border, at)
    begin = np.append(0, np.cumsum(found.count))
    kept = np.empty(int(begin[-1]), dtype=np.int32)
    copy_lists(kept, begin, np.arange(found.begin.size), found.begin, found.nodes)
    return replace(found, nodes=kept, begin=begin[:-1])


def _period(x: Floats, rows: Integers) -> float:
    """The distance along y at which points at x (p, dim) of the same row of the table repeat."""
    across = np.round(np.delete(x, 1, axis=1), 6)  # what is equal may differ by round-off
    order = np.lexsort((x[:, 1], *across.T, rows))
    same = (rows[order[1:]] == rows[order[:-1]]) & (across[order[1:]] == across[order[:-1]]).all(axis=1)
    return float(np.diff(x[order, 1])[same].min(initial=np.inf))


def _up(positions: Floats, period: float) -> tuple[Floats, ...]:
    """Keys, the first one last, that bring nodes a period apart along y next to each other."""
    across = np.round(np.delete(positions, 1, axis=1), 6)
    phase = np.round(positions[:, 1] / period % 1.0, 4) % 1.0
    return positions[:, 1], phase, *across.T


def _group(
    chosen: Integers, offsets: Integers, nodes: Numbers, rows: Integers, x: Floats, border: Flags, at: Integers
) -> Blocks:
    """The blocks of the chosen points, in the order of their first; offsets, rows and border have an entry for each."""
    if chosen.size == 0:
        no = np.empty(0, dtype=bool)
        return Blocks(np.empty((0, LANES), np.int32), NONE, NONE, NONE, np.empty((0, LANES)), no, nodes, at, NONE, 0)
    order = np.lexsort((nodes[offsets[:-1]], rows)).astype(np.int64)
    place = np.empty(chosen.size, dtype=np.int64)
    number_rows(place, order, offsets, nodes, rows)
    ends = np.flatnonzero(np.append(place[1:] % LANES == 0, True))
    starts = np.append(0, ends[:-1] + 1)
    keep = ends > starts  # a block with one point gains nothing
    starts, lengths = starts[keep], (ends - starts)[keep] + 1
    lanes = starts[:, None] + np.arange(LANES)
    inside = np.arange(LANES) < lengths[:, None]
    lanes = np.where(inside, order[np.minimum(lanes, order.size - 1)], -1)
    lanes = lanes[np.argsort(lanes[:, 0], kind="stable")]
    blocked = np.zeros(chosen.size, dtype=bool)
    blocked[lanes[lanes >= 0]] = True
    first = lanes[:, 0]
    points = np.where(lanes >= 0, chosen[lanes], -1).astype(np.int32)
    places = np.zeros((len(points), 3, LANES))
    places[:, : x.shape[1]] = np.where((points >= 0)[:, None], x[points].transpose(0, 2, 1), 0.0)
    return Blocks(
        points,
        offsets[first],
        offsets[first + 1] - offsets[first],
        rows[first],
        places.reshape(-1, LANES),
        np.asarray((border[lanes] & (lanes >= 0)).any(axis=1)),
        nodes,
        at,
        np.concatenate([chosen[~blocked & border], chosen[~blocked & ~border]]),
        int((~blocked & border).sum()),
    )


@jit
def copy_lists(result: Numbers, begin: Integers, chosen: Integers, offsets: Integers, nodes: Numbers) -> None:
    """result[begin[i]] ... become the nodes of point chosen[i]."""
    for i in range(chosen.size):
        for k in range(begin[i + 1] - begin[i]):
            result[begin[i] + k] = nodes[offsets[chosen[i]] + k]


@jit
def see(border: Flags, shared: Flags, offsets: Integers, nodes: Numbers) -> None:
    """border[p]: whether point p sees a shared node."""
    for p in range(border.size):
        for e in range(offsets[p], offsets[p + 1]):
            if shared[nodes[e]]:
                border[p] = True
                break


@jit
def number_rows(place: Integers, order: Integers, offsets: Integers, nodes: Numbers, rows: Integers) -> None:
    """place[i]: how far point order[i] is along its row of points whose nodes follow one another."""
    place[0] = 0
    for i in range(1, order.size):
        p = order[i - 1]
        q = order[i]
        follows = rows[p] == rows[q]
        if follows:
            for k in range(offsets[p + 1] - offsets[p]):
                if nodes[offsets[q] + k] != nodes[offsets[p] + k] + 1:
                    follows = False
                    break
        place[i] = place[i - 1] + 1 if follows else 0


def live_blocks(blocks: Blocks, flags: Numbers, owner: Numbers, weights: Floats) -> LiveBlocks:
    """The blocks in which flags (p,) mark a live point; owner (p, slots) as `active.activate` settles it."""
    chosen = np.flatnonzero(((flags[blocks.points] != 0) & (blocks.points >= 0)).any(axis=1))
    border = blocks.border[chosen]
    chosen = np.concatenate([chosen[border], chosen[~border]])
    first = np.zeros(chosen.size + 1, dtype=np.int64)
    slots = np.zeros((chosen.size, owner.shape[1]), dtype=np.int8)
    count_entries(first, slots, chosen, blocks.points, flags, owner)
    np.cumsum(first, out=first)
    entries = int(first[-1])
    live = LiveBlocks(
        chosen,
        int(border.sum()),
        np.zeros((chosen.size, LANES)),
        first,
        np.zeros(entries, dtype=np.int32),
        np.full(entries, -1, dtype=np.int32),
        np.full((entries, LANES), -1, dtype=np.int32),
        np.zeros(entries, dtype=bool),
    )
    fill_entries(
        live.weights, live.column, live.particle, live.owner, live.partial,
        first, slots, chosen, blocks.points, flags, owner, weights,
    )
    return live


@jit
def count_entries(
    first: Integers, slots: Bytes, chosen: Integers, points: Numbers, flags: Numbers, owner: Numbers
) -> None:
    """first[l + 1]: the entries of block chosen[l]; slots[l, s] = 1 where one of its live points has slot s."""
    for l in range(chosen.size):
        first[l + 1] = 1
        for j in range(points.shape[1]):
            p = points[chosen[l], j]
            if p < 0 or not flags[p]:
                continue
            for s in range(owner.shape[1]):
                if owner[p, s] >= 0 and not slots[l, s]:
                    slots[l, s] = 1
                    first[l + 1] += 1


@jit
def fill_entries(
    weights: Floats, column: Numbers, particle: Numbers, entry_owner: Numbers, partial: Flags,
    first: Integers, slots: Bytes, chosen: Integers, points: Numbers, flags: Numbers, owner: Numbers, w: Floats,
) -> None:
    """Fill the arrays of `LiveBlocks`; rho's entries stand at their defaults."""
    for l in range(chosen.size):
        e = first[l]
        for j in range(points.shape[1]):
            p = points[chosen[l], j]
            weights[l, j] = w[p] if p >= 0 and flags[p] else 0.0
        for s in range(owner.shape[1]):
            if not slots[l, s]:
                continue
            e += 1
            column[e] = 1 + s
            for j in range(points.shape[1]):
                p = points[chosen[l], j]
                a = owner[p, s] if p >= 0 and flags[p] else np.int32(-1)
                entry_owner[e, j] = a
                if a < 0:
                    partial[e] = True
                elif particle[e] == -1:
                    particle[e] = a
                elif particle[e] != a:
                    particle[e] = MIXED
