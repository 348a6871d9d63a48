"""The languages of byte links and of CAN, for frames of any kind, valid and damaged."""

from __future__ import annotations

from dataclasses import dataclass

from protocol.canmap.frame import RECORD, RECORD_BYTES, REMOTE, BusRates
from protocol.canmap.host import CanWire, stop_record
from protocol.canmap.ids import BROADCAST, STATUS_SLOTS, CanClass, CanId, parse_id
from protocol.canmap.transport import CanCounters, Reassembler, TransferEncoder, pack_record
from protocol.codes import MessageType
from protocol.framing import CONNECT_PREAMBLE, HEADER_BYTES, Deframer, Frame, encode_frame, parse_frame, wrapped
from protocol.links import Link

DEVICE_STATUS = {STATUS_SLOTS[kind] for kind in (MessageType.HEARTBEAT, MessageType.EVENT, MessageType.LOG)}


@dataclass(frozen=True)
class Heard:
    """A message as it came, at `at` s of the link's clock; `transfer` is its transfer id on CAN.

    `reserved`: the last byte of its header, which CAN does not carry; `slot`: of its identifier on CAN.
    """

    at: float
    frame: Frame
    transfer: int = 0
    reserved: int = 0
    slot: int = 0


@dataclass(frozen=True)
class BusFrame:
    """A stream frame of this device on CAN: its slot in 0..15 of the edges, or 0..31 of the samples, and its data."""

    at: float
    edges: bool
    slot: int
    data: bytes


class ByteLine:
    """Serial ports and TCP."""

    bus = False

    def __init__(self) -> None:
        self._deframer = Deframer()
        self.came = bytearray()
        """The bytes that came since `preamble`."""

    def encode(self, frame: Frame, reserved: int = 0) -> bytes:
        """What is written for a frame, whose reserved byte is this."""
        return encode_frame(frame) if not reserved else wrapped(frame.pack()[:7] + bytes([reserved]) + frame.payload)

    def preamble(self) -> bytes:
        """What is written before HELLO."""
        self.came.clear()
        return CONNECT_PREAMBLE

    def feed(self, data: bytes, at: float) -> list[Heard | BusFrame]:
        """What these bytes complete."""
        self.came += data
        return [Heard(at, parse_frame(raw), reserved=raw[HEADER_BYTES - 1]) for raw in self._deframer.feed(data)]

    @property
    def damaged(self) -> int:
        """Damaged messages that came."""
        return self._deframer.counters.bad


class BusLine:
    """HBP on CAN, as host number `host` on a bus of these `rates`; node 0 of a frame means the device `node`."""

    bus = True

    def __init__(self, rates: BusRates, node: int, extended: bool, host: int) -> None:
        self.rates = rates
        self.extended = extended
        self.node = node
        self.host = host
        self._encoder = TransferEncoder(rates.fd, extended)
        self._counters = CanCounters()
        self._reassemblers: dict[CanId, Reassembler] = {}
        self.records: list[tuple[int, CanId, bytes]] = []
        """The frames of HBP that came since it was emptied, with their flags."""

    @property
    def damaged(self) -> int:
        """See `ByteLine`."""
        return self._counters.bad

    def preamble(self) -> bytes:
        """See `ByteLine`."""
        self.records.clear()
        return b""

    def encode(self, frame: Frame, reserved: int = 0) -> bytes:
        """See `ByteLine`; a transfer has no byte that is reserved."""
        node = frame.node or self.node
        return self.transfer(self.address(frame), frame._replace(node=node))

    def address(self, frame: Frame) -> CanId:
        """The identifier on which a message of this type goes to a device."""
        node = frame.node or self.node
        slot = STATUS_SLOTS.get(frame.type)
        return CanId(CanClass.TO_DEVICE, node, self.host) if slot is None else CanId(CanClass.STATUS, node, slot)

    def transfer(self, can_id: CanId, frame: Frame) -> bytes:
        """The records of a message on this identifier."""
        return self._encoder.encode(can_id, frame._replace(node=can_id.node).pack())

    def broadcast(self, frame: Frame) -> bytes:
        """The records of a message to node 0."""
        return self.transfer(CanId(CanClass.TO_DEVICE, BROADCAST, self.host), frame)

    def stop(self, node: int) -> bytes:
        """A frame of class 0."""
        return stop_record(node, self.extended, self.rates.fd)

    def record(self, can_id: CanId, data: bytes, fd: bool | None = None) -> bytes:
        """One frame, of the kind of the bus where `fd` is None."""
        return pack_record(can_id.pack(self.extended), data, self.rates.fd if fd is None else fd)

    def feed(self, data: bytes, at: float) -> list[Heard | BusFrame]:
        """See `ByteLine`."""
        found: list[Heard | BusFrame] = []
        for number, length, flags, _, _, room in RECORD.iter_unpack(data):
            parts = parse_id(number, self.extended)
            if parts is None:
                continue
            part = room[:length]
            self.records.append((flags, parts, part))
            if parts.kind in (CanClass.EDGES, CanClass.SAMPLES, CanClass.SAMPLES_2):
                slot = parts.slot + (16 if parts.kind == CanClass.SAMPLES_2 else 0)
                if parts.node == self.node:
                    found.append(BusFrame(at, parts.kind == CanClass.EDGES, slot, part))
                continue
            status = parts.kind == CanClass.STATUS and parts.slot in DEVICE_STATUS
            if not status and parts.kind != CanClass.TO_HOST:
                continue
            if parts not in self._reassemblers:
                self._reassemblers[parts] = Reassembler(parts.node, self._counters)
            message = self._reassemblers[parts].feed(part)
            if message is not None:
                found.append(Heard(at, parse_frame(message), part[-1] & 31, slot=parts.slot))
        return found


Line = ByteLine | BusLine


def line_of(link: Link) -> Line:
    """What is spoken on a link."""
    wire = link.wire()
    if not isinstance(wire, CanWire):
        return ByteLine()
    return BusLine(wire.rates, wire.node, wire.extended, wire.host)


def cut(wire: bytes) -> list[bytes]:
    """Records, one by one."""
    return [wire[at : at + RECORD_BYTES] for at in range(0, len(wire), RECORD_BYTES)]


def changed(record: bytes, at: int, bits: int) -> bytes:
    """A record with these bits of one data byte inverted; `at` counts from the end if negative."""
    number, length, flags, reserved, time, data = RECORD.unpack(record)
    place = at % length
    data = data[:place] + bytes([data[place] ^ bits]) + data[place + 1 :]
    return RECORD.pack(number, length, flags, reserved, time, data)


def remote(record: bytes) -> bytes:
    """The same as a remote frame."""
    number, length, flags, reserved, time, data = RECORD.unpack(record)
    return RECORD.pack(number | REMOTE, length, flags, reserved, time, bytes(len(data)))
