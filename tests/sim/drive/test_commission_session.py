"""Commissioning through the protocol: whatever ends RUNNING ends all of it, and a host is told."""

from itertools import pairwise

import numpy as np
import pytest
from small_host import SmallHost

from protocol.messages import BlobWrite, Command, DriveState, Fault, SetpointMode
from protocol.signals import DRIVE_PARAMETERS, Flag
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink

VOLATILE = [p.name for p in DRIVE_PARAMETERS if p.flags & Flag.VOLATILE]
ASKED = {
    "forced_speed": 60.0,
    "forced_slope": 400.0,
    "forced": 1.0,
    "test_voltage": 0.5,
    "test_periods": 9.0,
    "test": 1.0,
}
CHANNELS = ["u_alpha", "u_beta", "theta_ctrl", "status"]


def stopped(host, device):
    host.command(Command.STOP)
    return DriveState.IDLE


def starved(host, device):
    host.run(0.3, alive=False)
    assert device.drive.machine.faults is Fault.WATCHDOG
    return DriveState.FAULT


def tripped(host, device):
    host.set("i_trip", 0.5)
    host.run(0.02)
    assert device.drive.machine.faults is Fault.OVERCURRENT
    return DriveState.FAULT


@pytest.mark.parametrize("end", [stopped, starved, tripped])
def test_whatever_ends_running_ends_all_of_it(end):
    device = SimulatedDevice(load_params())
    host = SmallHost(VirtualLink(device, step=0.002))
    host.stream(CHANNELS)
    defaults = {name: host.get(name).default for name in VOLATILE}
    host.start()
    for name, value in ASKED.items():
        assert host.set(name, value) == value
    host.setpoint(SetpointMode.VOLTAGE, 0.0, 1.0)
    host.run(0.3)
    running = host.samples().physical("u_alpha")[-1000:]
    assert np.abs(running).max() > 1.0
    state = end(host, device)
    host.run(0.8)  # the shaft comes to rest
    assert device.drive.state is state
    assert {name: host.get(name).value for name in VOLATILE} == defaults
    told = {each.name: each.value for each in host.kept.parameters if each.exact}
    assert {name: told[name] for name in ASKED} == {name: defaults[name] for name in ASKED}
    host.set("i_trip", 16.0)
    if state is DriveState.FAULT:
        host.command(Command.FAULT_CLEAR, int(device.drive.machine.faults))
    before = len(host.samples())
    host.start()
    host.run(0.3)
    samples = host.samples()
    u = np.hypot(samples.physical("u_alpha"), samples.physical("u_beta"))[before:]
    assert u.max() < 0.15  # the loop holds no current, whatever was asked before
    assert not (samples.raw["status"][before:] & 128).any()


def test_a_waveform_comes_by_the_protocol_and_is_played():
    device = SimulatedDevice(load_params(None, {"firmware.observer": 0, "mechanics.theta_0_deg": 0.0}))
    host = SmallHost(VirtualLink(device, step=0.002))
    host.stream([*CHANNELS, "i_q_ref"])
    wave = np.array([0, 16384, 32767, -32767, 8192], "<i2")
    host.request(BlobWrite(4, wave.nbytes, 0, wave.tobytes()))
    host.set("test_current", 1.0)
    host.set("test_length", len(wave))
    host.set("test_periods", 3)
    host.start()
    host.set("test", 4)
    host.run(0.05)
    samples = host.samples()
    begins = np.flatnonzero(samples.raw["status"] & 128)
    assert {b - a for a, b in pairwise(begins)} == {15}
    cycle = samples.physical("i_q_ref")[begins[0] : begins[0] + 15]
    assert cycle == pytest.approx(np.repeat(wave / 32767.0, 3), abs=1.5 / 1024)
