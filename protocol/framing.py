"""Frames on a byte link: `00 | COBS(header, payload, crc32) | 00`.

`encode_frame` makes one, `Deframer` finds them in a stream that may hold noise, halves and damage. A damaged
frame is dropped and counted; a frame that comes out is byte for byte what was sent, but for those of a stream that are
joined (`Deframer.join`). This module does no I/O and keeps at most one frame's length of bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import NamedTuple, Protocol

from protocol.errors import LocalProtocolError

MAJOR = 1  # of the protocol; in bits 0-3 of every frame's flags
MINOR = 1
REPLY = 0x10  # flag: answers the request with the same tid
ERROR = 0x20  # flag, with REPLY: the answer is an ErrorReply

HEADER_BYTES = 8
CRC_BYTES = 4
MAX_PAYLOAD = 1024
CONNECT_PREAMBLE = bytes(16)  # ends whatever half frame the device may hold

_HEADER = struct.Struct("<BBHHBB")
_OVERHEAD = HEADER_BYTES + CRC_BYTES


@cache
def compiled() -> ModuleType:
    """`protocol.compiled_framing`, imported when it is first needed: see there."""
    return import_module("protocol.compiled_framing")


class Frame(NamedTuple):
    """One frame: `type` (a MessageType where known), `flags`, request id `tid`, `node`, `payload`."""

    type: int
    flags: int
    tid: int
    node: int
    payload: bytes

    def pack(self) -> bytes:
        """Return header + payload.

        Raises LocalProtocolError if the payload is longer than 1024 bytes or a header field does not fit.
        """
        type_, flags, tid, node, payload = self
        if len(payload) > MAX_PAYLOAD:
            raise LocalProtocolError(f"payload of {len(payload)} bytes: a frame carries at most {MAX_PAYLOAD}")
        try:
            return _HEADER.pack(type_, flags, tid, len(payload), node, 0) + payload
        except struct.error as error:
            raise LocalProtocolError(f"frame header {self[:4]} does not fit: {error}") from None

    @property
    def major(self) -> int:
        """Protocol major version of the sender."""
        return self.flags & 0x0F

    @property
    def is_reply(self) -> bool:
        """Whether it answers a request."""
        return bool(self.flags & REPLY)

    @property
    def is_error(self) -> bool:
        """Whether it is a refusal."""
        return bool(self.flags & ERROR)


def encode_frame(frame: Frame) -> bytes:
    """Return the wire bytes of a frame, with both delimiters; errors as `Frame.pack`."""
    return wrapped(frame.pack())


def wrapped(body: bytes, summed: bool = True) -> bytes:
    """Return the wire bytes of header and payload, and of their CRC if `summed`."""
    wire: bytes = compiled().encode(body, 1, b"", 0, 0, 0, summed)[0]
    return wire


def encoded_length(payload_bytes: int) -> int:
    """Return the most bytes that a frame with such a payload takes on the wire, delimiters included."""
    body = HEADER_BYTES + payload_bytes + CRC_BYTES
    return body + (body + 253) // 254 + 2


def parse_frame(raw: bytes) -> Frame:
    """Return the frame in header + payload as they come from `Deframer.feed`."""
    type_, flags, tid, _, node, _ = _HEADER.unpack_from(raw)
    return Frame(type_, flags, tid, node, raw[HEADER_BYTES:])


class ReceiverCounters(Protocol):
    """What the receiver at either end of any link counts."""

    @property
    def frames(self) -> int:
        """Intact frames."""

    @property
    def bad(self) -> int:
        """Damaged ones, of every kind."""


@dataclass(slots=True)
class FramingCounters:
    """What a `Deframer` saw since it was made."""

    frames: int = 0
    bad_crc: int = 0
    bad_cobs: int = 0
    bad_length: int = 0  # shorter than an empty frame, or the length field disagrees
    too_long: int = 0  # longer than any frame without a delimiter
    noise_bytes: int = 0  # bytes of damaged frames, and those before the first delimiter

    @property
    def bad(self) -> int:
        """Damaged frames of every kind."""
        return self.bad_crc + self.bad_cobs + self.bad_length + self.too_long


class Deframer:
    """Finds frames in a byte stream that may be cut anywhere.

    Bytes up to the first delimiter are dropped: they may be the tail of a frame.
    """

    def __init__(self) -> None:
        self.counters = FramingCounters()
        self._max_chunk = encoded_length(MAX_PAYLOAD) - 2
        self._decoder = compiled().Decoder(self._max_chunk, MAX_PAYLOAD, _OVERHEAD)
        self._tail = b""
        self._skipping = True  # until the next delimiter: unsynchronised, or inside a run that is too long

    def reset(self) -> None:
        """Forget half a frame and wait for the next delimiter; the counters stay."""
        self.counters.noise_bytes += len(self._tail)
        self._tail = b""
        self._skipping = True

    def join(self, type_: int, node: int, stream: int, rest: tuple[int, int, int, int]) -> None:
        """From now on stream frames of this kind that follow each other without a gap or a flag come out as one.

        Their records are then behind one header, the first one's, whose tid says how many more frames they are of.
        `rest`: their cfg_id, the bytes of a record, and by how much index and tick grow from record to record, -1 for a
        tick that does not.
        """
        self._decoder.join(compiled().Followed(type_, node, stream, *rest))

    def feed(self, data: bytes) -> list[bytes]:
        """Return header + payload of every intact frame that `data` completes, in order."""
        counters = self.counters
        start = data.find(b"\0") if self._skipping else 0
        if start < 0:
            counters.noise_bytes += len(data)
            return []
        counters.noise_bytes += start
        self._skipping = False
        data = self._tail + data[start:]
        self._tail = data[data.rfind(b"\0") + 1 :]
        if len(self._tail) > self._max_chunk:
            counters.too_long += 1
            counters.noise_bytes += len(self._tail)
            self._skipping = True
            self._tail = b""

        decoded, places, (intact, bad_cobs, bad_crc, bad_length, too_long, damaged) = self._decoder.decode(data)
        if damaged:
            counters.noise_bytes += damaged
            counters.bad_crc += bad_crc
            counters.bad_cobs += bad_cobs
            counters.bad_length += bad_length
            counters.too_long += too_long
        counters.frames += intact
        each = iter(places)
        return [decoded[begin:end] for begin, end in zip(each, each, strict=True)]
