"""What packings cost: `python tests/benchmarks/bench_packing.py [COUNT ...]` prints processor seconds on one core.

Spheres of a spread of 0.1, poured, and pressed to 0.58 of the vacancy box. The cache is not asked.
"""

import sys
import time
from typing import Any

from frit.solver.case import Case, parse_case
from frit.solver.packing import make, request

COUNTS = (200, 1000, 10_000)
FILLED = 0.47  # solid fraction of the container with all particles: a poured heap leaves room above


def spheres(number: int, **asked: Any) -> Case:
    """A container for about `number` spheres of mean radius 1, a tenth higher than wide."""
    edge = (number * 4.1888 / FILLED / 1.1) ** (1.0 / 3.0)
    size = [edge, edge, 1.1 * edge]
    particles = {
        "source": "packing", "mean_radius": 1.0, "std_radius": 0.1, "container": [[0.0] * 3, size], **asked,
    }  # fmt: skip
    rest = {"domain": {"size": size}, "nodes": {"spacing": 0.5}, "time": {"end": 1.0}}
    return parse_case(rest | {"particles": particles})


def main() -> None:
    """A line per count and way."""
    counts = [int(word) for word in sys.argv[1:]] or list(COUNTS)
    for asked in ({"count": COUNTS[0]}, {"packing_density": 0.5}):  # compiles the loops
        make(request(spheres(COUNTS[0], **asked)))
    for count in counts:
        for way, asked in (("poured", {"count": count}), ("pressed", {"packing_density": 0.58})):
            began = time.process_time()
            made = make(request(spheres(count, **asked))).realised
            seconds = time.process_time() - began
            print(f"{way:8} {made['count']:6} spheres {seconds:8.2f} s   trials {made['trial'] + 1}", flush=True)


if __name__ == "__main__":
    main()
