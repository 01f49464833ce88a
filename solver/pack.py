"""`python -P -m frit.solver.pack CASE --out FILE.csv` packs what a case asks for; prints what came out, as JSON."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from . import particle_file
from .case import CaseError, load_case
from .pack_measures import density_profile, touching
from .pack_store import packed
from .packing import Packing, Request, request

BINS = 10


def main() -> int:
    """Exit status 0, or 2 with what is wrong with the case on stderr."""
    parser = argparse.ArgumentParser(prog="frit.solver.pack", description="Pack the particles of a case.")
    parser.add_argument("case", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.csv")
    arguments = parser.parse_args()
    try:
        case = load_case(arguments.case)
        packing = packed(case)
        particle_file.write(arguments.out, packing.centres, packing.radii)
        case.with_particles(packing.centres, packing.radii)  # what the run would refuse is refused now
    except (CaseError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps(report(request(case), packing)))
    return 0


def report(wanted: Request, packing: Packing) -> dict[str, Any]:
    """Realised values, and the distributions of radii, of density across the last axis, and of contacts."""
    low, high = wanted.low, np.array(wanted.container[1])
    counts, edges = np.histogram(packing.radii, bins=BINS if np.ptp(packing.radii) > 0.0 else 1)
    heights, fractions = density_profile(packing.centres, packing.radii, low, high, BINS)
    contacts = touching(packing.centres, packing.radii, low, high)
    return {
        "packing": packing.realised,
        "container": wanted.container,
        "radii": {"edges": edges.tolist(), "counts": counts.tolist()},
        "profile": {"height": heights.tolist(), "solid_fraction": fractions.tolist()},
        "coordination": np.bincount(contacts.counts).tolist(),
    }


if __name__ == "__main__":
    sys.exit(main())
