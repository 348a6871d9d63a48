"""Runs of the simulated bench, marked in stretches, and what an observer makes of their telemetry afterwards."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from protocol.messages import DriveState, SetpointMode
from protocol.signals import DRIVE_CHANNELS, AngleSource, Status
from sim.config.params import load_params
from sim.drive.machine import SimulatedBench
from sim.drive.tick import LOG_FIELDS
from sim.observers import sample
from sim.observers.catalogue import chosen

RPM = 2 * math.pi / 60
SCALE = {channel.name: channel.scale for channel in DRIVE_CHANNELS}
INPUTS = ("u_alpha", "u_beta", "i_a", "i_b", "i_c", "i_q_ref", "i_q")


class Telemetry(NamedTuple):
    """What observers get, and the truth; n samples."""

    samples: sample.Samples
    reset: np.ndarray
    theta: np.ndarray  # rad, unwrapped
    theta_vt: np.ndarray  # rad, of the drive's own vector tracking
    i_a: np.ndarray  # A


class Run:
    """A bench with drive and load machine running, its control on the encoder unless `observer` says otherwise."""

    def __init__(self, overrides=None, seed=1, observer=AngleSource.ENCODER, **parameters):
        self.bench = SimulatedBench(load_params(None, overrides or {}), seed)
        for name, value in {"observer": observer, **parameters}.items():
            self.bench.set_param(name, value)
        self.parts = []
        self.marks = {}
        self.n = 0
        self.advance(3e-4)
        for state in (DriveState.ARMED, DriveState.RUNNING):
            self.bench.enter_state(state)
            self.bench.load_enter_state(state)
            self.advance(1e-4)

    def advance(self, seconds, mark=None):
        """Go on for `seconds`; `mark` names the stretch."""
        n = round(seconds * self.bench.params.clock.pwm_hz)
        self.parts.append(self.bench.advance(n, log=True))
        if mark is not None:
            self.marks[mark] = slice(self.n, self.n + n)
        self.n += n
        assert not self.bench.faults

    def forced(self, rpm, i_q, seconds, mark=None):
        """Speed forced by the load machine, current by the drive."""
        self.bench.load_setpoint(SetpointMode.SPEED, rpm * RPM)
        self.bench.setpoint(SetpointMode.CURRENT, i_q, 0.0)
        self.advance(seconds, mark)

    def spin(self, rpm, seconds, mark=None, load=0.0):
        """Speed by the drive's own loop, against a load in N·m."""
        self.bench.load_setpoint(SetpointMode.TORQUE, load)
        self.bench.setpoint(SetpointMode.SPEED, rpm * RPM)
        self.advance(seconds, mark)

    def telemetry(self):
        """Everything recorded so far, as a host would have it."""
        raw = np.concatenate([part.samples for part in self.parts])
        edges = np.concatenate([part.edges for part in self.parts])
        log = np.concatenate([part.log for part in self.parts])
        clock, drive = self.bench.params.clock, self.bench.parameters
        u_alpha, u_beta, i_a, i_b, i_c, i_q_ref, i_q = (raw[name] * SCALE[name] for name in INPUTS)
        reset = (raw["status"] & Status.OBSERVERS_RESET) != 0
        _, samples = sample.run(
            sample.make_params(clock.tick_hz, chosen(sample.Settings, drive)),
            sample.init(),
            self.parts[0].tick + np.arange(raw.size, dtype=np.int64) * clock.period_ticks,
            raw["hall"].copy(),
            u_alpha,
            u_beta,
            i_a,
            i_b,
            i_c,
            i_q_ref - np.r_[0.0, i_q[:-1]],
            np.concatenate([part.edge_tick for part in self.parts]),
            (edges["codes"] >> 3) & 7,
            reset,
        )
        theta, theta_vt = (log[:, LOG_FIELDS.index(name)] for name in ("theta_e", "theta_vt"))
        return Telemetry(samples, reset, theta, theta_vt, i_a)
