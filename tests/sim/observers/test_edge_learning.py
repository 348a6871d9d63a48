"""The places of the edges against least squares by numpy, and which sensors are believed against hand-made levels."""

import numpy as np
import pytest
from ideal_motor import CODES

from sim.observers import edge_learning as el

UNKNOWN = (0.0,) * 12
DEG = np.pi / 180
SENSOR = (2, 1, 0, 2, 1, 0)  # that changes at a boundary, by the codes 1, 3, 2, 6, 4, 5


def taught(visits):
    """Edges after visits (boundary, way, r in rad, i_q in A)."""
    edges = el.start(UNKNOWN)
    for boundary, way, r, i_q in visits:
        edges = el.learn(edges, boundary, way, float(r), float(i_q), 1.0)
    return edges


def visits(deltas, c, currents, noise=0.0):
    """Round after round upwards over the six boundaries, with the residual -delta + c i."""
    rng = np.random.default_rng(0)
    return [(b, 1, -deltas[b] + c * i + noise * rng.standard_normal(), i) for i in currents for b in range(6)]


def deltas_of(edges):
    """Upwards, rad."""
    return [el.delta(edges, b, 1) for b in range(6)]


@pytest.mark.parametrize("boundary", range(6))
@pytest.mark.parametrize("way", [1, -1])
def test_an_edge_is_found_by_each_of_the_three_means(boundary, way):
    edges = el.start(UNKNOWN)
    lower, upper = int(CODES[boundary - 1]), int(CODES[boundary])
    before, code = (lower, upper) if way > 0 else (upper, lower)
    sensor, here = SENSOR[boundary], boundary * 60 * DEG
    assert el.met(edges, sensor, before, code, here + np.pi, -way * 1.0, el.BY_CODES) == (boundary, way)
    assert el.met(edges, sensor, before, code, here + np.pi, way * 1.0, el.BY_SPEED) == (boundary, way)
    for off in (-80, 80):
        assert el.met(edges, sensor, before, code, here + off * DEG, -way * 1.0, el.NEARER) == (boundary, way)
    for off in (-100, 100):
        assert el.met(edges, sensor, before, code, here + off * DEG, 0.0, el.NEARER) == ((boundary + 3) % 6, -way)
    # an illegal code says nothing, so the nearer one counts
    assert el.met(edges, sensor, 0, 7, here, 0.0, el.BY_CODES)[0] in (boundary, (boundary + 3) % 6)


def test_places_and_slope_are_those_of_least_squares():
    """One slope and six means, with the prior as one more row: numpy's lstsq as the oracle."""
    rng = np.random.default_rng(3)
    deltas = rng.uniform(-15, 15, 6) * DEG
    currents = rng.uniform(-1.0, 1.0, 20) + np.repeat([1.0, 4.0], 10)
    given = visits(deltas, 0.3 * DEG, currents, noise=0.1 * DEG)
    edges = taught(given)
    rows = np.zeros((len(given) + 1, 7))
    for k, (boundary, _, _, i_q) in enumerate(given):
        rows[k, boundary], rows[k, 6] = 1.0, i_q
    rows[-1, 6] = np.sqrt(el.S_PRIOR)
    solution = np.linalg.lstsq(rows, np.array([r for *_, r, _ in given] + [0.0]), rcond=None)[0]
    assert edges.s_ii < el.S_FULL
    assert edges.c == pytest.approx(solution[6], rel=1e-6)
    assert deltas_of(edges) == pytest.approx(-solution[:6], abs=1e-8)
    assert edges.c == pytest.approx(0.3 * DEG, rel=0.1)
    assert edges.learned == 6


def test_without_a_change_of_load_the_slope_stays_zero_and_a_constant_load_unlearns_nothing():
    deltas = np.array([-1.2, -3.0, 7.2, -3.3, 0.6, 5.6]) * DEG
    constant = taught(visits(deltas, 0.3 * DEG, [4.0] * 30))
    assert constant.c == 0.0
    assert deltas_of(constant) == pytest.approx(deltas - 1.2 * DEG)
    varied = visits(deltas, 0.3 * DEG, [1.0, 8.0] * 20)
    before = taught(varied)
    after = taught([*varied, *visits(deltas, 0.3 * DEG, [4.0] * 2000)])
    assert before.c == pytest.approx(0.3 * DEG, rel=0.05)
    assert after.c == pytest.approx(before.c, rel=0.05)
    assert deltas_of(after) == pytest.approx(deltas, abs=0.05 * DEG)


def test_the_other_way_follows_until_it_is_known():
    edges = taught([(2, 1, 0.1, 1.0)])
    assert el.delta(edges, 2, -1) == el.delta(edges, 2, 1) == pytest.approx(-0.1)
    edges = taught([(2, 1, 0.1, 1.0), (2, -1, 0.05, 1.0), (2, 1, 0.1, 1.0)])
    assert el.delta(edges, 2, -1) == pytest.approx(-0.05)
    assert el.delta(edges, 2, 1) == pytest.approx(-0.1)


def test_one_false_edge_hardly_moves_a_learned_place():
    good = [(0, 1, 0.0, 1.0)] * 50
    edges = taught([*good, (0, 1, 20 * DEG, 1.0)])
    assert 0.01 < np.degrees(abs(el.delta(edges, 0, 1))) < el.CLIP / DEG / 50
    far = taught([*good, (0, 1, 120 * DEG, 1.0)])
    assert el.delta(far, 0, 1) == 0.0


@pytest.mark.parametrize("shift", [8.0, -5.0])
@pytest.mark.parametrize("sensor", range(3))
def test_a_sensor_that_moved_is_flagged_and_followed(sensor, shift):
    before = visits(np.zeros(6), 0.0, [2.0] * 20)
    deltas = np.array([shift * DEG * (SENSOR[boundary] == sensor) for boundary in range(6)])
    almost = taught([*before, *visits(deltas, 0.0, [2.0] * 2)])
    assert almost.sensors == 0
    edges = taught([*before, *visits(deltas, 0.0, [2.0] * 4)])
    assert edges.sensors == 8 << sensor
    assert deltas_of(edges) == pytest.approx(deltas, abs=0.2 * DEG)
    assert edges.learned == 4  # the moved ones count anew
    assert taught([*before, *visits(deltas, 0.0, [2.0] * 20)]).learned == 6


def test_all_off_alike_is_the_back_emf_and_no_sensor():
    before = visits(np.zeros(6), 0.0, [2.0] * 20)
    edges = taught([*before, *visits(np.full(6, 5 * DEG), 0.0, [2.0] * 10)])
    assert edges.sensors == 0


def levels(edges, codes, turns, way=1):
    """Levels judged at each boundary, `codes` by sector; also whether the angle was ever said to be wrong."""
    astray = False
    for k in range(6 * turns):
        boundary = (k * way) % 6
        edges, now = el.judge(edges, int(codes[boundary if way > 0 else boundary - 1]), boundary, way)
        astray |= now
    return edges, astray


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("stuck", range(3))
def test_a_wrong_level_is_not_believed_until_it_has_been_right_for_a_while(stuck, way):
    broken = CODES | (1 << stuck)
    edges, astray = levels(el.start(UNKNOWN), CODES, 5, way)
    assert edges.sensors == 0
    edges, astray = levels(edges, broken, 2, way)
    assert edges.sensors == 1 << stuck
    assert not el.believed(edges, stuck)
    assert not astray
    for turns, doubted in ((1, 1 << stuck), (5, 0)):
        mended, _ = levels(edges, CODES, turns, way)
        assert mended.sensors == doubted


def test_levels_that_contradict_everywhere_mean_that_the_angle_is_wrong():
    edges, astray = levels(el.start(UNKNOWN), CODES ^ 7, 2)
    assert astray
    assert edges.sensors == 0


def test_ahead_is_the_next_edge_that_is_believed():
    edges = el.start(UNKNOWN)
    assert el.ahead(edges, 1, 1) == pytest.approx((np.pi / 2, np.pi / 6))
    assert el.ahead(edges, 1, -1) == pytest.approx((np.pi / 6, np.pi / 6))
    one, _ = levels(edges, CODES | 1, 2)  # sensor a: boundaries 2 and 5
    assert el.ahead(one, 1, 1) == pytest.approx((2 * np.pi / 3, np.pi / 3))
    assert el.ahead(one, 0, -1)[1] == pytest.approx(np.pi / 3)
    two = one._replace(sensors=3)
    assert el.ahead(two, 0, 1) == pytest.approx((np.pi / 2, np.pi / 2))
    placed = taught([(1, 1, 0.1, 0.0), (2, 1, -0.1, 0.0)])
    assert el.ahead(placed, 1, 1) == pytest.approx((np.pi / 2, np.pi / 6 - 0.1))
