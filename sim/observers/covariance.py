"""Covariance of five quantities, as a Kalman filter needs it: its correction, and the gains.

A symmetric 5 x 5 matrix is a tuple of the 15 numbers of its upper half, row by row. After the measurement of one
number, z = h x + noise of variance r, let g = P h (`across`) and s = 1 / (h g + r): the gains are s g, and P becomes
P - s g g' (`less`).

This module knows nothing about motors.

Source: R. E. Kalman, "A New Approach to Linear Filtering and Prediction Problems", J. Basic Eng., vol. 82, 1960.
"""

from __future__ import annotations

from sim.numba_cache import kernel

Five = tuple[float, float, float, float, float]
Symmetric = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float, float, float
]


@kernel
def diagonal(a: float, b: float, c: float, d: float, e: float) -> Symmetric:
    """The diagonal matrix of these variances."""
    return (a, 0.0, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, c, 0.0, 0.0, d, 0.0, e)


@kernel
def across(P: Symmetric, h: Five) -> Five:
    """P h."""
    return (
        P[0] * h[0] + P[1] * h[1] + P[2] * h[2] + P[3] * h[3] + P[4] * h[4],
        P[1] * h[0] + P[5] * h[1] + P[6] * h[2] + P[7] * h[3] + P[8] * h[4],
        P[2] * h[0] + P[6] * h[1] + P[9] * h[2] + P[10] * h[3] + P[11] * h[4],
        P[3] * h[0] + P[7] * h[1] + P[10] * h[2] + P[12] * h[3] + P[13] * h[4],
        P[4] * h[0] + P[8] * h[1] + P[11] * h[2] + P[13] * h[3] + P[14] * h[4],
    )


@kernel
def times(s: float, g: Five) -> Five:
    """s g."""
    return (s * g[0], s * g[1], s * g[2], s * g[3], s * g[4])


@kernel
def added(x: Five, k: Five, z: float) -> Five:
    """x + k z: the five after a correction."""
    return (x[0] + k[0] * z, x[1] + k[1] * z, x[2] + k[2] * z, x[3] + k[3] * z, x[4] + k[4] * z)


@kernel
def less(P: Symmetric, g: Five, s: float) -> Symmetric:
    """P - s g g'."""
    a, b, c, d, e = s * g[0], s * g[1], s * g[2], s * g[3], s * g[4]
    return (
        P[0] - a * g[0], P[1] - a * g[1], P[2] - a * g[2], P[3] - a * g[3], P[4] - a * g[4],
        P[5] - b * g[1], P[6] - b * g[2], P[7] - b * g[3], P[8] - b * g[4],
        P[9] - c * g[2], P[10] - c * g[3], P[11] - c * g[4],
        P[12] - d * g[3], P[13] - d * g[4],
        P[14] - e * g[4],
    )  # fmt: skip


@kernel
def plus(P: Symmetric, variances: Five) -> Symmetric:
    """P with these variances added to its diagonal."""
    a, b, c, d, e = variances
    return (
        P[0] + a, P[1], P[2], P[3], P[4],
        P[5] + b, P[6], P[7], P[8],
        P[9] + c, P[10], P[11],
        P[12] + d, P[13],
        P[14] + e,
    )  # fmt: skip
