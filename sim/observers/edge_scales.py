"""Sizes of the disturbances of an observer of Hall edges and back-EMF, from the motor's parameters.

The effect of a dead time, a ripple or a load on an angle depends on voltage, current, speed and inertia of the drive.
Each constant of `edge_kalman` is a multiple of one of these sizes, so it means the same with every motor.

This module never sees a sample.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim import legs

V_SHARE = 0.00546  # of u_dc, V: what dead time and devices leave of a back-EMF; chosen, as e_on in sim/default.toml
SHAFT = 0.14  # s: inertia of an unknown shaft, by its torque at i and the largest speed; chosen, as mechanics.J there
AT_HALF = 0.99  # of the speed that u_dc / sqrt 3 allows at half of i: the largest one; derived, as `top` there
FULL_SCALE = 2.5  # range of the current sensors by the largest current; derived, as current_sensor.range there
OMEGA_B = 15.0  # omega_b by omega_v: above it the back-EMF gives an angle better than one edge; tuned
DROP_SHARE = 0.1  # of R_s i, V: how wrong a resistance may be; chosen
TINY = 1e-9  # least flux linkage, inductance, voltage, in their units: none of them divides by zero
LEAST = 1e-3  # A and rad/s, likewise


class Scale(NamedTuple):
    """The motor, and the sizes; SI units, electrical angles."""

    T_s: float
    R_s: float
    L_s: float
    psi_f: float
    v: float  # V, unknown part of the voltage
    v_drop: float  # V, the same along the current, where a resistance may be wrong too
    i: float  # A, largest phase current
    i_fade: float  # A, current at which the dead time's error saturates
    omega_v: float  # rad/s, speed at which the back-EMF is v
    omega_b: float  # rad/s, speed above which the back-EMF gives an angle better than one edge
    alpha: float  # rad/s2, acceleration by the largest torque
    feed: float  # rad/(s2 A), acceleration by current; 0: the inertia is not known


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
        v_drop=max(v, DROP_SHARE * R_s_hat * i),
        i=i,
        i_fade=legs.FADE / (L_s_hat * pwm_hz),
        omega_v=v / psi_f,
        omega_b=OMEGA_B * v / psi_f,
        alpha=n_p * torque / (J_hat or SHAFT * torque / omega_m_max),
        feed=n_p * torque / (J_hat * i) if J_hat > 0.0 else 0.0,
    )
