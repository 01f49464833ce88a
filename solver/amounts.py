"""How much a case asks for, reckoned without building any of it: nodes, points, rows, snapshots, steps, particles.

Every figure is a float that may be infinite: what is asked for may be beyond counting.
"""

import math
from collections.abc import Sequence

POINTS = 1 / 0.72  # material points on free nodes, per mean distance of these along an axis: as many as triangles
LOOSEST = 1e-12  # relative: round-off does not lose the last of evenly spaced times


def quotient(a: float, b: float) -> float:
    """a / b, infinite where that is too large or b is 0."""
    return a / b if b > 0.0 else math.inf


def nodes(size: Sequence[float], spacing: float, source: str = "triangular") -> float:
    """Nodes of a lattice of nearest neighbours h in the box, its walls included; of gmsh about as many as triangular.

    lattice: square or cubic. Triangular: rows h sqrt(3)/2 apart; body-centred: two per cube of edge 2h / sqrt(3).
    """
    if source == "lattice":
        return math.prod(quotient(length, spacing) + 1 for length in size)
    pitch = [spacing, spacing * math.sqrt(3) / 2] if len(size) == 2 else [2 * spacing / math.sqrt(3)] * 3
    counts = [quotient(length, step) + 1 for length, step in zip(size, pitch, strict=True)]
    return math.prod(counts) * (1 if len(size) == 2 else 2)


def points(count: float, dim: int) -> float:
    """Material points on that many nodes: a triangle has two per node, a body-centred lattice six."""
    return count * (2 if dim == 2 else 6)


def times(end: float, every: float) -> float:
    """Evenly spaced output times from 0 to the end."""
    return math.floor(whole) + 1.0 if (whole := quotient(end, every) * (1 + LOOSEST)) < 2**53 else whole


def paper_step(spacing: float, mobility: float, gradient: float) -> float:
    """dt = 0.1 d_min^2 / (2 L kappa_eta), d_min the smallest distance between nodes: the paper's rule (2.3)."""
    return 0.1 * spacing**2 / (2.0 * mobility * gradient)


def volume(radius: float, dim: int) -> float:
    """pi R^2 or 4/3 pi R^3."""
    return math.pi * radius**2 if dim == 2 else 4.0 / 3.0 * math.pi * radius**3


def packed(
    density: float, container: Sequence[Sequence[float]], mean: float, histogram: Sequence[tuple[float, float]]
) -> float:
    """Particles of a packing to a solid fraction: a spread makes them fewer."""
    low, high = container
    dim = len(low)
    weights = [weight for _, weight in histogram] or [1.0]
    sizes = [volume(radius, dim) for radius, _ in histogram] or [volume(mean, dim)]
    mean_volume = sum(w * v for w, v in zip(weights, sizes, strict=True)) / sum(weights)
    return quotient(density * math.prod(b - a for a, b in zip(low, high, strict=True)), mean_volume)
