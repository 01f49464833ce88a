"""What packings cost: `python tests/benchmarks/bench_packing.py [COUNT ...]` prints processor seconds on one core.

Spheres of a spread of 0.1, poured, and pressed to 0.58 of the vacancy box. The cache is not asked.
"""

import sys
import time
from typing import Any

from frit.solver.case import Case, parse_case
from frit.solver.packing import make, request

COUNTS = (200, 1000, 10_000)
FILLED = 0.535  # solid fraction of the container with `count` particles: a poured heap leaves room above


def spheres(count: int, **asked: Any) -> Case:
    """A container for about `count` spheres of mean radius 1, a tenth higher than wide."""
    edge = (count * 4.1888 / FILLED / 1.1) ** (1.0 / 3.0)
    size = [edge, edge, 1.1 * edge]
    particles = {
        "source": "packing", "mean_radius": 1.0, "std_radius": 0.1, "container": [[0.0] * 3, size], **asked,
    }  # fmt: skip
    return parse_case({"domain": {"size": size}, "particles": particles, "time": {"end": 1.0}, "nodes": {"spacing": 0.5}})


def main() -> None:
    """A line per count and way."""
    counts = [int(word) for word in sys.argv[1:]] or list(COUNTS)
    for asked in ({"count": 30}, {"packing_density": 0.5}):  # compiles the loops
        make(request(spheres(30, **asked)))
    for count in counts:
        for way, asked in (("poured", {"count": count}), ("pressed", {"packing_density": 0.58})):
            began = time.process_time()
            realised = make(request(spheres(count, **asked))).realised
            seconds = time.process_time() - began
            print(f"{way:8} {realised['count']:6} spheres {seconds:8.2f} s   trials {realised['trial'] + 1}", flush=True)


if __name__ == "__main__":
    main()
