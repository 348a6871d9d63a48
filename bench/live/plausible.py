"""Whether what a run showed can be a healthy drive's: speed, position error, currents, Hall sensors and encoder.

A drive can take every command, stream every sample and still not do what it was asked for: wrong pole pairs, exchanged
Hall wires, a shaft that is stuck. `Plausibility` is a sink that keeps a few sums of the samples in RUNNING, bounded in
memory, and at the end names what cannot be right, and what nothing in the stream could show. The bounds are wide: they
tell nonsense from a drive, not a good drive from a bad one (that is what acceptance tests are for).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.device.heard import Heard
from bench.live.causes import BackEmf, Turns, Wires
from bench.signal.channels import flagged, reference_angle, speed_channel
from bench.signal.position import ErrorTable, Moments, states
from bench.signal.units import RPM, pole_pairs
from bench.signal.waveforms.sectors import SECTOR_WIDTH as SECTOR
from bench.signal.waveforms.sectors import steps_between
from protocol.messages import DriveState
from protocol.signals import Flag, Unit
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

OFF_BY = SECTOR  # rms of a position error above which an angle is no estimate
SEEN_FOR = 0.5  # s of samples from which on it is judged
SPEED_OFF = 0.5  # of the speed that was asked for, by which its mean may be off
STANDS = 60.0  # r/min that a motor may turn at which was asked to stand
LEAST_SPEED = 5.0  # r/min by which any speed may be off
RISING = 0.05  # of the speed that was asked for, by which it changes while it is still on its way
LONG_ENOUGH = 1.0  # s at a speed before it is judged
LAST = 10.0  # s of a stretch that are judged at most
BLOCK = 0.25  # s of a stretch that are judged at least
TOO_MUCH = 1.25  # of i_max that the mean current may be
NO_SUM = 0.5  # of a phase current, rms, that the sum of the three may be
LEAST_SUM = 0.3  # A, below which the sum is noise and offsets
PHASES = ("i_a", "i_b", "i_c")


@dataclass
class _Asked:
    """A stretch of the run in which one speed was asked for, mechanical r/min, and one load, A."""

    speed_rpm: float
    load_a: float = 0.0
    title: str = ""
    looks: deque[tuple[float, float, float, float]] = field(default_factory=deque)
    """Duration in s, mean speed in r/min, mean current and mean i_q in A, chunk by chunk; of the last `LAST` s."""
    seconds: float = 0.0


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


class Plausibility:
    """Sink that judges the run of a drive by its `stream` of samples and, with `edges`, its Hall edges.

    `parameters`: the drive's, by name, in their units.
    """

    def __init__(self, stream: StreamConfig, edges: bool, parameters: Mapping[str, float]) -> None:
        channels = stream.channels
        self._drive, self._rate, self._edges = stream.node, stream.rate, edges
        self._names = {channel.name for channel in channels}
        self._n_p = pole_pairs(parameters)
        self._i_max = parameters.get("i_max", math.inf)
        self._theta = reference_angle(channels)
        self._omega = flagged(channels, Unit.RAD_PER_S, Flag.REFERENCE)
        self._by = "the encoder" if self._omega else "its Hall sensors" if edges else "its own estimate"
        if not self._omega and not edges:
            self._omega = speed_channel(channels, parameters)
        self._asked: list[_Asked] = []
        self._not_finite: dict[str, int] = {}
        self._current, self._phase, self._sum = Moments(), Moments(), Moments()
        self._sectors = 0.0  # since the last chunk of samples
        self._turns, self._wires, self._emf = Turns(self._rate, self._n_p), Wires(), BackEmf(parameters)

    def ask(self, speed_rpm: float, load_a: float = 0.0, title: str = "") -> None:
        """From now on this speed is asked for, and this load."""
        self._asked.append(_Asked(speed_rpm, load_a, title))

    def came(self) -> list[Came]:
        """What was asked for and what came, one by one."""
        return [
            Came(a.title, a.speed_rpm, _mean(a.looks, 1), a.load_a, _mean(a.looks, 3), self._by) for a in self._asked
        ]

    # -- sink ---------------------------------------------------------------------------------------------------

    def take(self, item: Heard) -> None:
        """Follow the Hall sensors from sector to sector; take in what was sampled while the drive was running."""
        if isinstance(item, EdgeChunk) and item.config.node == self._drive:
            self._edges_came(item)
        elif isinstance(item, SampleChunk) and item.config.node == self._drive:
            self._samples_came(item)

    def _edges_came(self, chunk: EdgeChunk) -> None:
        steps = steps_between(chunk.hall_old, chunk.hall_new)
        self._sectors += float(steps.sum())
        if self._theta:
            self._turns.edges(chunk, steps)

    def _samples_came(self, chunk: SampleChunk) -> None:
        gone, self._sectors = self._sectors, 0.0
        for channel in chunk.config.channels:
            if channel.raw.dtype == "<f4":
                bad = int(np.count_nonzero(~np.isfinite(chunk.raw[channel.name])))
                self._not_finite[channel.name] = self._not_finite.get(channel.name, 0) + bad
        if self._theta and "hall" in self._names:  # in any state
            self._wires.add(chunk.physical(self._theta), chunk.raw["hall"])
        if (told := states(chunk)) is not None and told[-1] != DriveState.RUNNING:
            self._turns.samples(chunk, None)
            return
        seconds = len(chunk) / self._rate
        self._look_at_currents(chunk)
        self._look_for_causes(chunk, seconds)
        if self._theta:
            step = float(np.abs(chunk.physical(self._omega)).mean()) / self._rate if self._omega else 0.0
            self._turns.samples(chunk, chunk.physical(self._theta), step)
        self._look_at_speed(chunk, gone, seconds)

    def _look_at_currents(self, chunk: SampleChunk) -> None:
        if {"i_d", "i_q"} <= self._names:
            self._current.add(np.hypot(chunk.physical("i_d"), chunk.physical("i_q")))
        if self._names.issuperset(PHASES):
            a, b, c = (chunk.physical(name) for name in PHASES)
            self._phase.add(np.sqrt((a * a + b * b + c * c) / 3.0))
            self._sum.add(a + b + c)

    def _look_for_causes(self, chunk: SampleChunk, seconds: float) -> None:
        if self._omega and self._names.issuperset(("e_alpha", "e_beta", "i_d", "i_q")) and self._by == "the encoder":
            emf = float(np.hypot(chunk.physical("e_alpha"), chunk.physical("e_beta")).mean())
            current = math.hypot(chunk.physical("i_d").mean(), chunk.physical("i_q").mean())
            self._emf.add(seconds, emf, float(np.abs(chunk.physical(self._omega)).mean()), current)

    def _look_at_speed(self, chunk: SampleChunk, gone: float, seconds: float) -> None:
        if not self._asked or self._n_p is None:
            return
        if self._omega:
            omega = float(chunk.physical(self._omega).mean())
        elif self._edges:
            omega = gone * SECTOR / seconds
        else:
            return
        current = i_q = math.nan
        if {"i_d", "i_q"} <= self._names:
            current = float(np.hypot(chunk.physical("i_d"), chunk.physical("i_q")).mean())
            i_q = float(chunk.physical("i_q").mean())
        asked = self._asked[-1]
        asked.seconds += seconds
        asked.looks.append((seconds, omega / self._n_p / RPM, current, i_q))
        while sum(look[0] for look in asked.looks) > min(LAST, max(asked.seconds / 3.0, BLOCK)):
            asked.looks.popleft()

    # -- at the end ---------------------------------------------------------------------------------------------

    def implausible(self, errors: ErrorTable) -> list[str]:
        """What cannot be right for a healthy drive, each with its numbers; `errors`: position errors of the run."""
        found = [f"{name} is not a finite number in {n} samples" for name, n in self._not_finite.items() if n]
        found += self.causes()
        found += [words for asked in self._asked if (words := self._wrong_speed(asked))]
        of_all: dict[str, Moments] = {}
        for name, moments in (pair for row in errors.segments.values() for pair in row.items()):
            of_all.setdefault(name, Moments()).merge(moments)
        for name, whole in of_all.items():
            if whole.n / self._rate >= SEEN_FOR and (rms := whole.rms) > OFF_BY:
                found.append(f"{name} is {math.degrees(rms):.0f} deg (rms) off the encoder: more than a Hall sector")
        if self._current.rms > TOO_MUCH * self._i_max:
            found.append(f"{self._current.rms:.3g} A (rms of the current vector) with i_max = {self._i_max:g} A")
        if self._sum.rms > max(LEAST_SUM, NO_SUM * self._phase.rms):
            found.append(
                f"the phase currents add up to {self._sum.rms:.2g} A (rms), which should be 0, at "
                f"{self._phase.rms:.2g} A a phase"
            )
        return found

    def causes(self) -> list[str]:
        """What is set or wired wrongly, by what the shaft showed as it turned; also of a run that ended in a trip."""
        turns = self._turns.finding() if self._edges else ""
        return [turns] if turns else [cause for cause in (self._wires.finding(), self._emf.finding(SEEN_FOR)) if cause]

    def unverified(self) -> list[str]:
        """What nothing in the stream could show, each with the reason."""
        unseen = []
        if not self._theta:
            unseen.append("position error (no angle with the flag REFERENCE)")
        elif self._turns.too_late:
            unseen.append(
                "Hall sensors against the encoder (edges come too late after the samples, or their ticks are wrong)"
            )
        elif self._turns.too_fast and self._edges and not self._turns.compared:
            unseen.append("Hall sensors against the encoder (too few samples in an electrical revolution)")
        if self._n_p is None:
            unseen.append("speed (no parameter n_p)")
        elif not self._omega and not self._edges:
            unseen.append("speed (no encoder, no Hall edges, no estimate of it)")
        elif self._by == "its own estimate":
            unseen.append("speed, but for the drive's own estimate")
        else:
            slow = [
                asked
                for asked in self._asked  # whether such a speed still changes is noise
                if asked.seconds >= LONG_ENOUGH and 0 < abs(asked.speed_rpm) <= self._off(asked)
            ]
            short = [
                asked
                for asked in self._asked
                if asked not in slow and (asked.seconds < LONG_ENOUGH or self._on_its_way(asked))
            ]
            for which, why in ((short, "too short a time"), (slow, "too slow to tell")):
                if speeds := ", ".join(f"{asked.speed_rpm:g}" for asked in which):
                    unseen.append(f"whether {speeds} r/min are held ({why})")
        return unseen

    def _off(self, asked: _Asked) -> float:
        """By how many r/min the mean speed may be off: at least by a Hall sector, where those tell it."""
        if not asked.speed_rpm:
            return STANDS
        bound = max(LEAST_SPEED, SPEED_OFF * abs(asked.speed_rpm))
        if self._by == "its Hall sensors" and asked.looks and self._n_p:
            bound = max(bound, SECTOR / (self._n_p * RPM * sum(look[0] for look in asked.looks)))
        return bound

    def _wrong_speed(self, asked: _Asked) -> str:
        if asked.seconds < LONG_ENOUGH or not asked.looks or self._on_its_way(asked):
            return ""
        speed, current = _mean(asked.looks, 1), _mean(asked.looks, 2)
        if abs(speed - asked.speed_rpm) <= self._off(asked):
            return ""
        amperes = "" if math.isnan(current) else f", with {current:.1f} A"
        of = f" of {self._i_max:g} A (i_max)" if amperes and math.isfinite(self._i_max) else ""
        return f"{asked.speed_rpm:g} r/min were asked for, it turned at {speed:.0f} r/min by {self._by}{amperes}{of}"

    def _on_its_way(self, asked: _Asked) -> bool:
        """Whether the speed still changes towards what was asked for."""
        looks = list(asked.looks)
        if len(looks) < 2:
            return False
        early, late = (_mean(part, 1) for part in (looks[: len(looks) // 2], looks[len(looks) // 2 :]))
        nearer = abs(asked.speed_rpm - early) - abs(asked.speed_rpm - late)
        return nearer > RISING * abs(asked.speed_rpm)


def _mean(looks: Sequence[tuple[float, ...]], column: int) -> float:
    """Over the time; NaN of nothing."""
    seconds = sum(look[0] for look in looks)
    return sum(look[0] * look[column] for look in looks) / seconds if seconds else math.nan
