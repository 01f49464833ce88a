"""How busy more ranks stay: the work of one evaluation of the rates against what ranks tell each other in it.

Points are cut into boxes as `partition.bisect` does, here as if they lay evenly. A node is shared where points of both
sides of a cut see it: in a layer twice the range of the shape functions thick. Each evaluation exchanges one value and
then one row of fields per shared node with every neighbour, and sums the particles' forces over all ranks.
"""

from dataclasses import dataclass
from math import ceil, log2, prod

LATENCY = 2e-6  # s per message: a fast network, or shared memory under load
BANDWIDTH = 5e9  # bytes per second and rank
FIELDS = 8  # a node's row: rho and seven slots
BODY = 80  # bytes per particle in the sum of forces and moments
LEAST_NODES = 100
COUNTS = (2, 4, 8, 16, 32, 64, 128, 256, 512)

Box = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class Division:
    """What the busiest of some ranks has to do and to say in one evaluation."""

    ranks: int
    imbalance: float
    """its work over the mean, less 1"""
    shared: float
    """nodes that it sends and receives, once for each neighbour that holds them"""
    neighbours: float

    @property
    def halo_bytes(self) -> float:
        """It sends, and receives, so much per evaluation."""
        return self.shared * 8 * (1 + FIELDS)

    def efficiency(self, core_seconds: float, particles: float) -> float:
        """Part of the ranks' time that is work; core_seconds: of one evaluation on one core."""
        mean, rounds = core_seconds / self.ranks, ceil(log2(self.ranks))
        messages = 2 * self.neighbours + 2 * rounds
        sums = particles * BODY * rounds
        talk = messages * LATENCY + (2 * self.halo_bytes + sums) / BANDWIDTH
        return mean / (mean * (1 + self.imbalance) + talk)


def boxes(size: tuple[float, ...], parts: int) -> list[Box]:
    """The box [0, size] cut in two across its longest side (of equal ones the last) as often as there are parts."""
    done: list[Box] = []
    todo: list[tuple[Box, int]] = [((tuple(0.0 for _ in size), size), parts)]
    while todo:
        (low, high), count = todo.pop()
        if count == 1:
            done.append((low, high))
            continue
        left = count // 2
        axis = max(reversed(range(len(size))), key=lambda k: high[k] - low[k])
        cut = low[axis] + (high[axis] - low[axis]) * left / count
        middle_high = (*high[:axis], cut, *high[axis + 1 :])
        middle_low = (*low[:axis], cut, *low[axis + 1 :])
        todo += [((low, middle_high), left), ((middle_low, high), count - left)]
    return done


def divide(size: tuple[float, ...], nodes: float, reach: float, ranks: int) -> Division:
    """The division of evenly spread nodes whose functions reach so far (nm); imbalance 0.

    The points nearest to a cut lie a third of the nodes' spacing beside it.
    """
    parts, density = boxes(size, ranks), nodes / prod(size)
    reach -= density ** (-1 / len(size)) / 3
    most, widest = 0.0, 0
    for i, (low, high) in enumerate(parts):
        shared, met = 0.0, 0
        for j, (other_low, other_high) in enumerate(parts):
            # Nodes in reach of both boxes: where the boxes, each wider by the reach on all sides, overlap.
            lows = [max(max(a, b) - reach, 0.0) for a, b in zip(low, other_low, strict=True)]
            highs = [min(min(a, b) + reach, c) for a, b, c in zip(high, other_high, size, strict=True)]
            sides = [b - a for a, b in zip(lows, highs, strict=True)]
            if i == j or min(sides) <= 0.0:
                continue
            shared += density * prod(sides)
            met += 1
        most, widest = max(most, shared), max(widest, met)
    return Division(ranks, 0.0, most, widest)


def efficiencies(
    size: tuple[float, ...], nodes: float, reach: float, core_seconds: float, particles: float
) -> dict[int, float]:
    """Ranks, and the part of their time that is work, while each has at least `LEAST_NODES`; arguments as above."""
    return {
        ranks: divide(size, nodes, reach, ranks).efficiency(core_seconds, particles)
        for ranks in COUNTS
        if nodes / ranks >= LEAST_NODES
    }
