"""The paper's vector-tracking observer (3)-(10), with its load-angle compensation (18)-(19).

A phase-locked loop on the unit back-EMF vector, fed forward with the Hall average speed omega_h.

What the paper leaves open, and how it is settled here:
- Time. u*(k-1) is in force over [k-1, k]; it pairs with the mean current of that interval and with
  i(k) - i(k-1). The back-EMF so found is that of the interval's middle, and it is there that (8) compares it.
- sgn() of (9) does not see the corrected speed, which reaches +-k_p, 2018 r/min with the paper's gains:
  with the printed sgn(omega_hat) (`literal_sgn` = 1) the sign flips with the correction below that speed,
  and noise at 50 r/min, a reversal or an error past 90 deg leave the loop falsely locked for good. Here the
  direction is that of omega_h when the correction starts; from then on it is the sign of the filtered speed
  that the back-EMF shows along the estimate, with hysteresis, so that a rotor that turns back between two
  edges is followed. While the two disagree omega_h is stale and is not fed forward.
- (6) takes omega_h, and tau = min(tau_max, 1/|omega_h|). The gain and phase of the sampled filter
  y += a (x - y) are undone by its own inverse, (1 - (1 - a) e^{-j omega T_s}) / a; the paper's 1 + j tau omega,
  the inverse of the continuous filter, leaves a bias that grows with speed (`exact_inverse` = 0).
- (7): below the back-EMF of `omega_on` the vector is not stretched to full length: noise would be.
- Around zero speed the correction is off: it starts at an edge with |omega_h| >= omega_on, from that edge's
  angle, and stops once |omega_h| < omega_off. It is off as well while the reference voltage is exactly
  zero: the outputs are off then, and the motor's voltage is its own. While it is off the estimate moves
  with omega_h inside the Hall sector, from the angle of the last edge or from the sector's centre.
- An estimate more than 30 deg outside the Hall sector is not believed: the correction stops, and starts
  anew at the next edge. Not with `literal_sgn`, which is there to be seen failing.
- (18) integrates only while compensation and correction are on, and stays within 30 deg. It takes the
  current error exactly as the drive's current loop had it one period ago, whatever angle that loop works
  with, so that its integral is the change of the loop's integrator and does not drift. Size and sign of k_pc
  and k_ic are commissioned for a drive.

A test sine can be added at either input of the loop, to measure its frequency response (11): the response of the
estimate at sample k, against sin(phase of k), is then the paper's low-pass or high-pass. `inject` = 1 turns theta* by
A sin(phase), at the phase of the middle of the period, to which (8) belongs. `inject` = 2 adds to omega_h, as it is fed
forward, the exact difference of A sin(phase) over the period, by T_s; (6) and the thresholds see omega_h without it.

Never reads a Hall pin (that is `hall_speed`'s) and never adapts a parameter.

Source: Kim et al. 2011, DOI 10.1109/TIE.2010.2098367; equation numbers are the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.numba_cache import jit, kernel
from sim.observers.average_speed import HALF_SECTOR, centre
from sim.observers.sample import Sample, Samples, at
from sim.observers.transforms import TWO_PI, clip, wrap

GUARD = 2.0 * HALF_SECTOR  # rad from the sector's centre beyond which the estimate is not believed
DELTA_MAX = HALF_SECTOR  # rad, largest load angle
E_TINY = 1e-6  # V, keeps (7) from dividing by zero where omega_on is zero
INJECT_OFF, INJECT_BACK_EMF = 0, 1
TURN = 1.0 - 1e-9  # a turn of the test sine, whose steps add up to 1 but for rounding


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The drive's parameters that it takes.

    The gains of Fig. 6 are k_p_vt = 1268 1/s and k_i_vt = 54289 1/s². tau_max = 0.5 ms is ours: longer lets
    the ripple of omega_h through (6), shorter the noise of the currents.
    """

    R_s_hat: float  # ohm
    L_s_hat: float  # H
    psi_f_hat: float  # V s
    k_p_vt: float  # 1/s
    k_i_vt: float  # 1/s²
    tau_max: float  # s
    omega_on: float  # electrical rad/s
    omega_off: float
    k_pc: float  # rad/A
    k_ic: float  # rad/(A s)
    load_angle_comp: float
    literal_sgn: float
    bw_omega_lpf: float  # Hz
    inject: float = 0.0
    inject_amplitude: float = 0.0  # rad
    inject_hz: float = 0.0


class Params(NamedTuple):
    """Constants of the observer: SI units, electrical angles and speeds."""

    T_s: float
    R_s: float
    L_by_T: float  # L_s / T_s
    k_p: float
    k_i_T: float  # k_i * T_s
    a_min: float  # gain of the filter of (6) at tau = tau_max: T_s / (T_s + tau)
    omega_on: float
    omega_off: float
    e_min: float  # V, back-EMF at omega_on
    e_turn: float  # V, hysteresis of the direction: back-EMF at half of omega_off
    k_pc: float
    k_ic_T: float  # k_ic * T_s
    load_angle_comp: int
    literal_sgn: int
    exact_inverse: int
    a_omega: float  # gain of the filter on the estimated speed
    inject: int
    inject_amplitude: float  # rad
    inject_turns: float  # of the test sine, a sample


class State(NamedTuple):
    """What the observer remembers."""

    primed: int  # 1: the fields below hold a past sample
    on: int  # 1: the correction is at work
    direction: int  # +1 or -1 while it is
    i_alpha: float
    i_beta: float
    e_alpha: float  # back-EMF after the low-pass filter of (6), before its inverse
    e_beta: float
    theta: float  # (10)
    omega: float  # (4)
    omega_corr_i: float  # integral part of (9)
    delta_i: float  # integral part of (18)
    omega_lpf: float
    turn: float  # where in its turn the test sine is at the next sample; from 1 on a new one begins


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample
    omega: float  # electrical rad/s, low-pass filtered
    delta_hat: float  # load angle (18), rad
    e_alpha: float  # E_f* of (6), V, of the middle of the period
    e_beta: float
    on: int  # 1: the correction is at work
    sync: int  # 1: the test sine begins a turn at this sample


class Estimates(NamedTuple):
    """A run's results, one element a sample."""

    theta: NDArray[np.float64]
    omega: NDArray[np.float64]
    delta_hat: NDArray[np.float64]
    e_alpha: NDArray[np.float64]
    e_beta: NDArray[np.float64]
    on: NDArray[np.int64]
    sync: NDArray[np.int64]


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    T_s = 1.0 / float(pwm_hz)
    return Params(
        T_s=T_s,
        R_s=float(drive.R_s_hat),
        L_by_T=float(drive.L_s_hat) / T_s,
        k_p=float(drive.k_p_vt),
        k_i_T=float(drive.k_i_vt) * T_s,
        a_min=T_s / (T_s + float(drive.tau_max)),
        omega_on=float(drive.omega_on),
        omega_off=float(drive.omega_off),
        e_min=max(float(drive.psi_f_hat) * float(drive.omega_on), E_TINY),
        e_turn=0.5 * float(drive.psi_f_hat) * float(drive.omega_off),
        k_pc=float(drive.k_pc),
        k_ic_T=float(drive.k_ic) * T_s,
        load_angle_comp=int(drive.load_angle_comp),
        literal_sgn=int(drive.literal_sgn),
        exact_inverse=1,
        a_omega=1.0 - math.exp(-2.0 * math.pi * float(drive.bw_omega_lpf) * T_s),
        inject=int(drive.inject),
        inject_amplitude=float(drive.inject_amplitude),
        inject_turns=float(drive.inject_hz) * T_s,
    )


@kernel
def init() -> State:
    """Nothing known: the next sample gives the first currents and the angle by the Hall sector."""
    return State(0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@kernel
def _undo_filter(params: Params, a: float, omega: float) -> tuple[float, float]:
    """Real and imaginary part of the inverse, at `omega`, of the filter y += a (x - y)."""
    x = omega * params.T_s
    b = 1.0 - a
    if params.exact_inverse == 0:
        return 1.0, x * b / a  # T_s b / a is tau
    # Series of cos and sin: within 5e-8 for |x| < 0.3, over twice the speed of Table II's motor at 16 kHz.
    y = x * x
    cos = 1.0 - y * (0.5 - y * (1.0 / 24.0 - y / 720.0))
    sin = x * (1.0 - y * (1.0 / 6.0 - y / 120.0))
    return (1.0 - b * cos) / a, b * sin / a


@kernel
def _injected(params: Params, turn: float) -> tuple[float, int, float, float]:
    """The test sine at a sample: next `turn`, 1 if a turn begins, the angle (rad) and the speed (rad/s) to add."""
    if params.inject == INJECT_OFF:
        return 1.0, 0, 0.0, 0.0
    sync = 1 if turn >= TURN else 0
    turn -= sync
    phase = TWO_PI * turn
    advance = TWO_PI * params.inject_turns
    angle = 0.0
    speed = 0.0
    if params.inject == INJECT_BACK_EMF:
        angle = params.inject_amplitude * math.sin(phase - 0.5 * advance)
    else:
        speed = params.inject_amplitude * (math.sin(phase) - math.sin(phase - advance)) / params.T_s
    return turn + params.inject_turns, sync, angle, speed


@kernel
def step(
    params: Params,
    state: State,
    sample: Sample,
) -> tuple[State, Estimate]:
    """One control period."""
    hall = sample.hall
    theta_avg = sample.theta_avg
    u_alpha, u_beta = sample.u_alpha, sample.u_beta
    i_alpha, i_beta = sample.i_alpha, sample.i_beta
    omega_h = hall.omega
    if state.primed == 0:
        state = State(1, 0, 0, i_alpha, i_beta, 0.0, 0.0, theta_avg, omega_h, 0.0, 0.0, omega_h, 1.0)
        return state, Estimate(theta_avg, omega_h, 0.0, 0.0, 0.0, 0, 0)

    # (5): mean back-EMF of the period that ends here
    i_alpha_mean = 0.5 * (i_alpha + state.i_alpha)
    i_beta_mean = 0.5 * (i_beta + state.i_beta)
    e_alpha = u_alpha - params.R_s * i_alpha_mean - params.L_by_T * (i_alpha - state.i_alpha)
    e_beta = u_beta - params.R_s * i_beta_mean - params.L_by_T * (i_beta - state.i_beta)

    # (6): f is E_f*
    speed = abs(omega_h)
    x = params.T_s * speed
    a = max(params.a_min, x / (1.0 + x))
    e_alpha = state.e_alpha + a * (e_alpha - state.e_alpha)
    e_beta = state.e_beta + a * (e_beta - state.e_beta)
    g_re, g_im = _undo_filter(params, a, omega_h)
    f_alpha = g_re * e_alpha - g_im * e_beta
    f_beta = g_re * e_beta + g_im * e_alpha

    turn, sync, injected_angle, injected_speed = _injected(params, state.turn)
    driven = u_alpha != 0.0 or u_beta != 0.0
    on = state.on if driven and speed >= params.omega_off else 0
    direction = state.direction
    theta = state.theta
    omega = omega_h
    omega_corr_i = 0.0
    delta = 0.0
    delta_i = state.delta_i if params.load_angle_comp != 0 else 0.0
    if on == 1:
        omega = omega_h + injected_speed
        theta_mid = theta + 0.5 * params.T_s * (omega + state.omega_corr_i) - injected_angle
        cos = math.cos(theta_mid)
        sin = math.sin(theta_mid)
        e_q = f_beta * cos - f_alpha * sin
        if params.literal_sgn != 0:
            direction = 1 if state.omega >= 0.0 else -1
        else:
            if e_q * direction < -params.e_turn:
                direction = -direction
            if omega_h * direction < 0.0:
                omega = 0.0
        # (7), (8): sin(theta_hat - theta*) times the sign of the speed
        size = max(math.sqrt(f_alpha * f_alpha + f_beta * f_beta), params.e_min)
        cross = (f_alpha * cos + f_beta * sin) / size
        if params.load_angle_comp != 0:  # (18)
            delta_i = clip(delta_i + params.k_ic_T * sample.i_q_err, DELTA_MAX)
            delta = clip(params.k_pc * sample.i_q_err + delta_i, DELTA_MAX)
        # (19), which is (9) with a load angle of zero; (4); (10)
        error = delta - cross * direction
        omega_corr_i = state.omega_corr_i + params.k_i_T * error
        omega += params.k_p * error + omega_corr_i
        theta = wrap(theta + params.T_s * omega)
        if params.literal_sgn == 0 and abs(wrap(theta - centre(hall.sector))) > GUARD:
            on = 0
            omega = omega_h
            omega_corr_i = 0.0
            theta = theta_avg
    elif hall.edge == 1 or omega_h == 0.0:
        theta = theta_avg
        direction = hall.direction
        if hall.edge == 1 and driven and speed >= params.omega_on:
            on = 1  # at work from the next sample on
    else:
        middle = centre(hall.sector)
        theta = wrap(middle + clip(wrap(theta + params.T_s * omega_h - middle), HALF_SECTOR))

    omega_lpf = state.omega_lpf + params.a_omega * (omega - state.omega_lpf)
    state = State(
        1, on, direction, i_alpha, i_beta, e_alpha, e_beta, theta, omega, omega_corr_i, delta_i, omega_lpf, turn
    )
    return state, Estimate(theta, omega_lpf, delta, f_alpha, f_beta, on, sync)


@jit
def run(params: Params, state: State, samples: Samples, reset: NDArray[np.bool_]) -> tuple[State, Estimates]:
    """`step` over n samples, with `init` before each where `reset`, shape (n,), is set."""
    n = reset.shape[0]
    out = Estimates(
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
    )
    for k in range(n):
        if reset[k]:
            state = init()
        state, estimate = step(params, state, at(samples, k))
        out.theta[k] = estimate.theta
        out.omega[k] = estimate.omega
        out.delta_hat[k] = estimate.delta_hat
        out.e_alpha[k] = estimate.e_alpha
        out.e_beta[k] = estimate.e_beta
        out.on[k] = estimate.on
        out.sync[k] = estimate.sync
    return state, out
