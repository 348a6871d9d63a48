"""Dead-time compensation: what a leg loses to its dead time, added to its duty by the sign of its current.

While both switches of a leg are off the current chooses the diode: a current into the motor pulls the
terminal to minus, one out of it to plus. Over a period the leg so loses t_d / T_s of the link voltage
against its current. Around zero current the switching ripple changes the sign within the period and the
loss fades out; the compensation fades with it, linearly below a current in proportion to the ripple, which
also keeps the noise of the current from being amplified.

The currents to give are those of the period in which the duties are in force: the measured ones turned
ahead with the voltage (no angle estimate enters, only a speed).

`dead_time_hat` and the compensated share are parameters. With `dead_time_learn` what they leave is estimated at run
time, as two dead times: one in the compensation's own shape over the current, one that is there at a sixth of that
current already, and gone where the first has faded in. What R_s and L_s leave of the voltage is the back-EMF, which
turns with the rotor, and that error, which goes with the signs of the phase currents, and so has harmonics. What turns
with the rotor is taken out by a filter, and each shape goes by what is left along it, once an electrical turn. No angle
enters: an estimate has a ripple of its own.

Learned only from a turn among others of the same speed; not below a speed at which the back-EMF tells little; and the
slower the faster it turns, because the back-EMF has harmonics of its own.

Source: S.-Y. Kim, W. Lee, M.-S. Rho, S.-Y. Park, "Effective Dead-Time Compensation Using a Simple Vectorial
Disturbance Estimator in PMSM Drives", IEEE Trans. Ind. Electron., vol. 57, no. 5, 2010, pp. 1609-1614 (the
paper's [20]), takes the same error as a vector in step with the currents' signs, and estimates its size by what the
motor's equations leave of the voltage. Told apart by shape, and from the harmonics alone, is ours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.control.transforms import clip, inverse_clarke, inverse_park
from sim.numba_cache import kernel

FADE = 0.8448  # V, the current below which it fades, times inductance and PWM frequency: 0.3 A with the paper's
NARROW = 1.0 / 6.0  # of that current, where the other shape is there
RATE = 60.0  # 1/s, of what is learned
FROM = 2.5  # omega_on, from which on it learns
HALF = 5.0  # omega_on, at which learning goes at a quarter of that rate
MEAN = 1.0  # 1/rad, of the electrical angle: what is taken to turn with the rotor
EVEN = 0.02  # of the speed, by which turns may differ that teach
SETTLED = 2  # turns more of one speed that it takes for one to teach: two before it and one after
MOST = 0.05  # of a period, that is learned of each


class Params(NamedTuple):
    """Constants of the compensation."""

    duty: float  # share of a period that is given back at full current
    per_fade: float  # 1/A, of the current below which it fades
    learn: int  # 1: what is left of the error is learned, and given back too
    T_s: float
    R_s: float
    L_by_T: float  # ohm
    omega_on: float  # electrical rad/s


class Left(NamedTuple):
    """Dead times that the parameters leave, s."""

    full: float  # in the compensation's own shape
    near: float  # near zero current


class Taught(NamedTuple):
    """By the samples of a turn."""

    full: float  # V s, along each shape
    near: float
    power: float  # s, of the shapes


class State(NamedTuple):
    """What was learned, and what that takes."""

    left: Left
    i_alpha: float  # A, at the last sample
    i_beta: float
    e_alpha: float  # V, what turns with the rotor
    e_beta: float
    omega: float  # electrical rad/s, mean of the last turn; 0: none yet
    even: int  # turns running of one speed
    angle: float  # rad, since the last turn
    seconds: float  # since then
    taught: Taught  # since then
    before: Taught  # by the last turn


def make_params(
    pwm_hz: float,
    *,
    dead_time_hat: float,
    dead_time_comp: float,
    dead_time_learn: float,
    R_s_hat: float,
    L_s_hat: float,
    omega_on: float,
) -> Params:
    """Constants from the drive's parameters of the same names (s, share, 0 or 1, ohm, H, rad/s)."""
    fade = float(f"{FADE / (L_s_hat * pwm_hz):.3g}")
    return Params(
        float(dead_time_hat) * float(dead_time_comp) * float(pwm_hz),
        1.0 / fade,
        int(dead_time_learn),
        1.0 / float(pwm_hz),
        float(R_s_hat),
        float(L_s_hat) * float(pwm_hz),
        float(omega_on),
    )


@kernel
def init() -> State:
    """Nothing learned."""
    return begun(Left(0.0, 0.0), 0.0, 0.0)


@kernel
def begun(left: Left, i_alpha: float, i_beta: float) -> State:
    """What was learned so far, and no turn yet; the currents at the last sample (A)."""
    none = Taught(0.0, 0.0, 0.0)
    return State(left, i_alpha, i_beta, 0.0, 0.0, 0.0, 0, 0.0, 0.0, none, none)


@kernel
def _shapes(params: Params, current: float) -> tuple[float, float]:
    """Both shapes at a phase current (A): sign of it, fading; and what is there before."""
    x = current * params.per_fade
    full = clip(x, 1.0)
    return full, clip(x / NARROW, 1.0) - full


@kernel
def _square(f: tuple[float, float]) -> float:
    """Of both shapes."""
    return f[0] * f[0] + f[1] * f[1]


@kernel
def learnt(
    params: Params,
    state: State,
    u_dc: float,
    u_alpha: float,
    u_beta: float,
    i_alpha: float,
    i_beta: float,
    omega: float,
) -> State:
    """After a period with this voltage in force (V): currents at its end (A), electrical speed (rad/s)."""
    T_s = params.T_s
    a = 0.5 * (i_alpha + state.i_alpha)
    b = 0.5 * (i_beta + state.i_beta)
    turned = T_s * state.omega
    main_alpha, main_beta = inverse_park(state.e_alpha, state.e_beta, math.cos(turned), math.sin(turned))
    rest_alpha = u_alpha - params.R_s * a - params.L_by_T * (i_alpha - state.i_alpha) - main_alpha
    rest_beta = u_beta - params.R_s * b - params.L_by_T * (i_beta - state.i_beta) - main_beta
    share = min(MEAN * abs(turned), 1.0)
    e_a, e_b, e_c = inverse_clarke(rest_alpha, rest_beta)
    i_a, i_b, i_c = inverse_clarke(a, b)
    f_a = _shapes(params, i_a)
    f_b = _shapes(params, i_b)
    f_c = _shapes(params, i_c)
    left = state.left
    taught = Taught(
        state.taught.full + T_s * (e_a * f_a[0] + e_b * f_b[0] + e_c * f_c[0]),
        state.taught.near + T_s * (e_a * f_a[1] + e_b * f_b[1] + e_c * f_c[1]),
        state.taught.power + T_s * (_square(f_a) + _square(f_b) + _square(f_c)),
    )
    before = state.before
    mean = state.omega
    even = state.even
    angle = state.angle + T_s * omega
    seconds = state.seconds + T_s
    if abs(angle) >= math.tau:
        mean = angle / seconds
        even = even + 1 if abs(mean - state.omega) < EVEN * abs(mean) else 0
        if even > SETTLED:
            x = mean / (HALF * params.omega_on)
            rate = RATE / (1.0 + x * x) ** 2
            rate *= T_s / (max(u_dc, 1.0) * (1.0 + 0.5 * rate * before.power))
            most = MOST * T_s
            left = Left(clip(left.full + rate * before.full, most), clip(left.near + rate * before.near, most))
        angle = 0.0
        seconds = 0.0
        before = taught
        taught = Taught(0.0, 0.0, 0.0)
    main_alpha += share * rest_alpha
    main_beta += share * rest_beta
    return State(left, i_alpha, i_beta, main_alpha, main_beta, mean, even, angle, seconds, taught, before)


@kernel
def _share(params: Params, left: Left, current: float) -> float:
    """What is given back of a leg's duty."""
    given = params.duty * clip(current * params.per_fade, 1.0)
    if params.learn != 0:
        full, near = _shapes(params, current)
        given += (left.full * full + left.near * near) / params.T_s
    return given


@kernel
def compensate(
    params: Params,
    left: Left,
    duties: tuple[float, float, float],
    currents: tuple[float, float, float],
) -> tuple[float, float, float]:
    """Duties with the dead time's loss given back, each in [0, 1]; currents in A, positive into the motor."""
    return (
        min(max(duties[0] + _share(params, left, currents[0]), 0.0), 1.0),
        min(max(duties[1] + _share(params, left, currents[1]), 0.0), 1.0),
        min(max(duties[2] + _share(params, left, currents[2]), 0.0), 1.0),
    )
