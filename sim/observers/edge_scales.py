"""Sizes of what disturbs an observer of Hall edges and back-EMF, by the motor's parameters.

What a dead time, a ripple or a load does to an angle goes with voltage, current, speed and inertia of the drive. Every
constant of `edge_kalman` is a multiple of one of these, so that it means the same on each motor.

Never sees a sample.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim import legs

V_SHARE = 0.00546  # of u_dc, V: what dead time and devices leave of a back-EMF
SHAFT = 0.14  # s: inertia of a shaft that is not known, by its torque at i_ref and the largest speed
AT_HALF = 0.99  # of the speed that u_dc / sqrt 3 allows with half of i_ref: the largest that is asked for
FULL_SCALE = 2.5  # of i_ref: the current sensors' range
OMEGA_B = 15.0  # omega_v, above which the back-EMF tells an angle better than one edge does
TINY = 1e-9  # least flux linkage, inductance, voltage, in their units: none of them divides by zero
LEAST = 1e-3  # A and rad/s


class Scale(NamedTuple):
    """The motor, and sizes; SI units, electrical angles."""

    T_s: float
    R_s: float
    L_s: float
    psi_f: float
    v: float  # V, a voltage that nobody knows
    v_drop: float  # V, the same along the current, where a resistance may be wrong
    i: float  # A, the largest phase current
    i_fade: float  # A, at which the dead time's error saturates
    omega_v: float  # rad/s, at which the back-EMF is v
    omega_b: float  # rad/s
    alpha: float  # rad/s2, what the largest torque does to the shaft
    feed: float  # rad/(s2 A), what the current does to it; 0: its inertia is not known


def make_scale(
    pwm_hz: float,
    *,
    n_p: float,
    omega_m_max: float,
    R_s_hat: float,
    L_s_hat: float,
    psi_f_hat: float,
    i_range: float,
    J_hat: float,
) -> Scale:
    """From the drive's parameters of these names; J_hat = 0: not known."""
    psi_f = max(psi_f_hat, TINY)
    i = max(i_range, LEAST) / FULL_SCALE
    omega_m_max = max(omega_m_max, LEAST)
    L_s_hat = max(L_s_hat, TINY)
    fastest = n_p * omega_m_max
    u = math.hypot(psi_f * fastest + 0.5 * R_s_hat * i, 0.5 * fastest * L_s_hat * i)
    v = max(V_SHARE * math.sqrt(3.0) / AT_HALF * u, TINY)
    torque = 1.5 * n_p * psi_f * i
    return Scale(
        T_s=1.0 / pwm_hz,
        R_s=R_s_hat,
        L_s=L_s_hat,
        psi_f=psi_f,
        v=v,
        v_drop=max(v, 0.1 * R_s_hat * i),
        i=i,
        i_fade=legs.FADE / (L_s_hat * pwm_hz),
        omega_v=v / psi_f,
        omega_b=OMEGA_B * v / psi_f,
        alpha=n_p * torque / (J_hat or SHAFT * torque / omega_m_max),
        feed=n_p * torque / (J_hat * i) if J_hat > 0.0 else 0.0,
    )
