"""Angles of the Hall edges, by boundary and direction, and what each pole pair adds; with their uncertainty.

A place is the actual minus the ideal angle of an edge. Each boundary has one for each direction, because sensors have
hysteresis. The magnets are not placed exactly either, so each edge of a shaft revolution differs a little, equally in
both directions. Pole pairs are counted from where the rotor stood at the start.

This module holds numbers only; `edge_lessons` and `edge_kalman` decide what they should be.

Source: the misplacement of Table I of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple, cast

from sim.native import with_item
from sim.numba_cache import kernel
from sim.observers.hall_levels import OWNER
from sim.observers.hall_speed import SECTOR_WIDTH
from sim.observers.transforms import TWO_PI, clip

Six = tuple[float, float, float, float, float, float]
Twelve = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""A value for each place: boundaries 0..5 passed upwards, then 0..5 passed downwards."""
Pairs = tuple[Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six, Six]

DEG = math.pi / 180.0
MOST = 16  # pole pairs that are told apart, the length of `Pairs`; with more of them none are
ZERO_6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ZERO_12 = (*ZERO_6, *ZERO_6)
ZEROS = cast("Pairs", (ZERO_6,) * MOST)

# Standard deviations, rad. Table I of the paper has edges up to 7.2 deg from their place, 4.2 deg rms.
FURTHEST = 30.0 * DEG  # largest misplacement; derived: half a sector, beyond which two edges could meet
UNKNOWN = 6.0 * DEG  # of a place that nobody has given; chosen: a little more than Table I
TOLD = 0.5 * DEG  # of a place by that of the other direction; chosen: usual hysteresis. Also the largest uncertainty of
# a shared offset that counts: beside the back-EMF, edges are exact relative to one another
ONE = 0.3 * DEG  # of an edge's relative place after one revolution; tuned
VISITS_TOLD = 4.0  # revolutions that a given place counts as, relative to those of the same direction; chosen
OWN_MOST = 3.0 * DEG  # rad, chosen: largest residue that is learned from
SCATTER = 0.12 * DEG  # of an edge from one shaft revolution to the next, at the start; tuned


class Places(NamedTuple):
    """What is known of the edges."""

    relative: Twelve  # rad, minus the mean of its direction
    visits: Twelve  # revolutions that it was learned from, weighted; 0: never
    actual: Twelve  # rad, actual minus ideal angle
    variance: Twelve  # rad2, of `actual`
    pair: int  # pole pair of the last edge
    own: Pairs  # rad, what each edge of a shaft revolution adds
    turns: float  # shaft revolutions that `own` was learned from
    wrong: Six  # rad by which the back-EMF is off at each boundary, the mean of all pole pairs
    scatter: float  # rad2


@kernel
def start(told: Twelve, sd: float) -> Places:
    """Nothing learned yet: the places given, and the standard deviation of an offset that all of a way share, rad.

    0 means that a place is not known. If all places of a direction are given, they are taken as learned relative to one
    another.
    """
    relative = ZERO_12
    visits = ZERO_12
    variance = ZERO_12
    for k in range(12):
        variance = with_item(variance, k, UNKNOWN**2 if told[k] == 0.0 else sd * sd)
        if known(told, k // 6):
            relative = with_item(relative, k, told[k] - mean(told, k // 6))
            visits = with_item(visits, k, VISITS_TOLD)
            variance = with_item(variance, k, ONE**2 / VISITS_TOLD + min(sd * sd, TOLD**2))
    return Places(relative, visits, told, variance, 0, ZEROS, 0.0, ZERO_6, SCATTER * SCATTER)


@kernel
def known(told: Twelve, way: int) -> bool:
    """Whether all places upwards (`way` 0) or downwards (1) were given."""
    count = 0
    for k in range(6 * way, 6 * way + 6):
        count += 1 if told[k] != 0.0 else 0
    return count == 6


@kernel
def mean(places: Twelve, way: int) -> float:
    """The mean of those upwards (`way` 0) or downwards (1)."""
    total = 0.0
    for k in range(6 * way, 6 * way + 6):
        total += places[k] / 6.0
    return total


@kernel
def slot(boundary: int, way: int) -> int:
    """Index of a place among the twelve."""
    return boundary if way > 0 else boundary + 6


@kernel
def angle(places: Places, boundary: int, way: int) -> float:
    """Angle (rad, not wrapped) of the edge at `boundary` passed upwards (`way` 1) or downwards (-1), of a mean pair."""
    return boundary * SECTOR_WIDTH + places.actual[slot(boundary, way)]


@kernel
def width(places: Places, boundary: int, to: int, way: int) -> float:
    """Distance (rad) from one boundary to another in the direction `way`."""
    wide = way * (angle(places, to, way) - angle(places, boundary, way))
    return wide - TWO_PI * math.floor(wide / TWO_PI)


@kernel
def pair_of(places: Places, pairs: int, last: int, last_way: int, boundary: int, way: int) -> int:
    """Pole pair of the edge at `boundary` after one at `last`; `pairs` = 0: they are not told apart."""
    if pairs == 0:
        return 0
    pair = places.pair
    if way > 0:
        pair += 1 if boundary < last or (boundary == last and last_way > 0) else 0
    else:
        pair -= 1 if boundary > last or (boundary == last and last_way < 0) else 0
    return 0 if pair >= pairs else pairs - 1 if pair < 0 else pair


@kernel
def taught(places: Places, pair: int, boundary: int, z: float, turned: float, share: float, turns: float) -> Places:
    """The places after an edge in `pair` came `z` rad after the estimate, and the back-EMF at it `turned`.

    Where both did, the shaft was not where the estimate was, and the edge is in its place. What is wrong of the
    back-EMF repeats with the electrical angle, and so at a boundary in every pair. `turns`: share of a revolution.
    """
    wrong = places.wrong[boundary] + share * (turned - places.wrong[boundary])
    by = -share * clip(z - (turned - wrong), OWN_MOST)
    six = with_item(places.own[pair], boundary, places.own[pair][boundary] + by)
    own = with_item(places.own, pair, six)
    return places._replace(
        pair=pair, own=own, wrong=with_item(places.wrong, boundary, wrong), turns=places.turns + turns
    )


@kernel
def shifted(places: Places, sensor: int, by: float) -> Places:
    """The places after a sensor has moved `by` (rad): what was learned of its edges is forgotten."""
    relative = places.relative
    actual = places.actual
    visits = places.visits
    for k in range(12):
        if OWNER[k % 6] == sensor:
            relative = with_item(relative, k, clip(relative[k] + by, FURTHEST))
            actual = with_item(actual, k, clip(actual[k] + by, FURTHEST))
            visits = with_item(visits, k, min(visits[k], 1.0))
    return places._replace(relative=relative, actual=actual, visits=visits)
