"""Motor, inverter and shaft stepped in time: classic fourth-order Runge-Kutta, or running down with outputs off.

A step ends early where the speed passes zero (friction turns round there, or holds the shaft); the rest of the
interval follows as a step of its own.

The angle `theta_e` is unwrapped; its cosine and sine ride along, turned by small rotations, and are set right by
`refresh` now and then. This module reads no sensor and knows no firmware.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.plant import inverter, mechanics, pmsm

C_3, C_4, C_5, C_6, C_7, C_8, C_9, C_10 = (1.0 / math.factorial(k) for k in range(3, 11))
ONE_SIXTH = 1.0 / 6.0
SMALL = 0.3  # rad up to which a rotation's series is good to 5e-14
TINY = 1e-3  # rad up to which three terms are good to 1e-13


class Params(NamedTuple):
    """Constants of motor, inverter and shaft."""

    motor: pmsm.Params
    inverter: inverter.Params
    shaft: mechanics.Params


class State(NamedTuple):
    """The plant's state."""

    psi_alpha: float  # V s
    psi_beta: float
    omega_m: float  # rad/s
    theta_e: float  # electrical rad, unwrapped
    cos: float  # of theta_e
    sin: float


@kernel
def init(params: Params, theta_e: float) -> State:
    """At rest without current at the electrical angle `theta_e` (rad)."""
    cos = math.cos(theta_e)
    sin = math.sin(theta_e)
    return State(params.motor.psi_f * cos, params.motor.psi_f * sin, 0.0, theta_e, cos, sin)


@kernel
def refresh(state: State) -> State:
    """The same state with the cosine and sine of its angle computed anew."""
    return State(
        state.psi_alpha,
        state.psi_beta,
        state.omega_m,
        state.theta_e,
        math.cos(state.theta_e),
        math.sin(state.theta_e),
    )


@kernel
def rotation(angle: float) -> tuple[float, float]:
    """cos and sin of an angle (rad), by series where it is small."""
    x = angle * angle
    if x > SMALL * SMALL:
        return math.cos(angle), math.sin(angle)
    return (
        1.0 - x * (0.5 - x * (C_4 - x * (C_6 - x * (C_8 - x * C_10)))),
        angle * (1.0 - x * (C_3 - x * (C_5 - x * (C_7 - x * C_9)))),
    )


@kernel
def turn(cos: float, sin: float, angle: float) -> tuple[float, float]:
    """cos and sin of an angle (rad) further."""
    c, s = rotation(angle)
    return cos * c - sin * s, sin * c + cos * s


@kernel
def _nudge(cos: float, sin: float, angle: float) -> tuple[float, float]:
    """`turn` by the angles (rad) in which the stages of one step differ: nearly nothing."""
    x = angle * angle
    if x > TINY * TINY:
        return turn(cos, sin, angle)
    c = 1.0 - 0.5 * x
    s = angle * (1.0 - C_3 * x)
    return cos * c - sin * s, sin * c + cos * s


@kernel
def _rates(
    params: Params,
    applied: inverter.Applied,
    K_re: float,
    K_im: float,
    y_alpha: float,
    y_beta: float,
    omega_m: float,
    cos: float,
    sin: float,
) -> tuple[float, float, float]:
    """Rates of y (V) and the torque (N m) in one stage of `_driven`."""
    motor = params.motor
    omega_e = motor.n_p * omega_m
    k_alpha = K_re * cos - K_im * sin
    k_beta = K_re * sin + K_im * cos
    # written so that as little as possible waits for y
    i_alpha, i_beta = pmsm.winding_currents(
        motor, y_alpha + (k_alpha - motor.psi_f * cos), y_beta + (k_beta - motor.psi_f * sin), cos, sin
    )
    loss_alpha, loss_beta = inverter.loss(params.inverter, applied, i_alpha, i_beta)
    return (
        (applied.u_alpha + omega_e * k_beta) - motor.R_s * i_alpha - loss_alpha,
        (applied.u_beta - omega_e * k_alpha) - motor.R_s * i_beta - loss_beta,
        pmsm.torque(motor, y_alpha + k_alpha, y_beta + k_beta, i_alpha, i_beta),
    )


@kernel
def _driven(params: Params, state: State, applied: inverter.Applied, push: mechanics.Push, h: float) -> State:
    """One Runge-Kutta step with the outputs on.

    The magnet's flux turns and would be the largest error: 1e-6 A at two steps a period and 3000 r/min. So what
    is integrated is y = psi - K exp(j theta), where K = a psi_f / (a + j omega), a = R_s / L, is the answer to the
    magnet in steady state at the step's first speed. It is exact for L_d = L_q, and close otherwise.
    """
    motor = params.motor
    n_p = motor.n_p
    b = params.shaft.b
    gain = push.gain
    dry = push.tau_dry
    half = 0.5 * h

    omega1 = state.omega_m
    a = motor.R_s * motor.g_mean
    omega_e = n_p * omega1
    share = a * motor.psi_f / (a * a + omega_e * omega_e)
    K_re = share * a
    K_im = -share * omega_e
    cos, sin = state.cos, state.sin
    y_alpha = state.psi_alpha - (K_re * cos - K_im * sin)
    y_beta = state.psi_beta - (K_re * sin + K_im * cos)

    a1, b1, tau = _rates(params, applied, K_re, K_im, y_alpha, y_beta, omega1, cos, sin)
    alpha1 = gain * (tau - b * omega1 - dry) + push.alpha

    c, s = rotation(half * n_p * omega1)
    cos, sin = state.cos * c - state.sin * s, state.sin * c + state.cos * s
    omega2 = state.omega_m + half * alpha1
    a2, b2, tau = _rates(params, applied, K_re, K_im, y_alpha + half * a1, y_beta + half * b1, omega2, cos, sin)
    alpha2 = gain * (tau - b * omega2 - dry) + push.alpha

    c, s = _nudge(c, s, half * n_p * (omega2 - omega1))
    cos, sin = state.cos * c - state.sin * s, state.sin * c + state.cos * s
    omega3 = state.omega_m + half * alpha2
    a3, b3, tau = _rates(params, applied, K_re, K_im, y_alpha + half * a2, y_beta + half * b2, omega3, cos, sin)
    alpha3 = gain * (tau - b * omega3 - dry) + push.alpha

    cos, sin = cos * c - sin * s, sin * c + cos * s
    cos, sin = _nudge(cos, sin, h * n_p * (omega3 - omega2))
    omega4 = state.omega_m + h * alpha3
    a4, b4, tau = _rates(params, applied, K_re, K_im, y_alpha + h * a3, y_beta + h * b3, omega4, cos, sin)
    alpha4 = gain * (tau - b * omega4 - dry) + push.alpha

    sixth = h * ONE_SIXTH
    angle = sixth * n_p * (omega1 + 2.0 * (omega2 + omega3) + omega4)
    cos, sin = _nudge(cos, sin, angle - h * n_p * omega3)
    return State(
        y_alpha + sixth * (a1 + 2.0 * (a2 + a3) + a4) + (K_re * cos - K_im * sin),
        y_beta + sixth * (b1 + 2.0 * (b2 + b3) + b4) + (K_re * sin + K_im * cos),
        state.omega_m + sixth * (alpha1 + 2.0 * (alpha2 + alpha3) + alpha4),
        state.theta_e + angle,
        cos,
        sin,
    )


@kernel
def _coasting(params: Params, state: State, push: mechanics.Push, h: float) -> State:
    """One step with the outputs off: the current runs down, the shaft sees the mean torque of the step."""
    motor = params.motor
    i_alpha, i_beta = pmsm.currents(motor, state.psi_alpha, state.psi_beta, state.cos, state.sin)
    tau = pmsm.torque(motor, state.psi_alpha, state.psi_beta, i_alpha, i_beta)
    left_alpha, left_beta = inverter.freewheel(params.inverter, motor, i_alpha, i_beta, h)
    size = math.hypot(i_alpha, i_beta)
    if size > 0.0:
        tau *= 0.5 * (1.0 + math.hypot(left_alpha, left_beta) / size)
    # constant torque and viscous friction: the exact solution's series in x = b h / J
    alpha = push.gain * (tau - params.shaft.b * state.omega_m - push.tau_dry) + push.alpha
    x = push.gain * params.shaft.b * h
    omega_m = state.omega_m + alpha * h * (1.0 - x * (0.5 - x / 6.0))
    angle = motor.n_p * h * (state.omega_m + alpha * h * (0.5 - x * (1.0 / 6.0 - x / 24.0)))
    cos, sin = turn(state.cos, state.sin, angle)
    psi_alpha, psi_beta = pmsm.flux(motor, left_alpha, left_beta, cos, sin)
    return State(psi_alpha, psi_beta, omega_m, state.theta_e + angle, cos, sin)


@kernel
def _step(params: Params, state: State, applied: inverter.Applied, push: mechanics.Push, h: float) -> State:
    if applied.on:
        return _driven(params, state, applied, push, h)
    return _coasting(params, state, push, h)


@kernel
def torque(params: Params, state: State) -> float:
    """Electromagnetic torque now, N m."""
    i_alpha, i_beta = pmsm.currents(params.motor, state.psi_alpha, state.psi_beta, state.cos, state.sin)
    return pmsm.torque(params.motor, state.psi_alpha, state.psi_beta, i_alpha, i_beta)


@kernel
def step(
    params: Params, state: State, applied: inverter.Applied, load: mechanics.Load, h: float
) -> tuple[State, float]:
    """The state after `h` seconds, and the forced acceleration (rad/s2) of the load machine, 0 where it forces none."""
    left = h
    alpha = 0.0
    for _ in range(4):  # zero speed is passed once or twice in a step; four times never
        tau_e = torque(params, state) if state.omega_m == 0.0 else 0.0
        push = mechanics.push(params.shaft, load, state.omega_m, tau_e, left)
        alpha = push.alpha
        after = _step(params, state, applied, push, left)
        if push.gain == 0.0 or after.omega_m * push.tau_dry >= 0.0:
            return after, alpha
        # the speed turned against the direction that friction was taken for
        part = state.omega_m / (state.omega_m - after.omega_m)
        if part <= 0.0:  # from rest: the torque fell within the step
            part = 1.0
        else:
            after = _step(params, state, applied, push, part * left)
        state = State(after.psi_alpha, after.psi_beta, 0.0, after.theta_e, after.cos, after.sin)
        left *= 1.0 - part
        if left <= 1e-6 * h:
            return state, alpha
    return state, alpha
