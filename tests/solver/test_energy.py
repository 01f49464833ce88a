"""Free energy, its derivatives, its minima, and the mobility."""

from collections.abc import Callable

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from frit.solver.arrays import Floats
from frit.solver.energy import Coefficients, df_deta, df_drho, free_energy_density, mobility

TABLE_2 = Coefficients(
    A=16.0, B=1.0, L=10.0, kappa_rho=10.0, kappa_eta=1.0, D_vol=0.01, D_vap=0.001, D_surf=4.0, D_gb=0.4,
    m_t=500.0, m_r=1.0, k=100.0, rho_0=0.9816, c=0.14,
)  # fmt: skip


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers with few digits: products of very small ones would underflow, which is an error in tests."""
    return st.floats(low, high).map(lambda x: round(x, 6))


def several(low: float, high: float) -> st.SearchStrategy[Floats]:
    return st.lists(numbers(low, high), min_size=1, max_size=4).map(np.array)


# What a diffuse model under fast rigid motion is seen to visit, and more.
RHO, ETAS = numbers(-0.5, 1.5), several(-0.3, 1.3)
COEFFICIENTS = st.tuples(*[numbers(0.0, 20.0)] * 9).map(lambda some: Coefficients._make((*some, *TABLE_2[9:])))

# Sums of about ten terms of at most 20 * 1.5^4 * 4: round-off stays below this.
ROUND_OFF = 1e-12 * 20 * 10


def f(rho: float, eta: Floats, m: Coefficients) -> float:
    return float(free_energy_density(rho, float((eta**2).sum()), float((eta**3).sum()), m))


def overlap(eta: Floats) -> float:
    """The double sum of (5) over ordered pairs, as it stands: negative where one of two is."""
    return float(sum(eta[a] * eta[b] for a in range(len(eta)) for b in range(len(eta)) if a != b))


def slope(function: Callable[[float], float]) -> float:
    """The derivative at 0 by five points: exact for a polynomial of degree four, up to round-off."""
    h = 0.25
    return (8 * (function(h) - function(-h)) - (function(2 * h) - function(-2 * h))) / (12 * h)


@given(RHO, ETAS, COEFFICIENTS)
@settings(deadline=None)
def test_formulas_agree_with_the_reference(rho: float, eta: Floats, m: Coefficients) -> None:
    """Both sum the same few terms: they differ by round-off only."""
    S2, S3 = float((eta**2).sum()), float((eta**3).sum())
    assert f(rho, eta, m) == pytest.approx(float(reference.free_energy_density(np.array(rho), eta, m)), abs=ROUND_OFF)
    assert df_drho(rho, S2, S3, m) == pytest.approx(float(reference.df_drho(np.array(rho), eta, m)), abs=ROUND_OFF)
    exact = reference.df_deta(np.array(rho), eta, m)
    got = [df_deta(float(e), rho, S2, m) for e in eta]
    np.testing.assert_allclose(got, exact, rtol=0, atol=12 * ROUND_OFF)


@given(RHO, ETAS, COEFFICIENTS)
@settings(deadline=None)
def test_derivatives_are_those_of_the_energy(rho: float, eta: Floats, m: Coefficients) -> None:
    """f is of degree four in rho and in each eta: five-point differences have no truncation error, and lose a digit."""
    S2, S3 = float((eta**2).sum()), float((eta**3).sum())
    assert df_drho(rho, S2, S3, m) == pytest.approx(slope(lambda d: f(rho + d, eta, m)), abs=20 * ROUND_OFF)
    for a, unit in enumerate(np.eye(len(eta))):

        def along(d: float, unit: Floats = unit) -> float:
            return f(rho, eta + d * unit, m)

        assert df_deta(float(eta[a]), rho, S2, m) == pytest.approx(slope(along), abs=20 * ROUND_OFF)


@pytest.mark.parametrize("particles", [1, 2, 4])
def test_vapour_and_each_grain_are_the_minima(particles: int) -> None:
    """At (0, 0) and (1, one-hot) f and its gradient vanish, and the Hessian has 2 A + 2 B for rho, 12 B for each eta.

    Small integers are exact in floating point, so the first two hold to the last bit. The Hessian is diagonal there;
    differences of the exact derivatives over 2 e are off by e^2 times a fourth derivative of at most 24 A.
    """
    m, e = TABLE_2, 1e-5
    for rho, eta in [(0.0, np.zeros(particles)), *((1.0, unit) for unit in np.eye(particles))]:
        S2, S3 = float((eta**2).sum()), float((eta**3).sum())
        assert f(rho, eta, m) == 0.0
        assert df_drho(rho, S2, S3, m) == 0.0
        assert [df_deta(float(value), rho, S2, m) for value in eta] == [0.0] * particles

        def gradient(z: Floats) -> Floats:
            S2, S3 = float((z[1:] ** 2).sum()), float((z[1:] ** 3).sum())
            return np.array([df_drho(z[0], S2, S3, m), *(df_deta(value, z[0], S2, m) for value in z[1:])])

        z = np.array([rho, *eta])
        hessian = [(gradient(z + e * unit) - gradient(z - e * unit)) / (2 * e) for unit in np.eye(1 + particles)]
        np.testing.assert_allclose(hessian, np.diag([2 * m.A + 2 * m.B] + [12 * m.B] * particles), atol=1e-6)


@given(RHO, ETAS)
@settings(deadline=None)
def test_nothing_lies_below_the_minima(rho: float, eta: Floats) -> None:
    """f >= B [ rho^2 - rho (6 s^2 - 4 s^3) + 6 s^2 - 8 s^3 + 3 s^4 ] with s^2 = S2, S3 <= s^3: not negative here."""
    assert f(rho, eta, TABLE_2) >= -ROUND_OFF


@given(RHO, ETAS)
@settings(deadline=None)
def test_mobility_is_never_negative(rho: float, eta: Floats) -> None:
    """A negative D is anti-diffusion and ends in NaN; rounding of phi near 1 is all that may be seen of it."""
    assert mobility(rho, overlap(eta), TABLE_2) >= 0.0


@given(numbers(0.0, 1.0), several(0.0, 1.0), COEFFICIENTS)
@settings(deadline=None)
def test_mobility_is_equation_5_between_0_and_1(rho: float, eta: Floats, m: Coefficients) -> None:
    phi = rho**3 * (10 - 15 * rho + 6 * rho**2)
    D = m.D_vol * phi + m.D_vap * (1 - phi) + m.D_surf * rho * (1 - rho) + m.D_gb * overlap(eta)
    assert mobility(rho, overlap(eta), m) == pytest.approx(D, abs=ROUND_OFF)
    assert float(reference.mobility(np.array(rho), eta, m)) == pytest.approx(D, abs=ROUND_OFF)


def test_mobility_outside_0_and_1_is_that_of_the_pure_phases() -> None:
    """Up to the last bit, which the compiler's order of the sum may change."""
    for rho, overlap, D in [(-0.5, 0.0, TABLE_2.D_vap), (0.0, -0.3, TABLE_2.D_vap), (1.5, -0.3, TABLE_2.D_vol)]:
        assert mobility(rho, overlap, TABLE_2) == pytest.approx(D, rel=4e-16)


@given(numbers(0.0, 1.0))
@settings(deadline=None)
def test_the_phase_function_goes_from_vapour_to_solid(rho: float) -> None:
    """phi(1 - rho) = 1 - phi(rho): without surfaces and boundaries D(rho) + D(1 - rho) = D_vol + D_vap."""
    m = TABLE_2._replace(D_surf=0.0)
    assert mobility(rho, 0.0, m) + mobility(1.0 - rho, 0.0, m) == pytest.approx(m.D_vol + m.D_vap, abs=1e-15)
