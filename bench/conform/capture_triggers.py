"""Level 2, fourth part: captures that a condition on a channel freezes. Chapter 19 of SPEC."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bench.conform.captured import RECORDS, Captured, captured, fitting_records, require_capture
from bench.conform.checks import Group
from bench.conform.data import few
from bench.conform.device import Device, ids
from bench.conform.levels import STREAMS
from bench.conform.verdicts import Failed, Unknown
from protocol.codes import CaptureTrigger
from protocol.descriptor import Channel
from protocol.messages import CaptureArm

check = Group("capture", STREAMS)

AROUND = 40  # records before a trigger, and from it on
SPARSE = 50  # a decimation
SELDOM = 0.1  # share of the periods that a level is above, or below
RARE = 0.06  # share of the periods in which a condition is met that is looked for with it
OFTEN = 4  # captures of it
KINDS = (
    CaptureTrigger.ABOVE, CaptureTrigger.BELOW, CaptureTrigger.RISES, CaptureTrigger.FALLS, CaptureTrigger.CHANGES
)  # fmt: skip
BY_TWO = (CaptureTrigger.RISES, CaptureTrigger.FALLS, CaptureTrigger.CHANGES)
"""Conditions that compare with the period before."""


def _at_rest(device: Device) -> Captured:
    """Consecutive periods of the channels that a stream can carry beside."""
    chosen = few(device)
    return captured(device, CaptureArm(CaptureTrigger.NOW, after=fitting_records(device, chosen), channels=ids(chosen)))


def _moving(device: Device) -> tuple[Channel, NDArray[np.float64]]:
    """The channel that changes most at rest, and its values in consecutive periods. Raises Unknown."""
    found = device.once("capture", lambda: _at_rest(device))
    values = {channel: found.values(channel) for channel in found.channels}
    best = max(values, key=lambda channel: len(np.unique(values[channel])))
    if len(np.unique(values[best])) < 3:
        raise Unknown("no channel changes at rest")
    return best, values[best]


def _met(kind: CaptureTrigger, values: NDArray[np.float64], level: float) -> NDArray[np.bool_]:
    """In which of consecutive periods a condition of SPEC's table holds; the first has none before it."""
    before = np.concatenate([values[:1], values[:-1]])
    if kind == CaptureTrigger.CHANGES:
        changes: NDArray[np.bool_] = values != before
        return changes
    above = kind in (CaptureTrigger.ABOVE, CaptureTrigger.RISES)
    now, was = (values > level, before > level) if above else (values < level, before < level)
    if kind in (CaptureTrigger.ABOVE, CaptureTrigger.BELOW):
        was = np.zeros_like(was)
    found: NDArray[np.bool_] = now & ~was
    return found


def _level(values: NDArray[np.float64], share: float) -> float:
    """A level that about this share of some values is below, and none of them on."""
    ordered = np.unique(values)
    below = int(np.searchsorted(np.cumsum([np.mean(values == each) for each in ordered]), share))
    below = min(max(below, 0), len(ordered) - 2)
    return float(ordered[below] + ordered[below + 1]) / 2


@check("channel-triggers", "19.18 19.20 19.21 19.24")
def channel_triggers(device: Device) -> Iterator[str]:
    """The trigger's record is the first that fulfils the condition, for each condition on a channel."""
    require_capture(device)
    channel, values = _moving(device)
    around = min(AROUND, fitting_records(device, [channel]) // 2)
    for kind in KINDS:
        level = _level(values, SELDOM if kind in (CaptureTrigger.BELOW, CaptureTrigger.RISES) else 1 - SELDOM)
        request = CaptureArm(kind, 0, 1, around, around, level, channel.id, channels=(channel.id,))
        for _ in range(OFTEN if kind in BY_TWO else 1):
            found = captured(device, request)
            if kind in BY_TWO and not found.reply.first:
                raise Failed(
                    f"{kind.name} of {channel.name}: the first period is the trigger's, and has none before it"
                )
        first, seen = found.reply.first, _met(kind, found.values(channel), level)
        words = f"{kind.name} of {channel.name}, level {level:.6g}, {first} records before the trigger's"
        if found.reply.trigger != kind or first > around:
            raise Failed(f"{words}: the trigger is {found.reply.trigger.name}")
        if seen[:first].any():
            raise Failed(f"{words}: the condition held before, in record {int(seen.argmax())}")
        if first and not seen[first]:
            raise Failed(f"{words}: the condition does not hold in the trigger's: {found.values(channel)[first]:.6g}")
        yield words


@check("judged-in-each-period", "19.18 19.19")
def judged_in_each_period(device: Device) -> str:
    """A condition is judged in every period, also where one in many is recorded."""
    require_capture(device)
    channel, values = _moving(device)
    ordered = np.unique(values)
    shares = [float(np.mean(values > level)) for level in ordered]
    rare = [n for n, share in enumerate(shares) if 0 < share <= RARE]
    if not rare or len(values) < RECORDS:
        raise Unknown(f"no level of {channel.name} is rarely exceeded at rest")
    level = float(ordered[rare[0]] + ordered[rare[0] + 1]) / 2
    above = 0
    for _ in range(OFTEN):
        request = CaptureArm(CaptureTrigger.ABOVE, 0, SPARSE, 2, 2, level, channel.id, channels=(channel.id,))
        found = captured(device, request)
        above += bool(found.values(channel)[found.reply.first] > level)
    words = (
        f"{channel.name} above {level:.6g}, as {100 * shares[rare[0]]:.1f} % of the periods are, one in {SPARSE} kept"
    )
    if above == OFTEN:
        raise Failed(
            f"{words}: the trigger's record is above it in each of {OFTEN} captures, as if no other were judged"
        )
    return f"{words}: the trigger's record is above it in {above} of {OFTEN} captures"
