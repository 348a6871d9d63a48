"""Hall sensors, encoder, current sensors and the noise on them."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from sim.plant import current_sensor, encoder, hall_sensor, noise
from tests.sim.drive.rig import Rig, error_deg

TABLE_I = (-1.2, -3.0, 7.2, -3.3, 0.6, 5.6)
QUANTILES = noise.table()
RNG = np.uint64(noise.advance(noise.seeded(1)))


@pytest.mark.parametrize("ring", [0.0, 30.0, -75.0, 180.0, -360.0, 360.0])
@pytest.mark.parametrize("degrees", [-400.0, -1.0, 0.0, 1.3, 52.0, 53.0, 200.0, 361.0, 1000.0])
def test_sector_at_boot(degrees, ring):
    params = hall_sensor.make_params(TABLE_I, 0.5, 0.0, offset_deg=ring)
    state = hall_sensor.init(params, math.radians(degrees), QUANTILES, RNG)
    edges = {n: ring + 60.0 * n - TABLE_I[n % 6] for n in range(-20, 30)}
    assert state.number == max(n for n, edge in edges.items() if edge <= degrees)


def test_jitter_has_its_rms_and_no_edge_is_met_twice():
    params = hall_sensor.make_params([0.0] * 6, 0.0, 0.2)
    rng = RNG
    below, above = [], []
    for _ in range(4000):
        rng = np.uint64(noise.advance(rng))
        state = hall_sensor.enter(params, 0, math.radians(30.0), QUANTILES, rng)
        below.append(math.degrees(state.below))
        above.append(math.degrees(state.above) - 60.0)
        at_edge = hall_sensor.enter(params, 0, 0.0, QUANTILES, rng)
        assert at_edge.below < 0.0
    assert np.std(below) == pytest.approx(0.2, rel=0.04)
    assert np.std(above) == pytest.approx(0.2, rel=0.04)
    assert abs(np.mean(below)) < 0.02
    assert abs(np.corrcoef(below, above)[0, 1]) < 0.06


@pytest.mark.parametrize(("omega_0", "omega_1"), [(100.0, 120.0), (0.0, 5.0), (-40.0, -39.0), (3.0, -0.5)])
def test_edge_time_solves_the_cubic(omega_0, omega_1):
    h = 1 / 32000.0
    theta_0, theta_1 = 1.0, 1.0 + 0.5 * h * (omega_0 + omega_1)
    theta = theta_0 + 0.37 * (theta_1 - theta_0)

    def hermite(x):
        return (
            (2 * x**3 - 3 * x**2 + 1) * theta_0 + (x**3 - 2 * x**2 + x) * h * omega_0
            + (3 * x**2 - 2 * x**3) * theta_1 + (x**3 - x**2) * h * omega_1 - theta
        )  # fmt: skip

    x = hall_sensor.time_of(theta_0, omega_0, theta_1, omega_1, h, theta)
    assert x == pytest.approx(brentq(hermite, 0.0, 0.999 if omega_1 * omega_0 >= 0 else 0.6), abs=1e-4)


def test_encoder_counts_and_their_angle():
    params, wrong = (encoder.make_params(3600, 0.0, 100.0, 6, n_p_hat, 1 / 16000.0) for n_p_hat in (6, 4))
    for theta_e in (-0.001, 0.0, 0.001, 3.0, 6 * 2 * math.pi - 1e-6, 6 * 2 * math.pi, 500.0, -500.0):
        turns = (theta_e / 6) / (2 * math.pi) % 1.0
        counter = encoder.count(params, theta_e, 0.0) % 14400
        assert counter == encoder.count(wrong, theta_e, 0.0) % 14400 == int(turns * 14400) % 14400
        assert encoder.angle(wrong, counter) == pytest.approx(encoder.angle(params, counter) * 4 / 6)
        error = (encoder.angle(params, counter) - theta_e + math.pi) % (2 * math.pi) - math.pi
        assert abs(math.degrees(error)) <= 0.075 + 1e-9  # half of 0.15 deg
    ahead = encoder.make_params(3600, 10.0, 100.0, 6, 6, 1 / 16000.0)
    assert encoder.count(ahead, 0.0, 0.0) == int(10.0 / 0.15)


@pytest.mark.parametrize("omega_m", [5.0, 52.36, -314.0])
def test_encoder_speed_settles_on_the_truth_over_many_turns(omega_m):
    T_s = 1 / 16000.0
    params = encoder.make_params(3600, 0.0, 100.0, 6, 6, T_s)
    state = encoder.init(0)
    speeds = []
    for k in range(1, 8000):
        count = encoder.count(params, 6 * omega_m * k * T_s, 6 * omega_m) % 14400
        state, omega_e = encoder.track(params, state, count)
        speeds.append(omega_e)
    assert np.mean(speeds[2000:]) == pytest.approx(6 * omega_m, rel=2e-3)
    assert np.std(speeds[2000:]) < 1.0


def test_current_sensor_gain_offset_steps_and_range():
    params = current_sensor.make_params(0.0, (0.1, 0.0, 0.0), (0.02, 0.0, 0.0), 20.0, 12)
    step = 20.0 / 2048
    quiet = 0.0, 0.0, 0.0
    measured, _, _ = current_sensor.measure(params, (5.0, 0.0, 0.0), quiet)
    assert measured == round((5.0 * 1.02 + 0.1) / step) * step
    assert current_sensor.measure(params, (0.0, 99.0, 0.0), quiet)[1] == 2047 * step
    assert current_sensor.measure(params, (0.0, -99.0, 0.0), quiet)[1] == -20.0


def test_noise_is_normal_repeatable_and_seeded():
    def draw(seed, n=20000):
        rng, values = noise.seeded(seed), []
        for _ in range(n):
            rng = np.uint64(noise.advance(rng))
            values.append([f(QUANTILES, rng) for f in (noise.first, noise.second, noise.third)])
        return np.array(values)

    one = draw(1)
    assert np.array_equal(one, draw(1))
    assert not np.array_equal(one[:100], draw(2, 100))
    assert np.abs(one.mean(axis=0)).max() < 0.03
    assert one.std(axis=0) == pytest.approx([1.0, 1.0, 1.0], rel=0.02)
    assert np.mean(np.abs(one) < 1.0) == pytest.approx(0.6827, abs=0.01)
    assert np.abs(np.corrcoef(one.T) - np.eye(3)).max() < 0.03
    assert abs(np.corrcoef(one[1:, 0], one[:-1, 0])[0, 1]) < 0.03


def test_an_eccentric_disc_errs_once_a_turn_and_uneven_marks_within_a_line():
    params = encoder.make_params(100, 0.0, 100.0, 1, 1, 1 / 16000.0, eccentricity_deg=2.0)
    theta = np.linspace(0.0, 2.0 * np.pi, 40_000, endpoint=False)
    counts = np.unwrap([encoder.count(params, x, 0.0) for x in theta], period=400)
    error = np.degrees((counts + 0.5) * 2.0 * np.pi / 400 - theta)
    assert 2.0 * np.mean(error * np.sin(theta)) == pytest.approx(2.0, rel=1e-3)
    uneven = encoder.make_params(100, 0.0, 100.0, 1, 1, 1 / 16000.0, unevenness=0.3)
    steps = np.flatnonzero(np.diff([encoder.count(uneven, x, 0.0) for x in theta])) + 1
    widths = np.diff(theta[steps]) * 400 / (2.0 * np.pi)
    # c(x) = x + 0.3 sin(pi x / 2) reaches whole numbers where brentq says
    edges = [brentq(lambda x, n=n: x + 0.3 * math.sin(0.5 * math.pi * x) - n, n - 1, n + 1) for n in range(1, 5)]
    np.testing.assert_allclose(widths[:3], np.diff(edges), atol=0.03)
    assert min(widths) > 0.5


def test_pole_pairs_have_edges_of_their_own_that_stay():
    params = hall_sensor.make_params(TABLE_I, 0.0, 0.0, n_p=4, pole_pair_deg=1.5)
    alike = hall_sensor.make_params(TABLE_I, 0.0, 0.0)
    own = np.degrees([hall_sensor.edge_angle(params, n) - hall_sensor.edge_angle(alike, n) for n in range(-24, 48)])
    np.testing.assert_allclose(own[:24], own[24:48], atol=1e-9)
    np.testing.assert_allclose(own[:24], own[48:], atol=1e-9)
    assert np.abs(own).max() <= 1.5
    assert 0.5 < own[:24].std() < 1.2  # 0.87 of the uniform distribution
    assert abs(np.corrcoef(own[:23], own[1:24])[0, 1]) < 0.5


@pytest.mark.parametrize("rpm", [200.0, -200.0])
def test_until_the_index_has_come_by_the_encoder_counts_from_where_it_booted(rpm):
    rig = Rig(0, **{"encoder.index_search": 1, "mechanics.theta_0_deg": 60.0})
    rig.start()
    run = rig.forced(rpm, 0.0, 0.6)
    turned = run["theta_true"] / (2 * np.pi * 6)  # mechanical turns; the index is at whole ones
    searching = np.floor(turned) == 0
    off = error_deg(run, "theta_enc")
    assert 100 < searching.sum() < len(off) - 2000
    np.testing.assert_allclose(off[searching][:-1], 60.0, atol=0.31)
    np.testing.assert_allclose(off[~searching][1:], 0.0, atol=0.16)
    assert abs(run["omega_enc"][-1] - run["omega_true"][-1]) < 0.5
    assert np.ptp(run["omega_enc"][4800:]) < 1.0  # the jump of the count is none of the speed
    at_edges = run.edges["encoder"].astype(float) / 14_400
    assert np.all(at_edges < 1.0)
