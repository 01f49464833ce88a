"""Packings: particles poured into a container, or pressed in it to a density. Lengths are in nm.

Both begin with *cohesive settling*: particles fall one by one at random places and stay where they first touch, which
makes a connected, very loose pile (solid fraction near 0.15 in 3-D, 0.36 in 2-D).

pour     The pile is gathered below random close packing; then gravity pulls it down, with damping and friction, until
         it is at rest; the container is open above.
density  A lid presses the pile down to the height of the container, in a thick medium, so that nothing gets shaken
         into order (athermal, as in O'Hern et al. 2003), and without friction; then weak cohesion
         draws neighbours together, and clusters that still float are moved until they touch. How many particles that
         takes is found by trying: from the fraction that trials reach in the measured box follows the count of the
         next. With `exchange`, shaken particles may also swap radii, which packs a wide spread denser than random
         close packing.

A trial depends on the request and its number alone; everything is serial, so a request has one packing.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .arrays import Floats
from .case import Box, Case, CaseError, Particles, Problem
from .heap import Heap
from .pack_measures import solid_fraction, touching, volumes
from .radii import draw

TOLERANCE = 0.005  # of the solid fraction asked for
OVERLAP = 0.005  # the largest that a packing may have, in mean radii
ROUNDS = 500  # of shaking
WORK = 20_000  # particles in all trials together, but at least FEWEST and at most MOST trials
FEWEST, MOST = 8, 60
SAMPLE = 10_000  # particles from which the mean volume is known before they are drawn


@dataclass(frozen=True)
class Request:
    """What decides a packing: the table of the case, and the box in which a density is measured (None: all)."""

    particles: Particles
    container: Box
    box: Box | None

    @property
    def size(self) -> Floats:
        """Edges of the container (dim,)."""
        return np.subtract(self.container[1], self.container[0])

    @property
    def low(self) -> Floats:
        """Lower corner of the container."""
        return np.array(self.container[0])

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.container[0])

    def radii(self, count: int, rng: np.random.Generator) -> Floats:
        """As many as asked, in random order."""
        given = self.particles
        spread = given.mean_radius or 0.0, given.std_radius or 0.0, given.truncation or 0.0, given.histogram
        return draw(count, given.distribution or "normal", *spread, rng)

    def measured(self, x: Floats, r: Floats) -> float:
        """Solid fraction where the density is asked for."""
        return solid_fraction(x, r, *map(np.array, self.box or self.container))


@dataclass(frozen=True)
class Packing:
    """Particles, and what they are like (see `describe`)."""

    centres: Floats  # (n, dim)
    radii: Floats  # (n,)
    realised: dict[str, Any]


def request(case: Case) -> Request:
    """The packing that a case asks for. The vacancy box counts where it decides the packing and is in the container."""
    given = case.particles
    if given.source != "packing" or given.container is None:
        raise CaseError([Problem("particles.source", given.source, "must be 'packing' for particles to be packed")])
    box: Box | None = case.output.vacancy_box
    low, high = np.array(given.container)
    outside = (np.array(case.output.vacancy_box[0]) < low).any() or (np.array(case.output.vacancy_box[1]) > high).any()
    if given.method == "pour" or given.packing_density is None or outside:
        box = None
    return Request(given, given.container, box)


def make(wanted: Request) -> Packing:
    """The packing. Raises `CaseError` with what can be reached where it cannot be what was asked."""
    sample = wanted.radii(SAMPLE, np.random.default_rng(0))
    mean_volume = float(volumes(sample, wanted.dim).mean())
    edge, widest = float(wanted.size.min()), 2.0 * float(sample.max())
    if widest > edge:
        allowed = f"no room for the largest particles, {widest:.4g} nm wide: its shortest edge is {edge:g} nm"
        raise _refusal("container", wanted.particles.container, allowed)
    density, count = wanted.particles.packing_density, wanted.particles.count
    if count is None:
        count = max(1, round((density or 0.0) * float(np.prod(wanted.size)) / mean_volume))
    if wanted.particles.method == "pour":
        return _pour(wanted, count)
    if density is None:
        return _press(wanted, count)
    return _to_density(wanted, count, density)


def _refusal(field: str, value: Any, allowed: str) -> CaseError:
    return CaseError([Problem(f"particles.{field}", value, allowed)])


def _amount(wanted: Request) -> tuple[str, Any]:
    """The field that says how much, and its value."""
    given = wanted.particles
    return ("count", given.count) if given.count is not None else ("packing_density", given.packing_density)


def _start(wanted: Request, count: int, trial: int) -> tuple[Heap, float]:
    """The loose pile of a trial, and its unit of length, nm."""
    rng = np.random.default_rng([wanted.particles.seed or 0, trial])
    radii = wanted.radii(count, rng)
    unit = float(radii.mean())
    return Heap(radii / unit, wanted.size / unit, rng), unit


def _finish(wanted: Request, heap: Heap, unit: float, trial: int) -> Packing | None:
    """The heap in nm; None where it is no packing: an overlap, or a particle outside."""
    centres, radii = heap.x[:, : wanted.dim] * unit + wanted.low, heap.r * unit
    high = np.array(wanted.container[1])
    # What presses on a wall is in it by a little: move it inside.
    centres = np.clip(centres, wanted.low + radii[:, None], high - radii[:, None])
    packing = Packing(centres, radii, describe(wanted, centres, radii) | {"trial": trial})
    return packing if packing.realised["largest_overlap"] <= OVERLAP else None


# --- the two ways


def _pour(wanted: Request, count: int) -> Packing:
    heap, unit = _start(wanted, count, 0)
    heap.pour(wanted.particles.friction or 0.0)
    height = float(wanted.size[-1])
    field, value = _amount(wanted)
    if heap.top * unit > height * (1.0 + 1e-6):
        fit = int(count * height / (heap.top * unit))
        part = fit / count * float(volumes(heap.r * unit, wanted.dim).sum()) / float(np.prod(wanted.size))
        most = f"about {fit}" if field == "count" else f"about {part:.3f}"
        allowed = f"{count} poured particles reach {heap.top * unit:.4g} nm high in a container of {height:g} nm"
        raise _refusal(field, value, f"{allowed}: at most {most}")
    packing = _finish(wanted, heap, unit, 0)
    if packing is None:
        raise _refusal(field, value, "the poured particles do not come to rest; another seed may help")
    return packing


class Trials:
    """What trials have shown: the fraction in the measured box over that of the container, and between which counts."""

    def __init__(self, per_particle: float, guess: float = 1.0) -> None:
        """per_particle: the part of the container that a mean particle fills; guess: of the first ratio."""
        self.per_particle, self.guess = per_particle, guess
        self.ratios: list[float] = []
        self.fractions: list[float] = []
        self.jams: list[float] = []  # counts with which heaps would have jammed at the height of the container
        self.shorts: list[float] = []  # counts with which piles that were too low would have reached the lid

    def reached(self, fraction: float, count: int) -> None:
        """A packing with this fraction was made."""
        self.fractions.append(fraction)
        self.ratios.append(fraction / (count * self.per_particle))

    @property
    def floor(self) -> int:
        """Count whose pile reaches the lid every other time: one that was too low does not rule out its count."""
        return max(1, round(0.97 * float(np.mean(self.shorts)))) if self.shorts else 1

    @property
    def ceiling(self) -> float:
        """Count that fits every other time: a heap jams a little early or late."""
        return 0.99 * float(np.mean(self.jams)) if self.jams else math.inf

    def count(self, fraction: float) -> int:
        """To try next for this fraction in the measured box, from the latest trials."""
        ratio = float(np.mean(self.ratios[-6:])) if self.ratios else self.guess
        return max(int(min(fraction / (self.per_particle * ratio) + 0.5, self.ceiling)), self.floor)

    def hopeless(self, fraction: float, tolerance: float) -> bool:
        """Whether the densest of several heaps, all as dense as they get, is far from this fraction."""
        best = max(self.fractions, default=0.0)
        return len(self.jams) >= 5 and len(self.fractions) >= 3 and best < fraction - 4.0 * tolerance


def _to_density(wanted: Request, count: int, density: float) -> Packing:
    """Try counts until the solid fraction in the measured box is the asked one, within TOLERANCE.

    Where all of the container is measured, whole particles may not come that near: then the nearest count will do.
    """
    seen = Trials(density / count, _wall_effect(wanted) if wanted.box else 1.0)
    tolerance = max(TOLERANCE, 0.51 * seen.per_particle if wanted.box is None else 0.0)
    for trial in range(_trials(count)):
        n = seen.count(density)
        found = _trial(wanted, n, trial, seen)
        if found is not None:
            fraction = wanted.measured(found.centres, found.radii)
            seen.reached(fraction, n)
            if abs(fraction - density) <= tolerance:
                return found
        if seen.hopeless(density, tolerance):
            break
    raise _unreachable(wanted, count, seen)


def _wall_effect(wanted: Request) -> float:
    """About by how much the middle of a container is denser than all of it: next to a wall there is room to spare.

    1 + 0.35 R A / V with A the area of the walls; 0.3 was seen in dense packs, 0.5 in loose ones.
    """
    radius = float(wanted.radii(SAMPLE, np.random.default_rng(0)).mean())
    return 1.0 + 0.35 * radius * float((2.0 / wanted.size).sum())


def _trials(count: int) -> int:
    return min(max(WORK // count, FEWEST), MOST)


def _press(wanted: Request, count: int) -> Packing:
    """Exactly `count` particles in the container."""
    seen = Trials(1.0)
    for trial in range(_trials(count) // 4):
        found = _trial(wanted, count, trial, seen)
        if found is not None:
            return found
    least, most = _extremes(wanted, count, seen)
    allowed = f"cannot fill the container so that all hang together; reachable: about {least} to {most}"
    raise _refusal("count", count, allowed)


def _trial(wanted: Request, count: int, trial: int, seen: Trials) -> Packing | None:
    """Press `count` particles to the height of the container; None, and a note in `seen`, where that fails."""
    heap, unit = _start(wanted, count, trial)
    height, pile = float(wanted.size[-1]) / unit, heap.top
    if pile < height:
        seen.shorts.append(count * height / pile)
        return None
    exchange = bool(wanted.particles.exchange)
    if not (heap.anneal(height, ROUNDS) if exchange else heap.press(height)):
        jammed = float(heap.high[heap.up])
        seen.jams.append(min(count - 0.5, count * height / jammed))
        return None
    heap.stick()
    found = _finish(wanted, heap, unit, trial)
    if found is None or not (found.realised["connected"] and found.realised["percolates"]):
        return None
    return found


def _unreachable(wanted: Request, count: int, seen: Trials) -> CaseError:
    """What can be reached, from the trials and from a few more near the loosest and the densest heap."""
    least, most = _extremes(wanted, count, seen)
    loose = [math.ceil(least * factor) for factor in (1.0, 1.1, 1.25, 1.5)]
    dense = [math.floor(most * factor) for factor in (0.99, 0.97)]
    for counts in (loose, dense):
        for k, n in enumerate(counts):
            found = _trial(wanted, n, MOST + k, seen)
            if found is not None:
                seen.reached(wanted.measured(found.centres, found.radii), n)
                break
    where = "the vacancy box" if wanted.box else "the container"
    lowest, highest = min(seen.fractions, default=math.nan), max(seen.fractions, default=math.nan)
    allowed = f"cannot be reached in {where} with this spread and seed; reachable: about {lowest:.3f} to {highest:.3f}"
    return _refusal("packing_density", wanted.particles.packing_density, allowed)


def _extremes(wanted: Request, count: int, seen: Trials) -> tuple[int, int]:
    """Counts of the loosest and the densest heap in the container."""
    heap, unit = _start(wanted, max(count, 4), MOST)
    height, n = float(wanted.size[-1]) / unit, len(heap.r)
    least = math.ceil(n * height / heap.top)
    heap.press(1e-3 * height)
    jammed = n * height / float(heap.high[heap.up])
    return max(least, seen.floor), math.floor(np.mean([*seen.jams, jammed]))


# --- what it is like


def describe(wanted: Request, centres: Floats, radii: Floats) -> dict[str, Any]:
    """What goes into run.json: realised mean, spread, count, densities, coordination, and how the packing was made."""
    low, high = wanted.low, np.array(wanted.container[1])
    contacts = touching(centres, radii, low, high)
    given = wanted.particles
    backbone, rattlers = contacts.backbone_coordination(wanted.dim + (given.method != "pour"))
    return {
        "method": given.method,
        "seed": given.seed,
        "count": len(radii),
        "mean_radius": float(radii.mean()),
        "std_radius": float(radii.std()),
        "packing_density": solid_fraction(centres, radii, low, high),
        "coordination": contacts.coordination,
        "backbone_coordination": backbone,
        "rattlers": rattlers,
        "largest_overlap": contacts.overlap,
        "connected": contacts.clusters == 1,
        "percolates": contacts.percolates(wanted.dim - 1),
    }
