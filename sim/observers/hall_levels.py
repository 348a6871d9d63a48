"""Hall sensors by their levels: which edge it was, which sensors are believed, which have moved.

A level counts once two successive samples have shown it, so a pulse shorter than a period is ignored. If it has changed
to and fro before, within `RETURN`, its edge may be the first change, before a bounce, or the last, after a pulse: the
angle decides. A sensor and its new level leave two boundaries, 180 deg apart. Boundary b (0..5) opens sector b if it is
passed upwards.

A sensor whose level contradicts the edges of the others is not believed until it has been right for a while. Levels are
compared at accepted edges only, where the angle is known best, and only if a level has become wrong by not changing: a
dead sensor does not change, one that is disturbed does. A sensor has moved if `MOVED_EDGES` successive edges of it are
off by the same angle; not if all three sensors are off, because then the back-EMF is wrong.

This module never estimates an angle.

Source: codes of Fig. 1 of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.native import with_item
from sim.numba_cache import kernel
from sim.observers.sample import Sample

Three = tuple[int, int, int]
Ages = tuple[float, float, float]

CODE_OF_SECTOR = (1, 3, 2, 6, 4, 5)
RISES = (5, 1, 3)  # boundary where the output of sensor a, b, c rises, passed upwards; it falls three further on
OWNER = (2, 1, 0, 2, 1, 0)  # sensor that changes at a boundary
ALL = 7  # bits of the three sensors that are not believed
MOVED_BIT = 8  # bit of sensor a that it has moved
LOST_BIT = 64  # edges contradict the filter

RETURN = math.radians(30.0)  # rad by which a bounce may delay a level; chosen: half a sector
ALIKE = math.radians(2.0)  # rad by which edges that are off alike differ; chosen: three standard deviations and more

# Chosen, in edges: a stuck sensor is wrong at half of all edges, and a pulse over a whole sector at one or two.
MOVED_EDGES = 6  # off alike before a sensor counts as moved: three electrical revolutions
ODD = 6  # changes of a level after an illegal code before the codes are believed again: an electrical revolution
WRONG = 4  # doubt that a wrong level adds; a right one takes 1 away
DISBELIEF = 10  # doubt from which on a sensor is not believed, until there is none left
DOUBT_MAX = 24  # largest doubt: a sensor is believed again after that many right levels


class Levels(NamedTuple):
    """What the inputs show."""

    code: int  # levels that two successive samples have shown
    pending: int  # bits of the sensors that differ from it in the last sample
    recent: int  # bits of the sensors that have lately, or do
    first: Ages  # s since these sensors did for the first time
    late: Ages  # s since they did last
    touched: int  # bits of the sensors that have changed without an edge being used, and not been right since
    odd: int  # changes after which the codes are believed again: an illegal one shows a dead sensor in each revolution
    unused: int  # edges not used so far; a pending one counts


class Belief(NamedTuple):
    """Which sensors are believed; all are, if all is zero."""

    doubts: Three  # by sensor
    streaks: Three  # by sensor: successive edges that were off alike
    offs: Ages  # rad by which the last edge of each was
    sensors: int  # bits 0-2: sensor a, b, c is not believed; bits 3-5: it has moved


@kernel
def read(levels: Levels, sample: Sample, T_s: float, speed: float) -> tuple[Levels, int, float, float]:
    """The levels after a sample, the sensor whose level is a new one (-1: none), s since it changed first and last.

    `speed`: size of the rotor's, rad/s. If several levels are new, the others follow with the next samples.
    """
    wrong = sample.code ^ levels.code
    if wrong == 0 and sample.edges == 0 and levels.recent == 0:
        return levels, -1, 0.0, 0.0
    unused = levels.unused + sample.edges
    recent = levels.recent
    firsts = levels.first
    lates = levels.late
    sensor = -1
    for k in range(3):
        bit = 1 << k
        first = firsts[k] + T_s
        late = lates[k] + T_s
        if levels.pending & bit == 0:
            late = sample.ages[k]
            if late < 0.0 and wrong & bit != 0:  # an edge that was not captured
                late = 0.5 * T_s
                unused += 1
            if recent & bit == 0 or first * speed > RETURN:
                first = late
                recent = recent | bit if late >= 0.0 else recent & ~bit
        elif wrong & bit != 0 and (sensor < 0 or first > firsts[sensor]):
            sensor = k
        firsts = with_item(firsts, k, first)
        lates = with_item(lates, k, late)
    bit = 1 << sensor if sensor >= 0 else 0
    touched = levels.touched | (recent & ~wrong)
    code = levels.code ^ bit
    odd = ODD if code == 0 or code == ALL else max(levels.odd - 1, 0) if sensor >= 0 else levels.odd
    levels = Levels(code, wrong & ~bit, recent & ~bit, firsts, lates, touched, odd, unused)
    return levels, sensor, firsts[max(sensor, 0)], lates[max(sensor, 0)]


@kernel
def rising(sensor: int, code: int) -> int:
    """The boundary of the edge of `sensor` to the levels `code` if passed upwards; downwards it is 3 further."""
    return RISES[sensor] if (code >> sensor) & 1 == 1 else (RISES[sensor] + 3) % 6


@kernel
def believed(belief: Belief, sensor: int) -> bool:
    """Whether the edges of a sensor (0..2) are to be used."""
    return (belief.sensors >> sensor) & 1 == 0


@kernel
def regular(levels: Levels, belief: Belief) -> bool:
    """Whether the levels show the sector for certain, but for a pulse: all sensors believed, no illegal code lately."""
    return levels.odd == 0 and belief.sensors & ALL == 0 and 0 < levels.code < ALL


@kernel
def following(belief: Belief, boundary: int, way: int) -> int:
    """The next boundary whose sensor is believed."""
    found = (boundary + way) % 6
    for _ in range(2):
        if not believed(belief, OWNER[found]):
            found = (found + way) % 6
    return found


@kernel
def beyond(boundary: int, way: int) -> int:
    """The levels beyond `boundary`, passed upwards (`way` 1) or downwards (-1)."""
    return CODE_OF_SECTOR[boundary if way > 0 else (boundary + 5) % 6]


@kernel
def judged(belief: Belief, wrong: int) -> tuple[Belief, bool]:
    """The belief after the levels of the sensors with a bit in `wrong` contradicted an edge.

    If no sensor would be believed any more, the angle was wrong: all are believed again, and the second result is true.
    """
    doubts = belief.doubts
    sensors = belief.sensors
    for k in range(3):
        doubt = min(doubts[k] + WRONG, DOUBT_MAX) if (wrong >> k) & 1 == 1 else max(doubts[k] - 1, 0)
        doubts = with_item(doubts, k, doubt)
        if doubt >= DISBELIEF:
            sensors |= 1 << k
        elif doubt == 0:
            sensors &= ~(1 << k)
    none = sensors & ALL == ALL
    if none:
        sensors -= ALL
        doubts = (0, 0, 0)
    return belief._replace(doubts=doubts, sensors=sensors), none


@kernel
def off_to(belief: Belief, sensor: int, off: float) -> tuple[Belief, bool]:
    """The belief after an edge that was `off` (rad) or not (0), and whether its sensor has moved."""
    streak = belief.streaks[sensor] + 1 if abs(off - belief.offs[sensor]) < ALIKE else 1
    streaks = with_item(belief.streaks, sensor, streak if off != 0.0 else 0)
    belief = belief._replace(streaks=streaks, offs=with_item(belief.offs, sensor, off))
    if streaks[sensor] < MOVED_EDGES or (streaks[0] != 0 and streaks[1] != 0 and streaks[2] != 0):
        return belief, False
    return belief._replace(streaks=(0, 0, 0), sensors=belief.sensors | (MOVED_BIT << sensor)), True
