"""The forced angle and a given voltage: against the integrated ramp, the winding's equations, and a compass."""

import math

import numpy as np
import pytest
from rig import PWM_HZ, Rig, physical
from scipy.optimize import brentq

from protocol.messages import SetpointMode
from sim.drive import tick

T = 1.0 / PWM_HZ
R, L, PSI, N_P = 0.158, 0.176e-3, 6.55e-3, 6
IDEAL = {
    "firmware.observer": 0,
    "inverter.dead_time": 0.0,
    "firmware.dead_time.dead_time_hat": 0.0,
    "current_sensor.noise_rms": 0.0,
    "load.alpha_m_max": 0.0,
}


def made(**settings):
    bench = Rig(1, **IDEAL | settings)
    bench.start()
    return bench


def locked(theta_deg, **settings):
    """A rotor that the load machine holds at an electrical angle."""
    bench = made(**{"mechanics.theta_0_deg": theta_deg}, **settings)
    bench.load_setpoint(SetpointMode.SPEED, 0.0)
    return bench


def force(bench, **parameters):
    for name, value in parameters.items():
        bench.set_param(f"forced_{name}", value)
    bench.set_param("forced", 1.0)


def unwrapped(recorded):
    return np.unwrap(recorded["theta_ctrl"])


# -- the angle ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_the_forced_angle_is_the_integral_of_its_ramp(seed):
    rng = np.random.default_rng(seed)
    slope = float(np.float32(10.0 ** rng.uniform(1.0, 5.0)))
    speeds = [float(np.float32(w)) for w in rng.uniform(-1500.0, 1500.0, 4)]
    bench = made()
    force(bench, slope=slope)
    theta, omega = bench.advance(1)["theta_enc"][0], 0.0
    for target in speeds:
        bench.set_param("forced_speed", target)
        n = int(rng.integers(200, 3000))
        t = np.arange(1, n + 1) * T
        ramp = abs(target - omega) / slope
        way = math.copysign(slope, target - omega)
        during = omega * t + 0.5 * way * t**2
        after = 0.5 * (omega + target) * ramp + target * (t - ramp)
        expected = theta + np.where(t < ramp, during, after)
        found = np.unwrap(np.r_[theta, bench.advance(n)["theta_ctrl"]])[1:]
        found += math.tau * round((expected[0] - found[0]) / math.tau)
        assert np.abs(found - expected).max() < slope * T**2 + 1e-9 * np.abs(expected).max()
        theta = expected[-1]
        omega = omega + way * n * T if n * T < ramp else target


def test_it_begins_where_the_angle_of_the_control_is_and_the_telemetry_says_so():
    bench = made(**{"firmware.observer": 2})
    bench.forced(700, 0.0, 1.0)
    before = bench.advance(50)
    assert np.all(before["theta_ctrl"] == before["theta_vt"])
    force(bench)
    recorded = bench.advance(2000)
    assert np.all(recorded["theta_ctrl"] == recorded["theta_ctrl"][0])
    assert math.remainder(recorded["theta_ctrl"][0] - recorded["theta_vt"][0], math.tau) == pytest.approx(0.0, abs=1e-9)
    assert physical(recorded, "theta_ctrl") == pytest.approx(recorded["theta_ctrl"], abs=1e-4)
    bench.set_param("forced", 0.0)
    after = bench.advance(2)
    assert np.all(after["theta_ctrl"] == after["theta_vt"])


@pytest.mark.parametrize("way", [0.3, -0.3, 3.0, -3.0, 3.1])
def test_at_rest_it_goes_to_its_angle_the_shorter_way_once_that_is_set(way):
    bench = made()
    force(bench)
    start = bench.advance(1000)["theta_ctrl"]
    assert np.all(start == start[0])
    target = float(np.float32(math.remainder(start[0] + way, math.tau)))
    bench.set_param("forced_angle", target)
    moved = np.unwrap(np.r_[start[-1], bench.advance(10_000)["theta_ctrl"]])
    assert np.abs(np.diff(moved)).max() == pytest.approx(math.tau * T)
    assert np.count_nonzero(np.diff(moved)) == pytest.approx(abs(way) / (math.tau * T), abs=1)
    assert moved[-1] - moved[0] == pytest.approx(way, abs=1e-5)


def test_an_angle_that_was_set_to_zero_is_one_too():
    bench = made(**{"mechanics.theta_0_deg": 60.0})
    bench.set_param("forced_angle", 0.0)
    force(bench)
    assert bench.run(0.5)["theta_ctrl"][-1] == pytest.approx(0.0, abs=1e-9)


def test_a_turning_angle_does_not_go_to_the_one_for_rest_until_it_stands():
    bench = made()
    force(bench, slope=1000.0, angle=1.0, speed=40.0)
    bench.run(0.5)
    assert np.diff(unwrapped(bench.run(0.1))) == pytest.approx(40.0 * T)
    bench.set_param("forced_speed", 0.0)
    assert bench.run(1.0)["theta_ctrl"][-1] == pytest.approx(1.0, abs=1e-6)


def test_it_stands_still_while_the_outputs_are_off_and_begins_at_rest():
    bench = made()
    bench.enable(False)
    force(bench, slope=100.0, speed=50.0, angle=2.0)
    off = bench.advance(3000)["theta_ctrl"]
    assert np.all(off == off[0])
    bench.enable()
    on = np.unwrap(np.r_[off[-1], bench.advance(1600)["theta_ctrl"]]) - off[-1]
    assert on[-1] == pytest.approx(0.5 * 100.0 * 0.1**2, rel=2e-3)


def test_a_current_along_it_drags_the_rotor():
    """A rotor without a sensor that is trusted follows a current that turns, a load angle behind."""
    bench = made()
    force(bench, slope=50.0, speed=20.0)
    bench.setpoint(SetpointMode.CURRENT, 0.0, 4.0)
    bench.run(1.0)
    recorded = bench.run(1.0)
    turned = recorded["theta_true"][-1] - recorded["theta_true"][0]
    assert turned == pytest.approx(20.0, abs=0.3)
    behind = np.remainder(recorded["theta_ctrl"] - recorded["theta_true"] + math.pi, math.tau) - math.pi
    friction = 5e-3 + 1e-4 * 20.0 / N_P
    assert math.sin(behind.mean()) == pytest.approx(friction / (1.5 * N_P * PSI * 4.0), rel=0.1)


# -- the voltage ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("theta_deg", [0.0, 77.0, -140.0])
@pytest.mark.parametrize("u", [1.5j, -0.75 + 0.5j])
def test_a_voltage_on_a_locked_rotor_is_answered_by_its_winding(theta_deg, u):
    bench = locked(theta_deg)
    bench.advance(100)
    bench.setpoint(SetpointMode.VOLTAGE, u.imag, u.real)
    recorded = bench.advance(200)
    i = recorded["i_alpha_true"] + 1j * recorded["i_beta_true"]
    frame = np.exp(1j * recorded["theta_enc"])
    t = np.maximum(np.arange(200) - 1, 0) * T  # computed at the first sample, in force from the second on
    expected = u * frame / R * (1.0 - np.exp(-R / L * t))
    assert np.abs(i - expected).max() < 2e-3 * abs(u) / R
    volts = recorded["u_alpha"][2:] + 1j * recorded["u_beta"][2:]
    assert np.abs(volts - u * frame[2:]).max() < 1.5 / 1024
    assert np.abs(frame - np.exp(1j * recorded["theta_true"])).max() < math.radians(0.1)


def test_a_voltage_on_a_forced_angle_pulls_the_rotor_there_like_a_compass():
    bench = made(**{"firmware.observer": 2, "mechanics.b": 5e-3})
    for angle in (0.0, 2.0 * math.pi / 3.0, -2.0 * math.pi / 3.0):
        bench.set_param("forced_angle", angle)
        bench.set_param("forced", 1.0)
        bench.setpoint(SetpointMode.VOLTAGE, 0.0, 1.0)
        recorded = bench.run(2.0)
        held = math.asin(5e-3 / (1.5 * N_P * PSI / R))  # where dry friction may leave it
        assert abs(math.remainder(recorded["theta_true"][-1] - angle, math.tau)) <= held
        assert abs(recorded["i_alpha_true"][-1] + 1j * recorded["i_beta_true"][-1]) == pytest.approx(1.0 / R, rel=2e-3)
        assert bench.faults == 0


def test_a_voltage_turns_a_free_motor_as_fast_as_its_equations_say():
    u_q = 1.5
    bench = made()
    bench.setpoint(SetpointMode.VOLTAGE, u_q, 0.0)
    bench.run(1.0)
    recorded = bench.run(0.5)

    def currents(omega):  # 0 = R i_d - omega L i_q, u_q = R i_q + omega (L i_d + psi)
        i_q = (u_q - omega * PSI) / (R + (omega * L) ** 2 / R)
        return omega * L * i_q / R, i_q

    def balance(omega):
        return 1.5 * N_P * PSI * currents(omega)[1] - 5e-3 - 1e-4 * omega / N_P

    omega = brentq(balance, 1.0, u_q / PSI)
    assert recorded["omega_true"].mean() == pytest.approx(omega, rel=2e-3)
    assert recorded["i_q"].mean() == pytest.approx(currents(omega)[1], abs=0.02)


def test_nothing_is_asked_of_the_currents_in_voltage_and_an_integral_of_their_error_stays():
    bench = locked(30.0)
    bench.setpoint(SetpointMode.VOLTAGE, 1.0, 0.5)
    recorded = bench.advance(500)
    assert np.all(recorded["i_q_ref"][1:] == physical(recorded, "i_q")[:-1])
    assert recorded["i_d_ref"][1:] == pytest.approx(recorded["i_d"][:-1], abs=1.0 / 1024)


# -- changes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("i_q", [0.0, 3.0, -4.0])
@pytest.mark.parametrize("mode", [SetpointMode.CURRENT, SetpointMode.SPEED])
def test_the_loop_takes_over_at_the_voltage_that_is_there(mode, i_q):
    bench = locked(50.0)
    bench.setpoint(SetpointMode.VOLTAGE, 0.8, -0.3)
    before = bench.advance(400)
    bench.setpoint(mode, i_q)
    after = bench.advance(2000)
    u = np.r_[before["u_alpha"], after["u_alpha"]] + 1j * np.r_[before["u_beta"], after["u_beta"]]
    step = np.abs(np.diff(u))
    assert step[397:402].max() < 2.0 / 1024  # computed at the sample 400, in force until the sample 402
    assert step[402:].max() < math.tau * 800.0 * R * T * 16.0  # as fast as the integral goes
    if mode == SetpointMode.CURRENT:
        assert after["i_q"][-200:].mean() == pytest.approx(i_q, abs=0.02)
        assert after["i_d"][-200:].mean() == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("seed", range(8))
def test_no_change_of_mode_or_angle_moves_the_voltage_at_once_by_more_than_it_may(seed):
    """Random acts at random times on a turning and on a standing rotor; a current is asked for only after a voltage."""
    rng = np.random.default_rng(seed)
    bench = made(**{"firmware.protection.i_trip": 100.0})
    most = bench.parameters["u_test_max"]
    bench.forced(rng.uniform(-300.0, 300.0), 0.0, 0.2) if seed % 2 else bench.load_setpoint(SetpointMode.SPEED, 0.0)
    force(bench, slope=3000.0)
    acts = []
    u = [0.0j]
    for _ in range(60):
        act = rng.choice(["voltage", "voltage", "forced", "speed", "angle", "current"])
        if act == "voltage":
            bench.set_param("forced", 1.0)
            new = most * np.sqrt(rng.uniform()) * np.exp(1j * rng.uniform(0.0, math.tau))
            bench.setpoint(SetpointMode.VOLTAGE, new.imag, new.real)
        elif act == "forced" and bench.mode == SetpointMode.CURRENT:
            bench.set_param("forced", 1.0 - bench.parameters["forced"])
        elif act == "speed":
            bench.set_param("forced_speed", rng.uniform(-150.0, 150.0))
        elif act == "angle":
            bench.set_param("forced_angle", rng.uniform(-3.0, 3.0))
        elif act == "current" and bench.mode == SetpointMode.VOLTAGE:
            bench.setpoint(SetpointMode.CURRENT, *rng.uniform(-2.0, 2.0, 2))
        else:
            continue
        acts.append(act)
        recorded = bench.advance(int(rng.integers(1, 150)))
        u += list(recorded["u_alpha"] + 1j * recorded["u_beta"])
    assert {*acts} == {"voltage", "forced", "speed", "angle", "current"}
    assert bench.faults == 0
    turns = 200.0 * T * 2.0 * most  # what turning with the frame alone may change
    assert np.abs(np.diff(u)).max() < most + turns
    assert np.abs(u).max() > 0.8 * most


def test_stop_and_start_forget_a_voltage_and_begin_at_no_current():
    bench = locked(30.0)
    bench.setpoint(SetpointMode.VOLTAGE, 1.0, 0.5)
    bench.advance(500)
    bench.enable(False)
    off = bench.advance(500)
    assert not off["u_alpha"][1:].any()
    assert not off["u_beta"][1:].any()
    assert not bench.outputs_on
    assert bench.mode == 0
    bench.enable()
    on = bench.advance(1000)
    assert np.hypot(on["u_alpha"], on["u_beta"]).max() < 0.1
    assert np.hypot(on["i_alpha_true"], on["i_beta_true"])[-500:].max() < 0.05


def test_a_fault_ends_a_voltage():
    bench = locked(30.0)
    bench.setpoint(SetpointMode.VOLTAGE, 1.5, 0.0)
    bench.advance(100)
    bench.set_param("i_trip", 5.0)
    bench.advance(2)
    off = bench.advance(500)
    assert bench.faults
    assert not bench.outputs_on
    assert not off["u_alpha"].any()
    assert not off["u_beta"].any()
    assert abs(off["i_alpha_true"][-1]) < 1e-6


def test_the_loop_is_the_usual_one_until_it_is_needed_and_again_after_the_end_of_running():
    bench = made()
    for act in (
        lambda: bench.setpoint(SetpointMode.VOLTAGE, 0.5),
        lambda: bench.setpoint(SetpointMode.SPEED, 5.0, 1.0),
        lambda: bench.set_param("test", 4.0),
        lambda: bench.set_param("forced", 1.0),
    ):
        bench.setpoint(SetpointMode.SPEED, 5.0)
        assert bench._advance is tick.advance_usual
        act()
        assert bench._advance is tick.advance
        bench.advance(10)
        bench.setpoint(SetpointMode.CURRENT, 0.0)
        for name in ("test", "forced"):
            bench.set_param(name, 0.0)
        assert bench._advance is tick.advance  # what was in use ends smoothly
        bench.enable(False)
        bench.advance(10)
        bench.enable()
