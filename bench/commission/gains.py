"""Gains and thresholds of a drive by what was found of its motor: proportions, so that every motor gets its own.

Each is a bandwidth or a voltage in terms of the motor, as the simulated drive has them for the motor that was not
measured. What no measurement tells stays as it is: how much voltage the drive bears, and how much heat the winding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from bench.commission.quantity import Quantity

OF_PWM = 1.0 / 20.0
"""Bandwidth of the current loop over the PWM rate, at most: sampling, computing and PWM delay by 1.5 periods."""
SPEED_RATE, SPEED_INTEGRAL = 58.95, 15.0
"""rad/s, of the speed loop's proportional gain with the inertia, and 1/s of its integral."""
REFERENCE = 1980.0
"""rad/s, electrical, top speed of the paper's motor, by which rates of observers are scaled."""
TRACKING, TRACKING_INTEGRAL = 1268.0, 54289.0
"""1/s and 1/s2 of the vector tracking at that top speed."""
EMF_TIME, HALL_TIME, HALL_VECTOR = 0.5e-3, 0.2, 10.0
"""s of the back-EMF's filter at most, s without an edge, Hz of observers on the Hall vector; at that top speed."""
LOAD_ANGLE = 11.0 / (800.0 * 0.158) * 24.0
"""rad/(A s) of the load angle's integral, by the loop's Hz and ohm over the link's V."""
DEAD_SHARE, RESISTIVE = 0.00546, 0.1
"""Of the DC link, and of R times the current: V that dead time and a wrong R can leave of a back-EMF."""
ON_OFF = 0.6
"""Of the speed at which a correction by the back-EMF begins, that at which it ends."""
TOP = 0.99
"""Of the speed that the voltage allows with half of the current."""
TRIP_CURRENT, TRIP_SPEED, LOWEST_LINK = 2.0, 1.2, 0.5
"""Times the largest current and speed, and the DC link's voltage, at which the drive trips."""


@dataclass(frozen=True)
class Limits:
    """What a drive works within."""

    i_max: float
    """A."""
    omega_m: float
    """rad/s of the shaft that was agreed to; inf for none."""
    u_dc: float
    """V."""
    pwm_hz: float


def bandwidth(L: float, limits: Limits) -> float:
    """Hz of the current loop: a step of all of the current takes all of the voltage, and no more."""
    return min(OF_PWM * limits.pwm_hz, limits.u_dc / math.sqrt(3.0) / (math.tau * L * limits.i_max))


def top_speed(R: float, L: float, psi: float, limits: Limits) -> float:
    """rad/s, electrical, at which half of the current on q takes all of the voltage; 0 where it does at rest."""
    u, i = limits.u_dc / math.sqrt(3.0), 0.5 * limits.i_max
    if R * i >= u:
        return 0.0
    square = psi**2 + (L * i) ** 2
    return (math.sqrt((psi * R * i) ** 2 + square * (u**2 - (R * i) ** 2)) - psi * R * i) / square


def settings(found: Mapping[str, Quantity], n_p: int | None, limits: Limits) -> dict[str, float]:
    """Parameters by what was found, in their units; those for which something is missing are left out.

    `n_p`: None where nobody knows the pole pairs.
    """
    if not {"R_s", "L_q"} <= found.keys():
        return {}
    R, L = found["R_s"].value, found["L_q"].value
    bw = bandwidth(L, limits)
    told = {"i_max": limits.i_max, "i_trip": TRIP_CURRENT * limits.i_max, "bw_current": bw, "dead_time_comp": 1.0}
    told["u_dc_min"] = LOWEST_LINK * limits.u_dc
    if "psi_f" not in found:
        return told
    psi = found["psi_f"].value
    top = TOP * top_speed(R, L, psi, limits)
    scale = max(top, 1.0) / REFERENCE
    left = max(DEAD_SHARE * limits.u_dc, RESISTIVE * R * limits.i_max)
    told |= {
        "k_p_vt": TRACKING * scale, "k_i_vt": TRACKING_INTEGRAL * scale**2, "tau_max": EMF_TIME / scale,
        "hall_timeout": HALL_TIME / scale, "bw_hall_vector": HALL_VECTOR * scale,
        "k_ic": LOAD_ANGLE * bw * R / limits.u_dc, "omega_on": left / psi, "omega_off": ON_OFF * left / psi,
    }  # fmt: skip
    if n_p is None:
        return told
    omega_m = min(top / n_p, limits.omega_m)
    told |= {"omega_m_max": omega_m, "omega_m_trip": TRIP_SPEED * omega_m}
    if "J" in found and found["J"].value > 0.0:
        k_p = SPEED_RATE * found["J"].value / (1.5 * n_p * psi)
        told |= {"k_p_speed": k_p, "k_i_speed": SPEED_INTEGRAL * k_p}
    return told
