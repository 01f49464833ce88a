"""`python -P -m frit.solver.warm` compiles every loop of the solver now, into the cache: the first case need not wait.

Tiny cases are run to their end in a folder that is thrown away. Together they reach every compiled function with
every kind of argument: two and three dimensions, both shape functions, both integrators, with and without rigid
motion, one particle and several, lattices and free nodes, a whole run and a resumed one.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from .geometry import lattice
from .jit import cache_folder

Tree = dict[str, Any]

DISCS: Tree = {
    "name": "2-D, lme, adaptive, rigid motion",
    "domain": {"size": [22.0, 13.0]},
    "nodes": {"spacing": 1.0},
    "particles": {"centres": [[6.5, 6.2], [15.4, 6.8]], "radii": [5.0, 4.0]},
    "time": {"end": 0.004},
    "output": {"history_every": 0.001, "snapshots": [0.0, 0.004]},
}
SPHERES: Tree = {
    **DISCS,
    "name": "3-D, lme, adaptive, rigid motion",
    "domain": {"size": [13.0, 9.0, 9.0]},
    "particles": {"centres": [[3.5, 4.5, 4.5], [8.9, 4.5, 4.5]], "radii": [3.0, 2.5]},
}
CASES: list[Tree] = [
    DISCS,
    {
        **DISCS,
        "name": "2-D, linear, rk2, no motion",
        "shape_functions": {"kind": "linear"},
        "model": {"rigid_motion": False},
        "time": {"integrator": "rk2", "step": 1e-4, "end": 0.001},
        "output": {"history_every": 0.001},
    },
    {
        **DISCS,
        "name": "one disc",
        "particles": {"centres": [[6.5, 6.2]], "radii": [5.0]},  # a column of one row is laid out as a row is
    },
    {
        **DISCS,
        "name": "a packing",
        "domain": {"size": [44.0, 38.0]},
        "nodes": {"spacing": 2.0},
        "particles": {
            "source": "packing",
            "mean_radius": 3.0,
            "std_radius": 0.25,
            "packing_density": 0.79,
            "exchange": True,
            "container": [[2.0, 2.0], [42.0, 36.0]],
        },
    },
    SPHERES,
    {**DISCS, "name": "2-D, triangular", "nodes": {"source": "triangular", "spacing": 1.0}},
    {**SPHERES, "name": "3-D, body-centred", "nodes": {"source": "triangular", "spacing": 1.0}},
    {**SPHERES, "name": "3-D, linear, adaptive, rigid motion", "shape_functions": {"kind": "linear"}},
]


def on_free_nodes(tree: Tree, path: Path) -> Tree:
    """The case on a mesh file, made here, of the nodes of its lattice."""
    import meshio

    mesh = lattice(tree["domain"]["size"], tree["nodes"]["spacing"])
    flat = np.column_stack([mesh.nodes, np.zeros((len(mesh.nodes), 3 - mesh.nodes.shape[1]))])
    meshio.Mesh(flat, [("triangle" if mesh.nodes.shape[1] == 2 else "tetra", mesh.cells)]).write(path)
    return {**tree, "name": f"{tree['name']}, free nodes", "nodes": {"source": "file", "path": str(path)}}


def main() -> int:
    """Run all; say how long each took and where the compiled code is. The exit status is the solver's."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="frit-warm-") as folder:
        free = [on_free_nodes(tree, Path(folder) / f"{len(tree['domain']['size'])}.vtk") for tree in (DISCS, SPHERES)]
        for number, tree in enumerate(CASES + free):
            start, case, directory = time.monotonic(), Path(folder) / f"{number}.json", Path(folder) / str(number)
            kept = {**tree["output"], "keep_checkpoint": True}  # to be resumed
            case.write_text(json.dumps({**tree, "output": kept}))
            commands = [[str(case), "--out", str(directory)], ["--resume", str(directory)]]
            resumed = tree["name"] in (DISCS["name"], "2-D, triangular")
            for arguments in commands if resumed else commands[:1]:
                if status := subprocess.run([sys.executable, "-P", "-m", "frit.solver", *arguments]).returncode:
                    return status
            print(f"{tree['name']:45}{time.monotonic() - start:6.1f} s", flush=True)
    print(f"compiled code is in {cache_folder()}: {time.monotonic() - began:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
