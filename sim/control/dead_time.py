"""Dead-time compensation: what a leg loses to its dead time, added to its duty by the sign of its current.

While both switches of a leg are off the current chooses the diode: a current into the motor pulls the
terminal to minus, one out of it to plus. Over a period the leg so loses t_d / T_s of the link voltage
against its current. Around zero current the switching ripple changes the sign within the period and the
loss fades out; the compensation fades with it, linearly below a current in proportion to the ripple, which
also keeps the noise of the current from being amplified.

The currents to give are those of the period in which the duties are in force: the measured ones turned
ahead with the voltage (no angle estimate enters, only a speed).

`dead_time_hat` and the compensated share are parameters. With `dead_time_learn` what they leave is estimated at run
time, as two dead times: one in the compensation's own shape over the current, and one that fades in where the switching
ripple at the voltage in force does, less the first. What R_s and L_s leave of the voltage is the back-EMF, which turns
with the rotor, and that error, which goes with the signs of the phase currents, and so has harmonics. What turns with
the rotor is taken out by a filter, and of the shapes too; least squares over what is left say how large each is, once
an electrical turn. No angle enters: an estimate has a ripple of its own.

Learned only from a turn among others of the same speed; not below a speed at which the back-EMF tells little; and not
where the back-EMF is so large that its own harmonics are beyond the dead time's.

Source: S.-Y. Kim, W. Lee, M.-S. Rho, S.-Y. Park, "Effective Dead-Time Compensation Using a Simple Vectorial
Disturbance Estimator in PMSM Drives", IEEE Trans. Ind. Electron., vol. 57, no. 5, 2010, pp. 1609-1614 (the
paper's [20]), takes the same error as a vector in step with the currents' signs, and estimates its size by what the
motor's equations leave of the voltage. Told apart by shape, and from the harmonics alone, is ours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim import legs
from sim.control.transforms import clip, inverse_park
from sim.numba_cache import kernel

START = 0.02  # of u_dc, V: what is left at first, rms, of each shape
WANDER = 2e-4  # of u_dc, in a root of a second: how it changes
ERROR = 8e-4  # of u_dc: of r, which no shape has
HARMONICS = 0.1  # of the back-EMF: the same
LOUD = 0.08  # of u_dc, the back-EMF beyond which nothing is learned
ROUND = 0.97  # of the current, that must turn evenly; one that jumps from sector to sector teaches nothing
PER_TURN = 6.0  # times that it is another in a turn
TINY = 1e-9  # A
FROM = 2.5  # omega_on, from which on it learns
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
    """By the samples of a turn; sums."""

    n: float
    along: legs.Along
    i_alpha: float  # A, the current turned back by the mean speed
    i_beta: float
    size: float  # A


class State(NamedTuple):
    """What was learned, and what that takes."""

    left: Left
    C: tuple[float, float, float]  # V2, covariance of both as voltages: full, both, near
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
    fade = float(f"{legs.FADE / (L_s_hat * pwm_hz):.3g}")
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
    nothing = Taught(0.0, legs.none(), 0.0, 0.0, 0.0)
    return State(Left(0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0, 0.0, nothing, nothing)


@kernel
def begun(state: State, i_alpha: float, i_beta: float) -> State:
    """What was learned so far, and no turn yet; the currents at the last sample (A)."""
    none = Taught(0.0, legs.none(), 0.0, 0.0, 0.0)
    return State(state.left, state.C, i_alpha, i_beta, 0.0, 0.0, 0.0, 0, 0.0, 0.0, none, none)


@kernel
def _per_ripple(params: Params, u_alpha: float, u_beta: float) -> float:
    """1/A, of the current below which the loss fades at this voltage."""
    return legs.per_ripple(math.sqrt(u_alpha * u_alpha + u_beta * u_beta), params.L_by_T, params.per_fade)


@kernel
def _shapes(params: Params, current: float, per_ripple: float) -> tuple[float, float]:
    """Both shapes at a phase current (A): sign of it, fading; and what is there before."""
    full = clip(current * params.per_fade, 1.0)
    return full, clip(current * per_ripple, 1.0) - full


@kernel
def _learned(
    state: State, taught: Taught, u_dc: float, emf: float, T_s: float, seconds: float
) -> tuple[Left, tuple[float, float, float]]:
    """What is left, and its covariance, after a turn."""
    most = (START * u_dc) ** 2
    more = (WANDER * u_dc) ** 2 * seconds
    sigma = ((ERROR * u_dc) ** 2 + (HARMONICS * emf) ** 2) / PER_TURN
    C = state.C if state.C[0] > 0.0 else (most, 0.0, most)
    full, near, C = legs.solved(C, taught.along, most, more, 1.0 / (taught.n * sigma))
    by = T_s / max(u_dc, 1.0)
    limit = MOST * T_s
    return Left(clip(state.left.full + by * full, limit), clip(state.left.near + by * near, limit)), C


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
    size = max(math.sqrt(a * a + b * b), TINY)
    full = legs.harmonics(legs.shape(a, b, size, params.per_fade), a, b)
    near = legs.harmonics(legs.shape(a, b, size, _per_ripple(params, u_alpha, u_beta)), a, b)
    near = (near[0] - full[0], near[1] - full[1])
    cos = math.cos(state.angle)
    sin = math.sin(state.angle)
    taught = state.taught
    taught = Taught(
        taught.n + 1.0,
        legs.along(taught.along, rest_alpha, rest_beta, full, near),
        taught.i_alpha + cos * a + sin * b,
        taught.i_beta + cos * b - sin * a,
        taught.size + size,
    )
    left, C = state.left, state.C
    before = state.before
    mean = state.omega
    even = state.even
    angle = state.angle + T_s * omega
    seconds = state.seconds + T_s
    if abs(angle) >= math.tau:
        mean = angle / seconds
        even = even + 1 if abs(mean - state.omega) < EVEN * abs(mean) else 0
        emf = math.sqrt(state.e_alpha * state.e_alpha + state.e_beta * state.e_beta)
        mean_size = math.sqrt(before.i_alpha * before.i_alpha + before.i_beta * before.i_beta)
        if even > SETTLED and emf < LOUD * u_dc and mean_size > ROUND * before.size:
            left, C = _learned(state, before, u_dc, emf, T_s, seconds)
        angle = 0.0
        seconds = 0.0
        before = taught
        taught = Taught(0.0, legs.none(), 0.0, 0.0, 0.0)
    main_alpha += share * rest_alpha
    main_beta += share * rest_beta
    return State(left, C, i_alpha, i_beta, main_alpha, main_beta, mean, even, angle, seconds, taught, before)


@kernel
def _share(params: Params, left: Left, current: float, per_ripple: float) -> float:
    """What is given back of a leg's duty."""
    given = params.duty * clip(current * params.per_fade, 1.0)
    if params.learn != 0:
        full, near = _shapes(params, current, per_ripple)
        given += (left.full * full + left.near * near) / params.T_s
    return given


@kernel
def compensate(
    params: Params,
    left: Left,
    u: tuple[float, float],
    duties: tuple[float, float, float],
    currents: tuple[float, float, float],
) -> tuple[float, float, float]:
    """Duties with the dead time's loss given back, each in [0, 1]; u: alpha, beta (V); currents (A) into the motor."""
    per_ripple = _per_ripple(params, u[0], u[1])
    return (
        min(max(duties[0] + _share(params, left, currents[0], per_ripple), 0.0), 1.0),
        min(max(duties[1] + _share(params, left, currents[1], per_ripple), 0.0), 1.0),
        min(max(duties[2] + _share(params, left, currents[2], per_ripple), 0.0), 1.0),
    )
