"""Vector-tracking observer on the quantised Hall vector, with the mechanical model of the machine.

The Hall vector is the unit vector at the centre of the Hall sector. Its cross product with the estimate's unit vector
drives a Luenberger observer of angle, speed and load torque:

    d theta / dt = omega,   d omega / dt = n_p (tau_e - tau_load) / J,   d tau_load / dt = 0

with tau_e = 1.5 n_p psi_f i_q and i_q the current in the estimated frame. The estimated load torque makes the angle's
error free of a mean at constant speed and at constant acceleration; the torque fed forward keeps it small while the
current accelerates the rotor.

The Hall vector has harmonics. With ideal sensors it is

    e^{j theta_q} = (3/pi) sum over m of e^{j (6 m + 1) theta} / (6 m + 1),

which the cross product shows as a ripple at 6, 12, ... times omega; misplaced sensors add one at omega and 2 omega. The
loop attenuates at high speed, and follows below some 100 r/min, where the estimate steps with the sensors. What the
model does not know, a step of the load, is followed with a delay; a higher bandwidth means less of it and more ripple.
With the simulated bench's motor and the sensors of Table I, std at 500 r/min and largest error after steps of the load
worth 4 A and 7 A are 1.0, 63 and 94 deg at 5 Hz, 1.5, 43 and 75 at 8 Hz, 1.9, 31 and 49 at 10 Hz, 2.5, 23 and 33 at
13 Hz. The default, 10 Hz, is the lowest of them that keeps each below 60 deg.

How it is done here:
- The gains place the three poles of the sampled, linear loop at e^{-2 pi bw T_s}. The cross product is scaled by pi/3,
  so that the fundamental of the Hall vector has unit length.
- While the front end knows no speed (start, first edge, standstill) the estimate is that of `average_speed`, which
  stays inside the sector, and the load is taken as zero. With omega_h the observer starts, from its angle and speed.
- The estimate is held within 30 deg of the Hall sector, once two samples running find it outside (one alone may be a
  glitch). Speed and load go on being corrected there, and bring it back.
- With a finite `omega_decouple` harmonics are taken off above that speed: see `hall_vector_decoupled`.

Never looks at a voltage, and never adapts a parameter.

Source: F. Giulii Capponi, G. De Donato, L. Del Ferraro, O. Honorati, M. C. Harke, R. D. Lorenz, "AC brushless drive
with low-resolution Hall-effect sensors for surface-mounted PM machines", IEEE Trans. Ind. Appl., vol. 42, no. 2,
pp. 526-535, 2006.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.average_speed import HALF_SECTOR, centre
from sim.observers.sample import Sample
from sim.observers.transforms import wrap

GUARD = 2.0 * HALF_SECTOR  # rad from the sector's centre that the estimate keeps to
J_TINY = 1e-9  # kg m2, keeps the model from dividing by zero
TO_UNIT = math.pi / 3.0  # length of the Hall vector whose fundamental has unit length
SIXTH = 1.0 / 5.0 + 1.0 / 7.0  # of the cross product at 6 theta: harmonics -5 and 7
TWELFTH = 1.0 / 11.0 + 1.0 / 13.0  # at 12 theta: harmonics -11 and 13


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The drive's parameters that it takes."""

    n_p: float
    psi_f_hat: float  # V s
    J_hat: float  # kg m2, of the whole shaft
    bw_hall_vector: float  # Hz


class Params(NamedTuple):
    """Constants of the observer: SI units, electrical angles and speeds."""

    T_s: float
    k_torque: float  # rad/s2 per A of i_q
    k_theta: float  # gains on the cross product: rad,
    k_omega: float  # rad/s,
    k_load: float  # rad/s2
    tau_by_a: float  # N m per rad/s2 of electrical acceleration
    omega_decouple: float  # |omega_h| from which on the harmonics are taken off, rad/s; infinite: never


class State(NamedTuple):
    """What the observer remembers."""

    on: int  # 1: the observer is at work
    beyond: int  # 1: it found the last estimate too far from the sector
    theta: float
    omega: float
    a_torque: float  # rad/s2, by the current of the last sample
    a_load: float  # rad/s2, by the load


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample
    omega: float  # electrical rad/s
    tau_load: float  # N m, against the direction of rising angles


def make_params(pwm_hz: float, drive: Settings, decouple: bool = False) -> Params:
    """Constants for control periods at `pwm_hz` Hz; `decouple`: see `hall_vector_decoupled`.

    Three poles at z = r are k_theta = 1 - r^3, k_omega = 3/2 (1 - r^2) (1 - r) / T_s and
    k_load = (1 - r)^3 / T_s^2.
    """
    T_s = 1.0 / float(pwm_hz)
    inertia = max(float(drive.J_hat), J_TINY)
    bandwidth = float(drive.bw_hall_vector)
    r = math.exp(-2.0 * math.pi * bandwidth * T_s)
    return Params(
        T_s=T_s,
        k_torque=1.5 * float(drive.n_p) ** 2 * float(drive.psi_f_hat) / inertia,
        k_theta=1.0 - r**3,
        k_omega=1.5 * (1.0 - r**2) * (1.0 - r) / T_s,
        k_load=(1.0 - r) ** 3 / T_s**2,
        tau_by_a=inertia / float(drive.n_p),
        omega_decouple=2.0 * math.pi * bandwidth if decouple else math.inf,
    )


@kernel
def init() -> State:
    """Nothing known: the estimate is that by the edges until they show a speed."""
    return State(0, 0, 0.0, 0.0, 0.0, 0.0)


@kernel
def _harmonics(theta: float) -> float:
    """What the harmonics -5, 7, -11 and 13 add to the cross product at `theta`, rad from the ideal edge of sector 0."""
    sixfold = 6.0 * theta
    return math.sin(sixfold) * (SIXTH + 2.0 * TWELFTH * math.cos(sixfold))


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    omega_h = sample.hall.omega
    on = 0
    beyond = 0
    theta = sample.theta_avg
    omega = omega_h
    a_load = 0.0
    if omega_h != 0.0:
        on = 1
        a_load = state.a_load
    if on == 1 and state.on == 1:
        a = state.a_torque + a_load
        predicted = state.theta + params.T_s * (state.omega + 0.5 * params.T_s * a)
        middle = centre(sample.hall.sector, sample.hall_offset)
        cross = TO_UNIT * math.sin(middle - predicted)
        if abs(omega_h) >= params.omega_decouple:
            cross -= _harmonics(predicted - sample.hall_offset)
        ahead = wrap(predicted + params.k_theta * cross - middle)
        beyond = 1 if abs(ahead) > GUARD else 0
        if beyond == 1 and state.beyond == 1:
            ahead = math.copysign(GUARD, ahead)
        theta = wrap(middle + ahead)
        omega = state.omega + params.T_s * a + params.k_omega * cross
        a_load += params.k_load * cross
    i_q = sample.i_beta * math.cos(theta) - sample.i_alpha * math.sin(theta)
    return State(on, beyond, theta, omega, params.k_torque * i_q, a_load), Estimate(
        theta, omega, -params.tau_by_a * a_load
    )
