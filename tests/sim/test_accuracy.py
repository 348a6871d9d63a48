"""The closed loop of simulated plant and firmware where `bench accept` does not look: its bands have the rest."""

import math

import numpy as np
import pytest

from tests.sim.drive.rig import PWM_HZ, Rig, column, error_deg, physical

ENCODER, VECTOR = 0, 2


def running(source, overrides=None, **parameters):
    """A bench with drive and load machine running, at zero current and torque."""
    bench = Rig(1, **overrides or {})
    for name, value in {"observer": source, **parameters}.items():
        bench.set_param(name, value)
    bench.start()
    return bench


def settled(bench, rpm, i_q, settle, seconds):
    """What `seconds` record at a forced speed, `settle` s after it was reached."""
    bench.forced(rpm, i_q, settle)
    return bench.run(seconds)


def test_with_an_ideal_inverter_50_rpm_are_held_within_half_a_degree():
    ideal = {"inverter.dead_time": 0.0, "firmware.dead_time.dead_time_comp": 0.0}
    recorded = settled(running(VECTOR, ideal), 50, 4.0, 1.0, 2.0)
    assert error_deg(recorded, "theta_vt").std() < 0.6
    assert abs(error_deg(recorded, "theta_vt").mean()) < 0.1


@pytest.mark.parametrize("observer", [VECTOR, ENCODER])
def test_load_angle_does_not_wind_up_at_the_voltage_limit(observer):
    """At 3300 r/min 8 A cannot flow. The error that is left for seconds must not turn the estimate, then or after."""
    ampere = math.degrees(11.0 / (2.0 * math.pi * 800.0))  # deg that (18) adds in steady state
    bench = running(observer, load_angle_comp=1)

    def after(rpm, i_q, seconds):
        """Mean error and mean of (18) over the last quarter of a second, deg."""
        recorded = bench.forced(rpm, i_q, seconds)
        last = slice(-PWM_HZ // 4, None)
        delta = np.degrees(column(recorded, "delta_hat")[last].mean())
        return error_deg(recorded, "theta_vt")[last].mean(), delta, recorded

    before, delta, _ = after(500, 0.0, 1.0)
    assert abs(delta) < 0.15
    error, delta, limited = after(3300, 8.0, 4.0)
    size = np.hypot(physical(limited, "u_alpha"), physical(limited, "u_beta"))[-PWM_HZ:]
    assert np.all(size > 24.0 / math.sqrt(3.0) - 0.01)
    missing = 8.0 - physical(limited, "i_q")[-PWM_HZ:].mean()
    assert missing > 4.0  # integrated as it is, more than 2000 deg in the last second
    assert error == pytest.approx(before, abs=1.5)
    at_once, delta, _ = after(500, 0.0, 0.35)
    assert at_once == pytest.approx(before, abs=0.15)
    assert abs(delta) < 0.15
    _, delta, _ = after(500, 8.0, 0.5)
    assert delta == pytest.approx(8.0 * ampere, abs=0.15)
