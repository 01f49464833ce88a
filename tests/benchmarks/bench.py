"""The solver's speed: `make bench`, or `python tests/benchmarks/bench.py [NAME ...]`, names as in `BENCHES`.

Every figure is the median of several runs in this process or of several processes, on one core. Machines differ and are
shared: the ratios count.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from frit.solver import vectors
from frit.solver.case import Case, parse_case
from frit.solver.geometry import lattice
from frit.solver.neck import Neck
from frit.solver.partition import Ranks
from frit.solver.prepare import build_mesh, make_integrator, prepare
from frit.solver.run import run
from frit.solver.scheme import Scheme
from frit.solver.setup import make_setup
from frit.solver.shape import lme
from frit.solver.simd import LANES
from frit.solver.state import State


class Silent:
    """An observer that writes nothing: only the solver is timed."""

    def history(self, *_: Any) -> None:
        """No row."""

    def snapshot(self, *_: Any) -> None:
        """No snapshot."""

    def after_step(self, *_: Any) -> bool:
        """Go on."""
        return False


def two_discs(end: float = 10.0, **changes: dict[str, Any]) -> Case:
    """Two touching discs of radius 20 nm at spacing 1, without rigid motion."""
    tree: dict[str, Any] = {
        "domain": {"size": [100.0, 60.0]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {"source": "list", "centres": [[30.0, 30.0], [70.0, 30.0]], "radii": [20.0, 20.0]},
        "model": {"rigid_motion": False},
        "time": {"end": end, "integrator": "rk2"},
        "output": {"history_every": end, "snapshots": []},
    }
    return parse_case({**tree, **changes})


class Loop:
    """A case run in this process on one core: seconds of the time loop, and what came out."""

    def __init__(self, case: Case) -> None:
        mesh = build_mesh(case, Ranks())
        scheme, self.state = prepare(case, mesh, Ranks())
        began = time.process_time()
        run(scheme, self.state, make_integrator(case, mesh), Silent())
        self.seconds = time.process_time() - began
        self.evaluations = self.state.evaluations
        self.live = scheme.active.live.size / scheme.d.weights.size
        self.neck = Neck(case, mesh).measure(fields(self.state)) if len(self.state.slot_of) == 2 else np.nan
        moments = scheme.d.first_moment.T @ fields(self.state)[:, 1:] / (scheme.d.mass @ fields(self.state)[:, 1:])
        self.distance = float(np.linalg.norm(moments[:, 1] - moments[:, 0])) if moments.shape[1] == 2 else np.nan


def fields(state: State) -> Any:
    """rho and the order parameters in the order of the particles, (n, 1 + particles)."""
    return state.u[:, [0, *(1 + state.slot_of)]]


def median(measure: Callable[[], float], runs: int) -> float:
    """The median of some runs, after one that is not counted."""
    measure()
    return statistics.median(measure() for _ in range(runs))


def bench_two_discs() -> None:
    """rk2 at the paper's step to t = 10, and what each choice is worth."""
    off = {"enabled": False, "few_order_parameters": False}
    cases = {
        "rk2, 2000 steps (bar: 10 s)": two_discs(),
        "  every point live": two_discs(activation=off),
        "  linear shape functions": two_discs(shape_functions={"kind": "linear"}),
        "adaptive, tolerance 1e-3": two_discs(time={"end": 10.0, "integrator": "adaptive"}),
    }
    print("two discs, spacing 1, t = 10, no rigid motion: processor seconds of the time loop")
    reference = 0.0
    for name, case in cases.items():
        evaluations = 0

        def measure(case: Case = case) -> float:
            nonlocal evaluations
            loop = Loop(case)
            evaluations = loop.evaluations
            return loop.seconds

        seconds = median(measure, 3)
        reference = reference or seconds
        print(
            f"  {name:32s} {seconds:7.2f} s  {evaluations:6d} evaluations  {1e3 * seconds / evaluations:6.2f} ms each"
            f"  ratio to the first {seconds / reference:.3f}"
        )


def bench_shape() -> None:
    """Shape functions of 128 000 points of 26 nodes."""
    mesh = lattice((250.0, 219.0), 0.985)
    jitter = np.random.default_rng(0).uniform(-1e-3, 1e-3, mesh.points.shape)
    shared = median(lambda: _seconds(lambda: lme(mesh.points, mesh.spacing, mesh.nodes, 1.8, 1e-6)), 5)
    own = median(lambda: _seconds(lambda: lme(mesh.points + jitter, mesh.spacing, mesh.nodes, 1.8, 1e-6)), 5)
    table = lme(mesh.points, mesh.spacing, mesh.nodes, 1.8, 1e-6)
    each = table.nodes.size / table.points
    print(f"shape functions, {table.points} points of {each:.1f} nodes: processor seconds (bar: 2 s)")
    print(f"  lattice, repeated rows solved once {shared:6.2f} s")
    print(f"  every point solved by itself       {own:6.2f} s  ratio {own / shared:.2f}")


def _seconds(work: Callable[[], Any]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def bench_start() -> None:
    """A whole process that runs a short case with a warm cache: what a user waits for before anything moves."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case.json"
        path.write_text(two_discs(0.01).resolved_json())
        launch = [sys.executable, "-P", "-m", "frit.solver", str(path), "--out"]
        counter = iter(range(100))

        def whole() -> float:
            began = time.monotonic()
            subprocess.run([*launch, f"{folder}/{next(counter)}"], check=True)
            return time.monotonic() - began

        def cold() -> float:
            environment = {**os.environ, "FRIT_CACHE_DIR": f"{folder}/cache"}
            began = time.monotonic()
            subprocess.run([*launch, f"{folder}/cold"], check=True, env=environment)
            return time.monotonic() - began

        warm = median(whole, 5)
        print("start, set-up, two steps and all output of the two-disc case in a process of its own: wall seconds")
        print(f"  warm cache {warm:6.2f} s,  empty cache {cold():6.2f} s")


def bench_particles() -> None:
    """Time per evaluation and memory with 10, 100 and 1000 particles on the same nodes, every point live."""
    print("10, 100, 1000 discs of radius 5 on the same nodes, every point live (bar: ratios within 1.2)")
    first: dict[str, float] = {}
    for count in (10, 100, 1000):
        output = subprocess.run(
            [sys.executable, __file__, "particles-one", str(count)], check=True, capture_output=True, text=True
        )
        result = json.loads(output.stdout)
        first = first or result
        print(
            f"  {count:5d} particles  {result['nodes']:.0f} nodes  {result['slots']:.0f} slots"
            f"  {1e3 * result['seconds']:7.2f} ms per evaluation  ratio {result['seconds'] / first['seconds']:.2f}"
            f"  with stiffness {1e3 * result['stiff']:7.2f} ms"
            f"  {result['values'] / result['nodes']:.2f} fields per node"
            f"  {1e9 * result['seconds'] / result['values']:.0f} ns each"
            f"  peak memory {result['memory']:.0f} MB  ratio {result['memory'] / first['memory']:.2f}"
        )


def particles_one(count: int) -> None:
    """One measurement of `bench_particles`, printed as JSON."""
    columns, radius = 32, 5.0
    centres = [
        [12.0 + 2 * radius * (k % columns) + radius * (k // columns % 2), 12.0 + radius * 3**0.5 * (k // columns)]
        for k in range(count)
    ]
    tree = {
        "domain": {"size": [340.0, 300.0]},
        "nodes": {"source": "triangular", "spacing": 1.0},
        "particles": {"source": "list", "centres": centres, "radii": [radius] * count},
        "time": {"end": 0.03, "integrator": "adaptive"},  # the rim of 1000 discs in contact is crushed after 0.05
        "activation": {"enabled": False},
        "output": {"history_every": 0.03, "snapshots": []},
    }
    case = parse_case(tree)
    mesh = build_mesh(case, Ranks())
    scheme, state = prepare(case, mesh, Ranks())
    run(scheme, state, make_integrator(case, mesh), Silent())
    scheme.activate(state)
    y = scheme.active.unknowns.take(state.u)
    rate = np.empty_like(y)

    def five_evaluations() -> None:
        for _ in range(5):
            scheme.rates(y, rate)

    seconds = median(lambda: _seconds(five_evaluations) / 5, 7)
    stiff = median(lambda: _seconds(lambda: scheme.rates(y, rate, tau=0.01)), 7)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    slots = float(state.owner.shape[1])
    found = {"seconds": seconds, "stiff": stiff, "memory": memory}
    print(json.dumps({"nodes": len(mesh.nodes), "slots": slots, "values": y.size, **found}))


def bench_traffic() -> None:
    """Bytes that one evaluation moves per live point, and at what part of the rate of `new = old + dt rate`."""
    old, rate, new = np.ones((3, 20_000_000))
    stream = 3 * old.nbytes / median(lambda: _seconds(lambda: vectors.advance(new, old, 0.5, rate)), 7)
    print(f"memory traffic of one evaluation; new = old + dt rate moves {stream / 1e9:.1f} GB/s on one core")
    for dim, size, count in ((2, [170.0, 170.0], 16), (3, [42.0, 42.0, 42.0], 4)):
        places = np.stack(np.meshgrid(*[np.arange(count)] * dim), axis=-1).reshape(-1, dim)
        case = parse_case({
            "domain": {"size": size},
            "nodes": {"source": "triangular", "spacing": 1.0},
            "particles": {"source": "list", "centres": (7.0 + 9.6 * places).tolist(), "radii": [5.0] * count**dim},
            "time": {"end": 1.0},
        })  # fmt: skip
        scheme, state = prepare(case, build_mesh(case, Ranks()), Ranks())
        y = scheme.active.unknowns.take(state.u)
        evaluate = partial(scheme.rates, y, np.empty_like(y))
        seconds = median(partial(_seconds, evaluate), 9)
        bytes_moved = traffic(scheme)
        points = scheme.active.live.size
        fields = scheme.active.blocks.column.size / scheme.active.blocks.blocks.size
        print(
            f"  {dim}-D  {points} live points, {fields:.1f} fields  {bytes_moved / points:5.0f} bytes per point"
            f"  {1e3 * seconds:6.1f} ms  {bytes_moved / seconds / 1e9:.1f} GB/s"
            f"  {bytes_moved / seconds / stream:.0%} of that rate"
        )


def traffic(scheme: Scheme) -> int:
    """Bytes of the arrays that an evaluation reads and writes, each counted once a pass; the table stays at hand."""
    y = 8 * scheme.active.unknowns.size
    moved = 3 * y + 4 * y  # y to the columns, and these read; rates added to columns, and collected
    moved += 5 * scheme.W.nbytes  # cleared, added to, divided
    for layer in scheme.layers:
        live, blocks = layer.live, layer.blocks
        lists = blocks.nodes.itemsize * int(blocks.count[live.blocks].sum()) + 3 * 8 * live.blocks.size
        both = layer.fields.nbytes + layer.D.nbytes + layer.S2.nbytes  # written, then read
        both += live.weights.nbytes + live.blocks.nbytes + live.first.nbytes + live.column.nbytes + lists
        moved += 2 * both + live.partial.nbytes + live.owner[live.partial].nbytes
        moved += live.particle.nbytes + 8 * 3 * LANES * live.blocks.size  # where the points are
    return moved + 2 * (scheme.point.nbytes + scheme.active.mask.nbytes)


def crowd(dim: int, source: str, spacing: float, moving: bool) -> Case:
    """Particles in contact everywhere: 64 spheres of 9.7 nm, or 100 discs of 5.7 nm."""
    count, apart, radius = (4, 19.7, 9.7) if dim == 3 else (10, 11.5, 5.7)
    places = np.stack(np.meshgrid(*[np.arange(count)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return parse_case({
        "domain": {"size": [2 * radius + 1.6 + apart * (count - 1)] * dim},
        "nodes": {"source": source, "spacing": spacing},
        "particles": {"centres": (radius + 0.8 + apart * places).tolist(), "radii": [radius] * count**dim},
        "model": {"rigid_motion": moving},
        "time": {"end": 1.0},
    })  # fmt: skip


def bench_lattices() -> None:
    """One evaluation on square and cubic lattices, and on triangular and body-centred ones of about as many nodes."""
    print("one evaluation where particles touch everywhere: square or cubic lattice, triangular or body-centred one")
    for dim, spacing, other in ((2, 0.5, 0.5373), (3, 1.1, 1.2117)):
        for moving in (False, True):
            runs = []
            for source, h in (("lattice", spacing), ("triangular", other)):
                setup = make_setup(crowd(dim, source, h, moving), Ranks())
                scheme, state, _ = setup.start()
                y = scheme.vector(state)
                runs.append((setup.nodes, partial(_seconds, partial(scheme.rates, y, np.empty_like(y)))))
                runs[-1][1]()
            pairs = [[measure() for _, measure in runs] for _ in range(9)]  # by turns
            ours, theirs = (statistics.median(pair[k] for pair in pairs) for k in range(2))
            print(
                f"  {dim}-D, {'with' if moving else 'no  '} motion  {runs[0][0]:7d} nodes {1e3 * ours:7.1f} ms"
                f"  {runs[1][0]:7d} nodes {1e3 * theirs:7.1f} ms  ratio {theirs / ours:.1f}"
            )


BENCHES = {
    "lattices": bench_lattices,
    "traffic": bench_traffic,
    "two-discs": bench_two_discs,
    "shape": bench_shape,
    "start": bench_start,
    "particles": bench_particles,
}

if __name__ == "__main__":
    if sys.argv[1:2] == ["particles-one"]:
        particles_one(int(sys.argv[2]))
    else:
        for chosen in sys.argv[1:] or BENCHES:
            BENCHES[chosen]()
