"""Speed loop: a ramp on the reference, then PI with anti-windup. Mechanical speeds in, i_q reference out.

With inertia J and torque constant K_T, k_p = J * w / K_T closes the loop at w rad/s, and k_i well below k_p
* w / 4 keeps it damped. The defaults, k_p = 0.2 A s/rad and k_i = 3 A/rad, make w = 59 rad/s (9.4 Hz) of J =
2e-4 kg m2 and K_T = 0.059 N m/A: well below the 50 Hz of the filter on the estimated speed.

Never knows where its speed comes from.
"""

from __future__ import annotations

from typing import NamedTuple

from sim.control.transforms import clip
from sim.numba_cache import kernel


class Params(NamedTuple):
    """Constants of the loop."""

    k_p: float  # A s/rad
    k_i_T: float  # A/rad times T_s
    i_max: float  # A
    d_omega_max: float  # rad/s, largest change of the reference in a period


class State(NamedTuple):
    """What the loop remembers."""

    omega_m_ref: float  # rad/s, after the ramp
    i_q_i: float  # A, integral part


def make_params(pwm_hz: float, *, k_p_speed: float, k_i_speed: float, i_max: float, alpha_m_max: float) -> Params:
    """Constants from the drive's parameters of the same names (A s/rad, A/rad, A, rad/s2)."""
    T_s = 1.0 / float(pwm_hz)
    return Params(float(k_p_speed), float(k_i_speed) * T_s, float(i_max), float(alpha_m_max) * T_s)


@kernel
def init(omega_m: float, i_q: float) -> State:
    """Take over at the mechanical speed `omega_m` (rad/s) with `i_q` (A) flowing, without a bump."""
    return State(omega_m, i_q)


@kernel
def ramped(params: Params, state: State, omega_m_target: float) -> float:
    """The reference after the ramp of the coming period, rad/s."""
    return state.omega_m_ref + clip(omega_m_target - state.omega_m_ref, params.d_omega_max)


@kernel
def step(params: Params, state: State, omega_m_target: float, omega_m: float) -> tuple[State, float]:
    """One control period: (state, i_q reference in A), |i_q_ref| <= i_max.

    The integral stands still while the output is at its limit and the error would drive it further.
    """
    omega_m_ref = ramped(params, state, omega_m_target)
    error = omega_m_ref - omega_m
    i_q_i = state.i_q_i + params.k_i_T * error
    i_q_ref = params.k_p * error + i_q_i
    limited = clip(i_q_ref, params.i_max)
    if (i_q_ref - limited) * error > 0.0:
        i_q_i = state.i_q_i
    return State(omega_m_ref, i_q_i), limited
