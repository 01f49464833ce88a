"""The meshes of section 3.5: a square becomes a disc on nodes that finite elements cannot use.

`python -m frit.sweeps.paper.bad_meshes FOLDER` writes a mesh file and a case of each kind there, and of a good one; a
seed decides what is drawn. All have about 3700 nodes in 40 x 40 nm, the bad ones 61 along each wall.
"""

import argparse
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import Delaunay

from frit.solver.arrays import Floats, Integers
from frit.solver.geometry import lattice

SIDE = 40.0  # nm, of the domain
SQUARE = 16.0  # nm, edge of the particle
ALONG = 61  # nodes along each wall of a bad mesh
TRIANGLE = 0.72  # nm, edge of the good mesh's triangles
RATIO = 6.0  # of the longest to the shortest interval of a graded grid
JITTER = 0.75  # of a spacing: how far a node may be moved along each axis
SLIVER = 2e-3  # of a grid cell: the smallest triangle that is left
COLLAPSED = 0.25  # part of the inner nodes that are moved onto a neighbour
NEARLY = 1e-3  # of a spacing: what is left between the two
PAIR = 0.01  # nm, between the columns of a pair
SEED = 1

Nodes = tuple[Floats, Integers]  # (n, 2) and triangles (p, 3)


def good(_: np.random.Generator) -> Nodes:
    """Equilateral triangles."""
    mesh = lattice((SIDE, SIDE), TRIANGLE)
    return mesh.nodes, mesh.cells.astype(np.int64)


def squares() -> Nodes:
    """Squares, each cut into two triangles: what most bad meshes are made from."""
    return tensor(np.linspace(0.0, SIDE, ALONG), np.linspace(0.0, SIDE, ALONG))


def graded(_: np.random.Generator) -> Nodes:
    """Intervals along both axes that grow from the middle to the walls by `RATIO` in all."""
    steps = np.geomspace(1.0, RATIO, ALONG // 2)
    half = np.cumsum(steps) * (SIDE / 2 / steps.sum())
    half[-1] = SIDE / 2
    ticks = SIDE / 2 + np.concatenate([-half[::-1], [0.0], half])
    return tensor(ticks, ticks)


def askew(_: np.random.Generator) -> Nodes:
    """Intervals along both axes that grow from corner to corner by `RATIO` in all."""
    steps = np.geomspace(1.0, RATIO, ALONG - 1)
    ticks = np.append(0.0, np.cumsum(steps)) * (SIDE / steps.sum())
    ticks[-1] = SIDE
    return tensor(ticks, ticks)


def slivers(random: np.random.Generator) -> Nodes:
    """Inner nodes are moved so far that triangles become slivers, and back only where one would turn over."""
    start, cells = squares()
    moves = np.where(inner(start)[:, None], random.uniform(-JITTER, JITTER, start.shape), 0.0) * SIDE / (ALONG - 1)
    least = SLIVER * (SIDE / (ALONG - 1)) ** 2
    while (turned := areas(start + moves, cells) < least).any():
        moves[np.unique(cells[turned])] *= 0.9
    return start + moves, cells


def collapsed(random: np.random.Generator) -> Nodes:
    """A quarter of the inner nodes are moved onto a neighbour, all but a thousandth of the way."""
    nodes, cells = squares()
    places = nodes.reshape(ALONG, ALONG, 2)
    free = np.ones((ALONG, ALONG), dtype=bool)
    wanted = int(COLLAPSED * (ALONG - 2) ** 2)
    moved = places.copy()
    for number in random.permutation((ALONG - 2) ** 2):
        i, j = 1 + number // (ALONG - 2), 1 + number % (ALONG - 2)
        di, dj = [(1, 0), (-1, 0), (0, 1), (0, -1)][random.integers(4)]
        if wanted and free[i, j] and free[i + di, j + dj]:
            moved[i, j] += (1.0 - NEARLY) * (places[i + di, j + dj] - places[i, j])
            free[i, j] = free[i + di, j + dj] = False
            wanted -= 1
    return moved.reshape(-1, 2), cells


def pairs(_: np.random.Generator) -> Nodes:
    """Columns of nodes in pairs, 0.01 nm apart."""
    middles = np.linspace(0.0, SIDE, ALONG // 2 + 1)
    ticks = np.sort(np.concatenate([middles, middles[1:-1] + PAIR, [middles[-1] - PAIR]]))
    return tensor(ticks, np.linspace(0.0, SIDE, ALONG))


def scattered(random: np.random.Generator) -> Nodes:
    """Nodes drawn anywhere; only those on the walls are evenly spaced."""
    nodes, _ = squares()
    inside = inner(nodes)
    nodes[inside] = random.uniform(0.0, SIDE, (int(inside.sum()), 2))
    return nodes, np.asarray(Delaunay(nodes).simplices, dtype=np.int64)


KINDS: dict[str, Callable[[np.random.Generator], Nodes]] = {
    "good": good, "graded": graded, "askew": askew, "slivers": slivers, "collapsed": collapsed, "pairs": pairs,
    "random": scattered,
}  # fmt: skip


def tensor(x: Floats, y: Floats) -> Nodes:
    """The nodes of a grid, and its rectangles as triangles, whose diagonals alternate."""
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange(len(nodes)).reshape(len(x), len(y))
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    even = (np.add.outer(np.arange(len(x) - 1), np.arange(len(y) - 1)) % 2 == 0)[..., None]
    first = np.where(even, np.stack([a, b, c], axis=-1), np.stack([a, b, d], axis=-1))
    second = np.where(even, np.stack([a, c, d], axis=-1), np.stack([b, c, d], axis=-1))
    return nodes, np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])


def inner(nodes: Floats) -> Any:
    """Which nodes are not on a wall."""
    return ((nodes > 0.0) & (nodes < SIDE)).all(axis=1)


def areas(nodes: Floats, cells: Integers) -> Floats:
    """Signed areas of triangles."""
    a, b, c = (nodes[column] for column in cells.T)
    return np.asarray(0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))


def aspect(nodes: Floats, cells: Integers) -> Floats:
    """The longest edge of each triangle over its smallest height."""
    corners = nodes[cells]
    longest = np.max([np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in pairwise((0, 1, 2, 0))], axis=0)
    return np.asarray(longest**2 / np.maximum(2.0 * np.abs(areas(nodes, cells)), 1e-300))


def make(kind: str, seed: int = SEED) -> Nodes:
    """The mesh of that kind."""
    return KINDS[kind](np.random.default_rng(seed))


def write(kind: str, path: Path, seed: int = SEED) -> Path:
    """The mesh of that kind as a file."""
    import meshio

    nodes, cells = make(kind, seed)
    flat = np.column_stack([nodes, np.zeros(len(nodes))])
    meshio.Mesh(flat, [("triangle", cells)]).write(path)
    return path


def case(path: Path, end: float) -> dict[str, Any]:
    """The square on the mesh of a file, as a plain case."""
    middle = SIDE / 2
    return {
        "name": f"square to disc, {path.stem} mesh",
        "domain": {"size": [SIDE, SIDE]},
        "nodes": {"source": "file", "path": str(path)},
        "particles": {"shape": "box", "centres": [[middle, middle]], "sizes": [[SQUARE, SQUARE]]},
        "time": {"end": end},
        "output": {"history_every": end / 20, "snapshots": [0.0, end]},
    }


def main() -> None:
    """Write all meshes and their cases."""
    parser = argparse.ArgumentParser(description="Meshes of section 3.5 of Huang et al. (2023), with a case each.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--end", type=float, default=40.0, help="model time")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for kind in KINDS:
        path = write(kind, (given.folder / f"{kind}.vtk").absolute(), given.seed)
        tree = case(path, given.end)
        path.with_suffix(".json").write_text(json.dumps(tree, indent=2) + "\n")
        worst = aspect(*make(kind, given.seed)).max()
        print(f"{path.with_suffix('.json')}: {len(make(kind, given.seed)[0])} nodes, aspects up to {worst:.3g}")


if __name__ == "__main__":
    main()
