"""Runs of the simulated bench, what observers would have seen of them, and how long they take over that."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from protocol.signals import AngleSource, Status
from sim.observers.catalogue import CATALOGUE
from tests.benchmarks.table import Quickest
from tests.sim.drive.rig import PWM_HZ, Recorded, Rig, column, front_end
from tests.sim.observers.counting import Counted, counted


class Telemetry(NamedTuple):
    """What observers get, and the truth; n samples."""

    samples: np.ndarray  # of the front end
    reset: np.ndarray
    theta: np.ndarray  # rad, unwrapped
    drive: dict[str, float]  # parameters

    def params(self, name: str):
        """The observer's, by those of the drive."""
        return CATALOGUE[name].make_params(PWM_HZ, self.drive)

    def estimates(self, name: str):
        """What the observer makes of it."""
        return CATALOGUE[name].start(self.params(name)).run(self.samples, self.reset).view(np.recarray)

    def counted(self, name: str, part: slice) -> Counted:
        """What the observer does at each sample of a part, after all samples before it."""
        at_work = CATALOGUE[name].start(self.params(name))
        at_work.run(self.samples[: part.start], self.reset[: part.start])
        return counted(at_work.entry, at_work.params, at_work.state.first, self.samples[part])

    def nanoseconds(self, name: str, repeat: int) -> float:
        """A step of the observer, compiled; the best of so many runs."""
        at_work, best = CATALOGUE[name].start(self.params(name)), Quickest()
        for _ in range(repeat):
            with best.timed():
                at_work.run(self.samples, self.reset)
        return 1e9 * best[""] / self.reset.size


def telemetry(bench: Rig, parts: list[Recorded]) -> Telemetry:
    """Everything recorded, as a host would have it."""
    reset = np.concatenate([part.samples["status"] & Status.OBSERVERS_RESET for part in parts]) != 0
    theta = np.concatenate([column(part, "theta_e") for part in parts])
    return Telemetry(front_end(bench, parts, reset), reset, theta, bench.parameters)


class Run:
    """A bench with drive and load machine running on an angle, recorded in stretches."""

    def __init__(self, observer: AngleSource, **parameters: float) -> None:
        self.bench = Rig(1)
        for name, value in {"observer": observer, **parameters}.items():
            self.bench.set_param(name, value)
        self.parts = [self.bench.run(3e-4), *self.bench.start()]
        self.marks: dict[str, slice] = {}

    def _keep(self, part: Recorded, mark: str) -> None:
        if mark:
            n = sum(len(each.samples) for each in self.parts)
            self.marks[mark] = slice(n, n + len(part.samples))
        self.parts.append(part)
        assert not self.bench.faults

    def forced(self, rpm: float, i_q: float, seconds: float, mark: str = "") -> None:
        """Speed forced by the load machine, current by the drive; `mark` names the stretch."""
        self._keep(self.bench.forced(rpm, i_q, seconds), mark)

    def telemetry(self) -> Telemetry:
        """Everything recorded so far."""
        return telemetry(self.bench, self.parts)
