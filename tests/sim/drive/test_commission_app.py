"""What the drive refuses of commissioning, with which code and number, and that it says so in its identity."""

import math

import numpy as np
import pytest
from rig import Rig

from protocol.codes import TestSignal
from protocol.errors import Refused
from protocol.messages import DriveState, ErrorCode, Feature, SetpointMode
from protocol.signals import Flag
from sim.config.params import load_params
from sim.drive.apps import DriveApp
from sim.ports.device import SimulatedDevice

VOLTAGE, CURRENT, SPEED = SetpointMode.VOLTAGE, SetpointMode.CURRENT, SetpointMode.SPEED


class Drive(DriveApp):
    """A drive that runs, its rotor held."""

    def __init__(self, **settings):
        self.bench = Rig(1, **{"load.alpha_m_max": 0.0} | settings)
        super().__init__(self.bench)
        self.bench.start()
        self.bench.load_setpoint(SPEED, 0.0)
        self.bench.advance(10)

    def refuses(self, act, *arguments):
        """The code and the detail with which it refuses, and nothing changes."""
        before = dict(self.bench.parameters), self.bench._drive
        with pytest.raises(Refused) as refusal:
            act(*arguments)
        assert (dict(self.bench.parameters), self.bench._drive) == before
        return refusal.value.code, refusal.value.detail


def test_voltage_needs_the_forced_angle_or_the_encoder():
    drive = Drive()
    for source in (2, 1, 10):
        drive.set_param("observer", source)
        assert drive.refuses(drive.setpoint, VOLTAGE, 0.5, 0.0) == (ErrorCode.NOT_SUPPORTED, VOLTAGE)
    drive.set_param("observer", 0.0)
    drive.setpoint(VOLTAGE, 0.5, 0.0)
    drive.set_param("observer", 0.0)  # nothing changes
    assert drive.refuses(drive.set_param, "observer", 2.0) == (ErrorCode.WRONG_STATE, DriveState.RUNNING)
    drive.set_param("forced", 1.0)
    drive.set_param("observer", 2.0)
    assert drive.refuses(drive.set_param, "forced", 0.0) == (ErrorCode.WRONG_STATE, DriveState.RUNNING)
    drive.setpoint(CURRENT, 0.0, 0.0)
    drive.set_param("forced", 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_voltage_is_limited_in_size_and_in_how_far_it_jumps(seed):
    rng = np.random.default_rng(seed)
    drive = Drive(**{"firmware.observer": 0})
    most = drive.get_param("u_test_max")
    far = (ErrorCode.OUT_OF_RANGE, most)
    there = 0j
    for _ in range(60):
        new = 1.2 * most * rng.uniform() * np.exp(1j * rng.uniform(0.0, math.tau))
        asked = drive.setpoint, VOLTAGE, new.imag, new.real
        if abs(new) > most or abs(new - there) > 1.05 * most + 4e-3:
            assert drive.refuses(*asked) == far
        elif abs(new - there) < most:
            asked[0](*asked[1:])
            there = new
            drive.bench.advance(int(rng.integers(2, 50)))
    drive.setpoint(CURRENT, 0.0, 0.0)
    drive.bench.run(0.2)
    drive.setpoint(VOLTAGE, 0.0, -most)  # the limit itself
    drive.bench.advance(10)
    assert drive.refuses(drive.setpoint, VOLTAGE, 0.0, 0.2 * most) == far
    assert drive.bench.faults == 0


def test_speed_and_a_forced_angle_exclude_each_other():
    drive = Drive(**{"firmware.observer": 0})
    drive.setpoint(SPEED, 10.0, 0.0)
    assert drive.refuses(drive.set_param, "forced", 1.0) == (ErrorCode.WRONG_STATE, DriveState.RUNNING)
    drive.setpoint(CURRENT, 0.0, 0.0)
    drive.set_param("forced", 1.0)
    assert drive.refuses(drive.setpoint, SPEED, 10.0, 0.0) == (ErrorCode.NOT_SUPPORTED, SPEED)
    drive.set_param("forced", 0.0)
    drive.setpoint(SPEED, 10.0, 0.0)
    drive.enter_state(DriveState.IDLE)
    drive.set_param("forced", 1.0)  # nothing is in use


LIMITS = {"forced_speed": 6 * 330.0, "test_voltage": 1.5, "test_current": 8.0, "test_speed": 330.0}


@pytest.mark.parametrize(("name", "limit"), LIMITS.items(), ids=LIMITS)
@pytest.mark.parametrize("state", [DriveState.IDLE, DriveState.RUNNING])
def test_amplitudes_and_the_forced_speed_have_the_limits_of_what_they_are(name, limit, state):
    drive = Drive(**{"firmware.protection.u_test_max": 1.5})
    drive.enter_state(state)
    above = float(np.nextafter(np.float32(limit), np.float32(1e9)))
    drive.set_param(name, limit)
    assert drive.refuses(drive.set_param, name, above) == (ErrorCode.OUT_OF_RANGE, limit)
    if name == "forced_speed":
        drive.set_param(name, -limit)
        assert drive.refuses(drive.set_param, name, -above) == (ErrorCode.OUT_OF_RANGE, limit)


def test_a_d_current_beside_a_speed_is_limited():
    drive = Drive()
    drive.setpoint(SPEED, 1.0, -8.0)
    assert drive.refuses(drive.setpoint, SPEED, 1.0, 8.001) == (ErrorCode.OUT_OF_RANGE, 8.0)


def test_one_test_signal_ends_before_another_begins():
    drive = Drive()
    drive.set_param("test", TestSignal.U_D)
    for other in (TestSignal.U_D, TestSignal.SPEED):
        assert drive.refuses(drive.set_param, "test", other) == (ErrorCode.BUSY, other)
    drive.set_param("test", TestSignal.OFF)
    drive.set_param("test", TestSignal.OFF)
    drive.set_param("test", TestSignal.SPEED)


def test_what_is_volatile_is_not_stored_and_has_the_same_value_at_each_boot(tmp_path):
    store = tmp_path / "store.json"
    bench = Rig(1)
    drive = DriveApp(bench, store)
    volatile = {p.name for p in drive.parameters if p.flags & Flag.VOLATILE}
    assert {"forced", "forced_speed", "test", "test_length"} < volatile
    drive.set_param("forced_slope", 7.0)
    drive.set_param("u_test_max", 1.25)
    drive.commit()
    again = DriveApp(Rig(1), store)
    assert again.get_param("u_test_max") == 1.25
    for name in volatile:
        assert again.get_param(name) == again.default_param(name) == Drive().default_param(name)


def test_a_drive_without_an_encoder_has_no_constants_of_one_and_voltage_by_the_forced_angle_only():
    drive = Drive(**{"encoder.present": 0})
    assert not [p.name for p in drive.parameters if "encoder" in p.name]
    assert drive.refuses(drive.setpoint, VOLTAGE, 0.5, 0.0) == (ErrorCode.NOT_SUPPORTED, VOLTAGE)
    drive.set_param("forced", 1.0)
    drive.setpoint(VOLTAGE, 0.5, 0.0)
    assert {p.name for p in Drive().parameters} - {p.name for p in drive.parameters} == {
        "encoder_lines", "encoder_reverse", "encoder_zero",
    }  # fmt: skip


def test_the_identity_says_that_the_drive_can_be_commissioned():
    device = SimulatedDevice(load_params())
    assert device.drive.identity.features & Feature.COMMISSION
    assert not device.load.identity.features & Feature.COMMISSION


def test_hall_sensors_that_are_believed_again_trip_by_what_was_counted_meanwhile():
    drive = Drive(**{"firmware.observer": 0})
    drive.bench.set_load_param("hall_open", 7.0)
    drive.bench.run(0.5)
    assert drive.bench.faults == 0
    drive.set_param("forced", 1.0)
    drive.set_param("observer", 1.0)
    drive.bench.run(0.5)
    assert drive.bench.faults == 0
    drive.set_param("forced", 0.0)
    drive.bench.advance(2)
    assert drive.bench.faults.name == "HALL"
