import math

import numpy as np
import pytest
from ideal_motor import (
    IDEAL_EDGES,
    PAPER_EDGES,
    PSI_F,
    PWM_HZ,
    T_S,
    constant,
    error_deg,
    estimate,
    rpm,
    sectors,
    signals,
)

from sim.observers import programmable_filter


def last(s, out, turns=3.0):
    """Estimated less actual angle (deg) over the last turns."""
    speed = (s.theta[-1] - s.theta[-2]) / T_S
    n = round(turns * 2 * math.pi / abs(speed) * PWM_HZ)
    assert out.on[-n:].all()
    return error_deg(out.theta, s.theta)[-n:]


def steady(speed, turns=8.0, **kwargs):
    return signals(constant(rpm(speed)), 0.15 + turns * 2 * math.pi / abs(rpm(speed)), **kwargs)


@pytest.mark.parametrize("speed", [500.0, -500.0])
def test_a_start_without_a_transient(speed):
    """From its first sample on the filter is where it settles."""
    s = steady(speed)
    out = estimate(programmable_filter, s)
    first = int(np.argmax(out.on))
    assert first == int(np.searchsorted(s.tick, s.edge_tick[1])) + 1
    assert np.abs(error_deg(s.theta, out.theta))[first:].max() < 0.02
    assert np.abs(out.psi[first:] / PSI_F - 1).max() < 1e-3


def test_an_offset_does_not_add_up():
    """0.2 V of direct voltage would be 0.4 V s, sixty times the flux, after two seconds of an integrator."""
    omega = rpm(500)
    s = signals(constant(omega), 2.0)
    out = estimate(programmable_filter, s._replace(u_alpha=s.u_alpha + 0.2))
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
    out = estimate(programmable_filter, s, bw_omega_lpf=0.0)
    assert set(out.omega[out.on == 1]) == {out.omega[-1]}
    assert out.omega[-1] == pytest.approx(omega / share, rel=1e-3)
    assert last(s, out).mean() == pytest.approx(expected, abs=0.05)


def test_an_estimate_far_outside_the_sector_is_not_believed():
    """Sensors that contradict the back-EMF by half a turn: it starts at each edge, and is thrown out in time."""
    s = steady(300.0, edges_deg=IDEAL_EDGES - 180)
    out = estimate(programmable_filter, s)
    away = np.abs(error_deg(np.radians(60 * sectors(s.theta + np.pi) + 30), out.theta)) > 60 + 1e-9
    assert away.any()
    assert not (away[1:] & away[:-1]).any()
    assert np.array_equal(out.on[1:][away[:-1]], np.zeros(away[:-1].sum()))
