"""Gaussian elimination for particles that touch: one small block per particle, two per pair.

(I + tau M S) V = b couples a particle to those it touches. Eliminating it couples those to one another, so the one with
the fewest comes next (minimum degree); which pairs that adds is found once for given contacts, by `plan`. Rows are
exchanged inside a particle's own block alone: where contacts push back, eigenvalues are at least 1 and need no more (a
digit is lost in one of a thousand random systems of that kind).
Where a block has no inverse the solution is not finite, and the integrator tries a shorter step, with a smaller tau.

Loops go entry by entry: an operation on whole arrays costs numba a second of compiling, for a message about shapes.
"""

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Integers
from .jit import inlined, jit

FIRST = np.int64(0)  # a literal 0 would be a type of its own, and everything below it compiled once more


@dataclass(frozen=True)
class Plan:
    """Step i eliminates particle pivots[i] from the equations of later[e], e = first[i] ... first[i + 1] - 1.

    These are sorted by the steps that eliminate them.
    """

    pairs: Integers  # (pairs, 2) particles that push each other
    pivots: Integers  # (particles,)
    first: Integers  # (particles + 1,)
    later: Integers  # (e,)
    place: Integers  # (pairs,) entry e of each pair
    target: Integers  # entry of the pair later[d], later[e] for every d < e of a step, in that order


@dataclass(frozen=True)
class Factors:
    """The eliminated matrix: inverted blocks on the diagonal, and those of a step's particle with later ones."""

    plan: Plan
    inverse: Floats  # (particles, k, k)
    upper: Floats  # (e, k, k) rows of the step's particle, columns of the later one
    lower: Floats  # (e, k, k) the reverse, times the inverse

    def solve(self, b: Floats) -> Floats:
        """x of A x = b; both (particles, k)."""
        x = b.copy()
        substitute(x, self.inverse, self.upper, self.lower, self.plan.pivots, self.plan.first, self.plan.later)
        return x


def plan(pairs: Integers, particles: int) -> Plan:
    """The elimination for the pairs (a, b), a != b, each given once."""
    pivots, counts, partners = order(pairs, particles)
    step = np.empty(particles, dtype=np.int64)
    step[pivots] = np.arange(particles)
    later = partners[np.lexsort((step[partners], np.repeat(np.arange(particles), counts)))]
    first = np.append(0, np.cumsum(counts))
    place = np.empty(len(pairs), dtype=np.int64)
    target = np.empty(int((counts * (counts - 1) // 2).sum()), dtype=np.int64)
    find_places(place, target, pairs, step, first, later)
    return Plan(pairs, pivots, first, later, place, target)


@jit
def order(pairs: Integers, particles: int) -> tuple[Integers, Integers, Integers]:
    """The particles in the order of elimination, of each the number of those it is coupled to then, and these.

    Each is the one coupled to the fewest that are left, the first of them; those it leaves are then coupled.
    """
    waiting = np.zeros(particles, dtype=np.int64)  # the number of partners; more than any of those that are gone
    for p in range(pairs.shape[0]):
        waiting[pairs[p, 0]] += 1
        waiting[pairs[p, 1]] += 1
    start = np.empty(particles, dtype=np.int64)
    end = np.empty(particles, dtype=np.int64)
    used = 0
    for a in range(particles):
        start[a] = end[a] = used
        used += waiting[a]
    lists = np.empty(2 * used, dtype=np.int64)  # of the partners of a: lists[start[a]] ...; grows at its end
    for p in range(pairs.shape[0]):
        a, b = pairs[p, 0], pairs[p, 1]
        lists[end[a]], lists[end[b]] = b, a
        end[a] += 1
        end[b] += 1
    mark = np.zeros(particles, dtype=np.int64)
    joins = 0
    pivots = np.empty(particles, dtype=np.int64)
    for i in range(particles):
        a = 0
        for b in range(particles):
            if waiting[b] < waiting[a]:
                a = b
        pivots[i] = a
        waiting[a] = particles
        for k in range(start[a], end[a]):
            b = lists[k]
            most = end[b] - start[b] + end[a] - start[a]
            if used + most > lists.size:
                longer = np.empty(2 * used + most, dtype=np.int64)
                for j in range(used):
                    longer[j] = lists[j]
                lists = longer
            begin = used
            joins += 1
            mark[a] = mark[b] = joins
            for j in range(start[b], end[b]):
                if lists[j] != a:
                    mark[lists[j]] = joins
                    lists[used] = lists[j]
                    used += 1
            for j in range(start[a], end[a]):
                if mark[lists[j]] != joins:
                    lists[used] = lists[j]
                    used += 1
            start[b], end[b] = begin, used
            waiting[b] = used - begin
    counts = np.empty(particles, dtype=np.int64)
    whole = 0
    for i in range(particles):
        counts[i] = end[pivots[i]] - start[pivots[i]]
        whole += counts[i]
    partners = np.empty(whole, dtype=np.int64)
    e = 0
    for i in range(particles):
        for j in range(start[pivots[i]], end[pivots[i]]):
            partners[e] = lists[j]
            e += 1
    return pivots, counts, partners


@jit
def find_places(
    place: Integers, target: Integers, pairs: Integers, step: Integers, first: Integers, later: Integers
) -> None:
    """Fill `Plan.place` and `Plan.target`."""
    for p in range(pairs.shape[0]):
        place[p] = entry(pairs[p, 0], pairs[p, 1], step, first, later)
    t = 0
    for i in range(first.size - 1):
        for d in range(first[i], first[i + 1]):
            for e in range(d + 1, first[i + 1]):
                target[t] = entry(later[d], later[e], step, first, later)
                t += 1


@jit
def entry(a: int, b: int, step: Integers, first: Integers, later: Integers) -> int:
    """The entry of a pair, by bisection: later particles are sorted by their steps."""
    if step[a] > step[b]:
        a, b = b, a
    low = first[step[a]]
    high = first[step[a] + 1]
    while high - low > 1:
        middle = (low + high) // 2
        if step[later[middle]] <= step[b]:
            low = middle
        else:
            high = middle
    return int(low)


def factors(found: Plan, blocks: Floats) -> Factors:
    """The factors of I + the blocks (4 pairs, k, k) of the pairs' rows and columns (a, a), (a, b), (b, a), (b, b)."""
    k = blocks.shape[1]
    diagonal = np.tile(np.eye(k), (len(found.pivots), 1, 1))
    upper, lower = np.zeros((2, len(found.later), k, k))
    gather(diagonal, upper, lower, blocks, found.pairs, found.place, found.later)
    eliminate(diagonal, upper, lower, found.pivots, found.first, found.later, found.target)
    return Factors(found, diagonal, upper, lower)


@jit
def gather(
    diagonal: Floats, upper: Floats, lower: Floats, blocks: Floats, pairs: Integers, place: Integers, later: Integers
) -> None:
    """Add the blocks to the matrix."""
    count, k = pairs.shape[0], diagonal.shape[1]
    for p in range(count):
        a = pairs[p, 0]
        b = pairs[p, 1]
        e = place[p]
        ab, ba = (count + p, 2 * count + p) if later[e] == b else (2 * count + p, count + p)
        for r in range(k):
            for c in range(k):
                diagonal[a, r, c] += blocks[p, r, c]
                diagonal[b, r, c] += blocks[3 * count + p, r, c]
                upper[e, r, c] += blocks[ab, r, c]
                lower[e, r, c] += blocks[ba, r, c]


@jit
def eliminate(
    diagonal: Floats, upper: Floats, lower: Floats,
    pivots: Integers, first: Integers, later: Integers, target: Integers,
) -> None:
    """Turn the matrix into its factors, in place."""
    k = diagonal.shape[1]
    work = np.empty((1, k, k))
    t = 0
    for i in range(pivots.size):
        invert(diagonal[pivots[i]], work[0])
        for e in range(first[i], first[i + 1]):
            for r in range(k):
                for c in range(k):
                    work[0, r, c] = lower[e, r, c]
                    lower[e, r, c] = 0.0
            add_product(lower, e, work, FIRST, diagonal, pivots[i], 1.0)
        for d in range(first[i], first[i + 1]):
            add_product(diagonal, later[d], lower, d, upper, d, -1.0)
            for e in range(d + 1, first[i + 1]):
                add_product(upper, target[t], lower, d, upper, e, -1.0)
                add_product(lower, target[t], lower, e, upper, d, -1.0)
                t += 1


@jit
def substitute(
    x: Floats, inverse: Floats, upper: Floats, lower: Floats, pivots: Integers, first: Integers, later: Integers
) -> None:
    """Turn the right-hand side x (particles, k) into the solution: forward, then back."""
    k = x.shape[1]
    right = np.empty(k)
    for i in range(pivots.size):
        for e in range(first[i], first[i + 1]):
            for r in range(k):
                for c in range(k):
                    x[later[e], r] -= lower[e, r, c] * x[pivots[i], c]
    for i in range(pivots.size - 1, -1, -1):
        for r in range(k):
            right[r] = x[pivots[i], r]
        for e in range(first[i], first[i + 1]):
            for r in range(k):
                for c in range(k):
                    right[r] -= upper[e, r, c] * x[later[e], c]
        for r in range(k):
            x[pivots[i], r] = 0.0
            for c in range(k):
                x[pivots[i], r] += inverse[pivots[i], r, c] * right[c]


@inlined
def add_product(result: Floats, r: int, a: Floats, p: int, b: Floats, q: int, factor: float) -> None:
    """result[r] += factor a[p] b[q], all (k, k)."""
    if result.shape[1] == 3:
        multiply(result, r, a, p, b, q, factor, 3)  # known to the compiler: loops are unrolled
    else:
        multiply(result, r, a, p, b, q, factor, 6)


@inlined
def multiply(result: Floats, r: int, a: Floats, p: int, b: Floats, q: int, factor: float, k: int) -> None:
    """`add_product` for a given k."""
    for i in range(k):
        for j in range(k):
            value = 0.0
            for s in range(k):
                value += a[p, i, s] * b[q, s, j]
            result[r, i, j] += factor * value


@jit
def invert(block: Floats, work: Floats) -> None:
    """Replace a block (k, k) by its inverse, by Gauss and Jordan with row exchange; not finite where it has none."""
    k = block.shape[0]
    for r in range(k):
        for c in range(k):
            work[r, c] = block[r, c]
            block[r, c] = 1.0 if r == c else 0.0
    for s in range(k):
        best = s
        for r in range(s + 1, k):
            if abs(work[r, s]) > abs(work[best, s]):
                best = r
        for c in range(k):
            work[s, c], work[best, c] = work[best, c], work[s, c]
            block[s, c], block[best, c] = block[best, c], block[s, c]
        scale = 1.0 / work[s, s]
        for c in range(k):
            work[s, c] *= scale
            block[s, c] *= scale
        for r in range(k):
            if r != s:
                share = work[r, s]
                for c in range(k):
                    work[r, c] -= share * work[s, c]
                    block[r, c] -= share * block[s, c]
