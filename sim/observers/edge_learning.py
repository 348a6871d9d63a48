"""What is known of the Hall edges: where they lie, how sure that is, and which sensors are to be believed.

Boundary b (0..5) opens sector b when passed upwards and leaves it when passed downwards; each way has a place of its
own, because sensors have hysteresis. A place is learned from the angle that the back-EMF alone shows there:

    r = theta - b * 60 deg = -delta_b + c i_q,

where delta_b is the edge's misplacement and c i_q the angle by which a wrong L_s turns the back-EMF,
c = (L_s - L_s_hat) / psi_f. The two are told apart by a regression within each place: running means of r and i_q, and
from the deviations of all places together one slope

    c = S_ri / (S_ii + prior),    delta_b = c * mean i_q - mean r.

As long as the load has never varied the prior keeps c at zero, and what a wrong L_s does counts as misplacement. S_ri
and S_ii forget only when something new comes in (together, above `S_FULL`): a constant load unlearns nothing. A
deviation enters with at most `CLIP`.

A sensor whose edges all lie more than `MOVED` off, on the same side, `MOVED_EDGES` times running has moved: its four
places follow at once and are learned anew. Not if all three are off alike: that is the back-EMF's error.

A sensor whose level contradicts the edges of the others is not believed; it is again once it has been right for a
while. Levels are compared at accepted edges only, where the angle is known best.

Never measures an angle and never corrects one (that is `learned_edges`'s).

The misplacement is that of Table I of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367. The regression is the "within"
estimator of panel data: Y. Mundlak, "On the Pooling of Time Series and Cross Section Data", Econometrica, 1978.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.hall_speed import SECTOR_OF_CODE, SECTOR_WIDTH
from sim.observers.transforms import TWO_PI, clip, wrap

Twelve = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""A value for each place: boundaries 0..5 passed upwards, then 0..5 passed downwards."""
Three = tuple[int, int, int]

CODE_OF_SECTOR = (1, 3, 2, 6, 4, 5)
RISES = (5, 1, 3)  # boundary where the output of sensor a, b, c rises, passed upwards; it falls three further on
OWNER = (2, 1, 0, 2, 1, 0)  # sensor that changes at a boundary
DEG = math.pi / 180.0

HORIZON = 256.0  # visits, at full weight, that a place's means reach back over
ENOUGH = 8.0  # visits after which a place counts as learned
GIVEN = 16.0  # visits that a place given as a parameter is worth
FURTHEST = 30.0 * DEG  # largest misplacement
CLIP = 1.5 * DEG
MOVED = 2.0 * DEG
MOVED_EDGES = 6
S_PRIOR = 10.0  # A²
S_FULL = 400.0  # A²
WRONG = 4  # doubt that a wrong level adds; a right one takes 1 away
DISBELIEF = 8  # doubt from which a sensor is not believed, until there is none
DOUBT_MAX = 24
BY_CODES, NEARER, BY_SPEED = 0, 1, 2  # how the boundary of an edge is found
ALL = 7  # the sensors' bits
MOVED_BIT = 8  # of sensor a


class Edges(NamedTuple):
    """What is known."""

    mean_r: Twelve  # rad
    mean_i: Twelve  # A
    visits: Twelve  # weight of the means
    c: float  # rad/A
    s_ri: float  # rad A
    s_ii: float  # A²
    streaks: Three  # edges in a row, by sensor, that lay off upwards (counted up) or downwards (counted down)
    doubts: Three  # by sensor
    sensors: int  # bits 0-2: sensor a, b, c is not believed; bits 3-5: it has moved
    learned: int  # places learned


@kernel
def start(given: Twelve) -> Edges:
    """Nothing learned yet: the places given, as r (rad), 0 meaning that one is not known."""
    zeros = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    visits = zeros
    for k in range(12):
        if given[k] != 0.0:
            visits = _with(visits, k, GIVEN)
    return Edges(given, zeros, visits, 0.0, 0.0, 0.0, (0, 0, 0), (0, 0, 0), 0, _learned(visits))


@kernel
def _learned(visits: Twelve) -> int:
    count = 0
    for k in range(12):
        if visits[k] >= ENOUGH:
            count += 1
    return count


@kernel
def _with(values: Twelve, k: int, value: float) -> Twelve:
    """`values` with another k-th one."""
    return (
        value if k == 0 else values[0],
        value if k == 1 else values[1],
        value if k == 2 else values[2],
        value if k == 3 else values[3],
        value if k == 4 else values[4],
        value if k == 5 else values[5],
        value if k == 6 else values[6],
        value if k == 7 else values[7],
        value if k == 8 else values[8],
        value if k == 9 else values[9],
        value if k == 10 else values[10],
        value if k == 11 else values[11],
    )


@kernel
def _with3(values: Three, k: int, value: int) -> Three:
    return (value if k == 0 else values[0], value if k == 1 else values[1], value if k == 2 else values[2])


@kernel
def _slot(boundary: int, way: int) -> int:
    return boundary if way > 0 else boundary + 6


@kernel
def delta(edges: Edges, boundary: int, way: int) -> float:
    """Misplacement, ideal less actual angle (rad), of the edge at `boundary` passed upwards (way 1) or downwards."""
    slot = _slot(boundary, way)
    return edges.c * edges.mean_i[slot] - edges.mean_r[slot]


@kernel
def place(edges: Edges, boundary: int, way: int) -> float:
    """Angle (rad, not wrapped) of the edge at `boundary` passed upwards (`way` 1) or downwards (-1)."""
    return boundary * SECTOR_WIDTH - delta(edges, boundary, way)


@kernel
def believed(edges: Edges, sensor: int) -> bool:
    """Whether the edges of a sensor (0..2) are to be used."""
    return (edges.sensors >> sensor) & 1 == 0


@kernel
def ahead(edges: Edges, boundary: int, way: int) -> tuple[float, float]:
    """Middle (rad, wrapped) and half of the stretch (rad) from `boundary` on to the next edge that is believed."""
    following = (boundary + way) % 6
    for _ in range(2):
        if not believed(edges, OWNER[following]):
            following = (following + way) % 6
    here = place(edges, boundary, way)
    width = way * (place(edges, following, way) - here)
    width -= TWO_PI * math.floor(width / TWO_PI)
    return wrap(here + 0.5 * way * width), 0.5 * width


@kernel
def met(edges: Edges, sensor: int, before: int, code: int, theta: float, omega: float, how: int) -> tuple[int, int]:
    """Boundary and way of the edge of `sensor` that led from the levels `before` to `code`, near the angle `theta`.

    `how`: `BY_CODES`, if both are legal; `NEARER` of the two boundaries, 180 deg apart, that sensor and level leave;
    or the one that is passed with the sign of `omega`, `BY_SPEED`.
    """
    up = RISES[sensor] if (code >> sensor) & 1 == 1 else (RISES[sensor] + 3) % 6
    down = (up + 3) % 6
    was = SECTOR_OF_CODE[before]
    now = SECTOR_OF_CODE[code]
    if how == BY_CODES and was >= 0 and now >= 0:
        upwards = (was + 1) % 6 == now
    elif how == BY_SPEED:
        upwards = omega >= 0.0
    else:
        upwards = abs(wrap(place(edges, up, 1) - theta)) <= abs(wrap(place(edges, down, -1) - theta))
    return (up, 1) if upwards else (down, -1)


@kernel
def _moved(edges: Edges, sensor: int, streaks: Three, odd: float) -> Edges:
    """The edges with a sensor's four places shifted by `odd` (rad), to be learned anew."""
    mean_r = edges.mean_r
    visits = edges.visits
    for k in range(12):
        if OWNER[k % 6] == sensor:
            mean_r = _with(mean_r, k, clip(mean_r[k] + odd, FURTHEST))
            visits = _with(visits, k, 0.0)
    return Edges(
        mean_r,
        edges.mean_i,
        visits,
        edges.c,
        edges.s_ri,
        edges.s_ii,
        _with3(streaks, sensor, 0),
        edges.doubts,
        edges.sensors | (MOVED_BIT << sensor),
        _learned(visits),
    )


@kernel
def learn(edges: Edges, boundary: int, way: int, r: float, i_q: float, weight: float) -> Edges:
    """The edges after one was met at `boundary`, with the residual `r` (rad) at the q current `i_q` (A).

    `weight`, 0..1: how far the angle in `r` is to be relied on. The first visit of a place sets it; it sets the same
    boundary passed the other way too, as long as that is not known.
    """
    slot = _slot(boundary, way)
    sensor = OWNER[boundary]
    visits = edges.visits[slot]
    dr = wrap(r - edges.mean_r[slot])
    di = i_q - edges.mean_i[slot]
    odd = dr - edges.c * di
    streak = 0
    if visits >= ENOUGH and abs(odd) > MOVED:
        side = 1 if odd > 0.0 else -1
        streak = max(edges.streaks[sensor] * side, 0) * side + side
    streaks = _with3(edges.streaks, sensor, streak)
    if abs(streak) >= MOVED_EDGES and (streaks[0] == 0 or streaks[1] == 0 or streaks[2] == 0):
        return _moved(edges, sensor, streaks, odd)
    mean_r = edges.mean_r
    mean_i = edges.mean_i
    counts = edges.visits
    c = edges.c
    s_ri = edges.s_ri
    s_ii = edges.s_ii
    if abs(dr + mean_r[slot]) <= FURTHEST:
        if visits == 0.0:
            mean_r = _with(mean_r, slot, mean_r[slot] + dr)
            mean_i = _with(mean_i, slot, i_q)
        else:
            if visits >= ENOUGH:
                dr = c * di + clip(odd, CLIP)
            gain = weight / (visits + weight)
            mean_r = _with(mean_r, slot, mean_r[slot] + gain * dr)
            mean_i = _with(mean_i, slot, mean_i[slot] + gain * di)
            s_ri += (1.0 - gain) * dr * di
            s_ii += (1.0 - gain) * di * di
            if s_ii > S_FULL:
                s_ri *= S_FULL / s_ii
                s_ii = S_FULL
            c = s_ri / (s_ii + S_PRIOR)
        counts = _with(counts, slot, min(visits + weight, HORIZON))
        other = (slot + 6) % 12
        if counts[other] == 0.0:
            mean_r = _with(mean_r, other, mean_r[slot])
            mean_i = _with(mean_i, other, mean_i[slot])
    return Edges(mean_r, mean_i, counts, c, s_ri, s_ii, streaks, edges.doubts, edges.sensors, _learned(counts))


@kernel
def judge(edges: Edges, code: int, boundary: int, way: int) -> tuple[Edges, bool]:
    """The edges after the levels `code` were read just beyond `boundary`: doubts, and which sensors are believed.

    If none is left that is believed, all are again: it is the angle that was wrong, and the second result is true.
    """
    wrong = code ^ CODE_OF_SECTOR[boundary if way > 0 else (boundary + 5) % 6]
    doubts = edges.doubts
    sensors = edges.sensors
    for k in range(3):
        doubt = min(doubts[k] + WRONG, DOUBT_MAX) if (wrong >> k) & 1 == 1 else max(doubts[k] - 1, 0)
        doubts = _with3(doubts, k, doubt)
        if doubt >= DISBELIEF:
            sensors |= 1 << k
        elif doubt == 0:
            sensors &= ~(1 << k)
    none = sensors & ALL == ALL
    if none:
        sensors -= ALL
        doubts = (0, 0, 0)
    judged = Edges(
        edges.mean_r,
        edges.mean_i,
        edges.visits,
        edges.c,
        edges.s_ri,
        edges.s_ii,
        edges.streaks,
        doubts,
        sensors,
        edges.learned,
    )
    return judged, none
