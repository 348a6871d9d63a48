"""A simulated drive without a link: many of them, one after the other, with nothing telemetered that nobody asks for.

What is measured is made from the plant's own state, period by period, so that a drive costs little more than its
simulation. The same configuration, seed and course give the same figures, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.messages import DriveState, SetpointMode
from protocol.signals import AngleSource
from sim.config.params import BenchParams, ConfigError, Value, load_params
from sim.drive.machine import SOURCES, Recorded, SimulatedBench

__all__ = [
    "ENCODER",
    "OBSERVERS",
    "BenchParams",
    "ConfigError",
    "Course",
    "Driven",
    "Recorded",
    "measured_by",
    "nominal",
    "with_values",
]

F64 = NDArray[np.float64]

OBSERVERS = {entry.name: source for source, entry in SOURCES.items()}
"""Observers of the firmware: their number in the parameter `observer` by name."""
ENCODER = "encoder"
CONTROL = "control"
"""The angle that the control takes, among those that are measured."""
ENCODER_ANGLE = "theta_enc"
PIECE = 0.125  # s that are simulated at once: what they take of memory stays in the caches
RPM = math.tau / 60.0
OF_ERROR = ("mean", "std", "rms", "max")


def nominal(config: Path | None, overrides: Mapping[str, Value]) -> dict[str, Any]:
    """All figures of a configuration, by section and key; what it does not give follows from its motor. ConfigError."""
    return load_params(config, overrides).model_dump()


def with_values(figures: Mapping[str, Any], values: Mapping[str, Value]) -> BenchParams:
    """The drive with these figures, and with `values` in the place of some of them, by dotted key. ConfigError.

    Nothing else changes: the firmware still takes the motor for what it was.
    """
    changed = dict(figures)
    for dotted, value in values.items():
        table, *keys = changed, *dotted.split(".")
        for key in keys[:-1]:
            table[key] = dict(table[key])
            table = table[key]
        table[keys[-1]] = value
    return BenchParams.of(changed)


class Course(NamedTuple):
    """What a drive is made to do from standstill: each speed for a while, against one torque."""

    speeds: tuple[float, ...]
    """r/min, mechanical."""
    load: float
    """N m."""
    seconds: float
    """For which each speed is asked for,"""
    settle: float
    """and that are not measured at its begin."""
    control: str
    """Observer whose angle the control takes, or `ENCODER`; empty: as configured."""
    observers: tuple[str, ...]
    """Whose errors are measured."""


class Driven:
    """A drive that runs a course. Raises ConfigError for one that its firmware would refuse."""

    def __init__(self, params: BenchParams, seed: int, course: Course) -> None:
        if course.control:
            firmware = params.firmware.replace(observer=_source(course.control, params))
            params = params.replace(firmware=firmware)
        self._params, self._course = params, course
        self._bench = bench = SimulatedBench(params, seed)
        self.fault = ""
        """What the firmware has switched off for; empty as long as it has not."""
        most, tau_max = params.firmware.omega_m_max / RPM, params.load.tau_max
        for speed in course.speeds:
            if abs(speed) > most:
                raise ConfigError(f"speed {speed:g} r/min is above the {most:.4g} r/min of firmware.omega_m_max")
        if abs(course.load) > tau_max:
            raise ConfigError(f"load {course.load:g} N m is above load.tau_max = {tau_max:g} N m")
        if round(course.seconds * params.clock.pwm_hz) <= round(course.settle * params.clock.pwm_hz):
            raise ConfigError(
                f"nothing is left to measure of {course.seconds:g} s, the first {course.settle:g} s of which do not "
                f"count, at {params.clock.pwm_hz} Hz"
            )
        self.watch: Callable[[Recorded], object] = lambda recorded: None
        """Gets all that is recorded, piece by piece."""
        control = int(bench.parameters["observer"])
        self._angles = {CONTROL: ENCODER_ANGLE if control == AngleSource.ENCODER else _angle(control)}
        self._angles |= {name: _angle(OBSERVERS[name]) for name in course.observers}
        bench.watch(frozenset(self._angles.values()))

    @property
    def channels(self) -> frozenset[str]:
        """Channels of the observers whose errors are measured, the one in control among them."""
        entries = [entry for entry in SOURCES.values() if next(iter(entry.channels)) in self._angles.values()]
        return frozenset(name for entry in entries for name in entry.channels)

    def run(self, take: Callable[[Recorded, float], None]) -> None:
        """Run the course; `take` gets what is recorded and counts, piece by piece, with the speed asked for, r/min.

        It ends where the firmware switches off: `fault` says why then.
        """
        bench, course, pwm_hz = self._bench, self._course, self._params.clock.pwm_hz
        for state in (DriveState.ARMED, DriveState.RUNNING):
            bench.enter_state(state)
            bench.load_enter_state(state)
            self.watch(bench.advance(1))
        bench.load_setpoint(SetpointMode.TORQUE, course.load)
        settle, whole = round(course.settle * pwm_hz), round(course.seconds * pwm_hz)
        for speed in course.speeds:
            bench.setpoint(SetpointMode.SPEED, speed * RPM)
            for counts, left in ((False, settle), (True, whole - settle)):
                while left > 0 and not self.fault:
                    n = min(left, round(PIECE * pwm_hz))
                    left -= n
                    self._go_on(n, speed, take if counts else None)

    def _go_on(self, n: int, speed: float, take: Callable[[Recorded, float], None] | None) -> None:
        """A piece, whose memory is free again when this returns."""
        recorded = self._bench.advance(n)
        self.watch(recorded)
        if self._bench.faults:
            self.fault = str(self._bench.faults.name)
        elif take is not None:
            take(recorded, speed)

    def measure(self) -> dict[str, float]:
        """Run the course; what was measured of it by name, nothing but `tripped` where the firmware has switched off.

        Of each observer, and of the one in `control`, OBSERVER.mean, .std, .rms and .max of its error, actual less
        estimated angle, electrical degrees; `speed.mean` and `speed.std`: less what was asked for, r/min; `current.rms`
        and `current.max`: size of the current vector, A; `tripped`: 1 or 0.
        """
        sums = {name: _Sums() for name in (*self._angles.values(), "speed")}
        squares = _Sums()

        def take(recorded: Recorded, speed: float) -> None:
            theta = recorded["theta_true"]
            for channel in set(self._angles.values()):
                sums[channel].add(_wrapped(theta - recorded[channel]))
            sums["speed"].add(recorded["omega_m"] / RPM - speed)
            alpha, beta = recorded["i_alpha_true"], recorded["i_beta_true"]
            squares.add(alpha * alpha + beta * beta)

        self.run(take)
        if self.fault:
            return {"tripped": 1.0}
        found = {
            f"{name}.{of}": math.degrees(value)
            for name, channel in self._angles.items()
            for of, value in sums[channel].figures.items()
        }
        found |= {f"speed.{of}": sums["speed"].figures[of] for of in ("mean", "std")}
        found |= {f"current.{of}": math.sqrt(squares.figures[mean]) for of, mean in (("rms", "mean"), ("max", "max"))}
        return found | {"tripped": 0.0}


def measured_by(course: Course) -> dict[str, str]:
    """What `Driven.measure` measures in a course: units by name."""
    errors = {f"{name}.{of}": "deg" for name in (CONTROL, *course.observers) for of in OF_ERROR}
    return errors | {
        "speed.mean": "r/min", "speed.std": "r/min", "current.rms": "A", "current.max": "A", "tripped": ""
    }  # fmt: skip


class _Sums:
    """Mean, standard deviation, rms and largest size of what comes in pieces."""

    def __init__(self) -> None:
        self._n, self._sum, self._squares, self._largest = 0, 0.0, 0.0, 0.0

    def add(self, values: F64) -> None:
        self._n += len(values)
        self._sum += float(values.sum())
        self._squares += float(np.dot(values, values))
        self._largest = max(self._largest, float(values.max()), -float(values.min()))

    @property
    def figures(self) -> dict[str, float]:
        mean, square = self._sum / self._n, self._squares / self._n
        values = mean, math.sqrt(max(square - mean * mean, 0.0)), math.sqrt(square), self._largest
        return dict(zip(OF_ERROR, values, strict=True))


def _wrapped(angle: F64) -> F64:
    """Nearest to zero."""
    return angle - math.tau * np.rint(angle * (1.0 / math.tau))


def _angle(source: int) -> str:
    """The channel of an observer's angle."""
    return next(iter(SOURCES[source].channels))


def _source(name: str, params: BenchParams) -> int:
    if name == ENCODER and not params.encoder.present:
        raise ConfigError("the control cannot take the encoder's angle: encoder.present = 0")
    return int(AngleSource.ENCODER) if name == ENCODER else OBSERVERS[name]
