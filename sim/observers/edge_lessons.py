"""What one electrical revolution teaches about Hall edges, inductance, voltage drop and current sensors.

Lessons are learned once per revolution, from sums over it, and only if the revolution can separate one cause from
another:

1. The edges' angles relative to one another, from their times alone. Over two revolutions the angle is taken as a
   parabola through 0, 2 pi and 4 pi. Nothing is learned while the speed changes.
2. The offset that all edges share. The mean angle of the back-EMF over the revolution, minus that of the edges, is

       y = offset of this direction + c_1 i + c_3 i^3 + tau omega.

   c_1 comes from a wrong L_s, c_3 from iron that saturates, tau from the delay of Hall sensors and their filters. They
   are found by recursive least squares: what one speed and one load cannot separate stays uncertain and changes
   nothing.
3. The voltage along the rotor: e_q = psi omega + drop sat(i_q) + dR i_q, in the same way, with omega from the times of
   the edges. Not below a tenth of the largest current, where the dead time's error has another shape.
4. Offset and gain of the current sensors, from the part of e that repeats once per revolution (a constant vector of the
   stator: the offset) and twice per revolution (the gain: -k (R_s + L_s d/dt) conj i). Least mean squares.
5. The voltage that the three legs lose, each against its own current, in two shapes. One fades below i_fade, like a
   compensation of the dead time. The other fades below the switching ripple, like the dead time itself: a leg whose
   current changes its sign within a period loses nothing. Both are learned from their harmonics, which no resistance
   and no flux linkage has; then the second is known at any current. Recursive least squares.
6. The 5th and 7th harmonics of the back-EMF, which repeat six times per revolution in the rotor's frame and are
   proportional to the speed. Least mean squares; slowly at low speed and current, where 5 is larger.

4 to 6 learn from what the filter does not explain of e. 1 to 3 use nothing that the filter has corrected, except its
mean over the revolution, which `edge_kalman` hands over completely. So no angle confirms itself.

What was learned is sent as better values of the drive's parameters `LESSONS`, each with its standard deviation.

Source: angle and size of the back-EMF by (3), (5) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim import legs
from sim.legs import Along
from sim.native import with_item, zeroed
from sim.numba_cache import kernel
from sim.observers import covariance, hall_places
from sim.observers.covariance import Five, Symmetric
from sim.observers.edge_scales import Scale
from sim.observers.hall_edges import EDGES
from sim.observers.hall_places import DEG, Places, Six, Twelve
from sim.observers.hall_speed import SECTOR_WIDTH
from sim.observers.transforms import TWO_PI, clip, square

LESSONS = (*EDGES, "psi_f_hat", "R_s_hat", "L_s_hat")
"""The drive's parameters that it learns better values of."""

Two = tuple[float, float]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]

# Constants, as in `edge_kalman`: a unit in brackets is a field of `Scale`; "tuned" and "chosen" mean the same as there.

# When a revolution is good enough. Chosen.
ROW = 13  # edges in a row, one way: the ends of two revolutions
UNEVEN = 0.006  # of the time of two revolutions by which they may differ for the edges to be compared
STEADY = 0.02  # share by which the mean speed may be wrong, or two revolutions may differ, for lessons 2 and 3
ROUGH = 0.1  # the same for lessons 4 to 6
SLOWEST = 1.0  # [omega_v] speed below which lessons 1 and 2 are left out
SEEN = 0.3  # [psi omega] least mean of e_q for lesson 2
LOW_CURRENT = 0.1  # [i] below it lesson 3 is left out, and e_q is less certain: the dead time's error is another there
ENOUGH = (
    0.2  # variance of what is still open, by that of an observation, below which the same again would add noise only
)

# Angles of the edges. Tuned unless stated otherwise.
VISITS = 200.0  # revolutions that the mean of a relative angle reaches back over at most; chosen
MOVED = 1.0 * DEG  # rad, chosen: uncertainty that is added to the shared offset once a sensor has moved
DRIFT = 1e-9  # rad2 per revolution, chosen: shared offsets are never certain for good
APART = 0.3  # s, chosen: revolutions closer than this count as one observation, their errors are the same
C_1 = 0.4  # [L_s / psi_f] standard deviation of c_1 at the start: of what L_s may be wrong by
C_3 = 0.081  # rad at [i], the same of c_3
LATE = 5e-6  # s, the same of tau; chosen: delay of a sensor and its filter

# Error of the mean angle of the back-EMF over a revolution. Tuned.
EMF_V = 0.072  # [v] across the rotor
EMF_DARK = 0.067  # [v] more at low speed and current
EMF_DARK_AT = 100.0  # by the square of i_q / [i]: half of it is left at a tenth of [i]
EMF_LEGS = 0.03  # of what the legs lose; chosen
EMF_A = 0.15 * DEG  # rad
EMF_LOW = 0.69 * DEG  # rad, more at no current
LOW_AT = 64.0  # by the square of i_q / [i]: half of it is left at an eighth of [i]. Also for `DROP_LOW`

# e_q over a revolution. Tuned unless stated otherwise.
PSI_OFF = 0.4  # [psi_f] standard deviation of psi at the start; chosen
PSI_MOST = 0.75  # [psi_f] by which psi may be wrong at most; chosen
DROP = 2.3  # [v] standard deviation of the drop at the start
R_OFF = 0.5  # [R_s] the same of dR; chosen: copper that is 125 K warmer
DROP_V = 0.03  # [v] error of the mean
DROP_LOW = 0.38  # [v] more of it at no current
DROP_PSI = 0.003  # [psi omega] more of it
PSI_DRIFT = 0.0005  # [psi_f per sqrt(s)] random walks
DROP_DRIFT = 0.015  # [v per sqrt(s)]
R_DRIFT = 0.003  # [R_s per sqrt(s)]
FAR = 4.0  # standard deviations beyond which drop and dR have changed and are learned anew; chosen
ANOTHER = 0.03  # share of speed and of [i] within which an operating point is the same; chosen

# Current sensors and harmonics of the back-EMF. Tuned unless stated otherwise.
MEMORY = 64.0  # revolutions over which the first lessons are averaged; chosen
RIPPLE = 0.014  # per revolution, least gain of offset and gain of the sensors
RIPPLE_FIRST = 0.7  # of the plain average of the first ones; chosen: the filter's own angle is still wrong
SIX = 0.074  # per revolution, least gain of the harmonics
SIX_LEAST = 1.7  # [omega_b2] square of the speed below which they are learned more slowly

# Voltage that the legs lose. Tuned unless stated otherwise.
LEGS_START = 3.7  # [v] standard deviation of each shape at the start
LEGS_WANDER = 0.04  # [v per sqrt(s)] random walk
LEGS_ERROR = 0.15  # [v] error of a sample
LEGS_EMF = 0.32  # [psi omega] more of it, until the harmonics of the back-EMF are known
LEGS_TIMES = 5.4  # times per revolution that this error is another one
CLOSE = 1.5  # times the current below which a leg's loss fades by the ripple: a leg with less is uncertain; chosen
CLOSE_V = 0.3  # [v] loss of the second shape that halves the weight of e_d then; chosen
OPEN = 8.0  # times the same current: if all legs together have less, each sample counts; chosen


class Sums(NamedTuple):
    """Over the samples of a revolution."""

    n: float
    e_d: float  # V
    e_q: float
    i_q: float  # A
    omega: float  # rad/s
    sign: float  # of i_q, fading below i_fade
    off: float  # rad, over its edges: residue before and after the correction, the mean of both
    fixed: Two  # V, what the filter does not explain of e, in the stator's frame: alpha, beta
    twice: Two  # the same, turned backwards once more
    six: Four  # the same in the rotor's frame, times e^{6 j theta} and e^{-6 j theta}
    legs: Along  # the same along the shapes of the legs' loss


class LegsLoss(NamedTuple):
    """What legs lose if each loses 1 V in one of the shapes: alpha, beta."""

    full: (
        Two  # harmonics of the shape that fades below i_fade; the part that turns with the current belongs to the drop
    )
    near: Two  # harmonics of the shape that fades below the ripple, minus the first
    whole: Two  # the same with the part that turns with the current
    weight: float  # of e_d: less if a leg's current is so small that its loss is uncertain


class Lessons(NamedTuple):
    """What was learned."""

    places: Places
    gaps: Twelve  # s between the last thirteen edges, newest last
    common: Five  # offset upwards, offset downwards, rad; c_1, rad/A; c_3, rad/A at i; tau, s
    common_P: Symmetric
    ways: int  # bit 0: `common` was learned upwards, bit 1: downwards
    drop: Three  # psi, V s; drop, V; dR, ohm
    drop_P: Six
    at: Two  # rad/s and A, operating point at which these were learned last
    offset: Two  # V, R_s times the currents' offset
    gain: Two  # k
    six: Four  # V at omega_b
    lost: Two  # V, of each shape of `LegsLoss`
    lost_P: Three  # V2, its covariance
    turns: float


@kernel
def start(scale: Scale, told: Twelve, sd: float) -> Lessons:
    """Nothing learned yet; places as given, `sd` (rad): standard deviation of an offset that all of a way share."""
    up = hall_places.known(told, 0)
    down = hall_places.known(told, 1)
    offset_up = hall_places.mean(told, 0) if up else 0.0
    offset_down = hall_places.mean(told, 1) if down else 0.0
    legs_start = square(LEGS_START * scale.v)
    return zeroed(Lessons)._replace(
        places=hall_places.start(told, sd),
        common=(offset_up, offset_down, 0.0, 0.0, 0.0),
        common_P=covariance.diagonal(
            sd * sd if up else hall_places.UNKNOWN**2,
            sd * sd if down else hall_places.UNKNOWN**2,
            (C_1 * scale.L_s / scale.psi_f) ** 2,
            (C_3 / scale.i) ** 2,
            LATE**2,
        ),
        ways=(1 if up else 0) | (2 if down else 0),
        drop=(scale.psi_f, 0.0, 0.0),
        drop_P=((PSI_OFF * scale.psi_f) ** 2, 0.0, 0.0, (DROP * scale.v) ** 2, 0.0, (R_OFF * scale.R_s) ** 2),
        lost_P=(legs_start, 0.0, legs_start),
    )


@kernel
def turned(lessons: Lessons, scale: Scale, i_q: float) -> float:
    """Angle (rad) by which the winding's own flux turns the back-EMF at `i_q` (A)."""
    x = i_q / scale.i
    return i_q * (lessons.common[2] + lessons.common[3] * x * x)


@kernel
def along(lessons: Lessons, scale: Scale, omega: float, i_q: float) -> float:
    """e_q as learned, V."""
    return lessons.drop[0] * omega + lessons.drop[1] * clip(i_q / scale.i_fade, 1.0) + lessons.drop[2] * i_q


@kernel
def turned_variance(lessons: Lessons, scale: Scale, omega: float, i_q: float) -> float:
    """Of that angle beside the edges' (rad2): of what the inductance may be wrong by, if nothing else is known."""
    x = i_q / scale.i
    P = lessons.common_P
    alone = i_q * i_q * (P[9] + square(x * x) * P[12])
    h = _common(omega, i_q, x)
    g = covariance.across(P, h)
    return min(alone, g[0] * h[0] + g[1] * h[1] + g[2] * h[2] + g[3] * h[3] + g[4] * h[4])


@kernel
def along_variance(lessons: Lessons, scale: Scale, omega: float, i_q: float) -> float:
    """Of e_q as learned (V2), but for what changes slowly: of what the flux linkage may be wrong by, if nothing else is
    known."""
    sign = clip(i_q / scale.i_fade, 1.0)
    P = lessons.drop_P
    g0, g1, g2 = _across(P, omega, sign, i_q)
    return min(omega * omega * P[0], omega * g0 + sign * g1 + i_q * g2)


@kernel
def lesson(lessons: Lessons, scale: Scale, number: int) -> tuple[float, float]:
    """Learned value of the parameter of this number in `LESSONS`, and its standard deviation, in its unit."""
    psi = lessons.drop[0]
    if number < 12:
        value = -lessons.places.actual[number]
        together = lessons.common_P[0 if number < 6 else 5]
        variance = lessons.places.variance[number] - min(together, hall_places.TOLD**2) + together
        variance = min(variance, hall_places.UNKNOWN**2)
    elif number == 12:
        value = psi
        variance = lessons.drop_P[0]
    elif number == 13:
        value = scale.R_s + lessons.drop[2]
        variance = lessons.drop_P[5]
    else:
        value = scale.L_s + lessons.common[2] * psi
        variance = lessons.common_P[9] * psi * psi
    return value, math.sqrt(max(variance, 0.0))


@kernel
def lost(lessons: Lessons, scale: Scale, u: float, i_alpha: float, i_beta: float) -> LegsLoss:
    """The shapes of a period with a voltage of size u (V) and these mean currents (A)."""
    per_fade = 1.0 / scale.i_fade
    per_ripple = legs.per_ripple(u, scale.L_s / scale.T_s, per_fade)
    size = math.sqrt(i_alpha * i_alpha + i_beta * i_beta)
    wide = legs.shape(i_alpha, i_beta, size, per_fade)
    narrow = legs.shape(i_alpha, i_beta, size, per_ripple)
    full = legs.harmonics(wide, i_alpha, i_beta)
    near = legs.harmonics(narrow, i_alpha, i_beta)
    weight = 1.0
    if size * per_ripple > OPEN:
        half = 0.5 * i_alpha
        more = legs.HALF_SQRT3 * i_beta
        if min(abs(i_alpha), abs(more - half), abs(more + half)) * per_ripple < CLOSE:
            weight = 1.0 / (1.0 + square(lessons.lost[1] / (CLOSE_V * scale.v)))
    whole = (narrow.alpha - wide.alpha, narrow.beta - wide.beta)
    return LegsLoss(full, (near[0] - full[0], near[1] - full[1]), whole, weight)


@kernel
def _legs_learned(lessons: Lessons, sums: Sums, scale: Scale, omega: float) -> tuple[Two, Three]:
    """What the legs lose in each shape (V), and its covariance, after a revolution."""
    sigma = (square(LEGS_ERROR * scale.v) + square(LEGS_EMF * scale.psi_f * omega)) / LEGS_TIMES
    more = square(LEGS_WANDER * scale.v) * sums.n * scale.T_s
    full, near, P = legs.solved(lessons.lost_P, sums.legs, square(LEGS_START * scale.v), more, 1.0 / (sums.n * sigma))
    return (lessons.lost[0] + full, lessons.lost[1] + near), P


@kernel
def six_of(lessons: Lessons, scale: Scale, omega: float) -> Four:
    """The back-EMF's harmonics, V: factors of e^{-6 j theta} and e^{6 j theta}, real and imaginary."""
    a = lessons.six
    x = omega / scale.omega_b
    return x * a[0], x * a[1], x * a[2], x * a[3]


@kernel
def twice_of(lessons: Lessons, scale: Scale, omega: float) -> Two:
    """k (R_s - j omega L_s): a wrong gain adds this times conj i to e, with its sign turned."""
    re, im = lessons.gain
    x = -omega * scale.L_s
    return re * scale.R_s - im * x, re * x + im * scale.R_s


@kernel
def met(lessons: Lessons, places: Places, gap: float) -> Lessons:
    """The lessons after an edge, `gap` seconds after the one before it, which changed the places to these."""
    w = lessons.gaps
    gaps = (w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8], w[9], w[10], w[11], gap)
    return lessons._replace(places=places, gaps=gaps)


@kernel
def moved(lessons: Lessons, sensor: int, by: float) -> Lessons:
    """The lessons after a sensor has moved `by` (rad): the places of its edges, and so the shared offset."""
    places = hall_places.shifted(lessons.places, sensor, by)
    relative = places.relative
    up = hall_places.mean(relative, 0)
    down = hall_places.mean(relative, 1)
    for k in range(6):
        relative = with_item(relative, k, relative[k] - up)
        relative = with_item(relative, k + 6, relative[k + 6] - down)
    c = lessons.common
    return lessons._replace(
        places=places._replace(relative=relative),
        common=(c[0] + up, c[1] + down, c[2], c[3], c[4]),
        common_P=covariance.plus(lessons.common_P, (MOVED**2, MOVED**2, 0.0, 0.0, 0.0)),
    )


@kernel
def turn(lessons: Lessons, sums: Sums, scale: Scale, way: int, boundary: int) -> Lessons:
    """The lessons after a revolution that ends at `boundary`, with another one before it."""
    w = lessons.gaps
    T0 = w[0] + w[1] + w[2] + w[3] + w[4] + w[5]
    T1 = w[6] + w[7] + w[8] + w[9] + w[10] + w[11]
    omega = way * 2.0 * TWO_PI / (T0 + T1)
    places = lessons.places
    if abs(T0 - T1) < UNEVEN * (T0 + T1) and abs(omega) > SLOWEST * scale.omega_v:
        places = _compared(places, w, omega / scale.omega_b, way, boundary)
    n = sums.n
    i_q = sums.i_q / n
    mean = sums.omega / n
    common = lessons.common
    common_P = lessons.common_P
    ways = lessons.ways
    wrong = abs(T1 * abs(mean) - TWO_PI)
    seen = sums.e_q * mean > SEEN * lessons.drop[0] * mean * mean * n
    if wrong < STEADY * TWO_PI and abs(mean) > SLOWEST * scale.omega_v and seen:
        y = sums.off / 6.0 + sums.e_d / (n * lessons.drop[0] * mean)
        for k in range(6):
            y -= places.actual[k if way > 0 else k + 6] / 6.0
        common, common_P = _common_learned(lessons, scale, mean, i_q, -y, max(1.0, APART / T1))
        ways |= 1 if way > 0 else 2
        places = _placed(places, common, common_P, ways)
    drop = lessons.drop
    drop_P = lessons.drop_P
    at = lessons.at
    if abs(i_q) > LOW_CURRENT * scale.i and abs(T1 - T0) < STEADY * T1:
        at = _operating_point(lessons.at, scale, way * TWO_PI / T1, i_q)
        drop, drop_P = _drop_learned(lessons, scale, way * TWO_PI / T1, sums.sign / n, i_q, sums.e_q / n, T1, at)
    lessons = lessons._replace(places=places, common=common, common_P=common_P, ways=ways)
    lessons = lessons._replace(drop=drop, drop_P=drop_P, at=at)
    if wrong < ROUGH * TWO_PI and abs(T1 - T0) < ROUGH * T1:
        lessons = _ripple_learned(lessons, sums, scale, mean, i_q)
    return lessons


@kernel
def _compared(places: Places, w: Twelve, speed: float, way: int, boundary: int) -> Places:
    """The relative places by the times between thirteen edges; `speed` by omega_b."""
    T0 = w[0] + w[1] + w[2] + w[3] + w[4] + w[5]
    T1 = w[6] + w[7] + w[8] + w[9] + w[10] + w[11]
    b = TWO_PI * (T0 - T1) / (T1 + T0) / (T0 * T1)
    a = (TWO_PI - b * T1 * T1) / T1
    found = hall_places.ZERO_12
    mean = 0.0
    t = -T0
    for k in range(12):
        off = way * (a * t + b * t * t - (k - 6) * SECTOR_WIDTH)
        found = with_item(found, k, off)
        mean += off / 12.0
        t += w[k]
    weight = speed * speed / (speed * speed + 1.0)
    relative = places.relative
    visits = places.visits
    for k in range(6):
        slot = hall_places.slot((boundary + way * k) % 6, way)
        off = 0.5 * (found[k] + found[k + 6]) - mean
        so_far = min(visits[slot] + weight, VISITS)
        visits = with_item(visits, slot, so_far)
        relative = with_item(relative, slot, relative[slot] + weight / so_far * (off - relative[slot]))
    return places._replace(relative=relative, visits=visits)


@kernel
def _common(omega: float, i_q: float, x: float) -> Five:
    """h: what the mean angle of the back-EMF contains of `Lessons.common`."""
    up = 1.0 if omega > 0.0 else 0.0
    return up, 1.0 - up, i_q, x * x * i_q, omega


@kernel
def _common_learned(
    lessons: Lessons, scale: Scale, omega: float, i_q: float, y: float, times: float
) -> tuple[Five, Symmetric]:
    """`common` and its covariance after the mean angle of the back-EMF was y (rad) from that of the edges.

    `times`: how many such observations count as one.
    """
    x = i_q / scale.i
    fast = omega / scale.omega_b
    dark = 1.0 / ((1.0 + EMF_DARK_AT * x * x) * (1.0 + fast * fast))
    legs_lose = abs(lessons.lost[0]) + abs(lessons.lost[1])
    volts = ((EMF_V + EMF_DARK * dark) * scale.v + EMF_LEGS * legs_lose) / (lessons.drop[0] * omega)
    angle = EMF_A + EMF_LOW / (1.0 + LOW_AT * x * x)
    h = _common(omega, i_q, x)
    g = covariance.across(lessons.common_P, h)
    c = lessons.common
    unsure = g[0] * h[0] + g[1] * h[1] + g[2] * h[2] + g[3] * h[3] + g[4] * h[4]
    r = (volts**2 + angle**2) * times
    if unsure < ENOUGH * r:
        return c, lessons.common_P
    s = 1.0 / (unsure + r)
    y -= c[0] * h[0] + c[1] * h[1] + c[2] * h[2] + c[3] * h[3]
    P = covariance.plus(covariance.less(lessons.common_P, g, s), (DRIFT, DRIFT, 0.0, 0.0, 0.0))
    return covariance.added(c, g, s * y), P


@kernel
def _placed(places: Places, common: Five, common_P: Symmetric, ways: int) -> Places:
    """The places from relative places and offsets; a way that was never met is taken from the other one."""
    actual = places.actual
    variance = places.variance
    for k in range(12):
        other = (k + 6) % 12
        relative = 0.0
        alone = hall_places.UNKNOWN**2
        if places.visits[k] > 0.0:
            relative = places.relative[k]
            alone = hall_places.ONE**2 / places.visits[k]
        elif places.visits[other] > 0.0:
            relative = places.relative[other]
            alone = hall_places.TOLD**2
        up = k < 6
        if (ways >> (0 if up else 1)) & 1 == 0:
            up = not up
        actual = with_item(actual, k, relative + (common[0] if up else common[1]))
        together = min(common_P[0] if up else common_P[5], hall_places.TOLD**2)
        variance = with_item(variance, k, alone + together)
    return places._replace(actual=actual, variance=variance)


@kernel
def _across(P: Six, omega: float, sign: float, i_q: float) -> Three:
    """P h, where h is what e_q contains of psi, drop and dR."""
    return (
        P[0] * omega + P[1] * sign + P[2] * i_q,
        P[1] * omega + P[3] * sign + P[4] * i_q,
        P[2] * omega + P[4] * sign + P[5] * i_q,
    )


@kernel
def _operating_point(at: Two, scale: Scale, omega: float, i_q: float) -> Two:
    """The operating point that e_q is learned for: the one before, unless speed or current are different.

    If edges differ from pole pair to pole pair, each revolution seems to have a speed of its own. Taken literally, a
    minute at one speed would then show that e_q does not depend on the speed at all.
    """
    if abs(omega - at[0]) < ANOTHER * abs(omega) and abs(i_q - at[1]) < ANOTHER * scale.i:
        return at
    return omega, i_q


@kernel
def _drop_learned(
    lessons: Lessons, scale: Scale, omega: float, sign: float, i_q: float, e_q: float, seconds: float, at: Two
) -> tuple[Three, Six]:
    """psi, drop and dR, and their covariance, after a revolution with this mean e_q (V), as if at the point `at`."""
    x = i_q / scale.i
    low = DROP_LOW / (1.0 + LOW_AT * x * x)
    sigma = (DROP_V + low) * scale.v + DROP_PSI * lessons.drop[0] * abs(omega)
    P = lessons.drop_P
    a, b, c = lessons.drop
    off = e_q - omega * a - sign * b - i_q * c
    omega, i_q = at
    g0, g1, g2 = _across(P, omega, sign, i_q)
    unsure = omega * g0 + sign * g1 + i_q * g2
    if off * off > FAR * FAR * (unsure + sigma * sigma):
        P = (P[0], 0.0, 0.0, (DROP * scale.v) ** 2, 0.0, (R_OFF * scale.R_s) ** 2)
        g0, g1, g2 = _across(P, omega, sign, i_q)
        unsure = omega * g0 + sign * g1 + i_q * g2
    if unsure < ENOUGH * sigma * sigma:
        return lessons.drop, P
    s = 1.0 / (unsure + sigma * sigma)
    y = s * off
    psi = scale.psi_f + clip(a + g0 * y - scale.psi_f, PSI_MOST * scale.psi_f)
    return (psi, b + g1 * y, c + g2 * y), (
        P[0] - s * g0 * g0 + (PSI_DRIFT * a) ** 2 * seconds,
        P[1] - s * g0 * g1,
        P[2] - s * g0 * g2,
        P[3] - s * g1 * g1 + (DROP_DRIFT * scale.v) ** 2 * seconds,
        P[4] - s * g1 * g2,
        P[5] - s * g2 * g2 + (R_DRIFT * scale.R_s) ** 2 * seconds,
    )


@kernel
def _ripple_learned(lessons: Lessons, sums: Sums, scale: Scale, omega: float, i_q: float) -> Lessons:
    """Lessons 4 to 6, from what the filter did not explain of e in a revolution."""
    turns = min(lessons.turns + 1.0, MEMORY)
    n = sums.n
    share = max(RIPPLE_FIRST / turns, RIPPLE)
    offset = (lessons.offset[0] + share * sums.fixed[0] / n, lessons.offset[1] + share * sums.fixed[1] / n)
    gain = lessons.gain
    if i_q != 0.0:
        share *= i_q * i_q / (i_q * i_q + (LOW_CURRENT * scale.i) ** 2)
        x = -omega * scale.L_s
        re = sums.twice[0] / n
        im = sums.twice[1] / n
        share /= (scale.R_s * scale.R_s + x * x) * i_q
        gain = (gain[0] - share * (im * scale.R_s - re * x), gain[1] + share * (re * scale.R_s + im * x))
    lost, lost_P = _legs_learned(lessons, sums, scale, omega)
    x = omega / scale.omega_b
    share = x * max(1.0 / turns, SIX) / ((x * x + SIX_LEAST) * n)
    y = square(square(i_q / (LOW_CURRENT * scale.i)))
    share *= y / (y + 1.0)
    s = sums.six
    a = lessons.six
    six = (a[0] + share * s[0], a[1] + share * s[1], a[2] + share * s[2], a[3] + share * s[3])
    return lessons._replace(offset=offset, gain=gain, six=six, lost=lost, lost_P=lost_P, turns=turns)
