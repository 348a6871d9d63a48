"""Hall signals that somebody disturbs: pulses, bounces, dead sensors, put into signals that are well.

A disturbance changes when a sensor's input changes; codes at the samples and captured edges follow from that.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from ideal_motor import TICK_HZ, Signals

Changes = list[np.ndarray]
"""By sensor: ticks at which its input changes, rising; shape (n,)."""


def changes(s: Signals) -> Changes:
    """Of signals."""
    changed = s.edge_hall ^ np.r_[s.hall[:1], s.edge_hall[:-1]]
    return [s.edge_tick[(changed >> sensor) & 1 == 1] for sensor in range(3)]


def with_changes(s: Signals, ticks: Changes) -> Signals:
    """The signals with these instead of their own; two at one tick cancel each other."""
    code = np.zeros(s.tick.size, np.uint8)
    at, bits = [], []
    for sensor, each in enumerate(ticks):
        tick, count = np.unique(each, return_counts=True)
        tick = tick[count % 2 == 1]
        level = (s.hall[0] >> sensor) & 1 ^ np.searchsorted(tick, s.tick, side="right") & 1
        code |= (level << sensor).astype(np.uint8)
        at.append(tick)
        bits.append(np.full(tick.size, 1 << sensor, np.uint8))
    tick, bit = np.concatenate(at), np.concatenate(bits)
    order = np.argsort(tick, kind="stable")
    return s._replace(hall=code, edge_tick=tick[order], edge_hall=np.bitwise_xor.accumulate(bit[order]) ^ s.hall[0])


def pulsed(s: Signals, pulses: Iterable[tuple[int, float, float]]) -> Signals:
    """With pulses: of a sensor, from a tick on, for so many s, its input is inverted."""
    ticks = changes(s)
    for sensor, tick, width in pulses:
        ticks[sensor] = np.append(ticks[sensor], [int(tick), int(tick) + max(1, round(width * TICK_HZ))])
    return with_changes(s, ticks)


def bounced(
    s: Signals,
    rng: np.random.Generator,
    returns: int,
    gap: float,
    share: float = 1.0,
    sensors: Sequence[int] = range(3),
) -> Signals:
    """With a share of these sensors' edges bouncing: `returns` times to and fro, each after 0.7 to 1 times `gap` s."""
    ticks = changes(s)
    for sensor in sensors:
        of = ticks[sensor][rng.random(ticks[sensor].size) < share]
        later = np.cumsum(rng.uniform(0.7, 1.0, (of.size, 2 * returns)) * gap * TICK_HZ, axis=1)
        ticks[sensor] = np.append(ticks[sensor], (of[:, None] + later.astype(np.int64)).ravel())
    return with_changes(s, ticks)


def dead(s: Signals, sensor: int, level: int, tick: float = -1) -> Signals:
    """With an input that shows one level from a tick on, or always."""
    ticks = changes(s)
    before = ticks[sensor][ticks[sensor] <= tick]
    hall = s.hall.copy()
    if tick < 0:
        hall[0] = hall[0] & ~np.uint8(1 << sensor) | np.uint8(level << sensor)
    elif (hall[0] >> sensor) & 1 ^ before.size & 1 != level:
        before = np.append(before, int(tick))
    ticks[sensor] = before
    return with_changes(s._replace(hall=hall), ticks)
