import numpy as np
import pytest
from ideal_motor import CODES, TICK_HZ, TICKS, Signals

from sim.observers import average_speed, hall_speed, sample

PARAMS = hall_speed.make_params(TICK_HZ, 0.2)
WIDTH = np.pi / 3
STEP = 30 * TICKS  # from edge to edge
FULL = WIDTH * TICK_HZ / STEP


def forwards(edges, step=STEP):
    """Into sector 1, 2, 3, …"""
    return [(step * (k + 1), CODES[(k + 1) % 6]) for k in range(edges)]


def agree(out, expected):
    for name in hall_speed.Estimate._fields:
        assert np.array_equal(out[name], expected[name]), name


def front(tick, hall, edge_tick, edge_hall, params=PARAMS):
    """Last state and estimates of the front end, no motor connected."""
    none = np.zeros(tick.size)
    s = Signals(tick, hall, none, none, none, none, none, none, edge_tick, edge_hall, none)
    end = sample.FrontEnd(average_speed.Params(params, 0.0, 0.0))
    out = end.run(s.measured, s.edges, np.zeros(tick.size, bool))
    return end.state.first.hall, out.view(np.recarray).hall


def feed(events, until=None, params=PARAMS):
    """Front end over single edges [(tick, code), ...]; samples every TICKS from 0, code as the edges left it."""
    events = sorted(events)
    until = until if until is not None else events[-1][0] + TICKS
    tick = np.arange(0, until + 1, TICKS, dtype=np.int64)
    at = np.array([e[0] for e in events], np.int64)
    codes = np.array([e[1] for e in events], np.uint8)
    legal = (codes != 0) & (codes != 7)
    last = np.searchsorted(at[legal], tick, side="right") - 1
    hall = np.where(last >= 0, codes[legal][np.maximum(last, 0)], CODES[0]).astype(np.uint8)
    return tick, front(tick, hall, at, codes, params)


def test_an_overdue_edge_bounds_the_speed_and_a_timeout_ends_it():
    interval = 40 * TICKS
    tick, (_, out) = feed([(interval, CODES[1]), (2 * interval, CODES[2])], until=TICK_HZ // 4)
    age = (tick - 2 * interval) / TICK_HZ
    running = (age >= 0) & (age <= 0.2)
    full = WIDTH * TICK_HZ / interval
    np.testing.assert_allclose(
        out.omega[running], np.minimum(full, WIDTH / np.maximum(age[running], 1e-12)), rtol=1e-12
    )
    assert set(out.omega[age > 0.2]) == {0.0}
    assert set(out.direction[age > 0.2]) == {0}
    assert set(out.anchored[age > 0.2]) == {0}


def test_reversal_turns_direction_and_speed_at_the_same_boundary():
    back_at = 3 * STEP + STEP // 2  # in sector 3
    tick, (_, out) = feed([*forwards(3), (back_at, CODES[2]), (back_at + 2 * STEP, CODES[1])])
    turned = (tick >= back_at) & (tick < back_at + STEP)
    assert set(out.direction[turned]) == {-1}
    assert set(out.anchored[turned]) == {1}
    np.testing.assert_allclose(out.omega[turned], -FULL)
    assert out.omega[-1] == pytest.approx(-FULL / 2)  # a whole sector backwards, in twice the time


def test_a_sensor_chattering_on_an_edge_ends_with_the_speed_it_began_with():
    at = 3 * STEP
    tick, (state, out) = feed([*forwards(4), (at + 40, CODES[2]), (at + 90, CODES[3])])  # all within one period
    after = tick >= at + TICKS
    np.testing.assert_allclose(out.omega[after], FULL, rtol=100 / STEP)
    assert set(out.direction[after]) == {1}
    assert (state.skipped, state.undone) == (0, 1)


@pytest.mark.parametrize("shown", [2, 4])  # the code of either neighbour
@pytest.mark.parametrize("across", [False, True])  # a sample falls into the glitch
def test_a_glitch_inside_a_sector_leaves_nothing_behind(shown, across):
    tick, (_, clean) = feed(forwards(6))
    middle = 3 * STEP + 10 * TICKS - (200 if across else -200)
    _, (state, out) = feed([*forwards(6), (middle, CODES[shown]), (middle + 400, CODES[3])], until=tick[-1])
    same = np.ones(tick.size, bool)
    if across:
        same[np.searchsorted(tick, middle)] = False
    for name in ("sector", "direction", "anchored", "omega", "age"):
        assert np.array_equal(getattr(out, name)[same], getattr(clean, name)[same]), name
    assert (state.skipped, state.undone) == (0, 1)


def test_illegal_codes_are_counted_and_change_nothing():
    events = forwards(8)
    tick, (clean_state, clean) = feed(events)
    glitches = []
    for k, (at, code) in enumerate(events):
        glitches += [(at + 200, 0 if k % 2 else 7), (at + 260, code)]  # out of the code and back
    _, (state, out) = feed(events + glitches, until=tick[-1])
    agree(out, clean)
    assert (clean_state.illegal, state.illegal) == (0, 8)


def test_a_skipped_sector_holds_the_speed_and_makes_none():
    times = {1: 1, 2: 2, 3: 3, 5: 5, 6: 6, 7: 8}  # edge to sector 4 is lost; the last sector takes twice the time
    tick, (state, out) = feed([(STEP * t, CODES[k % 6]) for k, t in times.items()])
    assert state.skipped == 1
    lost = (tick >= 5 * STEP) & (tick < 6 * STEP)
    assert set(out.sector[lost]) == {5}
    assert set(out.anchored[lost]) == {0}
    at = {t: np.searchsorted(tick, t * STEP) for t in (5, 6, 8)}
    assert out.omega[at[5]] == pytest.approx(FULL / 2)  # overdue by then, held
    assert out.omega[at[6]] == pytest.approx(FULL / 2)  # the edge gives an angle, no speed
    assert out.anchored[at[6]] == 1
    assert out.omega[at[8]] == pytest.approx(FULL / 2)  # by the interval of two steps


def test_lost_edges_are_noticed_by_the_sampled_code_within_two_samples():
    tick = np.arange(0, 6 * STEP, TICKS, dtype=np.int64)
    at = np.array([STEP, 2 * STEP], np.int64)
    codes = CODES[[1, 2]]
    hall = CODES[np.minimum(tick // STEP, 4)]  # edges to sectors 3 and 4 never arrive
    state, out = front(tick, hall, at, codes)
    first_wrong = 3 * STEP // TICKS
    assert out.sector[first_wrong] == 2
    assert out.sector[first_wrong + 1] == 3
    assert state.skipped == 2
    hall[first_wrong:] = CODES[2]
    hall[first_wrong + 10] = CODES[4]  # one odd sample alone is not believed
    state, out = front(tick, hall, at, codes)
    assert state.skipped == 0


def test_several_edges_in_one_period():
    gap = TICKS // 5  # five edges a period
    _, (state, out) = feed(forwards(200, gap))
    np.testing.assert_allclose(out.omega[2:-1], WIDTH * TICK_HZ / gap)
    assert state.skipped == 0
    assert set(out.edge[1:-1]) == {1}


def test_an_edge_between_samples_is_taken_with_the_next_sample_and_later_ones_are_left():
    tick = np.array([0, TICKS, 2 * TICKS], np.int64)
    at = np.array([TICKS, TICKS + 1, 2 * TICKS + 1], np.int64)  # at the sample, just after it, after the last
    codes = CODES[[1, 2, 3]]
    hall = CODES[[0, 1, 2]]
    state, out = front(tick, hall, at, codes)
    assert list(out.sector) == [0, 1, 2]
    assert state.now.sector == 2


def test_the_first_sample_gives_the_sector_unless_its_code_is_illegal():
    tick = np.arange(3, dtype=np.int64) * TICKS
    none = np.array([], np.int64)
    hall = np.array([7, 0, CODES[4]], np.uint8)
    state, out = front(tick, hall, none, none.astype(np.uint8))
    assert (list(out.sector), state.illegal) == ([-1, -1, 4], 2)


@pytest.mark.parametrize("way", [1, -1])
def test_a_false_edge_just_after_a_true_one_makes_no_speed_beyond_the_fastest(way):
    fastest = 2970.0
    params = hall_speed.make_params(TICK_HZ, 0.2, fastest)
    at = [0, 40_000, 80_000, 80_100]  # the last one 5 us after a true edge, and a sample follows inside the pulse
    _, (_, out) = feed([(tick, CODES[way * k % 6]) for k, tick in enumerate(at)], 80_000 + TICKS, params)
    assert out.omega[-1] == way * fastest
    _, (_, slow) = feed([(tick, CODES[way * k % 6]) for k, tick in enumerate(at[:3])], 80_000, params)
    assert slow.omega[-1] == pytest.approx(way * WIDTH * TICK_HZ / 40_000)
