"""Messages over CAN frames: transfers with a tail byte, as in Cyphal.

    transfer = type u8 | flags u8 | tid u16 | length u16 | payload | crc32 where it needs more than one frame

cut into frames, each of which ends in a tail byte: bit 7 start, bit 6 end, bit 5 toggle (1 in the first frame), bits
0-4 transfer id. Inside the project a message is header + payload as on a byte link (`protocol.framing`); the CRC is
the same there and here. This module knows no message and no stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

from protocol.canmap.frame import BRS, FDF, MAX_DATA, RECORD, padded_length
from protocol.canmap.ids import CanId
from protocol.framing import CRC_BYTES, HEADER_BYTES, MAX_PAYLOAD

START, END, TOGGLE, ID_MASK = 0x80, 0x40, 0x20, 0x1F
NODE_OFFSET = 6  # of the node in a message's header: the CAN id has it, a transfer does not
TRANSFER_HEADER = NODE_OFFSET
MAX_TRANSFER = TRANSFER_HEADER + MAX_PAYLOAD + CRC_BYTES


def pack_record(can_id: int, data: bytes, fd: bool) -> bytes:
    """Return one CAN_RECORD; FD frames switch the bit rate, and `data` must have one of their lengths."""
    return RECORD.pack(can_id, len(data), FDF | BRS if fd else 0, 0, 0.0, data)


@dataclass(slots=True)
class CanCounters:
    """What one end of a CAN bus heard since it was made."""

    frames: int = 0
    """Frames of HBP for this end."""
    transfers: int = 0
    """Whole messages."""
    bad_crc: int = 0
    bad_length: int = 0
    """Transfers that are longer or shorter than they say."""
    aborted: int = 0
    """Transfers given up: a frame is missing, or a new one began."""
    orphans: int = 0
    """Frames of transfers whose beginning was not heard."""
    duplicates: int = 0
    """Frames that came twice in a row."""
    foreign: int = 0
    """Frames of others: identifiers that HBP does not have here."""
    stale: int = 0
    """Stream frames of no configured stream."""
    overdue: int = 0
    """Stream frames given up because no heartbeat said what time they are of."""
    error_frames: int = 0

    @property
    def bad(self) -> int:
        """Damaged messages of every kind."""
        return self.bad_crc + self.bad_length + self.aborted


class TransferEncoder:
    """Cuts messages into frames, with a transfer id for each CAN id."""

    def __init__(self, fd: bool, extended: bool) -> None:
        self._fd = fd
        self._extended = extended
        self._next: dict[CanId, int] = {}

    def encode(self, can_id: CanId, message: bytes) -> bytes:
        """Return the frames, as CAN_RECORDs, of a message (header + payload)."""
        transfer = self._next.get(can_id, 0)
        self._next[can_id] = (transfer + 1) & ID_MASK
        body = message[:NODE_OFFSET] + message[HEADER_BYTES:]
        room = (MAX_DATA if self._fd else 8) - 1
        if len(body) > room:
            body += crc32(message).to_bytes(CRC_BYTES, "little")
        wire = []
        packed = can_id.pack(self._extended)
        toggle = TOGGLE
        for start in range(0, len(body), room):
            part = body[start : start + room]
            end = start + room >= len(body)
            if self._fd:
                part = part.ljust(padded_length(len(part) + 1) - 1, b"\0")
            tail = (START if not start else 0) | (END if end else 0) | toggle | transfer
            wire.append(pack_record(packed, part + bytes([tail]), self._fd))
            toggle ^= TOGGLE
        return b"".join(wire)


class Reassembler:
    """Puts the transfers of one CAN id together again. `node` goes into the messages' header."""

    def __init__(self, node: int, counters: CanCounters) -> None:
        self._node = node
        self._counters = counters
        self._body = b""
        self._expected = -1  # tail bits of the next frame, -1 between transfers
        self._last = b""

    def feed(self, data: bytes) -> bytes | None:
        """Take a frame's data; return the message (header + payload) that it completes."""
        counters = self._counters
        if not data:
            counters.orphans += 1
            return None
        if data == self._last:  # neighbours differ in toggle or transfer id
            counters.duplicates += 1
            return None
        self._last = data
        tail, part = data[-1], data[:-1]
        if tail & START:
            if self._expected >= 0:
                counters.aborted += 1
            self._expected = -1
            if not tail & TOGGLE:
                counters.orphans += 1
                return None
            self._body = part
        elif self._expected < 0:
            counters.orphans += 1
            return None
        elif tail & (TOGGLE | ID_MASK) != self._expected or len(self._body) > MAX_TRANSFER:
            counters.aborted += 1
            self._expected = -1
            return None
        else:
            self._body += part
        if not tail & END:
            self._expected = tail & (TOGGLE | ID_MASK) ^ TOGGLE
            return None
        self._expected = -1
        return self._finish(single=bool(tail & START))

    def _finish(self, single: bool) -> bytes | None:
        body, counters = self._body, self._counters
        length = int.from_bytes(body[4:TRANSFER_HEADER], "little")
        end = TRANSFER_HEADER + length
        needed = end if single else end + CRC_BYTES
        if len(body) < max(TRANSFER_HEADER, needed) or len(body) > padded_body(needed, single):
            counters.bad_length += 1
            return None
        message = body[:NODE_OFFSET] + bytes((self._node, 0)) + body[TRANSFER_HEADER:end]
        if not single and crc32(message).to_bytes(CRC_BYTES, "little") != body[end:needed]:
            counters.bad_crc += 1
            return None
        counters.transfers += 1
        return message


def padded_body(needed: int, single: bool) -> int:
    """Return the most bytes, tail bytes left out, that the frames of a transfer of `needed` bytes have."""
    room = MAX_DATA - 1
    if single:
        return padded_length(min(needed, room) + 1) - 1
    last = needed % room or room
    return needed - last + padded_length(last + 1) - 1
