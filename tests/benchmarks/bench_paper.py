"""The bars that frit sets itself, measured: `make bench-paper`, or `python tests/benchmarks/bench_paper.py [NAME ...]`.

Runs are whole commands, `frit run CASE --ranks 2`, so that start, set-up and output count; the two-disc cases, whose
bar is one core's time loop, run in this process. `packs-3d` takes the better part of an hour and runs only when named.
The output is a table in Markdown for RESULTS.md.
"""

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from bench import Loop, two_discs

from frit.solver.case import Case, load_case, parse_case
from frit.solver.pack_store import packed
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh, make_integrator, prepare
from frit.solver.run import check, renew

PAPER = Path(__file__).parents[2] / "sweeps" / "paper"
OFF = {"enabled": False, "few_order_parameters": False}
ADAPTIVE = {"end": 10.0, "integrator": "adaptive"}
NECK = 17.33  # nm at t = 10, converged differences


class Command:
    """`frit run` of a case: wall seconds from start to end, and its records."""

    def __init__(self, case: Case, ranks: int = 2, keep: Path | None = None) -> None:
        with tempfile.TemporaryDirectory(prefix="frit-bench-") as folder:
            file, out = Path(folder) / "case.json", keep or Path(folder) / "run"
            file.write_text(case.resolved_json())
            began = time.monotonic()
            frit = Path(sys.executable).with_name("frit")
            command = [str(frit), "run", str(file), "--ranks", str(ranks), "--out", str(out)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            self.seconds = time.monotonic() - began
            self.history = [json.loads(line) for line in (out / "history.jsonl").read_text().splitlines()]
            self.profile: list[dict[str, float]] = json.loads((out / "run.json").read_text())["profile"]
        phases = ("gather", "scatter", "halo", "rigid motion", "live points", "steps")
        self.loop = max(sum(rank[phase] for phase in phases) for rank in self.profile)  # without start, set-up, output
        self.memory = sum(rank["memory"] for rank in self.profile)
        self.evaluations = self.history[-1]["evaluations"]
        self.live = self.history[-1]["live_fraction"]

    def column(self, name: str) -> Any:
        """One column of the history."""
        return np.array([row[name] for row in self.history])


def row(name: str, bar: str, found: str, loop: Loop | Command) -> str:
    """A line of the table."""
    memory = f"{loop.memory:.2f}" if isinstance(loop, Command) else ""
    return f"| {name} | {bar} | {found} | {loop.evaluations} | {loop.seconds:.2f} | {loop.live:.2f} | {memory} |"


def discs() -> Iterator[str]:
    """Two discs without rigid motion."""
    Loop(two_discs(end=0.1))  # compiled, or read from disk
    loops = sorted((Loop(two_discs(time=ADAPTIVE)) for _ in range(5)), key=lambda loop: loop.seconds)
    error = loops[2].neck / NECK - 1.0
    yield row("two discs, no motion, t = 10", "neck 1 %, 0.8 s", f"neck {error:+.2%}, median of 5 runs", loops[2])


def motion() -> Iterator[str]:
    """Two discs with rigid motion, against `rk2` at a tenth of its stable step."""
    resting = Loop(two_discs(time=ADAPTIVE))
    moving = Loop(two_discs(time=ADAPTIVE, model={"rigid_motion": True}))
    fine = Loop(two_discs(time={"end": 10.0, "integrator": "rk2", "step": 1e-4}, model={"rigid_motion": True}))
    ratio = moving.evaluations / resting.evaluations
    errors = f"neck {moving.neck / fine.neck - 1.0:+.3%}, distance {moving.distance / fine.distance - 1.0:+.3%}"
    yield row("the same with motion", "3 x evaluations; 0.3 %", f"{ratio:.2f} x; {errors}", moving)
    yield row("  rk2 at step 1e-4", "", "", fine)


def pack(**changes: Any) -> Case:
    """The paper's 2-D pack to t = 5."""
    tree = load_case(PAPER / "pack2d.toml").tree()
    tree["time"] |= {"end": 5.0}
    tree["output"] |= {"snapshots": [5.0], "history_every": 0.5}
    return parse_case(tree | changes)


def pack_2d() -> Iterator[str]:
    """The 2-D pack; and to t = 0.1, what the efficiency schemes save and change (all of it would take half an hour)."""
    short = {"time": {"end": 0.1}, "output": {"history_every": 0.05}}
    Command(pack(**short))  # compiled, and packed
    yield row("2-D pack, t = 5, 2 ranks", "30 s", "", Command(pack()))
    on, off = Command(pack(**short)), Command(pack(**short, activation=OFF))
    difference = np.abs(on.column("vacancy_ratio") - off.column("vacancy_ratio")).max()
    found = f"time loop {off.loop / on.loop:.1f} x slower, {off.seconds / on.seconds:.1f} x with start and set-up; "
    yield row("  to t = 0.1", "", "", on)
    yield row("  both schemes off", "10 x slower; 2e-4", f"{found}vacancy ratio differs by {difference:.1e}", off)


def packs_3d() -> Iterator[str]:
    """The paper's pack A to t = 15. The run stays in runs/pack_a, its history in pack_a.csv beside this file."""
    tree = load_case(PAPER / "pack_a.toml").tree()
    tree["time"] |= {"end": 15.0}
    tree["output"] |= {"snapshots": [0.0, 5.0, 15.0], "history_every": 0.25}
    folder = Path("runs/pack_a")
    shutil.rmtree(folder, ignore_errors=True)
    found = Command(parse_case(tree), keep=folder)
    names = ("time", "vacancy_ratio", "solid_mass", "free_energy", "live_fraction", "evaluations", "wall_time")
    lines = [",".join(f"{row[name]:.10g}" for name in names) for row in found.history]
    Path(__file__).with_name("pack_a.csv").write_text("\n".join([",".join(names), *lines]) + "\n")
    history = found.column("vacancy_ratio")
    yield row("3-D pack A, t = 15, 2 ranks", "45 min, 12 GB", f"{history[0]:.4f} to {history[-1]:.4f}", found)


def spacings() -> Iterator[str]:
    """Evaluations over the spacing, 2-D, without rigid motion."""
    counts = []
    for spacing in (2.0, 1.0, 0.5):
        loop = Loop(two_discs(nodes={"spacing": spacing}, time={"end": 10.0, "integrator": "adaptive"}))
        counts.append(loop.evaluations)
        yield row(f"two discs, spacing {spacing}", "", f"neck {loop.neck:.3f}", loop)
    slopes = [np.log2(b / a) for a, b in pairwise(counts)]
    yield f"| evaluations over h | no faster than h^-2 | h^{-slopes[0]:.2f}, h^{-slopes[1]:.2f} | | | | |"


def ranks() -> Iterator[str]:
    """The 2-D pack to t = 0.3 on one rank and on two, step by step in turns: the speed of machines changes."""
    mpirun = [str(Path(sys.executable).with_name("mpirun")), "-n", "2", sys.executable, __file__, "in-turns"]
    found = json.loads(subprocess.run(mpirun, check=True, capture_output=True, text=True).stdout)
    alone, apart, together = found["seconds"]
    said = f"{alone / together:.2f} x; two runs side by side do {2 * alone / apart:.2f} x the work of one"
    yield f"| 2-D pack, 1 -> 2 ranks | 1.8 x | {said} | {found['evaluations']} | {together:.2f} | | |"


def in_turns() -> None:
    """What `ranks` asks two ranks for. Each step is made by rank 0 for itself, by each rank for itself and by both
    together: what two cores can do at all shows in the second. Prints seconds, as JSON."""
    world = Ranks.world()
    case = pack(time={"end": 0.3}, output={"history_every": 0.3})
    packing = packed(case)
    case = case.with_particles(packing.centres, packing.radii)
    mesh = build_mesh(case, world)
    runs = [(*prepare(case, mesh, ranks), make_integrator(case, mesh)) for ranks in (Ranks(), Ranks(), world)]
    for scheme, state, integrator in runs:
        integrator.restart(scheme, state)
    seconds: list[list[float]] = []
    while runs[-1][1].time < case.time.end:
        seconds.append([])
        for number, (scheme, state, integrator) in enumerate(runs):
            wait(world)
            began = time.monotonic()
            if number > 0 or world.root:
                integrator.step(scheme, state, case.time.end)
                check(scheme, state, integrator.y)
                if renew(scheme, state, integrator.y):
                    integrator.restart(scheme, state)
            wait(world)
            seconds[-1].append(time.monotonic() - began)
    if world.root:
        whole = np.sum(seconds[1:], axis=0)  # the first step compiles, or reads what is compiled
        print(json.dumps({"seconds": whole.tolist(), "evaluations": runs[-1][1].evaluations}))


def wait(ranks: Ranks) -> None:
    """A barrier at which nobody keeps a core busy: MPI's own waiting does."""
    request = ranks.comm.Ibarrier()
    while not request.Test():
        time.sleep(2e-4)


CASES: dict[str, Callable[[], Iterator[str]]] = {
    "discs": discs, "spacings": spacings, "ranks": ranks, "pack-2d": pack_2d, "motion": motion, "packs-3d": packs_3d,
}  # fmt: skip


def main() -> None:
    """The table, line by line as it comes."""
    if sys.argv[1:] == ["in-turns"]:
        return in_turns()
    print("| case | bar | found | evaluations | seconds | live | memory, GB |\n|---|---|---|---|---|---|---|")
    for name in sys.argv[1:] or [name for name in CASES if name != "packs-3d"]:
        for line in CASES[name]():
            print(line, flush=True)


if __name__ == "__main__":
    main()
