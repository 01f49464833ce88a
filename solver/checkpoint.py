"""checkpoint.h5: the last complete state of a run, replaced atomically; resuming continues the same run."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .arrays import Floats
from .durable import replace_durably
from .geometry import Mesh
from .partition import Collector
from .scheme import Scheme
from .state import State
from .system import Progress

NAME = "checkpoint.h5"
FORMAT = 3
READABLE = (1, 2, 3)  # 1 lacks the rigid motion; in 1 and 2 the nodes of a lattice follow the space-filling curve, and
# the state in which the live points were chosen is that after the choice, which is not made better by another one


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be used; the message says why."""


@dataclass(frozen=True)
class Checkpoint:
    """A state on all nodes, and the state from which the live points were last chosen.

    Choosing them again at `reference` and going on from `state` repeats what an uninterrupted run does.
    """

    state: State
    reference: State
    memory: dict[str, float]
    motion: Floats | None  # (particles, dim + rotations) `Scheme.carried`; None: not known
    wall_time: float


def write(
    directory: Path, scheme: Scheme, state: State, collector: Collector, mesh: Mesh, notes: dict[str, Any]
) -> None:
    """Collective; rank 0 writes. notes: identity, memory, wall_time."""
    fields = {
        "u": collector.whole(state.u),
        "owner": collector.whole(state.owner),
        "reference": collector.whole(scheme.before.u),
        "reference_owner": collector.whole(scheme.before.owner),
    }
    if not scheme.d.share.ranks.root:
        return
    fields |= {"slot_of": state.slot_of, "reference_slot_of": scheme.before.slot_of, "motion": scheme.carried}
    store(directory, fields, state, len(mesh.nodes), mesh_hash(mesh), notes)


def store(
    directory: Path, fields: dict[str, Any], state: Progress, nodes: int, mesh: str, notes: dict[str, Any]
) -> None:
    """Write beside the old file, make it durable, and rename. mesh: a fingerprint of what the fields stand on."""
    beside = directory / (NAME + ".new")
    try:
        with h5py.File(beside, "w") as file:
            for name, values in fields.items():
                file[name] = values
            file.attrs.update(format=FORMAT, time=state.time, step=state.step, evaluations=state.evaluations)
            file.attrs.update(nodes=nodes, mesh=mesh, notes=json.dumps(notes))
    except (KeyError, RuntimeError, ValueError) as error:  # HDF5's words for a disk that is full, among others
        raise OSError(f"{NAME} could not be written: {error}") from error
    replace_durably(beside, directory / NAME)


def read(directory: Path, identity: str, mesh: Mesh) -> Checkpoint:
    """The checkpoint of a run directory; CheckpointError where it belongs to another case or mesh."""
    values, counts, notes = load(directory, identity, len(mesh.nodes), mesh_hash(mesh))
    state = State(*counts, values["u"], values["owner"], values["slot_of"])
    chosen_from = [values.get(f"reference_{name}", values[name]) for name in ("owner", "slot_of")]
    reference = State(*counts, values["reference"], *chosen_from)
    return Checkpoint(state, reference, notes["memory"], values.get("motion"), notes["wall_time"])


def load(
    directory: Path, identity: str, nodes: int, mesh: str
) -> tuple[dict[str, Any], tuple[float, int, int], dict[str, Any]]:
    """What `store` has written: fields; time, step and evaluations; notes. Raises `CheckpointError`."""
    path = directory / NAME
    try:
        with h5py.File(path) as file:
            values = {name: dataset[...] for name, dataset in file.items()}
            attributes = dict(file.attrs)
    except (OSError, KeyError) as error:
        raise CheckpointError(f"{path}: cannot be read as a checkpoint: {error}") from error
    if attributes["format"] not in READABLE:
        raise CheckpointError(f"{path}: format {attributes['format']}, this frit reads formats {READABLE}")
    notes = json.loads(attributes["notes"])
    if notes["identity"] != identity:
        raise CheckpointError(f"{path}: belongs to another case than case.json")
    if attributes["mesh"] != mesh:
        then = attributes["nodes"]
        raise CheckpointError(f"{path}: the mesh has changed since: {then} nodes then, {nodes} now")
    return values, (float(attributes["time"]), int(attributes["step"]), int(attributes["evaluations"])), notes


def by_rows(directory: Path) -> bool:
    """Whether the checkpoint numbers the nodes of a lattice by rows; True where `read` will find out what is wrong."""
    try:
        with h5py.File(directory / NAME) as file:
            return int(file.attrs["format"]) >= 3
    except (OSError, KeyError):
        return True


def mesh_hash(mesh: Mesh) -> str:
    """A fingerprint of the nodes and cells."""
    return hashlib.sha256(np.ascontiguousarray(mesh.nodes).tobytes() + mesh.cells.tobytes()).hexdigest()
