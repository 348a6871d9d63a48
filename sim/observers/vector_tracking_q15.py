"""The paper's observer (3)-(10) in integers, as a 16-bit fixed-point controller computes it.

It behaves as `vector_tracking` does, which describes what the paper leaves open: when the correction starts and stops,
whose direction it takes, what estimate it does not believe. The load-angle compensation, the test sine and the printed
sgn() are not in it. c/vector_tracking_q15.c is the same arithmetic in C99, integer for integer, for a firmware.

Formats (docs/fixed-point.md says why):
- voltage and current: 16 bits, 2^15 is the base: `base_u` V, `base_i` A, 32 unless the sensors measure more;
- angle: 2^32 is a turn, unsigned; the boundary takes 16 bits of it;
- speed: turns of 2^-32 a control period, signed, up to an eighth of a turn a period;
- back-EMF behind the filter of (6): 32 bits, 2^30 is base_u; scaled to 15 bits and a shift before it is turned;
- sine, cosine, filter gains, sin of the angle error: Q15; the filter's inverse: Q14.

Every product is of 16 by 16 bits, or of 32 by 16 made of two such. A shift after a product or a sum of products rounds
half up; one that only scales rounds down. Every intermediate fits into 32 bits: the kernels compute in int64 and never
rely on it.

Never adapts a parameter and never sees a float past `counts`; the Hall front end stays outside.

Source: Kim et al. 2011, DOI 10.1109/TIE.2010.2098367; equation numbers are the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.numba_cache import kernel
from sim.observers.sample import Sample
from sim.observers.transforms import TWO_PI

TURN = 1 << 32
MASK = TURN - 1
TWELFTH = TURN // 12  # 30 degrees
GUARD = TURN // 6  # from the sector's centre, beyond which the estimate is not believed
BASE = 32.0  # V and A, full scale where nothing else is said
ONE = 1 << 15  # of Q15
HALF = 1 << 14  # of Q15, and one of Q14
INT16_MAX = ONE - 1
TURN_MAX = (1 << 29) - 1  # largest speed, gain and integral: an eighth of a turn a period
OMEGA_MAX = (1 << 30) - 1  # largest sum of them
RAD = 25736  # Q15 rad in an eighth of a turn

QUARTER = 128  # intervals of the table of sines
SINE: NDArray[np.int64] = np.array(
    [min(round(ONE * math.sin(k * math.pi / (2 * QUARTER))), INT16_MAX) for k in range(QUARTER + 1)], np.int64
)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The drive's parameters that it takes."""

    R_s_hat: float  # ohm
    L_s_hat: float  # H
    psi_f_hat: float  # V s
    k_p_vt: float  # 1/s
    k_i_vt: float  # 1/s²
    tau_max: float  # s
    omega_on: float  # electrical rad/s
    omega_off: float
    bw_omega_lpf: float  # Hz
    i_range: float  # A, full scale of the current sensors
    hall_offset: float = 0.0  # electrical rad, ideal angle of the edge that opens sector 0


class Constants(NamedTuple):
    """`hbq_params_t` of the C file: integers."""

    z_now: int  # L_s / T_s + R_s / 2, times 2^z_shift base_i / base_u
    z_before: int  # L_s / T_s - R_s / 2, likewise
    z_shift: int  # 0..15
    a_min: int  # Q15, gain of the filter of (6) at tau = tau_max
    k_p: int  # turns of 2^-32 a period, for an error of 1 rad
    k_i: int  # likewise, a period
    turn_on: int  # omega_on and omega_off as turns of 2^-32 a period
    turn_off: int
    e_min: int  # back-EMF at omega_on, 2^30 is base_u
    e_turn: int  # back-EMF at half of omega_off
    a_omega: int  # Q15, gain of the filter on the estimated speed
    hall_offset: int  # 32 bits, where sector 0 opens


class Params(NamedTuple):
    """Constants of the observer, and of its boundary to SI units."""

    q: Constants
    u_scale: float  # counts a volt
    i_scale: float  # counts an ampere
    omega_scale: float  # turns of 2^-32 a period, a rad/s


class Counts(NamedTuple):
    """`hbq_sample_t` of the C file: what the observer is given of one control period."""

    u_alpha: int  # 16 bits, in force over the period that ends at the sample
    u_beta: int
    i_alpha: int  # 16 bits, at the sample
    i_beta: int
    turn_h: int  # omega_h, turns of 2^-32 a period
    theta_avg: int  # 0..65535: angle by (1)-(2), 2^16 is a turn
    sector: int  # 0..5, or -1: not known yet
    direction: int  # +1, -1, 0: unknown
    edge: int  # 1: a boundary was passed in this period


class State(NamedTuple):
    """`hbq_state_t` of the C file: what the observer remembers; theta, omega and on are its results."""

    primed: int  # 1: the fields below hold a past sample
    on: int  # 1: the correction is at work
    direction: int  # +1 or -1 while it is
    i_alpha: int
    i_beta: int
    e_alpha: int  # back-EMF after the low-pass filter of (6), before its inverse; 2^30 is base_u
    e_beta: int
    theta: int  # (10), 0..2^32 - 1
    corr_i: int  # integral part of (9), turns of 2^-32 a period
    omega: int  # turns of 2^-32 a period, low-pass filtered


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample
    omega: float  # electrical rad/s, low-pass filtered
    on: int  # 1: the correction is at work


def _integer(value: float, unit: float, limit: int) -> int:
    """`value` in steps of `unit`, at most `limit`."""
    return min(round(value / unit), limit)


def _gain(value: float) -> int:
    """A filter's gain in Q15, never none."""
    return min(max(round(ONE * value), 1), INT16_MAX)


def make_params(pwm_hz: float, drive: Settings, base_u: float = BASE, base_i: float = 0.0) -> Params:
    """Constants for control periods at `pwm_hz` Hz.

    `base_u` (V), `base_i` (A): full scale of the 16-bit voltages and currents, which saturate there; `base_i` 0: 32 A,
    or twice that as often as it takes to hold what the sensors measure.
    A constant that does not fit into its integer is the largest that does.
    """
    base_i = base_i or BASE * 2.0 ** max(0, math.ceil(math.log2(max(float(drive.i_range), 1.0) / BASE)))
    T_s = 1.0 / float(pwm_hz)
    step = TWO_PI / (TURN * T_s)  # rad/s, of a turn of 2^-32 a period
    volt = float(base_u) / (1 << 30)
    ohm = float(base_u) / float(base_i)
    z_now = float(drive.L_s_hat) / T_s + 0.5 * float(drive.R_s_hat)
    z_before = float(drive.L_s_hat) / T_s - 0.5 * float(drive.R_s_hat)
    z_shift = 15
    while z_shift > 0 and round(z_now / ohm * (1 << z_shift)) > INT16_MAX:
        z_shift -= 1
    z_unit = ohm / (1 << z_shift)
    return Params(
        Constants(
            z_now=_integer(z_now, z_unit, INT16_MAX),
            z_before=max(min(round(z_before / z_unit), INT16_MAX), -INT16_MAX),
            z_shift=z_shift,
            a_min=_gain(T_s / (T_s + float(drive.tau_max))),
            k_p=_integer(float(drive.k_p_vt), step, TURN_MAX),
            k_i=_integer(float(drive.k_i_vt), step / T_s, TURN_MAX),
            turn_on=_integer(float(drive.omega_on), step, TURN_MAX),
            turn_off=_integer(float(drive.omega_off), step, TURN_MAX),
            e_min=max(_integer(float(drive.psi_f_hat) * float(drive.omega_on), volt, (1 << 30) - 1), 4),
            e_turn=_integer(0.5 * float(drive.psi_f_hat) * float(drive.omega_off), volt, (1 << 30) - 1),
            a_omega=_gain(1.0 - math.exp(-2.0 * math.pi * float(drive.bw_omega_lpf) * T_s)),
            hall_offset=round(float(drive.hall_offset) * TURN / TWO_PI) & MASK,
        ),
        u_scale=ONE / float(base_u),
        i_scale=ONE / float(base_i),
        omega_scale=1.0 / step,
    )


def c_source(params: Params, name: str) -> str:
    """The constants as a C definition: `static const hbq_params_t NAME = {...};`."""
    fields = "".join(
        f"    .{field} = {value}{'u' if field == 'hall_offset' else ''},\n"
        for field, value in params.q._asdict().items()
    )
    return f"static const hbq_params_t {name} = {{\n{fields}}};\n"


@kernel
def init() -> State:
    """Nothing known: the next sample gives the first currents and the angle by the Hall sector."""
    return State(0, 0, 0, 0, 0, 0, 0, 0, 0, 0)


@kernel
def _clip(value: int, limit: int) -> int:
    return min(max(value, -limit), limit)


@kernel
def _signed(angle: int) -> int:
    """An angle of 32 bits, or what is left of one after a sum, as turns in [-2^31, 2^31)."""
    return ((angle + (TURN >> 1)) & MASK) - (TURN >> 1)


@kernel
def _times(x: int, k: int) -> int:
    """x k, with k of 16 bits in Q15. In C of two products, x split into a signed and an unsigned half."""
    return (x * k + HALF) >> 15


@kernel
def _ratio(n: int, d: int) -> int:
    """n / d, d positive, rounded half away from zero."""
    size = (abs(n) + (d >> 1)) // d
    return size if n >= 0 else -size


@kernel
def _root(n: int) -> int:
    """Square root, rounded down, of n < 2^30: a bit of the result a turn."""
    root = 0
    bit = 1 << 14
    while bit > 0:
        if (root + bit) * (root + bit) <= n:
            root += bit
        bit >>= 1
    return root


@kernel
def _sine(angle: int) -> int:
    """Sine in Q15 of an angle of 32 bits: 128 intervals of a quarter turn, straight between the points."""
    a = angle & (TURN // 2 - 1)
    if a > TURN // 4:
        a = TURN // 2 - a
    k = a >> 23
    low = int(SINE[k])
    if k < QUARTER:
        low += ((int(SINE[k + 1]) - low) * ((a >> 8) & INT16_MAX) + HALF) >> 15
    return low if angle < TURN // 2 else -low


@kernel
def _cosine(angle: int) -> int:
    return _sine((angle + TURN // 4) & MASK)


@kernel
def _back_emf(c: Constants, u: int, i: int, i_before: int) -> int:
    """(5): mean back-EMF of a period, 16 bits."""
    drop = (c.z_now * i - c.z_before * i_before + ((1 << c.z_shift) >> 1)) >> c.z_shift
    return _clip(u - drop, INT16_MAX)


@kernel
def _filter_gain(c: Constants, speed: int) -> int:
    """Gain of (6), Q15: T_s / (T_s + tau) with tau = min(tau_max, 1 / |omega_h|)."""
    x = ((speed >> 14) * RAD) >> 15  # T_s |omega_h|, rad
    return max(c.a_min, (x << 15) // (ONE + x))


@kernel
def _shift(size: int) -> int:
    """How far `size` < 2^30 is to be shifted down to fit into 15 bits, 0..15."""
    above = size >> 15
    shift = 0
    for part in (8, 4, 2, 1):
        if above >> part > 0:
            above >>= part
            shift += part
    return shift + above


@kernel
def _undo_filter(a: int, turn_h: int, e_alpha: int, e_beta: int) -> tuple[int, int]:
    """The filter's inverse (1 - (1 - a) e^-jx) / a, x = T_s omega_h, on a vector of 16 bits; a quarter of the result.

    With h = x / 2 and t = 2 (1 - a) sin(h) / a the inverse is 1 + t sin(h) + j t cos(h); t is at most 1.
    """
    h = abs(turn_h) >> 1
    sin = _sine(h)
    t = min(_ratio((ONE - a) * sin, a), HALF)  # Q14
    re = HALF + _times(t, sin)
    im = _times(t, _cosine(h))
    if turn_h < 0:
        im = -im
    f_alpha = (re * e_alpha - im * e_beta + ONE) >> 16
    f_beta = (re * e_beta + im * e_alpha + ONE) >> 16
    return f_alpha, f_beta


@kernel
def advance(c: Constants, state: State, x: Counts) -> State:
    """One control period: `hbq_step` of the C file."""
    turn_h = _clip(x.turn_h, TURN_MAX)
    theta_avg = x.theta_avg << 16
    if state.primed == 0:
        return State(1, 0, 0, x.i_alpha, x.i_beta, 0, 0, theta_avg, 0, turn_h)

    # (5), (6)
    speed = abs(turn_h)
    a = _filter_gain(c, speed)
    e_alpha = _back_emf(c, x.u_alpha, x.i_alpha, state.i_alpha) * ONE
    e_beta = _back_emf(c, x.u_beta, x.i_beta, state.i_beta) * ONE
    e_alpha = state.e_alpha + _times(e_alpha - state.e_alpha, a)
    e_beta = state.e_beta + _times(e_beta - state.e_beta, a)

    driven = x.u_alpha != 0 or x.u_beta != 0
    on = state.on if driven and speed >= c.turn_off else 0
    direction = state.direction
    theta = state.theta
    omega = turn_h
    corr_i = 0
    middle = ((2 * x.sector + 1) * TWELFTH + c.hall_offset) & MASK
    if on == 1:
        shift = _shift(abs(e_alpha) | abs(e_beta) | c.e_min)
        f_alpha, f_beta = _undo_filter(a, turn_h, e_alpha >> shift, e_beta >> shift)
        shift += 2
        theta_mid = (theta + ((turn_h + state.corr_i) >> 1)) & MASK
        cos = _cosine(theta_mid)
        sin = _sine(theta_mid)
        e_q = (f_beta * cos - f_alpha * sin) >> 15
        if e_q * direction < -(c.e_turn >> shift):
            direction = -direction
        if (turn_h < 0 and direction > 0) or (turn_h > 0 and direction < 0):
            omega = 0
        # (7), (8): sin(theta_hat - theta*) times the sign of the speed
        size = max(_root(f_alpha * f_alpha + f_beta * f_beta), c.e_min >> shift)
        cross = _clip(_ratio(f_alpha * cos + f_beta * sin, size), INT16_MAX)
        # (9), (4), (10)
        error = -cross * direction
        corr_i = _clip(state.corr_i + _times(c.k_i, error), TURN_MAX)
        omega = _clip(omega + _times(c.k_p, error) + corr_i, OMEGA_MAX)
        theta = (theta + omega) & MASK
        if abs(_signed(theta - middle)) > GUARD:
            on = 0
            omega = turn_h
            corr_i = 0
            theta = theta_avg
    elif x.edge == 1 or turn_h == 0:
        theta = theta_avg
        direction = x.direction
        if x.edge == 1 and driven and speed >= c.turn_on:
            on = 1  # at work from the next sample on
    else:
        theta = (middle + _clip(_signed(theta + turn_h - middle), TWELFTH)) & MASK

    omega = state.omega + _times(omega - state.omega, c.a_omega)
    return State(1, on, direction, x.i_alpha, x.i_beta, e_alpha, e_beta, theta, corr_i, omega)


@kernel
def _count(value: float, scale: float, limit: int) -> int:
    """A physical value in counts, rounded half up, saturated."""
    return math.floor(min(max(value * scale, -float(limit)), float(limit)) + 0.5)


@kernel
def counts(params: Params, sample: Sample) -> Counts:
    """The integers that a firmware would have in the place of `sample`."""
    return Counts(
        _count(sample.u_alpha, params.u_scale, INT16_MAX),
        _count(sample.u_beta, params.u_scale, INT16_MAX),
        _count(sample.i_alpha, params.i_scale, INT16_MAX),
        _count(sample.i_beta, params.i_scale, INT16_MAX),
        _count(sample.hall.omega, params.omega_scale, TURN_MAX),
        _count(sample.theta_avg, 2.0 * ONE / TWO_PI, ONE) & (2 * ONE - 1),
        sample.hall.sector,
        sample.hall.direction,
        sample.hall.edge,
    )


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    state = advance(params.q, state, counts(params, sample))
    return state, Estimate(_signed(state.theta) * (TWO_PI / TURN), state.omega / params.omega_scale, state.on)
