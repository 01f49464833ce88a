"""Packings against what is known of packings. The large ones are slow tests."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frit.solver.arrays import Floats
from frit.solver.case import Case, CaseError, parse_case
from frit.solver.heap import Heap
from frit.solver.pack_measures import density_profile, near_pairs, solid_fraction, touching
from frit.solver.packing import OVERLAP, TOLERANCE, Packing, make, request
from frit.solver.radii import BITS, steady


def case(size: list[float], **particles: Any) -> Case:
    """A packing in all of a domain of this size, radii near 1."""
    given = {"source": "packing", "mean_radius": 1.0, "container": [[0.0] * len(size), size], **particles}
    return parse_case({"domain": {"size": size}, "nodes": {"spacing": 0.2}, "particles": given, "time": {"end": 1.0}})


def packed(size: list[float], **particles: Any) -> Packing:
    """Packed anew, and checked: inside the container, no overlaps beyond the allowed, realised values true."""
    wanted = request(case(size, **particles))
    packing = make(wanted)
    x, r, found = packing.centres, packing.radii, packing.realised
    assert (x - r[:, None] >= -1e-9).all()
    assert (x + r[:, None] <= np.array(size) + 1e-9).all()
    apart = np.linalg.norm(x[:, None] - x, axis=2) + np.diag(np.full(len(r), np.inf)) if len(r) < 3000 else None
    if apart is not None:
        assert (r + r[:, None] - apart).max() <= OVERLAP * r.mean()
    assert found["count"] == len(r)
    assert (found["mean_radius"], found["std_radius"]) == (pytest.approx(r.mean()), pytest.approx(r.std()))
    assert found["packing_density"] == pytest.approx(solid_fraction(x, r, np.zeros(len(size)), np.array(size)))
    return packing


def core(packing: Packing, size: list[float], margin: float) -> float:
    """Solid fraction this far from all walls, and from the top of the heap."""
    low, high = np.full(len(size), margin), np.array(size) - margin
    high[-1] = min(high[-1], (packing.centres[:, -1] + packing.radii).max() - margin)
    return solid_fraction(packing.centres, packing.radii, low, high)


# --- what was asked


@pytest.mark.parametrize(
    ("size", "density"),
    [([24.0, 20.0], 0.6), ([24.0, 20.0], 0.78), ([11.0, 10.0, 12.0], 0.38), ([11.0, 10.0, 12.0], 0.55)],
)  # fmt: skip
def test_a_density_is_reached_and_all_hangs_together(size: list[float], density: float) -> None:
    """In the vacancy box: 80 % of the container. Loose or dense, a connected heap reaches from floor to lid."""
    packing = packed(size, std_radius=0.1, packing_density=density, seed=1)
    low, high = 0.1 * np.array(size), 0.9 * np.array(size)
    assert abs(solid_fraction(packing.centres, packing.radii, low, high) - density) <= TOLERANCE
    contacts = touching(packing.centres, packing.radii, np.zeros(len(size)), np.array(size))
    assert contacts.alone == 0
    assert contacts.clusters == 1
    assert contacts.percolates(len(size) - 1)
    assert packing.radii.mean() == pytest.approx(1.0)
    assert packing.radii.std() == pytest.approx(0.1)


def test_without_a_vacancy_box_inside_the_whole_container_counts() -> None:
    tree = case([24.0, 20.0], packing_density=0.7).model_dump(mode="json", exclude_none=True)
    tree["particles"] = {key: value for key, value in tree["particles"].items() if value != []}
    tree["particles"]["container"] = [[0.0, 0.0], [20.0, 20.0]]
    tree["output"]["vacancy_box"] = [[2.0, 2.0], [23.0, 18.0]]
    found = make(request(parse_case(tree)))
    assert abs(found.realised["packing_density"] - 0.7) <= TOLERANCE


def test_exactly_as_many_as_asked() -> None:
    assert packed([24.0, 20.0], count=80).realised["count"] == 80
    assert packed([24.0, 20.0], count=80, method="density").realised["count"] == 80


def test_poured_particles_lie_below_and_pressed_ones_reach_the_lid() -> None:
    poured = packed([24.0, 20.0], count=60)
    pressed = packed([24.0, 20.0], count=60, method="density")
    assert (poured.centres[:, 1] + poured.radii).max() < 13.0  # 60 discs of 0.82 in a width of 24 are 9.6 high
    assert (pressed.centres[:, 1] + pressed.radii).max() == pytest.approx(20.0, abs=1e-2)


@pytest.mark.parametrize("size", [[24.0, 20.0], [10.0, 10.0, 12.0]])
def test_nothing_poured_hangs_in_the_air(size: list[float]) -> None:
    """Each particle lies on the floor or on a particle whose centre is lower."""
    packing = packed(size, count=90, std_radius=0.1)
    x, r = packing.centres, packing.radii
    pairs, _ = near_pairs(x, r, 5e-3)
    upper = np.where(x[pairs[:, 0], -1] > x[pairs[:, 1], -1], pairs[:, 0], pairs[:, 1])
    held = np.bincount(upper, minlength=len(r)) > 0
    assert (held | (x[:, -1] - r < 5e-3)).all()


def test_a_seed_is_a_packing() -> None:
    first, again = (make(request(case([24.0, 20.0], count=60, std_radius=0.1, seed=5))) for _ in range(2))
    other = make(request(case([24.0, 20.0], count=60, std_radius=0.1, seed=6)))
    assert np.array_equal(first.centres, again.centres)
    assert np.array_equal(first.radii, again.radii)
    assert not np.array_equal(first.centres, other.centres)


PLAIN = {  # as little of the processor as can be asked for: in compiled code, the system's library, numpy and BLAS
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Nehalem",
}
KINDS: list[tuple[list[float], dict[str, Any]]] = [
    ([9.0, 9.0, 10.0], {"std_radius": 0.2, "count": 60, "friction": 0.4, "seed": 2}),
    ([24.0, 20.0], {"std_radius": 0.1, "packing_density": 0.7, "seed": 1}),
    ([10.0, 8.0, 9.0], {"std_radius": 0.25, "distribution": "lognormal", "count": 80, "method": "density", "seed": 3}
     | {"exchange": True}),
]  # fmt: skip
ELSEWHERE = """
import json
from numba import config
from test_packing import KINDS, case
from frit.solver.packing import make, request
made = [make(request(case(size, **asked))) for size, asked in KINDS]
print(json.dumps({
    "processor": config.CPU_NAME,
    "made": [[m.centres.tobytes().hex(), m.radii.tobytes().hex()] for m in made],
}))
"""


def test_a_packing_is_the_same_on_every_processor() -> None:
    """To the last bit: poured with friction, pressed, and shaken with a log-normal spread. No fused multiplication, no
    other order of a sum, and no last bit of a logarithm decides where a particle ends."""
    command = [sys.executable, "-c", ELSEWHERE]
    there = subprocess.run(
        command, cwd=Path(__file__).parent, env=os.environ | PLAIN, capture_output=True, text=True, check=False
    )
    assert there.returncode == 0, there.stderr
    found = json.loads(there.stdout)
    assert found["processor"] == "generic"
    made = [make(request(case(size, **asked))) for size, asked in KINDS]
    for (size, _), packing, (centres, radii) in zip(KINDS, made, found["made"], strict=True):
        assert np.array_equal(packing.radii, np.frombuffer(bytes.fromhex(radii)))
        there_too = np.frombuffer(bytes.fromhex(centres)).reshape(-1, len(size))
        assert np.array_equal(packing.centres, there_too)


def test_what_is_made_steady_keeps_its_value_and_loses_its_last_bits() -> None:
    x = np.random.default_rng(1).normal(size=1000) * 10.0 ** np.arange(-10, 10).repeat(50)
    np.testing.assert_allclose(steady(x), x, rtol=2.0**-BITS)
    assert (steady(np.nextafter(x, np.inf)) == steady(x)).mean() > 0.999
    assert (steady(x) != x).all()
    assert steady(steady(x)).tolist() == steady(x).tolist()
    assert steady([0.0, 1.0, -2.5]).tolist() == [0.0, 1.0, -2.5]


# --- what cannot be


def refusal(size: list[float], **particles: Any) -> str:
    with pytest.raises(CaseError) as caught:
        make(request(case(size, **particles)))
    return str(caught.value)


def reachable(message: str) -> tuple[float, float]:
    low, high = message.rpartition("about ")[2].split(" to ")
    return float(low), float(high)


@pytest.mark.parametrize(("size", "beyond", "most"), [([24.0, 20.0], 0.93, 0.87), ([11.0, 10.0, 12.0], 0.75, 0.68)])
def test_too_dense_is_refused_with_the_reachable_range(size: list[float], beyond: float, most: float) -> None:
    message = refusal(size, packing_density=beyond, std_radius=0.1)
    assert message.startswith(f"particles.packing_density = {beyond}: cannot be reached in the vacancy box")
    low, high = reachable(message)
    assert 0.1 < low < high < most
    inside = round(0.5 * (low + high), 2)
    assert abs(make(request(case(size, packing_density=inside, std_radius=0.1))).realised["packing_density"]) > 0.0


def test_too_loose_to_hang_together_is_refused() -> None:
    message = refusal([11.0, 10.0, 12.0], packing_density=0.08)
    low, high = reachable(message)
    assert 0.08 < low < high


def test_what_does_not_fit_is_refused() -> None:
    assert "particles.container" in (said := refusal([24.0, 1.9], count=3))
    assert "2 nm wide: its shortest edge is 1.9 nm" in said
    said = refusal([24.0, 20.0], count=200)
    assert said.startswith("particles.count = 200: 200 poured particles reach")
    most = int(said.rpartition(" ")[2])
    assert 110 < most < 140  # 0.82 * 480 / pi = 125
    assert "particles.count = 200: cannot fill" in refusal([24.0, 20.0], count=200, method="density")


# --- physics


def test_friction_makes_a_looser_heap() -> None:
    """Random loose packing of rough discs; the same discs without friction pack closer."""
    smooth = [core(packed([30.0, 30.0], count=190, std_radius=0.1, seed=s), [30.0, 30.0], 3.0) for s in range(3)]
    rough = [
        core(packed([30.0, 40.0], count=190, std_radius=0.1, seed=s, friction=0.6), [30.0, 40.0], 3.0) for s in range(3)
    ]
    assert 0.80 < np.mean(smooth) < 0.87
    assert 0.73 < np.mean(rough) < np.mean(smooth) - 0.01


def test_exchange_of_radii_packs_a_wide_spread_denser_than_at_random() -> None:
    """0.70 in the vacancy box, where random close packing of this spread ends near 0.65."""
    wide = {"std_radius": 0.3, "count": 134, "method": "density"}
    packing = packed([10.0, 10.0, 11.6], exchange=True, **wide)
    assert core(packing, [10.0, 10.0, 11.6], 1.5) > 0.67
    assert "cannot fill the container" in refusal([10.0, 10.0, 11.6], **wide)


@pytest.mark.slow
def test_random_close_packing_of_equal_spheres() -> None:
    """0.62 to 0.65, and about 6 contacts (isostatic) in the backbone, rattlers left out: Torquato & Stillinger 2010."""
    size = [20.0, 20.0, 24.0]
    packing = packed(size, count=1150)
    assert 0.62 < core(packing, size, 4.0) < 0.65
    assert 5.5 < inner_coordination(packing, 4.0) < 6.5


def inner_coordination(packing: Packing, margin: float) -> float:
    """Mean number of contacts of particles away from the walls and the top, without rattlers (fewer than 4)."""
    x, r = packing.centres, packing.radii
    top = (x[:, -1] + r).max()
    high = np.full(x.shape[1], 1e9)
    high[:-1] = x[:, :-1].max(axis=0) + 1.0
    high[-1] = top
    counts = touching(x, r, np.full(x.shape[1], -1e9), np.full(x.shape[1], 1e9)).counts
    inner = ((x > margin) & (x < high - margin)).all(axis=1) & (counts >= x.shape[1] + 1)
    return float(counts[inner].mean())


@pytest.mark.slow
def test_random_close_packing_of_equal_discs() -> None:
    """0.82 to 0.86: where pressed discs jam, once the lid is raised until their overlaps are gone.

    Athermal quenches of equal discs jam near 0.84 (O'Hern et al. 2003); what orders is denser, up to 0.907.
    """
    jammed = []
    for seed in range(5):
        heap = Heap(np.ones(900), np.array([60.0, 60.0]), np.random.default_rng(seed))
        assert not heap.press(20.0)
        while not heap.relax():
            heap.high[1] *= 1.001
            heap.x[:, 1] *= 1.001
        jammed.append(solid_fraction(heap.x[:, :2], heap.r, np.full(2, 5.0), heap.high[:2] - 5.0))
    assert 0.82 < np.mean(jammed) < 0.86


@pytest.mark.slow
def test_equal_discs_with_friction_pack_at_random() -> None:
    """0.82 to 0.86: a friction of 0.3 keeps poured equal discs from ordering."""
    size = [50.0, 50.0]
    fractions = [core(packed(size, count=560, friction=0.3, seed=seed), size, 6.0) for seed in range(4)]
    assert 0.82 < np.mean(fractions) < 0.86


@pytest.mark.slow
def test_equal_discs_pack_at_random_and_crystallise_when_poured() -> None:
    """A random pack of 0.82 exists; without friction gravity orders equal discs, up to 0.907 (hexagonal)."""
    packed([50.0, 50.0], packing_density=0.82)
    assert 0.86 < core(packed([50.0, 50.0], count=600), [50.0, 50.0], 6.0) < 0.907


@pytest.mark.slow
def test_wider_spreads_pack_denser() -> None:
    """Random close packing rises by some 0.02 for a spread of 0.4 means (Desmond & Weeks 2014).

    In six heaps of this size it was 0.0174, and the scatter of one heap 0.002: less than 0.01 is beyond chance.
    """
    size = [24.0, 24.0, 30.0]
    equal, wide = (
        np.mean([core(packed(size, count=count, std_radius=std, seed=seed), size, 4.0) for seed in range(2)])
        for std, count in ((0.0, 1575), (0.4, 1080))
    )
    assert wide > equal + 0.01


@pytest.mark.slow
def test_under_gravity_the_density_is_even_away_from_the_walls() -> None:
    """No trend with height, and no slab off by more than the noise of some 60 spheres."""
    size = [18.0, 18.0, 30.0]
    packing = packed(size, count=1200, std_radius=0.1)
    x, r = packing.centres, packing.radii
    low, high = np.array([0.0, 0.0, 4.0]), np.array([18.0, 18.0, (x[:, 2] + r).max() - 4.0])
    heights, fractions = density_profile(x, r, low, high, 6, margin=3.0)
    slope = np.polyfit(heights, fractions, 1)[0] * np.ptp(heights)
    assert abs(slope) < 0.02
    assert np.abs(fractions - fractions.mean()).max() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("poured", [True, False], ids=["pour", "press"])
def test_the_work_grows_like_the_number_of_particles(poured: bool) -> None:
    """Steps times listed pairs, as counted, of similar boxes; N^1.1 at most: fewer are at walls the more there are."""
    counts, work = (500, 1000, 2000, 4000), []
    for count in counts:
        edge = (count * 4.0 / 3.0 * np.pi / 0.55) ** (1.0 / 3.0)
        total = 0
        for seed in range(3):
            heap = Heap(np.ones(count), np.full(3, edge), np.random.default_rng(seed))
            if poured:
                heap.pour(0.0)
            else:
                assert heap.press(edge)
            total += heap.work
        work.append(total)
    assert np.polyfit(np.log(counts), np.log(work), 1)[0] < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("asked", [{"count": 10_000}, {"packing_density": 0.58}], ids=["pour", "density"])
def test_ten_thousand_spheres(asked: dict[str, Any]) -> None:
    size = [42.0, 42.0, 46.0]
    packing = packed(size, std_radius=0.1, **asked)
    margin: Floats = 0.1 * np.array(size)
    if "count" in asked:
        assert 0.62 < core(packing, size, 5.0) < 0.65
    else:
        inside = solid_fraction(packing.centres, packing.radii, margin, np.array(size) - margin)
        assert abs(inside - 0.58) <= TOLERANCE
