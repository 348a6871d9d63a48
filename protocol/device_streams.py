"""The device's streams: channels chosen, decimated, packed into blocks, and sent as DATA and EDGES frames.

Every edge goes out before the DATA frame whose last sample is at or after it. `seq` counts every frame that
a stream produced, the ones that the transmit queue had no room for included. This module never blocks and
never waits.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from zlib import crc32

import numpy as np
from cobs import cobs
from numpy.typing import NDArray

from protocol.descriptor import sample_dtype
from protocol.device_app import Identity
from protocol.device_tx import TxQueue
from protocol.errors import Refused
from protocol.framing import MAJOR, encoded_length
from protocol.messages import ErrorCode, Feature, MessageType, StreamEvent, StreamReply, StreamSet
from protocol.signals import Signal
from protocol.streams import DISCONTINUITY, EDGE_RECORD, OVERRUN, STREAM_HEADER

MAX_STREAMS = 4
MAX_LOAD = 0.95

_FULL_HEADER = struct.Struct("<BBHHBBBBHHHII")  # frame header and stream header


class _Stream:
    """Common to both kinds: frames with seq, overrun flag and account of drops."""

    TYPE: MessageType

    def __init__(self, node: int, stream: int, cfg_id: int, record_bytes: int, block: int, tx: TxQueue) -> None:
        self.running = False
        self.dropped = 0
        self.block = block
        self._node = node
        self._stream = stream
        self._cfg_id = cfg_id
        self._record_bytes = record_bytes
        self._tx = tx
        self._seq = 0
        self._flags = 0
        self._pending = b""

    def _emit(self, data: bytes, first: int, n: int, block: int, start: tuple[int, int], step: tuple[int, int]) -> None:
        """Send n records of `data` from record `first`, `block` to a frame.

        `start` and `step` are index and tick of the record `first`, and their increments from record to
        record.
        """
        size = self._record_bytes
        index, tick = start
        pack, encode, put = _FULL_HEADER.pack, cobs.encode, self._tx.put_bulk
        for k in range(first, first + n, block):
            count = min(block, first + n - k)
            body = (
                pack(
                    self.TYPE, MAJOR, 0, STREAM_HEADER.size + count * size, self._node, 0, self._stream,
                    self._flags, count, self._cfg_id, self._seq, index & 0xFFFFFFFF, tick & 0xFFFFFFFF,
                )
                + data[k * size : (k + count) * size]
            )  # fmt: skip
            if put(b"\0" + encode(body + crc32(body).to_bytes(4, "little")) + b"\0"):
                self._flags = 0
            else:
                self.dropped += 1
                self._flags |= OVERRUN
            self._seq = (self._seq + 1) & 0xFFFF
            index += step[0] * count
            tick += step[1] * count


class _SampleStream(_Stream):
    TYPE = MessageType.DATA

    def __init__(
        self, node: int, stream: int, cfg_id: int, runs: list[tuple[int, int, int]], request: StreamSet,
        block: int, ticks_per_period: int, tx: TxQueue,
    ) -> None:  # fmt: skip
        self._runs = runs
        self._decimation = request.decimation
        self._step = (request.decimation, request.decimation * ticks_per_period)
        self._first = (0, 0)  # index and tick of the first pending sample
        self._next: int | None = None
        super().__init__(node, stream, cfg_id, sum(width for _, _, width in runs), block, tx)

    def _selected(self, index0: int, n: int) -> tuple[int, int]:
        """Return where the first sample of this stream lies among n periods, and how many there are."""
        offset = -index0 % self._decimation
        return offset, max(0, -((offset - n) // self._decimation))

    def fills_block(self, index0: int, n: int) -> bool:
        """Return whether n more periods complete a frame, or break the row of indices."""
        offset, count = self._selected(index0, n)
        waiting = len(self._pending) // self._record_bytes
        broken = waiting > 0 and count > 0 and index0 + offset != self._next
        return waiting + count >= self.block or broken

    def push(self, index0: int, tick0: int, rows: NDArray[np.uint8]) -> None:
        """Take n periods: rows[n, bytes of a full sample]."""
        offset, count = self._selected(index0, len(rows))
        if not count:
            return
        first = index0 + offset
        if self._next is not None and first != self._next:
            self.flush()
            self._flags |= DISCONTINUITY
        self._next = first + count * self._step[0]
        chosen = rows[offset :: self._decimation]
        packed = np.empty((count, self._record_bytes), np.uint8)
        for to, start, width in self._runs:
            packed[:, to : to + width] = chosen[:, start : start + width]
        if not self._pending:
            self._first = (first, tick0 + offset * (self._step[1] // self._step[0]))
        data = self._pending + packed.tobytes()
        waiting = len(data) // self._record_bytes
        whole = waiting - waiting % self.block
        self._emit(data, 0, whole, self.block, self._first, self._step)
        self._pending = data[whole * self._record_bytes :]
        self._first = (self._first[0] + whole * self._step[0], self._first[1] + whole * self._step[1])

    def flush(self) -> None:
        """Send a partial block."""
        n = len(self._pending) // self._record_bytes
        if n:
            self._emit(self._pending, 0, n, n, self._first, self._step)
            self._pending = b""

    def waits_since(self) -> int | None:
        """Return the tick of the oldest sample that waits."""
        return self._first[1] if self._pending else None


class _EdgeStream(_Stream):
    TYPE = MessageType.EDGES

    def __init__(self, node: int, stream: int, cfg_id: int, block: int, tx: TxQueue) -> None:
        self._index = 0
        self._since = 0
        super().__init__(node, stream, cfg_id, EDGE_RECORD.itemsize, block, tx)

    def push(self, index0: int, data: bytes, tick: int) -> None:
        """Take edges; `tick` is now."""
        if not self._pending:
            self._index = index0
            self._since = tick
        self._pending += data

    def flush(self) -> None:
        """Send all edges that wait."""
        size = self._record_bytes
        n = len(self._pending) // size
        for k in range(0, n, self.block):
            count = min(self.block, n - k)
            tick = int.from_bytes(self._pending[k * size : k * size + 4], "little")
            self._emit(self._pending, k, count, count, (self._index + k, tick), (1, 0))
        self._pending = b""

    def waits_since(self) -> int | None:
        """Return the tick at which the oldest edge that waits was pushed."""
        return self._since if self._pending else None


class StreamTable:
    """The streams of one device: a stream is free, configured or running."""

    def __init__(self, identity: Identity, channels: Sequence[Signal], tx: TxQueue) -> None:
        self._identity = identity
        self._channels = {channel.id: channel for channel in channels}
        self._dtype = sample_dtype(channels)
        self._tx = tx
        self._ticks_per_period = identity.tick_hz // identity.pwm_hz
        self._streams: dict[int, _SampleStream | _EdgeStream] = {}
        self._latency: dict[int, int] = {}
        self._cfg_id = identity.boot_id & 0xFFFF
        self._dropped = 0
        self._edges = 0

    @property
    def dropped(self) -> int:
        """Stream frames that found no room since boot."""
        return self._dropped + sum(stream.dropped for stream in self._streams.values())

    @property
    def running(self) -> frozenset[int]:
        """Numbers of the running streams."""
        return frozenset(number for number, stream in self._streams.items() if stream.running)

    def configure(self, request: StreamSet, tx_max: int) -> StreamReply:
        """Carry out STREAM_SET; Refused, nothing changed, if it cannot be done."""
        self._check(request)
        edges = request.event == StreamEvent.EDGES
        runs = [] if edges else self._runs(request.channels)
        size = EDGE_RECORD.itemsize if edges else sum(width for _, _, width in runs)
        room = tx_max - STREAM_HEADER.size
        if size > room:
            raise Refused(f"a sample of {size} bytes", ErrorCode.DOES_NOT_FIT, room)
        block = room // size if edges else self._block(request, size, room, request.decimation)
        rate = self._rate(request, size, room, request.decimation)
        load = self._load(request, rate)
        if load > MAX_LOAD:
            fits = self._smallest_decimation(request, size, room)
            raise Refused(f"the link would be loaded to {load:.0%}", ErrorCode.DOES_NOT_FIT, fits)
        self._forget(request.stream)
        self._cfg_id = self._cfg_id % 0xFFFF + 1
        node = self._identity.node
        args = (node, request.stream, self._cfg_id)
        stream: _SampleStream | _EdgeStream
        if edges:
            stream = _EdgeStream(*args, block, self._tx)
        else:
            stream = _SampleStream(*args, runs, request, block, self._ticks_per_period, self._tx)
        self._streams[request.stream] = stream
        self._latency[request.stream] = request.max_latency_ms * self._identity.tick_hz // 1000
        self._tx.rates[node, request.stream] = rate
        return StreamReply(request.stream, self._cfg_id, size, block, load)

    def start(self, mask: int) -> None:
        """Carry out STREAM_START; Refused, nothing started, if a stream is not configured."""
        for number in _bits(mask):
            if number not in self._streams:
                raise Refused(f"stream {number} is not configured", ErrorCode.UNKNOWN_ID, number)
        for number in _bits(mask):
            self._streams[number].running = True

    def stop(self, mask: int) -> None:
        """Carry out STREAM_STOP: what waits is sent, the configuration is forgotten."""
        chosen = [number for number in self._streams if mask >> number & 1]
        self.flush(chosen)
        for number in chosen:
            self._forget(number)

    def push_samples(self, index0: int, tick0: int, raw: NDArray[np.void]) -> None:
        """Take samples of all channels: see `DeviceSession.push_samples`."""
        streams = [s for s in self._streams.values() if s.running and isinstance(s, _SampleStream)]
        if not streams or not len(raw):
            return
        if raw.dtype != self._dtype:
            raise TypeError(f"samples of {raw.dtype}, the channels make {self._dtype}")
        rows = np.ascontiguousarray(raw).view(np.uint8).reshape(len(raw), -1)
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
            if stream.running and isinstance(stream, _EdgeStream):
                stream.push(self._edges, data, tick)
        self._edges += len(records)

    def advance(self, tick: int) -> None:
        """Send what has waited for its stream's max_latency."""
        late = []
        for number, stream in self._streams.items():
            since = stream.waits_since()
            if since is not None and tick - since >= self._latency[number]:
                late.append(number)
        if late:
            self.flush(late)

    def flush(self, numbers: Sequence[int]) -> None:
        """Send what waits in these streams, edges first."""
        samples = [s for s in map(self._streams.__getitem__, numbers) if isinstance(s, _SampleStream)]
        if samples or any(isinstance(self._streams[number], _EdgeStream) for number in numbers):
            self._flush_edges()
        for stream in samples:
            stream.flush()

    def _flush_edges(self) -> None:
        for stream in self._streams.values():
            if isinstance(stream, _EdgeStream):
                stream.flush()

    def _forget(self, number: int) -> None:
        stream = self._streams.pop(number, None)
        if stream is not None:
            self._dropped += stream.dropped
            del self._tx.rates[self._identity.node, number]

    def _check(self, request: StreamSet) -> None:
        if request.stream >= MAX_STREAMS:
            raise Refused(f"stream {request.stream}", ErrorCode.OUT_OF_RANGE, MAX_STREAMS - 1)
        stream = self._streams.get(request.stream)
        if stream is not None and stream.running:
            raise Refused(f"stream {request.stream} is running", ErrorCode.BUSY, request.stream)
        if request.event == StreamEvent.EDGES:
            if not self._identity.features & Feature.EDGES:
                raise Refused("no edges", ErrorCode.NOT_SUPPORTED, request.event)
            if request.channels:
                raise Refused("an edge stream has no channels", ErrorCode.BAD_VALUE, len(request.channels))
            return
        if request.event != StreamEvent.PWM:
            raise Refused(f"event {request.event}", ErrorCode.NOT_SUPPORTED, request.event)
        if not request.decimation:
            raise Refused("decimation 0", ErrorCode.BAD_VALUE, 0)
        if not request.channels:
            raise Refused("no channels", ErrorCode.BAD_VALUE, 0)
        for position, number in enumerate(request.channels):
            if number not in self._channels:
                raise Refused(f"no channel {number}", ErrorCode.UNKNOWN_ID, number)
            if number in request.channels[:position]:
                raise Refused(f"channel {number} comes twice", ErrorCode.BAD_VALUE, number)

    def _runs(self, ids: Sequence[int]) -> list[tuple[int, int, int]]:
        """Return (position in the packed sample, position in the full sample, bytes), neighbours joined."""
        runs: list[tuple[int, int, int]] = []
        to = 0
        for number in ids:
            dtype, start = self._dtype.fields[self._channels[number].name][:2]  # type: ignore[index]
            if runs and runs[-1][1] + runs[-1][2] == start:
                runs[-1] = (runs[-1][0], runs[-1][1], runs[-1][2] + dtype.itemsize)
            else:
                runs.append((to, start, dtype.itemsize))
            to += dtype.itemsize
        return runs

    def _block(self, request: StreamSet, size: int, room: int, decimation: int) -> int:
        in_time = request.max_latency_ms * self._identity.pwm_hz // (1000 * decimation)
        return max(1, min(room // size, in_time))

    def _rate(self, request: StreamSet, size: int, room: int, decimation: int) -> float:
        """Return the bytes/s of the stream; edges count as one full header every max_latency."""
        if request.event == StreamEvent.EDGES:
            return encoded_length(STREAM_HEADER.size + size) * 1000 / max(1, request.max_latency_ms)
        block = self._block(request, size, room, decimation)
        frame = encoded_length(STREAM_HEADER.size + block * size)
        return frame * self._identity.pwm_hz / (decimation * block)

    def _load(self, request: StreamSet, rate: float) -> float:
        """Return the share of the link that all configured streams need, this one at `rate`; 0 if unknown."""
        if self._tx.capacity is None:
            return 0.0
        here = (self._identity.node, request.stream)
        others = sum(other for key, other in self._tx.rates.items() if key != here)
        return (others + rate) / self._tx.capacity

    def _smallest_decimation(self, request: StreamSet, size: int, room: int) -> int:
        """Return the smallest decimation at which the stream fits beside the others, 0 if none does."""
        if request.event == StreamEvent.EDGES or self._load(request, 0.0) > MAX_LOAD:
            return 0
        for decimation in range(request.decimation + 1, 0x10000):
            if self._load(request, self._rate(request, size, room, decimation)) <= MAX_LOAD:
                return decimation
        return 0


def _bits(mask: int) -> list[int]:
    return [number for number in range(32) if mask >> number & 1]
