"""Whether the lengths of a case fit the widths that its model gives to interfaces."""

import math
from collections.abc import Iterator

WIDEST = 2.0  # widths of an interface between nodes: functions wider than that do not hold it
LEAST = 10.0  # times the largest radius: what is narrower than a boundary is in another unit
USUAL = 20.0  # boundary widths: a radius that most cases are near to
UNITS = {"um": 1e3, "mm": 1e6, "m": 1e9}  # nm in each
Wrong = tuple[str, str]  # key, and what is allowed


def boundary_width(kappa_eta: float, B: float) -> float | None:
    """2 sqrt(kappa_eta / (3 B)), nm: 1 / (largest slope of eta) in a boundary; None: this model has none."""
    return 2.0 * math.sqrt(kappa_eta / (3.0 * B)) if B > 0.0 else None


def wrong_lengths(width: float, start: float, radius: tuple[str, float], spacing: float | None) -> Iterator[Wrong]:
    """What is wrong with the largest radius, given with its key, and with the spacing; one of both. start: xi.

    A particle narrower than the boundary around it is none: its lengths were meant in another unit.
    """
    said = f"the width of a boundary, 2 sqrt(kappa_eta / (3 B)) = {width:.4g} nm"
    key, largest = radius
    if LEAST * largest < width:
        unit = min(UNITS, key=lambda name: abs(math.log(largest * UNITS[name] / (USUAL * width))))
        meant = f"{largest * UNITS[unit]:.4g} nm, if {unit} was meant"
        yield key, f"must be at least {width / LEAST:.4g}, a tenth of {said}: lengths are in nm ({meant})"
    elif spacing is not None and (most := WIDEST * max(width, start)) < spacing <= largest:
        larger = f"twice the larger of particles.interface_width, {start:.4g} nm, and {said}"
        yield "nodes.spacing", f"cannot hold an interface: must be at most {most:.4g}, {larger}"
