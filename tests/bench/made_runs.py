"""Recordings of formulas: any channels of the vocabulary as float32, edges, events and marks, in any rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.record.info import Mark, RunInfo
from bench.record.writer import RunWriter
from bench.signal.chunks import part
from protocol.descriptor import Channel, Descriptor
from protocol.host import DeviceEventReceived
from protocol.messages import DeviceEvent, StreamEvent
from protocol.signals import DRIVE_CHANNELS, RawType, Unit
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig, sample_dtype

TICK_HZ, PWM_HZ, N_P = 20_000_000, 16_000, 6
RPM = 2 * np.pi / 60
VOCABULARY = {channel.name: channel for channel in Descriptor.of(DRIVE_CHANNELS, ()).channels}
PARAMETERS = {"n_p": float(N_P), "i_max": 8.0}
CODES = np.array([0b001, 0b011, 0b010, 0b110, 0b100, 0b101], np.uint8)
"""By sector."""

Columns = Mapping[str, np.ndarray]
Edges = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Tick, code before, code after."""


def channel(name: str, unit: Unit | None = None) -> Channel:
    """As the vocabulary has it, but for numbers that are exact."""
    known = VOCABULARY[name]
    if name in ("hall", "status"):
        return known
    return replace(known, raw=RawType.F32, scale=1.0, offset=0.0, unit=known.unit if unit is None else unit)


def make(
    path: Path,
    columns: Columns,
    edges: Edges | None = None,
    *,
    start: int = 0,
    events: Sequence[DeviceEvent] = (),
    marks: Sequence[Mark] = (),
    parameters: Mapping[str, float] = PARAMETERS,
    decimation: int = 1,
    units: Mapping[str, Unit] | None = None,
    channels: Sequence[Channel] | None = None,
) -> Path:
    """A run of these columns (n,) in SI units, from PWM period `start` on; `channels` that the vocabulary lacks."""
    channels = tuple(channels or (channel(name, (units or {}).get(name)) for name in columns))
    info = RunInfo(tick_hz=TICK_HZ, pwm_hz=PWM_HZ, channels=channels, parameters=parameters, identity={"name": "made"})
    clock = {"tick_hz": TICK_HZ, "pwm_hz": PWM_HZ}
    config = StreamConfig(1, 0, 1, StreamEvent.PWM, decimation, channels, 25, **clock)
    n = len(next(iter(columns.values())))
    raw = np.empty(n, sample_dtype(channels))
    for its in channels:
        values = np.asarray(columns[its.name])
        raw[its.name] = np.mod(values + np.pi, 2 * np.pi) - np.pi if its.unit == Unit.RAD else values
    index = start + np.arange(n, dtype=np.int64) * decimation
    whole = SampleChunk(config, index, index * (TICK_HZ // PWM_HZ), raw, ())
    writer = RunWriter(path, info)
    for event in events:
        writer.take(DeviceEventReceived(event.node, event))
    for mark in marks:
        writer.take(mark)
    if edges is not None:
        tick, old, new = edges
        edge_config = StreamConfig(1, 1, 2, StreamEvent.EDGES, 1, (), 100, **clock)
        count = np.arange(len(tick), dtype=np.int64)
        nothing = np.zeros(len(tick))
        writer.take(EdgeChunk(edge_config, tick, old, new, nothing.astype(bool), nothing.astype(np.uint16), count, ()))
    for first in range(0, n, 4000):
        writer.take(part(whole, first, min(first + 4000, n)))
    writer.close()
    return path


def tick(seconds: float) -> int:
    return round(seconds * TICK_HZ)


def turning(rpm: np.ndarray) -> np.ndarray:
    """Electrical angle of a shaft with these speeds, sample by sample."""
    steps = rpm * RPM * N_P / PWM_HZ
    return np.cumsum(steps) - steps
