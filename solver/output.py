"""The run directory: run.json, history.jsonl and snapshots.zarr."""

import fcntl
import json
import os
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .arrays import Floats, Numbers
from .case import Case
from .durable import read_json, replace_durably, write_whole
from .partition import Collector, Ranks

BLOCK = 65_536  # nodes per chunk of a snapshot
# Of the group; those of before had no `values`, and held coefficients.
ATTRIBUTES: dict[str, Any] = {"length_unit": "nm", "values": "fields at the nodes"}


class DirectoryError(ValueError):
    """A run directory that cannot be used; the message says why."""


LOCK = "lock"
OWN = ("case.json", "checkpoint.h5", "history.jsonl", "particles.csv", "run.json")  # files that the solver replaces


def write_json(path: Path, tree: Any) -> None:
    """A JSON file; see `write_text`."""
    write_text(path, json.dumps(tree, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Durable, whole or not at all; safe where several ranks write the same file at once."""
    write_whole(path, text.encode())


def remove_torn(directory: Path) -> None:
    """Remove what a solver was writing when it was killed; by who has the lock. Others write beside files as well."""
    for name in OWN:
        for torn in directory.glob(f"{name}*.new"):
            torn.unlink(missing_ok=True)


def read_state(directory: Path) -> str | None:
    """Of run.json; None before there is one."""
    return read_json(directory / "run.json").get("state")


def now() -> str:
    """The time of day in UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def lock(directory: Path) -> None:
    """Hold the run directory until this process ends; DirectoryError where another one holds it."""
    while True:
        handle = os.open(directory / LOCK, os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), os.stat(directory / LOCK)):
                return
        except FileNotFoundError:
            pass  # a run that came to its end has just removed it
        except OSError as error:
            os.close(handle)
            raise DirectoryError(f"{directory}: another process is running here") from error
        os.close(handle)


class History:
    """history.jsonl, appended by rank 0: one line per row, each written with one call and flushed."""

    def __init__(self, directory: Path, after: float | None = None) -> None:
        """after: keep the rows up to this time (a resumed run writes later ones again); None: start anew."""
        self.path = directory / "history.jsonl"
        kept = [] if after is None else [line for line in self._lines() if json.loads(line)["time"] <= after]
        beside = self.path.with_name("history.jsonl.new")
        beside.write_text("".join(kept))
        replace_durably(beside, self.path)
        self.file = open(self.path, "a", buffering=1)  # noqa: SIM115  (open as long as the run)

    def _lines(self) -> list[str]:
        """The complete lines; a torn last one is not complete."""
        if not self.path.exists():
            return []
        return [line for line in self.path.read_text().splitlines(keepends=True) if line.endswith("\n")]

    def vacancy_ratios(self) -> tuple[float, float] | None:
        """Of the first and the last row, where there is one."""
        rows = [json.loads(line)["vacancy_ratio"] for line in self._lines()]
        return (rows[0], rows[-1]) if rows else None

    def append(self, row: dict[str, Any]) -> None:
        """Add a row."""
        self.file.write(json.dumps(row, allow_nan=False) + "\n")

    def sync(self) -> None:
        """Make all rows durable: before a checkpoint that counts on them."""
        os.fsync(self.file.fileno())

    def close(self) -> None:
        """Make all rows durable and close."""
        self.sync()
        self.file.close()


class Fields(NamedTuple):
    """What a snapshot holds of some nodes."""

    rho: Floats
    eta_squared: Floats  # sum eta^2
    particle: Numbers  # with the largest eta where rho >= 1/2, else -1


class Snapshots:
    """snapshots.zarr, zarr v3: every rank writes the chunks of its block of nodes.

    A snapshot becomes visible at once: its chunks are written while the arrays still end before it, then the arrays
    grow, and last the group's consolidated metadata is replaced. Readers that use it (zarr and xarray do) see the
    arrays before or after, never between; `time` grows last for all others.
    """

    def __init__(
        self, directory: Path, case: Case, positions: Callable[[slice], Floats], collector: Collector, fresh: bool
    ) -> None:
        """Collective. positions: of some nodes (n, dim); fresh: make the group anew, else go on with the one there."""
        self.path, self.collector, self.ranks = directory / "snapshots.zarr", collector, collector.share.ranks
        self.times = case.output.snapshot_times(case.time.end)
        if self.ranks.root and fresh:
            create_group(self.path, case, collector.share.total, collector.block)
        elif self.ranks.root:
            for torn in self.path.rglob("*.partial"):  # files that zarr was writing when the run was killed
                torn.unlink()
        self.ranks.barrier()
        if fresh:
            self._place(positions)

    def _place(self, positions: Callable[[slice], Floats]) -> None:
        """Write where the nodes are, each rank its blocks, and only then show the group."""
        import zarr

        stored = zarr.open_array(self.path, path="nodes", mode="r+")
        for start in range(self.collector.first, self.collector.last, self.collector.block):
            block = slice(start, min(start + self.collector.block, self.collector.last))
            stored[block] = positions(block)
        self.ranks.barrier()
        if self.ranks.root:
            consolidate(self.path)
        self.ranks.barrier()

    def write(self, number: int, time: float, fields: Fields | None) -> None:
        """Write snapshot `number` (again, where a resumed run passes it again). Collective.

        fields: at the nodes of this rank's blocks, see `partition.Collector`; None where it has none.
        """
        first, last = self.collector.first, self.collector.last
        if fields is not None and last > first:
            for name, block in fields._asdict().items():
                grown(self.path, name, number + 1)[number, first:last] = block
        self.ranks.barrier()
        if self.ranks.root:
            self._publish(number, time)
        self.ranks.barrier()

    def next(self, time: float) -> int:
        """The number of the first snapshot that was asked for after a time."""
        return sum(asked <= time for asked in self.times)

    def _publish(self, number: int, time: float) -> None:
        import zarr

        names = ("rho", "eta_squared", "particle", "time")
        stored = {name: zarr.open_array(self.path, path=name, mode="r+") for name in names}
        grown(self.path, "time", number + 1)[number] = time
        if stored["time"].shape[0] <= number:
            for array in stored.values():
                array.resize((number + 1, *array.shape[1:]))
        consolidate(self.path)  # again too, where a run was killed just before this line


def fields_of(values: Floats, owner: Numbers) -> Fields:
    """Of fields by slots: values (n, 1 + slots) hold rho and the slots of eta, owner (n, slots) whose they are."""
    eta = values[:, 1 : 1 + owner.shape[1]]
    slot = eta.argmax(axis=1)
    particle = np.take_along_axis(owner, slot[:, None], axis=1)[:, 0]
    solid = np.where(values[:, 0] >= 0.5, particle, -1).astype(np.int32)
    return Fields(values[:, 0], (eta**2).sum(axis=1), solid)


def create_group(path: Path, case: Case, count: int, block: int) -> None:
    """An empty group for so many nodes, without consolidated metadata.

    Fields are kept in 32 bits: 1e-7 of their largest value.
    """
    import zarr
    from zarr.codecs import BloscCodec, BloscShuffle

    packed = BloscCodec(cname="zstd", clevel=5, shuffle=BloscShuffle.shuffle)
    group = zarr.open_group(path, mode="w", zarr_format=3, attributes=ATTRIBUTES | {"name": case.name})
    group.create_array(
        "nodes", shape=(count, case.dim), chunks=(block, case.dim), dtype="float64", dimension_names=("node", "axis"),
        compressors=packed, attributes={"units": "nm", "long_name": "position of the node"},
    )  # fmt: skip
    group.create_array(
        "time", shape=(0,), chunks=(1,), dtype="float64", dimension_names=("time",),
        attributes={"units": "1", "long_name": "model time"}, fill_value=np.nan,
    )  # fmt: skip
    described = {
        "rho": ("float32", np.nan, "concentration: 1 solid, 0 vacancy"),
        "eta_squared": ("float32", np.nan, "sum of the squared order parameters"),
        "particle": ("int32", -1, "number of the particle that owns the node, -1: vacancy"),
    }
    for name, (kind, fill, words) in described.items():
        group.create_array(
            name, shape=(0, count), chunks=(1, block), dtype=kind, dimension_names=("time", "node"),
            compressors=packed,
            attributes={"units": "1", "long_name": words}, fill_value=fill,
        )  # fmt: skip


def grown(path: Path, name: str, length: int) -> Any:
    """The array with room for `length` snapshots, in this process alone: what is stored still has its old shape."""
    import zarr
    from zarr.core.array import AsyncArray

    stored = zarr.open_array(path, path=name, mode="r+")._async_array
    shape = (max(length, stored.shape[0]), *stored.shape[1:])
    return zarr.Array(AsyncArray(stored.metadata.update_shape(shape), stored.store_path))


def consolidate(path: Path) -> None:
    """Replace the group's consolidated metadata: the one file that decides what a reader sees."""
    import zarr

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
        zarr.consolidate_metadata(path)


def block_size(directory: Path, nodes: int, ranks: Ranks, fresh: bool) -> int:
    """Nodes per chunk: at most BLOCK, and at least one chunk per rank where there are nodes enough.

    A resumed run keeps the chunks that are there, whatever its ranks: only then does each have one writer.
    """
    import zarr

    if fresh:
        return max(1, min(BLOCK, -(-nodes // ranks.size)))
    return int(zarr.open_array(directory / "snapshots.zarr", path="rho", mode="r").chunks[1])
