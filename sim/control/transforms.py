"""Frames: stator to rotor and back, stator to phases; amplitude-invariant (`clarke`, `wrap`: sim.observers). Limits.

Never integrates and keeps no state.
"""

from __future__ import annotations

import math

from sim.numba_cache import kernel

HALF_SQRT3 = 0.5 * math.sqrt(3.0)


@kernel
def park(alpha: float, beta: float, cos: float, sin: float) -> tuple[float, float]:
    """(d, q) of a stator-frame vector, in its own unit; `cos`, `sin` of the frame's electrical angle."""
    return alpha * cos + beta * sin, beta * cos - alpha * sin


@kernel
def inverse_park(d: float, q: float, cos: float, sin: float) -> tuple[float, float]:
    """(alpha, beta) of a rotor-frame vector; the inverse of `park`."""
    return d * cos - q * sin, d * sin + q * cos


@kernel
def inverse_clarke(alpha: float, beta: float) -> tuple[float, float, float]:
    """Phases a, b, c of a stator-frame vector; their sum is zero."""
    return alpha, -0.5 * alpha + HALF_SQRT3 * beta, -0.5 * alpha - HALF_SQRT3 * beta


@kernel
def clip(value: float, limit: float) -> float:
    """`value` within +-`limit`."""
    return min(max(value, -limit), limit)
