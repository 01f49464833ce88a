"""Who owns which points and nodes, and how ranks speak to each other. Nothing else in frit imports MPI.

Points are divided by recursive coordinate bisection of their weights. A rank holds every node that its points see;
nodes held by several ranks are *shared*: each rank sums its own points' shares there, `Halo.add` exchanges these
partial sums, and every holder adds them in the order of the ranks, so that all hold the same bits. Sums over nodes
count a node on its *owner*, the lowest rank that holds it.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import mpi4py
import numpy as np

from .arrays import Array, Flags, Floats, Integers
from .profile import Stopwatch

mpi4py.rc.threads = False
from mpi4py import MPI  # noqa: E402  (after the settings above)

Thing = TypeVar("Thing")
Places = Integers | list[slice]  # in an array: one by one, or in stretches


class Ranks:
    """A communicator with the few collective operations that frit needs; every one is free on a single rank."""

    def __init__(self, communicator: "MPI.Intracomm | None" = None) -> None:
        self.comm = MPI.COMM_SELF if communicator is None else communicator
        self.rank: int = self.comm.Get_rank()
        self.size: int = self.comm.Get_size()
        self.watch = Stopwatch()

    @classmethod
    def world(cls) -> "Ranks":
        """All ranks that mpirun started."""
        return cls(MPI.COMM_WORLD)

    @property
    def root(self) -> bool:
        """Whether this is rank 0, the one that writes histories and checkpoints."""
        return self.rank == 0

    def sum(self, array: Floats) -> Floats:
        """Sum over the ranks, in place."""
        if self.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, array, MPI.SUM)
        return array

    def max(self, array: Floats) -> Floats:
        """Maximum over the ranks, in place."""
        if self.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, array, MPI.MAX)
        return array

    def everyones(self, array: Array) -> list[Array]:
        """Each rank's array, on every rank. For set-up and rare events: arrays travel as Python objects."""
        return self.comm.allgather(array) if self.size > 1 else [array]

    def from_root(self, thing: Any) -> Any:
        """Rank 0's object on every rank. For set-up and rare events."""
        return self.comm.bcast(thing) if self.size > 1 else thing

    def in_turn(self, things: Iterable[Thing]) -> Iterator[Thing]:
        """On rank 0 everybody's things, one rank after another, each sent when it is wanted; elsewhere none.

        Collective: all ranks must take what comes to the end. For rare events: things travel as Python objects.
        """
        if not self.root:
            for thing in things:
                self.comm.send(thing, 0)
            self.comm.send(None, 0)
            return
        yield from things
        for rank in range(1, self.size):
            while (received := self.comm.recv(source=rank)) is not None:
                yield received

    def barrier(self) -> None:
        """Wait for everyone."""
        if self.size > 1:
            self.comm.Barrier()

    def abort(self, status: int) -> None:
        """End every rank at once."""
        MPI.COMM_WORLD.Abort(status)


def mpi_library() -> str:
    """The name and version of the MPI library, one line."""
    return MPI.Get_library_version().split("\n")[0].strip("\x00 ")


def bisect(points: Floats, weights: Floats, parts: int) -> Integers:
    """The part (0 ... parts - 1) of each point: cut at the weighted median across the longest side, and again.

    points (p, dim), weights (p,) > 0. Parts differ in weight by about one point; the result is the same everywhere. Of
    sides as long as each other the last is cut: whole rows along x make whole `blocks`.
    """
    part = np.zeros(len(points), dtype=np.int64)
    todo = [(np.arange(len(points)), 0, parts)]
    while todo:
        chosen, first, count = todo.pop()
        if count == 1:
            part[chosen] = first
            continue
        left = count // 2
        extent = np.ptp(points[chosen], axis=0)
        axis = int(np.flatnonzero(extent >= 0.99 * extent.max())[-1])
        chosen = chosen[np.argsort(points[chosen, axis], kind="stable")]
        heavy = np.cumsum(weights[chosen])
        cut = int(np.searchsorted(heavy, heavy[-1] * left / count))
        cut = min(max(cut, left), len(chosen) - (count - left))
        todo += [(chosen[:cut], first, left), (chosen[cut:], first + left, count - left)]
    return part


class Halo:
    """The places of an array that this rank shares with others, and the exchange of values there."""

    def __init__(self, ranks: Ranks, size: int, neighbours: Sequence[tuple[int, Places]]) -> None:
        """neighbours: other ranks, and where their values belong here, in the same order there."""
        self.ranks, self.size, self.neighbours = ranks, size, neighbours
        self.in_pairs = bool((self._others() <= 1).all())  # no place has three holders

    def _others(self) -> Array:
        """(size,) how many other ranks hold each place."""
        found = np.zeros(self.size, dtype=np.int16)
        for _, common in self.neighbours:
            for some in stretches(common):
                found[some] += 1
        return found

    @cached_property
    def owned(self) -> Flags:
        """(size,) places that no lower rank holds."""
        found = np.ones(self.size, dtype=bool)
        for rank, common in self.neighbours:
            for some in stretches(common) if rank < self.ranks.rank else ():
                found[some] = False
        return found

    @cached_property
    def shared(self) -> Integers:
        """Places that other ranks hold, too."""
        return np.flatnonzero(self._others())

    @classmethod
    def of_nodes(cls, ranks: Ranks, nodes: Integers) -> "Halo":
        """nodes: the global numbers of this rank's nodes, sorted. Collective."""
        neighbours: list[tuple[int, Places]] = []
        for rank, theirs in enumerate(ranks.everyones(nodes)):
            if rank != ranks.rank:
                common = np.flatnonzero(np.isin(nodes, theirs, assume_unique=True))
                neighbours += [(rank, common)] if common.size else []
        return cls(ranks, nodes.size, neighbours)

    def of(self, places: Integers) -> "Halo":
        """The halo of an array whose entry i belongs to places[i] of this one; all ranks must have the same order."""
        neighbours: list[tuple[int, Places]] = []
        known = np.zeros(self.size, dtype=bool)
        for rank, common in self.neighbours:
            known[:] = False
            for some in stretches(common):
                known[some] = True
            neighbours.append((rank, np.flatnonzero(known[places])))
        return Halo(self.ranks, places.size, neighbours)

    def add(self, array: Array) -> None:
        """Replace each shared node's partial sum by the sum over its holders, in place; (n,) or (n, F)."""
        self.finish(array, self.start(array))

    def start(self, array: Array) -> "Exchange | None":
        """Send the partial sums at the shared nodes; until `finish` they must stay as they are."""
        if not self.neighbours:
            return None
        with self.ranks.watch("halo"):
            return Exchange(self, array)

    def finish(self, array: Array, exchange: "Exchange | None") -> None:
        """Add what the other holders have sent, in the order of the ranks."""
        if exchange is None:
            return
        with self.ranks.watch("halo"):
            received = exchange.wait()
            if self.in_pairs:  # two numbers have the same sum in any order
                for (_, common), theirs in zip(self.neighbours, received, strict=True):
                    add_at(array, common, theirs)
                return
            mine = array[self.shared]
            array[self.shared] = 0
            waiting = True
            for (rank, common), theirs in zip(self.neighbours, received, strict=True):
                if waiting and rank > self.ranks.rank:
                    array[self.shared] += mine
                    waiting = False
                add_at(array, common, theirs)
            if waiting:
                array[self.shared] += mine

    def most(self, array: Array) -> None:
        """Replace each shared node's value by the largest of its holders, in place."""
        for (_, common), theirs in zip(self.neighbours, Exchange(self, array).wait(), strict=True):
            for some, values in parts_of(common, theirs):
                array[some] = np.maximum(array[some], values)


def stretches(places: Places) -> list[Any]:
    """What arrays take in their brackets: the numbers of all places, or one slice after another."""
    return places if isinstance(places, list) else [places]


def taken(array: Array, places: Places) -> Array:
    """A copy of what is there."""
    return np.concatenate([array[some] for some in places]) if isinstance(places, list) else array[places]


def parts_of(places: Places, values: Array) -> Iterator[tuple[Any, Array]]:
    """The values of each stretch."""
    if not isinstance(places, list):
        yield places, values
        return
    at = 0
    for some in places:
        yield some, values[at : (at := at + some.stop - some.start)]


def add_at(array: Array, places: Places, values: Array) -> None:
    """Add values to an array at places that are all different."""
    for some, part in parts_of(places, values):
        array[some] += part


class Exchange:
    """Values on their way between a rank and its neighbours."""

    def __init__(self, halo: Halo, array: Array) -> None:
        """Sends the array's values at the nodes shared with each neighbour, and awaits its."""
        comm = halo.ranks.comm
        self.sent = [taken(array, common) for _, common in halo.neighbours]
        self.received = [np.empty_like(values) for values in self.sent]
        pairs = list(zip(halo.neighbours, self.received, self.sent, strict=True))
        self.requests = [comm.Irecv(theirs, rank) for (rank, _), theirs, _ in pairs]
        self.requests += [comm.Isend(mine, rank) for (rank, _), _, mine in pairs]

    def poll(self) -> None:
        """Let MPI go on with it: values of 8 kB and more move only while both sides call."""
        MPI.Request.Testall(self.requests)

    def wait(self) -> list[Array]:
        """Every neighbour's values at the nodes shared with it."""
        MPI.Request.Waitall(self.requests)
        return self.received


def pieces(low: int, high: int, size: int, under_way: Exchange | None) -> Iterator[tuple[int, int]]:
    """low ... high - 1 in pieces of that size, after each of which what is under way goes on; else in one piece."""
    step = size if under_way else max(high - low, 1)
    for begin in range(low, high, step):
        yield begin, min(begin + step, high)
        if under_way:
            under_way.poll()


@dataclass(frozen=True)
class Share:
    """One rank's part of the mesh: global numbers of its points and nodes (sorted) and the halo."""

    ranks: Ranks
    points: Integers
    nodes: Integers
    halo: Halo
    total: int  # number of nodes of the whole mesh

    @property
    def owned(self) -> Integers:
        """Local numbers of the nodes that this rank owns."""
        return np.flatnonzero(self.halo.owned)


class Collector:
    """Brings nodal values of all ranks into the mesh's order: whole on rank 0, or in blocks for parallel writing."""

    def __init__(self, share: Share, block: int) -> None:
        """block: nodes per block; block j belongs to one rank, neighbouring blocks to the same or the next."""
        self.share = share
        self.block = block
        ranks, total = share.ranks, share.total
        blocks = -(-total // block)
        limits = np.array([min(total, block * (blocks * r // ranks.size)) for r in range(ranks.size + 1)])
        limits[-1] = total
        self.first, self.last = int(limits[ranks.rank]), int(limits[ranks.rank + 1])
        owned = share.nodes[share.owned]
        target = np.searchsorted(limits, owned, side="right") - 1
        self.sent = np.bincount(target, minlength=ranks.size)
        self.received = np.array([counts[ranks.rank] for counts in ranks.everyones(self.sent)])
        self.place = self._route(owned) - self.first
        self.lengths = np.diff(limits)

    def _route(self, values: Array) -> Array:
        """Values of the owned nodes, sorted by number, to the ranks of their blocks; rows stay whole."""
        ranks = self.share.ranks
        if ranks.size == 1:
            return values
        row = int(np.prod(values.shape[1:], dtype=np.int64))
        got = np.empty((int(self.received.sum()), *values.shape[1:]), dtype=values.dtype)
        kind = MPI._typedict[values.dtype.char]
        ranks.comm.Alltoallv(
            [np.ascontiguousarray(values), self.sent * row, kind], [got, self.received * row, kind]
        )
        return got

    def blocks(self, values: Array) -> Array:
        """This rank's blocks [first, last) of the values; `values` are given at this rank's own nodes, in order."""
        placed = np.empty((self.last - self.first, *values.shape[1:]), dtype=values.dtype)
        placed[self.place] = self._route(values[self.share.owned])
        return placed

    def whole(self, values: Array, everywhere: bool = False) -> Array | None:
        """All values in the mesh's order on rank 0, None elsewhere; or on every rank."""
        part = self.blocks(values)
        ranks = self.share.ranks
        if ranks.size == 1:
            return part
        row = int(np.prod(values.shape[1:], dtype=np.int64))
        kind = MPI._typedict[values.dtype.char]
        wanted = ranks.root or everywhere
        everything = np.empty((self.share.total, *values.shape[1:]), dtype=values.dtype) if wanted else None
        target = [everything, self.lengths * row, kind] if wanted else None
        if everywhere:
            ranks.comm.Allgatherv([part, part.size, kind], target)
        else:
            ranks.comm.Gatherv([part, part.size, kind], target)
        return everything
