"""Which edge was met, and which sensors are believed, against levels made by hand."""

import numpy as np
import pytest
from ideal_motor import CODES

from sim.native import zeroed
from sim.observers import hall_levels as hl
from sim.observers.sample import Sample

SENSOR = (2, 1, 0, 2, 1, 0)  # that changes at a boundary, by the codes 1, 3, 2, 6, 4, 5


def read(belief, codes, turns, way=1):
    """Levels judged at each boundary, `codes` by sector; also whether the angle was ever said to be wrong."""
    astray = False
    for k in range(6 * turns):
        boundary = (k * way) % 6
        belief, now = hl.judged(belief, int(codes[boundary if way > 0 else boundary - 1]) ^ hl.beyond(boundary, way))
        astray |= now
    return belief, astray


@pytest.mark.parametrize("boundary", range(6))
def test_an_edge_leaves_two_boundaries_half_a_turn_apart(boundary):
    before, after = int(CODES[boundary - 1]), int(CODES[boundary])
    assert before ^ after == 1 << SENSOR[boundary]
    assert hl.OWNER[boundary] == SENSOR[boundary]
    assert (hl.beyond(boundary, 1), hl.beyond(boundary, -1)) == (after, before)
    assert hl.rising(SENSOR[boundary], after) == boundary
    assert hl.rising(SENSOR[boundary], before) == (boundary + 3) % 6  # the same edge the other way


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("stuck", range(3))
def test_a_wrong_level_is_not_believed_until_it_has_been_right_for_a_while(stuck, way):
    belief, _ = read(zeroed(hl.Belief), CODES, 5, way)
    assert belief.sensors == 0
    belief, astray = read(belief, CODES | (1 << stuck), 2, way)
    assert (belief.sensors, astray) == (1 << stuck, False)
    assert not hl.believed(belief, stuck)
    for turns, doubted in ((1, 1 << stuck), (5, 0)):
        assert read(belief, CODES, turns, way)[0].sensors == doubted


def test_levels_that_contradict_everywhere_mean_that_the_angle_is_wrong():
    belief, astray = read(zeroed(hl.Belief), CODES ^ 7, 2)
    assert (belief.sensors, astray) == (0, True)


def test_the_next_boundary_is_of_a_sensor_that_is_believed():
    belief = zeroed(hl.Belief)
    assert [hl.following(belief, 1, way) for way in (1, -1)] == [2, 0]
    one, _ = read(belief, CODES | 1, 2)  # sensor a: boundaries 2 and 5
    assert [hl.following(one, 1, 1), hl.following(one, 0, -1)] == [3, 4]
    two = one._replace(sensors=3)
    assert [hl.following(two, 0, 1), hl.following(two, 3, 1)] == [3, 0]


@pytest.mark.parametrize(
    ("sides", "sensors"),
    [
        *(([0.1 * side * (k == sensor) for k in range(3)], 8 << sensor) for sensor in range(3) for side in (1, -1)),
        pytest.param((0.1, 0.1, 0.1), 0, id="all alike: that is the back-EMF"),
        pytest.param((0.0, None, 0.0), 0, id="each time by another angle"),
    ],
)
def test_a_sensor_that_moved_is_found_after_six_edges_off_alike(sides, sensors):
    belief = zeroed(hl.Belief)
    for k in range(6):
        assert belief.sensors == 0
        for sensor, side in enumerate(sides):
            belief, moved = hl.off_to(belief, sensor, 0.1 + 0.04 * k if side is None else side)
            assert moved == (k == 5 and side not in (0.0, None) and sensors != 0)
    assert belief.sensors == sensors


def test_unprimed_levels_agree_with_the_codes_of_the_specification():
    assert tuple(CODES) == hl.CODE_OF_SECTOR
    assert np.unique(CODES).size == 6


def test_a_level_is_new_after_two_samples_and_the_first_change_is_remembered():
    """A bounce: a changes 10 us before a sample, is back at the next, and changes for good 20 us before the third."""
    T_s, none = 60e-6, (-1.0, -1.0, -1.0)
    levels = zeroed(hl.Levels)._replace(code=2)
    seen = []
    for code, edges, ages in (
        (3, 1, (10e-6, *none[1:])),
        (2, 1, (30e-6, *none[1:])),
        (3, 1, (20e-6, *none[1:])),
        (3, 0, none),
    ):
        sample = zeroed(Sample)._replace(code=code, edges=edges, ages=ages)
        levels, sensor, first, late = hl.read(levels, sample, T_s, 100.0)
        seen.append(sensor)
    assert seen == [-1, -1, -1, 0]
    assert (first, late) == pytest.approx((10e-6 + 3 * T_s, 20e-6 + T_s))
    assert (levels.code, levels.touched, levels.unused) == (3, 1, 3)
