"""The bench as an object: repeatable, faults with their causes, outputs off, parameters, load machine."""

import numpy as np
import pytest
from rig import Rig, loop_records

from protocol.messages import DriveState, Fault, SetpointMode
from protocol.signals import STATUS_SOURCE_SHIFT, STATUS_STATE_MASK, AngleSource, Status


def spinning(omega_m=52.36, seconds=0.5, **overrides):
    bench = Rig(**overrides)
    bench.enable()
    bench.setpoint(SetpointMode.SPEED, omega_m)
    bench.advance(round(16000 * seconds))
    return bench


def states(recorded):
    return recorded.samples["status"] & STATUS_STATE_MASK


def current(recorded):
    return np.abs(np.array([recorded.samples[f"i_{x}"] for x in "abc"]).astype(float)).max(axis=0) / 1024


@pytest.mark.parametrize("glitches", [0.0, 5000.0])
def test_same_seed_same_bits_whatever_the_portions(glitches):
    def record(portions, seed):
        bench = Rig(seed, **{"wiring.hall_glitch": glitches})
        bench.enable()
        bench.set_param("observer", AngleSource.EDGE_KALMAN)  # takes over with sample 1600
        bench.setpoint(SetpointMode.SPEED, 100.0)
        runs = [bench.advance(n) for n in portions]
        assert bench.n == sum(portions)
        names = "samples", "load_samples", "edges", "edge_tick"
        found = [np.concatenate([getattr(run, name) for run in runs]).tobytes() for name in names]
        return [*found, *loop_records(runs)]

    whole = record([3000], 3)
    assert record([1, 0, 7, 256, 1000, 255, 80, 1, 2, 398, 1000], 3) == whole
    assert record([3000], 4)[0] != whole[0]
    assert record([3000], -1)[0] != whole[0]


def test_states_show_in_the_status_and_arming_initialises_the_observers():
    bench = Rig()
    assert list(states(bench.advance(2))) == [DriveState.IDLE] * 2
    bench.enter_state(DriveState.ARMED)
    armed = bench.advance(3)
    assert list(states(armed)) == [DriveState.ARMED] * 3
    assert list(armed.samples["status"] & Status.OBSERVERS_RESET > 0) == [True, False, False]
    assert not bench.outputs_on
    bench.enter_state(DriveState.RUNNING)
    assert bench.outputs_on
    running = bench.advance(3)
    assert list(states(running)) == [DriveState.RUNNING] * 3
    assert not np.any(running.samples["status"] & Status.OBSERVERS_RESET)
    assert set(running.samples["status"] >> STATUS_SOURCE_SHIFT) == {2}


def test_outputs_off_ends_the_current_and_the_torque_and_lets_the_shaft_coast():
    bench = spinning()
    bench.setpoint(SetpointMode.CURRENT, 6.0, -3.0)
    bench.advance(100)
    before = bench.truth
    assert before.i_q == pytest.approx(6.0, abs=1.0)
    bench.enable(False)
    assert not bench.outputs_on
    recorded = bench.advance(160)
    assert current(recorded)[5:].max() < 0.15
    assert np.abs(recorded.samples["tau_e_true"])[5:].max() == 0
    assert np.all(recorded.samples["u_alpha"] == 0)
    assert 0.9 * before.omega_m < bench.truth.omega_m < before.omega_m + 1.0


def test_speed_control_takes_over_a_shaft_that_turns_without_braking_it():
    bench = spinning(100.0)
    bench.setpoint(SetpointMode.CURRENT, 0.5, 0.0)
    bench.advance(800)
    omega_m = bench.truth.omega_m
    bench.setpoint(SetpointMode.SPEED, omega_m)
    taken = bench.advance(3200).samples["omega_true"]
    assert taken.min() > 0.9 * taken[0]


@pytest.mark.parametrize(("u_dc", "fault"), [(11.0, Fault.UNDERVOLTAGE), (33.0, Fault.OVERVOLTAGE)])
def test_voltage_faults_keep_the_outputs_off_while_the_cause_stands(u_dc, fault):
    bench = Rig(**{"inverter.u_dc": u_dc, "firmware.protection.u_dc_min": 12.0, "firmware.protection.u_dc_max": 32.0})
    bench.advance(10)
    assert bench.faults == 0  # no fault while idle, but its cause shows
    assert bench.fault_causes == fault
    bench.enable()
    recorded = bench.advance(10)
    assert bench.faults == fault
    assert not bench.outputs_on
    assert list(states(recorded)) == [DriveState.FAULT] * 10
    bench.enter_state(DriveState.FAULT)
    bench.clear_faults()
    bench.enable()
    bench.advance(1)
    assert bench.faults == fault


def test_overcurrent_opens_the_outputs_in_the_same_period():
    bench = spinning(**{"firmware.protection.i_trip": 7.0})
    assert bench.faults == 0
    bench.setpoint(SetpointMode.CURRENT, 8.0)
    recorded = bench.advance(400)
    trip = np.flatnonzero(states(recorded) == DriveState.FAULT)[0]
    assert bench.faults == Fault.OVERCURRENT
    assert current(recorded)[trip] > 7.0
    assert current(recorded)[:trip].max() <= 7.0
    assert current(recorded)[trip + 3 :].max() < 0.15
    assert bench.fault_causes == 0
    bench.clear_faults()
    assert bench.faults == 0
    bench.enable()
    bench.setpoint(SetpointMode.CURRENT, 2.0)
    assert states(bench.advance(100))[-1] == DriveState.RUNNING


@pytest.mark.parametrize(
    ("limits", "fine", "beyond"),
    [
        ({"firmware.protection.omega_m_trip": 200.0}, 180.0, 240.0),
        # below omega_m_trip, but the Hall sensors show 225 rad/s at most
        ({"firmware.protection.omega_m_trip": 400.0, "firmware.omega_m_max": 150.0}, 200.0, 340.0),
    ],
)
def test_overspeed_trips_by_the_hall_sensors_where_there_is_no_encoder(limits, fine, beyond):
    bench = spinning(90.0, 0.5, **{"encoder.present": 0}, **limits)
    bench.set_load_param("hall_glitch", 150.0)  # one false edge makes any speed
    assert np.abs(bench.advance(48000).samples["omega_avg"] * 0.125).max() > 200.0 * 6
    assert bench.faults == 0
    bench.set_load_param("hall_glitch", 0.0)
    for speed, fault in ((fine, 0), (beyond, Fault.OVERSPEED)):
        bench.load(SetpointMode.SPEED, speed)
        bench.advance(4000)
        assert bench.faults == fault


def test_every_edge_of_the_fastest_shaft_finds_room():
    bench = Rig(
        **{"motor.n_p": 64, "load.omega_m_max": 600.0, "load.alpha_m_max": 0.0, "clock.pwm_hz": 1000,
           "clock.substeps": 20}
    )  # fmt: skip
    bench.load(SetpointMode.SPEED, 600.0)
    recorded = bench.advance(100)
    assert len(recorded.edges) == pytest.approx(600.0 * 64 * 0.099 / (np.pi / 3), abs=3)


def test_parameters_are_known_by_name():
    with pytest.raises(KeyError, match="no parameter 'R_s'; there are: n_p"):
        Rig().set_param("R_s", 1.0)


def test_a_change_of_the_angle_source_is_bumpless():
    bench = spinning(100.0, 1.0)
    rng = np.random.default_rng(1)
    steps = []
    for source in (0, 1, 2, 1, 0, 2) * 4:
        before = bench.advance(1600 + int(rng.integers(100)))
        bench.set_param("observer", source)
        recorded = bench.advance(4)
        assert set(recorded.samples["status"] >> STATUS_SOURCE_SHIFT) == {source}
        torque = np.append(before.samples["tau_e_true"][-1:], recorded.samples["tau_e_true"]) / 16384
        steps.append(np.abs(np.diff(torque)).max())
        assert bench.truth.omega_m == pytest.approx(100.0, abs=8.0)
    assert np.median(steps) < 0.02
    assert max(steps) < 0.05


def test_the_largest_resistance_leaves_the_plant_sound():
    bench = spinning(80.0, 0.5)
    bench.set_param("R_s_hat", 100.0)
    bench.setpoint(SetpointMode.CURRENT, 4.0)
    bench.advance(8000)
    assert np.isfinite(bench.truth).all()


def test_truth_is_the_plants_state_at_the_last_sample():
    bench = spinning()
    recorded = bench.advance(100)
    truth = bench.truth
    assert truth.omega_e == 6 * truth.omega_m
    assert recorded["theta_true"][-1] == truth.theta_e
    assert recorded["omega_true"][-1] == truth.omega_e
    assert recorded.samples["tau_e_true"][-1] / 16384 == pytest.approx(truth.tau_e, abs=1e-4)
