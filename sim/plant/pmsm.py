"""The motor: a permanent-magnet synchronous machine by its flux linkage in the stator frame.

    d psi_alphabeta / dt = u_alphabeta - R_s i_alphabeta
    psi_dq = [L_d i_d + psi_f, L_q i_q]
    tau_e = 3/2 n_p (psi_alpha i_beta - psi_beta i_alpha)

With the flux as the state, the rotor's motion enters only through cos and sin of its angle: no rotational voltage has
to be integrated, and the voltages stay constant over a PWM period. It is the model of (3) for L_d = L_q = L_s.

Amplitude-invariant quantities; currents are positive into the motor. No saturation, no iron losses, no cogging.

Source: (3) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel

HALF_SQRT3 = 0.5 * math.sqrt(3.0)
ONE_THIRD = 1.0 / 3.0
ONE_BY_SQRT3 = 1.0 / math.sqrt(3.0)


class Params(NamedTuple):
    """The motor's constants."""

    R_s: float  # ohm
    g_mean: float  # (1/L_d + 1/L_q) / 2, 1/H
    g_diff: float  # (1/L_d - 1/L_q) / 2, 1/H
    psi_f: float  # V s
    n_p: float
    k_tau: float  # 3/2 n_p


def make_params(R_s: float, L_d: float, L_q: float, psi_f: float, n_p: int) -> Params:
    """The motor's constants from ohm, H, H, V s and the number of pole pairs."""
    return Params(
        float(R_s),
        0.5 * (1.0 / L_d + 1.0 / L_q),
        0.5 * (1.0 / L_d - 1.0 / L_q),
        float(psi_f),
        float(n_p),
        1.5 * n_p,
    )


@kernel
def winding_currents(params: Params, v_alpha: float, v_beta: float, cos: float, sin: float) -> tuple[float, float]:
    """i_alpha, i_beta (A) from the windings' own flux linkage v = psi - psi_f exp(j theta) (V s)."""
    i_alpha = params.g_mean * v_alpha
    i_beta = params.g_mean * v_beta
    if params.g_diff != 0.0:
        cos2 = cos * cos - sin * sin
        sin2 = 2.0 * cos * sin
        i_alpha += params.g_diff * (cos2 * v_alpha + sin2 * v_beta)
        i_beta += params.g_diff * (sin2 * v_alpha - cos2 * v_beta)
    return i_alpha, i_beta


@kernel
def currents(params: Params, psi_alpha: float, psi_beta: float, cos: float, sin: float) -> tuple[float, float]:
    """i_alpha, i_beta (A) from the flux linkage (V s) and the rotor's angle."""
    return winding_currents(params, psi_alpha - params.psi_f * cos, psi_beta - params.psi_f * sin, cos, sin)


@kernel
def flux(params: Params, i_alpha: float, i_beta: float, cos: float, sin: float) -> tuple[float, float]:
    """psi_alpha, psi_beta (V s) from the currents (A) and the rotor's angle: the inverse of `currents`."""
    i_d = cos * i_alpha + sin * i_beta
    i_q = cos * i_beta - sin * i_alpha
    psi_d = i_d / (params.g_mean + params.g_diff) + params.psi_f
    psi_q = i_q / (params.g_mean - params.g_diff)
    return cos * psi_d - sin * psi_q, sin * psi_d + cos * psi_q


@kernel
def torque(params: Params, psi_alpha: float, psi_beta: float, i_alpha: float, i_beta: float) -> float:
    """Electromagnetic torque, N m."""
    return params.k_tau * (psi_alpha * i_beta - psi_beta * i_alpha)


@kernel
def phases(alpha: float, beta: float) -> tuple[float, float, float]:
    """Phase quantities a, b, c of a stator-frame vector."""
    b = HALF_SQRT3 * beta - 0.5 * alpha
    return alpha, b, -alpha - b


@kernel
def vector(a: float, b: float, c: float) -> tuple[float, float]:
    """Stator-frame vector of phase quantities; what the three have in common drops out."""
    return (2.0 * a - b - c) * ONE_THIRD, (b - c) * ONE_BY_SQRT3
