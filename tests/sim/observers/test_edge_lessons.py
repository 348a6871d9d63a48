"""What a turn teaches, from turns that are made here; least squares by numpy as the oracle."""

import numpy as np
import pytest
from ideal_motor import TABLE_I

from sim.native import zeroed
from sim.observers import edge_lessons as el
from sim.observers.edge_scales import Motor, make_scale

DEG = np.pi / 180
PAPER = {"n_p": 6.0, "omega_m_max": 330.0, "R_s_hat": 0.158, "L_s_hat": 0.176e-3, "psi_f_hat": 6.55e-3}
SCALE = make_scale(16e3, Motor(**PAPER, i_range=20.0, J_hat=2e-4))
UNKNOWN = (0.0,) * 12
PLACES = -TABLE_I


def times(omega, slope, places_deg, way=1):
    """When the thirteen edges of two turns up to boundary 0 are met, at a speed that changes evenly."""
    k = np.arange(-12, 1) * way
    angle = (60.0 * k + np.asarray(places_deg)[k % 6]) * DEG
    angle = angle - angle[-1]
    found = []
    for at in angle:
        roots = np.roots([0.5 * slope, omega, -at]) if slope else np.array([at / omega])
        found.append(float(roots[np.argmin(np.abs(roots - at / omega))].real))
    return np.array(found)


def lessons(omega=600.0, slope=0.0, places_deg=PLACES, way=1, before=None):
    """Lessons with thirteen edges met, and nothing learned of them."""
    state = before or el.start(SCALE, UNKNOWN, 0.01)
    for gap in np.diff(times(way * omega, slope, places_deg, way)):
        state = el.met(state, state.places, float(gap))
    return state


def sums(omega, i_q, angle=0.0, e_q=None, sign=1.0, n=1000, **others):
    """Of a turn at a steady speed whose back-EMF is turned by an angle (rad) beside the edges."""
    e = SCALE.psi_f * omega if e_q is None else e_q
    values = {"e_d": -n * e * np.tan(angle), "e_q": n * e, "i_q": n * i_q, "omega": n * omega, "sign": n * sign, "n": n}
    return zeroed(el.Sums)._replace(**{name: float(value) for name, value in (values | others).items()})


@pytest.mark.parametrize(("slope", "way"), [(0.0, 1), (0.0, -1), (300.0, 1), (-300.0, -1)])
def test_edges_lie_to_one_another_as_their_times_say(slope, way):
    """An even change of speed does not count; noise of a tick is what is left."""
    state = lessons(600.0, slope, way=way)
    state = el.turn(state, sums(way * 600.0, 0.0), SCALE, way, 0)
    found = np.degrees(state.places.relative)[:6] if way > 0 else np.degrees(state.places.relative)[6:]
    assert found == pytest.approx(PLACES - PLACES.mean(), abs=1e-6)


def test_nothing_is_learned_of_edges_while_the_speed_changes_much():
    state = el.turn(lessons(600.0, 9000.0), sums(600.0, 0.0), SCALE, 1, 0)
    assert set(state.places.visits) == {0.0}


def test_the_common_place_is_told_from_load_and_speed():
    """Turns at any load and speed; each edge's place is known, so that the mean of all counts."""

    def angle(i_q, omega):
        return 2.0 * DEG + 0.004 * i_q - 0.002 * i_q**3 / 64.0 + 6e-6 * omega

    rng = np.random.default_rng(1)
    state = el.start(SCALE, UNKNOWN, 0.01)
    for _ in range(60):
        omega, i_q = rng.uniform(200, 1800), rng.uniform(0.5, 8.0)
        state = lessons(omega, places_deg=np.zeros(6), before=state)
        seen = angle(i_q, omega) - np.mean(state.places.actual[:6])
        state = el.turn(state, sums(omega, i_q, seen, off=6.0 * state.common[4] * omega), SCALE, 1, 0)
    for i_q in (0.5, 4.0, 8.0):
        found = np.dot(state.common, [1.0, 0.0, i_q, i_q**3 / 64.0, 600.0])
        assert np.degrees(found) == pytest.approx(np.degrees(angle(i_q, 600.0)), abs=0.5)
    assert np.degrees(state.common[0]) == pytest.approx(2.0, abs=0.7)


def test_the_drop_along_the_current_is_told_from_the_flux_as_by_least_squares():
    psi, drop, R = 1.05 * SCALE.psi_f, 0.15, 0.02
    rng = np.random.default_rng(2)
    state = el.start(SCALE, UNKNOWN, 0.01)
    for _ in range(300):
        omega, i_q = rng.uniform(50, 1800), rng.uniform(1.0, 8.0)
        state = lessons(omega, before=state)
        state = el.turn(state, sums(omega, i_q, e_q=psi * omega + drop + R * i_q), SCALE, 1, 0)
    assert state.drop == pytest.approx((psi, drop, R), rel=0.03)


def test_a_small_current_teaches_nothing_of_the_drop():
    state = lessons(600.0)
    assert el.turn(state, sums(600.0, 0.5, e_q=6.0), SCALE, 1, 0).drop == state.drop


def test_a_long_time_of_one_speed_says_nothing_of_the_flux_linkage_though_no_turn_lasts_as_long_as_the_next():
    """Turns of six pole pairs whose edges lie 1.5 deg apart, at a speed that none of them has; then another speed."""
    state = el.start(SCALE, UNKNOWN, 0.01)
    psi, omega = SCALE.psi_f, 500.0
    for turn in range(1000):
        seen = omega * (1.0 + 0.004 * np.cos(turn * np.pi / 3))
        state = el.turn(lessons(seen, before=state), sums(omega, 4.0, e_q=psi * omega + 0.1), SCALE, 1, 0)
    assert state.drop[0] == pytest.approx(psi, rel=0.05)
    assert np.sqrt(state.drop_P[0]) > 0.08 * psi
    for _ in range(30):
        state = el.turn(lessons(100.0, before=state), sums(100.0, 4.0, e_q=psi * 100.0 + 0.1), SCALE, 1, 0)
    assert state.drop[0] == pytest.approx(psi, rel=0.01)
    assert np.sqrt(state.drop_P[0]) < 0.02 * psi


@pytest.mark.parametrize("omega", [100.0, 1500.0])
def test_offset_and_gain_of_the_current_sensors_are_found_by_what_they_leave(omega):
    """e = u - R i - L di/dt with currents that are measured wrongly, straight from the definition."""
    offset, k, n = 0.05 + 0.02j, 0.01 - 0.02j, 4000
    theta = np.linspace(0.0, 2 * np.pi, n, endpoint=False)
    i = 4.0j * np.exp(1j * theta)
    wrong = offset + k * np.conj(i)  # measured less true
    slope = k * np.conj(1j * omega * i)
    left = -(SCALE.R_s * wrong + SCALE.L_s * slope)
    state = lessons(omega, places_deg=np.zeros(6))
    for _ in range(600):
        re, im = el.twice_of(state, SCALE, omega)
        rest = left - complex(*state.offset) - (re + 1j * im) * np.conj(i)
        twice = rest * np.exp(1j * theta)
        fixed = (rest.real.sum(), rest.imag.sum())
        state = el.turn(
            lessons(omega, places_deg=np.zeros(6), before=state),
            sums(omega, 4.0, n=n)._replace(fixed=fixed, twice=(twice.real.sum(), twice.imag.sum())),
            SCALE,
            1,
            0,
        )
    assert complex(*state.offset) == pytest.approx(-SCALE.R_s * offset, rel=0.01)
    assert complex(*state.gain) == pytest.approx(-k, rel=0.01)


def test_a_leg_whose_current_is_small_leaves_little_of_a_sample():
    """Unless all are, for there is nothing better then, or the legs lose nothing there."""
    nothing = el.start(SCALE, UNKNOWN, 0.01)
    state = nothing._replace(lost=(0.1, -0.3))
    u, i = 1.0, 4.0 * np.exp(1j * np.radians([90.0, 90.5, 93.0, 75.0, 60.0]))
    weights = [
        el.lost(state, SCALE, u, v.real, v.imag).weight for v in i
    ]  # phase a: 0, 0.03, 0.2, 1 and 2 A; ripple: 0.06 A
    assert max(weights[:2]) < 0.2
    assert weights[2:] == [1.0] * 3
    assert el.lost(state, SCALE, u, 0.0, 0.3).weight == 1.0
    assert el.lost(nothing, SCALE, u, 0.0, 4.0).weight == 1.0


@pytest.mark.parametrize("sensor", range(3))
def test_a_sensor_that_moves_takes_its_edges_along_and_the_others_stay(sensor):
    state = el.turn(lessons(600.0), sums(600.0, 2.0), SCALE, 1, 0)
    moved = el.moved(state, sensor, 5 * DEG)
    change = np.degrees(np.subtract(moved.places.actual, state.places.actual))
    assert change.reshape(4, 3) == pytest.approx(np.tile(5.0 * (np.arange(3) == 2 - sensor), (4, 1)))
    assert np.mean(moved.places.relative[:6]) == pytest.approx(0.0, abs=1e-12)
    again = np.add(moved.places.relative[:6], moved.common[0])
    before = np.add(state.places.relative[:6], state.common[0])
    assert np.degrees(again - before) == pytest.approx(change[:6])
