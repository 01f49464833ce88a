"""Results do not depend on the number of ranks; whatever goes wrong on one rank ends all of them, with its message."""

from pathlib import Path

import pytest
from launching import PAIR, Case, Tree, columns, different, launch, on_mesh, record, snapshots, solve, write_case

from frit.sweeps.pictures import draw_panels

# Three particles, each touching both others, all of different size: rigid motion with rotation. 100 steps.
TRIPLE: dict[int, Case] = {
    2: PAIR
    | {
        "domain": {"size": [21.0, 18.0]},
        "particles": {"centres": [[5.8, 5.5], [14.2, 6.1], [9.6, 12.8]], "radii": [4.4, 4.1, 3.8]},
    },
    3: PAIR
    | {
        "domain": {"size": [14.0, 13.0, 9.0]},
        "particles": {"centres": [[4.1, 4.0, 4.6], [9.2, 4.4, 4.3], [6.4, 8.8, 4.5]], "radii": [2.6, 2.5, 2.4]},
        "shape_functions": {"tolerance": 1e-4},  # half the neighbours of the default
        "model": {"m_t": 100.0},  # forces on balls this small are stiff: the step stays stable
    },
}

BROKEN = """
import os, sys
from frit.solver import __main__ as solver
from frit.solver.{module} as Scheme

rates, calls = Scheme.rates, 0

def broken(self, u, rate, tau=None):
    global calls
    calls += 1
    if calls == 40 and self.ranks.rank == {rank}:  # step 20: two evaluations each
        raise ValueError("the sum came out wrong")
    rates(self, u, rate, tau)

Scheme.rates = broken
sys.exit(solver.main())
"""


@pytest.fixture(scope="module", params=[2, 3, -2, -3], ids=["square", "cubic", "triangular", "body-centred"])
def serial(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Case, Path]:
    """A case and its run on one rank."""
    case = TRIPLE[abs(request.param)] if request.param > 0 else on_mesh(TRIPLE[abs(request.param)])
    return case, solve(case, tmp_path_factory.mktemp("ranks") / "1")


@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_agree_to_round_off(serial: tuple[Case, Path], ranks: int) -> None:
    """Sums of some thousand terms in another order: 1e-13 a step at most, and diffusion lets it not grow."""
    case, alone = serial
    together = solve(case, alone.with_name(str(ranks)), ranks)
    assert record(together)["ranks"] == ranks
    assert different(alone, together, 1e-10) == {}


def test_the_case_is_worth_comparing(serial: tuple[Case, Path]) -> None:
    """The particles stay, energy falls, and mass does not change: nothing here is still, nothing blows up."""
    column = columns(serial[1])
    assert column["step"][-1] == 100
    assert (column["particles"] == 3).all()
    assert column["free_energy"][-1] < 0.99 * column["free_energy"][0]
    # Round-off of 200 evaluations, each a sum over the nodes.
    assert column["solid_mass"] == pytest.approx(column["solid_mass"][0], rel=1e-12)


@pytest.mark.parametrize("mesh", [False, True])
def test_two_ranks_take_the_adaptive_steps_of_one(tmp_path: Path, mesh: bool) -> None:
    """Rounding enters the steps through their error and the spectral radius, a difference quotient over 1e-7."""
    case = (on_mesh(TRIPLE[2]) if mesh else TRIPLE[2]) | {
        "time": {"integrator": "adaptive", "end": 0.3},
        "output": {"history_every": 0.01, "snapshots": [0.0, 0.17, 0.3]},
    }
    alone, together = solve(case, tmp_path / "1"), solve(case, tmp_path / "2", ranks=2)
    assert different(alone, together, 1e-8) == {}


POLLING = """
import sys
import numpy as np
from frit.solver import __main__ as solver
from frit.solver import layers, partition, scheme

layers.PIECE = scheme.PIECE = 1  # a look after each block of 8 points: 400 an evaluation
world = partition.Ranks.world()
for values in (1, 1000, 100_000):  # within MPI's own buffers and beyond
    halo = partition.Halo(world, values, [(1 - world.rank, np.arange(values))])
    under_way = halo.start(np.full(values, 1.0 + world.rank))
    for _ in range(1000):
        under_way.poll()
        world.barrier()
    assert not any(under_way.requests), "all is done, and `finish` finds nothing to wait for"
    array = np.zeros(values)
    halo.finish(array, under_way)
    assert (array == 2.0 - world.rank).all()
sys.exit(solver.main())
"""


@pytest.mark.parametrize("dim", [2, 3])
def test_values_under_way_move_while_ranks_work(tmp_path: Path, dim: int) -> None:
    """Looks after them are enough, none has to be waited for; and work in many pieces is the same work."""
    case = on_mesh(TRIPLE[dim])
    alone = solve(case, tmp_path / "alone")
    together = solve(case, tmp_path / "polling", ranks=2, script=POLLING)
    assert different(alone, together, 1e-10) == {}


# Live points are chosen every 20 steps; RESTLESS: and then the mesh is divided anew, each time by other work.
OFTEN = """
import sys
from frit.solver import prepare, run
from frit.solver import __main__ as solver

run.REFRESH = 20
"""
RESTLESS = """
run.UNEVEN, activity, times = -1.0, prepare.activity, 0

def uneven(mesh, u, eps):
    global times
    times += 1
    work = activity(mesh, u, eps)
    work[mesh.points[:, times % 2] > 8.0] *= 1.0 + times
    return work

prepare.activity = uneven
status = solver.main()
assert times > 3, times
sys.exit(status)
"""


@pytest.mark.parametrize("integrator", ["rk2", "adaptive"])
def test_a_run_divided_anew_is_the_same_run(tmp_path: Path, integrator: str) -> None:
    """It goes on in the same process from a checkpoint of this moment."""
    case = on_mesh(TRIPLE[2])
    if integrator == "adaptive":
        case = case | {"time": {"integrator": "adaptive", "end": 0.5}, "output": {"history_every": 0.05}}
    alone = solve(case, tmp_path / "1", ranks=2, script=OFTEN + "sys.exit(solver.main())")
    divided = solve(case, tmp_path / "2", ranks=2, script=OFTEN + RESTLESS)
    assert different(alone, divided, 1e-10 if integrator == "rk2" else 1e-8) == {}
    assert record(divided)["resumed"] == []


@pytest.mark.parametrize(("rank", "mesh"), [(0, False), (1, False), (0, True)])
def test_an_exception_on_one_rank_ends_all(tmp_path: Path, rank: int, mesh: bool) -> None:
    """The others wait in an exchange that never comes: without an abort this hangs."""
    module = "scheme import Scheme" if mesh else "lattice.scheme import LatticeScheme"
    script = BROKEN.replace("{rank}", str(rank)).replace("{module}", module)
    with launch(on_mesh(PAIR) if mesh else PAIR, tmp_path / "run", ranks=2, script=script) as tree:
        status, _ = tree.ended()
        assert tree.gone()
    assert status != 0
    message = f"rank {rank}: ValueError: the sum came out wrong"
    ended = record(tmp_path / "run")
    assert (ended["state"], ended["message"]) == ("failed", message)
    log = (tmp_path / "run/log.txt").read_text()  # mpich may drop what a rank prints just before the abort
    assert message in log
    assert "Traceback" in log


def test_a_bad_state_on_one_rank_ends_all_with_time_and_place(tmp_path: Path) -> None:
    """No abort: every rank learns of it, and the checkpoint of before stands."""
    case = PAIR | {"time": {"integrator": "rk2", "end": 10.0, "step": 0.5}}
    case["output"] = {"history_every": 0.5, "snapshots": [0.0]}
    with launch(case, tmp_path / "run", ranks=2) as tree:
        status, printed = tree.ended()
    assert status == 1, printed
    ended = record(tmp_path / "run")
    assert ended["state"] == "failed"
    for words in ("step 1, at (", "rho = ", "likely cause: ", "good checkpoint is at t = 0, the last snapshot at 0.5"):
        assert words in ended["message"]
    assert snapshots(tmp_path / "run")["time"].tolist() == [0.0, 0.5]
    draw_panels(tmp_path / "run", [0.5], tmp_path / "moment.png")
    assert (tmp_path / "moment.png").stat().st_size > 10_000
    assert (tmp_path / "run/checkpoint.h5").exists()


def test_a_refused_case_ends_all(tmp_path: Path) -> None:
    """Rank 0 alone reads it; the others wait for it."""
    wrong = PAIR | {"time": {"integrator": "rk2", "end": -1.0}}
    with launch(wrong, tmp_path / "run", ranks=2) as tree:
        status, printed = tree.ended()
        assert tree.gone()
    assert status == 2
    assert "time.end = -1.0: must be greater than 0" in printed
    assert record(tmp_path / "run")["state"] == "refused"


def test_a_place_that_cannot_be_written_ends_all(tmp_path: Path) -> None:
    """Even when what went wrong cannot be written down either."""
    path = write_case(tmp_path / "case", PAIR)
    with Tree(2, path, "--out", path / "run") as tree:
        status, printed = tree.ended()
        assert tree.gone()
    assert status != 0
    assert "NotADirectoryError" in printed
