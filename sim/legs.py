"""What the legs of an inverter lose of the voltage, and how much of it: shapes over the phase currents, least squares.

A leg loses voltage against its current while both of its switches are off. Two shapes over the current make it up: the
sign, fading linearly below a current that a compensation of the dead time chose; and one that fades below the switching
ripple, as the dead time itself does: a leg whose current changes its sign within a period loses nothing. What turns
with the current is in each of them, but also what a resistance or a flux linkage is wrong by; so how much there is of
each is learned by the rest, the harmonics.

Keeps no state. Currents in A, vectors alpha, beta, for 1 V of loss.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel

FADE = 0.8448  # V, the current below which a compensation fades, times L and the PWM frequency: 0.3 A with the paper's
RIPPLE = 0.18  # of |u| T_s / L_s, the current below which the loss fades, by the switching ripple there
LEAST = 0.03  # of the one above: the least of that
FUNDAMENTAL = 4.0 / math.pi  # of a square wave
HALF_SQRT3 = 0.5 * math.sqrt(3.0)
ONE_BY_SQRT3 = 1.0 / math.sqrt(3.0)


class Shape(NamedTuple):
    """The loss of three legs."""

    alpha: float
    beta: float
    by: float  # 1/A: the current times this is what turns with it


class Along(NamedTuple):
    """A voltage along the harmonics of both shapes, and these along one another; sums over samples."""

    full: float  # V
    near: float
    full_full: float
    full_near: float
    near_near: float


@kernel
def per_ripple(u: float, L_by_T: float, per_fade: float) -> float:
    """1/A, of the current below which the loss fades at a voltage of that size (V)."""
    return L_by_T / max(RIPPLE * u, LEAST / per_fade * L_by_T)


@kernel
def shape(i_alpha: float, i_beta: float, size: float, per: float) -> Shape:
    """Of currents, fading below 1 / per; `size` of the current, above 0.

    The fundamental of a sine that is cut off, within 0.8 %.
    """
    f_a = min(max(i_alpha * per, -1.0), 1.0)
    f_b = min(max((HALF_SQRT3 * i_beta - 0.5 * i_alpha) * per, -1.0), 1.0)
    f_c = min(max((-HALF_SQRT3 * i_beta - 0.5 * i_alpha) * per, -1.0), 1.0)
    x = size * per
    by = per
    if x > 1.0:
        x = 1.0 / x
        by = FUNDAMENTAL * per * x * (1.0 - x * x * (1.0 / 6.0 + 0.048 * x * x))
    return Shape((2.0 * f_a - f_b - f_c) * (1.0 / 3.0), (f_b - f_c) * ONE_BY_SQRT3, by)


@kernel
def harmonics(of: Shape, i_alpha: float, i_beta: float) -> tuple[float, float]:
    """What of a shape does not turn with the current."""
    return of.alpha - of.by * i_alpha, of.beta - of.by * i_beta


@kernel
def none() -> Along:
    """No sample yet."""
    return Along(0.0, 0.0, 0.0, 0.0, 0.0)


@kernel
def along(so_far: Along, alpha: float, beta: float, full: tuple[float, float], near: tuple[float, float]) -> Along:
    """The sums with one sample more: a voltage (V), and the harmonics of both shapes."""
    return Along(
        so_far.full + alpha * full[0] + beta * full[1],
        so_far.near + alpha * near[0] + beta * near[1],
        so_far.full_full + full[0] * full[0] + full[1] * full[1],
        so_far.full_near + full[0] * near[0] + full[1] * near[1],
        so_far.near_near + near[0] * near[0] + near[1] * near[1],
    )


@kernel
def solved(
    C: tuple[float, float, float], sums: Along, most: float, more: float, weight: float
) -> tuple[float, float, tuple[float, float, float]]:
    """How much more there is of each shape (V), and the covariance of both (V²: full, both, near), by least squares.

    C: before; it has grown by `more` since, to `most` at most. `weight`: 1/V², of each sample.
    """
    a = min(C[0] + more, most)
    b = C[1]
    c = min(C[2] + more, most)
    det = a * c - b * b
    p = weight * sums.full_full + c / det
    q = weight * sums.full_near - b / det
    r = weight * sums.near_near + a / det
    det = p * r - q * q
    a, b, c = r / det, -q / det, p / det
    full = weight * (a * sums.full + b * sums.near)
    near = weight * (b * sums.full + c * sums.near)
    return full, near, (a, b, c)
