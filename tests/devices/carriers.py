"""Byte links: frames of chapter 1 over a pty or TCP. A carrier waits, receives, sends, and says its `target`."""

from __future__ import annotations

import os
import select
import socket
import struct
import tty
from contextlib import suppress
from zlib import crc32

from cobs import cobs

from tests.devices.spec import REPLY, Code, Message, Refusal, Type
from tests.devices.streams import HEADER, Record, Stream

HEAD = struct.Struct("<BBHHBx")
SHORTEST, LONGEST = 12, 1036  # bytes of a frame, decoded
MOST_WAITING = 32768  # bytes that wait to be sent, from which on streams are dropped
MOST_RECEIVED = 2048  # bytes without a delimiter that are kept


def encode(message: Message) -> bytes:
    """The bytes of a message on a byte link."""
    body = HEAD.pack(message.type, message.flags, message.tid, len(message.payload), message.node) + message.payload
    return b"\0" + cobs.encode(body + crc32(body).to_bytes(4, "little")) + b"\0"


def decode(frame: bytes) -> Message | None:
    """What stands between two delimiters; None if it is damaged."""
    try:
        data = cobs.decode(frame)
    except cobs.DecodeError:
        return None
    body = data[:-4]
    if not SHORTEST <= len(data) <= LONGEST or crc32(body) != int.from_bytes(data[-4:], "little"):
        return None
    kind, flags, tid, length, node = HEAD.unpack_from(body)
    payload = body[HEAD.size :]
    return Message(kind, flags, tid, node, payload) if length == len(payload) else None


class ByteCarrier:
    """Frames over a descriptor that reads and writes bytes; subclasses say which."""

    target: str

    def __init__(self) -> None:
        self.bad = 0
        """Damaged frames."""
        self._received = bytearray()
        self._synchronised = False
        self._waiting = bytearray()
        self._heartbeat: bytes | None = None  # waits for room

    # -- what a subclass has ------------------------------------------------------------------------------------

    def _descriptor(self) -> int:
        """To read from and write to; -1 where nobody is connected."""
        raise NotImplementedError

    def _read(self) -> bytes:
        return os.read(self._descriptor(), 65536)

    def _write(self, data: bytes) -> int:
        return os.write(self._descriptor(), data)

    def _lost(self) -> None:
        """Reading or writing failed."""

    def _begin(self) -> None:
        """Another host: nothing of the last one is left."""
        self._received.clear()
        self._waiting.clear()
        self._synchronised = False

    def close(self) -> None:
        """Done."""

    # -- receiving and sending ----------------------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        """Until there is something to read, or so long."""
        descriptor = self._descriptor()
        readable = [descriptor] if descriptor >= 0 else []
        select.select(readable, readable if self._waiting else [], [], seconds)
        self._push()

    def receive(self) -> list[tuple[Message, int]]:
        """The messages that have come, with the number of the host."""
        try:
            data = self._read() if self._descriptor() >= 0 else b""
        except BlockingIOError:
            return []
        except OSError:
            self._lost()
            return []
        return self._parse(data)

    def _parse(self, data: bytes) -> list[tuple[Message, int]]:
        self._received += data
        *frames, rest = self._received.split(b"\0")
        self._received = rest[-MOST_RECEIVED:]
        if frames and not self._synchronised:
            frames, self._synchronised = frames[1:], True
        found = []
        for frame in filter(None, frames):
            message = decode(bytes(frame))
            if message is None:
                self.bad += 1
                message = self.salvaged(bytes(frame))
            if message is not None:
                found.append((message, 0))
        return found

    @staticmethod
    def salvaged(frame: bytes) -> Message | None:
        """What is made of a damaged frame, for faults."""
        return None

    def send(self, message: Message, host: int = 0, transfer: int | None = None) -> int:
        """Send; returns its transfer id, for sending it again on CAN.

        Replies always have room; a heartbeat that waits is replaced; LOG and EVENT are dropped where all is full.
        """
        frame = encode(message)
        if message.type == Type.HEARTBEAT:
            self._heartbeat = frame
        elif message.flags & REPLY or len(self._waiting) < MOST_WAITING:
            self._waiting += frame
        self._push()
        return 0

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
        if self._descriptor() < 0:
            self._waiting.clear()
            return
        try:
            with suppress(BlockingIOError):
                while self._waiting:
                    del self._waiting[: self._write(bytes(self._waiting[:4096]))]
        except OSError:
            self._lost()


class Pty(ByteCarrier):
    """A pseudo terminal; a host opens it like a serial port, one after the other."""

    def __init__(self) -> None:
        super().__init__()
        self._master, self._slave = os.openpty()  # held open, so that a host that leaves is no error
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.target = f"serial:{os.ttyname(self._slave)}"

    def _descriptor(self) -> int:
        return self._master

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


class Tcp(ByteCarrier):
    """A server on the loopback interface, for one client at a time; the next one ends the last one's connection."""

    def __init__(self) -> None:
        super().__init__()
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.setblocking(False)
        self._client: socket.socket | None = None
        self.target = f"tcp:127.0.0.1:{self._server.getsockname()[1]}"

    def _descriptor(self) -> int:
        return -1 if self._client is None else self._client.fileno()

    def wait(self, seconds: float) -> None:
        if self._client is None:
            select.select([self._server], [], [], seconds)
        else:
            super().wait(seconds)
        with suppress(BlockingIOError):
            client, _ = self._server.accept()
            self._lost()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client = client

    def _read(self) -> bytes:
        data = super()._read()
        if not data:
            self._lost()
        return data

    def _lost(self) -> None:
        self._begin()
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        self._lost()
        self._server.close()
