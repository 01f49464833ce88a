"""Few order parameters: particles that never meet share a slot (section 2.5 of the paper).

Every particle has one slot, the same everywhere; two particles may share a slot as long as no material point sees
both. That is a colouring of the graph of particles that meet. When two particles of one slot come close, one of them
gets another slot, and when no slot is free another one is made: nothing is ever dropped.
"""

from heapq import heapify, heappop, heappush

import numpy as np

from .arrays import Floats, Integers, Numbers
from .jit import jit

MOST_SLOTS = 62  # bits of a watch word; see `kernels.watch_nodes`


class SlotError(RuntimeError):
    """More particles meet at one place than frit has slots."""


def unique_pairs(pairs: Integers) -> Integers:
    """The distinct rows (a, b) with a < b, sorted; rows with a negative number are none; (pairs, 2)."""
    rows = pairs.reshape(-1, 2)
    rows = rows[(rows[:, 0] >= 0) & (rows[:, 1] >= 0) & (rows[:, 0] != rows[:, 1])]
    codes = np.unique(rows.min(axis=1) << 32 | rows.max(axis=1))
    return np.stack([codes >> 32, codes & 0xFFFFFFFF], axis=1)


def colour(pairs: Integers, particles: int) -> Numbers:
    """A slot for every particle so that the particles of a pair differ, and few slots in all.

    The particle whose neighbours already use the most slots comes next, and takes the lowest slot free (Brelaz 1979).
    """
    meets = _adjacency(pairs, particles)
    slot_of = np.full(particles, -1, dtype=np.int32)
    taken: list[set[int]] = [set() for _ in range(particles)]
    queue = [(0, -len(meets[a]), a) for a in range(particles)]
    heapify(queue)
    while queue:
        saturation, _, a = heappop(queue)
        if slot_of[a] >= 0 or -saturation < len(taken[a]):
            continue  # has a slot, or an entry with more used slots is in the queue
        slot = _lowest_free(taken[a])
        slot_of[a] = slot
        for b in meets[a]:
            if slot_of[b] < 0 and slot not in taken[b]:
                taken[b].add(slot)
                heappush(queue, (-len(taken[b]), -len(meets[b]), b))
    return slot_of


def recolour(slot_of: Numbers, pairs: Integers) -> Numbers:
    """New slots in which no pair shares one; only particles that clash move, the one with fewer neighbours first."""
    meets = _adjacency(pairs, len(slot_of))
    new = slot_of.copy()
    for a, b in pairs[slot_of[pairs[:, 0]] == slot_of[pairs[:, 1]]]:
        if new[a] == new[b]:
            moved = min((a, b), key=lambda c: (len(meets[c]), c))
            new[moved] = _lowest_free({int(new[c]) for c in meets[moved]})
    return new


def _adjacency(pairs: Integers, particles: int) -> list[list[int]]:
    meets: list[list[int]] = [[] for _ in range(particles)]
    for a, b in pairs.tolist():
        meets[a].append(b)
        meets[b].append(a)
    return meets


def _lowest_free(taken: set[int]) -> int:
    free = next(s for s in range(len(taken) + 1) if s not in taken)
    if free >= MOST_SLOTS:
        raise SlotError(f"{free + 1} particles meet at one place, at most {MOST_SLOTS} can")
    return free


def repack(u: Floats, owner: Numbers, slot_of: Numbers, columns: int) -> tuple[Floats, Numbers]:
    """Fields and owners with every particle's values moved to its slot; `columns` is the new F."""
    new_u = np.zeros((len(u), columns))
    new_owner = np.full((len(u), int(slot_of.max()) + 1), -1, dtype=np.int32)
    move(new_u, new_owner, u, owner, slot_of)
    return new_u, new_owner


@jit
def move(new_u: Floats, new_owner: Numbers, u: Floats, owner: Numbers, slot_of: Numbers) -> None:
    """Copy rho, and every owned eta into the slot of its owner."""
    for a in range(u.shape[0]):
        new_u[a, 0] = u[a, 0]
        for s in range(owner.shape[1]):
            if owner[a, s] >= 0:
                new_u[a, 1 + slot_of[owner[a, s]]] = u[a, 1 + s]
                new_owner[a, slot_of[owner[a, s]]] = owner[a, s]


@jit
def meeting(owner: Numbers, chosen: Integers) -> Integers:
    """Every pair of particles that one of the chosen rows of owner holds together, once: (pairs, 2)."""
    seen = {np.int64(-1)}
    before = np.int64(-1)
    here = np.empty(owner.shape[1], dtype=np.int64)
    for p in chosen:
        if before >= 0:
            differs = np.int32(0)
            for s in range(owner.shape[1]):
                differs |= owner[p, s] ^ owner[before, s]
            if differs == 0:
                continue
        before = p
        count = 0
        for s in range(owner.shape[1]):
            here[count] = owner[p, s]
            count += owner[p, s] >= 0
        for s in range(count):
            for t in range(s):
                seen.add(min(here[s], here[t]) << 32 | max(here[s], here[t]))
    pairs = np.empty((len(seen) - 1, 2), dtype=np.int64)
    count = 0
    for code in seen:
        if code >= 0:
            pairs[count, 0] = code >> 32
            pairs[count, 1] = code & 0xFFFFFFFF
            count += 1
    return pairs
