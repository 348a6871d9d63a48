"""A motor of which one phase has no current: its wire is broken, or a short ties the two others together.

The current has one direction e in the stator frame then, that of two phases in series. With the flux linkage along it,

    x = e . psi,    dx/dt = e . u - R i,    x = e . psi(i e, theta)

gives the current; the flux across it is what magnet and iron make of that current, and its voltage is at the broken
wire, where nobody sees it. The current of a wire ends at once when it breaks: an arc is not in it.
"""

from __future__ import annotations

from sim.hints import apart
from sim.numba_cache import kernel
from sim.plant import pmsm

NONE, ALL = 0, 4  # else 1, 2, 3: the phase a, b or c has no current
TRIES = 8  # of the secant method: where nothing saturates the second is exact


@kernel
def axis(phase: int) -> tuple[float, float]:
    """The current's direction, where this phase (1, 2, 3) has none."""
    if phase == 1:
        return 0.0, 1.0
    return pmsm.HALF_SQRT3, 0.5 if phase == 2 else -0.5


@kernel
def _linkage(
    motor: pmsm.Params, i: float, e_alpha: float, e_beta: float, cos: float, sin: float
) -> tuple[float, float, float]:
    """Flux linkage along the axis (V s) with the current `i` (A) in it, and the whole flux."""
    psi_alpha, psi_beta = pmsm.flux(motor, i * e_alpha, i * e_beta, cos, sin)
    return e_alpha * psi_alpha + e_beta * psi_beta, psi_alpha, psi_beta


@kernel
def current(
    motor: pmsm.Params, along: float, e_alpha: float, e_beta: float, cos: float, sin: float
) -> tuple[float, float, float]:
    """The current (A) with which the linkage along the axis is `along` (V s), and the whole flux (V s) with it."""
    apart()
    before = 0.0
    lacks, psi_alpha, psi_beta = _linkage(motor, before, e_alpha, e_beta, cos, sin)
    lacks = along - lacks
    i = motor.g_mean * lacks
    for _ in range(TRIES):
        now, psi_alpha, psi_beta = _linkage(motor, i, e_alpha, e_beta, cos, sin)
        now = along - now
        if now == lacks or i == before:
            break
        following = i + now * (i - before) / (lacks - now)
        before, lacks, i = i, now, following
    return i, psi_alpha, psi_beta


@kernel
def torque(motor: pmsm.Params, i_alpha: float, i_beta: float, cos: float, sin: float) -> float:
    """Torque with these currents (A), cogging too, N m."""
    psi_alpha, psi_beta = pmsm.flux(motor, i_alpha, i_beta, cos, sin)
    if motor.uneven == 1:
        magnet = pmsm.magnet(motor, cos, sin)
        return pmsm.uneven_torque(motor, magnet, psi_alpha, psi_beta, i_alpha, i_beta)
    return motor.k_tau * (psi_alpha * i_beta - psi_beta * i_alpha)
