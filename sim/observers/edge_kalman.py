"""An observer past the paper's: a Kalman filter on Hall edges and back-EMF that learns what it needs to know of both.

State: angle and speed of the rotor, its acceleration, and two errors of the back-EMF along it, as speeds: b, which
stays (a resistance, a dead time), and c, which swings with the electrical angle. Three measurements:

- an edge, at its learned place: theta at the time that the edge was captured. It is sharp, and rare.
- e_d, the back-EMF across the estimate: -e_d / psi = omega (theta - theta_hat). Worth the more, the faster it turns;
  worth little where a leg's current goes through zero.
- e_q, the back-EMF along it: (e_q - drop) / psi = omega + b sat(i_q) + c. It shows a change of speed at once, also
  where edges are far apart.

What is wrong with e is not white: it repeats from one electrical angle to another. For e_q that is c, with the time in
which the rotor turns through a sixth of a radian; e_d has a variance that is larger by as much.

- Gains follow from the covariance, which is carried on every `EVERY` samples and at each edge. A gain that is used for
  so many samples is that of the mean of them, P h / (EVERY h P h + r), so that it is below 1 / EVERY.
- Acceleration changes with the current as the inertia says, where it is known, and wanders by a part of that. Else it
  wanders little. A load that steps shows in e_d and e_q before the next edge: their residues, filtered, beside what is
  usual. Beyond `SURPRISE` times that the acceleration may have been another for `BACK` seconds already.
- An edge far off is taken for the truth: the angle starts anew at it, with the speed since the last. Not so where the
  back-EMF is strong, and has been quiet: then it is the edge that is wrong, up to `LOST` times running.
- An edge that has not come holds the angle, and the speed below what it has had time for. Not so where the back-EMF
  tells the speed sharply, or a wire that is broken would hold it.
- Where edges were left out and the back-EMF is no longer so strong, the rotor is in the sector that the levels show.
- A rotor that stands may be anywhere between two edges, and the variance is at most that of such a rotor. Where no edge
  has come for `hall_timeout` and the speed is below `omega_v`, the angle goes to the middle of the sector.
- `edge_lessons` learns once a turn. Each edge's own place in a turn of the shaft is learned here, above omega_b / 2,
  where one edge counts little against the back-EMF.

Works on the sensors' raw levels (`hall_levels`), and so with two sensors, or one. Never uses the front end's sector or
speed, an encoder, or a torque of the shaft.

Source: (3), (5) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367, for the back-EMF; R. E. Kalman, "A New Approach to
Linear Filtering and Prediction Problems", J. Basic Eng., vol. 82, 1960.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, cast

from sim import legs
from sim.numba_cache import kernel
from sim.observers import covariance, edge_lessons, hall_levels, hall_places
from sim.observers.average_speed import FASTEST, centre
from sim.observers.covariance import Five, Symmetric
from sim.observers.edge_lessons import Four, Lessons, Lost, Sums, Two
from sim.observers.edge_scales import Scale, make_scale
from sim.observers.hall_edges import HallEdges
from sim.observers.hall_levels import SENSOR_OF_BIT, Belief, Levels
from sim.observers.hall_places import DEG, MOST, Twelve
from sim.observers.hall_speed import SECTOR_OF_CODE
from sim.observers.sample import Sample
from sim.observers.transforms import clip, square, wrap

EVERY = 8  # samples
SIG_D = 0.15  # of v: error of e_d that repeats
SIG_Q = 0.12  # of v: the same of e_q
SIG_Q_LOW = 0.5  # of v: where the current is small
SIG_NONE = 3.0  # of v: of both where there is none, and no leg loses what its dead time says
NONE = 0.12  # of i_fade: current that is none
SIG_EMF = 0.0073  # of psi omega: both
SIG_WHITE = 0.0055  # of i L / T_s: of a sample, by the noise of the currents
SIG_B = 0.1  # of v, in a root of a second
LITTLE = 0.1  # of i: below it the current is small
SLOWEST = 6.0  # rad/s: below it errors repeat no slower
REPEATS = 6.0  # 1/rad: of the electrical angle
ALPHA_LOW = 0.0029  # of alpha, in a root of a second: how much the acceleration wanders
ALPHA_HIGH = 0.061  # above ALPHA_AT
ALPHA_AT = 24.0  # omega_v
FEED = 0.9  # of what the current does to a shaft whose inertia is known
TORQUE = 2.8  # of what a change of current may do besides
TORQUE_TAU = 0.0063  # s
TORQUE_DEAD = 0.0023  # of i: a change that is none
B_TAU = 0.03  # s: of b where the current is small, and the dead time's error another
B_START = 4.0  # of v_drop
B_LOST = 0.69  # of v_drop: where an edge was far off
ANGLE_START = 20.0 * DEG
OMEGA_START = 5.0  # omega_v
ALPHA_START = 0.07  # of alpha
LEAST_D = 0.5  # omega_v: below it e_d says nothing
CLIP_D = 0.7  # of omega: largest residue of e_d that is used
CLIP_Q = 2.0  # the same of e_q, below omega_b
TAU = 1e-3  # s: filters of current and e_q
RESIDUE_TAU = 0.00083  # s: of the residues
RULE_TAU = 0.52  # s: of what they are as a rule
RULE_MOST = 9.0  # times that, a residue counts at most
RULE_LEAST = 0.017  # of v
RULE = 7.0  # times their square, as a variance
RULE_D = 92.0  # more of it for e_d at low speed, where it is spikes
RULE_AT = 5.4  # omega_v: up to here
SURPRISE = 3.5  # times the variance
BOOST = 0.43  # of alpha, in a root of a millisecond
BOOST_MOST = 1.8  # times that, at the most
BACK = 0.0044  # s
CALM = 1.0  # times the variance, above which the back-EMF is not quiet
QUIET = 5e-3  # s
GATE = 4.0  # sigma, beyond which an edge is far off
LOST = 2
STRONG = 2.5  # omega_v: from here on the back-EMF can be trusted
CREDIBLE = 0.3  # of psi omega: the least back-EMF along the estimate
SHARP = 8.0  # sigma of the speed that it must have
MOVED = 2.0 * DEG
MOVED_SIGMA = 3.0
OVERDUE = 19.0  # sigma
CODES = 40.0 * DEG  # rms of an angle that says less of an edge than the levels do
OWN_SPREAD = 0.61 * DEG  # of the edges of a turn of the shaft; at speed they count as little as that
OWN_AT_FIRST = 0.12  # a turn of the shaft, how fast that goes with what was learned of them
OWN_SHARE = 0.056  # of an edge's residue, at speed
OWN_MOST = 3.0 * DEG
OWN_FROM = 0.5  # omega_b
SCATTER_SHARE = 0.011
SCATTER_LEAST = 0.018 * DEG
SETTLED = 12  # edges running, one way
COUNT = len(edge_lessons.LESSONS)
HOLD = 64  # samples that a lesson is told for
PLACES = 17  # lessons until they come round, the first ones twice: a stream of every n-th sample has all, for usual n


@dataclass(frozen=True, kw_only=True)
class Settings(HallEdges):
    """The drive's parameters that it takes; an edge of 0 is not known."""

    n_p: float
    omega_m_max: float  # mechanical rad/s
    hall_timeout: float  # s
    R_s_hat: float  # ohm
    L_s_hat: float  # H
    psi_f_hat: float  # V s
    i_range: float  # A
    bw_omega_lpf: float  # Hz
    J_hat: float = 0.0  # kg m2; 0: not known
    learn_edges: float = 1.0  # 0 holds everything that is learned
    edge_sd: float = 0.0087  # rad, standard deviation of the edges that are told, all together


class Params(NamedTuple):
    """Constants: SI units, electrical angles and speeds."""

    scale: Scale
    a_tau: float  # gains of filters
    a_residue: float
    a_omega: float
    omega_max: float
    timeout: float  # s
    learn: int
    pairs: int  # pole pairs that are told apart, 0: none
    told: Twelve  # places at the start, rad, actual less ideal; 0: not known
    told_sd: float  # rad, of all of a way together


class Filter(NamedTuple):
    """The Kalman filter."""

    x: Five  # theta, omega, alpha, b, c
    P: Symmetric
    gain_d: Five  # of e_d and e_q, until P is carried on
    gain_q: Five
    since: int  # samples since it was


class Watch(NamedTuple):
    """What e and i do."""

    i_q: float  # A, filtered
    i_slow: float  # slower
    e_q: float  # V, filtered
    residue_d: float  # rad/s, filtered
    residue_q: float
    rule_d: float  # rad2/s2, mean squares of them
    rule_q: float
    quiet: float  # s since they were more
    counted: float  # samples that e_d counts for, since P was carried on


class Last(NamedTuple):
    """The last edge that was used."""

    passed: int  # edges in a row that went one way: 0, 1, 2, 3 and more
    row: int  # of them without one left out
    way: int  # +1 or -1
    boundary: int
    at: float  # rad
    age: float  # s
    off: int  # edges since that were too far off


class State(NamedTuple):
    """What the observer remembers."""

    primed: int  # 1: the fields below hold a past sample
    i_alpha: float
    i_beta: float
    omega_lpf: float
    filter: Filter
    watch: Watch
    last: Last
    levels: Levels
    belief: Belief
    lessons: Lessons
    sums: Sums
    twice: Two  # by `lessons`, at this speed and current
    six: Four
    told: int  # samples since the lessons came round
    lesson: Two  # the one that is told now, and its standard deviation


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample
    omega: float  # electrical rad/s, low-pass filtered
    sensors: int  # bits 0-2: sensor a, b, c is not believed; bits 3-5: it has moved since the start
    unused: int  # edges not used so far: pulses, edges far off or of a sensor that is not believed
    sigma: float  # rad, standard deviation of theta as the filter has it
    lesson: int  # a number in `edge_lessons.LESSONS`, each in turn
    learned: float  # what was learned that this parameter should be, in its unit
    learned_sd: float  # standard deviation of that


class Emf(NamedTuple):
    """The back-EMF of the period that ends at a sample, along and across the estimate at its middle."""

    e_d: float  # V
    e_q: float
    i_q: float  # A, mean of the period
    cos: float
    sin: float
    cos_6: float
    sin_6: float
    lost: Lost


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    names = ("n_p", "omega_m_max", "R_s_hat", "L_s_hat", "psi_f_hat", "i_range", "J_hat")
    scale = make_scale(float(pwm_hz), **{name: float(getattr(drive, name)) for name in names})
    pairs = int(drive.n_p)
    return Params(
        scale=scale,
        a_tau=1.0 - math.exp(-scale.T_s / TAU),
        a_residue=1.0 - math.exp(-scale.T_s / RESIDUE_TAU),
        a_omega=1.0 - math.exp(-2.0 * math.pi * float(drive.bw_omega_lpf) * scale.T_s),
        omega_max=FASTEST * float(drive.n_p) * float(drive.omega_m_max),
        timeout=float(drive.hall_timeout),
        learn=int(drive.learn_edges),
        pairs=pairs if 1 < pairs <= MOST else 0,
        told=cast("Twelve", tuple(-place for place in drive.places())),
        told_sd=max(float(drive.edge_sd), hall_places.SCATTER),
    )


@kernel
def init() -> State:
    """Nothing known: the next sample gives the first currents and the sector."""
    zero = (0.0, 0.0, 0.0, 0.0, 0.0)
    return State(
        0,
        0.0,
        0.0,
        0.0,
        Filter(zero, covariance.diagonal(0.0, 0.0, 0.0, 0.0, 0.0), zero, zero, 0),
        Watch(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        Last(0, 0, 0, 0, 0.0, 0.0, 0),
        Levels(0, -1, 0.0, 0),
        hall_levels.nothing_against(),
        edge_lessons.unprimed(),
        edge_lessons.nothing(),
        (0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0),
        0,
        (0.0, 0.0),
    )


@kernel
def _primed(params: Params, state: State, sample: Sample) -> State:
    """At rest in the middle of the sector that the levels show."""
    scale = params.scale
    zero = (0.0, 0.0, 0.0, 0.0, 0.0)
    theta = wrap(centre(max(SECTOR_OF_CODE[sample.code], 0)))
    P = covariance.diagonal(
        ANGLE_START**2,
        (OMEGA_START * scale.omega_v) ** 2,
        (ALPHA_START * scale.alpha) ** 2,
        (B_START * scale.v_drop / scale.psi_f) ** 2,
        0.0,
    )
    lessons = edge_lessons.start(scale, params.told, params.told_sd)
    rule_d = (SIG_D * scale.omega_v) ** 2
    rule_q = (SIG_Q * scale.omega_v) ** 2
    return State(
        1,
        sample.i_alpha,
        sample.i_beta,
        0.0,
        Filter((theta, 0.0, 0.0, 0.0, 0.0), P, zero, zero, 0),
        Watch(0.0, 0.0, 0.0, 0.0, 0.0, rule_d, rule_q, 0.0, 0.0),
        state.last,
        Levels(sample.code, -1, 0.0, 0),
        state.belief,
        lessons,
        state.sums,
        state.twice,
        state.six,
        state.told,
        edge_lessons.lesson(lessons, scale, 0),
    )


@kernel
def _emf(scale: Scale, state: State, sample: Sample, theta: float, omega: float) -> Emf:
    """(5), less what was learned of current sensors and ripple."""
    lessons = state.lessons
    i_alpha = 0.5 * (sample.i_alpha + state.i_alpha)
    i_beta = 0.5 * (sample.i_beta + state.i_beta)
    L_by_T = scale.L_s / scale.T_s
    re, im = state.twice
    e_alpha = sample.u_alpha - scale.R_s * i_alpha - L_by_T * (sample.i_alpha - state.i_alpha) - lessons.offset[0]
    e_beta = sample.u_beta - scale.R_s * i_beta - L_by_T * (sample.i_beta - state.i_beta) - lessons.offset[1]
    e_alpha -= re * i_alpha + im * i_beta
    e_beta -= im * i_alpha - re * i_beta
    u = math.sqrt(sample.u_alpha * sample.u_alpha + sample.u_beta * sample.u_beta)
    lost = edge_lessons.lost(lessons, scale, u, i_alpha, i_beta)
    full, near = lessons.lost
    e_alpha -= full * lost.full[0] + near * lost.whole[0]
    e_beta -= full * lost.full[1] + near * lost.whole[1]
    middle = theta - 0.5 * scale.T_s * omega
    cos = math.cos(middle)
    sin = math.sin(middle)
    c2 = cos * cos - sin * sin
    s2 = 2.0 * cos * sin
    c4 = c2 * c2 - s2 * s2
    s4 = 2.0 * c2 * s2
    c6 = c4 * c2 - s4 * s2
    s6 = s4 * c2 + c4 * s2
    six = state.six
    return Emf(
        e_alpha * cos + e_beta * sin - (six[0] + six[2]) * c6 - (six[1] - six[3]) * s6,
        e_beta * cos - e_alpha * sin - (six[1] + six[3]) * c6 - (six[2] - six[0]) * s6,
        i_beta * cos - i_alpha * sin,
        cos,
        sin,
        c6,
        s6,
        lost,
    )


@kernel
def _summed(sums: Sums, emf: Emf, left_d: float, left_q: float, omega: float, sign: float) -> Sums:
    """The sums after a sample, `left_d` and `left_q` (V) being what the filter leaves of e."""
    alpha = left_d * emf.cos - left_q * emf.sin
    beta = left_d * emf.sin + left_q * emf.cos
    six = sums.six
    return Sums(
        sums.n + 1.0,
        sums.e_d + emf.e_d,
        sums.e_q + emf.e_q,
        sums.i_q + emf.i_q,
        sums.omega + omega,
        sums.sign + sign,
        sums.off,
        (sums.fixed[0] + alpha, sums.fixed[1] + beta),
        (sums.twice[0] + alpha * emf.cos - beta * emf.sin, sums.twice[1] + alpha * emf.sin + beta * emf.cos),
        (
            six[0] + left_d * emf.cos_6 - left_q * emf.sin_6,
            six[1] + left_d * emf.sin_6 + left_q * emf.cos_6,
            six[2] + left_d * emf.cos_6 + left_q * emf.sin_6,
            six[3] + left_q * emf.cos_6 - left_d * emf.sin_6,
        ),
        legs.along(sums.legs, alpha, beta, emf.lost.full, emf.lost.near),
    )


@kernel
def _noise(scale: Scale, psi: float, omega: float, i_q: float) -> tuple[float, float, float, float]:
    """Variances of e_d and e_q for a sample, of c (all rad2/s2), and the rate (1/s) at which errors change."""
    size = abs(omega)
    rate = REPEATS * max(size, SLOWEST)
    by = 1.0 / (psi * psi)
    emf = square(SIG_EMF * psi * omega)
    white = (SIG_WHITE * scale.i * scale.L_s / scale.T_s) ** 2 * by
    none = square(SIG_NONE * scale.v / (1.0 + square(i_q / (NONE * scale.i_fade))))
    repeats = (square(SIG_D * scale.v) + none + emf) * by
    fast = max(size / scale.omega_b, 1.0)
    swings = (square(SIG_Q * scale.v) + none + emf) * by
    if abs(i_q) < LITTLE * scale.i:
        swings += square(SIG_Q_LOW * scale.v) * by
    return repeats * (1.0 + 2.0 / (rate * scale.T_s)) + white, white * fast * fast, swings, rate


@kernel
def _later(P: Symmetric, t: float, wander: float, b: float, f: float, c: float) -> Symmetric:
    """P after `t` seconds; variances that alpha, b and c gain, and the share of c that is left."""
    h = 0.5 * t * t
    return (
        P[0] + 2.0 * (t * P[1] + h * P[2] + t * h * P[6]) + t * t * P[5] + h * h * P[9],
        P[1] + t * (P[5] + P[2]) + (t * t + h) * P[6] + h * t * P[9],
        P[2] + t * P[6] + h * P[9],
        P[3] + t * P[7] + h * P[10],
        f * (P[4] + t * P[8] + h * P[11]),
        P[5] + 2.0 * t * P[6] + t * t * P[9],
        P[6] + t * P[9],
        P[7] + t * P[10],
        f * (P[8] + t * P[11]),
        P[9] + wander,
        P[10],
        f * P[11],
        P[12] + b,
        f * P[13],
        f * f * P[14] + c,
    )


@kernel
def _along(P: Symmetric, sign: float) -> Five:
    """P h of e_q."""
    return (
        P[1] + sign * P[3] + P[4],
        P[5] + sign * P[7] + P[8],
        P[6] + sign * P[10] + P[11],
        P[7] + sign * P[12] + P[13],
        P[8] + sign * P[13] + P[14],
    )


@kernel
def _across(P: Symmetric, omega: float) -> Five:
    """P h of e_d."""
    return (P[0] * omega, P[1] * omega, P[2] * omega, P[3] * omega, P[4] * omega)


@kernel
def _ago(P: Symmetric, ago: float) -> Five:
    """P h of the angle `ago` seconds ago."""
    return (P[0] - ago * P[1], P[1] - ago * P[5], P[2] - ago * P[6], P[3] - ago * P[7], P[4] - ago * P[8])


@kernel
def _carried(params: Params, kalman: Filter, watch: Watch, psi: float, driven: bool) -> tuple[Filter, Watch]:
    """P over the samples since it was last carried on, with what e has told in them; and whether that surprises."""
    scale = params.scale
    omega = kalman.x[1]
    size = abs(omega)
    n = float(kalman.since)
    t = n * scale.T_s
    r_d, r_q, swings, rate = _noise(scale, psi, omega, watch.i_q)
    sign = clip(watch.i_q / scale.i_fade, 1.0)
    f = 1.0 / (1.0 + rate * t)
    y = square(size / (ALPHA_AT * scale.omega_v))
    wander = square(scale.alpha * (ALPHA_LOW + (ALPHA_HIGH - ALPHA_LOW) * y / (1.0 + y)))
    change = max(abs(watch.i_q - watch.i_slow) / scale.i - TORQUE_DEAD, 0.0) * scale.alpha
    wander += TORQUE * change * change / TORQUE_TAU
    i_slow = watch.i_slow + t / TORQUE_TAU * (watch.i_q - watch.i_slow)
    P = _later(kalman.P, t, wander * t, square(SIG_B * scale.v / psi) * t, f, swings * (1.0 - f * f))
    rule_d = watch.rule_d
    rule_q = watch.rule_q
    quiet = watch.quiet
    if driven:
        if size > LEAST_D * scale.omega_v:
            g = _across(P, omega)
            P = covariance.less(P, g, watch.counted / (watch.counted * g[0] * omega + r_d))
        g = _along(P, sign)
        P = covariance.less(P, g, 1.0 / (g[1] + sign * g[3] + g[4] + r_q / n))
        least = square(RULE_LEAST * scale.v / psi)
        square_d = watch.residue_d * watch.residue_d
        square_q = watch.residue_q * watch.residue_q
        at = square(square(size / (RULE_AT * scale.omega_v)))
        slow = 1.0 / (1.0 + at * at)
        much = square_d / (omega * omega * P[0] + (RULE + RULE_D * slow) * max(rule_d, least))
        if size <= scale.omega_b:
            own = P[5] + sign * sign * P[12] + 2.0 * sign * P[7]
            much = max(much, square_q / (own + RULE * max(rule_q, least)))
        rule_d += t / RULE_TAU * (min(square_d, RULE_MOST * max(rule_d, least)) - rule_d)
        rule_q += t / RULE_TAU * (min(square_q, RULE_MOST * max(rule_q, least)) - rule_q)
        if much > CALM:
            quiet = 0.0
        if much > SURPRISE:
            P = _stirred(P, (BOOST * scale.alpha) ** 2 * (t / 1e-3) * min(much / SURPRISE - 1.0, BOOST_MOST))
    b = kalman.x[3]
    if abs(watch.i_q) < LITTLE * scale.i:
        b /= 1.0 + t / B_TAU
    x = (kalman.x[0], kalman.x[1], kalman.x[2], b, f * kalman.x[4])
    watch = Watch(watch.i_q, i_slow, watch.e_q, watch.residue_d, watch.residue_q, rule_d, rule_q, quiet, 0.0)
    return Filter(x, P, kalman.gain_d, kalman.gain_q, 0), watch


@kernel
def _stirred(P: Symmetric, a: float) -> Symmetric:
    """P where the acceleration may have been another, by the variance a, for `BACK` seconds."""
    y = BACK
    x = 0.5 * BACK * BACK
    return (
        P[0] + a * x * x,
        P[1] + a * x * y,
        P[2] + a * x,
        P[3],
        P[4],
        P[5] + a * y * y,
        P[6] + a * y,
        P[7],
        P[8],
        P[9] + a,
        P[10],
        P[11],
        P[12],
        P[13],
        P[14],
    )


@kernel
def _anew(scale: Scale, kalman: Filter, psi: float, angle: float, omega: float, alpha: float) -> Filter:
    """The filter with variances of angle, speed and acceleration that nothing else is known of."""
    b = max(kalman.P[12], square(B_LOST * scale.v_drop / psi))
    return Filter(
        kalman.x,
        covariance.diagonal(angle, omega, alpha, b, kalman.P[14]),
        kalman.gain_d,
        kalman.gain_q,
        kalman.since,
    )


@kernel
def _moved_to(kalman: Filter, x: Five) -> Filter:
    """The filter at another state."""
    return Filter(x, kalman.P, kalman.gain_d, kalman.gain_q, kalman.since)


@kernel
def _trusted(scale: Scale, kalman: Filter, watch: Watch, psi: float, driven: bool) -> tuple[bool, bool]:
    """Whether the back-EMF is strong, and whether it tells the speed sharply then."""
    omega = kalman.x[1]
    strong = driven and abs(omega) > STRONG * scale.omega_v and watch.e_q * omega > CREDIBLE * psi * omega * omega
    return strong, strong and SHARP * SHARP * kalman.P[5] < omega * omega


@kernel
def _edge(params: Params, state: State, sensor: int, before: int, driven: bool) -> State:
    """After an edge of `sensor`, from the levels `before`."""
    scale = params.scale
    kalman, last, belief, lessons = state.filter, state.last, state.belief, state.lessons
    levels = state.levels
    places = lessons.places
    learn = params.learn != 0
    psi = lessons.drop[0]
    ago = levels.pending_age
    omega = kalman.x[1]
    size = abs(omega)
    then = kalman.x[0] - ago * omega + 0.5 * ago * ago * kalman.x[2]
    by_codes = last.passed == 0 or last.off > LOST or kalman.P[0] > CODES * CODES
    boundary, way = _met(lessons, sensor, before, levels.code, then, by_codes)
    slot = hall_places.slot(boundary, way)
    at = hall_places.angle(places, boundary, way) + lessons.common[4] * omega
    pair = hall_places.pair_of(places, params.pairs, last.boundary, last.way, boundary, way)
    at += places.own[pair][boundary]
    z = wrap(at - then)
    speed = size / scale.omega_b
    fast = speed * speed / (speed * speed + 1.0)
    unlike = fast + (1.0 / (1.0 + OWN_AT_FIRST * places.turns) if params.pairs > 0 else 0.0)
    r = places.scatter + places.variance[slot] + OWN_SPREAD * OWN_SPREAD * unlike
    S = kalman.P[0] - 2.0 * ago * kalman.P[1] + ago * ago * kalman.P[5] + r
    far = z * z > GATE * GATE * S
    strong, sharp = _trusted(scale, kalman, state.watch, psi, driven)
    if strong:
        known = last.passed >= 3 and places.visits[slot] > 2.0
        side = 0
        if known and abs(z) > MOVED and z * z > MOVED_SIGMA * MOVED_SIGMA * S:
            side = 1 if z > 0.0 else -1
        belief, moved = hall_levels.off_to(belief, sensor, side)
        if moved and learn:
            lessons = edge_lessons.moved(lessons, sensor, -z)
            places = lessons.places
            z = 0.0
            far = False
    if far and sharp and state.watch.quiet > QUIET and last.passed > 0 and last.off <= LOST:
        last = Last(last.passed, 0, last.way, last.boundary, last.at, last.age, last.off + 1)
        return _after(state, kalman, last, levels, belief, lessons, state.sums)

    levels = Levels(levels.code, levels.pending, levels.pending_age, levels.unused - 1)
    since = max(last.age - ago, scale.T_s)
    turned = way != last.way
    row = 0 if turned else last.row
    passed = 0 if turned else last.passed
    x = kalman.x
    if far and last.off > LOST:
        kalman = _anew(scale, kalman, psi, r, 0.1 * omega * omega + scale.omega_v**2, kalman.P[9])
        kalman = _moved_to(kalman, (x[0] + z, x[1], x[2], x[3], x[4]))
        z = 0.0
    elif far and passed > 0:
        v = wrap(at - last.at) / since
        kalman = _anew(scale, kalman, psi, r, 0.1 * v * v + 0.1 * square(z / since), 0.3 * square(v / since))
        kalman = _moved_to(kalman, (x[0] + z + ago * (v - omega), v, 0.0, x[3], x[4]))
        z = 0.0
    elif far:
        P = kalman.P
        P = covariance.diagonal(P[0] + z * z, P[5] + square(z / since), P[9], P[12], P[14])
        kalman = Filter(x, P, kalman.gain_d, kalman.gain_q, kalman.since)
    g = _ago(kalman.P, ago)
    s = 1.0 / (g[0] - ago * g[1] + r)
    moved_by = s * z * (g[0] - ago * g[1])
    P = covariance.less(kalman.P, g, s)
    kalman = Filter(covariance.added(kalman.x, g, s * z), P, kalman.gain_d, kalman.gain_q, kalman.since)

    scatter = places.scatter
    sums = state.sums
    if learn and row >= SETTLED:
        seen = clip(z * (z - moved_by) - places.variance[slot], 9.0 * scatter)
        scatter = max(scatter + SCATTER_SHARE * (seen - scatter), SCATTER_LEAST * SCATTER_LEAST)
        if params.pairs > 0 and speed > OWN_FROM:
            by = -OWN_SHARE * fast * fast * clip(z, OWN_MOST)
            places = hall_places.taught(places, pair, boundary, by, 1.0 / (6.0 * params.pairs))
    row = row + 1 if boundary == (last.boundary + way) % 6 else 0
    belief, none = hall_levels.judged(belief, levels.code, boundary, way)
    passed = 0 if none else min(passed + 1, 3)
    last = Last(passed, row, way, boundary, at, ago, 0)
    if learn:
        lessons = edge_lessons.met(lessons, hall_places.after(places, pair, scatter), since)
        off = sums.off + z - 0.5 * moved_by
        sums = Sums(
            sums.n,
            sums.e_d,
            sums.e_q,
            sums.i_q,
            sums.omega,
            sums.sign,
            off,
            sums.fixed,
            sums.twice,
            sums.six,
            sums.legs,
        )
        if boundary == 0:
            if row >= edge_lessons.ROW and sums.n >= 4.0:
                lessons, kalman = _taught(scale, lessons, kalman, sums, state.watch.i_q, way)
            sums = edge_lessons.nothing()
    else:
        lessons = edge_lessons.with_places(lessons, hall_places.after(places, pair, scatter), lessons.gaps)
    return _after(state, kalman, last, levels, belief, lessons, sums)


@kernel
def _after(
    state: State, kalman: Filter, last: Last, levels: Levels, belief: Belief, lessons: Lessons, sums: Sums
) -> State:
    """The state after an edge."""
    return State(
        1,
        state.i_alpha,
        state.i_beta,
        state.omega_lpf,
        kalman,
        state.watch,
        last,
        levels,
        belief,
        lessons,
        sums,
        state.twice,
        state.six,
        state.told,
        state.lesson,
    )


@kernel
def _met(lessons: Lessons, sensor: int, before: int, code: int, theta: float, by_codes: bool) -> tuple[int, int]:
    """Boundary and way of the edge of `sensor` from the levels `before` to `code`.

    By the codes, if both are legal; or the nearer to `theta` of the two boundaries that sensor and level leave.
    """
    up = hall_levels.rising(sensor, code)
    down = (up + 3) % 6
    was = SECTOR_OF_CODE[before]
    now = SECTOR_OF_CODE[code]
    if by_codes and was >= 0 and now >= 0:
        upwards = (was + 1) % 6 == now
    else:
        from_up = abs(wrap(hall_places.angle(lessons.places, up, 1) - theta))
        upwards = from_up <= abs(wrap(hall_places.angle(lessons.places, down, -1) - theta))
    return (up, 1) if upwards else (down, -1)


@kernel
def _taught(scale: Scale, lessons: Lessons, kalman: Filter, sums: Sums, i_q: float, way: int) -> tuple[Lessons, Filter]:
    """What a turn teaches, and the filter: what the drop takes from now on is no longer b's."""
    x = kalman.x
    was = edge_lessons.along(lessons, scale, x[1], i_q)
    lessons = edge_lessons.turn(lessons, sums, scale, way, 0)
    if abs(i_q) <= LITTLE * scale.i:
        return lessons, kalman
    more = edge_lessons.along(lessons, scale, x[1], i_q) - was
    b = x[3] - more / lessons.drop[0] * clip(i_q / scale.i_fade, 1.0)
    return lessons, _moved_to(kalman, (x[0], x[1], x[2], b, x[4]))


@kernel
def _held(scale: Scale, kalman: Filter, last: Last, belief: Belief, lessons: Lessons, sharp: bool) -> Filter:
    """The filter where an edge has not come: the angle stays between two edges, as far as the back-EMF lets it."""
    places = lessons.places
    ahead = hall_levels.following(belief, last.boundary, last.way)
    width = hall_places.width(places, last.boundary, ahead, last.way)
    theta, omega, alpha, b, c = kalman.x
    x = last.way * wrap(theta - last.at)
    sigma = math.sqrt(places.scatter + places.variance[hall_places.slot(ahead, last.way)])
    margin = OVERDUE * sigma + scale.T_s * abs(omega)
    back = margin + abs(places.actual[last.boundary] - places.actual[last.boundary + 6])
    over = 0.0
    side = last.way
    if x > width + margin:
        over = x - width - margin
    elif x < -back:
        over = -x - back
        side = -last.way
    if 0.0 < over < 2.5 and not sharp:
        theta -= side * over
        fastest = width / max(last.age, scale.T_s)
        if last.passed > 1 and omega * side > fastest:
            omega = side * fastest
        if last.passed < 2:
            omega *= 1.0 - EVERY * scale.T_s / QUIET
        if alpha * side > 0.0:
            alpha = 0.0
        P = kalman.P
        P = covariance.diagonal(
            max(P[0], DEG * DEG),
            max(P[5], square(0.3 * omega) + (0.25 * scale.omega_v) ** 2),
            max(P[9], (ALPHA_START * scale.alpha) ** 2),
            P[12],
            P[14],
        )
        kalman = Filter((theta, omega, alpha, b, c), P, kalman.gain_d, kalman.gain_q, kalman.since)
    most = width * width / 12.0  # of a rotor that may be anywhere in between
    if kalman.P[0] > most:
        g = _ago(kalman.P, 0.0)
        s = 1.0 / (g[0] + most * g[0] / (g[0] - most))
        z = wrap(last.at + 0.5 * last.way * width - theta)
        P = covariance.less(kalman.P, g, s)
        kalman = Filter(covariance.added(kalman.x, g, s * z), P, kalman.gain_d, kalman.gain_q, kalman.since)
    return kalman


@kernel
def _heeded(scale: Scale, kalman: Filter, last: Last, lessons: Lessons, sector: int) -> tuple[Filter, Last]:
    """The filter where edges were left out and the back-EMF is no longer trusted more: the rotor is in `sector`."""
    places = lessons.places
    psi = lessons.drop[0]
    way = last.way if last.way != 0 else 1
    boundary = sector if way > 0 else (sector + 1) % 6
    at = hall_places.angle(places, boundary, way)
    width = hall_places.width(places, boundary, (boundary + way) % 6, way)
    x = kalman.x
    middle = at + 0.5 * way * width
    off = wrap(x[0] - middle)
    if abs(off) > 0.5 * width:
        theta = middle + clip(off, 0.5 * width)
        kalman = _moved_to(kalman, (theta, x[1], x[2], x[3], x[4]))
        kalman = _anew(scale, kalman, psi, ANGLE_START**2, kalman.P[5] + scale.omega_v**2, kalman.P[9])
    return kalman, Last(1, 0, way, boundary, at, last.age, 0)


@kernel
def _gained(scale: Scale, kalman: Filter, psi: float, i_q: float) -> Filter:
    """The filter with the gains of its P, for the next `EVERY` samples."""
    omega = kalman.x[1]
    sign = clip(i_q / scale.i_fade, 1.0)
    r_d, r_q, _, _ = _noise(scale, psi, omega, i_q)
    d = _across(kalman.P, omega)
    q = _along(kalman.P, sign)
    gain_d = covariance.times(1.0 / (EVERY * omega * d[0] + r_d), d)
    gain_q = covariance.times(1.0 / (EVERY * (q[1] + sign * q[3] + q[4]) + r_q), q)
    return Filter(kalman.x, kalman.P, gain_d, gain_q, kalman.since)


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    if state.primed == 0:
        state = _primed(params, state, sample)
        return state, Estimate(state.filter.x[0], 0.0, 0, 0, ANGLE_START, 0, state.lesson[0], state.lesson[1])
    scale = params.scale
    T_s = scale.T_s
    lessons = state.lessons
    kalman = state.filter
    watch = state.watch
    sums = state.sums
    last = state.last
    psi = lessons.drop[0]
    standing = kalman.x[0]
    theta = standing + T_s * kalman.x[1] + 0.5 * T_s * T_s * kalman.x[2]
    omega = kalman.x[1] + T_s * kalman.x[2]
    size = abs(omega)

    emf = _emf(scale, state, sample, theta, omega)
    i_q = watch.i_q + params.a_tau * (emf.i_q - watch.i_q)
    x = (theta, omega, kalman.x[2] + FEED * scale.feed * (i_q - watch.i_q), kalman.x[3], kalman.x[4])
    sign = clip(i_q / scale.i_fade, 1.0)
    driven = sample.u_alpha != 0.0 or sample.u_beta != 0.0
    residue_d = watch.residue_d
    residue_q = watch.residue_q
    if driven:
        z_d = -emf.e_d / psi - omega * edge_lessons.turned(lessons, scale, i_q)
        left = (emf.e_q - lessons.drop[1] * sign - lessons.drop[2] * emf.i_q) / psi - omega - x[3] * sign
        z_q = left - x[4]
        residue_d += params.a_residue * (z_d - residue_d)
        residue_q += params.a_residue * (left - residue_q)
        if params.learn != 0:
            sums = _summed(sums, emf, emf.e_d, psi * left, omega, clip(emf.i_q / scale.i_fade, 1.0))
        most = max(size, 1.5 * scale.omega_v)
        if size > LEAST_D * scale.omega_v:
            x = covariance.added(x, kalman.gain_d, emf.lost.weight * clip(z_d, CLIP_D * most))
        x = covariance.added(x, kalman.gain_q, clip(z_q, CLIP_Q * most) if size <= scale.omega_b else z_q)
    watch = Watch(
        i_q,
        watch.i_slow,
        watch.e_q + params.a_tau * (emf.e_q - watch.e_q),
        residue_d,
        residue_q,
        watch.rule_d,
        watch.rule_q,
        watch.quiet + T_s,
        watch.counted + emf.lost.weight,
    )
    kalman = Filter(x, kalman.P, kalman.gain_d, kalman.gain_q, kalman.since + 1)
    last = Last(last.passed, last.row, last.way, last.boundary, last.at, last.age + T_s, last.off)

    before = state.levels.code
    ago = state.levels.pending_age + T_s
    levels = hall_levels.read(state.levels, sample, T_s)
    sensor = SENSOR_OF_BIT[before ^ levels.code]
    twice = state.twice
    six = state.six
    told = (state.told + 1) % (HOLD * PLACES)
    belief = state.belief
    if kalman.since >= EVERY or sensor >= 0:
        kalman, watch = _carried(params, kalman, watch, psi, driven)
        if sensor >= 0 and hall_levels.believed(belief, sensor):
            held = Levels(levels.code, levels.pending, ago, levels.unused)
            state = State(
                1,
                sample.i_alpha,
                sample.i_beta,
                state.omega_lpf,
                kalman,
                watch,
                last,
                held,
                belief,
                lessons,
                sums,
                twice,
                six,
                told,
                state.lesson,
            )
            state = _edge(params, state, sensor, before, driven)
            kalman, last, belief, lessons, sums = (
                state.filter,
                state.last,
                state.belief,
                state.lessons,
                state.sums,
            )
            levels = Levels(levels.code, levels.pending, levels.pending_age, state.levels.unused)
            psi = lessons.drop[0]
        _, sharp = _trusted(scale, kalman, watch, psi, driven)
        sector = SECTOR_OF_CODE[levels.code]
        if last.off > 0 and sector >= 0 and not sharp:
            kalman, last = _heeded(scale, kalman, last, lessons, sector)
        if last.passed > 0:
            kalman = _held(scale, kalman, last, belief, lessons, sharp)
        kalman = _gained(scale, kalman, psi, i_q)
        omega = kalman.x[1]
        twice = edge_lessons.twice_of(lessons, scale, omega)
        six = edge_lessons.six_of(lessons, scale, omega)

    theta = wrap(kalman.x[0])
    omega = clip(kalman.x[1], params.omega_max)
    stands = last.age > params.timeout and abs(omega) < scale.omega_v
    if stands:
        theta = _resting(lessons, levels.code, standing, 4.0 * T_s / params.timeout)
    b = clip(kalman.x[3], B_START * scale.v_drop / psi)
    kalman = _moved_to(kalman, (theta, omega, kalman.x[2], b, kalman.x[4]))
    omega_lpf = 0.0 if stands else state.omega_lpf + params.a_omega * (omega - state.omega_lpf)
    number = (told // HOLD) % COUNT
    lesson = edge_lessons.lesson(lessons, scale, number) if told % HOLD == 0 else state.lesson
    state = State(
        1,
        sample.i_alpha,
        sample.i_beta,
        omega_lpf,
        kalman,
        watch,
        last,
        levels,
        belief,
        lessons,
        sums,
        twice,
        six,
        told,
        lesson,
    )
    waiting = 1 if levels.pending >= 0 else 0
    sigma = math.sqrt(max(kalman.P[0], 0.0))
    unused = levels.unused - waiting
    return state, Estimate(theta, omega_lpf, belief.sensors, unused, sigma, number, lesson[0], lesson[1])


@kernel
def _resting(lessons: Lessons, code: int, theta: float, share: float) -> float:
    """The angle of a rotor that stands: a share nearer to the middle of the sector that the levels show."""
    sector = SECTOR_OF_CODE[code]
    if sector < 0:
        return theta
    width = hall_places.width(lessons.places, sector, (sector + 1) % 6, 1)
    return wrap(theta + share * wrap(hall_places.angle(lessons.places, sector, 1) + 0.5 * width - theta))
