"""From a case to a run on a lattice, and its checkpoints."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import checkpoint
from ..arrays import Array, Floats, Integers, zeros
from ..case import Box, Case
from ..integrators import Integrator, integrator_of
from ..output import Fields
from ..partition import Collector, Ranks, Share
from . import guard
from .observe import LatticeObservables, nodal, order_parameter
from .scheme import Lattice, LatticeScheme, LatticeState, axes_of, make_lattice, nodes_of
from .start import first_boxes, fitting_boxes, initial_fields, move
from .windows import Boxes, Layout

__all__ = ["LatticeSetup", "guard"]

FIELD_WORK = 1.0  # of one cell for one field, in an evaluation


@dataclass(frozen=True)
class Kept:
    """What a checkpoint holds; its fields stay in the file until each rank takes its part."""

    directory: Path
    boxes: Boxes
    counts: tuple[float, int, int]
    memory: dict[str, float]
    motion: Floats
    wall_time: float


class LatticeSetup:
    """Nodes on a square or cubic lattice, two material points in each cell. See `setup.Setup`."""

    def __init__(self, case: Case, ranks: Ranks) -> None:
        self.case, self.ranks = case, ranks
        self.axes = axes_of(case)

    @property
    def nodes(self) -> int:
        """How many there are."""
        return int(np.prod(nodes_of(self.axes)))

    @property
    def grid(self) -> tuple[int, ...]:
        """Nodes along y and x, or z, y and x."""
        return tuple(axis.cells + 1 for axis in self.axes if axis is not None)

    def positions(self, nodes: slice = slice(None)) -> Floats:
        """See `setup.Setup`: along x, then y, then z."""
        places = np.unravel_index(np.arange(*nodes.indices(self.nodes)), self.grid)
        axes = [axis.nodes for axis in self.axes if axis is not None]
        return np.stack([axis[place] for axis, place in zip(axes, places, strict=True)][::-1], axis=-1)

    def start(self, kept: Kept | None = None) -> tuple[LatticeScheme, LatticeState, Integrator]:
        """See `setup.Setup`."""
        boxes = kept.boxes if kept else first_boxes(self.case, self.axes)
        lattice = make_lattice(self.case, self.axes, self.ranks, self._work(boxes))
        scheme = LatticeScheme(lattice, boxes)
        if kept:
            y = zeros(int(scheme.layout.offset[-1]))
            slabs = list(slabs_of(lattice, scheme.layout, boxes, lattice.planes))
            for slab, rows in zip(slabs, checkpoint.rows(kept.directory, "y", (s.there for s in slabs)), strict=True):
                y[slab.here] = rows
            state = LatticeState(*kept.counts, y)
            scheme.motion = scheme.carried = kept.motion
        else:
            y = initial_fields(self.case, lattice, scheme.layout)
            if self.case.activation.few_order_parameters:
                (y,) = move(scheme, fitting_boxes(scheme, y, self.case.activation.eps_eta), y)
            state = LatticeState(0.0, 0, 0, y)
        shortest = min(axis.step for axis in self.axes if axis is not None)
        return scheme, state, integrator_of(self.case, shortest, kept.memory if kept else None)

    def _work(self, boxes: Boxes) -> Floats:
        """Of each layer of cells."""
        slow, middle, fast = self.axes
        work = np.full(slow.cells, 2.0 * (1 if middle is None else middle.cells) * fast.cells)
        for low, size in zip(boxes.low, boxes.size, strict=True):
            work[max(0, low[0] - 1) : low[0] + size[0]] += FIELD_WORK * size[1] * size[2]
        return work

    def share(self, system: LatticeScheme) -> Share:
        """This rank's nodes."""
        return system.lattice.share()

    def rows(self, system: LatticeScheme, state: LatticeState, box: Box | None = None) -> LatticeObservables:
        """What computes the history."""
        return LatticeObservables(system, box)

    def fields(self, system: LatticeScheme, state: LatticeState, u: Floats, collector: Collector) -> Fields:
        """See `setup.Setup`."""
        return Fields(*(collector.blocks(values) for values in nodal(system, u)))

    def order_parameter(self, system: LatticeScheme, state: LatticeState, u: Floats, particle: int) -> Floats:
        """See `setup.Setup`."""
        return order_parameter(system, u, particle)

    def remarks(self) -> list[str]:
        """See `setup.Setup`."""
        return []

    def keep(
        self, directory: Path, system: LatticeScheme, state: LatticeState, collector: Collector, notes: dict[str, Any]
    ) -> None:
        """Write the checkpoint."""
        g, boxes, layout = system.lattice, system.boxes, system.layout

        def parts() -> Iterator[tuple[int, Array]]:
            for slab in slabs_of(g, layout, boxes, g.owned):
                yield slab.there.start, state.y[slab.here]

        size = int(whole(g, boxes)[2][-1])
        fields = {
            "y": checkpoint.Spread((size,), state.y.dtype, parts),
            "motion": system.carried,
            **{f"window_{name}": getattr(boxes, name) for name in BOXES},
        }
        head = checkpoint.Head(state, self.nodes, self.fingerprint(), notes)
        checkpoint.store(directory, self.ranks, fields, head)

    def read(self, directory: Path, identity: str) -> Kept:
        """See `setup.Setup`."""
        found: Kept = self.ranks.from_root(self._read(directory, identity) if self.ranks.root else None)
        return found

    def _read(self, directory: Path, identity: str) -> Kept:
        values, counts, notes = checkpoint.load(directory, identity, self.nodes, self.fingerprint(), ("y",))
        boxes = Boxes(**{name: values[f"window_{name}"] for name in BOXES})
        return Kept(directory, boxes, counts, notes["memory"], values["motion"], notes["wall_time"])

    def fingerprint(self) -> str:
        """Of what the fields stand on."""
        axes = [f"{axis.cells} of {axis.length!r} reach {axis.reach}" for axis in self.axes if axis is not None]
        return f"lattice {' x '.join(axes)}"


BOXES = ("low", "size", "row", "begin", "end")


class Slab(NamedTuple):
    """Some planes of a window: their places in the vector of one rank that would have all, and in this rank's."""

    there: slice
    here: slice


def slabs_of(lattice: Lattice, layout: Layout, boxes: Boxes, planes: range) -> Iterator[Slab]:
    """What of each window is on some planes of nodes that this rank holds."""
    low, plane, offset = whole(lattice, boxes)
    for w in range(len(low)):
        begin = max(planes.start, low[w])
        end = min(planes.stop, low[w] + (offset[w + 1] - offset[w]) // max(plane[w], 1))
        if begin < end:
            there = int(offset[w] + (begin - low[w]) * plane[w])
            here = int(layout.offset[w] + (begin - layout.low[w, 0]) * plane[w])
            size = int((end - begin) * plane[w])
            yield Slab(slice(there, there + size), slice(here, here + size))


def whole(lattice: Lattice, boxes: Boxes) -> tuple[Integers, Integers, Integers]:
    """The windows as if one rank had all of them, rho's first: first plane, values of a plane, (w + 1,) offsets."""
    low = np.append(0, boxes.low[:, 0])
    plane = np.append(lattice.nodes[1] * lattice.row, boxes.size[:, 1] * boxes.size[:, 2])
    planes = np.append(lattice.nodes[0], boxes.size[:, 0])
    return low, plane, np.append(0, np.cumsum(plane * planes))
