"""The free energy, its derivatives and the mobility: scalar functions that read like the paper.

Every function takes point values: rho, the sums S2 = sum eta^2 and S3 = sum eta^3, and the model's coefficients `m`.
Source: Huang et al. (2023), equations (2), (5), (30), (31); Wang (2006).
"""

from typing import NamedTuple, TypeVar

from .jit import jit
from .simd import Pack, positive

Field = TypeVar("Field", float, Pack)  # a value, or a pack of them


class Coefficients(NamedTuple):
    """Table 2 in the order of the case file; a named tuple because numba compiles attribute access to it."""

    A: float
    B: float
    L: float
    kappa_rho: float
    kappa_eta: float
    D_vol: float
    D_vap: float
    D_surf: float
    D_gb: float
    m_t: float
    m_r: float
    k: float
    rho_0: float
    c: float


@jit
def free_energy_density(rho: Field, S2: Field, S3: Field, m: Coefficients) -> Field:
    """f = A rho^2 (1 - rho)^2 + B [ rho^2 + 6 (1 - rho) S2 - 4 (2 - rho) S3 + 3 S2^2 ]   (2)"""
    wells = m.A * rho * rho * (1.0 - rho) * (1.0 - rho)
    return wells + m.B * (rho * rho + 6.0 * (1.0 - rho) * S2 - 4.0 * (2.0 - rho) * S3 + 3.0 * S2 * S2)


@jit
def df_drho(rho: Field, S2: Field, S3: Field, m: Coefficients) -> Field:
    """df/drho = A (4 rho^3 - 6 rho^2 + 2 rho) + B (2 rho - 6 S2 + 4 S3)   (31)"""
    return m.A * rho * (2.0 + rho * (4.0 * rho - 6.0)) + m.B * (2.0 * rho - 6.0 * S2 + 4.0 * S3)


@jit
def df_deta(eta: Field, rho: Field | float, S2: Field | float, m: Coefficients) -> Field:
    """df/deta_a = 12 B [ (1 - rho) eta_a - (2 - rho) eta_a^2 + eta_a S2 ]   (30)"""
    return 12.0 * m.B * eta * ((1.0 - rho) - (2.0 - rho) * eta + S2)


@jit
def mobility(rho: Field, overlap: Field, m: Coefficients) -> Field:
    """D = D_vol phi + D_vap (1 - phi) + D_surf rho (1 - rho) + D_gb sum_a sum_{b != a} eta_a eta_b   (5)

    phi = rho^3 (10 - 15 rho + 6 rho^2). `overlap` is the double sum over ordered pairs. A diffuse model leaves [0, 1]
    by a little, where D would turn negative: D sees rho clamped to [0, 1] and the overlap clamped to >= 0.
    """
    r = 1.0 - positive(1.0 - positive(rho))
    phi = r * r * r * (10.0 - 15.0 * r + 6.0 * r * r)
    return m.D_vol * phi + m.D_vap * (1.0 - phi) + m.D_surf * r * (1.0 - r) + m.D_gb * positive(overlap)
