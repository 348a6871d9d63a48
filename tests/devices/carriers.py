"""What carries the messages of a device: frames and transfers are made by `protocol`, ports by `sim`.

A carrier waits, receives, sends, and says its `target`. How it fits streams into a link and what it drops is its own:
chapters 11 and 16 of protocol/SPEC.md, without `protocol`.
"""

from __future__ import annotations

import itertools
import select
import time
from collections import defaultdict
from collections.abc import Iterable
from functools import partial

import can

from protocol.canmap.frame import RECORD, BusRates
from protocol.canmap.ids import STATUS_SLOTS, CanClass, CanId, parse_id
from protocol.canmap.transport import CanCounters, Reassembler, TransferEncoder, pack_record
from protocol.framing import Deframer, encode_frame, parse_frame
from protocol.links.can_message import to_messages, to_record
from sim.ports.byte_ports import Port, PtyPort, TcpPort
from sim.ports.slcan_port import SlcanPort
from tests.devices.spec import REPLY, Code, Message, Refusal, Type
from tests.devices.streams import HEADER, Record, Stream

NODE = 1
MOST_WAITING = 32768  # bytes that wait to be sent, from which on streams are dropped
CHUNK = 4000  # bytes that a port is given at once: whole records
CLASSIC = BusRates(1_000_000)
ROOM = 6  # bytes of samples in a CAN frame
MOST_LOAD = 0.95
EDGES_PER_SECOND = 1000
EDGE_SLOTS, SAMPLE_SLOTS = 16, 32
MOST_GROUPS = 16
STOP_FRAME = -1


class Carrier:
    """Messages over a port."""

    whole = False
    """Whether less than a frame of samples is never sent."""

    def __init__(self, port: Port | None = None) -> None:
        self.port = port
        self._waiting = bytearray()

    @property
    def target(self) -> str:
        """What a host connects to."""
        assert self.port is not None
        return self.port.target

    def wait(self, seconds: float) -> None:
        """Until there is something to read, or so long."""
        assert self.port is not None
        if fds := self.port.read_fds():
            select.select(fds, fds if self._waiting else [], [], seconds)
        else:
            time.sleep(seconds / 10)
        self._push()

    def close(self) -> None:
        """Done."""
        if self.port is not None:
            self.port.unplug()

    def _received(self) -> bytes:
        self._push()
        return b"" if self.port is None else self.port.read()

    def _push(self) -> None:
        while self.port is not None and self._waiting:
            taken = self.port.write(bytes(self._waiting[:CHUNK]))
            del self._waiting[:taken]
            if not taken:
                return


class ByteCarrier(Carrier):
    """Frames of chapter 1."""

    def __init__(self, port: Port | None = None) -> None:
        super().__init__(port)
        self._deframer = Deframer()
        self._heartbeat: bytes | None = None  # waits for room

    @property
    def bad(self) -> int:
        """Damaged frames."""
        return self._deframer.counters.bad

    def receive(self) -> list[tuple[Message, int]]:
        """The messages that have come, with the number of the host."""
        return [(message, 0) for message in self.parse(self._received())]

    def parse(self, data: bytes) -> list[Message]:
        """The messages that these bytes complete."""
        return [parse_frame(raw) for raw in self._deframer.feed(data)]

    def send(self, message: Message, host: int = 0, sent: bytes | None = None) -> bytes:
        """Send, or send again what was `sent`; returns that.

        Replies always have room; a heartbeat that waits is replaced; LOG and EVENT are dropped where all is full.
        """
        frame = sent or encode_frame(message)
        if message.type == Type.HEARTBEAT:
            self._heartbeat = frame
        elif message.flags & REPLY or len(self._waiting) < MOST_WAITING:
            self._waiting += frame
        self._push()
        return frame

    def plan(self, stream: Stream, others: list[Stream], pwm_hz: float, boot_id: int) -> None:
        """Fill in block, load and slot. Raises Refusal(DOES_NOT_FIT). A byte link carries any load."""
        room = stream.tx_max - HEADER.size
        if stream.sample_bytes > room:
            raise Refusal(Code.DOES_NOT_FIT, room)
        stream.block = stream.most_in(room, pwm_hz)

    def emit(self, stream: Stream, records: list[Record], node: int) -> int:
        """Send up to a block of records; returns how many frames found no room."""
        kind, payload = stream.frame(records)
        if len(self._waiting) >= MOST_WAITING:
            return 1
        self.send(Message(kind, 1, 0, node, payload))
        return 0

    def _push(self) -> None:
        if self._heartbeat is not None and len(self._waiting) < MOST_WAITING:
            self._waiting += self._heartbeat
            self._heartbeat = None
        super()._push()


def frame_bits(length: int) -> int:
    """Most bits of a classic frame, with stuff bits and interframe space."""
    stuffable = 34 + 8 * length
    return stuffable + (stuffable - 1) // 4 + 13


def groups_of(sizes: list[int]) -> list[list[int]]:
    """Bytes of the channels in each frame of a sample: each group as long as it fits."""
    groups: list[list[int]] = [[]]
    for size in sizes:
        if sum(groups[-1]) + size > ROOM:
            groups.append([])
        groups[-1].append(size)
    return groups


class CanCarrier(Carrier):
    """Node 1 on a classic bus, chapter 16; the port's bytes are CAN_RECORDs."""

    assembler = Reassembler
    whole = True
    for_everybody: tuple[int, ...] = (Type.HELLO,)
    """Types of what is answered at node 0."""

    def __init__(self, port: Port) -> None:
        super().__init__(port)
        self._counters = CanCounters()
        self._assemblers: dict[int, Reassembler] = {}
        self._encoder = TransferEncoder(fd=False, extended=False)
        self._next_slot = defaultdict[bool, int](int)
        self._boot_id = -1
        self._overheard = b""

    @property
    def bad(self) -> int:
        """Damaged transfers."""
        return self._counters.bad

    def receive(self) -> list[tuple[Message, int]]:
        """The messages that have come, with the number of the host; a STOP frame has the type STOP_FRAME."""
        overheard, self._overheard = self._overheard, b""
        frames = RECORD.iter_unpack(overheard + self._received())
        return [found for number, n, *_, data in frames if (found := self._receive(number, data[:n])) is not None]

    def _receive(self, number: int, data: bytes) -> tuple[Message, int] | None:
        found = parse_id(number, extended=False)
        if found is None or found.node not in (0, NODE):
            return None
        kind, node, slot = found
        if kind == CanClass.STOP:
            return Message(STOP_FRAME, 0, 0, node, b""), 0
        if kind not in (CanClass.STATUS, CanClass.TO_DEVICE):
            return None
        body = self._assemblers.setdefault(number, self.assembler(node, self._counters)).feed(data)
        message = None if body is None else parse_frame(body)
        if message is None or (kind == CanClass.STATUS) != (message.type in (Type.ALIVE, Type.SETPOINT)):
            return None
        if kind == CanClass.STATUS and slot != STATUS_SLOTS[message.type]:
            return None
        if kind == CanClass.TO_DEVICE and node == 0 and message.type not in self.for_everybody:
            return None
        return message, slot if kind == CanClass.TO_DEVICE else 0

    def send(self, message: Message, host: int = 0, sent: bytes | None = None) -> bytes:
        """See `ByteCarrier`."""
        reply = message.flags & REPLY
        kind, slot = (CanClass.TO_HOST, host) if reply else (CanClass.STATUS, STATUS_SLOTS[message.type])
        return self._put(sent or self._encoder.encode(CanId(kind, message.node, slot), message.pack()))

    def _put(self, records: bytes) -> bytes:
        self._waiting += records
        self._push()
        return records

    def foreign(self, number: int, data: bytes) -> None:
        """A frame of somebody else on the bus: this device and the host get it."""
        self._overheard += self._put(pack_record(number, data, fd=False))

    # -- streams ------------------------------------------------------------------------------------------------

    def plan(self, stream: Stream, others: list[Stream], pwm_hz: float, boot_id: int) -> None:
        """See `ByteCarrier`."""
        if boot_id != self._boot_id:
            self._boot_id = boot_id
            self._next_slot.update({True: boot_id % EDGE_SLOTS, False: boot_id % SAMPLE_SLOTS})
        groups = [[8]] if stream.edges else groups_of(stream.sizes)
        if len(groups) > MOST_GROUPS:
            raise Refusal(Code.DOES_NOT_FIT, 0)
        taken, asked = sum(other.load for other in others), stream.decimation
        for stream.decimation in range(asked, 65536):
            stream.block = 1 if stream.edges or len(groups) > 1 else stream.most_in(ROOM, pwm_hz)
            stream.load = self._load(stream, groups, pwm_hz)
            stream.total = taken + stream.load
            if stream.total <= MOST_LOAD:
                break
        else:
            raise Refusal(Code.DOES_NOT_FIT, 0)
        if stream.decimation != asked:
            raise Refusal(Code.DOES_NOT_FIT, 0 if stream.edges else stream.decimation)
        circle = EDGE_SLOTS if stream.edges else SAMPLE_SLOTS
        in_use = {
            (other.slot + n) % circle
            for other in others
            if other.edges == stream.edges
            for n in range(1 if other.edges else len(groups_of(other.sizes)))
        }
        for step in range(circle):
            slot = (self._next_slot[stream.edges] + step) % circle
            if not in_use & {(slot + n) % circle for n in range(len(groups))}:
                stream.slot = slot
                self._next_slot[stream.edges] = (slot + len(groups)) % circle
                return
        raise Refusal(Code.DOES_NOT_FIT, 0)

    def _load(self, stream: Stream, groups: list[list[int]], pwm_hz: float) -> float:
        if stream.edges:
            return EDGES_PER_SECOND * frame_bits(8) / CLASSIC.bitrate
        bits = sum(frame_bits(2 + stream.block * sum(group)) for group in groups)
        return pwm_hz / stream.decimation / stream.block * bits / CLASSIC.bitrate

    def emit(self, stream: Stream, records: list[Record], node: int) -> int:
        """See `ByteCarrier`."""
        index, _, first = records[0]
        frames: Iterable[tuple[CanId, bytes]]
        if stream.edges:
            frames = [(CanId(CanClass.EDGES, node, stream.slot), first[:5] + bytes([index & 0xFF]) + first[6:])]
        else:
            counter = (index // stream.decimation & 0xFFFF).to_bytes(2, "little")
            rest, parts = b"".join(data for _, _, data in records), []
            for group in (groups := groups_of(stream.sizes)):
                size = sum(group) if len(groups) > 1 else len(rest)
                parts.append(counter + rest[:size])
                rest = rest[size:]
            slots = [(stream.slot + n) % SAMPLE_SLOTS for n in range(len(parts))]
            ids = [CanId(CanClass.SAMPLES + slot // 16, node, slot % 16) for slot in slots]
            frames = zip(ids, parts, strict=True)
        wire = b"".join(pack_record(number.pack(extended=False), data, fd=False) for number, data in frames)
        if len(self._waiting) >= 8 * MOST_WAITING:
            return len(wire) // RECORD.size
        self._put(wire)
        return 0


class VirtualBusPort:
    """python-can's bus inside this process; each device has one of its own."""

    numbers = itertools.count()

    def __init__(self) -> None:
        channel = f"test-device-{next(self.numbers)}"
        self._bus = can.Bus(interface="virtual", channel=channel)
        self.target = f"can:virtual/{channel}"

    def read_fds(self) -> list[int]:
        return []

    def read(self) -> bytes:
        return b"".join(to_record(message, 0.0) for message in iter(partial(self._bus.recv, 0.0), None))

    def write(self, data: bytes) -> int:
        for message in to_messages(data):
            self._bus.send(message)
        return len(data)

    def unplug(self) -> None:
        self._bus.shutdown()


IN_REAL_TIME = {
    "pty": lambda: ByteCarrier(PtyPort()),
    "tcp": lambda: ByteCarrier(TcpPort("127.0.0.1", 0)),
    "slcan": lambda: CanCarrier(SlcanPort(None, CLASSIC)),
    "virtual": lambda: CanCarrier(VirtualBusPort()),  # type: ignore[arg-type]
}
