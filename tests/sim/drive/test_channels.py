"""The drive's channels are those of the table where that is enough, and hold what a larger motor makes of them."""

from __future__ import annotations

import numpy as np
import pytest
from rig import RPM

from protocol.messages import DriveState, SetpointMode
from protocol.signals import DRIVE_CHANNELS, Unit
from sim.config.params import load_params
from sim.drive.channels import channels
from sim.drive.machine import SimulatedBench

TRACTION = {"motor.i_max": 30.0, "motor.R_s": 0.05, "motor.psi_f": 12e-3, "motor.n_p": 14, "load.omega_m_max": 400.0}


def test_the_papers_drive_has_those_of_the_table() -> None:
    assert channels(load_params())[: len(DRIVE_CHANNELS)] == DRIVE_CHANNELS


def test_currents_speeds_and_torques_of_a_larger_motor_fit() -> None:
    params = load_params(None, TRACTION)
    bench = SimulatedBench(params, 1)
    offered = channels(params)
    scale = {channel.name: channel.scale for channel in offered}
    for state in (DriveState.ARMED, DriveState.RUNNING):
        bench.enter_state(state)
        bench.load_enter_state(state)
    bench.load_setpoint(SetpointMode.SPEED, 300 * RPM)
    bench.setpoint(SetpointMode.CURRENT, 45.0, 0.0)
    bench.advance(8000)
    recorded = bench.advance(2000)
    raw = recorded.raw(offered)
    assert bench.faults == 0
    for name, at_least in (("i_a", 40.0), ("i_q", 44.0), ("tau_e_true", 10.0)):
        shown = raw[name] * scale[name]
        assert np.abs(shown).max() > at_least
        assert shown == pytest.approx(recorded[name], abs=0.51 * scale[name])
    assert {channel.scale / table.scale for channel, table in zip(offered, DRIVE_CHANNELS, strict=False)
            if channel.unit is Unit.A} == {4.0}  # fmt: skip
