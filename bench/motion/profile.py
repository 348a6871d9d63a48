"""A motion profile as a pure function of time: what is asked of a drive and of its load machine, act by act.

Quantities have the names and units of the file (`speed_rpm` is r/min of the shaft). Nothing here knows a clock, a link
or a file: whoever plays a profile says what time it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import cycle

from bench.errors import BenchError
from bench.signal.sources import source_name

SPEED, CURRENT = "speed_rpm", "current_A"
LOAD_TORQUE, LOAD_CURRENT, LOAD_SPEED = "load_torque_Nm", "load_current_A", "load_speed_rpm"
OF_DRIVE, OF_LOAD = (SPEED, CURRENT), (LOAD_TORQUE, LOAD_CURRENT, LOAD_SPEED)
"""What a machine is asked for, one at a time."""
UNITS = {SPEED: "r/min", CURRENT: "A", LOAD_TORQUE: "N·m", LOAD_CURRENT: "A", LOAD_SPEED: "r/min"}


@dataclass(frozen=True, slots=True)
class Sine:
    """A sine of `amplitude` about `offset`, in the unit of its quantity; its phase counts from the step's begin."""

    amplitude: float
    frequency_hz: float
    offset: float = 0.0
    phase_deg: float = 0.0

    def at(self, t: float) -> float:
        """Its value `t` s after the begin."""
        return self.offset + self.amplitude * math.sin(self._angle(t))

    def extremes(self, seconds: float) -> tuple[float, float]:
        """Its least and its largest value from the begin on, in so many s."""
        first, last = self._angle(0.0), self._angle(seconds)
        ends = self.at(0.0), self.at(seconds)
        low = self.offset - self.amplitude if _comes_to(first, last, -0.25 * math.tau) else min(ends)
        high = self.offset + self.amplitude if _comes_to(first, last, 0.25 * math.tau) else max(ends)
        return low, high

    def _angle(self, t: float) -> float:
        return math.radians(self.phase_deg) + math.tau * self.frequency_hz * t


def _comes_to(first: float, last: float, angle: float) -> bool:
    """Whether an angle that goes from `first` to `last` comes to `angle` on the way, in any turn."""
    return angle + math.tau * math.ceil((first - angle) / math.tau) <= last


@dataclass(frozen=True, slots=True)
class Course:
    """What one quantity does in an act: a line from `first` to `last` in `ramp` s and then `last`, or a sine."""

    quantity: str
    first: float
    last: float
    ramp: float = 0.0
    sine: Sine | None = None

    def at(self, t: float) -> float:
        """Its value `t` s after the act's begin."""
        if self.sine is not None:
            return self.sine.at(t)
        return self.last if t >= self.ramp else self.first + (self.last - self.first) * (t / self.ramp)

    def changes(self, t: float) -> bool:
        """Whether it still changes after `t` s."""
        return self.sine is not None or t < self.ramp

    def extremes(self, seconds: float) -> tuple[float, float]:
        """Its least and its largest value in the first so many s."""
        if self.sine is not None:
            return self.sine.extremes(seconds)
        ends = self.at(0.0), self.at(seconds)
        return min(ends), max(ends)

    @property
    def slope(self) -> float:
        """The most that it changes in a second; 0 where it does not, or all at once."""
        if self.sine is not None:
            return math.tau * self.sine.frequency_hz * self.sine.amplitude
        return abs(self.last - self.first) / self.ramp if self.ramp else 0.0


AT_REST = Course(SPEED, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Step:
    """What a person writes of a step: what becomes another, and for how long. All else stays as it is."""

    name: str
    """What the recording's mark is called."""
    seconds: float
    targets: Mapping[str, float | Sine] = field(default_factory=dict)
    ramp: float = 0.0
    """s from the step's begin in which plain numbers of `targets` are reached."""
    sets: Mapping[str, float] = field(default_factory=dict)
    """Parameters of the drive that are set when it begins."""
    title: str = ""
    """What it does, in words; empty: words are made of it."""
    number: str = ""
    """Where it stands in the file, such as 3 or 3.2; empty where there is no file."""

    @property
    def place(self) -> str:
        """How errors name it."""
        numbered = f"step {self.number}" if self.number else self.name
        return numbered if self.name == numbered else f"{numbered} ({self.name})"


@dataclass(frozen=True, slots=True)
class Act:
    """A step in its place, for `seconds`: what drive and load machine are asked for at any time of it."""

    name: str
    title: str
    seconds: float
    drive: Course = AT_REST
    load: Course | None = None
    """None: the load machine is not needed."""
    sets: Mapping[str, float] = field(default_factory=dict)
    place: str = ""
    """How errors name it."""

    @property
    def courses(self) -> tuple[Course, ...]:
        """Of the drive, and of the load machine if there is one."""
        return (self.drive,) if self.load is None else (self.drive, self.load)

    @property
    def settles(self) -> bool:
        """Whether the drive is asked for one value in the last third of it, at least."""
        return not self.drive.changes(self.seconds / 1.5)

    def peak(self, quantity: str) -> float:
        """The largest magnitude of a quantity in it."""
        ends = (course.extremes(self.seconds) for course in self.courses if course.quantity == quantity)
        return max((max(abs(low), abs(high)) for low, high in ends), default=0.0)


@dataclass(frozen=True)
class Profile:
    """Steps that follow each other, repeats written out. BenchError where a step cannot follow the one before."""

    steps: tuple[Step, ...]
    name: str = ""
    source: str = ""
    """The file that it is from."""
    max_current: float | None = None
    """A, the most that the motor may get at any time; None: what else is agreed."""
    max_speed: float | None = None
    """r/min at which the motor is switched off where a current turns it; None where no step gives a current."""

    @cached_property
    def acts(self) -> tuple[Act, ...]:
        """All of it once, from standstill."""
        return tuple(_chained(self.steps, self.steps))

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return math.fsum(step.seconds for step in self.steps)

    @property
    def loads(self) -> bool:
        """Whether it needs a load machine."""
        return any(key in OF_LOAD for step in self.steps for key in step.targets)

    def uses(self, quantity: str) -> bool:
        """Whether a step asks for it."""
        return any(quantity in step.targets for step in self.steps)

    def peak(self, *quantities: str) -> float:
        """The largest magnitude that any of them has."""
        return max(act.peak(quantity) for act in self.acts for quantity in quantities)

    def timed(self, seconds: float | None) -> Iterator[Act]:
        """The acts once, or, to fill `seconds`, over and over and cut short."""
        if seconds is None:
            yield from self.acts
            return
        for act in _chained(cycle(self.steps), self.steps):
            yield replace(act, seconds=min(act.seconds, seconds))
            seconds -= act.seconds
            if seconds <= 0:
                return

    def begins(self) -> Iterator[tuple[float, Act]]:
        """Each act with when it begins, in s."""
        at = 0.0
        for act in self.acts:
            yield at, act
            at += act.seconds


def _chained(steps: Iterable[Step], all_steps: Iterable[Step]) -> Iterator[Act]:
    """Each step with what it finds; before the first one, nothing is asked for of what `all_steps` name first."""
    named = [key for step in all_steps for key in step.targets]
    drive = Course(next((key for key in named if key in OF_DRIVE), SPEED), 0.0, 0.0)
    load = next((Course(key, 0.0, 0.0) for key in named if key in OF_LOAD), None)
    if load is not None and load.quantity == LOAD_SPEED:  # which would hold the shaft
        load = Course(LOAD_TORQUE, 0.0, 0.0)
    for step in steps:
        for key, target in step.targets.items():
            if key in OF_DRIVE:
                drive = _course(step, key, target, drive)
            else:
                assert load is not None
                load = _course(step, key, target, load)
        title = step.title or _words(step)
        yield Act(step.name, title, step.seconds, drive, load, step.sets, step.place)
        drive = _held(drive, step.seconds)
        load = None if load is None else _held(load, step.seconds)


def _held(course: Course, seconds: float) -> Course:
    value = course.at(seconds)
    return Course(course.quantity, value, value)


def _course(step: Step, key: str, target: float | Sine, before: Course) -> Course:
    if isinstance(target, Sine):
        return Course(key, target.at(0.0), target.at(step.seconds), sine=target)
    if not step.ramp:
        return Course(key, target, target)
    nothing = before.last == 0.0 and {key, before.quantity} <= {LOAD_TORQUE, LOAD_CURRENT}
    if before.quantity != key and not nothing:
        raise BenchError(
            f"{step.place}: {key} cannot ramp, because {before.quantity} was asked for before it and nobody knows the "
            f"{key} at that moment: give {key} without ramp_s once"
        )
    return Course(key, before.last, target, step.ramp)


def _words(step: Step) -> str:
    """What a step does, for people."""
    within = f" in {step.ramp:g} s" if step.ramp else ""
    parts = []
    for key, target in step.targets.items():
        what, unit = key.rpartition("_")[0].replace("_", " "), UNITS[key]
        if isinstance(target, Sine):
            parts.append(f"{what} {target.offset:g} ± {target.amplitude:g} {unit} at {target.frequency_hz:g} Hz")
        else:
            parts.append(f"{what} {target:g} {unit}{within}")
    return f"{step.place}: {', '.join([*parts, *settings_words(step.sets)]) or 'hold'}"


def settings_words(sets: Mapping[str, float]) -> list[str]:
    """Parameters and their values, for people; an angle source by its name."""
    return [f"{name} = {(name == 'observer' and source_name(value)) or f'{value:g}'}" for name, value in sets.items()]
