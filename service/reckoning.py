"""What a case would take, reckoned before it is let in: nodes, particles, rows, snapshots, memory, disk.

All of it follows from a few numbers of the resolved case; nothing is built. Memory and disk were measured: 1.4 to
2.4 kB a node in 2-D, 5.1 to 11.4 kB in 3-D, 0.27 GB a rank besides; checkpoints 140 to 530 bytes a node, snapshots up
to 30, rows 230 bytes and 19 a particle. A run that takes more than it should is ended by its runner.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .problems import WrongField
from .settings import Settings

RANK = 300_000_000  # bytes of memory of a rank without nodes
NODE = {2: 2_500, 3: 10_000}  # bytes of memory of a node, by dimension
CHECKPOINT, SNAPSHOT = 600, 30  # bytes of disk for a node
ROW, ROW_PARTICLE = 250, 20  # bytes of disk for a history row, and for each particle in it
UNKNOWN = 0.0  # nodes of a mesh that is read from a file: its size is known when it was read

Case = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Reckoned:
    """One figure, the key and value that it follows from most, and what is allowed."""

    what: str
    figure: float
    most: float
    key: str
    value: Any

    @property
    def wrong(self) -> bool:
        """Whether it is too much; a figure that is no number is."""
        return not self.figure <= self.most

    def field(self, pointer: str, where: str = "") -> WrongField:
        """The problem, for a case that stands at `pointer`."""
        detail = f"gives about {self.figure:.3g} {self.what}, must be at most {self.most:.6g}{where}"
        return WrongField(pointer=f"{pointer}/{self.key.replace('.', '/')}", value=self.value, detail=detail)


def too_much(case: Case, ranks: int, settings: Settings) -> Iterator[Reckoned]:
    """All figures of a resolved case that are over the limits."""
    yield from (one for one in reckon(case, ranks, settings) if one.wrong)


def reckon(case: Case, ranks: int, settings: Settings) -> Iterator[Reckoned]:
    """All figures of a resolved case."""
    size, spacing, output = case["domain"]["size"], case["nodes"].get("spacing"), case["output"]
    end, every, dim = case["time"]["end"], output["history_every"], len(size)
    nodes, particles = estimated_nodes(size, spacing), particles_of(case)
    rows, snapshots = _over(end, every), _snapshots(output["snapshots"], end)
    memory = RANK * ranks + nodes * NODE[dim]
    disk = nodes * (CHECKPOINT + SNAPSHOT * snapshots) + rows * (ROW + ROW_PARTICLE * particles)
    node_key, node_value = ("nodes.spacing", spacing) if spacing is not None else ("nodes.path", None)
    many, many_value = _particles_key(case["particles"])
    disk_key = "output.snapshots" if nodes * SNAPSHOT * snapshots > rows * ROW else "output.history_every"
    yield Reckoned("nodes", nodes, settings.nodes_limit, node_key, node_value)
    yield Reckoned("particles", particles, settings.particles_limit, many, many_value)
    yield Reckoned("history rows", rows, settings.rows_limit, "output.history_every", every)
    yield Reckoned("snapshots", snapshots, settings.snapshots_limit, "output.snapshots", _shown(output["snapshots"]))
    yield Reckoned(f"bytes of memory on {ranks} ranks", memory, settings.memory_limit * ranks, node_key, node_value)
    yield Reckoned("bytes of disk", disk, settings.disk_limit, disk_key, None)


def estimated_nodes(size: Sequence[float], spacing: float | None) -> float:
    """Nodes of the lattice of nearest neighbours h in the box, its walls included; 0 for a mesh from a file.

    Triangular: rows h sqrt(3)/2 apart; body-centred: two per cube of edge 2h / sqrt(3).
    """
    if spacing is None:
        return UNKNOWN
    pitch = [spacing, spacing * math.sqrt(3) / 2] if len(size) == 2 else [2 * spacing / math.sqrt(3)] * 3
    counts = [_over(length, step) + 1 for length, step in zip(size, pitch, strict=True)]
    return math.prod(counts) * (1 if len(size) == 2 else 2)


def particles_of(case: Case) -> float:
    """How many there are; of a packing by density, what its container holds at that density."""
    particles, dim = case["particles"], len(case["domain"]["size"])
    if particles["source"] != "packing":
        return float(len(particles["centres"]))
    if (count := particles.get("count")) is not None:
        return float(count)
    lower, upper = particles["container"]
    solid = math.prod(b - a for a, b in zip(lower, upper, strict=True)) * particles["packing_density"]
    ball = math.pi if dim == 2 else 4 / 3 * math.pi
    try:
        return _over(solid, ball * _power_mean(particles, dim) ** dim)
    except OverflowError:
        return math.inf


def _power_mean(particles: Case, dim: int) -> float:
    """(mean of R^dim)^(1 / dim) of a histogram, the mean radius of the others."""
    if (mean := particles.get("mean_radius")) is not None:
        return float(mean)
    pairs = particles["histogram"]
    total = sum(weight for _, weight in pairs)
    return float(sum(weight / total * radius**dim for radius, weight in pairs) ** (1 / dim))


def _particles_key(particles: Case) -> tuple[str, Any]:
    """What the number of particles follows from."""
    if particles["source"] != "packing":
        return "particles.centres", None
    for key in ("count", "mean_radius"):
        if (value := particles.get(key)) is not None:
            return f"particles.{key}", value
    return "particles.histogram", None


def _snapshots(given: Any, end: float) -> float:
    return float(len(given)) if isinstance(given, Sequence) else _over(end, given["every"]) + 1


def _shown(snapshots: Any) -> Any:
    return snapshots if isinstance(snapshots, Mapping) else None


def _over(a: float, b: float) -> float:
    """a / b for positive numbers, infinite where it is too large for one."""
    return a / b if b > 0 else math.inf
