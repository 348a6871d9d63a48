"""Hall sensors by their levels: which edge it was, which sensors are believed, which have moved.

A level counts once two successive samples have shown it, so a pulse shorter than a period is ignored. A sensor and its
new level leave two boundaries, 180 deg apart. Boundary b (0..5) opens sector b if it is passed upwards.

A sensor whose level contradicts the edges of the others is not believed until it has been right for a while. Levels are
compared at accepted edges only, where the angle is known best. A sensor has moved if `MOVED_EDGES` successive edges of
it are off to the same side; not if all three sensors are off alike, because then the back-EMF is wrong.

This module never estimates an angle.

Source: codes of Fig. 1 of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

from typing import NamedTuple

from sim.native import with_item
from sim.numba_cache import kernel
from sim.observers.sample import Sample

Three = tuple[int, int, int]

CODE_OF_SECTOR = (1, 3, 2, 6, 4, 5)
SENSOR_OF_BIT = (-1, 0, 1, -1, 2, -1, -1, -1)  # by the bits of a code that changed; -1: none, or more than one
RISES = (5, 1, 3)  # boundary where the output of sensor a, b, c rises, passed upwards; it falls three further on
OWNER = (2, 1, 0, 2, 1, 0)  # sensor that changes at a boundary
ALL = 7  # bits of the three sensors that are not believed
MOVED_BIT = 8  # bit of sensor a that it has moved

# Chosen, in edges: two wrong levels are enough to doubt a sensor, and a stuck one is wrong at half of all edges.
MOVED_EDGES = 6  # off to the same side before a sensor counts as moved: three electrical revolutions
WRONG = 4  # doubt that a wrong level adds; a right one takes 1 away
DISBELIEF = 8  # doubt from which on a sensor is not believed, until there is none left
DOUBT_MAX = 24  # largest doubt: a sensor is believed again after that many right levels


class Levels(NamedTuple):
    """What the inputs show."""

    code: int  # levels that two successive samples have shown
    pending: int  # levels of the last sample if they differ from `code`; -1: they do not
    pending_age: float  # s since they changed
    unused: int  # edges not used so far; a pending one counts


class Belief(NamedTuple):
    """Which sensors are believed; all are, if all is zero."""

    doubts: Three  # by sensor
    streaks: Three  # by sensor: successive edges that were off upwards (positive) or downwards (negative)
    sensors: int  # bits 0-2: sensor a, b, c is not believed; bits 3-5: it has moved


@kernel
def read(levels: Levels, sample: Sample, T_s: float) -> Levels:
    """The levels after a sample."""
    unused = levels.unused + sample.edges
    if sample.code == levels.pending or sample.code == levels.code:
        return Levels(sample.code, -1, 0.0, unused)
    age = 0.5 * T_s  # an edge that was not captured
    if sample.edges == 0:
        unused += 1
    elif sample.edge_to == sample.code:
        age = min(sample.edge_age, T_s)
    return Levels(levels.code, sample.code, age, unused)


@kernel
def rising(sensor: int, code: int) -> int:
    """The boundary of the edge of `sensor` to the levels `code` if passed upwards; downwards it is 3 further."""
    return RISES[sensor] if (code >> sensor) & 1 == 1 else (RISES[sensor] + 3) % 6


@kernel
def believed(belief: Belief, sensor: int) -> bool:
    """Whether the edges of a sensor (0..2) are to be used."""
    return (belief.sensors >> sensor) & 1 == 0


@kernel
def following(belief: Belief, boundary: int, way: int) -> int:
    """The next boundary whose sensor is believed."""
    found = (boundary + way) % 6
    for _ in range(2):
        if not believed(belief, OWNER[found]):
            found = (found + way) % 6
    return found


@kernel
def judged(belief: Belief, code: int, boundary: int, way: int) -> tuple[Belief, bool]:
    """The belief after the levels `code` were read just beyond `boundary`.

    If no sensor would be believed any more, the angle was wrong: all are believed again, and the second result is true.
    """
    wrong = code ^ CODE_OF_SECTOR[boundary if way > 0 else (boundary + 5) % 6]
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
def off_to(belief: Belief, sensor: int, side: int) -> tuple[Belief, bool]:
    """The belief after an edge that was off to one side (1, -1) or not (0), and whether its sensor has moved."""
    streak = max(belief.streaks[sensor] * side, 0) * side + side
    streaks = with_item(belief.streaks, sensor, streak)
    if abs(streak) < MOVED_EDGES or (streaks[0] != 0 and streaks[1] != 0 and streaks[2] != 0):
        return belief._replace(streaks=streaks), False
    return belief._replace(streaks=(0, 0, 0), sensors=belief.sensors | (MOVED_BIT << sensor)), True
