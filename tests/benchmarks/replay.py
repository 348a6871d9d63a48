"""Runs of the simulated bench, marked in stretches, and what an observer makes of their telemetry afterwards."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from protocol.signals import AngleSource, Status
from sim.observers import sample
from sim.observers.catalogue import chosen
from tests.sim.drive.rig import SCALE, Recorded, Rig, column

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
        self.bench = Rig(seed, **overrides or {})
        for name, value in {"observer": observer, **parameters}.items():
            self.bench.set_param(name, value)
        self.parts, self.marks, self.n = [], {}, 0
        self._keep(self.bench.run(3e-4))
        for part in self.bench.start():
            self._keep(part)

    def _keep(self, part: Recorded, mark=None):
        """`mark` names the stretch."""
        n = len(part.samples)
        self.parts.append(part)
        if mark is not None:
            self.marks[mark] = slice(self.n, self.n + n)
        self.n += n
        assert not self.bench.faults

    def forced(self, rpm, i_q, seconds, mark=None):
        """Speed forced by the load machine, current by the drive."""
        self._keep(self.bench.forced(rpm, i_q, seconds), mark)

    def spin(self, rpm, seconds, mark=None, load=0.0):
        """Speed by the drive's own loop, against a load in N·m."""
        self._keep(self.bench.spin(rpm, seconds, load), mark)

    def telemetry(self):
        """Everything recorded so far, as a host would have it."""
        raw = np.concatenate([part.samples for part in self.parts])
        edges = np.concatenate([part.edges for part in self.parts])
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
        theta, theta_vt = (
            np.concatenate([column(part, name) for part in self.parts]) for name in ("theta_e", "theta_vt")
        )
        return Telemetry(samples, reset, theta, theta_vt, i_a)
