"""The scripted show on the simulated drive: manoeuvres of the paper with the average speed, then with the observer.

A show is a list of acts. It decides what is done and when, never how: `bench.live.run` runs it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle

from protocol.signals import AngleSource


@dataclass(frozen=True, slots=True)
class Act:
    """From now on, for `seconds`: this speed, this load, this angle source."""

    title: str
    seconds: float
    speed_rpm: float
    load_a: float
    source: int | None  # None leaves it alone


AVERAGE, TRACKING = AngleSource.AVERAGE_SPEED, AngleSource.VECTOR_TRACKING

SHOW: tuple[Act, ...] = (
    Act("start-up to 500 r/min, average speed", 3.0, 500, 0.0, AVERAGE),
    Act("step to 1000 r/min, average speed", 3.0, 1000, 0.0, AVERAGE),
    Act("load step to 4 A, average speed", 3.0, 1000, 4.0, AVERAGE),
    Act("switch to vector tracking, 4 A", 3.0, 1000, 4.0, TRACKING),
    Act("step to 500 r/min, vector tracking", 3.0, 500, 4.0, TRACKING),
    Act("load off, vector tracking", 3.0, 500, 0.0, TRACKING),
)


def timed(acts: Sequence[Act], seconds: float | None) -> Iterator[Act]:
    """The acts once, or, to fill `seconds`, over and over and cut short."""
    if seconds is None:
        yield from acts
        return
    for act in cycle(acts):
        yield replace(act, seconds=min(act.seconds, seconds))
        seconds -= act.seconds
        if seconds <= 0:
            return
