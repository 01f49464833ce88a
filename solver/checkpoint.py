"""checkpoint.h5: the last complete state of a run, replaced atomically; resuming continues the same run."""

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from .arrays import Array, Floats
from .durable import replace_durably
from .geometry import Mesh
from .partition import Collector, Ranks
from .scheme import Scheme
from .state import State
from .system import Progress

NAME = "checkpoint.h5"
PIECE = 16_384  # nodes of a mesh that travel at a time
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


class Spread(NamedTuple):
    """A dataset of which every rank has a part: it is written piece by piece, and whole on no rank."""

    shape: tuple[int, ...]
    kind: np.dtype[Any]
    parts: Callable[[], Iterable[tuple[int, Array]]]  # this rank's: the first row of each, and its rows


class Head(NamedTuple):
    """What a checkpoint says beside its fields."""

    state: Progress
    nodes: int
    mesh: str  # a fingerprint of what the fields stand on
    notes: dict[str, Any]  # identity, memory, wall_time


def write(
    directory: Path, scheme: Scheme, state: State, collector: Collector, mesh: Mesh, notes: dict[str, Any]
) -> None:
    """Collective; rank 0 writes. notes: see `Head`."""

    def spread(values: Array) -> Spread:
        return Spread((len(mesh.nodes), values.shape[1]), values.dtype, lambda: in_pieces(collector, values))

    fields: dict[str, Array | Spread] = {
        "u": spread(state.u),
        "owner": spread(state.owner),
        "reference": spread(scheme.before.u),
        "reference_owner": spread(scheme.before.owner),
        "slot_of": state.slot_of,
        "reference_slot_of": scheme.before.slot_of,
        "motion": scheme.carried,
    }
    store(directory, scheme.d.share.ranks, fields, Head(state, len(mesh.nodes), mesh_hash(mesh), notes))


def in_pieces(collector: Collector, values: Array) -> Iterator[tuple[int, Array]]:
    """The values of this rank's blocks of nodes, and where they begin. Collective."""
    part = collector.blocks(values)
    for start in range(0, len(part), PIECE):
        yield collector.first + start, part[start : start + PIECE]


def store(directory: Path, ranks: Ranks, fields: Mapping[str, Array | Spread], head: Head) -> None:
    """Write beside the old file, make it durable, and rename. Collective; rank 0 writes."""
    if not ranks.root:
        for values in fields.values():
            for _ in ranks.in_turn(values.parts()) if isinstance(values, Spread) else ():
                pass
        return
    state, beside = head.state, directory / (NAME + ".new")
    try:
        with h5py.File(beside, "w") as file:
            for name, values in fields.items():
                if not isinstance(values, Spread):
                    file[name] = values
                    continue
                dataset = file.create_dataset(name, values.shape, values.kind)
                for first, rows in ranks.in_turn(values.parts()):
                    dataset[first : first + len(rows)] = rows
            file.attrs.update(format=FORMAT, time=state.time, step=state.step, evaluations=state.evaluations)
            file.attrs.update(nodes=head.nodes, mesh=head.mesh, notes=json.dumps(head.notes))
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
    directory: Path, identity: str, nodes: int, mesh: str, left: Collection[str] = ()
) -> tuple[dict[str, Any], tuple[float, int, int], dict[str, Any]]:
    """What `store` has written: fields; time, step and evaluations; notes. Raises `CheckpointError`.

    left: names of fields that are left in the file, for `rows`.
    """
    path = directory / NAME
    try:
        with h5py.File(path) as file:
            values = {name: dataset[...] for name, dataset in file.items() if name not in left}
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


def rows(directory: Path, name: str, wanted: Iterable[slice]) -> Iterator[Array]:
    """Some rows of a field. Raises `CheckpointError`."""
    try:
        with h5py.File(directory / NAME) as file:
            for some in wanted:
                yield file[name][some]
    except (OSError, KeyError) as error:
        raise CheckpointError(f"{directory / NAME}: cannot be read as a checkpoint: {error}") from error


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
