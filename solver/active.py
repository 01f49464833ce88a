"""Where something happens: live material points, the slots that exist there, and what the still ones owe.

A point is live where |grad rho| >= eps_rho or any |grad eta| >= eps_eta (section 2.4). Switching a point off must not
change its neighbours: it shares nodes with live points, and those nodes need its part of W (24) and of the advection
(20), (21). Both are computed once, when the set is made, and hold as long as the shared nodal values stand still.
`Active.stale` watches exactly those values; the set is made anew when one has moved by `run.LAG` eps.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import block_kernels, kernels, slots, unknowns, vectors
from .arrays import Array, Bytes, Flags, Floats, Integers, Numbers
from .block_kernels import SMALLEST
from .blocks import Blocks, LiveBlocks, live_blocks
from .discretisation import FIXED_WORK, WORTH, Discretisation
from .rigid import rotations
from .simd import LANES
from .state import State, width
from .unknowns import Unknowns

LEAST = 1.0  # eps_eta: an order parameter exists at a point where it or its gradient (per nm) is at least this
SLOT_EPS = 0.2  # eps_eta: unit in which an order parameter's growth is measured where it does not exist yet


@dataclass(frozen=True)
class Active:
    """The live points and their surroundings at one moment; arrays over this rank's points and nodes."""

    live: Integers  # numbers of the live points
    blocks: LiveBlocks  # those of them that are in blocks along x
    upright: LiveBlocks  # those that are in blocks along y
    loose: Integers  # (L,) numbers of those that are in neither, the first `loose_border` at the rank's border
    loose_border: int
    owner: Numbers  # (L, slots) particle of each slot at the loose points, -1: none
    mask: Floats  # (L, F) 1 for rho and the slots that exist at the loose points, else 0
    present: Flags  # (L, F / LANES) packs of columns that hold anything
    several: Flags  # (L,) points that see more than one particle
    nodes: Integers  # nodes that a live point of any rank touches: the only ones that change
    unknowns: Unknowns  # the fields that exist there
    pairs: Integers  # (pairs, 2) particles a < b that a live point of any rank sees together
    potential: Floats  # (n,) what this rank's still points owe to W, times m_a
    edge_nodes: Integers  # nodes between live points and a particle's still interior
    edge_particle: Numbers  # that particle
    drift: Floats  # (edges, 2, dim + rotations) what still points owe to the advection there
    moments: Floats  # (particles, 1 + dim) int eta, int r eta over the owned nodes that stand still
    reference: Floats  # (y,) the fields when the set was made
    watch: Floats  # (y,) 1 / eps where their change decides whether the set still holds, else 0

    def work(self) -> float:
        """What an evaluation costs on this rank, in units of one field of one block.

        A loose point takes twice that for each pack: its sums wait for each other, and fields that are not there count.
        """
        blocks = sum(FIXED_WORK * live.blocks.size + live.column.size for live in (self.blocks, self.upright))
        return float(blocks + 2.0 * (FIXED_WORK * self.loose.size + self.present.sum()))

    def stale(self, y: Floats) -> float:
        """Largest movement of a watched value, in units of its eps; `run.LAG` says when it is too much."""
        return float(vectors.largest_change(y, self.reference, self.watch))


Room = Callable[[int, int], Floats]  # work space of so many rows and columns, valid until the next is asked for


def activate(d: Discretisation, state: State, room: Room) -> Active:
    """Make the set for the state. A particle's order parameter is set to zero at nodes that no point sees where it
    exists (`LEAST`), and slots are moved where particles that shared one have come close. Collective; the result does
    not depend on the number of ranks.
    """
    flags, owner, pairs = _settle(d, state, room)
    if _worth(d, flags):
        pairs = None  # those at live points alone are wanted
    else:
        flags[:] = 1
    table = d.shape
    low = np.full(d.nodes, np.iinfo(np.int32).max, dtype=np.int64)
    high = np.full(d.nodes, -1, dtype=np.int64)
    kernels.interiors(low, high, flags, owner, state.u, table.offsets, table.nodes, table.rows, table.table)
    _spread(d, low, high)
    kernels.switch_on(flags, low < high, table.offsets, table.nodes)
    live = np.flatnonzero(flags)
    loose = d.upright.loose[flags[d.upright.loose] != 0]
    mask = np.zeros((loose.size, state.u.shape[1]))
    mask[:, 0] = 1.0
    mask[:, 1 : 1 + owner.shape[1]] = owner[loose] >= 0
    moving, resting = _touched(d, flags != 0), _touched(d, flags == 0)
    edge_nodes = np.flatnonzero(moving & resting & (high >= 0))
    potential, drift = _still_shares(d, state, flags, owner, edge_nodes, high)
    blocks, upright = (live_blocks(some, flags, owner, d.weights) for some in (d.blocks, d.upright))
    kind = np.where(d.share.halo.owned, unknowns.OWNED, 0)
    kind |= unknowns.BLOCKS if blocks.blocks.size or upright.blocks.size else 0
    by_itself = np.zeros(d.shape.points, dtype=bool)
    by_itself[loose] = True
    kind[_seen_by(d, by_itself) != 0] |= unknowns.LOOSE
    kind[edge_nodes] |= unknowns.LOOSE
    moved, rest = (unknowns.lay_out(np.flatnonzero(s), state.owner, kind, d.share.halo) for s in (moving, ~moving))
    moments = np.zeros((len(state.slot_of), 1 + d.dim))
    unknowns.add_moments(moments, rest.take(state.u), d.mass, d.first_moment, rest.strips)
    return Active(
        live=live,
        blocks=blocks,
        upright=upright,
        loose=loose,
        loose_border=int((flags[d.upright.loose[: d.upright.loose_border]] != 0).sum()),
        owner=owner[loose],
        mask=mask,
        present=(mask != 0.0).reshape(loose.size, mask.shape[1] // LANES, LANES).any(axis=2),
        several=mask.sum(axis=1) > 2.0,
        nodes=np.flatnonzero(moving),
        unknowns=moved,
        pairs=_everyones_pairs(d, slots.meeting(owner, live)) if pairs is None else pairs,
        potential=potential,
        edge_nodes=edge_nodes,
        edge_particle=high[edge_nodes].astype(np.int32),
        drift=drift,
        moments=moments,
        reference=moved.take(state.u),
        watch=_watch(d, flags, owner, state.owner, moved, [blocks, upright], loose),
    )


def _worth(d: Discretisation, flags: Numbers) -> bool:
    """Whether so many points of all ranks can rest that resting pays. Collective."""
    counts = d.share.ranks.sum(np.array([flags.sum(), flags.size], dtype=np.float64))
    return bool(counts[0] <= WORTH * counts[1])


def _settle(d: Discretisation, state: State, room: Room) -> tuple[Numbers, Numbers, Integers | None]:
    """Flags and slot owners of the points, once every particle has its slot to itself wherever a live point looks; and
    the pairs of particles that meet at any point of any rank, where somebody asked.

    Particles that clash move to other slots until none does. What has been seen to meet stays known, so this ends.
    Where the particles then need fewer packs of slots than there are, all are dealt out anew.
    """
    known = np.empty((0, 2), dtype=np.int64)
    compact, points = True, d.shape.points
    flags = np.zeros(points, dtype=np.int32)
    owner = np.full((points, state.owner.shape[1]), -1, dtype=np.int32)
    clash = np.full((points, 2), -1, dtype=np.int64)
    changed = np.ones(d.nodes, dtype=bool)  # nodes whose values or owners a point has not been asked about yet
    while True:
        columns, those = state.u.shape[1], owner.shape[1]
        work = room(columns + 2 * those, d.nodes + LANES)
        owners = work[columns:].reshape(2, those, -1)
        _sense(d, state, flags, owner, clash, changed, owners, work[:columns])
        if not d.case.activation.enabled:
            flags[:] = 1
        if not d.case.activation.few_order_parameters:
            owner[:] = np.arange(owner.shape[1], dtype=np.int32)
            return flags, owner, None
        claims, clashes = _claim(d, owner, clash, owners)
        clashes = _everyones_pairs(d, clashes)
        meet, fewer = None, False
        if compact and state.u.shape[1] > LANES:
            meet = _everyones_pairs(d, slots.meeting(owner, np.arange(points)))
            fewer = width(int(slots.colour(meet, len(state.slot_of)).max()) + 1) < state.u.shape[1]
        if len(clashes) or fewer:
            every = np.arange(d.nodes)
            seen = [known, clashes, slots.meeting(claims, every), slots.meeting(state.owner, every)]
            known = _everyones_pairs(d, np.concatenate(seen))
        slot_of = state.slot_of
        if len(clashes):
            slot_of = slots.recolour(slot_of, known)
            if width(int(slot_of.max()) + 1) > state.u.shape[1]:
                slot_of = slots.colour(known, len(slot_of))
        elif fewer:
            slot_of = slots.colour(known, len(slot_of))
            compact = False
        columns = width(int(slot_of.max()) + 1)
        if not len(clashes) and columns >= state.u.shape[1]:
            state.owner = claims
            state.eta[claims < 0] = 0.0
            return flags, owner, meet
        before, state.slot_of = state.owner, slot_of
        state.u, state.owner = slots.repack(state.u, state.owner, slot_of, columns)
        if state.owner.shape == before.shape:
            changed = (state.owner != before).any(axis=1)
        else:
            changed = np.ones(d.nodes, dtype=bool)
            owner = np.full((points, state.owner.shape[1]), -1, dtype=np.int32)


def _claim(d: Discretisation, owner: Numbers, clash: Integers, owners: Floats) -> tuple[Numbers, Integers]:
    """The owners of the nodes' slots, with one ring of room, and the pairs of particles that want the same slot.

    owners: work space, as for `_sense`.
    """
    near, table = d.nearest, d.shape
    high, low = owners
    high[:], low[:] = -1.0, block_kernels.NOBODY
    for blocks in (d.blocks, d.upright):
        largest, smallest = _numbered(high, blocks), _numbered(low, blocks)
        block_kernels.claim(
            largest, smallest, owner, blocks.points, blocks.begin, blocks.nodes, near.kind, near.starts, near.places
        )
        if blocks.at.size:
            high[:, blocks.at], low[:, blocks.at] = largest[:, :-LANES], smallest[:, :-LANES]
    kernels.claim(
        high, low, owner, d.upright.loose, table.offsets, table.nodes, near.kind, near.starts, near.places
    )
    claims, lowest = np.empty((2, d.nodes, owner.shape[1]), dtype=np.int32)
    block_kernels.by_node(claims, high)
    block_kernels.by_node(lowest, low)
    _spread(d, lowest, claims)
    crowded = (claims >= 0) & (lowest < claims)
    return claims, np.concatenate([clash, np.stack([lowest[crowded], claims[crowded]], axis=1)])


def _sense(
    d: Discretisation, state: State, flags: Numbers, owner: Numbers, clash: Integers, changed: Flags,
    owners: Floats, columns: Floats,
) -> None:
    """Fill flags, owner and clash at the points that see a changed node; see `kernels.sense`.

    Work space: owners (2, slots, n + LANES) for the largest and the smallest particle of each slot and node, columns
    (F, n + LANES) for the fields.
    """
    table, near, switch = d.shape, d.nearest, d.case.activation
    least = LEAST * switch.eps_eta
    kernels.sense(
        flags, owner, clash, state.u, state.owner, switch.eps_rho, switch.eps_eta, least, d.dim, d.upright.loose,
        changed, table.offsets, table.nodes, table.rows, table.table, near.kind, near.starts, near.places,
    )
    block_kernels.to_columns(columns, state.u)
    block_kernels.by_column(owners[0], owners[1], state.owner)
    # |sum N u| and |sum grad N u| are at most max |u| times the largest sum of |N| or of |grad N| in a row of the table
    negligible = min(least, switch.eps_eta) / d.steepest
    for blocks in (some for some in (d.blocks, d.upright) if len(some.points)):
        block_kernels.sense(
            flags, owner, clash, _numbered(columns, blocks), _numbered(owners[0], blocks), _numbered(owners[1], blocks),
            switch.eps_rho, switch.eps_eta, least, negligible, blocks.points,
            changed[blocks.seen], blocks.begin, blocks.count, blocks.start, blocks.nodes, table.table,
            near.kind, near.starts, near.places,
        )


def _numbered(columns: Floats, blocks: Blocks) -> Floats:
    """Fields by columns as the blocks number the nodes: for upright ones a copy."""
    if not blocks.at.size:
        return columns
    fields = np.zeros((len(columns), blocks.at.size + LANES))
    block_kernels.fetch(fields, columns, blocks.at)
    return fields


def _everyones_pairs(d: Discretisation, pairs: Integers) -> Integers:
    """The distinct pairs that any rank found."""
    return slots.unique_pairs(np.concatenate(d.share.ranks.everyones(slots.unique_pairs(pairs))))


def _spread(d: Discretisation, low: Array, high: Array) -> None:
    """Smallest `low` and largest `high` over the holders of each shared node."""
    d.share.halo.most(high)
    np.negative(low, out=low)
    d.share.halo.most(low)
    np.negative(low, out=low)


def _watch(
    d: Discretisation, flags: Numbers, owner: Numbers, node_owner: Numbers, moved: Unknowns, lives: list[LiveBlocks],
    loose: Integers,
) -> Floats:
    """1 / eps of the unknowns that decide whether the set still holds, 0 of the others."""
    watch, owned = np.zeros((2, d.nodes), dtype=np.int64)
    table, near, switch = d.shape, d.nearest, d.case.activation
    kernels.all_slots(owned, node_owner)
    for blocks, live in zip((d.blocks, d.upright), lives, strict=True):
        bits = watch[blocks.seen]
        block_kernels.watch_nodes(
            bits, owned[blocks.seen], live.blocks, live.weights, live.first, live.column, live.owner, blocks.points,
            blocks.begin, blocks.start, blocks.nodes, table.table, near.kind, near.starts, near.places,
        )
        watch[blocks.seen] = bits
    kernels.watch_nodes(
        watch, flags, owner, owned, table.offsets, table.nodes, table.rows, table.table,
        near.kind, near.starts, near.places, np.concatenate([loose, np.flatnonzero(flags == 0)]),
    )
    column = np.repeat(moved.strips.column, np.diff(moved.strips.first))
    bits = watch[moved.nodes]
    slot, rho, eta = (1.0 / max(x, SMALLEST) for x in (SLOT_EPS * switch.eps_eta, switch.eps_rho, switch.eps_eta))
    return np.where(bits & 1, np.where(column == 0, rho, eta), np.where(bits >> column & 1, slot, 0.0))


def _seen_by(d: Discretisation, chosen: Flags) -> Bytes:
    """Which nodes of this rank its chosen points see, 1 or 0."""
    seen = np.zeros(d.nodes, dtype=np.int8)
    if chosen.all():
        seen[:] = 1  # a rank holds only nodes that its points see
    elif chosen.any():
        kernels.touch(seen, chosen, d.shape.offsets, d.shape.nodes)
    return seen


def _touched(d: Discretisation, chosen: Flags) -> Flags:
    """Which nodes a chosen point of any rank sees."""
    touched = _seen_by(d, chosen)
    d.share.halo.most(touched)
    return touched.astype(bool)


def _still_shares(
    d: Discretisation, state: State, flags: Numbers, owner: Numbers, edge_nodes: Integers, interior: Integers
) -> tuple[Floats, Floats]:
    """What still points owe to W, and to the advection at the edge nodes.

    The drift that the nodes beyond the edge would get is the quadrature's error in sum_p w_p grad N_a = 0. It is left
    out there, so its sum is taken from the edge nodes by volume: mass stays conserved to round-off.
    """
    table = d.shape
    edge = np.full(d.nodes, -1, dtype=np.int64)
    edge[edge_nodes] = np.arange(edge_nodes.size)
    potential = np.zeros(d.nodes)
    drift = np.zeros((edge_nodes.size, 2, d.dim + rotations(d.dim)))
    kernels.still_shares(
        potential, drift, flags, edge, owner, state.u, d.weights, d.x,
        table.offsets, table.nodes, table.rows, table.table, np.empty((1, table.longest)),
        d.coefficients, d.huang,
    )
    particle = interior[edge_nodes]
    excess = np.zeros((len(state.slot_of), *drift.shape[1:]))
    np.add.at(excess, particle, drift)
    volume = np.zeros(len(state.slot_of))
    owned = d.share.halo.owned[edge_nodes]
    np.add.at(volume, particle[owned], d.mass[edge_nodes[owned]])
    d.share.ranks.sum(excess)
    d.share.ranks.sum(volume)
    mean = excess / np.where(volume > 0.0, volume, 1.0)[:, None, None]
    drift[owned] -= d.mass[edge_nodes[owned], None, None] * mean[particle[owned]]
    return potential, drift
