"""The device's streams: which channels, how often, in which order.

Every edge goes out before the frame whose last sample is at or after it. What a frame looks like is the
`Carrier`'s. This module never blocks and never waits.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from protocol.descriptor import sample_dtype
from protocol.device.app import Identity
from protocol.device.carrier import Carrier, EdgeStream, SampleStream, Shape
from protocol.device.records import Means, Records, Samples, Values, check_channels, made, rows_of
from protocol.errors import Refused
from protocol.messages import ErrorCode, Feature, StreamEvent, StreamInfo, StreamReply, StreamSet
from protocol.signals import Signal
from protocol.streams import EDGE_RECORD, MAX_DECIMATION, MAX_STREAMS

MAX_LOAD = 0.95


class StreamTable:
    """The streams of one device: a stream is free, configured or running."""

    def __init__(self, identity: Identity, channels: Sequence[Signal], carrier: Carrier) -> None:
        self._identity = identity
        self._carrier = carrier
        self._channels = {channel.id: channel for channel in channels}
        self._dtype = sample_dtype(channels)
        self._tx = carrier.tx
        self._ticks_per_period = identity.tick_hz // identity.pwm_hz
        self._streams: dict[int, SampleStream | EdgeStream] = {}
        self._configured: dict[int, tuple[StreamSet, StreamReply]] = {}
        self._cfg_id = identity.boot_id & 0xFFFF
        self._dropped = 0
        self.channels: frozenset[str] = frozenset()
        """Names of the channels that streams are configured with."""
        self.edges = 0
        """Hall edges since boot."""
        self.expired = 0
        """Stream frames that waited too long."""

    @property
    def dropped(self) -> int:
        """Stream frames that were not sent since boot."""
        return self.expired + self._dropped + sum(stream.dropped for stream in self._streams.values())

    @property
    def running(self) -> frozenset[int]:
        """Numbers of the running streams."""
        return frozenset(number for number, stream in self._streams.items() if stream.running)

    def configure(self, request: StreamSet, tx_max: int) -> StreamReply:
        """Carry out STREAM_SET; Refused, nothing changed, if it cannot be done."""
        self._check(request)
        records = self._records(request)
        widths = records.widths

        def shape_at(decimation: int) -> Shape:
            return self._carrier.shape(request, widths, tx_max, self._identity.pwm_hz, decimation)

        shape = shape_at(request.decimation)
        load = self._load(request, shape.rate)
        if load > MAX_LOAD:
            fits = self._smallest_decimation(request, shape_at)
            raise Refused(f"the link would be loaded to {load:.0%}", ErrorCode.DOES_NOT_FIT, fits)
        cfg_id = self._cfg_id % 0xFFFF + 1
        node, ticks = self._identity.node, self._ticks_per_period
        stream: SampleStream | EdgeStream
        if request.event == StreamEvent.EDGES:
            size = EDGE_RECORD.itemsize
            stream = self._carrier.edges(node, request, cfg_id, shape.block)
        else:
            size = sum(widths)
            stream = self._carrier.samples(node, request, cfg_id, records, shape.block, ticks)
        self._forget(request.stream)
        self._streams[request.stream] = stream
        self._cfg_id = cfg_id
        self._tx.rates[node, request.stream] = shape.rate
        reply = StreamReply(request.stream, cfg_id, size, shape.block, load, stream.slot, self._identity.tick0)
        self._configured[request.stream] = request, reply
        self._look_at_channels()
        return reply

    def describe(self, number: int, tx_max: int) -> StreamInfo:
        """Carry out STREAM_GET, with as many ids as fit; Refused if the stream is not configured."""
        _check_number(number)
        if number not in self._configured:
            raise Refused(f"stream {number} is not configured", ErrorCode.UNKNOWN_ID, number)
        request, reply = self._configured[number]
        told = asdict(request) | asdict(reply) | {"running": self._streams[number].running}
        del told["load"]
        told["channels"] = request.channels[: (tx_max - StreamInfo.FIXED_BYTES) // 2]
        return StreamInfo(**told)

    def start(self, mask: int) -> None:
        """Carry out STREAM_START; Refused, nothing started, if a stream is not configured."""
        chosen = [number for number in range(32) if mask >> number & 1]
        for number in chosen:
            if number not in self._streams:
                raise Refused(f"stream {number} is not configured", ErrorCode.UNKNOWN_ID, number)
        for number in chosen:
            self._streams[number].running = True

    def stop(self, mask: int) -> None:
        """Carry out STREAM_STOP: what waits is sent, the configuration is forgotten."""
        chosen = [number for number in self._streams if mask >> number & 1]
        self.flush(chosen)
        for number in chosen:
            self._forget(number)
            self._carrier.close(number)

    def push_samples(self, index0: int, tick0: int, samples: Samples) -> None:
        """Take samples of all channels: see `DeviceSession.push_samples`."""
        streams = [each for each in self._streams.values() if isinstance(each, SampleStream) and each.running]
        if not streams or not len(samples):
            return
        rows = rows_of(made(samples, self.channels), self._dtype)
        if any(stream.fills_block(index0, len(rows)) for stream in streams):
            self._flush_edges()
        for stream in streams:
            stream.push(index0, tick0, rows)

    def push_edges(self, records: NDArray[np.void], tick: int) -> None:
        """Take edges: see `DeviceSession.push_edges`."""
        if not len(records):
            return
        data = records.tobytes()
        for stream in self._streams.values():
            if isinstance(stream, EdgeStream) and stream.running:
                stream.push(self.edges, data, tick)
        self.edges += len(records)

    def advance(self, tick: int) -> None:
        """Send what has waited for its stream's max_latency."""
        late = []
        for number, stream in self._streams.items():
            since = stream.waits_since()
            latency_ms = self._configured[number][0].max_latency_ms
            if since is not None and tick - since >= latency_ms * self._identity.tick_hz // 1000:
                late.append(number)
        self.flush(late)

    def flush(self, numbers: Sequence[int]) -> None:
        """Send what waits in these streams, edges first."""
        if numbers:
            self._flush_edges()
        for number in numbers:
            self._streams[number].flush()

    def _flush_edges(self) -> None:
        for stream in self._streams.values():
            if isinstance(stream, EdgeStream):
                stream.flush()

    def _forget(self, number: int) -> None:
        stream = self._streams.pop(number, None)
        if stream is not None:
            self._dropped += stream.dropped
            del self._configured[number]
            self._look_at_channels()
            del self._tx.rates[self._identity.node, number]

    def _look_at_channels(self) -> None:
        ids = (number for request, _ in self._configured.values() for number in request.channels)
        self.channels = frozenset(self._channels[number].name for number in ids)

    def _check(self, request: StreamSet) -> None:
        """Refuse what does not depend on the link: the first of several errors, in the order of SPEC.md."""
        _check_number(request.stream)
        self._check_event(request)
        stream = self._streams.get(request.stream)
        if stream is not None and stream.running:
            raise Refused(f"stream {request.stream} is running", ErrorCode.BUSY, request.stream)

    def _check_event(self, request: StreamSet) -> None:
        if request.event == StreamEvent.EDGES and self._identity.features & Feature.EDGES:
            if request.channels:
                raise Refused("an edge stream has no channels", ErrorCode.BAD_VALUE, len(request.channels))
            return
        means = request.event == StreamEvent.MEAN and self._identity.features & Feature.MEANS
        if request.event != StreamEvent.PWM and not means:
            raise Refused(f"no stream of {request.event.name}", ErrorCode.NOT_SUPPORTED, request.event)
        if not request.decimation:
            raise Refused("decimation 0", ErrorCode.BAD_VALUE, 0)
        check_channels(request.channels, self._channels)

    def _records(self, request: StreamSet) -> Records:
        """Return what makes the records of a stream of samples."""
        kind = Means if request.event == StreamEvent.MEAN else Values
        return kind(self._dtype, [self._channels[number] for number in request.channels], request.decimation)

    def _load(self, request: StreamSet, rate: float) -> float:
        """Return the share of the link that all configured streams need, this one at `rate`; 0 if unknown."""
        if self._tx.capacity is None:
            return 0.0
        here = (self._identity.node, request.stream)
        others = sum(other for key, other in self._tx.rates.items() if key != here)
        return (others + rate) / self._tx.capacity

    def _smallest_decimation(self, request: StreamSet, shape_at: Callable[[int], Shape]) -> int:
        """Return the smallest decimation at which the stream fits beside the others, 0 if none does."""
        if request.event == StreamEvent.EDGES or self._load(request, 0.0) > MAX_LOAD:
            return 0
        slower = range(request.decimation + 1, MAX_DECIMATION + 1)
        first = bisect_left(slower, True, key=lambda n: self._load(request, shape_at(n).rate) <= MAX_LOAD)
        return slower[first] if first < len(slower) else 0


def _check_number(stream: int) -> None:
    if stream >= MAX_STREAMS:
        raise Refused(f"stream {stream}", ErrorCode.OUT_OF_RANGE, MAX_STREAMS - 1)
