"""Sizes of the disturbances of an observer of Hall edges and back-EMF, from the motor's parameters.

The effect of a dead time, a ripple or a load on an angle depends on voltage, current, speed and inertia of the drive.
Each constant of `edge_kalman` is a multiple of one of these sizes, so it means the same with every motor.

This module never sees a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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


@dataclass(frozen=True, kw_only=True)
class Motor:
    """The drive's parameters that say which motor it has; 0: not known, where that is the default."""

    n_p: float
    omega_m_max: float  # mechanical rad/s
    R_s_hat: float  # ohm
    L_s_hat: float  # H
    psi_f_hat: float  # V s
    i_range: float  # A
    J_hat: float = 0.0  # kg m2
    u_dc_min: float = 0.0  # V, of the DC link, below which the drive trips


def make_scale(pwm_hz: float, motor: Motor) -> Scale:
    """The sizes for control periods at `pwm_hz` Hz."""
    psi_f, L_s = max(float(motor.psi_f_hat), TINY), max(float(motor.L_s_hat), TINY)
    R_s, J, n_p = float(motor.R_s_hat), float(motor.J_hat), float(motor.n_p)
    i, omega_m_max = max(float(motor.i_range), LEAST) / FULL_SCALE, max(float(motor.omega_m_max), LEAST)
    fastest = n_p * omega_m_max
    u = math.hypot(psi_f * fastest + 0.5 * R_s * i, 0.5 * fastest * L_s * i)
    # omega_m_max may be set far below what the link allows, and u_dc is u_dc_min at least
    v = max(V_SHARE * math.sqrt(3.0) / AT_HALF * u, V_SHARE * motor.u_dc_min, TINY)
    torque = 1.5 * n_p * psi_f * i
    return Scale(
        T_s=1.0 / float(pwm_hz),
        R_s=R_s,
        L_s=L_s,
        psi_f=psi_f,
        v=v,
        v_drop=max(v, DROP_SHARE * R_s * i),
        i=i,
        i_fade=legs.FADE / (L_s * float(pwm_hz)),
        omega_v=v / psi_f,
        omega_b=OMEGA_B * v / psi_f,
        alpha=n_p * torque / (J or SHAFT * torque / omega_m_max),
        feed=n_p * torque / (J * i) if J > 0.0 else 0.0,
    )
