"""The scripted show on the simulated drive: manoeuvres of the paper with the average speed, then with the observer.

A show is a list of acts. It decides what is done and when, never how: `bench.live.run` runs it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle

from bench.signal.units import RPM
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

SLOW = 500.0 * RPM / 330.0
"""The show's lower speed, as a share of the largest: 500 r/min of the paper's motor. The other is twice that."""


def show(omega_m_max: float, i_max: float) -> tuple[Act, ...]:
    """The show for a drive with these limits, rad/s and A; for the paper's at 500 and 1000 r/min, with 4 A."""
    slow, amperes = float(f"{SLOW * omega_m_max / RPM:.2g}"), float(f"{0.5 * i_max:.2g}")
    fast = 2.0 * slow
    return (
        Act(f"start-up to {slow:g} r/min, average speed", 3.0, slow, 0.0, AVERAGE),
        Act(f"step to {fast:g} r/min, average speed", 3.0, fast, 0.0, AVERAGE),
        Act(f"load step to {amperes:g} A, average speed", 3.0, fast, amperes, AVERAGE),
        Act(f"switch to vector tracking, {amperes:g} A", 3.0, fast, amperes, TRACKING),
        Act(f"step to {slow:g} r/min, vector tracking", 3.0, slow, amperes, TRACKING),
        Act("load off, vector tracking", 3.0, slow, 0.0, TRACKING),
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
