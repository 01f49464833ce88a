"""Particle files of others: names of columns, separators, units."""

from pathlib import Path

import numpy as np
import pytest

from frit.solver.case import CaseError, load_case
from frit.solver.particle_file import ParticleFileError, read, write

ROWS = [[1.0, 2.0, 3.0, 0.5], [4.0, 5.0, 6.0, 0.25]]


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z,r\n1,2,3,0.5\n4,5,6,0.25\n",
        "X, Y, Z, Radius\n1, 2, 3, 0.5\n\n4, 5, 6, 2.5e-1\n",
        "1,2,3,0.5\n4,5,6,0.25\n",
        "x y z r\n1 2 3 0.5\n4 5 6 0.25\n",
        "# made elsewhere\n  1.0   2.0\t3.0 0.5\n4 5 6 0.25",
        "x;y;z;radius\n1;2;3;0.5\n4;5;6;0.25\n",
    ],
    ids=["csv", "spaces", "bare", "cloud", "bare cloud", "semicolons"],
)
def test_the_same_particles(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.cloud").write_text(text)
    centres, radii = read(tmp_path / "p.cloud", 3)
    assert np.column_stack([centres, radii]).tolist() == ROWS


@pytest.mark.parametrize(("units", "factor"), [("nm", 1.0), ("um", 1e3), ("mm", 1e6), ("m", 1e9)])
def test_units(tmp_path: Path, units: str, factor: float) -> None:
    (tmp_path / "p.csv").write_text(f"{30 / factor!r},{30 / factor!r},{20 / factor!r}\n")
    (tmp_path / "case.toml").write_text(
        '[domain]\nsize = [60.0, 60.0]\n[nodes]\nspacing = 1.0\n[time]\nend = 1.0\n'
        f'[particles]\nsource = "file"\npath = "p.csv"\nunits = "{units}"\n'
    )
    particles = load_case(tmp_path / "case.toml").particles
    assert particles.centres[0] == pytest.approx((30.0, 30.0))
    assert particles.radii == pytest.approx((20.0,))
    assert particles.units is None  # they are a list now, in nm


def test_unknown_units_are_refused(tmp_path: Path) -> None:
    (tmp_path / "case.toml").write_text(
        '[domain]\nsize = [60.0, 60.0]\n[nodes]\nspacing = 1.0\n[time]\nend = 1.0\n'
        '[particles]\nsource = "file"\npath = "p.csv"\nunits = "inch"\n'
    )
    with pytest.raises(CaseError, match=r"particles\.units = 'inch': must be 'nm', 'um', 'mm' or 'm'"):
        load_case(tmp_path / "case.toml")


def test_what_is_wrong_is_told_by_line(tmp_path: Path) -> None:
    (tmp_path / "p.cloud").write_text("x y z r\n1 2 3 0.5\n1 2 3\n1 2 3 -1\n")
    with pytest.raises(ParticleFileError) as caught:
        read(tmp_path / "p.cloud", 3)
    assert caught.value.problems == (
        "line 3 has 3 columns, must have 4: x,y,z,radius",
        "line 4, column 4 (radius) is '-1', must be a number greater than 0",
    )


def test_what_is_written_is_read_to_the_last_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    centres, radii = rng.random((50, 3)) / 3.0, rng.random(50) + 0.1
    write(tmp_path / "p.csv", centres, radii)
    again = read(tmp_path / "p.csv", 3)
    assert np.array_equal(again[0], centres)
    assert np.array_equal(again[1], radii)
    assert [path.name for path in tmp_path.iterdir()] == ["p.csv"]
