"""Where a rank's time goes: seconds per phase of a run, and its largest memory."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

PHASES = ("set-up", "gather", "scatter", "halo", "rigid motion", "live points", "output", "steps")


class Stopwatch:
    """Seconds per phase. The clock always runs, in one phase at a time: a phase inside another interrupts it."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PHASES, 0.0)
        self.current, self.since = PHASES[0], perf_counter()

    def enter(self, phase: str) -> str:
        """Go over to a phase; the one before is returned."""
        now, before = perf_counter(), self.current
        self.seconds[before] += now - self.since
        self.current, self.since = phase, now
        return before

    @contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        """A phase for the length of a block, then again the one before."""
        before = self.enter(phase)
        try:
            yield
        finally:
            self.enter(before)

    def read(self) -> dict[str, float]:
        """Seconds per phase until now, and `memory`, GB that the process has held at most."""
        self.enter(self.current)
        return self.seconds | {"memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9}


def table(ranks: list[dict[str, float]]) -> str:
    """Phases by ranks, in seconds and in parts of the slowest rank's whole."""
    whole = max(sum(rank[phase] for phase in PHASES) for rank in ranks)
    head = f"{'seconds':14}" + "".join(f"{f'rank {number}':>10}" for number in range(len(ranks))) + f"{'share':>8}"
    lines = [head]
    for phase in PHASES:
        values = [rank[phase] for rank in ranks]
        lines.append(f"{phase:14}" + "".join(f"{v:10.2f}" for v in values) + f"{max(values) / whole:8.1%}")
    lines.append(f"{'memory, GB':14}" + "".join(f"{rank['memory']:10.2f}" for rank in ranks))
    return "\n".join(lines)
