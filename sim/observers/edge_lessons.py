"""What an electrical turn teaches of the Hall edges, the inductance, the voltage drop and the current sensors.

Learned once a turn, from sums over it, and only where the turn tells one thing from another:

1. How the edges lie to one another, from their times alone: over two turns the angle is a parabola through 0, 2 pi and
   4 pi. Where the speed is not steady, nothing.
2. Where all of them lie together. The back-EMF's mean angle over the turn, less that of the edges, is

       y = place of this way + c_1 i + c_3 i^3 + tau omega,

   c_1 by a wrong L_s, c_3 by iron that saturates, tau because Hall sensors and their filters answer late. Recursive
   least squares: what one speed and one load do not tell apart stays unsure, and changes nothing.
3. What of the voltage along the rotor is no back-EMF, e_q = psi omega + drop sat(i_q) + dR i_q: the same way. omega is
   by the edges' times. Not below a tenth of the largest current, where the dead time's error has another shape.
4. Offset and gain of the current sensors, by what they leave in e once (the offset, a constant vector of the stator)
   and twice a turn (the gain: -k (R_s + L_s d/dt) conj i). Least mean squares.
5. What the three legs lose, each against its own current: a voltage that fades below i_fade, as a compensation of the
   dead time does, and one that fades below the switching ripple, as the dead time itself does: a leg whose current
   changes its sign within a period loses nothing. Learned by their harmonics, which no resistance and no flux linkage
   has; the second is then known at any current. Least squares.
6. The back-EMF's 5th and 7th harmonics, six times a turn in the rotor's frame, which go with the speed. Least mean
   squares; little at low speed and current, where 5 is larger.

4 to 6 are learned from what the filter leaves of e, and 1 to 3 from nothing that it has corrected but the mean over
the turn, which `edge_kalman` gives in full: no angle confirms itself.

What was learned is told as better values of the drive's parameters `LESSONS`, each with its standard deviation.

Source: the angle and size of the back-EMF by (3), (5) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim import legs
from sim.legs import Along
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

ROW = 13  # edges running, one way, after which two turns are known
UNEVEN = 0.006  # of two turns' time by which they may differ where their edges are compared
STEADY = 0.02  # of a turn by which the mean speed may be off where the back-EMF's angle counts, and two turns differ
ROUGH = 0.1  # the same where what is left of e is looked at
SLOWEST = 1.0  # omega_v: below it neither edges nor the common place are learned
VISITS = 200.0  # most that a place's mean reaches back over
MOVED = 1.0 * DEG  # how much less is known of where all edges lie after a sensor has moved, rms
DRIFT = 1e-9  # rad2 a turn
ENOUGH = 0.2  # of an observation's variance: where so little is open, the same again teaches nothing but its noise
APART = 0.3  # s: turns closer than this are one observation of the common place
EMF_V = 0.072  # of v: error of the back-EMF's mean angle
EMF_DARK = 0.067  # of v: the same where speed and current are small
EMF_A = 0.15 * DEG
EMF_LOW = 0.69 * DEG  # of it, at no current
C_1 = 0.07  # rad at i: rms of what a wrong L_s does
C_3 = 0.081  # rad at i: of saturation
LATE = 5e-6  # s: of tau
LITTLE = 0.1  # of i: below it nothing is learned of the drop
PSI_OFF = 0.15  # of psi_f, rms at first
PSI_MOST = 0.5  # of psi_f, that it is off at most
FAR = 4.0  # sigma, beyond which drop and dR are no longer what they were
ANOTHER = 0.03  # of speed and largest current: what is no other operation
DROP = 2.3  # of v
R_OFF = 0.5  # of R_s
DROP_V = 0.03  # of v: error of the turn's e_q
DROP_LOW = 0.38  # of v: of it, at no current
DROP_PSI = 0.003  # of psi omega
PSI_DRIFT = 0.0005  # of psi_f, in a root of a second
DROP_DRIFT = 0.015  # of v
R_DRIFT = 0.003  # of R_s
MEMORY = 64.0  # turns over which ripple is a mean at first
RIPPLE = 0.014  # a turn, least gain of offset and gain
SIX = 0.074  # a turn, least gain of the back-EMF's harmonics
SIX_LEAST = 1.7  # (omega / omega_b)2: below it they are learned the more slowly
LEGS_START = 3.7  # of v, rms of what legs lose, at first
LEGS_WANDER = 0.04  # of v, in a root of a second
LEGS_ERROR = 0.15  # of v, of what no shape has
LEGS_EMF = 0.32  # of psi omega: the same, of the harmonics
LEGS_TIMES = 5.4  # a turn, that it is another
CLOSE = 1.5  # of the current below which a leg's loss fades by the ripple: a leg that has less
CLOSE_V = 0.3  # of v, lost beside the ripple, that halves what a sample with one counts
OPEN = 8.0  # of the same: where all legs together have less, each sample counts


class Sums(NamedTuple):
    """Over the samples of a turn."""

    n: float
    e_d: float  # V
    e_q: float
    i_q: float  # A
    omega: float  # rad/s
    sign: float  # of i_q, as the dead time's error has it
    off: float  # rad, over its edges: place less angle before it was corrected, and after, the mean of both
    fixed: Two  # V, what is left of e in the stator's frame: alpha, beta
    twice: Two  # turned once more backwards
    six: Four  # and in the rotor's frame, times e^{6 j theta} and e^{-6 j theta}
    legs: Along  # of what is left of e


class Lost(NamedTuple):
    """What legs lose that lose 1 V of each shape: alpha, beta."""

    full: Two  # harmonics of the shape that fades below i_fade; what turns with the current is the drop's
    near: Two  # of the one that fades below the ripple, less the first
    whole: Two  # the same, with what turns with the current
    weight: float  # of e_d: less where a leg's current is so small that its loss is not known


class Lessons(NamedTuple):
    """What was learned."""

    places: Places
    gaps: Twelve  # s between the last thirteen edges, newest last
    common: Five  # place upwards, downwards, rad; c_1, rad/A; c_3, rad/A at i; tau, s
    common_P: Symmetric
    ways: int  # bit 0: `common` was seen upwards, bit 1: downwards
    drop: Three  # psi, V s; drop, V; dR, ohm
    drop_P: Six
    at: Two  # rad/s and A, where these were learned last
    offset: Two  # V, R_s times the currents' offset
    gain: Two  # k
    six: Four  # V at omega_b
    lost: Two  # V, of each shape of `Lost`
    lost_P: Three  # V2, its covariance
    turns: float


@kernel
def nothing() -> Sums:
    """No sample yet."""
    return Sums(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0, 0.0, 0.0), legs.none())


@kernel
def unprimed() -> Lessons:
    """Room for what `start` gives."""
    return Lessons(
        hall_places.start(hall_places.ZERO_12, 0.0),
        hall_places.ZERO_12,
        (0.0, 0.0, 0.0, 0.0, 0.0),
        covariance.diagonal(0.0, 0.0, 0.0, 0.0, 0.0),
        0,
        (0.0, 0.0, 0.0),
        hall_places.ZERO_6,
        (0.0, 0.0),
        (0.0, 0.0),
        (0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0),
        (0.0, 0.0, 0.0),
        0.0,
    )


@kernel
def start(scale: Scale, told: Twelve, sd: float) -> Lessons:
    """Nothing learned yet; places as they were told, with the standard deviation of all of a way together (rad)."""
    rest = unprimed()
    up = hall_places.known(told, 0)
    down = hall_places.known(told, 1)
    common = covariance.diagonal(
        sd * sd if up else hall_places.UNKNOWN**2,
        sd * sd if down else hall_places.UNKNOWN**2,
        (C_1 / scale.i) ** 2,
        (C_3 / scale.i) ** 2,
        LATE**2,
    )
    drop = ((PSI_OFF * scale.psi_f) ** 2, 0.0, 0.0, (DROP * scale.v) ** 2, 0.0, (R_OFF * scale.R_s) ** 2)
    return Lessons(
        hall_places.start(told, sd),
        rest.gaps,
        (
            hall_places.mean(told, 0) if up else 0.0,
            hall_places.mean(told, 1) if down else 0.0,
            0.0,
            0.0,
            0.0,
        ),
        common,
        (1 if up else 0) | (2 if down else 0),
        (scale.psi_f, 0.0, 0.0),
        drop,
        rest.at,
        rest.offset,
        rest.gain,
        rest.six,
        rest.lost,
        (square(LEGS_START * scale.v), 0.0, square(LEGS_START * scale.v)),
        0.0,
    )


@kernel
def turned(lessons: Lessons, scale: Scale, i_q: float) -> float:
    """By how much the winding's own flux turns the back-EMF at `i_q` (A), rad."""
    x = i_q / scale.i
    return i_q * (lessons.common[2] + lessons.common[3] * x * x)


@kernel
def along(lessons: Lessons, scale: Scale, omega: float, i_q: float) -> float:
    """e_q as learned, V."""
    return lessons.drop[0] * omega + lessons.drop[1] * clip(i_q / scale.i_fade, 1.0) + lessons.drop[2] * i_q


@kernel
def lesson(lessons: Lessons, scale: Scale, number: int) -> tuple[float, float]:
    """Value of the parameter of this number in `LESSONS` as learned, and its standard deviation, in its unit."""
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
def lost(lessons: Lessons, scale: Scale, u: float, i_alpha: float, i_beta: float) -> Lost:
    """In a period with a voltage of size u (V) and these mean currents (A)."""
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
    return Lost(
        full,
        (near[0] - full[0], near[1] - full[1]),
        (narrow.alpha - wide.alpha, narrow.beta - wide.beta),
        weight,
    )


@kernel
def _lost(lessons: Lessons, sums: Sums, scale: Scale, omega: float) -> tuple[Two, Three]:
    """What was learned that the legs lose (V), and its covariance, after a turn; `lost` is of a sample."""
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
    """k (R_s - j omega L_s): what a wrong gain adds to e is this times conj i, with its sign turned."""
    re, im = lessons.gain
    x = -omega * scale.L_s
    return re * scale.R_s - im * x, re * x + im * scale.R_s


@kernel
def met(lessons: Lessons, places: Places, gap: float) -> Lessons:
    """After an edge, `gap` seconds after the one before it."""
    w = lessons.gaps
    return with_places(lessons, places, (w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8], w[9], w[10], w[11], gap))


@kernel
def with_places(lessons: Lessons, places: Places, gaps: Twelve) -> Lessons:
    """The lessons with other places and gaps."""
    return Lessons(
        places,
        gaps,
        lessons.common,
        lessons.common_P,
        lessons.ways,
        lessons.drop,
        lessons.drop_P,
        lessons.at,
        lessons.offset,
        lessons.gain,
        lessons.six,
        lessons.lost,
        lessons.lost_P,
        lessons.turns,
    )


@kernel
def moved(lessons: Lessons, sensor: int, by: float) -> Lessons:
    """After a sensor has moved `by` (rad): its edges' places, and with them where all lie together."""
    places = hall_places.shifted(lessons.places, sensor, by)
    relative = places.relative
    up = hall_places.mean(relative, 0)
    down = hall_places.mean(relative, 1)
    for k in range(6):
        relative = hall_places.with12(relative, k, relative[k] - up)
        relative = hall_places.with12(relative, k + 6, relative[k + 6] - down)
    c = lessons.common
    return Lessons(
        Places(
            relative,
            places.visits,
            places.actual,
            places.variance,
            places.pair,
            places.own,
            places.turns,
            places.scatter,
        ),
        lessons.gaps,
        (c[0] + up, c[1] + down, c[2], c[3], c[4]),
        covariance.plus(lessons.common_P, (MOVED**2, MOVED**2, 0.0, 0.0, 0.0)),
        lessons.ways,
        lessons.drop,
        lessons.drop_P,
        lessons.at,
        lessons.offset,
        lessons.gain,
        lessons.six,
        lessons.lost,
        lessons.lost_P,
        lessons.turns,
    )


@kernel
def turn(lessons: Lessons, sums: Sums, scale: Scale, way: int, boundary: int) -> Lessons:
    """After a whole turn that ends at `boundary`, and another before it."""
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
    seen = sums.e_q * mean > 0.3 * lessons.drop[0] * mean * mean * n
    if wrong < STEADY * TWO_PI and abs(mean) > SLOWEST * scale.omega_v and seen:
        y = sums.off / 6.0 + sums.e_d / sums.e_q
        for k in range(6):
            y -= places.actual[k if way > 0 else k + 6] / 6.0
        common, common_P = _together(lessons, scale, way, mean, i_q, -y, max(1.0, APART / T1))
        ways |= 1 if way > 0 else 2
        places = _placed(places, common, common_P, ways)
    drop = lessons.drop
    drop_P = lessons.drop_P
    at = lessons.at
    if abs(i_q) > LITTLE * scale.i and abs(T1 - T0) < STEADY * T1:
        at = _same(lessons.at, scale, way * TWO_PI / T1, i_q)
        drop, drop_P = _dropped(lessons, scale, way * TWO_PI / T1, sums.sign / n, i_q, sums.e_q / n, T1, at)
    changed = Lessons(
        places,
        w,
        common,
        common_P,
        ways,
        drop,
        drop_P,
        at,
        lessons.offset,
        lessons.gain,
        lessons.six,
        lessons.lost,
        lessons.lost_P,
        lessons.turns,
    )
    if wrong < ROUGH * TWO_PI and abs(T1 - T0) < ROUGH * T1:
        return _rippled(changed, sums, scale, mean, i_q)
    return changed


@kernel
def _compared(places: Places, w: Twelve, speed: float, way: int, boundary: int) -> Places:
    """The edges' places to one another, by the times between thirteen of them; `speed` by omega_b."""
    T0 = w[0] + w[1] + w[2] + w[3] + w[4] + w[5]
    T1 = w[6] + w[7] + w[8] + w[9] + w[10] + w[11]
    b = TWO_PI * (T0 - T1) / (T1 + T0) / (T0 * T1)
    a = (TWO_PI - b * T1 * T1) / T1
    found = hall_places.ZERO_12
    mean = 0.0
    t = -T0
    for k in range(12):
        off = way * (a * t + b * t * t - (k - 6) * SECTOR_WIDTH)
        found = hall_places.with12(found, k, off)
        mean += off / 12.0
        t += w[k]
    weight = speed * speed / (speed * speed + 1.0)
    relative = places.relative
    visits = places.visits
    for k in range(6):
        slot = hall_places.slot((boundary + way * k) % 6, way)
        off = 0.5 * (found[k] + found[k + 6]) - mean
        so_far = min(visits[slot] + weight, VISITS)
        visits = hall_places.with12(visits, slot, so_far)
        relative = hall_places.with12(relative, slot, relative[slot] + weight / so_far * (off - relative[slot]))
    return Places(
        relative,
        visits,
        places.actual,
        places.variance,
        places.pair,
        places.own,
        places.turns,
        places.scatter,
    )


@kernel
def _together(
    lessons: Lessons, scale: Scale, way: int, omega: float, i_q: float, y: float, times: float
) -> tuple[Five, Symmetric]:
    """The edges' common place and what goes with it, after the back-EMF's mean angle was y (rad) beside theirs."""
    x = i_q / scale.i
    fast = omega / scale.omega_b
    dark = 1.0 / ((1.0 + 100.0 * x * x) * (1.0 + fast * fast))
    volts = (EMF_V + EMF_DARK * dark) * scale.v / (lessons.drop[0] * omega)
    angle = EMF_A + EMF_LOW / (1.0 + 64.0 * x * x)
    up = 1.0 if way > 0 else 0.0
    h = (up, 1.0 - up, i_q, x * x * i_q, omega)
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
    """The places by how they lie to one another, and together; one way by the other where it was never met."""
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
        actual = hall_places.with12(actual, k, relative + (common[0] if up else common[1]))
        together = min(common_P[0] if up else common_P[5], hall_places.TOLD**2)
        variance = hall_places.with12(variance, k, alone + together)
    return Places(
        places.relative,
        places.visits,
        actual,
        variance,
        places.pair,
        places.own,
        places.turns,
        places.scatter,
    )


@kernel
def _across(P: Six, omega: float, sign: float, i_q: float) -> Three:
    """P times what a turn sees of psi, drop and dR."""
    return (
        P[0] * omega + P[1] * sign + P[2] * i_q,
        P[1] * omega + P[3] * sign + P[4] * i_q,
        P[2] * omega + P[4] * sign + P[5] * i_q,
    )


@kernel
def _same(at: Two, scale: Scale, omega: float, i_q: float) -> Two:
    """The operation that is learned from: as it was, unless speed or current are another.

    Edges that differ from pole pair to pole pair make a speed of each turn that none had. Taken as it is, it would say,
    in a minute of one speed, that e_q does not go with the speed at all.
    """
    if abs(omega - at[0]) < ANOTHER * abs(omega) and abs(i_q - at[1]) < ANOTHER * scale.i:
        return at
    return omega, i_q


@kernel
def _dropped(
    lessons: Lessons, scale: Scale, omega: float, sign: float, i_q: float, e_q: float, seconds: float, at: Two
) -> tuple[Three, Six]:
    """psi, drop and dR after a turn whose mean e_q was this (V), learned as of the operation `at`."""
    x = i_q / scale.i
    low = DROP_LOW / (1.0 + 64.0 * x * x)
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
def _rippled(lessons: Lessons, sums: Sums, scale: Scale, omega: float, i_q: float) -> Lessons:
    """The lessons after what a turn left of e once, twice and six times."""
    turns = min(lessons.turns + 1.0, MEMORY)
    n = sums.n
    share = max(0.7 / turns, RIPPLE)
    offset = (lessons.offset[0] + share * sums.fixed[0] / n, lessons.offset[1] + share * sums.fixed[1] / n)
    gain = lessons.gain
    if i_q != 0.0:
        share *= i_q * i_q / (i_q * i_q + (LITTLE * scale.i) ** 2)
        x = -omega * scale.L_s
        re = sums.twice[0] / n
        im = sums.twice[1] / n
        share /= (scale.R_s * scale.R_s + x * x) * i_q
        gain = (gain[0] - share * (im * scale.R_s - re * x), gain[1] + share * (re * scale.R_s + im * x))
    lost, lost_P = _lost(lessons, sums, scale, omega)
    x = omega / scale.omega_b
    share = x * max(1.0 / turns, SIX) / ((x * x + SIX_LEAST) * n)
    y = square(square(i_q / (LITTLE * scale.i)))
    share *= y / (y + 1.0)
    s = sums.six
    a = lessons.six
    return Lessons(
        lessons.places,
        lessons.gaps,
        lessons.common,
        lessons.common_P,
        lessons.ways,
        lessons.drop,
        lessons.drop_P,
        lessons.at,
        offset,
        gain,
        (a[0] + share * s[0], a[1] + share * s[1], a[2] + share * s[2], a[3] + share * s[3]),
        lost,
        lost_P,
        turns,
    )
