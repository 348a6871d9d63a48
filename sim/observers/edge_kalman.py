"""Kalman filter on Hall edges and back-EMF. It learns what it needs to know about both while it runs.

Its state is the rotor's angle theta, speed omega and acceleration alpha, and two errors of the back-EMF along the
estimate, both expressed as speeds: b is slow (a wrong resistance, a residue of the dead time), and c repeats with the
electrical angle. Three measurements correct the state:

- A Hall edge, at its learned angle, gives theta at the time when the edge was captured. Edges are accurate but rare.
- The back-EMF across the estimate: -e_d / psi = omega (theta - theta_hat). The filter gives it more weight the faster
  the rotor turns, and little while the current of a leg passes zero.
- The back-EMF along the estimate: (e_q - drop) / psi = omega + b sat(i_q) + c. It shows a change of speed at once, also
  while edges are far apart.

The errors of e_d and e_q are not white noise: they repeat at the same electrical angles. For e_q the state c models
them; it decays while the rotor turns through a sixth of a radian. For e_d the variance of a sample is enlarged by the
number of samples over which the error stays the same.

- The covariance P is updated every `UPDATE_EVERY` samples and at each edge. The gains follow from it. A gain serves
  that many samples, so it is the gain for their mean, P h / (UPDATE_EVERY h P h + r), which is below 1 / UPDATE_EVERY.
- Without a voltage, with the outputs off or where none is known, edges alone correct the state: the acceleration
  wanders faster, as a drive may turn the shaft that is not seen, and no edge is doubted because the back-EMF is quiet.
  Where none will be known, which a resistance of 0 says, the angle before the first edge is that of the sector.
- If the inertia is known, the acceleration follows the current and is uncertain by a part of that change; otherwise it
  wanders slowly. Before the first edge, and where one is long overdue, friction may hold the shaft: what the current
  would cause is then uncertain as a whole. Edges that err alike, one after the other, make the walk wider: a load that
  pulsates does that.
- A load step shows in e_d and e_q before the next edge: the filter compares their filtered residues with the usual
  ones. Beyond `SURPRISE` times the expected variance it assumes that the acceleration has been different for
  `SURPRISE_BACK` seconds already.
- An edge far from the estimate is taken as correct, and the filter restarts from it with the mean speed since the last
  edge. If the back-EMF is strong and has been quiet, the edge is taken as wrong instead, until all sensors contradict.
- A pulse and a bounce go back. An edge that comes too early, or turns a rotor back that surely turns forward, is held:
  forgotten if its level returns; used if the next edge in turn comes early as well. One that comes a little too early
  is used once it is due, with little weight; one back just after an edge if its level stays. What follows upon an edge
  within half a turn is no second one, unless it fits better than the first, which then was a pulse.
- If an edge is overdue, the angle stays before it and the speed is limited accordingly. If the back-EMF gives the speed
  precisely, this is left out up to the edge after it, because a broken wire would hold the angle for ever.
- Codes that have been legal for a revolution are regular: each dead sensor shows an illegal one in each. Then they say
  which edge it was, no sensor is dead, and an estimate that has turned further outside their sector than one edge is
  lost: it starts again in the middle, its speed limited by the time in which no edge came.
- After rejected edges, once the back-EMF is no longer strong, the angle returns to the sector that the levels show.
- What is not known of R_s, L_s and psi_f is part of the noise of e_d and e_q, as far as it is not learned.
- Edges that are further off than P says raise a doubt, a factor of the variance that is told. Where P, or that doubt,
  leaves no more than the sector, the angle that is told moves towards the sector's middle; the filter's own does not.
- A rotor at rest may be anywhere between two edges, so its variance is at most that of a uniform distribution. If no
  edge has come for `hall_timeout` and the speed is below `omega_v`, the angle moves to the middle of the sector.
- `edge_lessons` learns once per electrical revolution. This module learns the angle of each edge within a shaft
  revolution, above omega_b / 2, where a single edge has little weight beside the back-EMF.

It uses the raw levels of the sensors (`hall_levels`), and so works with two sensors or one. Its angles begin at the
ideal edge of sector 0, `hall_offset`, until they meet the stator's frame. It never uses the front end's sector or
speed, an encoder, or a torque of the shaft. docs/edge-kalman.md has equations, results and limits.

Source: (3), (5) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367, for the back-EMF; R. E. Kalman, "A New Approach to
Linear Filtering and Prediction Problems", J. Basic Eng., vol. 82, 1960.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, cast

from sim import legs
from sim.native import zeroed
from sim.numba_cache import kernel
from sim.observers import covariance, edge_lessons, hall_levels, hall_places
from sim.observers.average_speed import FASTEST, centre
from sim.observers.covariance import Five, Symmetric
from sim.observers.edge_lessons import LOW_CURRENT, Four, LegsLoss, Lessons, Sums, Two
from sim.observers.edge_scales import Motor, Scale, make_scale
from sim.observers.hall_edges import HallEdges
from sim.observers.hall_levels import Belief, Levels
from sim.observers.hall_places import DEG, MOST, Twelve
from sim.observers.hall_speed import SECTOR_OF_CODE, SECTOR_WIDTH
from sim.observers.sample import Sample
from sim.observers.transforms import TWO_PI, clip, square, wrap

# Constants. A unit in brackets is a field of `Scale`, which follows from the motor: [v] means "times scale.v, in V".
# With the paper's motor v = 0.131 V, i = 8 A, i_fade = 0.3 A, omega_v = 20 rad/s, omega_b = 300 rad/s, alpha = 14 000
# rad/s2. "tuned": set for small errors on the benches and seeds that docs/edge-kalman.md names for tuning; the command
# `python -m tests.benchmarks edges` measures the result with other seeds. "chosen": set for the reason given.

# Samples. Chosen.
UPDATE_EVERY = 8  # samples from one update of P to the next: most of the cost is there, and 8 keep it affordable
EMF_TAU = 1e-3  # s, filter of i_q and e_q: 16 periods at 16 kHz, against the noise of the current sensors

# Errors of e_d and e_q, standard deviations. Tuned.
EMF_D = 0.15  # [v] error of e_d that repeats with the angle
EMF_Q = 0.12  # [v] the same of e_q
EMF_Q_LOW = 0.5  # [v] more of it below `LOW_CURRENT`, where the dead time's error has another shape
EMF_HARMONICS = 0.0073  # [psi omega] harmonics of the back-EMF, in both
EMF_WHITE = 0.0055  # [i L_s / T_s] of one sample: noise of the currents, differentiated
EMF_NO_CURRENT = 3.0  # [v] more of both without current, where no leg loses what its dead time predicts
NO_CURRENT = 0.12  # [i_fade] current at which half of that is left
ANGLES_REPEATED = 6.0  # 1/rad, chosen: the errors repeat six times per revolution, as the legs commutate
RIPPLE_SPEED = 6.0  # rad/s, below which they are assumed to change no more slowly

# Error b, the slow one of e_q. Tuned.
B_WALK = 0.1  # [v per sqrt(s)] random walk
B_TAU = 0.03  # s in which b is forgotten below `LOW_CURRENT`
B_START = 4.0  # [v_drop] standard deviation at the start; b stays within it
B_RESTART = 0.69  # [v_drop] the least after a restart from an edge

# Acceleration. Tuned.
ALPHA_WALK_SLOW = 0.0029  # [alpha per sqrt(s)] random walk at low speed
ALPHA_WALK_FAST = 0.061  # [alpha per sqrt(s)] at high speed, where e_d shows the angle anyway
ALPHA_WALK_SPEED = 24.0  # [omega_v] half way between the two
ALPHA_WALK_BLIND = 0.4  # [alpha per sqrt(s)] without a voltage: who turns the shaft is not known. On real captures
FEED = 0.9  # share of the acceleration that i_q causes if the inertia is known
TORQUE_WALK = 2.8  # variance of what a change of i_q may cause besides, by the square of its effect
TORQUE_TAU = 0.0063  # s, filter of the i_q from which a change counts
HELD_UP_GAP = 2.0  # times the last interval after which friction or a load may hold the shaft; chosen
TORQUE_DEAD_BAND = 0.0023  # [i] a smaller change is none

# Start, standard deviations.
ANGLE_START = 20.0 * DEG  # rad; derived: a uniform distribution over a sector of 60 deg has 17.3 deg
OMEGA_START = 5.0  # [omega_v] tuned
ALPHA_START = 0.07  # [alpha] tuned; also after a missing edge

# Residues of e_d and e_q as corrections.
EMF_D_FROM = 0.5  # [omega_v] chosen: below it e_d is mostly error, and is not used
CLIP_D = 0.7  # [omega] tuned: largest residue of e_d that counts
CLIP_Q = 2.0  # [omega] tuned: of e_q, up to omega_b
CLIP_SPEED = 1.5  # [omega_v] chosen: the least omega that these two refer to

# Surprise: the residues, filtered, against what they usually are. Tuned unless stated otherwise.
RESIDUE_TAU = 0.00083  # s, filter of the residues
USUAL_TAU = 0.52  # s, filter of their mean squares
USUAL_CLIP = 9.0  # [mean square] chosen: a residue counts as 3 standard deviations at most
USUAL_LEAST = 0.017  # [v] least residue that is usual
USUAL = 7.0  # variance by the mean square
USUAL_D = 92.0  # more of it for e_d at low speed, which has spikes there
USUAL_D_SPEED = 5.4  # [omega_v] up to which that is
SURPRISE = 3.5  # square of a residue by its variance, from which on it is a surprise
SURPRISE_ALPHA = 0.43  # [alpha per sqrt(ms)] by which the acceleration may then be another
SURPRISE_MOST = 1.8  # times that variance at the most
SURPRISE_BACK = 0.0044  # s for which it has been another already
QUIET_BELOW = 1.0  # chosen, as `SURPRISE`: the back-EMF is quiet below one standard deviation
QUIET = 5e-3  # s for which it must be; chosen: several `RESIDUE_TAU`. Also the time in which a lost speed decays

# Edges. Chosen unless stated otherwise.
UNLIKELY = 2.0  # variances beyond which an edge is given up for another change of its level that fits better
GATE = 4.0  # standard deviations beyond which an edge is far off: one in 16 000 is, of a normal distribution
EARLY = 2.0 * DEG  # rad by which an edge must turn the estimate forward to be doubtful, and
EARLY_SIGMA = 2.2  # standard deviations by which it is early, with a quiet back-EMF; until the rotor has turned
DUE = 2.0  # times that angle
DOUBTFUL = 0.25  # of the square of its residue, more variance of an edge whose sensor was disturbed; chosen: half of it
FOLLOWS = 2.0  # times the speed that the largest torque reaches in two sectors: no edge follows one sooner
OVERDUE_GAP = 1.5  # times the last interval after which no edge is early
BOUNCE = 15.0 * DEG  # rad after an edge within which it may bounce: a quarter of a sector
HELD_MOST = 5e-3  # s for which an edge is held if the codes are regular: no pulse is so long
STAYED = 4.0  # times the time after which its level returned: if it has stayed so long, the rotor has turned back
STRONG = 2.5  # [omega_v] speed from which on the back-EMF may be trusted, with
CREDIBLE = 0.3  # [psi omega] at least that much back-EMF along the estimate
SHARP = 8.0  # and the speed this many standard deviations from zero; the rotor does not turn back then, either
MOVED = 2.0 * DEG  # rad by which the edges of a sensor that has moved are off at least, and
MOVED_SIGMA = 3.0  # by that many standard deviations
OVERDUE = 19.0  # standard deviations of an edge by which the angle may pass it; tuned
OVERDUE_FURTHEST = 12.0 * DEG  # rad, but no more; chosen: two standard deviations of an edge that nobody has told
OVERDUE_MOST = 2.5  # rad: beyond it the angle is ambiguous, not late
OVERDUE_OMEGA = 0.3  # [omega] least standard deviation of the speed after a missing edge, with
OVERDUE_OMEGA_LEAST = 0.25  # [omega_v]
RESTART_OMEGA = 0.1  # [omega2, speed by the edges squared] variance of the speed after a restart
RESTART_ALPHA = 0.3  # [speed by the edges over their distance, squared] variance of the acceleration then
KNOWN_VISITS = 2.0  # revolutions that a place must be learned from before its sensor can be said to have moved

# Consistency. Chosen.
UNIFORM = 1.0 / math.sqrt(12.0)  # standard deviation of an angle that is anywhere in a range, by its width
LOST = 80.0 * DEG  # rad that the estimate may turn outside the sector that regular codes show: that of one dead sensor
UNPROVED = 3.0  # doubt at the start: P may be a quarter of what it should be, as long as no edge has shown more
DOUBT_RISES = 0.5  # share of a new one in the mean of the edges' squares, if it is more,
DOUBT_FALLS = 0.15  # and if it is less
DOUBT_MOST = 24.0  # five times the standard deviation
ONCE = 1.0  # doubt that moves nothing yet: of one edge two standard deviations off
INCONSISTENT = 8.0  # doubt that is told: errors are three times as large as the filter expects

# Walk of the acceleration, from edges that err alike. Chosen.
ALIKE = 0.15  # product of two residues in a row, by their variance, that chance may bring: 0 if P is right
ALIKE_MOST = 4.0  # two standard deviations each
WALK_SHARE = 0.05  # of more than that, by which an edge makes the walk larger
WALK_MOST = 1e4  # variance: a hundred times the standard deviation

# Angle of each edge within a shaft revolution, and the edges' scatter. Tuned unless stated otherwise.
OWN_SPREAD = 0.61 * DEG  # rad, standard deviation of these angles; at high speed an edge counts as little as that
OWN_KNOWN = 0.12  # per shaft revolution: how fast they become known
OWN_SHARE = 0.056  # of an edge's residue that is learned, at high speed
OWN_FROM = 0.5  # [omega_b] chosen: speed from which on they are learned; an edge has little weight there
SCATTER_SHARE = 0.011  # of the square of a residue that is learned as scatter
SCATTER_LEAST = 0.018 * DEG  # rad
SCATTER_CLIP = 9.0  # [scatter] chosen: a residue counts as 3 standard deviations at most
LEAST_SAMPLES = 4.0  # in a revolution that anything is learned from; chosen
SETTLED = 12  # edges in a row, one way, before either is learned; chosen: two electrical revolutions

STANDSTILL = 4.0  # [1 / hall_timeout] chosen: rate at which the angle of a rotor at rest moves to the sector's middle
USED, INSTEAD, RETURNED, HELD, REJECTED = range(5)  # what becomes of an edge: used, also in place of the last one; its
# level is that of the sector again, so nothing; it waits for the next one; it is wrong. `Last.off` gets of it:
OFF = (0, 0, 0, 1, 9)
COUNT = len(edge_lessons.LESSONS)
HOLD = 64  # samples for which a lesson is sent
CYCLE = 17  # lessons sent until they start again, the first two twice: prime, so a stream of every n-th sample has all


@dataclass(frozen=True, kw_only=True)
class Settings(Motor, HallEdges):
    """The drive's parameters that it takes; an edge of 0 is not known."""

    hall_timeout: float  # s
    bw_omega_lpf: float  # Hz
    learn_edges: float = 1.0  # 0 keeps everything as it was learned
    edge_sd: float = 0.0087  # rad, standard deviation of an offset that all given edges of a direction share


class Params(NamedTuple):
    """Constants: SI units, electrical angles and speeds."""

    scale: Scale
    a_tau: float  # gains of filters: of i_q and e_q
    a_residue: float  # of their residues
    a_omega: float  # of the estimated speed
    omega_max: float
    timeout: float  # s
    learn: int
    pairs: int  # pole pairs that are told apart, 0: none
    told: Twelve  # given edges, rad, actual minus ideal; 0: not known
    told_sd: float  # rad, standard deviation of an offset that all of a direction share


class Filter(NamedTuple):
    """The Kalman filter."""

    x: Five  # theta, omega, alpha, b, c
    P: Symmetric
    gain_d: Five  # of e_d and e_q, until the next update of P
    gain_q: Five
    since: int  # samples since the last update


class Watch(NamedTuple):
    """What the filter observes of voltage and current besides."""

    i_q: float  # A, filtered
    i_slow: float  # A, filtered with `TORQUE_TAU`
    e_q: float  # V, filtered
    residue_d: float  # rad/s, filtered
    residue_q: float
    sum_d: float  # rad/s, of the residues of e_d since the last edge
    usual_d: float  # rad2/s2, mean squares of the residues
    usual_q: float
    quiet: float  # s since they were larger than that
    weight_d: float  # sum of the weights of e_d since the last update of P
    doubt: float  # squares of the edges' residues by their variances, less 1, averaged: how much too small P has been
    pull: float  # rad, from the estimate towards the middle of the sector, where little but that is known
    variance: float  # rad2, of the angle that is told, but for what all edges share
    walk: float  # variance of the acceleration's walk, by the usual one
    before: float  # rad, residue of the last edge
    out: float  # rad that the estimate has turned outside the sector of the levels, less what it has inside


class Last(NamedTuple):
    """The last edge that was used."""

    passed: int  # edges in a row in one direction: 0, 1, 2, 3 and more
    row: int  # the same without a missing one
    way: int  # +1 or -1
    boundary: int
    at: float  # rad
    age: float  # s
    gap: float  # s from the edge before it
    residue: float  # rad, before it was used; 0: it was likely
    turned: float  # rad by which it has turned the estimate
    sped: float  # rad/s by which it has changed its speed
    off: int  # bits 0-2: sensors with an edge since that was not used and has not returned; 3-5: it was rejected
    held: int  # 1 + sensor of the last of those that were held; 0: it has returned
    next: int  # boundary that follows on it
    next_way: int
    then: float  # s, `age` at its capture
    wait: float  # s from then until it is used


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
    twice: Two  # `edge_lessons.twice_of` at this speed
    six: Four  # `edge_lessons.six_of` at this speed
    told: int  # samples since the first lesson was sent
    lesson: Two  # the one that is being sent, and its standard deviation


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample
    omega: float  # electrical rad/s, low-pass filtered
    sensors: int  # bits 0-2: sensor a, b, c is not believed; bits 3-5: it has moved since the start; bit 6: edges
    # contradict the filter, its angle may be lost
    unused: int  # edges not used so far: pulses, rejected edges, edges of a sensor that is not believed
    sigma: float  # rad, the filter's standard deviation of theta
    lesson: int  # a number in `edge_lessons.LESSONS`, each in turn
    learned: float  # the value learned for this parameter, in its unit
    learned_sd: float  # its standard deviation


class Emf(NamedTuple):
    """Back-EMF of the period that ends at a sample, along and across the estimate at the period's middle."""

    e_d: float  # V
    e_q: float
    i_q: float  # A, mean of the period
    cos: float  # of the estimate
    sin: float
    cos_6: float  # of six times the estimate
    sin_6: float
    lost: LegsLoss


class Edge(NamedTuple):
    """An edge as the filter sees it."""

    boundary: int
    way: int  # +1 or -1
    pair: int  # pole pair
    at: float  # rad, its learned angle
    ago: float  # s from its capture to the sample
    residue: float  # rad, its angle minus the estimate at its capture
    variance: float  # rad2, of `at`
    fast: float  # 0..1, by the speed: near 1 above omega_b
    far: bool  # it lies far from the estimate
    lost: bool  # and so did the last of all sensors
    fate: int  # `USED` …
    wait: float  # s, as in `Last`


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    scale = make_scale(pwm_hz, drive)
    pairs = int(drive.n_p)
    return Params(
        scale=scale,
        a_tau=1.0 - math.exp(-scale.T_s / EMF_TAU),
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
    return zeroed(State)


@kernel
def _primed(params: Params, state: State, sample: Sample) -> State:
    """The state at the first sample: at rest in the middle of the sector that the levels show."""
    scale = params.scale
    theta = wrap(centre(max(SECTOR_OF_CODE[sample.code], 0), 0.0))
    P = covariance.diagonal(
        ANGLE_START**2,
        (OMEGA_START * scale.omega_v) ** 2,
        (ALPHA_START * scale.alpha) ** 2,
        (B_START * scale.v_drop / scale.psi_f) ** 2,
        0.0,
    )
    lessons = edge_lessons.start(scale, params.told, params.told_sd)
    usual_d = (EMF_D * scale.omega_v) ** 2
    usual_q = (EMF_Q * scale.omega_v) ** 2
    return state._replace(
        primed=1,
        i_alpha=sample.i_alpha,
        i_beta=sample.i_beta,
        filter=state.filter._replace(x=(theta, 0.0, 0.0, 0.0, 0.0), P=P),
        watch=state.watch._replace(usual_d=usual_d, usual_q=usual_q, doubt=UNPROVED, walk=1.0, variance=ANGLE_START**2),
        levels=state.levels._replace(code=sample.code),
        lessons=lessons,
        lesson=edge_lessons.lesson(lessons, scale, 0),
    )


@kernel
def _emf(scale: Scale, state: State, sample: Sample, theta: float, omega: float) -> Emf:
    """(5), minus what was learned about current sensors, legs and harmonics."""
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
    e_d = e_alpha * cos + e_beta * sin - (six[0] + six[2]) * c6 - (six[1] - six[3]) * s6
    e_q = e_beta * cos - e_alpha * sin - (six[1] + six[3]) * c6 - (six[2] - six[0]) * s6
    return Emf(e_d, e_q, i_beta * cos - i_alpha * sin, cos, sin, c6, s6, lost)


@kernel
def _summed(sums: Sums, emf: Emf, left_d: float, left_q: float, omega: float, sign: float) -> Sums:
    """The sums with one sample more; `left_d` and `left_q` (V): what the filter does not explain of e."""
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
def _noise(scale: Scale, lessons: Lessons, omega: float, i_q: float) -> Four:
    """Variances of e_d and e_q for a sample and of c (all rad2/s2), and the rate (1/s) at which the errors change."""
    size = abs(omega)
    rate = ANGLES_REPEATED * max(size, RIPPLE_SPEED)
    psi = lessons.drop[0]
    by = 1.0 / (psi * psi)
    alike = SECTOR_WIDTH / (max(size, RIPPLE_SPEED) * scale.T_s)
    wrong_d = size * size * edge_lessons.turned_variance(lessons, scale, omega, i_q) * alike
    wrong_q = edge_lessons.along_variance(lessons, scale, omega, i_q) * by * alike
    emf = square(EMF_HARMONICS * psi * omega)
    white = (EMF_WHITE * scale.i * scale.L_s / scale.T_s) ** 2 * by
    none = square(EMF_NO_CURRENT * scale.v / (1.0 + square(i_q / (NO_CURRENT * scale.i_fade))))
    repeats = (square(EMF_D * scale.v) + none + emf) * by
    fast = max(size / scale.omega_b, 1.0)
    swings = (square(EMF_Q * scale.v) + none + emf) * by
    if abs(i_q) < LOW_CURRENT * scale.i:
        swings += (square(EMF_Q_LOW * scale.v) + lessons.drop_P[3]) * by
    return repeats * (1.0 + 2.0 / (rate * scale.T_s)) + white + wrong_d, white * fast * fast + wrong_q, swings, rate


@kernel
def _propagated(P: Symmetric, t: float, wander: float, b: float, f: float, c: float) -> Symmetric:
    """P after `t` seconds in which alpha, b and c gain these variances, and the share `f` of c is left."""
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
    """P h for e_q."""
    return (
        P[1] + sign * P[3] + P[4],
        P[5] + sign * P[7] + P[8],
        P[6] + sign * P[10] + P[11],
        P[7] + sign * P[12] + P[13],
        P[8] + sign * P[13] + P[14],
    )


@kernel
def _across(P: Symmetric, omega: float) -> Five:
    """P h for e_d."""
    return (P[0] * omega, P[1] * omega, P[2] * omega, P[3] * omega, P[4] * omega)


@kernel
def _ago(P: Symmetric, ago: float) -> Five:
    """P h for the angle `ago` seconds ago."""
    return (P[0] - ago * P[1], P[1] - ago * P[5], P[2] - ago * P[6], P[3] - ago * P[7], P[4] - ago * P[8])


@kernel
def _updated(
    params: Params, kalman: Filter, watch: Watch, lessons: Lessons, noise: Four, driven: bool, held_up: bool
) -> tuple[Filter, Watch]:
    """P after the samples since its last update, with what e_d and e_q told in them, and more if they surprise."""
    scale = params.scale
    omega = kalman.x[1]
    size = abs(omega)
    n = float(kalman.since)
    t = n * scale.T_s
    psi = lessons.drop[0]
    r_d, r_q, swings, rate = noise
    sign = clip(watch.i_q / scale.i_fade, 1.0)
    f = 1.0 / (1.0 + rate * t)
    y = square(size / (ALPHA_WALK_SPEED * scale.omega_v))
    wander = square(scale.alpha * (ALPHA_WALK_SLOW + (ALPHA_WALK_FAST - ALPHA_WALK_SLOW) * y / (1.0 + y)))
    if not driven:
        wander = square(scale.alpha * ALPHA_WALK_BLIND)
    wander *= watch.walk
    change = max(abs(watch.i_q - watch.i_slow) / scale.i - TORQUE_DEAD_BAND, 0.0) * scale.alpha
    wander += TORQUE_WALK * change * change / TORQUE_TAU
    if held_up:
        wander += square(scale.feed * watch.i_q) / TORQUE_TAU
    i_slow = watch.i_slow + t / TORQUE_TAU * (watch.i_q - watch.i_slow)
    unknown = 2.0 * square(watch.i_q - watch.i_slow) * lessons.drop_P[5] / TORQUE_TAU  # by a resistance not known yet
    walk = (square(B_WALK * scale.v) + unknown) * t / (psi * psi)
    P = _propagated(kalman.P, t, wander * t, walk, f, swings * (1.0 - f * f))
    usual_d = watch.usual_d
    usual_q = watch.usual_q
    quiet = watch.quiet
    if driven:
        if size > EMF_D_FROM * scale.omega_v:
            g = _across(P, omega)
            P = covariance.less(P, g, watch.weight_d / (watch.weight_d * g[0] * omega + r_d))
        g = _along(P, sign)
        P = covariance.less(P, g, 1.0 / (g[1] + sign * g[3] + g[4] + r_q / n))
        least = square(USUAL_LEAST * scale.v / psi)
        square_d = watch.residue_d * watch.residue_d
        square_q = watch.residue_q * watch.residue_q
        at = square(square(size / (USUAL_D_SPEED * scale.omega_v)))
        slow = 1.0 / (1.0 + at * at)
        much = square_d / (omega * omega * P[0] + (USUAL + USUAL_D * slow) * max(usual_d, least))
        if size <= scale.omega_b:
            own = P[5] + sign * sign * P[12] + 2.0 * sign * P[7]
            much = max(much, square_q / (own + USUAL * max(usual_q, least)))
        usual_d += t / USUAL_TAU * (min(square_d, USUAL_CLIP * max(usual_d, least)) - usual_d)
        usual_q += t / USUAL_TAU * (min(square_q, USUAL_CLIP * max(usual_q, least)) - usual_q)
        if much > QUIET_BELOW:
            quiet = 0.0
        if much > SURPRISE:
            P = _surprised(
                P, (SURPRISE_ALPHA * scale.alpha) ** 2 * (t / 1e-3) * min(much / SURPRISE - 1.0, SURPRISE_MOST)
            )
    else:
        quiet = 0.0
    b = kalman.x[3]
    if abs(watch.i_q) < LOW_CURRENT * scale.i:
        b /= 1.0 + t / B_TAU
    x = (kalman.x[0], kalman.x[1], kalman.x[2], b, f * kalman.x[4])
    watch = watch._replace(i_slow=i_slow, usual_d=usual_d, usual_q=usual_q, quiet=quiet, weight_d=0.0)
    return kalman._replace(x=x, P=P, since=0), watch


@kernel
def _surprised(P: Symmetric, a: float) -> Symmetric:
    """P if the acceleration may have been different, with the variance `a`, for `SURPRISE_BACK` seconds."""
    y = SURPRISE_BACK
    x = 0.5 * SURPRISE_BACK * SURPRISE_BACK
    return (
        P[0] + a * x * x, P[1] + a * x * y, P[2] + a * x, P[3], P[4],
        P[5] + a * y * y, P[6] + a * y, P[7], P[8],
        P[9] + a, P[10], P[11],
        P[12], P[13],
        P[14],
    )  # fmt: skip


@kernel
def _restarted(scale: Scale, kalman: Filter, psi: float, angle: float, omega: float, alpha: float) -> Filter:
    """The filter with these variances of angle, speed and acceleration, as if nothing else were known of them."""
    b = max(kalman.P[12], square(B_RESTART * scale.v_drop / psi))
    return kalman._replace(P=covariance.diagonal(angle, omega, alpha, b, kalman.P[14]))


@kernel
def _trusted(scale: Scale, kalman: Filter, watch: Watch, psi: float, driven: bool) -> tuple[bool, bool]:
    """Whether the back-EMF is strong, and whether it then gives the speed precisely."""
    omega = kalman.x[1]
    strong = driven and abs(omega) > STRONG * scale.omega_v and watch.e_q * omega > CREDIBLE * psi * omega * omega
    return strong, strong and SHARP * SHARP * kalman.P[5] < omega * omega


@kernel
def _edge(
    params: Params, state: State, sensor: int, before: int, ago: float, late: float, driven: bool, held: bool
) -> tuple[Edge, Belief, Lessons]:
    """An edge of `sensor`, captured `ago` or `late` seconds before the sample, and whether that sensor has moved.

    `before`: the levels until then. `held`: it was held, and its level has not returned.
    """
    scale = params.scale
    kalman, last, belief, lessons = state.filter, state.last, state.belief, state.lessons
    places = lessons.places
    psi = lessons.drop[0]
    omega = kalman.x[1]
    then = kalman.x[0] - ago * omega + 0.5 * ago * ago * kalman.x[2]
    strong, sharp = _trusted(scale, kalman, state.watch, psi, driven)
    sure = sharp and state.watch.quiet > QUIET
    all_off = (last.off | belief.sensors) & hall_levels.ALL == hall_levels.ALL
    regular = hall_levels.regular(state.levels, belief)
    lost = all_off and not (sure and abs(omega) > scale.omega_b) and not (regular and _within(state, then))
    by_codes = last.passed == 0 or lost or not driven or regular
    boundary, way = _boundary(lessons, sensor, before, state.levels.code, then, by_codes)
    slot = hall_places.slot(boundary, way)
    at = hall_places.angle(places, boundary, way) + lessons.common[4] * omega
    pair = hall_places.pair_of(places, params.pairs, last.boundary, last.way, boundary, way)
    at += places.own[pair][boundary]
    z = wrap(at - then)
    speed = abs(omega) / scale.omega_b
    fast = speed * speed / (speed * speed + 1.0)
    unlike = fast + (1.0 / (1.0 + OWN_KNOWN * places.turns) if params.pairs > 0 else 0.0)
    r = places.scatter + places.variance[slot] + OWN_SPREAD * OWN_SPREAD * unlike
    S = kalman.P[0] - 2.0 * ago * kalman.P[1] + ago * ago * kalman.P[5] + r
    z_late = wrap(z - (ago - late) * omega)
    if z * z > UNLIKELY * S and abs(z_late) < abs(z):
        z = z_late
        ago = late
    far = z * z > GATE * GATE * S and not (held and wrap(kalman.x[0] - at) * way > 0.0)
    touched = (state.levels.touched >> sensor) & 1 == 1
    again = boundary == last.boundary and way == last.way and last.age * abs(omega) < math.pi
    back = way * omega < 0.0 and SHARP * SHARP * kalman.P[5] < omega * omega
    if strong and not (again or back or held or touched):
        known = last.passed >= 3 and places.visits[slot] > KNOWN_VISITS
        moves = known and MOVED < abs(z) < hall_places.FURTHEST and z * z > MOVED_SIGMA * MOVED_SIGMA * S
        belief, moved = hall_levels.off_to(belief, sensor, z if moves else 0.0)
        if moved and params.learn != 0:
            lessons = edge_lessons.moved(lessons, sensor, -z)
            z = 0.0
            far = False
    fate = USED
    since = last.age - ago
    overdue = since > OVERDUE_GAP * last.gap and not touched
    apart = since - last.then
    fastest = FOLLOWS * math.sqrt(omega * omega + 4.0 * SECTOR_WIDTH * scale.alpha)
    next_one = last.held > 0 and boundary == last.next and way == last.next_way
    follows = next_one and z * way > 0.0 and fastest * apart > SECTOR_WIDTH
    early = (
        state.watch.quiet > QUIET
        and z * way > EARLY_SIGMA * math.sqrt(S)
        and abs(z) * (kalman.P[0] - ago * kalman.P[1]) > EARLY * S
    )
    short = since * max(abs(omega), scale.omega_v) < BOUNCE
    bounce = short and boundary == last.boundary and way == -last.way and way * omega < 0.0 and not held
    if last.passed > 0 and not lost and (again or back or far or early or bounce):
        if ((state.levels.code ^ hall_levels.beyond(last.boundary, last.way)) >> sensor) & 1 == 0:
            fate = RETURNED
            if again and abs(wrap(last.residue - since * omega)) < abs(last.residue):
                fate = INSTEAD
        elif sure and (back or far):
            fate = REJECTED
        elif bounce or (not (held or overdue or follows) and last.passed > 2 and (back or touched or z * way > 0.0)):
            fate = HELD
    if held or touched:
        r += DOUBTFUL * z * z
    wait = DUE * abs(z) / max(abs(omega), SECTOR_WIDTH / max(last.gap, scale.T_s))
    if bounce and not back:
        wait = STAYED * since
    elif back or far:
        wait = math.inf
    if regular and fastest * since > SECTOR_WIDTH:
        wait = min(wait, HELD_MOST + ago - late)
    return Edge(boundary, way, pair, at, ago, z, r, fast, far, lost, fate, wait), belief, lessons


@kernel
def _corrected_by_edge(params: Params, state: State, edge: Edge) -> State:
    """The state after an edge that is not rejected."""
    scale = params.scale
    kalman, last, lessons = state.filter, state.last, state.lessons
    places = lessons.places
    boundary, way, ago = edge.boundary, edge.way, edge.ago
    since = max(last.age - ago, scale.T_s)
    turned = way != last.way
    row = 0 if turned else last.row
    passed = 0 if turned else last.passed
    speed = abs(kalman.x[1]) / scale.omega_b
    z = edge.residue
    watch = state.watch
    expected = kalman.P[0] - 2.0 * ago * kalman.P[1] + ago * ago * kalman.P[5] + edge.variance
    more = z * z / expected - 1.0 - watch.doubt
    alike = 0.0 if turned or edge.far else clip(z * watch.before / expected, ALIKE_MOST)
    walk = min(max(watch.walk * (1.0 + WALK_SHARE * (edge.fast * alike - ALIKE)), 1.0), WALK_MOST)
    doubt = watch.doubt + more * (DOUBT_RISES if more > 0.0 else DOUBT_FALLS)
    watch = watch._replace(doubt=min(max(doubt, 0.0), DOUBT_MOST), walk=walk, before=z, sum_d=0.0)
    if edge.far:
        kalman, z = _from_edge(scale, kalman, lessons.drop[0], last, edge, passed)
    g = _ago(kalman.P, ago)
    s = 1.0 / (g[0] - ago * g[1] + edge.variance)
    moved_by = s * z * (g[0] - ago * g[1])
    kalman = kalman._replace(x=covariance.added(kalman.x, g, s * z), P=covariance.less(kalman.P, g, s))

    scatter = places.scatter
    if params.learn != 0 and row >= SETTLED:
        known = places.variance[hall_places.slot(boundary, way)]
        seen = clip(z * (z - moved_by) - known, SCATTER_CLIP * scatter)
        scatter = max(scatter + SCATTER_SHARE * (seen - scatter), SCATTER_LEAST * SCATTER_LEAST)
        if params.pairs > 0 and speed > OWN_FROM:
            share = OWN_SHARE * edge.fast * edge.fast
            turned_by = state.watch.sum_d * scale.T_s / (since * kalman.x[1])
            places = hall_places.taught(places, edge.pair, boundary, z, turned_by, share, 1.0 / (6.0 * params.pairs))
    row = row + 1 if boundary == (last.boundary + way) % 6 else 0
    levels = state.levels
    wrong = levels.code ^ hall_levels.beyond(boundary, way)
    dead = 0 if hall_levels.regular(levels, state.belief) else wrong & ~levels.touched
    belief, none = hall_levels.judged(state.belief, dead)
    passed = 0 if none else min(passed + 1, 3)
    places = places._replace(pair=edge.pair, scatter=scatter)
    sums = state.sums
    if params.learn == 0:
        lessons = lessons._replace(places=places)
    else:
        lessons = edge_lessons.met(lessons, places, since)
        sums = sums._replace(off=sums.off + z - 0.5 * moved_by)
    levels = levels._replace(unused=levels.unused - 1, touched=levels.touched & wrong)
    doubtful = z if s * z * z > UNLIKELY else 0.0
    last = Last(
        passed, row, way, boundary, edge.at, ago, since, doubtful, s * z * g[0], s * z * g[1], 0, 0, 0, 0, 0.0, 0.0
    )
    return state._replace(
        filter=kalman, watch=watch, last=last, levels=levels, belief=belief, lessons=lessons, sums=sums
    )


@kernel
def _used_instead(kalman: Filter, last: Last, edge: Edge) -> tuple[Filter, Last]:
    """The filter and its last edge if a pulse was taken for that, and the boundary has been passed by now only."""
    P = covariance.plus(kalman.P, (last.turned**2, last.sped**2, 0.0, 0.0, 0.0))
    g = _ago(P, edge.ago)
    s = 1.0 / (g[0] - edge.ago * g[1] + edge.variance)
    last = last._replace(row=0, age=edge.ago, residue=edge.residue, turned=s * edge.residue * g[0], sped=0.0)
    return kalman._replace(x=covariance.added(kalman.x, g, s * edge.residue), P=covariance.less(P, g, s)), last


@kernel
def _from_edge(scale: Scale, kalman: Filter, psi: float, last: Last, edge: Edge, passed: int) -> tuple[Filter, float]:
    """The filter at an edge far from its estimate, and the residue (rad) left; `passed`: edges in a row before it."""
    x = kalman.x
    z = edge.residue
    if edge.lost:
        omega = x[1]
        kalman = _restarted(
            scale, kalman, psi, edge.variance, RESTART_OMEGA * omega * omega + scale.omega_v**2, kalman.P[9]
        )
        return kalman._replace(x=(x[0] + z, x[1], x[2], x[3], x[4])), 0.0
    since = max(last.age - edge.ago, scale.T_s)
    if passed > 0:
        v = wrap(edge.at - last.at) / since
        variance = RESTART_OMEGA * v * v + RESTART_OMEGA * square(z / since)
        kalman = _restarted(scale, kalman, psi, edge.variance, variance, RESTART_ALPHA * square(v / since))
        return kalman._replace(x=(x[0] + z + edge.ago * (v - x[1]), v, 0.0, x[3], x[4])), 0.0
    P = kalman.P
    P = covariance.diagonal(P[0] + z * z, P[5] + square(z / since), P[9], P[12], P[14])
    return kalman._replace(P=P), z


@kernel
def _boundary(lessons: Lessons, sensor: int, before: int, code: int, theta: float, by_codes: bool) -> tuple[int, int]:
    """Boundary and way of the edge of `sensor` from the levels `before` to `code`.

    Sensor and level leave two boundaries. The codes decide if both are legal and `by_codes` is set; otherwise the
    boundary nearer to `theta` is taken.
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
def _revolution(scale: Scale, state: State, way: int) -> tuple[Lessons, Filter]:
    """What a revolution teaches, and the filter: what the learned drop takes over is removed from b."""
    kalman = state.filter
    i_q = state.watch.i_q
    x = kalman.x
    was = edge_lessons.along(state.lessons, scale, x[1], i_q)
    lessons = edge_lessons.turn(state.lessons, state.sums, scale, way, 0)
    if abs(i_q) <= LOW_CURRENT * scale.i:
        return lessons, kalman
    more = edge_lessons.along(lessons, scale, x[1], i_q) - was
    b = x[3] - more / lessons.drop[0] * clip(i_q / scale.i_fade, 1.0)
    return lessons, kalman._replace(x=(x[0], x[1], x[2], b, x[4]))


@kernel
def _sector(lessons: Lessons, sector: int) -> tuple[float, float]:
    """Middle (rad) and width of a sector, between the edges by which it is left."""
    lo = lessons.places.actual[sector + 6]
    hi = SECTOR_WIDTH + lessons.places.actual[(sector + 1) % 6]
    return sector * SECTOR_WIDTH + 0.5 * (lo + hi), hi - lo


@kernel
def _within(state: State, theta: float) -> bool:
    """Whether an angle lies in the sector that the levels show, or little beside it."""
    middle, width = _sector(state.lessons, SECTOR_OF_CODE[state.levels.code])
    return abs(wrap(theta - middle)) < 0.5 * width + OVERDUE_FURTHEST


@kernel
def _limits(state: State) -> tuple[float, float, float]:
    """Middle and width of where the rotor is by the levels, and the variance of the edge that it would leave by.

    A width of 0: nothing limits it.
    """
    last, belief, levels, places = state.last, state.belief, state.levels, state.lessons.places
    if hall_levels.regular(levels, belief):
        sector = SECTOR_OF_CODE[levels.code]
        middle, width = _sector(state.lessons, sector)
        leaves = (sector + 1) % 6 if wrap(state.filter.x[0] - middle) > 0.0 else sector + 6
        return middle, width, places.variance[leaves]
    if last.passed == 0:
        return 0.0, 0.0, 0.0
    ahead = hall_levels.following(belief, last.boundary, last.way)
    if ((levels.code ^ hall_levels.beyond(ahead, last.way)) >> hall_levels.OWNER[ahead]) & 1 == 0:  # it came early
        ahead = hall_levels.following(belief, ahead, last.way)
    width = hall_places.width(places, last.boundary, ahead, last.way)
    return last.at + 0.5 * last.way * width, width, places.variance[hall_places.slot(ahead, last.way)]


@kernel
def _bounded(scale: Scale, state: State, t: float, sharp: bool, driven: bool) -> State:
    """The state between two edges, `t` s since the last time: the angle does not pass one that has not come.

    Unless the speed is `sharp`; and then only to where the next edge should have come as well.
    """
    kalman, last, watch, belief = state.filter, state.last, state.watch, state.belief
    regular = hall_levels.regular(state.levels, belief)
    middle, width, variance = _limits(state)
    if width == 0.0:
        return state._replace(watch=watch._replace(pull=0.0, variance=kalman.P[0]))
    theta, omega, alpha, b, c = kalman.x
    edge = math.sqrt(state.lessons.places.scatter + variance)
    most = min(OVERDUE * edge, OVERDUE_FURTHEST)
    x = wrap(theta - middle)
    side = 1.0 if x > 0.0 else -1.0
    past = abs(x) - 0.5 * width - scale.T_s * abs(omega)
    over = past - most
    turned = t * max(abs(omega), scale.omega_v)
    out = watch.out + turned if past > (most if sharp else edge) and regular else max(watch.out - turned, 0.0)
    doubt = watch.doubt
    sure = sharp and watch.quiet > QUIET and abs(omega) > scale.omega_b
    if out > LOST + QUIET * abs(omega) and not sure:
        kalman, last = _in_sector(scale, kalman, last, state.lessons, SECTOR_OF_CODE[state.levels.code])
        belief = belief._replace(doubts=(0, 0, 0))
        out = 0.0
        doubt = max(doubt, INCONSISTENT + 1.0)
    elif 0.0 < over < OVERDUE_MOST and not sharp and last.off == 0:
        fastest = width / max(last.age, scale.T_s)
        if last.passed > 1 and omega * side > fastest:
            omega = side * fastest
        if last.passed < 2:
            omega *= 1.0 - UPDATE_EVERY * scale.T_s / QUIET
        if alpha * side > 0.0:
            alpha = 0.0
        P = kalman.P
        P = covariance.diagonal(
            max(P[0], DEG * DEG, square(min(0.5 * out, UNIFORM * width))),
            max(P[5], square(OVERDUE_OMEGA * omega) + (OVERDUE_OMEGA_LEAST * scale.omega_v) ** 2),
            max(P[9], (ALPHA_START * scale.alpha) ** 2),
            P[12],
            P[14],
        )
        kalman = kalman._replace(x=(theta - side * over, omega, alpha, b, c), P=P)
    kalman = _between(kalman, middle, width)
    pull, variance = _told(kalman, doubt, middle, width if regular and driven else 0.0)
    if past > 0.0 and kalman.x[1] * side > 0.0 and square(kalman.x[1]) > 4.0 * kalman.P[5]:
        variance += min(past / most, 1.0) * square(0.5 * width)  # an edge is overdue: a dead sensor leaves it out
    watch = watch._replace(out=out, doubt=doubt, pull=pull, variance=variance)
    return state._replace(filter=kalman, last=last, belief=belief, watch=watch)


@kernel
def _told(kalman: Filter, doubt: float, middle: float, width: float) -> tuple[float, float]:
    """By how much the angle that is told differs from the filter's (rad), and its variance.

    Where the filter knows no more than the sector, `width` rad about its `middle`, that is told; `width` 0: no sector,
    or no voltage, where what turns the shaft is unknown, P is wide, and yet most shafts go on as they did.
    """
    variance = kalman.P[0] * (1.0 + doubt)
    if width == 0.0:
        return 0.0, variance
    most = square(UNIFORM * width)
    share = min(kalman.P[0] / most, 1.0)
    more = max(doubt - ONCE, 0.0)
    share *= share + (1.0 - share) * more / (1.0 + more)
    off = wrap(middle - kalman.x[0])
    variance = min(variance, most)
    return share * off, variance + variance / most * (most - variance + square((1.0 - share) * off))


@kernel
def _between(kalman: Filter, middle: float, width: float) -> Filter:
    """The filter where the angle is anywhere in a sector, `width` rad about its `middle`: no less is known of it."""
    most = width * width / 12.0  # variance
    if kalman.P[0] > most:
        g = _ago(kalman.P, 0.0)
        s = 1.0 / (g[0] + most * g[0] / (g[0] - most))
        z = wrap(middle - kalman.x[0])
        kalman = kalman._replace(x=covariance.added(kalman.x, g, s * z), P=covariance.less(kalman.P, g, s))
    return kalman


@kernel
def _in_sector(scale: Scale, kalman: Filter, last: Last, lessons: Lessons, sector: int) -> tuple[Filter, Last]:
    """The filter after rejected edges, or after none where some should have come: the rotor is in `sector`."""
    middle, width = _sector(lessons, sector)
    way = last.way if last.way != 0 else 1
    boundary = sector if way > 0 else (sector + 1) % 6
    at = hall_places.angle(lessons.places, boundary, way)
    x = kalman.x
    omega = x[1]
    variance = kalman.P[5] + scale.omega_v**2
    alpha = kalman.P[9]
    if last.off == 0 and last.age > 0.0:
        omega = clip(omega, 0.5 * width / last.age)
        variance = min(variance, square(width / last.age))
        alpha = min(alpha, square(2.0 * width / square(last.age)))
    if abs(wrap(x[0] - middle)) > 0.5 * width:
        b = square(B_START * scale.v_drop / lessons.drop[0])
        P = covariance.diagonal(ANGLE_START**2, variance, alpha, b, kalman.P[14])
        kalman = kalman._replace(x=(middle, omega, 0.0, x[3], 0.0), P=P)
    return kalman, Last(1, 0, way, boundary, at, last.age, 0.0, 0.0, 0.0, 0.0, 0, 0, 0, 0, 0.0, 0.0)


@kernel
def _with_gains(scale: Scale, kalman: Filter, noise: Four, i_q: float) -> Filter:
    """The filter with the gains of its P, for the next `UPDATE_EVERY` samples."""
    omega = kalman.x[1]
    sign = clip(i_q / scale.i_fade, 1.0)
    r_d, r_q, _, _ = noise
    d = _across(kalman.P, omega)
    q = _along(kalman.P, sign)
    return kalman._replace(
        gain_d=covariance.times(1.0 / (UPDATE_EVERY * omega * d[0] + r_d), d),
        gain_q=covariance.times(1.0 / (UPDATE_EVERY * (q[1] + sign * q[3] + q[4]) + r_q), q),
    )


@kernel
def _corrected(params: Params, state: State, sample: Sample, driven: bool) -> State:
    """The state a period later, predicted and corrected by e_d and e_q with the gains in force."""
    scale = params.scale
    T_s = scale.T_s
    lessons, kalman, watch, sums, last = state.lessons, state.filter, state.watch, state.sums, state.last
    psi = lessons.drop[0]
    theta = kalman.x[0] + T_s * kalman.x[1] + 0.5 * T_s * T_s * kalman.x[2]
    omega = kalman.x[1] + T_s * kalman.x[2]
    size = abs(omega)
    emf = _emf(scale, state, sample, theta + sample.hall_offset, omega)
    i_q = watch.i_q + params.a_tau * (emf.i_q - watch.i_q)
    x = (theta, omega, kalman.x[2] + FEED * scale.feed * (i_q - watch.i_q), kalman.x[3], kalman.x[4])
    sign = clip(i_q / scale.i_fade, 1.0)
    residue_d = watch.residue_d
    residue_q = watch.residue_q
    sum_d = watch.sum_d
    if driven:
        by_psi = 1.0 / psi
        z_d = -emf.e_d * by_psi - omega * edge_lessons.turned(lessons, scale, i_q)
        left = (emf.e_q - lessons.drop[1] * sign - lessons.drop[2] * emf.i_q) * by_psi - omega - x[3] * sign
        z_q = left - x[4]
        residue_d += params.a_residue * (z_d - residue_d)
        sum_d += z_d
        residue_q += params.a_residue * (left - residue_q)
        if params.learn != 0:
            sums = _summed(sums, emf, emf.e_d, psi * left, omega, clip(emf.i_q / scale.i_fade, 1.0))
        most = max(size, CLIP_SPEED * scale.omega_v)
        if size > EMF_D_FROM * scale.omega_v:
            x = covariance.added(x, kalman.gain_d, emf.lost.weight * clip(z_d, CLIP_D * most))
        x = covariance.added(x, kalman.gain_q, clip(z_q, CLIP_Q * most) if size <= scale.omega_b else z_q)
    e_q = watch.e_q + params.a_tau * (emf.e_q - watch.e_q)
    quiet = watch.quiet + T_s
    weight_d = watch.weight_d + emf.lost.weight
    watch = watch._replace(
        i_q=i_q, e_q=e_q, residue_d=residue_d, residue_q=residue_q, sum_d=sum_d, quiet=quiet, weight_d=weight_d
    )
    kalman = kalman._replace(x=x, since=kalman.since + 1)
    state = state._replace(i_alpha=sample.i_alpha, i_beta=sample.i_beta, filter=kalman, watch=watch, sums=sums)
    return state._replace(last=last._replace(age=last.age + T_s))


@kernel
def _settled(params: Params, state: State, sensor: int, before: int, ago: float, late: float, driven: bool) -> State:
    """The state with P updated, after an edge of `sensor` (-1: none) from the levels `before`.

    It was captured `ago` seconds before the sample or, if that fits better, `late` seconds.
    """
    scale = params.scale
    t = scale.T_s * state.filter.since
    noise = _noise(scale, state.lessons, state.filter.x[1], state.watch.i_q)
    held_up = state.last.passed == 0 or state.last.age > HELD_UP_GAP * state.last.gap
    kalman, watch = _updated(params, state.filter, state.watch, state.lessons, noise, driven, held_up)
    state = state._replace(filter=kalman, watch=watch)
    last = state.last
    held = sensor < 0 and last.held > 0
    if held:
        ago = late = last.age - last.then
        if ago > last.wait:
            sensor = last.held - 1
            before = state.levels.code ^ 1 << sensor
    if sensor >= 0 and hall_levels.believed(state.belief, sensor):
        edge, belief, lessons = _edge(params, state, sensor, before, ago, late, driven, held)
        state = state._replace(belief=belief, lessons=lessons)
        if edge.fate != USED:
            off = last.off & ~(9 << sensor) | OFF[edge.fate] << sensor
            last = last._replace(off=off, held=0 if last.held == sensor + 1 else last.held)
            if edge.fate == INSTEAD:
                kalman, last = _used_instead(kalman, last, edge)
            elif edge.fate == HELD:
                last = last._replace(held=sensor + 1, next=(edge.boundary + edge.way) % 6, next_way=edge.way)
                last = last._replace(then=last.age - edge.ago, wait=edge.wait)
            levels = state.levels._replace(touched=state.levels.touched | 1 << sensor)
            state = state._replace(filter=kalman, last=last, levels=levels)
        else:
            state = _corrected_by_edge(params, state, edge)
            if params.learn != 0 and edge.boundary == 0:
                if state.last.row >= edge_lessons.ROW and state.sums.n >= LEAST_SAMPLES:
                    lessons, kalman = _revolution(scale, state, edge.way)
                    state = state._replace(lessons=lessons, filter=kalman)
                state = state._replace(sums=zeroed(Sums))
    kalman, last, lessons = state.filter, state.last, state.lessons
    psi = lessons.drop[0]
    _, sharp = _trusted(scale, kalman, watch, psi, driven)
    sector = SECTOR_OF_CODE[state.levels.code]
    if last.off > hall_levels.ALL and sector >= 0 and not sharp:
        kalman, last = _in_sector(scale, kalman, last, lessons, sector)
    state = _bounded(scale, state._replace(filter=kalman, last=last), t, sharp, driven)
    kalman, last = state.filter, state.last
    kalman = _with_gains(scale, kalman, noise, watch.i_q)
    twice = edge_lessons.twice_of(lessons, scale, kalman.x[1])
    six = edge_lessons.six_of(lessons, scale, kalman.x[1])
    return state._replace(filter=kalman, last=last, twice=twice, six=six)


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    if state.primed == 0:
        state = _primed(params, state, sample)
        theta = state.filter.x[0] + sample.hall_offset  # wrapped by hand: one `wrap` more slows each step by 20 %
        theta -= TWO_PI if theta >= math.pi else -TWO_PI if theta < -math.pi else 0.0
        return state, Estimate(theta, 0.0, 0, 0, ANGLE_START, 0, state.lesson[0], state.lesson[1])
    scale = params.scale
    T_s = scale.T_s
    standing = state.filter.x[0]
    before = state.levels.code
    driven = sample.u_alpha != 0.0 or sample.u_beta != 0.0
    state = _corrected(params, state, sample, driven)
    speed = max(abs(state.filter.x[1]), scale.omega_v)
    levels, sensor, ago, late = hall_levels.read(state.levels, sample, T_s, speed)
    state = state._replace(levels=levels)
    if state.filter.since >= UPDATE_EVERY or sensor >= 0:
        state = _settled(params, state, sensor, before, ago, late, driven)

    lessons, kalman, belief, levels = state.lessons, state.filter, state.belief, state.levels
    theta = wrap(kalman.x[0])
    omega = clip(kalman.x[1], params.omega_max)
    stands = state.last.age > params.timeout and abs(omega) < scale.omega_v
    if stands:
        theta = _at_rest(lessons, levels.code, standing, STANDSTILL * T_s / params.timeout)
    b = clip(kalman.x[3], (B_START * scale.v_drop + scale.R_s * abs(state.watch.i_q)) / lessons.drop[0])
    kalman = kalman._replace(x=(theta, omega, kalman.x[2], b, kalman.x[4]))
    omega_lpf = 0.0 if stands else state.omega_lpf + params.a_omega * (omega - state.omega_lpf)
    told = (state.told + 1) % (HOLD * CYCLE)
    number = (told // HOLD) % COUNT
    lesson = edge_lessons.lesson(lessons, scale, number) if told % HOLD == 0 else state.lesson
    state = state._replace(omega_lpf=omega_lpf, filter=kalman, told=told, lesson=lesson)
    unused = levels.unused - (1 if levels.pending != 0 else 0)
    together = lessons.common_P[0 if state.last.way >= 0 else 5]
    sigma = math.sqrt(max(state.watch.variance, 0.0) + together)
    theta = wrap(theta + (0.0 if stands else state.watch.pull) + sample.hall_offset)
    sensors = belief.sensors | (hall_levels.LOST_BIT if state.watch.doubt > INCONSISTENT else 0)
    return state, Estimate(theta, omega_lpf, sensors, unused, sigma, number, lesson[0], lesson[1])


@kernel
def _at_rest(lessons: Lessons, code: int, theta: float, share: float) -> float:
    """The angle of a rotor that stands: a share nearer to the middle of the sector that the levels show."""
    sector = SECTOR_OF_CODE[code]
    if sector < 0:
        return theta
    middle, _ = _sector(lessons, sector)
    return wrap(theta + share * wrap(middle - theta))
