import numpy as np
import pytest
from ideal_motor import (
    PAPER_EDGES,
    PWM_HZ,
    T_S,
    TABLE_I,
    TICK_HZ,
    TICKS,
    constant,
    error_deg,
    glitch,
    own,
    rpm,
    samples,
    sectors,
    signals,
    table,
    track,
)

from sim.observers import lookup_table

WIDTH = np.diff(np.r_[PAPER_EDGES, 360 + PAPER_EDGES[0]])  # deg, of sector 0..5


def params(offsets_deg=TABLE_I, downwards_deg=None):
    return lookup_table.make_params(PWM_HZ, own(lookup_table, **table(offsets_deg, downwards_deg)))


def start(sector, sign):
    """From rest, 5 deg from the end of a sector: an angle that rises or falls with the time squared."""
    opens = PAPER_EDGES[sector]
    theta_0 = np.radians(opens + 5 if sign > 0 else opens + WIDTH[sector] - 5)
    return lambda t: theta_0 + sign * 3500.0 * np.maximum(t - 0.02, 0) ** 2


def passed_edges(s):
    """How many edges each sample has seen."""
    return np.searchsorted(s.edge_tick, s.tick, side="right")


@pytest.mark.parametrize("speed", [50.0, 500.0, 3000.0, -50.0, -500.0, -3000.0])
def test_exact_at_constant_speed_with_the_right_table(speed):
    omega = rpm(speed)
    s = signals(constant(omega), 2.5 * 2 * np.pi / abs(omega), edges_deg=PAPER_EDGES)
    out = track(lookup_table, params(), s)
    settled = passed_edges(s) >= 2
    a_tick = np.degrees(abs(omega)) / TICK_HZ
    assert np.abs(error_deg(s.theta, out.theta))[settled].max() < 4 * a_tick
    np.testing.assert_allclose(out.omega[settled], omega, rtol=2 * a_tick / WIDTH.min())


def test_each_way_has_its_own_boundaries():
    """Hysteresis: the edges lie elsewhere downwards. A table for upwards alone errs by the shift."""
    hysteresis = 2.0
    s = signals(constant(rpm(-500)), 0.3, edges_deg=PAPER_EDGES - hysteresis)
    settled = passed_edges(s) >= 2
    right = error_deg(s.theta, track(lookup_table, params(TABLE_I, TABLE_I + hysteresis), s).theta)[settled]
    assert np.abs(right).max() < 0.01
    wrong = error_deg(s.theta, track(lookup_table, params(TABLE_I), s).theta)[settled]
    np.testing.assert_allclose(wrong, -hysteresis, atol=0.01)


@pytest.mark.parametrize(
    "way",
    [constant(rpm(500)), constant(rpm(-500)), lambda t: rpm(200) * np.minimum(t, 0.1), start(2, 1), start(5, -1)],
    ids=["forwards", "backwards", "a stop", "a start", "a start backwards"],
)
def test_an_empty_table_is_the_average_speed(way):
    """So what is proved here of a standstill, an edge that is overdue and the two bounds is true of that, too."""
    s = signals(way, 0.4, edges_deg=PAPER_EDGES, fine=10)
    seen = samples(s)
    out = track(lookup_table, params(np.zeros(6)), s)
    np.testing.assert_allclose(error_deg(seen.theta_avg, out.theta), 0, atol=1e-9)
    np.testing.assert_allclose(out.omega, seen.hall.omega, rtol=1e-12)


def test_jitter_alone_is_left():
    """Of the edge and, grown with the way since, of its speed: var (1 + x)^2 + x^2 at the share x of a sector."""
    omega, jitter, turns = rpm(500), 0.05, 300
    turn = 2 * np.pi / omega
    s = signals(constant(omega), turns * turn)
    rng = np.random.default_rng(1)
    shift = rng.standard_normal(s.edge_tick.size) * np.radians(jitter) / omega * TICK_HZ
    s = s._replace(edge_tick=s.edge_tick + np.round(shift).astype(np.int64))
    out = track(lookup_table, params(np.zeros(6)), s)
    error = error_deg(s.theta, out.theta)[passed_edges(s) >= 2]
    expected = jitter * np.sqrt(1 + 1 + 2 / 3)
    assert error.std() == pytest.approx(expected, rel=0.05)
    assert expected < np.abs(error).max() < jitter * 5 * 2.5


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("sector", range(6))
def test_from_standstill_in_each_sector_both_ways(sector, sign):
    """The true centre, an exact angle at the first edge, a speed at the second; always inside the true sector."""
    s = signals(start(sector, sign), 0.08, edges_deg=PAPER_EDGES, fine=10)
    out = track(lookup_table, params(), s)
    error = error_deg(s.theta, out.theta)
    first, second = (int(np.searchsorted(s.tick, s.edge_tick[k])) for k in (0, 1))
    at_rest = np.radians(PAPER_EDGES[sector] + WIDTH[sector] / 2)
    np.testing.assert_allclose(error_deg(at_rest, out.theta[:first]), 0, atol=1e-9)
    assert abs(error[first]) < np.degrees(0.5 * rpm(3000) * T_S)
    assert set(out.omega[:second]) == {0.0}
    assert np.sign(out.omega[second]) == sign
    now = sectors(s.theta, PAPER_EDGES) % 6
    centre = PAPER_EDGES[now] + WIDTH[now] / 2
    assert np.all(np.abs(error_deg(np.radians(centre), out.theta)) <= WIDTH[now] / 2 + 1e-6)


def test_a_speed_step_costs_one_sector():
    """The speed doubles at an edge: the next sector is under-run by half its width, the others are exact."""
    slow = rpm(200)
    k = 9
    at = (PAPER_EDGES[(k + 1) % 6] + 360 * ((k + 1) // 6) - np.degrees(0.3)) / np.degrees(slow)
    s = signals(lambda t: 0.3 + slow * (t + np.maximum(t - at, 0)), 0.2, edges_deg=PAPER_EDGES, fine=40)
    out = track(lookup_table, params(), s)
    error = error_deg(s.theta, out.theta)
    e = int(np.argmin(np.abs(s.edge_tick - at * TICK_HZ)))
    in_it = (s.tick >= s.edge_tick[e]) & (s.tick < s.edge_tick[e + 1])
    width = WIDTH[(k + 1) % 6]
    a_period = np.degrees(2 * slow) * T_S
    assert width / 2 - a_period < error[in_it].max() < width / 2 + 0.05
    assert error[in_it].min() > -0.05
    assert np.abs(error[s.tick >= s.edge_tick[e + 1]]).max() < 0.05


@pytest.mark.parametrize("sector", [2, 1], ids=["wide", "narrow"])
def test_an_overdue_edge_and_standstill(sector):
    """A stop in a sector's middle: the far boundary where it truly is, width by age for a speed; then the centre."""
    omega = rpm(200)
    stop = (PAPER_EDGES[sector] + 360 + WIDTH[sector] / 2 - np.degrees(0.3)) / np.degrees(omega)
    s = signals(lambda t: 0.3 + omega * np.minimum(t, stop), stop + 0.3, edges_deg=PAPER_EDGES, fine=10)
    out = track(lookup_table, params(), s)
    age = (s.tick - s.edge_tick[-1]) / TICK_HZ
    waiting = (age > np.radians(WIDTH[sector]) / omega + T_S) & (age < 0.2)
    over = age > 0.2 + T_S
    assert over.sum() > 100
    far = np.radians(PAPER_EDGES[(sector + 1) % 6])
    np.testing.assert_allclose(error_deg(far, out.theta[waiting]), 0, atol=1e-9)
    np.testing.assert_allclose(out.omega[waiting], np.radians(WIDTH[sector]) / age[waiting], rtol=1e-9)
    centre = np.radians(PAPER_EDGES[sector] + WIDTH[sector] / 2)
    np.testing.assert_allclose(error_deg(centre, out.theta[over]), 0, atol=1e-9)
    assert set(out.omega[over]) == {0.0}


def test_reversal():
    """Exact again at the second edge after it, and never out of the true sector."""
    omega, turn_at = rpm(100), 0.1003
    s = signals(lambda t: 0.3 + omega * np.where(t < turn_at, t, 2 * turn_at - t), 0.2, edges_deg=PAPER_EDGES, fine=10)
    out = track(lookup_table, params(), s)
    now = sectors(s.theta, PAPER_EDGES) % 6
    centre = PAPER_EDGES[now] + WIDTH[now] / 2
    assert np.all(np.abs(error_deg(np.radians(centre), out.theta)) <= WIDTH[now] / 2 + 1e-6)
    back = np.searchsorted(s.edge_tick, turn_at * TICK_HZ)
    again = s.tick > s.edge_tick[back + 1]
    assert np.abs(error_deg(s.theta, out.theta))[again].max() < 0.01
    between = (s.tick > s.edge_tick[back] + TICKS) & (s.tick <= s.edge_tick[back + 1])
    # the magnitude is held: at most the speed before, less where the edge was overdue
    assert np.all(out.omega[between] < 0)
    assert np.all(out.omega[between] >= -omega * 1.001)


@pytest.mark.parametrize("speed", [100.0, -100.0])
def test_a_short_pulse_leaves_nothing_behind(speed):
    s = signals(constant(rpm(speed)), 0.3, edges_deg=PAPER_EDGES)
    clean = track(lookup_table, params(), s)
    hit = track(lookup_table, params(), glitch(s, 6, 0.004))
    assert (clean.theta != hit.theta).sum() == 1
    assert (clean.omega != hit.omega).sum() == 1


def test_a_lost_edge_holds_the_speed():
    """Two sensors at once: the rotor is somewhere in the new sector until its next edge, and the speed stays."""
    omega = rpm(100)
    s = signals(constant(omega), 0.3, edges_deg=PAPER_EDGES)
    keep = np.arange(s.edge_tick.size) != 8
    lost = s._replace(edge_tick=s.edge_tick[keep], edge_hall=s.edge_hall[keep])
    out = track(lookup_table, params(), lost)
    blind = (s.tick > s.edge_tick[8]) & (s.tick < s.edge_tick[9])
    after = s.tick >= s.edge_tick[10]
    np.testing.assert_allclose(out.omega[blind], omega, rtol=5e-3)  # overdue until two samples contradict
    assert np.abs(error_deg(s.theta, out.theta))[blind].max() <= WIDTH.max() / 2 + 1.0
    assert np.abs(error_deg(s.theta, out.theta))[after].max() < 0.01


def test_a_table_that_leaves_a_sector_no_width():
    """Boundaries on top of each other, and even crossed: the speed of such a sector is zero, and nothing divides."""
    for offset in (30.0, 60.0):
        s = signals(constant(rpm(500)), 0.1)
        out = track(lookup_table, params(np.array([offset, -offset, offset, 0, 0, 0])), s)
        assert np.isfinite(out.theta).all()
        settled = passed_edges(s) >= 2
        assert out.omega[settled].min() == 0.0
        # the sector after that one is wider by the offset
        assert out.omega[settled].max() == pytest.approx(rpm(500) * (60 + offset) / 60, rel=1e-3)
