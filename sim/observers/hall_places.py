"""Where the Hall edges lie: by boundary and way, and what each pole pair adds; how sure that is.

A place is the actual less the ideal angle of an edge. Each boundary has one for each way, because sensors have
hysteresis. Magnets are not placed exactly either: each edge of a turn of the shaft lies a little elsewhere, both ways
alike. Pole pairs are counted from wherever the rotor stood first.

Holds numbers only; what they should be is said by `edge_lessons` and `edge_kalman`.

Source: the misplacement of Table I of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.hall_levels import OWNER
from sim.observers.hall_speed import SECTOR_WIDTH
from sim.observers.transforms import TWO_PI, clip

Six = tuple[float, float, float, float, float, float]
Twelve = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""A value for each place: boundaries 0..5 passed upwards, then 0..5 passed downwards."""
Pairs = tuple[Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six]

DEG = math.pi / 180.0
MOST = 16  # pole pairs that are told apart; of more, none are
ZERO_6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ZERO_12 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ZEROS = (
    *(ZERO_6, ZERO_6, ZERO_6, ZERO_6, ZERO_6, ZERO_6, ZERO_6, ZERO_6),
    *(ZERO_6, ZERO_6, ZERO_6, ZERO_6, ZERO_6, ZERO_6, ZERO_6, ZERO_6),
)
FURTHEST = 30.0 * DEG  # largest misplacement
UNKNOWN = 6.0 * DEG  # of a place that nobody has said anything of, rms
TOLD = 0.5 * DEG  # of one way by the other, rms; and the most that all together count as unsure beside the back-EMF
ONE = 0.3 * DEG  # of an edge's distance from the others of its way in one turn, rms
VISITS_TOLD = 4.0  # turns that a place which was told counts as, beside those of the same way
SCATTER = 0.12 * DEG  # of an edge from one turn of the shaft to the next, rms, at first


class Places(NamedTuple):
    """What is known of them."""

    relative: Twelve  # rad, by its way's mean
    visits: Twelve  # weight of that; 0: never met
    actual: Twelve  # rad, less the ideal
    variance: Twelve  # rad2, of `actual`
    pair: int  # pole pair in which the last edge lay
    own: Pairs  # rad, what each edge of a turn of the shaft adds
    turns: float  # of the shaft that have taught `own`
    scatter: float  # rad2


@kernel
def start(told: Twelve, sd: float) -> Places:
    """Nothing learned yet: the places given, and the standard deviation of all of a way together, rad.

    0 means that a place is not known. Where all of a way are, how they lie to one another is taken as learned.
    """
    relative = ZERO_12
    visits = ZERO_12
    variance = ZERO_12
    for k in range(12):
        variance = with12(variance, k, UNKNOWN**2 if told[k] == 0.0 else sd * sd)
        if known(told, k // 6):
            relative = with12(relative, k, told[k] - mean(told, k // 6))
            visits = with12(visits, k, VISITS_TOLD)
            variance = with12(variance, k, ONE**2 / VISITS_TOLD + min(sd * sd, TOLD**2))
    return Places(relative, visits, told, variance, 0, ZEROS, 0.0, SCATTER * SCATTER)


@kernel
def known(told: Twelve, way: int) -> bool:
    """Whether all places upwards (`way` 0) or downwards (1) were told."""
    count = 0
    for k in range(6 * way, 6 * way + 6):
        count += 1 if told[k] != 0.0 else 0
    return count == 6


@kernel
def mean(places: Twelve, way: int) -> float:
    """Of those upwards (`way` 0) or downwards (1)."""
    total = 0.0
    for k in range(6 * way, 6 * way + 6):
        total += places[k] / 6.0
    return total


@kernel
def with12(values: Twelve, k: int, value: float) -> Twelve:
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
def _with6(values: Six, k: int, value: float) -> Six:
    return (
        value if k == 0 else values[0],
        value if k == 1 else values[1],
        value if k == 2 else values[2],
        value if k == 3 else values[3],
        value if k == 4 else values[4],
        value if k == 5 else values[5],
    )


@kernel
def _with_pair(own: Pairs, pair: int, six: Six) -> Pairs:
    return (
        six if pair == 0 else own[0],
        six if pair == 1 else own[1],
        six if pair == 2 else own[2],
        six if pair == 3 else own[3],
        six if pair == 4 else own[4],
        six if pair == 5 else own[5],
        six if pair == 6 else own[6],
        six if pair == 7 else own[7],
        six if pair == 8 else own[8],
        six if pair == 9 else own[9],
        six if pair == 10 else own[10],
        six if pair == 11 else own[11],
        six if pair == 12 else own[12],
        six if pair == 13 else own[13],
        six if pair == 14 else own[14],
        six if pair == 15 else own[15],
    )


@kernel
def slot(boundary: int, way: int) -> int:
    """Which of the twelve."""
    return boundary if way > 0 else boundary + 6


@kernel
def angle(places: Places, boundary: int, way: int) -> float:
    """Angle (rad, not wrapped) of the edge at `boundary` passed upwards (`way` 1) or downwards (-1), of a mean pair."""
    return boundary * SECTOR_WIDTH + places.actual[slot(boundary, way)]


@kernel
def width(places: Places, boundary: int, to: int, way: int) -> float:
    """From one boundary on to another, rad."""
    wide = way * (angle(places, to, way) - angle(places, boundary, way))
    return wide - TWO_PI * math.floor(wide / TWO_PI)


@kernel
def pair_of(places: Places, pairs: int, last: int, last_way: int, boundary: int, way: int) -> int:
    """Pole pair of the edge at `boundary`, the last having been at `last`; `pairs` = 0: they are not told apart."""
    if pairs == 0:
        return 0
    pair = places.pair
    if way > 0:
        pair += 1 if boundary < last or (boundary == last and last_way > 0) else 0
    else:
        pair -= 1 if boundary > last or (boundary == last and last_way < 0) else 0
    return 0 if pair >= pairs else pairs - 1 if pair < 0 else pair


@kernel
def after(places: Places, pair: int, scatter: float) -> Places:
    """The places after an edge in `pair`."""
    return Places(
        places.relative,
        places.visits,
        places.actual,
        places.variance,
        pair,
        places.own,
        places.turns,
        scatter,
    )


@kernel
def taught(places: Places, pair: int, boundary: int, by: float, turns: float) -> Places:
    """The places after the own one of an edge was moved `by` (rad), which is a share of `turns` of the shaft."""
    six = places.own[pair]
    own = _with_pair(places.own, pair, _with6(six, boundary, six[boundary] + by))
    return Places(
        places.relative,
        places.visits,
        places.actual,
        places.variance,
        pair,
        own,
        places.turns + turns,
        places.scatter,
    )


@kernel
def shifted(places: Places, sensor: int, by: float) -> Places:
    """The places after a sensor has moved `by` (rad): what was learned of its edges is forgotten."""
    relative = places.relative
    actual = places.actual
    visits = places.visits
    for k in range(12):
        if OWNER[k % 6] == sensor:
            relative = with12(relative, k, clip(relative[k] + by, FURTHEST))
            actual = with12(actual, k, clip(actual[k] + by, FURTHEST))
            visits = with12(visits, k, min(visits[k], 1.0))
    return Places(
        relative,
        visits,
        actual,
        places.variance,
        places.pair,
        places.own,
        places.turns,
        places.scatter,
    )
