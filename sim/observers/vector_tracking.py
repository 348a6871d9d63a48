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
  y += a (x - y) are undone by its own inverse, (1 - (1 - a) e^{-j omega T_s}) / a (`back_emf`); the paper's
  1 + j tau omega, the inverse of the continuous filter, leaves a bias that grows with speed.
- (7): below the back-EMF of `omega_on` the vector is not stretched to full length: noise would be.
- Around zero speed the correction is off: it starts at an edge with |omega_h| >= omega_on, from that edge's
  angle, and stops once |omega_h| < omega_off. It is off as well while the reference voltage is exactly
  zero: the outputs are off then, and the motor's voltage is its own. While it is off the estimate moves
  with omega_h inside the Hall sector, from the angle of the last edge or from the sector's centre.
- An estimate more than 30 deg outside the Hall sector is not believed: the correction stops, and starts
  anew at the next edge. Not with `literal_sgn`, which is there to be seen failing.
- (18) integrates while compensation and outputs are on, the correction or not, and stays within 30 deg. It takes
  the current error exactly as the integral of the drive's current loop took it in one period ago, whatever angle
  that loop works with: at the voltage limit less what its anti-windup took back. So (18)'s integral is that of
  the loop by their gains, and neither drifts nor winds up. Size and sign of k_pc and k_ic are commissioned for a
  drive.

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

from sim.circle import cos_sin
from sim.numba_cache import kernel
from sim.observers import back_emf
from sim.observers.average_speed import HALF_SECTOR, centre
from sim.observers.sample import Sample
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
    back_emf: back_emf.Params
    k_p: float
    k_i_T: float  # k_i * T_s
    omega_on: float
    omega_off: float
    e_min: float  # V, back-EMF at omega_on
    e_turn: float  # V, hysteresis of the direction: back-EMF at half of omega_off
    k_pc: float
    k_ic_T: float  # k_ic * T_s
    load_angle_comp: int
    literal_sgn: int
    a_omega: float  # gain of the filter on the estimated speed
    inject: int
    inject_amplitude: float  # rad
    inject_turns: float  # of the test sine, a sample


class State(NamedTuple):
    """What the observer remembers."""

    back_emf: back_emf.State
    on: int  # 1: the correction is at work
    direction: int  # +1 or -1 while it is
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


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    T_s = 1.0 / float(pwm_hz)
    return Params(
        T_s=T_s,
        back_emf=back_emf.make_params(pwm_hz, drive.R_s_hat, drive.L_s_hat, drive.tau_max),
        k_p=float(drive.k_p_vt),
        k_i_T=float(drive.k_i_vt) * T_s,
        omega_on=float(drive.omega_on),
        omega_off=float(drive.omega_off),
        e_min=max(float(drive.psi_f_hat) * float(drive.omega_on), E_TINY),
        e_turn=0.5 * float(drive.psi_f_hat) * float(drive.omega_off),
        k_pc=float(drive.k_pc),
        k_ic_T=float(drive.k_ic) * T_s,
        load_angle_comp=int(drive.load_angle_comp),
        literal_sgn=int(drive.literal_sgn),
        a_omega=1.0 - math.exp(-2.0 * math.pi * float(drive.bw_omega_lpf) * T_s),
        inject=int(drive.inject),
        inject_amplitude=float(drive.inject_amplitude),
        inject_turns=float(drive.inject_hz) * T_s,
    )


@kernel
def init() -> State:
    """Nothing known: the next sample gives the first currents and the angle by the Hall sector."""
    return State(back_emf.init(), 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


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
    omega_h = hall.omega
    # (5), (6): f is E_f*
    emf, f_alpha, f_beta = back_emf.step(params.back_emf, state.back_emf, sample)
    if state.back_emf.primed == 0:
        state = State(emf, 0, 0, theta_avg, omega_h, 0.0, 0.0, omega_h, 1.0)
        return state, Estimate(theta_avg, omega_h, 0.0, 0.0, 0.0, 0, 0)

    speed = abs(omega_h)
    turn, sync, injected_angle, injected_speed = _injected(params, state.turn)
    driven = sample.u_alpha != 0.0 or sample.u_beta != 0.0
    on = state.on if driven and speed >= params.omega_off else 0
    direction = state.direction
    theta = state.theta
    omega = omega_h
    omega_corr_i = 0.0
    delta = 0.0
    delta_i = state.delta_i if params.load_angle_comp != 0 else 0.0
    if params.load_angle_comp != 0 and driven:  # (18)
        delta_i = clip(delta_i + params.k_ic_T * sample.i_q_err, DELTA_MAX)
    if on == 1:
        omega = omega_h + injected_speed
        theta_mid = theta + 0.5 * params.T_s * (omega + state.omega_corr_i) - injected_angle
        cos, sin = cos_sin(theta_mid)
        e_q = f_beta * cos - f_alpha * sin
        if params.literal_sgn != 0:
            direction = 1 if state.omega >= 0.0 else -1
        else:
            if e_q * direction < -params.e_turn:
                direction = -direction
            if omega_h * direction < 0.0:
                omega = 0.0
        # (7), (8): sin(theta_hat - theta*) times the sign of the speed
        per_size = 1.0 / max(math.sqrt(f_alpha * f_alpha + f_beta * f_beta), params.e_min)
        cross = (f_alpha * cos + f_beta * sin) * per_size
        if params.load_angle_comp != 0:
            delta = clip(params.k_pc * sample.i_q_err + delta_i, DELTA_MAX)
        # (19), which is (9) with a load angle of zero; (4); (10)
        error = delta - cross * direction
        omega_corr_i = state.omega_corr_i + params.k_i_T * error
        omega += params.k_p * error + omega_corr_i
        theta = wrap(theta + params.T_s * omega)
        if params.literal_sgn == 0 and abs(wrap(theta - centre(hall.sector, sample.hall_offset))) > GUARD:
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
        middle = centre(hall.sector, sample.hall_offset)
        theta = wrap(middle + clip(wrap(theta + params.T_s * omega_h - middle), HALF_SECTOR))

    omega_lpf = state.omega_lpf + params.a_omega * (omega - state.omega_lpf)
    state = State(emf, on, direction, theta, omega, omega_corr_i, delta_i, omega_lpf, turn)
    return state, Estimate(theta, omega_lpf, delta, f_alpha, f_beta, on, sync)
