"""Angles and frames that observers and controllers share; amplitude-invariant (vectors are phase peaks).

Never integrates and keeps no state.
"""

from __future__ import annotations

import math

from sim.numba_cache import kernel

TWO_PI = 2.0 * math.pi
TURNS_PER_RAD = 1.0 / TWO_PI
ONE_BY_SQRT3 = 1.0 / math.sqrt(3.0)


@kernel
def wrap(angle: float) -> float:
    """The same angle (rad) in [-pi, pi)."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = angle - TWO_PI * math.floor((angle + math.pi) * TURNS_PER_RAD)
    return wrapped if -math.pi <= wrapped < math.pi else -math.pi  # rounding, at the seam


@kernel
def clarke(a: float, b: float, c: float) -> tuple[float, float]:
    """(alpha, beta) of three phase quantities, in their own unit; a part common to all three drops out."""
    return (2.0 * a - b - c) / 3.0, (b - c) * ONE_BY_SQRT3


@kernel
def clip(value: float, limit: float) -> float:
    """`value` within +-`limit`."""
    return min(max(value, -limit), limit)


@kernel
def square(x: float) -> float:
    """x²: a product has the same bits compiled and not, which a power need not have."""
    return x * x
