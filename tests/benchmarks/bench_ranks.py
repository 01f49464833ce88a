"""More ranks than are here: pack A of the paper cut for 2 ... 512 ranks, `python tests/benchmarks/bench_ranks.py`.

The partitions are real, all neighbour lists included; what ranks would take is reckoned with the latency and the
bandwidth of `frit.sweeps.scaling`, beside what `frit sweep plan` says without a mesh. Some minutes and 6 GB.
"""

from pathlib import Path

import numpy as np

from frit.solver.arrays import Flags, Integers, Numbers
from frit.solver.case import load_case
from frit.solver.geometry import make_mesh
from frit.solver.jit import jit
from frit.solver.neighbours import make_grid
from frit.solver.partition import bisect
from frit.solver.shape import search_range
from frit.sweeps.cost import VISIT
from frit.sweeps.scaling import BANDWIDTH, COUNTS, LATENCY, Division, divide

CASE = Path(__file__).parents[2] / "sweeps" / "paper" / "pack_a.toml"


@jit
def hold(held: Flags, part: Integers, offsets: Integers, near: Numbers) -> None:
    """held[a, r]: whether a point of rank r sees node a."""
    for p in range(part.size):
        for e in range(offsets[p], offsets[p + 1]):
            held[near[e], part[p]] = True


def main() -> None:
    """The table."""
    case = load_case(CASE)
    mesh = make_mesh(case.nodes, case.domain.size)
    reach = search_range(mesh.spacing, case.shape_functions.gamma, case.shape_functions.tolerance)
    offsets, near = make_grid(mesh.nodes, float(reach[0])).within(mesh.points, reach)
    seconds = near.size * VISIT
    print(f"pack A: {len(mesh.nodes)} nodes, {len(mesh.points)} points, all live")
    print(f"{seconds:.1f} s per evaluation on one core")
    print(f"{LATENCY:g} s per message, {BANDWIDTH:g} bytes per second and rank")
    print(f"{'ranks':>6}{'imbalance':>11}{'neighbours':>12}{'halo, MB':>10}{'efficiency':>12}{'planned':>9}")
    work = np.diff(offsets).astype(np.float64)
    for ranks in COUNTS:
        part = bisect(mesh.points, work, ranks)
        held = np.zeros((len(mesh.nodes), ranks), dtype=bool)
        hold(held, part, offsets, near)
        several = held[held.sum(axis=1) > 1].astype(np.float32)
        shared = (several * (several.sum(axis=1, keepdims=True) - 1)).sum(axis=0)
        neighbours = (several.T @ several > 0).sum(axis=0) - 1
        load = np.bincount(part, work, ranks)
        real = Division(ranks, float(load.max() / load.mean() - 1), float(shared.max()), int(neighbours.max()))
        planned = divide(case.domain.size, len(mesh.nodes), float(reach[0]), ranks)
        parts = f"{real.efficiency(seconds, 143):12.1%}{planned.efficiency(seconds, 143):9.1%}"
        print(f"{ranks:6}{real.imbalance:11.2%}{real.neighbours:12}{real.halo_bytes / 1e6:10.2f}{parts}", flush=True)


if __name__ == "__main__":
    main()
