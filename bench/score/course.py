"""What the shaft did over a whole recording, from its angle, speed and status alone: a first pass over these channels.

When it starts and turns round depends on all that came before, and what counts depends on whether the drive was ever
RUNNING: that has to be known before the first sample is scored.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bench.score.phases import CONTEXT, Turns, changes, direction_of, speed_of, turns_of
from bench.signal.capture import Capture
from bench.signal.position import running, states
from bench.signal.windows import windows
from protocol.streams import SampleChunk


@dataclass
class _Growing:
    """A stretch as it is found: where its direction changes, from its first sample on."""

    first: int
    t: float
    n: int = 0
    begins: list[int] = field(default_factory=list)
    directions: list[int] = field(default_factory=list)
    running: list[bool] = field(default_factory=list)

    def turns(self, ran: bool | None, rate: float) -> Turns:
        """Its starts and reversals; those while the drive is RUNNING, where it ever `ran`."""
        usable = np.array(self.running) if ran else np.ones(len(self.begins), bool)
        begins, directions = np.array(self.begins, np.int64), np.array(self.directions, np.int8)
        return turns_of(begins, directions, usable, self.n, rate)


@dataclass(frozen=True)
class Stretch:
    """n samples without a gap, of which the angle is known."""

    first: int
    """Its first sample, counted from the recording's."""
    t: float
    """Device time of that, s."""
    n: int
    turns: Turns
    """By its own samples, from 0."""


@dataclass(frozen=True)
class Course:
    """A whole recording."""

    stretches: tuple[Stretch, ...]
    samples: int
    lost: int
    """Samples, before its first too, if that is told."""
    ran: bool | None
    """Whether the drive was RUNNING at any sample; None where it does not tell."""
    fastest: dict[str, float]
    """The largest magnitude of each of the speeds that were asked for, rad/s."""
    top_speed: float
    """The largest magnitude of the speed by the angle itself, electrical rad/s."""

    @property
    def unknown(self) -> int:
        """Samples of which no angle is known."""
        return self.samples - sum(stretch.n for stretch in self.stretches)

    def usable(self, samples: SampleChunk) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which of some samples count, (n,)."""
        return running(samples) if self.ran else np.ones(len(samples), bool)


def survey(captures: Iterable[Capture], reference: str, speeds: Iterable[str], pole_pairs: int) -> Course:
    """Go through captures that follow each other. `reference`: the actual angle, NaN for none; `speeds`: channels."""
    found: list[_Growing] = []
    fastest = dict.fromkeys(speeds, 0.0)
    samples = lost = 0
    ran: bool | None = None
    rate, top_speed = 1.0, 0.0
    for window in windows(captures, CONTEXT):
        whole, own = window.capture.samples, window.samples
        rate = window.capture.rate
        lost += sum(gap.lost_samples for gap in own.gaps)
        for name in fastest:
            fastest[name] = max(fastest[name], float(np.abs(own.physical(name)).max()))
        now = running(whole)
        if states(own) is not None:
            ran = bool(ran) or bool(now[window.own].any())
        theta = whole.physical(reference)
        for rows, part in window.stretches(np.isfinite(theta)):
            if part.start == rows.start:
                found.append(_Growing(samples + part.start - window.own.start, float(window.capture.t[part.start])))
            growing = found[-1]
            speed, kept = speed_of(theta[rows], rate), slice(part.start - rows.start, part.stop - rows.start)
            direction = direction_of(speed, pole_pairs)[kept]
            top_speed = max(top_speed, float(np.abs(speed[kept]).max(initial=0.0)))
            for at in changes(direction).tolist():
                if not growing.directions or growing.directions[-1] != direction[at]:
                    growing.begins.append(growing.n + at)
                    growing.directions.append(int(direction[at]))
                    growing.running.append(bool(now[part.start + at]))
            growing.n += len(direction)
        samples += len(own)
    stretches = tuple(Stretch(g.first, g.t, g.n, g.turns(ran, rate)) for g in found)
    return Course(stretches, samples, lost, ran, fastest, top_speed)
