"""Motor, inverter and shaft stepped in time: the winding exactly, or running down with outputs off.

A step ends early where the speed passes zero (friction turns round there, or holds the shaft); the rest of the
interval follows as a step of its own.

The angle `theta_e` is unwrapped; its cosine and sine ride along, turned by small rotations, and are set right by
`refresh` now and then. This module reads no sensor and knows no firmware.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.hints import apart, seldom
from sim.numba_cache import kernel
from sim.plant import dead_time, inverter, mechanics, open_phase, pmsm

C_3, C_4, C_5, C_6, C_7, C_8, C_9, C_10 = (1.0 / math.factorial(k) for k in range(3, 11))
ONE_SIXTH, ONE_TWELFTH, ONE_TWENTY_FOURTH = 1.0 / 6.0, 1.0 / 12.0, 1.0 / 24.0
ONE_SIXTIETH, ONE_BY_120 = 1.0 / 60.0, 1.0 / 120.0
SMALL = 0.3  # rad up to which a rotation's series is good to 5e-14
TINY = 0.06  # rad up to which a shorter one is good to 5e-15
ROUNDS = 3  # of the iteration for the inverter's loss


class Decay(NamedTuple):
    """How the winding's flux follows a constant voltage over a step of `h` seconds, a = R_s (1/L_d + 1/L_q) / 2."""

    h: float
    whole: float  # exp(-a h)
    gain: float  # s, (1 - exp(-a h)) / a
    half: float  # the same of half a step
    half_gain: float
    skew: float  # s, what a voltage that falls by one volt over the step adds to the answer to its mean


def make_decay(motor: pmsm.Params, h: float) -> Decay:
    """The constants of a step of `h` seconds."""
    x = motor.R_s * motor.g_mean * h
    return Decay(
        float(h),
        math.exp(-x),
        -h * math.expm1(-x) / x,
        math.exp(-0.5 * x),
        -h * math.expm1(-0.5 * x) / x,
        h * x / 12.0,
    )


def decays(motor: pmsm.Params, h: float) -> tuple[Decay, Decay]:
    """The constants of whole and of half steps of `h` seconds."""
    return make_decay(motor, h), make_decay(motor, 0.5 * h)


class Params(NamedTuple):
    """Constants of motor, inverter and shaft."""

    motor: pmsm.Params
    inverter: inverter.Params
    shaft: mechanics.Params
    decay: Decay  # of whole steps
    half_decay: Decay  # of half steps
    open: int = 0  # the phase whose wire is broken, as in `open_phase`
    tied: int = 0  # the phase that is alone while a short ties the others together, likewise
    tied_R: float = 0.0  # ohm, of that short


class State(NamedTuple):
    """The plant's state."""

    psi_alpha: float  # V s
    psi_beta: float
    omega_m: float  # rad/s
    theta_e: float  # electrical rad, unwrapped
    cos: float  # of theta_e
    sin: float
    late: float = 0.0  # rad, by which `theta_e` is behind: some nanoradians, made up for in the next step


@kernel
def init(params: Params, theta_e: float) -> State:
    """At rest without current at the electrical angle `theta_e` (rad)."""
    cos = math.cos(theta_e)
    sin = math.sin(theta_e)
    psi_alpha, psi_beta = pmsm.flux(params.motor, 0.0, 0.0, cos, sin)
    return State(psi_alpha, psi_beta, 0.0, theta_e, cos, sin, 0.0)


@kernel
def refresh(state: State) -> State:
    """The same state with the cosine and sine of its angle computed anew."""
    return state._replace(cos=math.cos(state.theta_e), sin=math.sin(state.theta_e))


@kernel
def fed(params: Params, u_dc: float) -> Params:
    """The same plant on another DC link voltage (V)."""
    return params._replace(inverter=inverter.fed(params.inverter, u_dc))


@kernel
def apply(
    params: Params, state: State, i_alpha: float, i_beta: float, d_a: float, d_b: float, d_c: float
) -> inverter.Applied:
    """What the inverter does over a PWM period with duties 0..1, that begins in `state` with these currents (A)."""
    applied = inverter.apply(params.inverter, d_a, d_b, d_c)
    if params.inverter.legs.dead == 0.0:
        return applied
    motor = params.motor
    duties = (min(max(d_a, 0.0), 1.0), min(max(d_b, 0.0), 1.0), min(max(d_c, 0.0), 1.0))
    currents = pmsm.phases(i_alpha, i_beta)
    u_alpha, u_beta = dead_time.mean_voltage(
        params.inverter.legs, motor, duties, currents, state.cos, state.sin, motor.n_p * state.omega_m
    )
    return applied._replace(u_alpha=u_alpha, u_beta=u_beta)


@kernel
def rotation(angle: float) -> tuple[float, float]:
    """cos and sin of an angle (rad), by series where it is small."""
    x = angle * angle
    if x < TINY * TINY:
        return 1.0 - x * (0.5 - x * (C_4 - x * C_6)), angle * (1.0 - x * (C_3 - x * (C_5 - x * C_7)))
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
def _decay(params: Params, h: float) -> Decay:
    """The same for a step of any length: by series, for at most the step that `params` is made for."""
    if h == params.decay.h:
        return params.decay
    if h == params.half_decay.h:
        return params.half_decay
    x = params.motor.R_s * params.motor.g_mean * h
    y = 0.5 * x
    half = math.exp(-y)
    half_share = 1.0 - 0.5 * y * (1.0 - y * (1.0 / 3.0 - y * (1.0 / 12.0 - y * (1.0 / 60.0 - y / 360.0))))
    return Decay(h, half * half, h * half_share * 0.5 * (1.0 + half), half, 0.5 * h * half_share, h * x / 12.0)


@kernel
def _nudge(cos: float, sin: float, angle: float) -> tuple[float, float]:
    """`turn` by nearly nothing: by an angle (rad) whose third power is."""
    c = 1.0 - 0.5 * angle * angle
    return cos * c - sin * angle, sin * c + cos * angle


@kernel
def _salient(motor: pmsm.Params, psi_alpha: float, psi_beta: float, cos: float, sin: float) -> tuple[float, float]:
    """The voltage on R_s of the currents that are there because L_d and L_q differ."""
    i_alpha, i_beta = pmsm.currents(motor, psi_alpha, psi_beta, cos, sin)
    return (
        motor.R_s * (i_alpha - motor.g_mean * (psi_alpha - motor.psi_f * cos)),
        motor.R_s * (i_beta - motor.g_mean * (psi_beta - motor.psi_f * sin)),
    )


@kernel
def _torque(motor: pmsm.Params, psi_alpha: float, psi_beta: float, cos: float, sin: float) -> float:
    """Torque (N m); where L_d = L_q it is the magnet's part alone, which is found without the currents."""
    if motor.g_diff == 0.0:
        return motor.k_tau * motor.g_mean * motor.psi_f * (cos * psi_beta - sin * psi_alpha)
    i_alpha, i_beta = pmsm.currents(motor, psi_alpha, psi_beta, cos, sin)
    return motor.k_tau * (psi_alpha * i_beta - psi_beta * i_alpha)


@kernel
def _driven(params: Params, state: State, applied: inverter.Applied, push: mechanics.Push, h: float) -> State:
    """One step with the outputs on, of a motor with L_d = L_q.

    The winding's flux answers exactly to a constant voltage and to a magnet that turns evenly: by K exp(j theta) with
    K = a psi_f / (a + j omega), a = R_s / L. By how much the magnet does not is in it to first order. The inverter's
    loss is in it by its mean as the currents go from the step's begin to its end, which is found by iteration where a
    phase comes near zero. Speed and angle follow from the torque and its first two derivatives at both ends. What the
    angle still lacks then is made up for in the next step, so that nothing in this one waits for it.
    """
    motor = params.motor
    n_p = motor.n_p
    b = params.shaft.b
    gain = push.gain
    decay = _decay(params, h)
    a = motor.R_s * motor.g_mean
    torque_by = motor.k_tau * motor.g_mean * motor.psi_f  # N m by V s across the magnet

    omega_m = state.omega_m
    omega_e = n_p * omega_m
    cos0, sin0 = state.cos, state.sin
    i0_alpha, i0_beta = pmsm.even_currents(motor, state.psi_alpha, state.psi_beta, cos0, sin0)
    loss_alpha, loss_beta = inverter.loss(params.inverter, applied, i0_alpha, i0_beta)
    u_alpha = applied.u_alpha - loss_alpha
    u_beta = applied.u_beta - loss_beta
    across0 = cos0 * state.psi_beta - sin0 * state.psi_alpha
    alpha0 = gain * (torque_by * across0 - b * omega_m - push.tau_dry) + push.alpha
    rate_alpha = u_alpha - motor.R_s * i0_alpha
    rate_beta = u_beta - motor.R_s * i0_beta
    along0 = sin0 * state.psi_beta + cos0 * state.psi_alpha
    along_rate = cos0 * rate_alpha + sin0 * rate_beta
    across_rate = cos0 * rate_beta - sin0 * rate_alpha
    slope0 = gain * (torque_by * (across_rate - omega_e * along0) - b * alpha0)
    curve0 = omega_e * (2.0 * along_rate + omega_e * across0) + a * (across_rate - motor.psi_f * omega_e)
    curve0 = -gain * torque_by * (curve0 + n_p * alpha0 * along0)

    # the end: the angle is that of an even turn, and `more`
    mean = omega_e + 0.5 * n_p * h * alpha0
    ahead = h * mean
    c, s = rotation(ahead)
    cos = cos0 * c - sin0 * s
    sin = sin0 * c + cos0 * s
    more = n_p * h * h * h * (ONE_SIXTH * slope0 + ONE_TWENTY_FOURTH * h * curve0) + state.late
    cos, sin = _nudge(cos, sin, more)
    share = a * motor.psi_f / (a * a + mean * mean)
    K_re = share * a
    K_im = share * mean  # of the conjugate
    bend = ONE_TWENTY_FOURTH * a * motor.psi_f * n_p * h * h * h * alpha0
    left_im = K_im - bend
    right_re = K_re - more * K_im
    right_im = K_im + bend + more * (K_re - 0.25 * h * a * motor.psi_f)
    free_alpha = decay.whole * (state.psi_alpha - K_re * cos0 - left_im * sin0) + (right_re * cos + right_im * sin)
    free_beta = decay.whole * (state.psi_beta - K_re * sin0 + left_im * cos0) + (right_re * sin - right_im * cos)
    psi_alpha = free_alpha + decay.gain * u_alpha
    psi_beta = free_beta + decay.gain * u_beta
    i_alpha, i_beta = pmsm.even_currents(motor, psi_alpha, psi_beta, cos, sin)
    omega_1 = omega_e + n_p * h * (alpha0 + 0.5 * h * slope0)
    rate_alpha = u_alpha - motor.R_s * i_alpha
    rate_beta = u_beta - motor.R_s * i_beta
    if inverter.loses(applied) and not inverter.settled(params.inverter, i0_alpha, i0_beta, i_alpha, i_beta):
        eighth = 0.125 * h * motor.g_mean
        first_alpha = u_alpha - motor.R_s * i0_alpha + motor.psi_f * (omega_e * sin0 - omega_1 * sin)
        first_beta = u_beta - motor.R_s * i0_beta - motor.psi_f * (omega_e * cos0 - omega_1 * cos)
        for _ in range(ROUNDS):
            bow_alpha = eighth * (first_alpha - rate_alpha)  # of the cubic through values and slopes
            bow_beta = eighth * (first_beta - rate_beta)
            mean_alpha, mean_beta = inverter.mean_loss(
                params.inverter, applied, i0_alpha, i0_beta, i_alpha, i_beta, bow_alpha, bow_beta
            )
            end_alpha, end_beta = inverter.loss(params.inverter, applied, i_alpha, i_beta)
            psi_alpha = free_alpha + decay.gain * (applied.u_alpha - mean_alpha) - decay.skew * (end_alpha - loss_alpha)
            psi_beta = free_beta + decay.gain * (applied.u_beta - mean_beta) - decay.skew * (end_beta - loss_beta)
            i_alpha, i_beta = pmsm.even_currents(motor, psi_alpha, psi_beta, cos, sin)
            rate_alpha = applied.u_alpha - end_alpha - motor.R_s * i_alpha
            rate_beta = applied.u_beta - end_beta - motor.R_s * i_beta
    along = sin * psi_beta + cos * psi_alpha
    across = cos * psi_beta - sin * psi_alpha
    alpha1 = gain * (torque_by * across - b * (omega_m + h * (alpha0 + 0.5 * h * slope0)) - push.tau_dry) + push.alpha
    along_rate = cos * rate_alpha + sin * rate_beta
    across_rate = cos * rate_beta - sin * rate_alpha
    slope1 = gain * (torque_by * (across_rate - omega_1 * along) - b * alpha1)
    curve1 = omega_1 * (2.0 * along_rate + omega_1 * across) + a * (across_rate - motor.psi_f * omega_1)
    curve1 = -gain * torque_by * (curve1 + n_p * alpha1 * along)
    late = ONE_SIXTIETH * (7.0 * slope0 + 2.0 * slope1) + ONE_TWENTY_FOURTH * h * curve0
    late = n_p * h * h * (0.15 * (alpha1 - alpha0) - h * late)
    faster = 0.5 * (alpha0 + alpha1) + h * (0.1 * (slope0 - slope1) + ONE_BY_120 * h * (curve0 + curve1))
    return State(psi_alpha, psi_beta, omega_m + h * faster, state.theta_e + (ahead + more), cos, sin, late)


@kernel
def _salient_driven(params: Params, state: State, applied: inverter.Applied, push: mechanics.Push, h: float) -> State:
    """`_driven` where L_d and L_q differ.

    What they differ by goes by Simpson's rule, and so do the magnet as it turns, torque and speed.
    """
    motor = params.motor
    n_p = motor.n_p
    b = params.shaft.b
    gain = push.gain
    decay = _decay(params, h)
    half = 0.5 * h
    a = motor.R_s * motor.g_mean
    magnet = a * motor.psi_f

    omega_m = state.omega_m
    omega_e = n_p * omega_m
    cos0, sin0 = state.cos, state.sin
    i0_alpha, i0_beta = pmsm.currents(motor, state.psi_alpha, state.psi_beta, cos0, sin0)
    loss_alpha, loss_beta = inverter.loss(params.inverter, applied, i0_alpha, i0_beta)
    u_alpha = applied.u_alpha - loss_alpha
    u_beta = applied.u_beta - loss_beta
    tau0 = _torque(motor, state.psi_alpha, state.psi_beta, cos0, sin0)
    alpha0 = gain * (tau0 - b * omega_m - push.tau_dry) + push.alpha

    # the middle; the torque's slope is that of L_d = L_q
    rate_alpha = u_alpha - motor.R_s * i0_alpha
    rate_beta = u_beta - motor.R_s * i0_beta
    slope = cos0 * rate_beta - sin0 * rate_alpha - omega_e * (sin0 * state.psi_beta + cos0 * state.psi_alpha)
    slope = gain * (motor.k_tau * motor.g_mean * motor.psi_f * slope - b * alpha0)
    early = 0.125 * h * h * n_p * (alpha0 + ONE_SIXTH * h * slope)  # rad, of what the first speed would make
    c, s = rotation(half * omega_e + early)
    cos = cos0 * c - sin0 * s
    sin = sin0 * c + cos0 * s
    x_cos = decay.half * cos0 - cos
    x_sin = decay.half * sin0 - sin
    tilt = h * ONE_TWELFTH
    share = 0.25 * h * magnet
    psi_alpha = decay.half * state.psi_alpha + decay.half_gain * u_alpha
    psi_beta = decay.half * state.psi_beta + decay.half_gain * u_beta
    faster = half * n_p * alpha0
    psi_alpha += share * (x_cos + 2.0 * cos + tilt * (a * x_cos - omega_e * x_sin + faster * sin))
    psi_beta += share * (x_sin + 2.0 * sin + tilt * (a * x_sin + omega_e * x_cos - faster * cos))
    bend0_alpha, bend0_beta = _salient(motor, state.psi_alpha, state.psi_beta, cos0, sin0)
    bend_alpha, bend_beta = bend0_alpha, bend0_beta
    for _ in range(2):
        mean_alpha = decay.half_gain * 0.5 * (bend0_alpha + bend_alpha)
        mean_beta = decay.half_gain * 0.5 * (bend0_beta + bend_beta)
        bend_alpha, bend_beta = _salient(motor, psi_alpha - mean_alpha, psi_beta - mean_beta, cos, sin)
    psi_alpha -= decay.half_gain * 0.5 * (bend0_alpha + bend_alpha)
    psi_beta -= decay.half_gain * 0.5 * (bend0_beta + bend_beta)
    mid_alpha, mid_beta = pmsm.currents(motor, psi_alpha, psi_beta, cos, sin)
    tau = _torque(motor, psi_alpha, psi_beta, cos, sin)
    alpha = gain * (tau - b * (omega_m + half * (alpha0 + 0.5 * half * slope)) - push.tau_dry) + push.alpha

    # the end, at the angle by the slope: what it lacks is put right when all is known, so that nothing waits for it
    ahead = n_p * h * h * (0.5 * alpha0 + ONE_SIXTH * h * slope) + state.late
    c, s = _nudge(c, s, ahead - 2.0 * early)
    magnet *= h * ONE_SIXTH
    free_alpha = decay.whole * (state.psi_alpha + magnet * cos0) + 4.0 * magnet * decay.half * cos
    free_beta = decay.whole * (state.psi_beta + magnet * sin0) + 4.0 * magnet * decay.half * sin
    cos, sin = cos * c - sin * s, sin * c + cos * s
    free_alpha += magnet * cos
    free_beta += magnet * sin
    psi_alpha = free_alpha + decay.gain * u_alpha
    psi_beta = free_beta + decay.gain * u_beta
    end_alpha = psi_alpha - decay.gain * bend_alpha
    end_beta = psi_beta - decay.gain * bend_beta
    bend1_alpha, bend1_beta = _salient(motor, end_alpha, end_beta, cos, sin)
    sixth = h * ONE_SIXTH
    bend_alpha = sixth * (decay.whole * bend0_alpha + 4.0 * decay.half * bend_alpha + bend1_alpha)
    bend_beta = sixth * (decay.whole * bend0_beta + 4.0 * decay.half * bend_beta + bend1_beta)
    free_alpha -= bend_alpha
    free_beta -= bend_beta
    psi_alpha -= bend_alpha
    psi_beta -= bend_beta
    i_alpha, i_beta = pmsm.currents(motor, psi_alpha, psi_beta, cos, sin)
    if inverter.loses(applied) and not inverter.settled(params.inverter, i0_alpha, i0_beta, i_alpha, i_beta):
        bent = 0.125 * h * motor.g_mean
        bow_alpha = mid_alpha - 0.5 * (i0_alpha + i_alpha)
        bow_beta = mid_beta - 0.5 * (i0_beta + i_beta)
        for _ in range(ROUNDS):
            mean_alpha, mean_beta = inverter.mean_loss(
                params.inverter, applied, i0_alpha, i0_beta, i_alpha, i_beta, bow_alpha, bow_beta
            )
            end_alpha, end_beta = inverter.loss(params.inverter, applied, i_alpha, i_beta)
            end_alpha -= loss_alpha
            end_beta -= loss_beta
            psi_alpha = free_alpha + decay.gain * (applied.u_alpha - mean_alpha) - decay.skew * end_alpha
            psi_beta = free_beta + decay.gain * (applied.u_beta - mean_beta) - decay.skew * end_beta
            i_alpha, i_beta = pmsm.currents(motor, psi_alpha, psi_beta, cos, sin)
            less = motor.g_mean * decay.half_gain
            bow_alpha = mid_alpha - 0.5 * (i0_alpha + i_alpha) - less * (mean_alpha - loss_alpha) + bent * end_alpha
            bow_beta = mid_beta - 0.5 * (i0_beta + i_beta) - less * (mean_beta - loss_beta) + bent * end_beta
    late = n_p * h * h * ONE_SIXTH * (alpha0 + 2.0 * alpha) - ahead
    along = sin * psi_beta + cos * psi_alpha
    tau1 = _torque(motor, psi_alpha, psi_beta, cos, sin) - motor.k_tau * motor.g_mean * motor.psi_f * along * late
    alpha1 = gain * (tau1 - b * (omega_m + h * alpha) - push.tau_dry) + push.alpha
    faster = ONE_SIXTH * (alpha0 + 4.0 * alpha + alpha1)
    cos, sin = _nudge(cos, sin, late)
    theta_e = state.theta_e + (h * n_p * state.omega_m + ahead + late)
    return State(psi_alpha, psi_beta, omega_m + h * faster, theta_e, cos, sin, 0.0)


@kernel
def _rates(
    params: Params,
    applied: inverter.Applied,
    push: mechanics.Push,
    magnet: pmsm.Magnet,
    psi_alpha: float,
    psi_beta: float,
    omega_m: float,
) -> tuple[float, float, float]:
    """How the flux (V) and the speed (rad/s2) of an uneven motor change at a moment."""
    motor = params.motor
    i_alpha, i_beta = pmsm.uneven_currents(motor, magnet, psi_alpha, psi_beta)
    loss_alpha, loss_beta = inverter.loss(params.inverter, applied, i_alpha, i_beta)
    tau = pmsm.uneven_torque(motor, magnet, psi_alpha, psi_beta, i_alpha, i_beta)
    return (
        applied.u_alpha - loss_alpha - motor.R_s * i_alpha,
        applied.u_beta - loss_beta - motor.R_s * i_beta,
        push.gain * (tau - params.shaft.b * omega_m - push.tau_dry) + push.alpha,
    )


@kernel
def _uneven(params: Params, state: State, applied: inverter.Applied, push: mechanics.Push, h: float) -> State:
    """One step of an uneven motor with the outputs on, by the Runge-Kutta method of fourth order.

    Its two middle stages share an angle, which the slopes of the begin tell well enough.
    """
    n_p = params.motor.n_p
    half = 0.5 * h
    psi_alpha, psi_beta, omega_m = state.psi_alpha, state.psi_beta, state.omega_m
    magnet = pmsm.magnet(params.motor, state.cos, state.sin)
    a1, b1, w1 = _rates(params, applied, push, magnet, psi_alpha, psi_beta, omega_m)
    cos, sin = turn(state.cos, state.sin, n_p * half * (omega_m + 0.5 * half * w1))
    magnet = pmsm.magnet(params.motor, cos, sin)
    a2, b2, w2 = _rates(params, applied, push, magnet, psi_alpha + half * a1, psi_beta + half * b1, omega_m + half * w1)
    a3, b3, w3 = _rates(params, applied, push, magnet, psi_alpha + half * a2, psi_beta + half * b2, omega_m + half * w2)
    angle = n_p * h * (omega_m + h * ONE_SIXTH * (w1 + w2 + w3)) + state.late
    cos, sin = turn(state.cos, state.sin, angle)
    magnet = pmsm.magnet(params.motor, cos, sin)
    a4, b4, w4 = _rates(params, applied, push, magnet, psi_alpha + h * a3, psi_beta + h * b3, omega_m + h * w3)
    sixth = h * ONE_SIXTH
    return State(
        psi_alpha + sixth * (a1 + 2.0 * (a2 + a3) + a4),
        psi_beta + sixth * (b1 + 2.0 * (b2 + b3) + b4),
        omega_m + sixth * (w1 + 2.0 * (w2 + w3) + w4),
        state.theta_e + angle,
        cos,
        sin,
        0.0,
    )


@kernel
def _coasting(params: Params, state: State, push: mechanics.Push, h: float) -> State:
    """One step with the outputs off: the current runs down, the shaft sees the mean torque of the step."""
    motor = params.motor
    i_alpha, i_beta, tau = pmsm.currents_and_torque(motor, state.psi_alpha, state.psi_beta, state.cos, state.sin)
    left_alpha, left_beta = inverter.freewheel(params.inverter, motor, i_alpha, i_beta, h)
    size = math.sqrt(i_alpha * i_alpha + i_beta * i_beta)
    if size > 0.0:
        tau *= 0.5 * (1.0 + math.sqrt(left_alpha * left_alpha + left_beta * left_beta) / size)
    if motor.uneven == 1:
        tau += pmsm.magnet(motor, state.cos, state.sin).cogging
    # constant torque and viscous friction: the exact solution's series in x = b h / J
    alpha = push.gain * (tau - params.shaft.b * state.omega_m - push.tau_dry) + push.alpha
    x = push.gain * params.shaft.b * h
    omega_m = state.omega_m + alpha * h * (1.0 - x * (0.5 - x / 6.0))
    angle = motor.n_p * h * (state.omega_m + alpha * h * (0.5 - x * (1.0 / 6.0 - x / 24.0))) + state.late
    cos, sin = turn(state.cos, state.sin, angle)
    psi_alpha, psi_beta = pmsm.flux(motor, left_alpha, left_beta, cos, sin)
    return State(psi_alpha, psi_beta, omega_m, state.theta_e + angle, cos, sin, 0.0)


@kernel
def _on_axis_rates(
    params: Params,
    applied: inverter.Applied,
    push: mechanics.Push,
    phase: int,
    along: float,
    omega_m: float,
    cos: float,
    sin: float,
) -> tuple[float, float]:
    """How the flux along the axis (V) and the speed (rad/s2) change where `phase` has no current."""
    apart()
    motor = params.motor
    e_alpha, e_beta = open_phase.axis(phase)
    i, _, _ = open_phase.current(motor, along, e_alpha, e_beta, cos, sin)
    tau = open_phase.torque(motor, i * e_alpha, i * e_beta, cos, sin)
    loss_alpha, loss_beta = inverter.loss(params.inverter, applied, i * e_alpha, i * e_beta)
    u = e_alpha * (applied.u_alpha - loss_alpha) + e_beta * (applied.u_beta - loss_beta)
    R = motor.R_s if applied.on else motor.R_s + 0.5 * params.tied_R
    return u - R * i, push.gain * (tau - params.shaft.b * omega_m - push.tau_dry) + push.alpha


@kernel
def _on_axis(
    params: Params, state: State, applied: inverter.Applied, push: mechanics.Push, h: float, phase: int
) -> State:
    """`_uneven` where one phase has no current."""
    apart()
    n_p = params.motor.n_p
    half = 0.5 * h
    omega_m = state.omega_m
    e_alpha, e_beta = open_phase.axis(phase)
    x = e_alpha * state.psi_alpha + e_beta * state.psi_beta
    x1, w1 = _on_axis_rates(params, applied, push, phase, x, omega_m, state.cos, state.sin)
    cos, sin = turn(state.cos, state.sin, n_p * half * (omega_m + 0.5 * half * w1))
    x2, w2 = _on_axis_rates(params, applied, push, phase, x + half * x1, omega_m + half * w1, cos, sin)
    x3, w3 = _on_axis_rates(params, applied, push, phase, x + half * x2, omega_m + half * w2, cos, sin)
    angle = n_p * h * (omega_m + h * ONE_SIXTH * (w1 + w2 + w3)) + state.late
    cos, sin = turn(state.cos, state.sin, angle)
    x4, w4 = _on_axis_rates(params, applied, push, phase, x + h * x3, omega_m + h * w3, cos, sin)
    sixth = h * ONE_SIXTH
    x += sixth * (x1 + 2.0 * (x2 + x3) + x4)
    omega_m += sixth * (w1 + 2.0 * (w2 + w3) + w4)
    _, psi_alpha, psi_beta = open_phase.current(params.motor, x, e_alpha, e_beta, cos, sin)
    return State(psi_alpha, psi_beta, omega_m, state.theta_e + angle, cos, sin, 0.0)


@kernel
def _step(params: Params, state: State, applied: inverter.Applied, push: mechanics.Push, h: float) -> State:
    lone = params.open if applied.on else params.tied
    if seldom(lone != open_phase.NONE and lone != open_phase.ALL):
        return _on_axis(params, state, applied, push, h, lone)
    if not applied.on or lone == open_phase.ALL:
        return _coasting(params, state, push, h)
    if params.motor.uneven == 1:
        return _uneven(params, state, applied, push, h)
    if params.motor.g_diff != 0.0:
        return _salient_driven(params, state, applied, push, h)
    return _driven(params, state, applied, push, h)


@kernel
def torque(params: Params, state: State) -> float:
    """Electromagnetic torque now and cogging, N m."""
    motor = params.motor
    if motor.uneven == 1:
        magnet = pmsm.magnet(motor, state.cos, state.sin)
        i_alpha, i_beta = pmsm.uneven_currents(motor, magnet, state.psi_alpha, state.psi_beta)
        return pmsm.uneven_torque(motor, magnet, state.psi_alpha, state.psi_beta, i_alpha, i_beta)
    return _torque(motor, state.psi_alpha, state.psi_beta, state.cos, state.sin)


@kernel
def losing_shaft(shaft: mechanics.Params, state: State) -> mechanics.Params:
    """The shaft with friction and iron losses as they are now."""
    square = state.psi_alpha * state.psi_alpha + state.psi_beta * state.psi_beta
    return mechanics.losing(shaft, state.omega_m, square)


@kernel
def step(
    params: Params, state: State, applied: inverter.Applied, load: mechanics.Load, h: float
) -> tuple[State, float]:
    """The state after `h` seconds, and the forced acceleration (rad/s2) of the load machine, 0 where it forces none."""
    left = h
    alpha = 0.0
    part = 0.5 * h if applied.on and params.motor.g_diff != 0.0 and params.motor.uneven == 0 else h
    cut = False
    for _ in range(10):  # zero speed is passed once or twice in a step; more often never
        part = min(part, left)
        tau_e = torque(params, state) if state.omega_m == 0.0 else 0.0
        here = params._replace(shaft=losing_shaft(params.shaft, state))
        push = mechanics.push(here.shaft, load, state.omega_m, tau_e, left)
        alpha = push.alpha
        after = _step(here, state, applied, push, part)
        turned = push.gain != 0.0 and after.omega_m * push.tau_dry < 0.0  # against friction as it was taken
        if turned and not cut and state.omega_m != 0.0:
            part *= state.omega_m / (state.omega_m - after.omega_m)
            cut = True
            continue
        omega_m = 0.0 if turned or cut else after.omega_m
        cut = False
        state = after._replace(omega_m=omega_m)
        left -= part
        if left <= 1e-6 * h:
            break
        part = left
    return state, alpha
