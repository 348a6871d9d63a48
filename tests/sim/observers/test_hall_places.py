"""Where edges are said to lie: by boundary, way and pole pair."""

import numpy as np
import pytest

from sim.observers import hall_places as hp

DEG = np.pi / 180


@pytest.fixture
def places():
    return hp.start((0.0, 0.1, 0.0, -0.1, 0.0, 0.0) + (0.0,) * 6, 0.5 * DEG)


def test_what_was_told_is_there_and_surer_than_what_was_not(places):
    assert hp.angle(places, 1, 1) == pytest.approx(np.pi / 3 + 0.1)
    assert hp.angle(places, 1, -1) == pytest.approx(np.pi / 3)
    assert places.variance[1] < places.variance[0] / 100


def test_how_places_lie_to_one_another_is_known_where_all_of_a_way_were_told():
    up, down = np.array([0.1, -0.02, 0.03, 0.04, 0.05, 0.04]), (0.0, 0.1, 0.0, 0.1, 0.1, 0.1)
    places = hp.start((*up, *down), 2.0 * DEG)
    assert places.relative == pytest.approx([*(up - up.mean()), *(0.0,) * 6])
    assert places.actual == (*up, *down)
    assert [visits > 0 for visits in places.visits] == [True] * 6 + [False] * 6


def test_widths_are_between_edges(places):
    assert hp.width(places, 1, 2, 1) == pytest.approx(np.pi / 3 - 0.1)
    assert hp.width(places, 2, 1, -1) == pytest.approx(np.pi / 3)
    assert hp.width(places, 5, 1, 1) == pytest.approx(2 * np.pi / 3 + 0.1)


@pytest.mark.parametrize("pairs", [2, 7, 16])
def test_pole_pairs_are_counted_both_ways_and_over_missing_edges(pairs):
    """A random walk over boundaries, with edges left out; the oracle counts edges from the start."""
    rng = np.random.default_rng(3)
    number, last, last_way = 0, 0, 1
    places = hp.start((0.0,) * 12, 0.5 * DEG)
    for _ in range(500):
        way = int(rng.choice([1, -1], p=[0.6, 0.4]))
        if way == last_way:
            number += way * int(rng.integers(1, 4))  # the edge that opens sector `number`
        elif rng.random() < 0.5:
            number += way * int(rng.integers(1, 3))
        boundary = number % 6
        pair = hp.pair_of(places, pairs, last, last_way, boundary, way)
        assert pair == number // 6 % pairs
        places = places._replace(pair=pair)
        last, last_way = boundary, way


def test_of_one_pole_pair_none_are_told_apart(places):
    assert hp.pair_of(places, 0, 5, 1, 0, 1) == 0


def test_what_one_edge_is_taught_no_other_knows(places):
    taught = hp.taught(places, 15, 4, -0.02, 0.0, 0.5, 0.25)
    own = np.array(taught.own)
    assert own.shape == (hp.MOST, 6)
    assert own[15, 4] == 0.01
    assert np.count_nonzero(own) == 1
    assert (taught.turns, taught.relative) == (0.25, places.relative)


def test_a_shaft_that_turns_unevenly_moves_no_edge_but_a_back_emf_that_is_wrong_in_every_pair_hides_none(places):
    uneven, wrong = places, places
    for _ in range(200):
        for pair in range(8):
            by = 0.02 * np.sin(2.0 * np.pi * pair / 8)
            uneven = hp.taught(uneven, pair, 4, by + uneven.own[pair][4], by, 0.05, 1 / 48)
            wrong = hp.taught(wrong, pair, 4, by + wrong.own[pair][4], 0.03, 0.05, 1 / 48)
    assert np.abs(np.array(uneven.own)).max() < 0.002
    own = np.array([wrong.own[pair][4] for pair in range(8)])
    assert own == pytest.approx(-0.02 * np.sin(2.0 * np.pi * np.arange(8) / 8), abs=0.002)


def test_a_sensor_that_moved_takes_its_four_places_along(places):
    moved = hp.shifted(places._replace(visits=(50.0,) * 12), 0, 5 * DEG)
    change = np.subtract(moved.actual, places.actual)
    assert change == pytest.approx(5 * DEG * np.array([0, 0, 1, 0, 0, 1] * 2))
    assert np.array(moved.visits).tolist() == [50.0, 50.0, 1.0] * 4
    far = hp.shifted(places, 2, 2.0)
    assert max(far.actual) == pytest.approx(hp.FURTHEST)
