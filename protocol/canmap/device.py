"""The device's end of a CAN bus: one node, its carrier and its receiver. No I/O.

Frames to be sent wait in the node's own `TxQueue`, one CAN_RECORD each; the controller takes them from there. This
module never looks into a message and never controls a motor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from protocol.canmap.frame import BRS, CAN_RECORD, ERROR, FDF, RECORD_BYTES, BusRates
from protocol.canmap.ids import (
    BROADCAST,
    MAX_NODE,
    SLOTS,
    STATUS_SLOTS,
    STREAM_SLOTS,
    CanClass,
    CanId,
    parse_id,
    stream_id,
)
from protocol.canmap.layout import MAX_GROUPS, StreamLayout, edge_load, sample_layout
from protocol.canmap.transport import CanCounters, Reassembler, TransferEncoder, pack_record
from protocol.device.carrier import EdgeStream, SampleStream, Shape, Stream, in_time
from protocol.device.records import Records, Rows
from protocol.device.session import DeviceApp, DeviceSession, Identity
from protocol.device.tx import TxQueue
from protocol.errors import Refused
from protocol.framing import Frame
from protocol.messages import ErrorCode, MessageType, StreamSet
from protocol.streams import EDGE_RECORD

MAX_AGE = 0.5  # s that a stream frame may wait
_HOST_STATUS = (STATUS_SLOTS[MessageType.ALIVE], STATUS_SLOTS[MessageType.SETPOINT])


class _CanStream(Stream):
    """Common to both kinds: frames go out at once, and nothing less than a frame waits."""

    def _put(self, wire: bytes) -> None:
        """Queue CAN_RECORDs, each on its own."""
        ends = range(RECORD_BYTES, len(wire) + 1, RECORD_BYTES)
        self.dropped += len(ends) - self._tx.put_bulk(wire, ends)


class _Samples(_CanStream, SampleStream):
    """A stream of samples: whole frames only."""

    def __init__(self, slot: int, ids: list[int], layout: StreamLayout, records: Records, decimation: int, tx: TxQueue):
        super().__init__(tx, slot)
        self._ids = ids
        self._layout = layout
        self._records = records
        self._decimation = decimation
        self._pending = np.empty((0, layout.groups[-1][1]), np.uint8)
        self._next: int | None = None  # index of the sample after the pending ones

    def push(self, index0: int, tick0: int, rows: Rows) -> None:
        """See `SampleStream`."""
        first, samples = self._records.take(index0, rows)
        if not len(samples):
            return
        if first == self._next:
            first -= len(self._pending) * self._decimation
            samples = np.concatenate([self._pending, samples])
        self._next = first + len(samples) * self._decimation
        frames = len(samples) // self._layout.samples
        whole = frames * self._layout.samples
        if frames:
            self._send(first, samples[:whole].reshape(frames, -1))
        self._pending = samples[whole:]

    def _send(self, first: int, shares: NDArray[np.uint8]) -> None:
        """Send frames with the samples of `shares`, a row each, the first of which is the PWM period `first`."""
        layout = self._layout
        index = first + np.arange(len(shares)) * layout.samples * self._decimation
        count = index & 0xFFFFFFFF if layout.fd else index // self._decimation & 0xFFFF
        counter = count.astype("<u4" if layout.fd else "<u2").view(np.uint8).reshape(len(shares), -1)
        records = np.zeros((len(shares), len(layout.groups)), CAN_RECORD)
        if layout.fd:
            records["flags"] = FDF | BRS
        for group, (start, end) in enumerate(layout.groups):
            column = records[:, group]
            column["id"] = self._ids[group]
            column["length"] = layout.length(group)
            column["data"][:, : layout.counter] = counter
            column["data"][:, layout.counter : layout.used(group)] = (
                shares if len(layout.groups) == 1 else shares[:, start:end]
            )
        self._put(records.tobytes())


class _Edges(_CanStream, EdgeStream):
    """A stream of edges: a frame each."""

    def __init__(self, slot: int, can_id: int, fd: bool, tx: TxQueue) -> None:
        super().__init__(tx, slot)
        self._id = can_id
        self._fd = fd

    def push(self, index0: int, data: bytes, tick: int) -> None:
        """See `EdgeStream`."""
        records = np.frombuffer(data, EDGE_RECORD).copy()
        records["flags"] = index0 + np.arange(len(records)) & 0xFF
        self._put(b"".join(pack_record(self._id, record.tobytes(), self._fd) for record in records))


class _Slots:
    """Slots of one kind of stream, handed out in a circle."""

    def __init__(self, size: int, first: int) -> None:
        self._size = size
        self._next = first % size
        self._taken: dict[int, list[int]] = {}

    def take(self, stream: int, n: int) -> list[int]:
        """Return n slots in a row for a stream that no stream has; if need be those that it has itself."""
        for used in (self._taken, {other: slots for other, slots in self._taken.items() if other != stream}):
            busy = {slot for slots in used.values() for slot in slots}
            for start in range(self._size):
                slots = [(self._next + start + k) % self._size for k in range(n)]
                if not busy.intersection(slots):
                    self._next = (slots[-1] + 1) % self._size
                    self._taken[stream] = slots
                    return slots
        raise Refused(f"{n} slots", ErrorCode.DOES_NOT_FIT, 0)

    def free(self, stream: int) -> None:
        """The stream is no more."""
        self._taken.pop(stream, None)


class CanCarrier:
    """CAN frames (a `protocol.device.carrier.Carrier`). Rates are shares of the bus: the queue's `capacity` is 1.

    `boot_id` decides which slots come first, so that they differ from those before a reboot.
    """

    def __init__(self, tx: TxQueue, rates: BusRates, extended: bool, boot_id: int = 0) -> None:
        self.tx = tx
        self._rates = rates
        self._extended = extended
        self._encoder = TransferEncoder(rates.fd, extended)
        self.host = 0
        """Number of the host whose request is being answered."""
        self._sample_slots = _Slots(STREAM_SLOTS, boot_id)
        self._edge_slots = _Slots(SLOTS, boot_id)

    def encode(self, frame: Frame) -> bytes:
        """See `Carrier.encode`."""
        if frame.is_reply:
            can_id = CanId(CanClass.TO_HOST, frame.node, self.host)
        else:
            can_id = CanId(CanClass.STATUS, frame.node, STATUS_SLOTS[frame.type])
        return self._encoder.encode(can_id, frame.pack())

    def shape(self, request: StreamSet, widths: Sequence[int], tx_max: int, pwm_hz: int, decimation: int) -> Shape:
        """See `Carrier.shape`; the rate is the largest share of the bus that the frames may take."""
        if not widths:
            return Shape(1, edge_load(self._rates, self._extended))
        layout = sample_layout(widths, self._rates.fd, in_time(request, pwm_hz, decimation))
        if len(layout.groups) > MAX_GROUPS:
            raise Refused(f"a sample of {sum(widths)} bytes", ErrorCode.DOES_NOT_FIT, layout.groups[MAX_GROUPS][0])
        return Shape(layout.samples, layout.load(self._rates, pwm_hz / decimation, self._extended))

    def samples(
        self, node: int, request: StreamSet, cfg_id: int, records: Records, block: int, ticks: int
    ) -> SampleStream:
        """See `Carrier.samples`. Each configuration has slots of its own, after those of the one before."""
        layout = sample_layout(records.widths, self._rates.fd, block)
        self._edge_slots.free(request.stream)
        slots = self._sample_slots.take(request.stream, len(layout.groups))
        ids = [stream_id(node, slot).pack(self._extended) for slot in slots]
        return _Samples(slots[0], ids, layout, records, request.decimation, self.tx)

    def edges(self, node: int, request: StreamSet, cfg_id: int, block: int) -> EdgeStream:
        """See `Carrier.edges`."""
        self._sample_slots.free(request.stream)
        (slot,) = self._edge_slots.take(request.stream, 1)
        return _Edges(slot, CanId(CanClass.EDGES, node, slot).pack(self._extended), self._rates.fd, self.tx)

    def close(self, stream: int) -> None:
        """See `Carrier.close`: its slots are free."""
        self._sample_slots.free(stream)
        self._edge_slots.free(stream)


class CanDevice:
    """One node on a CAN bus.

    Args:
        app: what it controls.
        identity: its `node` is 1..15.
        rates: of the bus; they decide the frame format.
        extended: 29-bit identifiers.
        tx: the frames that wait; its `capacity` is set to 1.
    """

    def __init__(
        self, app: DeviceApp, identity: Identity, rates: BusRates, extended: bool = False, tx: TxQueue | None = None
    ) -> None:
        if not 1 <= identity.node <= MAX_NODE:
            raise ValueError(f"node {identity.node} is not in 1..{MAX_NODE}")
        self.tx = TxQueue() if tx is None else tx
        self.tx.capacity = 1.0
        self.counters = CanCounters()
        self._carrier = CanCarrier(self.tx, rates, extended, identity.boot_id)
        self.session = DeviceSession(app, identity, self._carrier, self.counters)
        self._node = identity.node
        self._extended = extended
        self._reassemblers: dict[CanId, Reassembler] = {}

    def receive(self, frames: bytes) -> None:
        """Take CAN_RECORDs from the bus, those of others too."""
        for record in np.frombuffer(frames, CAN_RECORD):
            self._receive(int(record["id"]), record["data"][: record["length"]].tobytes())

    def advance(self, tick: int) -> None:
        """Let time pass up to the device's 64-bit `tick`; stream frames that have waited too long are given up."""
        self.session.advance(tick)
        self.session.streams.expired += self.tx.expire(tick, round(MAX_AGE * self.session.identity.tick_hz))

    def take(self) -> bytes:
        """Return and forget the next CAN_RECORD that is to be sent, nothing if there is none."""
        return self.tx.take(RECORD_BYTES)

    def gave_up(self) -> None:
        """A stream frame was taken back from the controller's mailbox."""
        self.session.streams.expired += 1

    def _receive(self, can_id: int, data: bytes) -> None:
        if can_id & ERROR:
            self.counters.error_frames += 1
            return
        parts = parse_id(can_id, self._extended)
        if parts is None or not self._is_mine(parts):
            self.counters.foreign += 1
            return
        self.counters.frames += 1
        if parts.kind == CanClass.STOP:
            self.session.stop()
            return
        if parts not in self._reassemblers:
            self._reassemblers[parts] = Reassembler(parts.node, self.counters)
        message = self._reassemblers[parts].feed(data)
        if message is None:
            return
        if self._belongs(parts, message[0]):
            host = parts.slot if parts.kind == CanClass.TO_DEVICE else 0
            self._carrier.host = host
            self.session.receive(message, host)
        else:
            self.counters.foreign += 1

    def _is_mine(self, parts: CanId) -> bool:
        if parts.kind == CanClass.STATUS:
            return parts.node == self._node and parts.slot in _HOST_STATUS
        return parts.kind in (CanClass.STOP, CanClass.TO_DEVICE) and parts.node in (self._node, BROADCAST)

    def _belongs(self, parts: CanId, kind: int) -> bool:
        """Whether a message of this type may come on this identifier."""
        if parts.kind == CanClass.STATUS:
            return STATUS_SLOTS.get(kind) == parts.slot
        return kind not in STATUS_SLOTS and (parts.node == self._node or kind == MessageType.HELLO)
