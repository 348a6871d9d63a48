"""CAN, chapter 16, classic: an slcan adapter on a pty, which other processes reach, and python-can's `virtual` bus."""

from __future__ import annotations

import itertools
import os
import select
import tty
from collections.abc import Iterator
from contextlib import suppress
from zlib import crc32

import can

from tests.devices.carriers import HEAD
from tests.devices.spec import REPLY, Code, Message, Refusal, Type
from tests.devices.streams import Record, Stream

NODE = 1
STOP, STATUS, TO_DEVICE, TO_HOST, EDGES, SAMPLES = range(6)
STATUS_SLOTS = {Type.HEARTBEAT: 4, Type.EVENT: 2, Type.LOG: 3, Type.ALIVE: 5, Type.SETPOINT: 1}
FIRST, LAST, TOGGLE = 128, 64, 32  # of the tail
SHORT_HEAD = 6  # bytes of the header in a transfer
ROOM = 6  # bytes of samples in a frame
MOST_LOAD = 0.95
EDGES_PER_SECOND = 1000
EDGE_SLOTS, SAMPLE_SLOTS = 16, 32
MOST_WAITING = 65536  # bytes of an adapter's text
MOST_GROUPS = 16
KBIT_PER_S = dict(zip(b"012345678", (10, 20, 50, 100, 125, 250, 500, 750, 1000), strict=True))
"""What the digit of slcan's S stands for."""

Frame = tuple[int, bytes]
"""11-bit identifier and data."""


def identifier(kind: int, node: int, slot: int) -> int:
    """class, node and slot."""
    return kind << 8 | node << 4 | slot


def frame_bits(length: int) -> int:
    """Most bits of a classic frame, with stuff bits and interframe space."""
    stuffable = 34 + 8 * length
    return stuffable + (stuffable - 1) // 4 + 13


def groups_of(sizes: list[int]) -> list[int]:
    """Channels in each frame of a sample, by their bytes: each group as long as it fits."""
    groups, room = [0], ROOM
    for size in sizes:
        if size > room:
            groups.append(0)
            room = ROOM
        groups[-1] += 1
        room -= size
    return groups


def cut(message: Message, transfer: int) -> Iterator[bytes]:
    """The data of the frames of a message."""
    head = HEAD.pack(message.type, message.flags, message.tid, len(message.payload), message.node)
    rest = head[:SHORT_HEAD] + message.payload
    if len(rest) > 7:
        rest += crc32(head + message.payload).to_bytes(4, "little")
    parts = [rest[start : start + 7] for start in range(0, len(rest), 7)]
    for n, part in enumerate(parts):
        ends = FIRST * (n == 0) | LAST * (n == len(parts) - 1)
        yield part + bytes([ends | (TOGGLE if n % 2 == 0 else 0) | transfer])


class Assembler:
    """Transfers of one identifier, from their frames."""

    def __init__(self) -> None:
        self.bad = 0
        self._data: bytearray | None = None
        self._expected = 0  # the tail's toggle and transfer id
        self._before = b""

    def feed(self, data: bytes, node: int) -> Message | None:
        """The message that this frame completes."""
        if not data or self.repeated(data):
            return None
        self._before = data
        tail, single = data[-1], False
        if tail & FIRST:
            self.bad += self._data is not None
            self._data, self._expected = bytearray(), (tail & 31) | TOGGLE
            single = bool(tail & LAST)
        if self._data is None:
            return None
        if not self.expected(tail, self._expected):
            return self._damaged()
        self._data += data[:-1]
        self._expected ^= TOGGLE
        if not tail & LAST:
            return None
        whole, self._data = bytes(self._data), None
        body, crc = (whole, b"") if single else (whole[:-4], whole[-4:])
        if len(body) < SHORT_HEAD:
            return self._damaged()
        kind, flags, tid, length, _ = HEAD.unpack(body[:SHORT_HEAD] + b"\0\0")
        payload = body[SHORT_HEAD:]
        checked = HEAD.pack(kind, flags, tid, length, node) + payload
        if length != len(payload) or (crc and crc32(checked) != int.from_bytes(crc, "little")):
            return self._damaged()
        return Message(kind, flags, tid, node, payload)

    def repeated(self, data: bytes) -> bool:
        """Whether this is the frame before once more."""
        return data == self._before

    @staticmethod
    def expected(tail: int, toggle_and_id: int) -> bool:
        """Whether this is the next frame of the transfer."""
        return tail & 63 == toggle_and_id

    def _damaged(self) -> None:
        self.bad += 1
        self._data = None


class CanCarrier:
    """Node 1 on a classic bus; subclasses say which."""

    target: str
    bitrate = 1_000_000
    assembler = Assembler
    for_everybody: tuple[int, ...] = (Type.HELLO,)
    """Types of what is answered at node 0."""

    def __init__(self) -> None:
        self._assemblers: dict[int, Assembler] = {}
        self._transfers: dict[int, Iterator[int]] = {}
        self._next_slot: dict[bool, int] = {}
        self._boot_id = -1

    @property
    def bad(self) -> int:
        """Damaged transfers."""
        return sum(assembler.bad for assembler in self._assemblers.values())

    # -- what a subclass has ------------------------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        """Until there is something to read, or so long."""
        raise NotImplementedError

    def _frames(self) -> list[Frame]:
        """What has come."""
        raise NotImplementedError

    def _put(self, frames: list[Frame], stream: bool = False) -> bool:
        """Send; False if there was no room for frames of a stream."""
        raise NotImplementedError

    def foreign(self, number: int, data: bytes) -> None:
        """A frame of somebody else on the bus: this device and the host get it."""
        raise NotImplementedError

    # -- messages -----------------------------------------------------------------------------------------------

    def receive(self) -> list[tuple[Message, int]]:
        """The messages that have come, with the number of the host; a STOP frame is a message of type 0."""
        return [found for frame in self._frames() if (found := self._receive(*frame)) is not None]

    def _receive(self, number: int, data: bytes) -> tuple[Message, int] | None:
        kind, node, slot = number >> 8, number >> 4 & 15, number & 15
        if node not in (0, NODE):
            return None
        if kind == STOP:
            return Message(0, 0, 0, node, b""), 0
        if kind not in (STATUS, TO_DEVICE):
            return None
        message = self._assemblers.setdefault(number, self.assembler()).feed(data, node)
        if message is None or (kind == STATUS) != (message.type in (Type.ALIVE, Type.SETPOINT)):
            return None
        if kind == STATUS and slot != STATUS_SLOTS[Type(message.type)]:
            return None
        if kind == TO_DEVICE and node == 0 and message.type not in self.for_everybody:
            return None
        return message, slot if kind == TO_DEVICE else 0

    def send(self, message: Message, host: int = 0, transfer: int | None = None) -> int:
        """See `ByteCarrier`."""
        kind = message.type
        number = (
            identifier(TO_HOST, message.node, host)
            if message.flags & REPLY
            else identifier(STATUS, message.node, STATUS_SLOTS[Type(kind)])
        )
        if transfer is None:
            transfer = next(self._transfers.setdefault(number, itertools.count())) % 32
        self._put([(number, data) for data in cut(message, transfer)])
        return transfer

    # -- streams ------------------------------------------------------------------------------------------------

    def plan(self, stream: Stream, others: list[Stream], pwm_hz: float, boot_id: int) -> None:
        """See `ByteCarrier`."""
        if boot_id != self._boot_id:
            self._boot_id = boot_id
            self._next_slot = {True: boot_id % EDGE_SLOTS, False: boot_id % SAMPLE_SLOTS}
        groups = [1] if stream.edges else groups_of(stream.sizes)
        if len(groups) > MOST_GROUPS:
            raise Refusal(Code.DOES_NOT_FIT, 0)
        taken = sum(other.load for other in others)
        for decimation in range(stream.decimation, 65536):
            stream.decimation, asked = decimation, stream.decimation
            stream.block = 1 if stream.edges or len(groups) > 1 else stream.most_in(ROOM, pwm_hz)
            stream.load = self._load(stream, groups, pwm_hz)
            stream.decimation = asked
            if taken + stream.load <= MOST_LOAD:
                break
        else:
            raise Refusal(Code.DOES_NOT_FIT, 0)
        if decimation != stream.decimation:
            raise Refusal(Code.DOES_NOT_FIT, 0 if stream.edges else decimation)
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

    def _load(self, stream: Stream, groups: list[int], pwm_hz: float) -> float:
        if stream.edges:
            return EDGES_PER_SECOND * frame_bits(8) / self.bitrate
        rate = pwm_hz / stream.decimation
        if len(groups) == 1:
            return rate / stream.block * frame_bits(2 + stream.block * stream.sample_bytes) / self.bitrate
        sizes = iter(stream.sizes)
        bits = sum(frame_bits(2 + sum(itertools.islice(sizes, group))) for group in groups)
        return rate * bits / self.bitrate

    def emit(self, stream: Stream, records: list[Record], node: int) -> int:
        """See `ByteCarrier`."""
        index, _, first = records[0]
        if stream.edges:
            data = first[:5] + bytes([index & 0xFF]) + first[6:]
            return 0 if self._put([(identifier(EDGES, node, stream.slot), data)], True) else 1
        counter = (index // stream.decimation & 0xFFFF).to_bytes(2, "little")
        groups = groups_of(stream.sizes)
        if len(groups) == 1:
            frames = [(self._sample_id(node, stream.slot), counter + b"".join(data for _, _, data in records))]
        else:
            frames, sizes, start = [], iter(stream.sizes), 0
            for n, group in enumerate(groups):
                end = start + sum(itertools.islice(sizes, group))
                frames.append((self._sample_id(node, stream.slot + n), counter + first[start:end]))
                start = end
        return 0 if self._put(frames, True) else len(frames)

    @staticmethod
    def _sample_id(node: int, slot: int) -> int:
        slot %= SAMPLE_SLOTS
        return identifier(SAMPLES + slot // 16, node, slot % 16)


class Slcan(CanCarrier):
    """An adapter of the LAWICEL kind on a pty, with this device alone on its bus."""

    def __init__(self) -> None:
        super().__init__()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.target = f"can:slcan/{os.ttyname(self._slave)}"
        self._open = False
        self._received = bytearray()
        self._waiting = bytearray()

    def wait(self, seconds: float) -> None:
        select.select([self._master], [self._master] if self._waiting else [], [], seconds)
        self._push()

    def _frames(self) -> list[Frame]:
        with suppress(BlockingIOError):
            self._received += os.read(self._master, 65536)
        *lines, self._received = self._received.split(b"\r")
        return [frame for line in lines if (frame := self._line(bytes(line))) is not None]

    def _line(self, line: bytes) -> Frame | None:
        """Obey and answer a line of the host; returns the frame that it puts on the bus."""
        if line.startswith(b"t"):
            self._answer(b"z\r" if self._open else b"\a")
            number, length = int(line[1:4], 16), int(line[4:5], 16)
            return (number, bytes.fromhex(line[5 : 5 + 2 * length].decode())) if self._open else None
        if line.startswith(b"S") and line[1] in KBIT_PER_S:
            self.bitrate = 1000 * KBIT_PER_S[line[1]]
        elif line in (b"O", b"C"):
            self._open = line == b"O"
            if not self._open:
                self._waiting.clear()
        elif line:
            self._answer(b"\a")
            return None
        self._answer(b"\r")
        return None

    def _answer(self, text: bytes) -> None:
        self._waiting += text
        self._push()

    def _put(self, frames: list[Frame], stream: bool = False) -> bool:
        if stream and len(self._waiting) >= MOST_WAITING:
            return False
        if self._open:
            text = "".join(f"t{number:03X}{len(data)}{data.hex()}\r" for number, data in frames)
            self._answer(text.encode())
        return True

    def foreign(self, number: int, data: bytes) -> None:
        self._put([(number, data)])
        self._received += f"t{number:03X}{len(data)}{data.hex()}\r".encode()

    def _push(self) -> None:
        with suppress(BlockingIOError):
            while self._waiting:
                del self._waiting[: os.write(self._master, bytes(self._waiting[:4096]))]

    def close(self) -> None:
        """Done."""
        os.close(self._master)
        os.close(self._slave)


class Virtual(CanCarrier):
    """python-can's bus inside this process; each device has one of its own."""

    numbers = itertools.count()

    def __init__(self) -> None:
        super().__init__()
        channel = f"test-device-{next(self.numbers)}"
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._other = can.Bus(interface="virtual", channel=channel)
        self.target = f"can:virtual/{channel}"
        self._first: can.Message | None = None

    def wait(self, seconds: float) -> None:
        self._first = self._bus.recv(seconds)

    def _frames(self) -> list[Frame]:
        frames, message = [], self._first
        while message is not None:
            frames.append((message.arbitration_id, bytes(message.data)))
            message = self._bus.recv(0)
        return frames

    def _put(self, frames: list[Frame], stream: bool = False) -> bool:
        for number, data in frames:
            self._bus.send(can.Message(arbitration_id=number, data=data, is_extended_id=False))
        return True

    def foreign(self, number: int, data: bytes) -> None:
        self._other.send(can.Message(arbitration_id=number, data=data, is_extended_id=False))

    def close(self) -> None:
        """Done."""
        self._bus.shutdown()
        self._other.shutdown()
