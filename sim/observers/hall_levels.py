"""Hall sensors by their levels: which edge was met, which sensors are to be believed, which have moved.

A level counts once two samples running have shown it, so that a pulse shorter than a period is none. A sensor and its
new level leave two boundaries, 180 deg apart. Boundary b (0..5) opens sector b when passed upwards.

A sensor whose level contradicts the edges of the others is not believed; it is again once it has been right for a
while. Levels are compared at accepted edges only, where the angle is known best. A sensor whose edges all lie off on
the same side, `MOVED_EDGES` running, has moved; not if all three are off alike: that is the back-EMF's error.

Never estimates an angle.

Source: codes of Fig. 1 of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.sample import Sample

Three = tuple[int, int, int]

CODE_OF_SECTOR = (1, 3, 2, 6, 4, 5)
SENSOR_OF_BIT = (-1, 0, 1, -1, 2, -1, -1, -1)  # that changed; -1: none, or more than one
RISES = (5, 1, 3)  # boundary where the output of sensor a, b, c rises, passed upwards; it falls three further on
OWNER = (2, 1, 0, 2, 1, 0)  # sensor that changes at a boundary
MOVED_EDGES = 6
WRONG = 4  # doubt that a wrong level adds; a right one takes 1 away
DISBELIEF = 8  # doubt from which a sensor is not believed, until there is none
DOUBT_MAX = 24
ALL = 7  # the sensors' bits
MOVED_BIT = 8  # of sensor a


class Levels(NamedTuple):
    """What the inputs show."""

    code: int  # levels that two samples running have shown
    pending: int  # levels that the last sample showed, where they differ; -1: they do not
    pending_age: float  # s
    unused: int  # edges that were not used so far; one that is pending counts


class Belief(NamedTuple):
    """What is thought of the sensors."""

    doubts: Three  # by sensor
    streaks: Three  # edges in a row, by sensor, that lay off upwards (counted up) or downwards (counted down)
    sensors: int  # bits 0-2: sensor a, b, c is not believed; bits 3-5: it has moved


@kernel
def nothing_against() -> Belief:
    """All sensors are believed."""
    return Belief((0, 0, 0), (0, 0, 0), 0)


@kernel
def read(levels: Levels, sample: Sample, T_s: float) -> Levels:
    """The levels after a sample."""
    unused = levels.unused + sample.edges
    if sample.code == levels.pending:
        return Levels(sample.code, -1, 0.0, unused)
    if sample.code == levels.code:
        return Levels(levels.code, -1, 0.0, unused)
    age = 0.5 * T_s  # an edge that was not captured
    if sample.edges == 0:
        unused += 1
    elif sample.edge_to == sample.code:
        age = min(sample.edge_age, T_s)
    return Levels(levels.code, sample.code, age, unused)


@kernel
def rising(sensor: int, code: int) -> int:
    """The boundary that the edge of `sensor` to the levels `code` is if passed upwards; downwards it is 3 further."""
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
def _with(values: Three, k: int, value: int) -> Three:
    return (value if k == 0 else values[0], value if k == 1 else values[1], value if k == 2 else values[2])


@kernel
def judged(belief: Belief, code: int, boundary: int, way: int) -> tuple[Belief, bool]:
    """After the levels `code` were read just beyond `boundary`.

    If no sensor is left that is believed, all are again: it is the angle that was wrong, and the second result is true.
    """
    wrong = code ^ CODE_OF_SECTOR[boundary if way > 0 else (boundary + 5) % 6]
    doubts = belief.doubts
    sensors = belief.sensors
    for k in range(3):
        doubt = min(doubts[k] + WRONG, DOUBT_MAX) if (wrong >> k) & 1 == 1 else max(doubts[k] - 1, 0)
        doubts = _with(doubts, k, doubt)
        if doubt >= DISBELIEF:
            sensors |= 1 << k
        elif doubt == 0:
            sensors &= ~(1 << k)
    none = sensors & ALL == ALL
    if none:
        sensors -= ALL
        doubts = (0, 0, 0)
    return Belief(doubts, belief.streaks, sensors), none


@kernel
def off_to(belief: Belief, sensor: int, side: int) -> tuple[Belief, bool]:
    """After an edge that lay off to one side (1, -1) or did not (0): has the sensor moved?"""
    streak = max(belief.streaks[sensor] * side, 0) * side + side
    streaks = _with(belief.streaks, sensor, streak)
    if abs(streak) < MOVED_EDGES or (streaks[0] != 0 and streaks[1] != 0 and streaks[2] != 0):
        return Belief(belief.doubts, streaks, belief.sensors), False
    return Belief(belief.doubts, (0, 0, 0), belief.sensors | (MOVED_BIT << sensor)), True
