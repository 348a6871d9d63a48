"""How a device's messages and stream frames look on a link: `Carrier`, and the one of byte links.

On a byte link a stream's records are packed into blocks and sent as DATA and EDGES frames. `seq` counts every frame
that a stream produced, the ones that the transmit queue had no room for included. This module never decides what is
streamed: that is `protocol.device.streams`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from protocol.device.records import Records, Rows
from protocol.device.tx import TxQueue
from protocol.errors import Refused
from protocol.framing import HEADER_BYTES, MAJOR, Frame, compiled, encode_frame, encoded_length
from protocol.messages import ErrorCode, MessageType, StreamSet
from protocol.streams import DISCONTINUITY, EDGE_RECORD, OVERRUN, STREAM_HEADER

TOGETHER = 64  # frames that are encoded at once
_HEAD = np.dtype(  # frame header and stream header
    {
        "names": ["type", "major", "length", "node", "stream", "flags", "n", "cfg_id", "seq", "index", "tick"],
        "formats": ["u1", "u1", "<u2", "u1", "u1", "u1", "<u2", "<u2", "<u2", "<u4", "<u4"],
        "offsets": [0, 1, 4, 6, 8, 9, 10, 12, 14, 16, 20],
        "itemsize": HEADER_BYTES + STREAM_HEADER.size,
    }
)
_COUNT = np.arange(TOGETHER)


class Stream:
    """A configured stream. `dropped` counts frames that found no room, `slot` is the first one on CAN."""

    def __init__(self, tx: TxQueue, slot: int = 0) -> None:
        self.running = False
        self.dropped = 0
        self.slot = slot
        self._tx = tx

    def flush(self) -> None:
        """Send what waits; of samples only if a frame may hold less than a block."""

    def waits_since(self) -> int | None:
        """Return the tick of the oldest sample that waits, or at which the oldest edge that waits was pushed.

        None if there is none that `flush` would send.
        """
        return None


class SampleStream(Stream, ABC):
    """A stream of samples."""

    def fills_block(self, index0: int, n: int) -> bool:
        """Return whether n more periods complete a frame, or break the row of indices, while edges may wait."""
        return False

    @abstractmethod
    def push(self, index0: int, tick0: int, rows: Rows) -> None:
        """Take n periods."""


class EdgeStream(Stream, ABC):
    """A stream of edges."""

    @abstractmethod
    def push(self, index0: int, data: bytes, tick: int) -> None:
        """Take edges (EDGE_RECORDs) from number `index0` on; `tick` is now."""


class Shape(NamedTuple):
    """What a stream comes to: records in a frame, and its rate in the units of the queue's `capacity`."""

    block: int
    rate: float


class Carrier(Protocol):
    """One device's way onto its link."""

    tx: TxQueue

    def encode(self, frame: Frame) -> bytes:
        """Return a message as the bytes of the link."""

    def shape(self, request: StreamSet, widths: Sequence[int], tx_max: int, pwm_hz: int, decimation: int) -> Shape:
        """Return what the stream of `request` comes to at `decimation`; `widths`: bytes of each channel.

        Raises Refused if a sample is too long.
        """

    def samples(
        self, node: int, request: StreamSet, cfg_id: int, records: Records, block: int, ticks: int
    ) -> SampleStream:
        """Return a stream of samples; `ticks` are those of a PWM period. Raises Refused if there is no place for it."""

    def edges(self, node: int, request: StreamSet, cfg_id: int, block: int) -> EdgeStream:
        """Return a stream of edges."""

    def close(self, stream: int) -> None:
        """Stream number `stream` is no more."""


class _ByteStream(Stream):
    """Common to both kinds: frames with seq, overrun flag and account of drops."""

    TYPE: MessageType

    def __init__(self, node: int, stream: int, cfg_id: int, record_bytes: int, block: int, tx: TxQueue) -> None:
        super().__init__(tx)
        self.block = block
        self._record_bytes = record_bytes
        self._seq = 0
        self._flags = 0
        self._pending = b""
        self._heads = np.zeros(TOGETHER, _HEAD)
        self._heads["type"], self._heads["major"], self._heads["node"] = self.TYPE, MAJOR, node
        self._heads["stream"], self._heads["cfg_id"] = stream, cfg_id

    def _emit(self, data: bytes, first: int, n: int, block: int, start: tuple[int, int], step: tuple[int, int]) -> None:
        """Send n records of `data` from record `first`, `block` to a frame.

        `start` and `step` are index and tick of the record `first`, and their increments from record to
        record.
        """
        size, end, together = self._record_bytes, first + n, TOGETHER
        index, tick = start
        while first < end:
            count = min(-(-(end - first) // block), together)
            stop = min(first + count * block, end)
            heads, k = self._heads[:count], _COUNT[:count]
            heads["n"], heads["length"] = block, STREAM_HEADER.size + block * size
            if first + count * block > stop:
                heads["n"][-1] = last = stop - first - (count - 1) * block
                heads["length"][-1] = STREAM_HEADER.size + last * size
            heads["flags"][0] = self._flags
            heads["seq"] = self._seq + k
            heads["index"] = index + step[0] * block * k
            heads["tick"] = (tick & 0xFFFFFFFF) + step[1] * block * k
            wire, ends = compiled().encode(heads.tobytes(), count, data, first * size, stop * size, block * size)
            sent = self._tx.put_bulk(wire, ends)
            if sent:
                self._flags = heads["flags"][0] = 0
            if sent < count:  # the next frame tells
                self._flags |= OVERRUN
                self.dropped += 1
                sent += 1
                together = 1
            self._seq = (self._seq + sent) & 0xFFFF
            index += step[0] * block * sent
            tick += step[1] * block * sent
            first += block * sent


class _ByteSamples(_ByteStream, SampleStream):
    TYPE = MessageType.DATA

    def __init__(
        self, node: int, request: StreamSet, cfg_id: int, records: Records,
        block: int, ticks_per_period: int, tx: TxQueue,
    ) -> None:  # fmt: skip
        self._records = records
        self._decimation = request.decimation
        self._step = (request.decimation, request.decimation * ticks_per_period)
        self._first = (0, 0)  # index and tick of the first pending sample
        self._next: int | None = None
        super().__init__(node, request.stream, cfg_id, sum(records.widths), block, tx)

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

    def push(self, index0: int, tick0: int, rows: Rows) -> None:
        """Take n periods."""
        first, records = self._records.take(index0, rows)
        if not len(records):
            return
        if self._next is not None and first != self._next:
            self.flush()
            self._flags |= DISCONTINUITY
        self._next = first + len(records) * self._step[0]
        if not self._pending:
            self._first = (first, tick0 + (first - index0) * (self._step[1] // self._step[0]))
        data = self._pending + records.tobytes()
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


class _ByteEdges(_ByteStream, EdgeStream):
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


class ByteCarrier:
    """COBS frames: serial ports, TCP."""

    def __init__(self, tx: TxQueue) -> None:
        self.tx = tx

    def encode(self, frame: Frame) -> bytes:
        """See `Carrier.encode`."""
        return encode_frame(frame)

    def shape(self, request: StreamSet, widths: Sequence[int], tx_max: int, pwm_hz: int, decimation: int) -> Shape:
        """See `Carrier.shape`; the rate is in bytes/s, and edges count as one full header every max_latency."""
        edges = not widths
        size = EDGE_RECORD.itemsize if edges else sum(widths)
        room = tx_max - STREAM_HEADER.size
        if size > room:
            raise Refused(f"a sample of {size} bytes", ErrorCode.DOES_NOT_FIT, room)
        if edges:
            rate = encoded_length(STREAM_HEADER.size + size) * 1000 / max(1, request.max_latency_ms)
            return Shape(room // size, rate)
        block = max(1, min(room // size, in_time(request, pwm_hz, decimation)))
        frame = encoded_length(STREAM_HEADER.size + block * size)
        return Shape(block, frame * pwm_hz / (decimation * block))

    def samples(
        self, node: int, request: StreamSet, cfg_id: int, records: Records, block: int, ticks: int
    ) -> SampleStream:
        """See `Carrier.samples`."""
        return _ByteSamples(node, request, cfg_id, records, block, ticks, self.tx)

    def edges(self, node: int, request: StreamSet, cfg_id: int, block: int) -> EdgeStream:
        """See `Carrier.edges`."""
        return _ByteEdges(node, request.stream, cfg_id, block, self.tx)

    def close(self, stream: int) -> None:
        """See `Carrier.close`."""


def in_time(request: StreamSet, pwm_hz: int, decimation: int) -> int:
    """Return how many samples a stream takes in its max_latency."""
    return request.max_latency_ms * pwm_hz // (1000 * decimation)
