import math

import numpy as np
import pytest
from ideal_motor import (
    IDEAL_EDGES,
    L_S,
    PAPER_EDGES,
    PSI_F,
    PWM_HZ,
    R_S,
    T_S,
    TICK_HZ,
    constant,
    error_deg,
    glitch,
    own,
    rpm,
    samples,
    sectors,
    signals,
    track,
)

from sim.observers import programmable_filter


def estimate(s, **drive):
    params = programmable_filter.make_params(PWM_HZ, own(programmable_filter, **drive))
    return track(programmable_filter, params, s)


def last(s, out, turns=3.0):
    """Estimated less actual angle (deg) over the last turns."""
    speed = (s.theta[-1] - s.theta[-2]) / T_S
    n = round(turns * 2 * math.pi / abs(speed) * PWM_HZ)
    assert out.on[-n:].all()
    return error_deg(out.theta, s.theta)[-n:]


def steady(speed, turns=8.0, **kwargs):
    return signals(constant(rpm(speed)), 0.15 + turns * 2 * math.pi / abs(rpm(speed)), **kwargs)


@pytest.mark.parametrize("speed", [50.0, 500.0, 3000.0, -50.0, -500.0, -3000.0])
@pytest.mark.parametrize("i_q", [0.0, 8.0])
def test_exact_at_constant_speed_with_ideal_sensors(speed, i_q):
    """Angle and length of the flux, without a bias that grows with the speed; omega_h is exact to a tick."""
    s = steady(speed, i_q=i_q)
    out = estimate(s)
    a_tick = abs(rpm(speed)) / TICK_HZ / (math.pi / 3)  # relative error of omega_h
    error = last(s, out)
    assert abs(error.mean()) < 0.002
    assert np.abs(error).max() < np.degrees(1.5 * a_tick) + 1e-6
    np.testing.assert_allclose(out.psi[-100:], PSI_F, rtol=2 * a_tick + 1e-9)
    np.testing.assert_allclose(out.omega[-100:], rpm(speed), rtol=1.1 * a_tick)


@pytest.mark.parametrize("speed", [500.0, -500.0])
def test_a_start_without_a_transient(speed):
    """From its first sample on the filter is where it settles."""
    s = steady(speed)
    out = estimate(s)
    first = int(np.argmax(out.on))
    assert first == int(np.searchsorted(s.tick, s.edge_tick[1])) + 1
    assert np.abs(error_deg(s.theta, out.theta))[first:].max() < 0.02
    assert np.abs(out.psi[first:] / PSI_F - 1).max() < 1e-3


@pytest.mark.parametrize("factor", [0.8, 1.2])
@pytest.mark.parametrize("speed", [500.0, 3000.0, -500.0])
def test_a_wrong_inductance_is_a_load_angle(speed, factor):
    s = steady(speed, i_q=8.0)
    expected = np.degrees(math.atan((1 - factor) * L_S * 8.0 / PSI_F))
    assert abs(expected) > 2
    assert last(s, estimate(s, L_s_hat=factor * L_S)).mean() == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("speed", [500.0, 3000.0])
def test_a_wrong_resistance_changes_the_length_and_not_the_angle(speed):
    """R i is along the back-EMF, whose integral is along the flux."""
    s = steady(speed, i_q=8.0)
    out = estimate(s, R_s_hat=0.5 * R_S)
    assert abs(last(s, out).mean()) < 0.01
    more = 0.5 * R_S * 8.0 * T_S / (2 * math.tan(rpm(speed) * T_S / 2))
    assert out.psi[-1] == pytest.approx(PSI_F + more, rel=1e-4)


def test_an_offset_does_not_add_up():
    """0.2 V of direct voltage would be 0.4 V s, sixty times the flux, after two seconds of an integrator."""
    omega = rpm(500)
    s = signals(constant(omega), 2.0)
    out = estimate(s._replace(u_alpha=s.u_alpha + 0.2))
    # three stages, each 1 / cos(30 deg) at zero frequency against unit gain at omega; then 1 / omega
    flux = 0.2 / omega / math.cos(math.pi / 6) ** 3
    expected = np.degrees(math.asin(flux / PSI_F))
    error = error_deg(s.theta, out.theta)
    assert expected > 5
    for part in (error[PWM_HZ // 2 : PWM_HZ], error[-PWM_HZ // 2 :]):
        assert np.abs(part).max() == pytest.approx(expected, rel=0.02)
        assert abs(part.mean()) < 0.1


@pytest.mark.parametrize("sector", range(6))
def test_a_wrong_speed_is_a_wrong_lag(sector):
    """The filter stays tuned to its first omega_h (bandwidth 0), which Table I makes wrong: atan of each stage."""
    omega = rpm(200)
    start = np.radians(PAPER_EDGES[sector]) - 0.1
    s = signals(constant(omega, start), 0.6, edges_deg=PAPER_EDGES)
    width = np.diff(np.r_[PAPER_EDGES, 360 + PAPER_EDGES[0]])[sector]
    share = width / 60.0  # omega by the tuned speed
    expected = 90 - 3 * np.degrees(math.atan(math.tan(math.pi / 6) * share))
    out = estimate(s, bw_omega_lpf=0.0)
    assert set(out.omega[out.on == 1]) == {out.omega[-1]}
    assert out.omega[-1] == pytest.approx(omega / share, rel=1e-3)
    assert last(s, out).mean() == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("speed", [500.0, -500.0])
def test_the_sensors_of_table_i_come_in_through_the_speed_alone(speed):
    """A ripple, less with a narrower filter of omega_h, and a lead by what omega_h is too high in the mean."""
    s = signals(constant(rpm(speed)), 2.0, edges_deg=PAPER_EDGES)
    errors = [last(s, estimate(s, bw_omega_lpf=bw), 20.0) for bw in (10.0, 50.0, 200.0)]
    assert [error.std() for error in errors] == pytest.approx([0.44, 1.9, 3.6], rel=0.1)
    share = samples(s).hall.omega[-PWM_HZ:].mean() / rpm(speed) - 1
    assert 0.008 < share < 0.012
    lead = np.sign(speed) * np.degrees(1.5 * math.sin(math.pi / 3)) * share
    assert errors[1].mean() == pytest.approx(lead, rel=0.05)


def test_a_step_of_the_current_does_not_reach_the_angle():
    n = round(0.5 * PWM_HZ)
    s = signals(constant(rpm(500)), 0.5, i_q=np.where(np.arange(n) < n // 2, 0.0, 8.0))
    assert np.abs(last(s, estimate(s), 20.0)).max() < 0.01


def test_a_rising_speed():
    """While the rotor speeds up omega_h lags it and the stages are tuned wrong; right after, they are not."""
    slope = 3000.0
    s = signals(
        lambda t: 0.3 + rpm(300) * t + slope * (np.clip(t - 0.2, 0, 0.1) ** 2 / 2 + 0.1 * np.maximum(t - 0.3, 0)),
        0.5,
        fine=4,
    )
    error = error_deg(estimate(s).theta, s.theta)
    ramp = (s.tick > 0.2 * TICK_HZ) & (s.tick < 0.3 * TICK_HZ)
    assert 3 < np.abs(error[ramp]).max() < 12
    assert np.abs(error[-PWM_HZ // 10 :]).max() < 0.05


def test_on_and_off_have_hysteresis():
    """From 100 r/min down to between the thresholds, then below them, and up again."""
    between, below = 16.0, 8.0
    speeds = np.repeat([rpm(100), between, below, between, rpm(100)], [4000, 8000, 12000, 8000, 4000])
    way = np.cumsum(speeds) * T_S
    t_all = np.arange(speeds.size) * T_S
    s = signals(lambda t: 0.3 + np.interp(t, t_all, way), speeds.size * T_S)
    out = estimate(s)
    assert out.on[3000:12000].all()
    assert not out.on[16000:32000].any()
    assert out.on[-1000:].all()
    assert not out.psi[out.on == 0].any()
    np.testing.assert_array_equal(out.theta[out.on == 0], samples(s).theta_avg[out.on == 0])


def test_outputs_off_leave_it_to_the_edges():
    s = steady(500.0, 40.0)
    off = slice(3000, 4000)
    s.u_alpha[off] = s.u_beta[off] = 0.0
    out = estimate(s)
    assert not out.on[off].any()
    assert np.abs(error_deg(s.theta, out.theta))[off].max() < 0.1
    assert out.on[4000:].mean() > 0.9
    assert np.abs(last(s, out)).max() < 0.01


def test_reversal():
    """Off a sample after the edge that shows it, on again from the next: its angle is known, and its speed."""
    omega, turn_at = rpm(100), 0.3003
    s = signals(lambda t: 0.3 + omega * np.where(t < turn_at, t, 2 * turn_at - t), 0.6, fine=10)
    out = estimate(s)
    first = np.searchsorted(s.edge_tick, turn_at * TICK_HZ)
    back, again = np.searchsorted(s.tick, s.edge_tick[first : first + 2])
    assert list(out.on[[back, back + 1, again, again + 1]]) == [1, 0, 0, 1]
    assert not out.on[back + 1 : again].any()
    assert out.omega[-1] == pytest.approx(-omega, rel=1e-3)
    assert np.abs(last(s, out, 1.0)).max() < 0.1


def test_an_estimate_far_outside_the_sector_is_not_believed():
    """Sensors that contradict the back-EMF by half a turn: it starts at each edge, and is thrown out in time."""
    s = steady(300.0, edges_deg=IDEAL_EDGES - 180)
    out = estimate(s)
    away = np.abs(error_deg(np.radians(60 * sectors(s.theta + np.pi) + 30), out.theta)) > 60 + 1e-9
    assert away.any()
    assert not (away[1:] & away[:-1]).any()
    assert np.array_equal(out.on[1:][away[:-1]], np.zeros(away[:-1].sum()))


@pytest.mark.parametrize("ahead", [1, -1])
@pytest.mark.parametrize("speed", [300.0, -300.0])
def test_a_short_pulse(speed, ahead):
    """One false sample moves the filtered speed by its gain at most, for a while: 4 deg, not 60; a false reversal 0."""
    s = steady(speed, 30.0)
    clean, hit = estimate(s), estimate(glitch(s, 30, 0.0015, ahead))
    assert hit.on[1000:].all()
    moved = np.abs(error_deg(clean.theta, hit.theta))
    if ahead > 0:
        assert 1.0 < moved.max() < 5.0
    else:
        assert moved.max() < 0.01
    assert moved[-1000:].max() < 0.01
