"""What a run that turned a motor shows of the drive: whether it did what it was asked for, its currents, its angles.

A drive can take every command, stream every sample and still not do what it was asked for: wrong pole pairs, exchanged
Hall wires, a shaft that is stuck. Pieces come in any length, and only sums of them are kept.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bench.findings.finding import Finding
from bench.findings.thresholds import (
    KNOWN_FOR,
    LEAST_SPEED,
    LEAST_SUM,
    LONG_ENOUGH,
    NO_SUM,
    OFF_BY,
    RISING,
    SEEN_FOR,
    SPEED_OFF,
    STANDS,
    TOO_MUCH,
)
from bench.signal.position import ErrorTable, Moments
from bench.signal.units import RPM
from bench.signal.waveforms.sectors import SECTOR_WIDTH
from protocol.streams import SampleChunk

LAST = 10.0  # s of a stretch that are judged at most
BLOCK = 0.25  # s of a stretch that are judged at least
VECTOR, PHASES = ("i_d", "i_q"), ("i_a", "i_b", "i_c")
BY_ENCODER, BY_HALL, BY_ESTIMATE = "the encoder", "its Hall sensors", "its own estimate"


class Look(NamedTuple):
    """What was seen in a short time of the run."""

    time: float
    """s of device time at its end."""
    seen: float
    """s of it over which the speed is known."""
    omega: float
    """Mean speed in these, electrical rad/s."""
    sampled: float
    """s of it of which samples came."""
    current: float = math.nan
    """A, mean in these; NaN where it is not streamed, as of i_q."""
    i_q: float = math.nan


@dataclass
class _Asked:
    """A stretch of the run in which one speed was asked for, mechanical r/min, and one load, A."""

    speed_rpm: float
    load_a: float = 0.0
    title: str = ""
    looks: deque[Look] = field(default_factory=deque)
    """Of the last third, at most of the last `LAST` s."""
    begun: float = math.nan
    """s of device time of what was seen first."""

    @property
    def seconds(self) -> float:
        """From there to what was seen last."""
        return self.looks[-1].time - self.begun if self.looks else 0.0

    @property
    def window(self) -> float:
        """s that `looks` are about."""
        return min(LAST, max(self.seconds / 3.0, BLOCK))

    @property
    def seen(self) -> float:
        """s of them over which the speed is known."""
        return sum(look.seen for look in self.looks)

    def add(self, look: Look) -> None:
        """Let go of what lies before the last third; a clock that has gone back begins anew."""
        if not self.looks or look.time < self.looks[-1].time:
            self.looks.clear()
            self.begun = look.time - max(look.seen, look.sampled)
        self.looks.append(look)
        while self.looks[0].time <= look.time - self.window:
            self.looks.popleft()


@dataclass(frozen=True)
class Came:
    """What was asked for in a stretch of the run, and what came in its last third; NaN where that was not seen."""

    title: str
    speed_asked_rpm: float
    speed_came_rpm: float
    load_asked_a: float
    i_q_came_a: float
    seen_by: str
    """What the speed was seen by."""


class SpeedHeld:
    """Whether the shaft turned as it was asked to, one stretch after the other.

    `seen_by`: what the speed is seen by; `n_p`: pole pairs; `i_max`: A, inf if the drive tells none.
    """

    def __init__(self, seen_by: str, n_p: int, i_max: float) -> None:
        self._by, self._n_p, self._i_max = seen_by, n_p, i_max
        self._asked: list[_Asked] = []

    def ask(self, speed_rpm: float, load_a: float, title: str) -> None:
        """From now on this speed is asked for, and this load; NaN: none, or none that is held long enough to judge."""
        self._asked.append(_Asked(speed_rpm, load_a, title))

    def add(self, look: Look) -> None:
        """Take in what was seen next."""
        if self._asked:
            self._asked[-1].add(look)

    def came(self) -> list[Came]:
        """What was asked for and what came, one by one."""
        return [
            Came(a.title, a.speed_rpm, self._speed(a.looks), a.load_a, _sampled(a.looks, "i_q"), self._by)
            for a in self._asked
        ]

    def findings(self) -> Iterator[Finding]:
        """Speeds that were not held."""
        for asked in self._asked:
            speed, current = self._speed(asked.looks), _sampled(asked.looks, "current")
            if asked.seconds < LONG_ENOUGH or self._little(asked) or self._on_its_way(asked):
                continue
            if abs(speed - asked.speed_rpm) > self._off(asked):
                amperes = "" if math.isnan(current) else f", with {current:.1f} A"
                amperes += f" of {self._i_max:g} A (i_max)" if amperes and math.isfinite(self._i_max) else ""
                turned = f"it turned at {speed:.0f} r/min by {self._by}{amperes}"
                yield Finding("speed", f"{asked.speed_rpm:g} r/min were asked for, {turned}")

    def unverified(self) -> list[str]:
        """Speeds of which it was not seen whether they are held, each with the reason."""
        unseen: dict[str, list[str]] = {}
        for asked in self._asked:
            if math.isfinite(asked.speed_rpm) and (why := self._not_told(asked)):
                unseen.setdefault(why, []).append(f"{asked.speed_rpm:g}")
        return [f"whether {', '.join(dict.fromkeys(of))} r/min are held ({why})" for why, of in unseen.items()]

    def _not_told(self, asked: _Asked) -> str:
        """Why it was not seen whether this speed is held; empty where it was."""
        if not asked.looks:
            return "not seen"
        if asked.seconds < LONG_ENOUGH:
            return "too short a time"
        if 0 < abs(asked.speed_rpm) <= self._off(asked, asked.window):  # whether such a speed still changes is noise
            return "too slow to tell"
        if self._little(asked):
            return f"it is known over {asked.seen:.1f} s of the last {asked.window:.1f} s"
        return "it still changed" if self._on_its_way(asked) else ""

    def _speed(self, looks: Iterable[Look]) -> float:
        """Mean in mechanical r/min, over the time that it is known; NaN for none."""
        seen = sum(look.seen for look in looks)
        gone = sum(look.seen * look.omega for look in looks if look.seen)
        return gone / seen / self._n_p / RPM if seen else math.nan

    def _little(self, asked: _Asked) -> bool:
        """Whether the speed is known over too little of the time."""
        enough = asked.seen >= KNOWN_FOR * asked.window
        return not enough or 0 < abs(asked.speed_rpm) <= self._off(asked, asked.seen)

    def _off(self, asked: _Asked, seen: float = math.nan) -> float:
        """By how many r/min the mean speed may be off: by a Hall sector in the time that it was seen, at least."""
        if not asked.speed_rpm:
            return STANDS
        bound = max(LEAST_SPEED, SPEED_OFF * abs(asked.speed_rpm))
        seen = asked.seen if math.isnan(seen) else seen
        return max(bound, SECTOR_WIDTH / (self._n_p * RPM * seen)) if self._by == BY_HALL and seen else bound

    def _on_its_way(self, asked: _Asked) -> bool:
        """Whether the speed still changes towards what was asked for."""
        looks = [look for look in asked.looks if look.seen]
        if len(looks) < 2:
            return False
        early, late = (self._speed(part) for part in (looks[: len(looks) // 2], looks[len(looks) // 2 :]))
        nearer = abs(asked.speed_rpm - early) - abs(asked.speed_rpm - late)
        return nearer > RISING * abs(asked.speed_rpm)


class Currents:
    """The current vector against i_max, A, and the sum of the phase currents against 0."""

    def __init__(self, i_max: float) -> None:
        self._i_max = i_max
        self._vector, self._phase, self._sum = Moments(), Moments(), Moments()

    def add(self, chunk: SampleChunk) -> None:
        """Add samples; those of channels that there are."""
        names = set(chunk.raw.dtype.names or ())
        if names.issuperset(VECTOR):
            self._vector.add(np.hypot(*(chunk.physical(name) for name in VECTOR)))
        if names.issuperset(PHASES):
            a, b, c = (chunk.physical(name) for name in PHASES)
            self._phase.add(np.sqrt((a * a + b * b + c * c) / 3.0))
            self._sum.add(a + b + c)

    def findings(self) -> Iterator[Finding]:
        """What is more than it may be."""
        if self._vector.rms > TOO_MUCH * self._i_max:
            words = f"{self._vector.rms:.3g} A (rms of the current vector) with i_max = {self._i_max:g} A"
            yield Finding("current", words)
        if self._sum.rms > max(LEAST_SUM, NO_SUM * self._phase.rms):
            yield Finding(
                "current_sum",
                f"the phase currents add up to {self._sum.rms:.2g} A (rms), which should be 0, at "
                f"{self._phase.rms:.2g} A a phase",
            )


class NotFinite:
    """Values of float channels that are no numbers."""

    def __init__(self) -> None:
        self._bad: dict[str, int] = {}

    def add(self, chunk: SampleChunk) -> None:
        """Add samples."""
        for channel in chunk.config.channels:
            if channel.raw.dtype == "<f4":
                bad = int(np.count_nonzero(~np.isfinite(chunk.raw[channel.name])))
                self._bad[channel.name] = self._bad.get(channel.name, 0) + bad

    def findings(self) -> Iterator[Finding]:
        """The channels that have any."""
        for name, n in self._bad.items():
            if n:
                yield Finding("not_finite", f"{name} is not a finite number in {n} samples")


def far_off(errors: ErrorTable, rate: float) -> Iterator[Finding]:
    """Estimates that are none; `errors`: position errors of a run, rad, `rate` samples a second."""
    of_all: dict[str, Moments] = {}
    for name, moments in (pair for row in errors.segments.values() for pair in row.items()):
        of_all.setdefault(name, Moments()).merge(moments)
    for name, whole in of_all.items():
        if whole.n / rate >= SEEN_FOR and (rms := whole.rms) > OFF_BY:
            words = f"{name} is {math.degrees(rms):.0f} deg (rms) off the encoder: more than a Hall sector"
            yield Finding("position_error", words)


def _sampled(looks: Iterable[Look], name: str) -> float:
    """The mean of what samples tell, over their time; NaN of nothing."""
    of = [(look.sampled, getattr(look, name)) for look in looks]
    seconds = sum(sampled for sampled, _ in of)
    return sum(sampled * value for sampled, value in of) / seconds if seconds else math.nan
