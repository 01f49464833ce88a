"""Packings on disk: a cache by what decides them, and the particles of a run in its directory.

A cache file is named by the hash of the request and of the code that packs, and holds a checksum: what is damaged is
packed again. Replicates that share a packing, and runs that start anew, find it there.
"""

import hashlib
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from . import particle_file
from .case import Case
from .durable import write_json
from .jit import cache_root
from .pack_measures import solid_fraction
from .packing import Packing, Request, make, request

NAME = "particles.csv"  # in a run directory
CODE = ("dem.py", "heap.py", "jit.py", "overlaps.py", "packing.py", "pack_measures.py", "radii.py")


def packed(case: Case) -> Packing:
    """The packing that a case asks for, from the cache if it is there. Raises `CaseError` where there can be none."""
    wanted = request(case)
    path = cache_root() / "packings" / f"{key(wanted)}.json"
    packing = read(path)
    if packing is None:
        packing = make(wanted)
        with suppress(OSError):  # a cache that cannot be written only costs time
            write(path, packing)
    low, high = map(np.array, case.output.vacancy_box)
    inside = {"vacancy_box_density": solid_fraction(packing.centres, packing.radii, low, high)}
    return Packing(packing.centres, packing.radii, packing.realised | inside)


def key(wanted: Request) -> str:
    """SHA-256 of all that decides a packing."""
    particles = wanted.particles.model_dump(mode="json", exclude={"interface_width"})
    digest = hashlib.sha256(json.dumps([particles, wanted.box], sort_keys=True).encode())
    for name in CODE:
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()


def write(path: Path, packing: Packing) -> None:
    """Into the cache: a reader sees all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    body = json.dumps([packing.centres.tolist(), packing.radii.tolist(), packing.realised])
    write_json(path, {"sha256": hashlib.sha256(body.encode()).hexdigest(), "packing": body}, durable=False)


def read(path: Path) -> Packing | None:
    """From the cache; None where there is none, or a damaged one."""
    try:
        file = json.loads(path.read_text())
        body: str = file["packing"]
        if hashlib.sha256(body.encode()).hexdigest() != file["sha256"]:
            return None
        centres, radii, realised = json.loads(body)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return Packing(np.array(centres), np.array(radii), realised)


def place(case: Case, directory: Path, fresh: bool) -> tuple[Case, dict[str, Any] | None]:
    """The case with its particles, and what they are like where they were packed just now.

    A fresh run writes them into its directory, a resumed one reads them there. The asked case keeps its identity.
    """
    if case.particles.source != "packing":
        return case, None
    if fresh:
        packing = packed(case)
        particle_file.write(directory / NAME, packing.centres, packing.radii)
        return case.with_particles(packing.centres, packing.radii), packing.realised
    return case.with_particles(*particle_file.read(directory / NAME, case.dim)), None
