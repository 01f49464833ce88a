"""Loops that apply a table of shape functions to coefficients, and its adjoint to values at points."""

from .arrays import Floats, Integers, Numbers
from .jit import jit


@jit
def sample(values: Floats, u: Floats, offsets: Integers, nodes: Numbers, rows: Integers, table: Floats) -> None:
    """values[p] = sum_a N_a(x_p) u_a, for all columns of u (n, F)   (17)"""
    for p in range(values.shape[0]):
        for c in range(values.shape[1]):
            values[p, c] = 0.0
        for i in range(offsets[p + 1] - offsets[p]):
            a, share = nodes[offsets[p] + i], table[0, rows[p] + i]
            for c in range(values.shape[1]):
                values[p, c] += share * u[a, c]


@jit
def spread(
    sums: Floats, values: Floats, weights: Floats, offsets: Integers, nodes: Numbers, rows: Integers, table: Floats
) -> None:
    """sums[a] += sum_p w_p N_a(x_p) values[p], for all columns."""
    for p in range(values.shape[0]):
        for i in range(offsets[p + 1] - offsets[p]):
            a, share = nodes[offsets[p] + i], weights[p] * table[0, rows[p] + i]
            for c in range(values.shape[1]):
                sums[a, c] += share * values[p, c]
