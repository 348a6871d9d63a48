"""The simulated bench with what its tests do to it, and what they read of its records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from protocol.messages import DriveState, SetpointMode
from protocol.signals import DRIVE_CHANNELS
from sim.config.params import load_params
from sim.drive.machine import Recorded, SimulatedBench
from sim.drive.tick import RECORDS
from sim.native import Cells
from sim.observers import sample
from sim.observers.entry import chosen

PWM_HZ = 16_000
RPM = 2 * np.pi / 60  # mechanical rad/s
MEASURED = ("u_alpha", "u_beta", "i_a", "i_b", "i_c")
SCALE = {channel.name: channel.scale for channel in DRIVE_CHANNELS}


class Rig(SimulatedBench):
    """A simulated bench; `settings` by `section.key`."""

    def __init__(self, seed: int = 0, **settings: Any) -> None:
        super().__init__(load_params(None, settings), seed)

    def enable(self, on: bool = True) -> None:
        """From IDLE through ARMED to RUNNING at once, or back to IDLE."""
        for state in (DriveState.ARMED, DriveState.RUNNING) if on else (DriveState.IDLE,):
            self.enter_state(state)

    def load(self, mode: SetpointMode, value: float) -> None:
        """The load machine RUNNING: a torque, or a speed that it forces."""
        self.load_enter_state(DriveState.RUNNING)
        self.load_setpoint(mode, value)

    def start(self) -> list[Recorded]:
        """Drive and load machine: a period ARMED, and one RUNNING, at no current and torque."""
        records = []
        for state in (DriveState.ARMED, DriveState.RUNNING):
            self.enter_state(state)
            self.load_enter_state(state)
            records.append(self.advance(1))
        return records

    def run(self, seconds: float) -> Recorded:
        """Go on for a time."""
        return self.advance(round(seconds * PWM_HZ))

    def forced(self, rpm: float, i_q: float, seconds: float) -> Recorded:
        """Speed forced by the load machine, current by the drive."""
        self.load_setpoint(SetpointMode.SPEED, rpm * RPM)
        self.setpoint(SetpointMode.CURRENT, i_q, 0.0)
        return self.run(seconds)

    def spin(self, rpm: float, seconds: float, load: float = 0.0) -> Recorded:
        """Speed by the drive's own loop, against a torque in N·m."""
        self.load_setpoint(SetpointMode.TORQUE, load)
        self.setpoint(SetpointMode.SPEED, rpm * RPM)
        return self.run(seconds)


COLUMNS = {"theta_e": "theta_true", "omega_e": "omega_true", "i_alpha": "i_alpha_true", "i_beta": "i_beta_true"}


def loop_records(parts: Sequence[Recorded]) -> list[bytes]:
    """All that the loop recorded, the bits of each column."""
    return [np.concatenate([part[name] for part in parts]).tobytes() for of in RECORDS for name in of._fields]


def column(recorded: Recorded, name: str) -> np.ndarray:
    """An estimate or the truth, not rounded; angles of the truth not wrapped."""
    return recorded[COLUMNS.get(name, name)]


def physical(recorded: Recorded, name: str) -> np.ndarray:
    """A channel in its unit."""
    return recorded.samples[name] * SCALE[name]


def measured_of(bench: SimulatedBench, parts: Sequence[Recorded]) -> np.ndarray:
    """What the observers' front end gets of what was recorded, (n,), beside the edges."""
    seen = {name: np.concatenate([physical(part, name) for part in parts]) for name in (*MEASURED, "i_q_ref", "i_q")}
    measured = Cells(sample.Measured, len(seen["i_q"])).array
    ticks = bench.params.clock.period_ticks
    measured["tick"] = np.concatenate([part.tick + np.arange(len(part)) * ticks for part in parts])
    measured["hall"] = np.concatenate([part.samples["hall"] for part in parts])
    for name in MEASURED:
        measured[name] = seen[name]
    measured["i_q_err"] = seen["i_q_ref"] - np.r_[0.0, seen["i_q"][:-1]]
    return measured


def made_front_end(bench: SimulatedBench) -> sample.FrontEnd:
    """A front end with the drive's parameters."""
    return sample.FrontEnd(sample.make_params(bench.params.clock.tick_hz, chosen(sample.Settings, bench.parameters)))


def front_end(bench: SimulatedBench, parts: Sequence[Recorded], reset: np.ndarray) -> np.ndarray:
    """What the observers' front end makes of what was recorded, (n,); `reset` (n,)."""
    edges = np.concatenate([part.captured for part in parts])
    return made_front_end(bench).run(measured_of(bench, parts), edges, reset).view(np.recarray)


def error_deg(recorded: Recorded, name: str) -> np.ndarray:
    """Actual less estimated angle, electrical degrees."""
    return (np.degrees(recorded["theta_true"] - recorded[name]) + 180) % 360 - 180
