"""Level 2, fifth part: means of the period, beside every period. 11.51 of SPEC."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.conform.captured import captured, fitting_records, require_capture
from bench.conform.checks import Group
from bench.conform.data import by_index, periods, split_sample, unwrapped
from bench.conform.device import ALL, Configured, Device, ids
from bench.conform.levels import STREAMS
from bench.conform.verdicts import Failed, Unknown
from protocol.codes import CaptureTrigger, Feature, StreamEvent
from protocol.descriptor import Channel
from protocol.messages import CaptureArm
from protocol.signals import Flag, RawType, Unit

check = Group("stream", STREAMS)

RATE = 400.0  # Hz of the means
WATCHED = 0.1  # s
PERIODS = 2000  # in a row that are looked at, where there is room
EXACT = 2.0**-22  # share of the largest raw value by which a mean may be off: two roundings to f32


def _chosen(device: Device) -> tuple[Channel, ...]:
    """Channels of each kind that a mean knows: one that wraps, one without unit, and two others."""
    wraps = [c for c in device.channels if c.flags & Flag.WRAPS]
    plain = [c for c in device.channels if c.unit == Unit.NONE and c not in wraps]
    others = [c for c in device.channels if c not in wraps and c not in plain]
    currents = sorted(others, key=lambda channel: channel.unit != Unit.A)
    return tuple(dict.fromkeys((*wraps[:1], *plain[:1], *plain[-1:], *currents[:2])))


def every_period(device: Device, chosen: Sequence[Channel]) -> dict[int, bytes]:
    """Samples of consecutive periods by index, while a stream runs: captured, or else streamed. Raises Unknown."""
    if device.offers(Feature.CAPTURE):
        require_capture(device)
        records = fitting_records(device, chosen, PERIODS)
        request = CaptureArm(CaptureTrigger.NOW, 0, 1, 0, records, channels=ids(chosen))
        return captured(device, request).records
    told = device.configure(1, ids(chosen), device.pwm_hz, share=ALL)
    if told.asked.decimation > 1:
        raise Unknown("the link is too slow for samples of every period, and the device lacks the feature CAPTURE")
    device.start_streams(2)
    device.probe.listen(WATCHED)
    return by_index(device, told, tuple(chosen))


@check("means", "11.51 11.10")
def means(device: Device) -> str:
    """A record of MEAN holds the mean of the raw values over its periods, the last value of what has no unit."""
    return means_beside(device)


def means_beside(device: Device, meanwhile: Callable[[Configured], None] = lambda told: None) -> str:
    """Evidence for the means of some channels, streamed once `meanwhile` has begun. Raises Failed, Unknown."""
    device.require(Feature.MEANS)
    chosen = _chosen(device)
    told = device.configure(0, ids(chosen), RATE, event=StreamEvent.MEAN)
    if told.reply.sample_bytes != 4 * len(chosen):
        raise Failed(f"sample_bytes is {told.reply.sample_bytes} for the means of {len(chosen)} channels")
    device.start_streams(1)
    meanwhile(told)
    device.probe.listen(WATCHED / 2)
    samples = every_period(device, chosen)
    device.probe.listen(WATCHED / 2)
    device.stop_streams()
    as_floats = tuple(replace(channel, raw=RawType.F32) for channel in chosen)
    found, now = by_index(device, told, as_floats), periods(device, told)
    for index in found:
        if unwrapped(index, now) % told.asked.decimation:
            raise Failed(f"index {index} of a record of MEAN is not divisible by {told.asked.decimation}")
    return _compared(told, chosen, found, samples)


def _compared(told: Configured, chosen: Sequence[Channel], found: dict[int, bytes], samples: dict[int, bytes]) -> str:
    decimation, looked, differs = told.asked.decimation, 0, False
    for index, record in found.items():
        span = [(index - k) & 0xFFFFFFFF for k in range(decimation - 1, -1, -1)]
        if any(n not in samples for n in span):
            continue
        looked += 1
        rows = [split_sample(samples[n], tuple(chosen)) for n in span]
        for at, channel in enumerate(chosen):
            raw = np.frombuffer(b"".join(row[at] for row in rows), channel.raw.dtype).astype(np.float64)
            value, due = float(np.frombuffer(record, "<f4")[at]), mean_of(channel, raw)
            differs = differs or due not in (raw[0], raw[-1])
            span_of = turn_of(channel)
            off = abs(value - due)
            if span_of:
                off = min(off, abs(span_of - off))
            if not off <= EXACT * max(np.abs(raw).max(), span_of, 1.0):
                raise Failed(
                    f"{channel.name} of the {decimation} periods to index {index} is {value:.9g}, not {due:.9g}"
                )
            if span_of and not -span_of / 2 <= value < span_of / 2:
                raise Failed(f"{channel.name} of the periods to index {index} is {value:.9g}, out of its type")
    if not looked:
        raise Unknown(f"no record of MEAN has all its {decimation} periods among {len(samples)}")
    if not differs:
        raise Unknown("all channels stood still")
    return f"{looked} records of {len(chosen)} channels over {decimation} periods each: their means"


def turn_of(channel: Channel) -> float:
    """A turn of a channel that wraps in raw units, 0 for another."""
    if not channel.flags & Flag.WRAPS:
        return 0.0
    if channel.raw == RawType.F32:
        return 2 * math.pi / channel.scale
    return float(1 << 8 * np.dtype(channel.raw.dtype).itemsize)


def mean_of(channel: Channel, raw: NDArray[np.float64]) -> float:
    """What 11.51 says of the raw values of consecutive periods, (n,)."""
    if channel.unit == Unit.NONE:
        return float(raw[-1])
    turn = turn_of(channel)
    if not turn:
        return math.fsum(raw) / len(raw)
    ahead = [(value - raw[0] + turn / 2) % turn - turn / 2 for value in raw]
    mean = raw[0] + math.fsum(ahead) / len(raw)
    return float((mean + turn / 2) % turn - turn / 2)
