"""Position as the angle of the rotor flux, made from the back-EMF by a programmable cascaded low-pass filter.

The rotor flux is the integral of the back-EMF. An integrator drifts with any offset; three equal low-pass stages, each
tuned to lag by a third of what an integrator lags at the present speed, do the same to the fundamental and forget the
rest.

How it is done here, exactly for the sampled signals:
- u - R i_mean - L (i(k) - i(k-1)) / T_s is a period's mean back-EMF, psi (e^{j theta(k)} - e^{j theta(k-1)}) / T_s.
  So, with x = |omega| T_s, what makes the flux at the sample of it lags by pi/2 - x/2 and has the gain
  T_s / (2 sin(x/2)).
- A stage y = b y + c e has unit gain and lags by phi at the speed omega with b = sin(phi) / sin(x + phi) and
  c = sin(x) / sin(x + phi); phi = (pi/2 - x/2) / 3.
- The inductance's voltage is taken off before the filter, not the inductance's flux behind it: a step of the current
  then does not reach the angle.

omega is omega_h through a low-pass filter, and tunes the stages to a wrong lag where it is wrong: 3 sin(2 phi) / 2, or
0.74 deg for each per cent. Misplaced sensors make a ripple of omega_h at omega and 2 omega, and a mean above the speed
(0.9 % with those of Table I, which is a lead of 0.6 deg). That is why this observer errs where the back-EMF itself is
exact. A lower `bw_omega_lpf` makes the ripple less, and the lag of omega behind a changing speed, which tunes the
stages just as wrong, more.

Below `omega_on` / `omega_off`, at standstill and while the reference voltage is exactly zero (outputs off) the estimate
is that of `average_speed`. The filter starts at an edge with |omega_h| >= omega_on, as it would have settled at that
edge's angle with the flux psi_f_hat. It stops once |omega_h| < omega_off, or when the edges contradict it in two
samples running (one alone may be a glitch): omega_h has the other sign, or the angle lies more than 30 deg outside the
sector.

Never integrates without forgetting, and never adapts a parameter.

Source: B. Karanayil, M. F. Rahman, C. Grantham, "An implementation of a programmable cascaded low-pass filter for a
rotor flux synthesizer for an induction motor drive", IEEE Trans. Power Electron., vol. 19, no. 2, pp. 257-263, 2004.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.average_speed import HALF_SECTOR, centre
from sim.observers.sample import Sample
from sim.observers.transforms import wrap

STAGES = 3
GUARD = 2.0 * HALF_SECTOR  # rad from the sector's centre beyond which the estimate is not believed
X_MAX = 1.0  # rad a period: beyond any drive's, and keeps the stages stable


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The drive's parameters that it takes."""

    R_s_hat: float  # ohm
    L_s_hat: float  # H
    psi_f_hat: float  # V s
    omega_on: float  # electrical rad/s
    omega_off: float
    bw_omega_lpf: float  # Hz


class Params(NamedTuple):
    """Constants of the observer: SI units, electrical angles and speeds."""

    T_s: float
    R_s: float
    L_by_T: float  # L_s / T_s
    psi_f: float
    omega_on: float
    omega_off: float
    a_omega: float  # gain of the filter on omega_h


class State(NamedTuple):
    """What the observer remembers."""

    on: int  # 1: the filter is at work, and the fields below hold the last sample's
    doubted: int  # 1: the edges contradicted it
    i_alpha: float
    i_beta: float
    omega: float
    y1_alpha: float  # V, behind each stage
    y1_beta: float
    y2_alpha: float
    y2_beta: float
    y3_alpha: float
    y3_beta: float


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample
    omega: float  # electrical rad/s: omega_h, filtered while `on`
    psi: float  # V s, length of the rotor flux; 0: the filter is off
    on: int  # 1: the angle is that of the rotor flux


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    T_s = 1.0 / float(pwm_hz)
    return Params(
        T_s=T_s,
        R_s=float(drive.R_s_hat),
        L_by_T=float(drive.L_s_hat) / T_s,
        psi_f=float(drive.psi_f_hat),
        omega_on=float(drive.omega_on),
        omega_off=float(drive.omega_off),
        a_omega=1.0 - math.exp(-2.0 * math.pi * float(drive.bw_omega_lpf) * T_s),
    )


@kernel
def init() -> State:
    """The filter off: it starts at an edge that shows a speed."""
    return State(0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@kernel
def _tuned(params: Params, omega: float) -> tuple[float, float, float, float]:
    """Lag of a stage (rad), its b and c, and the gain T_s / (2 sin(x/2)) of the integral, at the speed `omega`."""
    x = min(abs(omega) * params.T_s, X_MAX)
    phi = (0.5 * math.pi - 0.5 * x) / STAGES
    norm = math.sin(x + phi)
    return phi, math.sin(phi) / norm, math.sin(x) / norm, 0.5 * params.T_s / math.sin(0.5 * x)


@kernel
def _started(params: Params, sample: Sample) -> State:
    """The filter as it would have settled at the speed and angle of the edges."""
    omega = sample.hall.omega
    theta = sample.theta_avg
    phi, _, _, gain = _tuned(params, omega)
    size = params.psi_f / gain
    lag = math.copysign(phi, omega)
    return State(
        1,
        0,
        sample.i_alpha,
        sample.i_beta,
        omega,
        size * math.cos(theta + 2.0 * lag),
        size * math.sin(theta + 2.0 * lag),
        size * math.cos(theta + lag),
        size * math.sin(theta + lag),
        size * math.cos(theta),
        size * math.sin(theta),
    )


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    hall = sample.hall
    omega_h = hall.omega
    i_alpha, i_beta = sample.i_alpha, sample.i_beta
    driven = sample.u_alpha != 0.0 or sample.u_beta != 0.0
    if state.on == 1 and driven and abs(omega_h) >= params.omega_off:
        reversed_ = omega_h * state.omega <= 0.0
        omega = state.omega if reversed_ else state.omega + params.a_omega * (omega_h - state.omega)
        _, b, c, gain = _tuned(params, omega)
        half_R = 0.5 * params.R_s
        e_alpha = sample.u_alpha - half_R * (i_alpha + state.i_alpha) - params.L_by_T * (i_alpha - state.i_alpha)
        e_beta = sample.u_beta - half_R * (i_beta + state.i_beta) - params.L_by_T * (i_beta - state.i_beta)
        y1_alpha = b * state.y1_alpha + c * e_alpha
        y1_beta = b * state.y1_beta + c * e_beta
        y2_alpha = b * state.y2_alpha + c * y1_alpha
        y2_beta = b * state.y2_beta + c * y1_beta
        y3_alpha = b * state.y3_alpha + c * y2_alpha
        y3_beta = b * state.y3_beta + c * y2_beta
        theta = wrap(math.atan2(y3_beta, y3_alpha))
        doubted = 1 if reversed_ or abs(wrap(theta - centre(hall.sector, sample.hall_offset))) > GUARD else 0
        if doubted == 0 or state.doubted == 0:
            psi = gain * math.sqrt(y3_alpha * y3_alpha + y3_beta * y3_beta)
            state = State(1, doubted, i_alpha, i_beta, omega, y1_alpha, y1_beta, y2_alpha, y2_beta, y3_alpha, y3_beta)
            return state, Estimate(theta, omega, psi, 1)
    if hall.edge == 1 and driven and omega_h != 0.0 and abs(omega_h) >= params.omega_on:
        state = _started(params, sample)  # at work from the next sample on
    else:
        state = init()
    return state, Estimate(sample.theta_avg, omega_h, 0.0, 0)
