"""Where the fields of a lattice live: one vector, in which each field has a box of nodes, its window.

rho has all nodes of the rank, the order parameter of a particle those near it. Rows along the fast axis (x) lie one
after another, each as long as the window is wide: whole packs, with `reach` or more places at both ends that belong to
no node or to none where the field is not 0. So a loop over packs may look `reach` places past a row. Of each row only
an interval of nodes is *in* the window; everything else in the box is 0 and stays 0.

Axes are named slow, middle, fast: z, y, x in space; y, none (a single node), x in the plane.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Integers, Numbers
from ..jit import jit
from ..simd import LANES

NONE = 1 << 30  # begin of a row that holds no node


class Layout(NamedTuple):
    """The windows on one rank: number 0 is rho's, 1 + a that of particle a. What the loops need."""

    offset: Integers  # (w + 1,) where each begins in the vector
    low: Integers  # (w, 3) first node along slow, middle, fast axis; along the fast one it may lie before the first
    size: Integers  # (w, 3) nodes that it holds
    row: Integers  # (w,) its first row
    begin: Numbers  # (rows,) nodes in the window, counted from low: begin ... end - 1; NONE, 0: none
    end: Numbers
    first: Integers  # (layers + 1,) of the windows with points in each layer of cells:
    window: Numbers  # window[first[k]] ... window[first[k + 1] - 1], k from the rank's first layer on
    layer: Integers  # (w,) its first layer on the rank
    span: Integers  # (w,) where its part of `spans` begins, layer by layer, row by row of nodes
    cell: Integers  # (w,) and its part of `cells`, where a layer has one row more
    spans: Numbers  # (s, 2) packs of the row in which a node that the layer sees is in the window: begin and end
    cells: Numbers  # (c, 4) packs of the row of cells in which one has a corner in the window: begin and end; and
    # those which the spans of the rows of nodes hold that it sees


@dataclass(frozen=True)
class Boxes:
    """The windows of the particles' order parameters on the whole lattice, the same on all ranks."""

    low: Integers  # (particles, 3)
    size: Integers  # (particles, 3) along the fast axis whole packs; slow 0: the particle has been consumed
    row: Integers  # (particles + 1,)
    begin: Numbers  # (rows,) as in `Layout`
    end: Numbers


def boxes_of(begin: list[Integers], end: list[Integers], low: list[Integers], reach: int) -> Boxes:
    """Boxes around intervals: begin, end (slow, middle) in nodes of the lattice, low (2,) of their first row."""
    lows, sizes, begins, ends = [], [], [], []
    for b, e, corner in zip(begin, end, low, strict=True):
        there = e > b
        if not there.any():
            lows.append(np.zeros(3, dtype=np.int64))
            sizes.append(np.zeros(3, dtype=np.int64))
            continue
        slow, middle = (np.flatnonzero(there.any(axis=axis)) for axis in (1, 0))
        chosen = np.ix_(np.arange(slow[0], slow[-1] + 1), np.arange(middle[0], middle[-1] + 1))
        b, e, there = b[chosen], e[chosen], there[chosen]
        first = LANES * ((int(b[there].min())) // LANES) - reach  # as rho's: packs begin at the same nodes
        width = int(e[there].max()) + reach - first
        lows.append(np.array([corner[0] + slow[0], corner[1] + middle[0], first]))
        sizes.append(np.array([*b.shape, whole_packs(width)]))
        begins.append(np.where(there, b - first, NONE).ravel())
        ends.append(np.where(there, e - first, 0).ravel())
    size = np.array(sizes, dtype=np.int64).reshape(-1, 3)
    row = np.concatenate([[0], np.cumsum(size[:, 0] * size[:, 1])])
    low_ = np.array(lows, dtype=np.int64).reshape(-1, 3)
    return Boxes(low_, size, row, joined(begins), joined(ends))


def whole_packs(places: int) -> int:
    """The number of places, rounded up to whole packs."""
    return LANES * -(-places // LANES)


def joined(arrays: list[Integers]) -> Numbers:
    """One after another, as short numbers."""
    return np.concatenate([np.empty(0, dtype=np.int32), *arrays]).astype(np.int32)


def lay_out(boxes: Boxes, nodes: tuple[int, int, int], reach: int, planes: tuple[int, int], layers: range) -> Layout:
    """The part of the windows on the planes of nodes first ... last - 1 that a rank holds for its layers of cells.

    nodes: of the whole lattice along slow, middle, fast.
    """
    first, last = planes
    width = whole_packs(nodes[2] + 2 * reach)
    lows, sizes = [[first, 0, -reach]], [[last - first, nodes[1], width]]
    count = (last - first) * nodes[1]
    begins, ends = [np.full(count, reach)], [np.full(count, reach + nodes[2])]
    for a in range(len(boxes.low)):
        low, size = boxes.low[a], boxes.size[a]
        begin, end = max(first, int(low[0])), min(last, int(low[0] + size[0]))
        held = max(0, end - begin)
        lows.append([begin, int(low[1]), int(low[2])])
        sizes.append([held, int(size[1]) if held else 0, int(size[2]) if held else 0])
        rows = slice(boxes.row[a] + (begin - low[0]) * size[1], boxes.row[a] + (begin - low[0] + held) * size[1])
        begins.append(boxes.begin[rows] if held else np.empty(0))
        ends.append(boxes.end[rows] if held else np.empty(0))
    size = np.array(sizes, dtype=np.int64)
    low = np.array(lows, dtype=np.int64)
    offset = np.concatenate([[0], np.cumsum(size.prod(axis=1))])
    row = np.concatenate([[0], np.cumsum(size[:, 0] * size[:, 1])])[:-1]
    tops = low[:, 0] + size[:, 0]
    there = np.arange(1, len(low))[size[1:, 0] > 0]
    seen = [there[(low[there, 0] - 1 <= k) & (k < tops[there])] for k in layers]
    counts = np.concatenate([[0], np.cumsum([len(some) for some in seen], dtype=np.int64)])
    begin_, end_ = joined(begins), joined(ends)
    layer = np.clip(low[:, 0] - 1, layers.start, layers.stop)
    held_ = np.where(size[:, 0] > 0, np.clip(tops, layers.start, layers.stop) - layer, 0)
    span, cell = (np.concatenate([[0], np.cumsum(held_ * (size[:, 1] + more), dtype=np.int64)]) for more in (0, 1))
    spans, cells = (np.zeros((int(last[-1]), width), dtype=np.int32) for last, width in ((span, 2), (cell, 4)))
    _find_spans(spans, cells, begin_, end_, low, size, row, layer, held_, reach, nodes[1] > 1)
    return Layout(
        offset, low, size, row, begin_, end_, counts, joined(seen), layer, span[:-1], cell[:-1], spans, cells
    )


@jit
def _find_spans(
    spans: Numbers, cells: Numbers, begin: Numbers, end: Numbers, low: Integers, size: Integers, row: Integers,
    layer: Integers, held: Integers, reach: int, space: bool,
) -> None:
    """Fill in `Layout.spans` and `Layout.cells`."""
    first = at = 0
    for w in range(len(low)):
        ns, nm, nf = size[w, 0], size[w, 1], size[w, 2]
        for i in range(held[w]):
            s = layer[w] + i - low[w, 0]  # the plane before the layer
            for m in range(nm):
                b, e = _packs(begin, end, row[w], ns, nm, nf, s - reach + 1, s + reach, m, m, 0)
                spans[first + m, 0] = b
                spans[first + m, 1] = e
            for j in range(nm + 1):  # the row of cells before row j of nodes; in the plane, that of row 0
                near, far = (j - 1, j) if space else (0, 0)
                b, e = _packs(begin, end, row[w], ns, nm, nf, s, s + 1, near, far, 1)
                cells[at, 0] = b
                cells[at, 1] = e
                cells[at, 2] = nf // LANES
                cells[at, 3] = 0
                for m in range(max(0, j - reach), min(nm, j + reach)):
                    if spans[first + m, 1] > spans[first + m, 0]:
                        cells[at, 2] = min(cells[at, 2], spans[first + m, 0])
                        cells[at, 3] = max(cells[at, 3], spans[first + m, 1])
                at += 1
            first += nm


@jit
def _packs(
    begin: Numbers, end: Numbers, row: int, ns: int, nm: int, nf: int, s_0: int, s_1: int, m_0: int, m_1: int,
    before: int,
) -> tuple[int, int]:
    """Packs that hold the intervals, and so many nodes before, of rows m_0 ... m_1 on planes s_0 ... s_1."""
    first, last = nf, 0
    for s in range(max(0, s_0), min(ns, s_1 + 1)):
        for m in range(max(0, m_0), min(nm, m_1 + 1)):
            if end[row + s * nm + m] > begin[row + s * nm + m]:
                first, last = min(first, begin[row + s * nm + m]), max(last, end[row + s * nm + m])
    return (max(first - before, 0) // LANES, -(-last // LANES)) if last > first else (0, 0)


@jit
def carry(new: Floats, to: Layout, old: Floats, of: Layout) -> None:
    """Copy all fields from one layout into another, as far as both have them; new is 0 before."""
    for w in range(len(to.low)):
        up, aside, ahead = to.low[w, 0] - of.low[w, 0], to.low[w, 1] - of.low[w, 1], to.low[w, 2] - of.low[w, 2]
        for s in range(to.size[w, 0]):
            z = s + up
            if z < 0 or z >= of.size[w, 0]:
                continue
            for m in range(to.size[w, 1]):
                y = m + aside
                if y < 0 or y >= of.size[w, 1]:
                    continue
                row, before = to.row[w] + s * to.size[w, 1] + m, of.row[w] + z * of.size[w, 1] + y
                begin = max(to.begin[row], of.begin[before] - ahead)
                end = min(to.end[row], of.end[before] - ahead)
                target = to.offset[w] + (s * to.size[w, 1] + m) * to.size[w, 2]
                source = of.offset[w] + (z * of.size[w, 1] + y) * of.size[w, 2] + ahead
                for i in range(begin, end):
                    new[target + i] = old[source + i]


@jit
def intervals(
    begin: Numbers, end: Numbers, y: Floats, layout: Layout,
    boxes_low: Integers, boxes_size: Integers, boxes_row: Integers, least: float, first: int, last: int,
) -> None:
    """Of each row of the boxes on planes first ... last - 1: from the first to the last node with |eta| >= least.

    In nodes of the lattice; rows that have none keep what they hold.
    """
    for w in range(1, len(layout.low)):
        a, nm, nf = w - 1, layout.size[w, 1], layout.size[w, 2]
        for s in range(layout.size[w, 0]):
            plane = layout.low[w, 0] + s
            if plane < first or plane >= last:
                continue
            for m in range(nm):
                at = layout.offset[w] + (s * nm + m) * nf
                row = boxes_row[a] + (plane - boxes_low[a, 0]) * boxes_size[a, 1] + m
                for i in range(layout.begin[layout.row[w] + s * nm + m], layout.end[layout.row[w] + s * nm + m]):
                    if abs(y[at + i]) >= least:
                        begin[row] = min(begin[row], layout.low[w, 2] + i)
                        end[row] = max(end[row], layout.low[w, 2] + i + 1)


def widened(
    begin: Integers, end: Integers, low: Integers, nodes: tuple[int, int, int], margin: int
) -> tuple[Integers, Integers, Integers]:
    """Intervals (slow, middle) with `margin` more nodes along every axis, and the row (2,) that they begin at."""
    grow = [min(margin, n - 1) for n in nodes]
    room = [(grow[0], grow[0]), (grow[1], grow[1])]
    b, e = np.pad(begin, room, constant_values=NONE), np.pad(end, room, constant_values=0)
    for axis, reach in enumerate(grow[:2]):
        source = b.copy(), e.copy()
        for shift in range(1, reach + 1):
            for ahead, behind in ((slice(shift, None), slice(None, -shift)), (slice(None, -shift), slice(shift, None))):
                here = (ahead, slice(None)) if axis == 0 else (slice(None), ahead)
                beside = (behind, slice(None)) if axis == 0 else (slice(None), behind)
                b[here] = np.minimum(b[here], source[0][beside])
                e[here] = np.maximum(e[here], source[1][beside])
    corner = low - np.array(grow[:2])
    rows = [slice(max(0, -int(corner[k])), max(0, min(b.shape[k], nodes[k] - int(corner[k])))) for k in range(2)]
    b, e = b[rows[0], rows[1]], e[rows[0], rows[1]]
    there = e > b
    b = np.where(there, np.maximum(b - grow[2], 0), NONE)
    e = np.where(there, np.minimum(e + grow[2], nodes[2]), 0)
    return b, e, np.maximum(corner, 0)


@jit
def rim(y: Floats, layout: Layout, nodes: Integers, margin: int) -> float:
    """The largest |eta| at nodes that are less than `margin` nodes away from the end of their window, walls apart."""
    largest = 0.0
    for w in range(1, len(layout.low)):
        ns, nm, nf = layout.size[w, 0], layout.size[w, 1], layout.size[w, 2]
        for s in range(ns):
            for m in range(nm):
                row = layout.row[w] + s * nm + m
                begin, end = layout.begin[row], layout.end[row]
                if end <= begin:
                    continue
                at = layout.offset[w] + (s * nm + m) * nf
                inner_begin = begin if layout.low[w, 2] + begin <= 0 else begin + margin
                inner_end = end if layout.low[w, 2] + end >= nodes[2] else end - margin
                for shift in (-margin, margin):
                    for axis in range(2):
                        z, x = (s + shift, m) if axis == 0 else (s, m + shift)
                        place = layout.low[w, axis] + (z if axis == 0 else x)
                        if place < 0 or place >= nodes[axis]:
                            continue  # a wall
                        if z < 0 or z >= ns or x < 0 or x >= nm:
                            if axis == 1 or layout.low[0, 0] <= place < layout.low[0, 0] + layout.size[0, 0]:
                                inner_begin, inner_end = end, begin
                            continue  # else it is another rank's to say
                        other = layout.row[w] + z * nm + x
                        inner_begin = max(inner_begin, layout.begin[other])
                        inner_end = min(inner_end, layout.end[other])
                for i in range(begin, end):
                    if i < inner_begin or i >= inner_end:
                        largest = max(largest, abs(y[at + i]))
    return largest


@jit
def scramble(direction: Floats, rate: Floats, layout: Layout, nodes: Integers) -> None:
    """direction = rate with signs that a hash of the node's number decides."""
    for w in range(len(layout.low)):
        ns, nm, nf = layout.size[w, 0], layout.size[w, 1], layout.size[w, 2]
        for s in range(ns):
            for m in range(nm):
                at = layout.offset[w] + (s * nm + m) * nf
                first = ((layout.low[w, 0] + s) * nodes[1] + layout.low[w, 1] + m) * nodes[2] + layout.low[w, 2]
                for i in range(nf):
                    flip = ((first + i) * 2654435761) % 4294967296 >= 2147483648
                    direction[at + i] = -rate[at + i] if flip else rate[at + i]
