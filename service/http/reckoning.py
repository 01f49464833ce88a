"""What a case will need, reckoned from its tables before anything is built, and which key is to blame for too much.

Memory was measured as the largest resident set of the ranks (2 particles; one rank unless said): lattices 2-D 451 000
nodes 0.98 GB, 72 000 nodes at gamma 0.5 0.43 GB; 3-D 94 000 nodes 0.80 GB, 258 000 nodes 1.77 GB, 94 000 nodes at gamma
0.5 3.1 GB; meshes of gmsh 3-D 23 000 nodes as reckoned (13 800 in truth) 0.57 GB, with points in cells 0.85 GB, 102 000
(59 600) 1.75 GB. Packs: 144 discs on 212 000 nodes 0.62 GB, 27 spheres on 94 000 nodes 0.90 GB. Two ranks with 212 000
nodes of 2-D: 0.88 GB together. So

    memory = ranks RANK + nodes (NODE + SLOT (slots beyond SLOTS)) + pairs PAIR

with the pairs of a material point and a node in its range. A first run that compiles takes RANK.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from frit.solver import amounts
from frit.solver.mesh_file import MeshFileError, shapes
from frit.sweeps.cost import factored, nodes_in_range, points_of

from ..settings import Settings

RANK = 450e6  # bytes: interpreter, libraries, compiled code and the compiler
NODE = 1600.0  # bytes per node: fields, numbers of the integrator, mesh
FACTORED = 900.0  # bytes per node of a square or cubic lattice, which has no mesh and no table of neighbours
# bytes: on lattices few are kept; of gmsh more nodes are reckoned
PAIR = {"lattice": 6.0, "triangular": 6.0, "gmsh": 40.0, "file": 75.0}
SLOTS = 6  # order parameters per node that NODE has
MANY_SLOTS = {2: 8, 3: 24}  # as many as shared slots get to: 6 in 2-D with 144 particles, 21 in 3-D with 150
SLOT = 100.0  # bytes per node and further slot
ROW, ROW_PARTICLE = 720.0, 40.0  # bytes, and more per particle: a line of history.jsonl, and the same in the index
SNAPSHOT = 20.0  # bytes per node
MESH = 100.0  # bytes per node, in snapshots.zarr
NEIGHBOURS = 5000  # particles that lie within the reach of the largest around one that is packed, at most

Tree = Mapping[str, Any]


@dataclass(frozen=True)
class Excess:
    """What a case has too much of: the dotted key that is to blame, its value, and what is allowed."""

    key: str
    value: Any
    allowed: str


@dataclass(frozen=True)
class Need:
    """Amounts that a case asks for; each may be infinite."""

    nodes: float
    points: float
    particles: float
    rows: float
    snapshots: float
    memory: float  # bytes, of all ranks
    disk: float  # bytes


def need(case: Tree, ranks: int) -> Need:
    """Of a resolved case, as plain values."""
    dim, end, output = len(case["domain"]["size"]), case["time"]["end"], case["output"]
    nodes, points = mesh_of(case)
    particles = particles_of(case["particles"])
    change = output.get("history_change", 0.0)  # which cases of old have not
    rows = amounts.times(end, output["history_every"]) + (1.0 / change if change else 0.0)
    snapshots = snapshots_of(output["snapshots"], end)
    shared = case["activation"]["few_order_parameters"]
    slots = min(particles, MANY_SLOTS[dim]) if shared else particles
    apart = case["nodes"].get("spacing") or (math.prod(case["domain"]["size"]) / max(nodes, 1.0)) ** (1.0 / dim)
    pairs = points * nodes_in_range(case, apart)
    each, pair = (FACTORED, 0.0) if factored(case) else (NODE, PAIR[case["nodes"]["source"]])
    memory = nodes * (each + SLOT * max(slots - SLOTS, 0)) + pairs * pair
    checkpoint = nodes * (16 + 24 * max(slots, SLOTS))
    disk = (ROW + ROW_PARTICLE * particles) * rows + SNAPSHOT * nodes * snapshots + 2 * checkpoint + MESH * nodes
    return Need(nodes, points, particles, rows, snapshots, ranks * RANK + memory, disk)


def mesh_of(case: Tree) -> tuple[float, float]:
    """Nodes and material points: reckoned of a lattice or gmsh, told by frit's own mesh file."""
    size, given = case["domain"]["size"], case["nodes"]
    if given["source"] != "file":
        nodes = amounts.nodes(size, given["spacing"], given["source"])
        cells = amounts.points(nodes, len(size))
        return nodes, points_of(case, nodes, cells)
    try:
        found = shapes(given["path"])
    except (OSError, MeshFileError):
        return 0.0, 0.0  # the ranks will say so
    nodes, cells = float(found.nodes), float(found.cells["triangle" if len(size) == 2 else "tetra"])
    return nodes, points_of(case, nodes, cells)


def particles_of(given: Tree) -> float:
    """How many there are, or will be packed at most."""
    if given["source"] != "packing":
        return float(len(given["centres"]))
    if (count := given.get("count")) is not None:
        return float(count)
    mean, histogram = given.get("mean_radius") or 0.0, given.get("histogram") or ()
    return amounts.packed(given["packing_density"], given["container"], mean, histogram)


def snapshots_of(given: Any, end: float) -> float:
    """How many a run writes."""
    return amounts.times(end, given["every"]) if isinstance(given, Mapping) else float(len(given))


# --- too much


def excesses(case: Tree, ranks: int, settings: Settings) -> Iterator[Excess]:
    """All that a case has too much of for this service."""
    asked = need(case, ranks)
    spacing = blamed = _spacing(case)
    for table, key in (("points", "pitch"), ("shape_functions", "width")):
        if (given := case[table].get(key)) is not None:
            blamed = f"{table}.{key}", given
    if not case["activation"]["few_order_parameters"] and asked.particles > MANY_SLOTS[3]:
        blamed = ("activation.few_order_parameters", False)
    if asked.nodes > settings.nodes_limit:
        yield Excess(*spacing, f"gives about {asked.nodes:.3g} nodes, must be at most {settings.nodes_limit}")
    if asked.particles > settings.particles_limit:
        said = f"gives about {asked.particles:.3g} particles, must be at most {settings.particles_limit}"
        yield Excess(*_amount(case["particles"]), said)
    elif (near := neighbours(case["particles"], asked.particles)) > NEIGHBOURS:
        key = "histogram" if case["particles"].get("histogram") else "std_radius"
        said = f"mixes sizes so that the largest is near {near:.3g} others, must be at most {NEIGHBOURS}"
        yield Excess(f"particles.{key}", case["particles"].get(key), said)
    if asked.rows > settings.rows_limit:
        said = f"gives {asked.rows:.3g} rows, must be at most {settings.rows_limit}"
        yield Excess("output.history_every", case["output"]["history_every"], said)
    if asked.snapshots > settings.snapshots_limit:
        said = f"gives {asked.snapshots:.3g} snapshots, must be at most {settings.snapshots_limit}"
        yield Excess(*_snapshots(case["output"]), said)
    if asked.memory > (most := settings.memory_limit * ranks):
        said = f"needs about {asked.memory:.3g} bytes of memory, must be at most {most:.3g} on {ranks} ranks"
        yield Excess(*blamed, said)
    if asked.disk > settings.disk_limit:
        if SNAPSHOT * asked.nodes * asked.snapshots > 0.5 * asked.disk:
            blamed = _snapshots(case["output"])
        elif (ROW + ROW_PARTICLE * asked.particles) * asked.rows > 0.5 * asked.disk:
            blamed = "output.history_every", case["output"]["history_every"]
        said = f"needs about {asked.disk:.3g} bytes on disk, must be at most {settings.disk_limit}"
        yield Excess(*blamed, said)


def neighbours(given: Tree, particles: float) -> float:
    """How many particles are looked at around one that is packed: those within three widths of the largest."""
    if given["source"] != "packing":
        return 0.0
    low, high = given["container"]
    histogram, mean = given.get("histogram") or (), given.get("mean_radius") or 0.0
    largest = max((radius for radius, _ in histogram), default=mean + 6 * (given.get("std_radius") or 0.0))
    part = math.prod(min(1.0, 6 * largest / (b - a)) for a, b in zip(low, high, strict=True))
    return particles * part


def _spacing(case: Tree) -> tuple[str, Any]:
    """The key that decides how many nodes there are."""
    if case["nodes"]["source"] == "file":
        return "nodes.path", None
    return "nodes.spacing", case["nodes"]["spacing"]


def _amount(given: Tree) -> tuple[str, Any]:
    """The key that decides how many particles there are."""
    if given["source"] != "packing":
        return "particles.centres", None
    for key in ("count", "mean_radius"):
        if given.get(key) is not None:
            return f"particles.{key}", given[key]
    return "particles.histogram", given["histogram"]


def _snapshots(output: Tree) -> tuple[str, Any]:
    given = output["snapshots"]
    return ("output.snapshots.every", given["every"]) if isinstance(given, Mapping) else ("output.snapshots", None)


def too_long(tree: Any, settings: Settings, key: str = "particles") -> Iterator[Excess]:
    """Lists of particles in a table as it came, or in a list of such tables: told before they are looked into."""
    tables = tree if isinstance(tree, list) else [tree]
    for table in tables:
        for name in ("centres", "radii", "sizes"):
            given = table.get(name) if isinstance(table, Mapping) else None
            if isinstance(given, list) and len(given) > settings.particles_limit:
                said = f"has {len(given)} entries, must be at most {settings.particles_limit}"
                yield Excess(f"{key}.{name}", None, said)
