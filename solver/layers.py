"""The blocks of one kind, with the fields of their nodes and points as `block_kernels` wants them."""

from collections.abc import Callable

import numpy as np

from . import block_kernels
from .arrays import Floats, Integers
from .blocks import Blocks, LiveBlocks
from .contacts import Contacts
from .discretisation import Discretisation
from .partition import Exchange, pieces
from .simd import LANES

PIECE = 1000  # blocks between two looks after what is under way: half a millisecond in the plane, two in space


class Layer:
    """Blocks along x, whose nodes are the rank's; or upright ones, whose nodes are some of these, numbered along y."""

    def __init__(
        self, d: Discretisation, blocks: Blocks, live: LiveBlocks, columns: int, room: Callable[[int], Floats]
    ) -> None:
        """columns: F; room(rows): work space (rows, LANES)."""
        self.d, self.blocks, self.live = d, blocks, live
        self.at = blocks.at if live.blocks.size else blocks.at[:0]
        nodes = self.at.size if blocks.at.size else d.nodes
        self.u, self.rate = np.zeros((2, columns, nodes + LANES))  # the rates are 0 between evaluations
        self.W = np.zeros((1, nodes + LANES))
        self.D, self.S2 = np.empty((2, live.blocks.size, LANES))
        self.fields = room(live.column.size * (1 + d.dim))
        self.touching = np.empty(live.blocks.size, dtype=np.int64)

    def range(self, border: bool) -> tuple[int, int]:
        """The live blocks at the border of the rank, which come first, or the others."""
        return (0, self.live.border) if border else (self.live.border, self.live.blocks.size)

    def potential(self, found: Contacts, border: bool, under_way: Exchange | None) -> None:
        """`block_kernels.potential` of the blocks at the border or of the others, and their contacts."""
        blocks, live, d = self.blocks, self.live, self.d
        for piece in pieces(*self.range(border), PIECE, under_way):
            touches = block_kernels.potential(
                self.W, self.touching, self.fields, self.D, self.S2, self.u,
                live.blocks, live.weights, live.first, live.column, live.owner, live.partial,
                blocks.begin, blocks.count, blocks.start, blocks.nodes, d.shape.table, d.coefficients, *piece,
            )
            if d.case.model.rigid_motion:
                self.meet(found, self.touching[:touches])

    def meet(self, found: Contacts, touching: Integers) -> None:
        """`block_kernels.meet` of the live blocks in which particles may touch."""
        live = self.live
        block_kernels.meet(
            found, self.fields, live.blocks, live.weights, live.first, live.owner, self.blocks.points,
            touching, self.d.coefficients.c,
        )

    def divergence(self, motion: Floats, border: bool, under_way: Exchange | None) -> None:
        """`block_kernels.divergence` of the same."""
        blocks, live, d = self.blocks, self.live, self.d
        for piece in pieces(*self.range(border), PIECE, under_way):
            block_kernels.divergence(
                self.rate, self.fields, self.D, self.S2, self.W, motion,
                live.blocks, live.weights, live.first, live.column, live.particle, live.owner,
                blocks.x, blocks.begin, blocks.count, blocks.start, blocks.nodes, d.shape.table,
                d.coefficients, d.case.model.rigid_motion, d.huang, *piece,
            )
