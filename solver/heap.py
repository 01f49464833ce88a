"""A heap of particles in a box, and what may be done to it: let it fall, press, shake, let it stick together.

Lengths are in units of the mean radius and measured from the container's lower corner; see dem.py for the forces.
"""

import math
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from . import dem
from .arrays import Floats, Integers
from .pack_measures import near_pairs, touching, volumes
from .radii import steady

LOOSEST = {2: 0.34, 3: 0.17}  # solid fraction of the pile between its walls, by dimension
SETTLED = {2: 0.75, 3: 0.55}  # solid fraction from which gravity takes over
TRIES = 30  # places above which a pile is level that a particle tries
RESTING = 0.002  # largest overlap of a heap that counts as relaxed, with particles and with walls
DT = 0.2  # in units of sqrt(mass / stiffness); contacts of the lightest particles are stable up to about 0.3
FALL = 0.1  # terminal velocity: a particle that lands is pressed in by about as much, for a moment
REST = 2e-3  # root mean square of the speeds of a heap that rests under its first gravity
LAST = 0.3  # of that, in the end
STAGES, MOST, LOWER = 2, 8, 0.07  # gravity is lowered so often, or more often if it must, each time to this part
LONGEST = 500  # times 100 steps, for each
CALM = 0.02  # drag of the later stages
DRAG = 0.1  # of the medium in which a heap relaxes
THICK = 0.4  # of that in which it is pressed: what gives way does not shake the others, or equal discs would order
BATCH = 25  # steps of the press between two looks
STRAIN = 1e-3  # of the press, per step: neighbours approach by 0.002 radii
YIELDING = 0.01  # overlap at which the press waits for the heap to give way
PATIENCE = 60  # times 50 steps, for which it waits
COHESION, REACH = 4e-4, 0.15  # pull of neighbours, and the gap across which they feel it
HEAT = 0.04  # thermal velocity of shaking at its start, which makes overlaps of as much


class Heap:
    """Particles with centres x (n, 3) and radii r (n,); in 2-D the third component is 0."""

    def __init__(self, r: Floats, box: Floats, rng: np.random.Generator) -> None:
        """Cohesive settling: each particle stays where it first touches. The pile may be higher than the box (dim,)."""
        n, self.dim = len(r), len(box)
        self.up = self.dim - 1
        self.r = r.copy()
        self.low, self.high = np.zeros(3), np.zeros(3)
        self.work = 0  # listed pairs, summed over all steps
        self.high[: self.dim] = box
        self.x, self.v, self.spin = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        self.contacts = dem.no_contacts()
        self.rng = rng
        level = float(volumes(self.r, self.dim).sum() / np.prod(box[:-1])) / LOOSEST[self.dim]
        dem.deposit(self.x, self.r, rng.random((n, TRIES, self.up)), self.low, self.high, self.dim, level)
        # Neighbours in space become neighbours in memory.
        order = np.lexsort((self.x / (2.0 * self.r.max())).astype(np.int64)[:, : self.dim].T[::-1])
        self.x, self.r = self.x[order], self.r[order]

    @property
    def top(self) -> float:
        """Height of the highest particle."""
        return float((self.x[:, self.up] + self.r).max())

    def march(self, steps: int, **physics: float) -> dem.Strain:
        """Move on by some steps; what is not given is off."""
        given: dict[str, Any] = {
            "gravity": 0.0, "friction": 0.0, "cohesion": 0.0, "reach": 0.0, "damping": 0.3, "drag": 0.0,
            "squeeze": 0.0, "lid": True, "dt": DT,
        } | physics  # fmt: skip
        self.contacts, strain = dem.march(
            self.x, self.v, self.spin, self.r, self.low, self.high,
            dem.Physics(self.dim, **given), self.contacts, steps,
        )  # fmt: skip
        self.work += strain[3]
        return dem.Strain(*strain)

    def pour(self, friction: float) -> None:
        """Let gravity pull until all is at rest.

        What the pile would fall is taken first, by a press without a lid or friction: in as many steps for a high pile
        as for a low one. The weight of all layers presses the lowest particles in by some per cent; once at rest,
        gravity is lowered, each time to rest, until the largest overlap is small.
        """
        solid = float(volumes(self.r, self.dim).sum()) / float(np.prod(self.high[: self.up]))
        self._lower(solid / SETTLED[self.dim], drag=DRAG, lid=False)
        first = gravity = 0.02 / max(0.5 * solid, 1.0)
        for stage in range(MOST):
            drag, slow = gravity / FALL + (CALM if stage else 0.0), REST * math.sqrt(gravity / first)
            strain = self._until_slow(slow, gravity=gravity, friction=friction, drag=drag, lid=False)
            if stage >= STAGES and strain.overlap < RESTING:
                self._until_slow(LAST * slow, gravity=gravity, friction=friction, drag=drag, lid=False)
                return
            gravity *= LOWER

    def _until_slow(self, slow: float, **physics: float) -> dem.Strain:
        """March until the root mean square of the speeds is below `slow`, and none is above ten times that."""
        for _ in range(LONGEST):
            strain = self.march(100, **physics)
            if strain.speed < 10.0 * slow and float(np.sqrt(np.mean(self.v**2))) < slow:
                break
        return strain

    def press(self, height: float) -> bool:
        """Lower the lid to the height, waiting where the heap resists, then relax; False: it jams, at high[up]."""
        return self._lower(height, drag=THICK) and self.relax()

    def _lower(self, height: float, **physics: float) -> bool:
        """Lower the top of the box from that of the pile to the height, and all below with it; False: it jams."""
        up, waited = self.up, 0
        self.high[up] = self.top
        strain = self.march(BATCH, **physics)
        while self.high[up] > height * (1.0 + 1e-12):
            if strain.overlap > YIELDING:
                if waited == PATIENCE:
                    return False
                waited, strain = waited + 1, self.march(50, **physics)
                continue
            waited, strain = 0, self.march(BATCH, squeeze=self._squeeze(height), **physics)
        return True

    def _squeeze(self, height: float) -> float:
        """The part that the box loses per step, so that BATCH of them bring it to the height, or nearer to it.

        The root is Newton's, which takes no power of the system's library (see `radii.steady`).
        """
        ratio = height / float(self.high[self.up])
        kept = 1.0 - (1.0 - ratio) / BATCH
        for _ in range(4):
            power = math.prod([kept] * (BATCH - 1))
            kept -= (kept * power - ratio) / (BATCH * power)
        return min(1.0 - kept, STRAIN)

    def relax(self) -> bool:
        """Wait until overlaps are small; False where they do not become so."""
        for _ in range(4 * PATIENCE):
            if self.march(50, drag=DRAG).overlap < 0.5 * RESTING:
                return True
        return self.march(50, drag=DRAG).overlap < RESTING

    def anneal(self, height: float, rounds: int) -> bool:
        """Press to the height whatever the overlaps, then shake ever more gently while radii are exchanged."""
        up, n = self.up, len(self.r)
        self.high[up] = self.top
        while self.high[up] > height * (1.0 + 1e-12):
            self.march(BATCH, drag=DRAG, squeeze=self._squeeze(height))
        for k in range(rounds):
            velocity = HEAT * (1.0 - k / rounds)
            self.v[:, : self.dim] = velocity * steady(self.rng.normal(size=(n, self.dim)))
            seed = int(self.rng.integers(2**31))
            dem.exchange(self.x, self.r, self.low, self.high, self.dim, seed, 20 * n, velocity**2)
            self.contacts = dem.no_contacts()
            self.march(100, drag=0.02, damping=0.0)
        return self.relax()

    def stick(self) -> None:
        """Weak cohesion draws together what is near; what still floats is moved until it touches."""
        for _ in range(100):
            strain = self.march(50, drag=DRAG, cohesion=COHESION, reach=REACH)
            if strain.speed < 1e-5:
                break
        for _ in range(len(self.r)):
            cluster = self._clusters()
            if cluster.max() == 0 or not self._join(cluster):
                return

    def _clusters(self) -> Integers:
        d = self.dim
        return touching(self.x[:, :d], self.r, self.low[:d], self.high[:d]).cluster

    def _join(self, cluster: Integers) -> bool:
        """Move each cluster but the largest to its nearest neighbour, if nothing is in the way; whether any moved.

        A cluster that moves by the smallest of its gaps, in whatever direction, overlaps nothing. Neighbours of what
        has moved wait for the next time.
        """
        sizes = np.bincount(cluster)
        pairs, gaps = near_pairs(self.x, self.r, float(self._widest_gap()))
        across = cluster[pairs[:, 0]] != cluster[pairs[:, 1]]
        pairs, gaps = pairs[across], gaps[across]
        settled, joined = np.zeros(len(sizes), dtype=bool), False
        order = np.argsort(gaps, kind="stable")
        for i, j in pairs[order]:
            a, b = (i, j) if sizes[cluster[i]] <= sizes[cluster[j]] else (j, i)
            if settled[cluster[a]] or settled[cluster[b]]:
                continue
            if self._move(np.flatnonzero(cluster == cluster[a]), a, b):
                settled[cluster[[a, b]]] = joined = True
        return joined

    def _move(self, members: Integers, a: int, b: int) -> bool:
        """Move the members until a of theirs touches b; False, and nothing moved, where there is no room."""
        line = self.x[b] - self.x[a]
        apart = math.sqrt(float((line**2).sum()))
        moved = self.x[members] + line * (1.0 - (self.r[a] + self.r[b]) / apart)
        d, slack = self.dim, 1e-6
        r = self.r[members, None]
        if (moved[:, :d] - r < self.low[:d] - slack).any() or (moved[:, :d] + r > self.high[:d] + slack).any():
            return False
        others = np.setdiff1d(np.arange(len(self.r)), members)
        tree = cKDTree(self.x[others])
        for place, radius in zip(moved, self.r[members], strict=True):
            near = others[tree.query_ball_point(place, radius + float(self.r.max()))]
            if (np.linalg.norm(self.x[near] - place, axis=1) - self.r[near] - radius < -RESTING).any():
                return False
        self.x[members] = moved
        return True

    def _widest_gap(self) -> float:
        """A distance within which every particle has neighbours: that of evenly spread ones, and room to spare."""
        return float((np.prod(self.high[: self.dim]) / len(self.r)) ** (1.0 / self.dim)) + float(self.r.max())
