"""How many bits a CAN frame is on the wire, stuff bits and interframe space included, and how long it takes.

Each frame is sent bit by bit through the stuffing rule (ISO 11898-1:2015): a complementary bit after five equal
ones. It holds from the start of frame to the end of a classic frame's CRC, and to the end of a CAN FD frame's data:
there the stuff bits of the CRC field have fixed places, the first of them instead of one that the data may ask for.
So the CRC is computed for classic frames only. The data bit rate holds from behind BRS up to the CRC delimiter.

This module judges no frame: what it is given must be one that can be sent.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.canmap.frame import (
    BRS,
    CAN_RECORD,
    ESI,
    EXTENDED,
    EXTENDED_MASK,
    FD_LENGTHS,
    FDF,
    REMOTE,
    STANDARD_MASK,
    BusRates,
)
from sim.native import Cells, Pointer, address, native
from sim.numba_cache import kernel

ARBITRATION_BITS = 32  # of an extended frame, from behind the start of frame to RTR
TAIL_BITS = 13  # CRC delimiter, ACK, ACK delimiter, 7 of end of frame, 3 of interframe space: never stuffed
CRC_15 = 0x4599
MOST_EQUAL = 5
LONG_CRC = 16  # data bytes of a CAN FD frame above which its CRC has 21 bits instead of 17
CRC_FIELD_BITS = 4 + 17 + 6  # CAN FD: stuff count with parity, CRC, a fixed stuff bit before and after every fourth bit
LONG_CRC_FIELD_BITS = 4 + 21 + 7
RECORD = CAN_RECORD.itemsize
LENGTH, FLAGS, DATA = (CAN_RECORD.fields[name][1] for name in ("length", "flags", "data"))  # type: ignore[index]
assert CAN_RECORD["id"] == np.dtype("<u4")


class _Line(NamedTuple):
    """What has been sent of a frame."""

    last: int  # level of the last bit
    run: int  # how many bits up to it had this level, stuff bits included
    stuffed: int  # stuff bits so far
    crc: int  # CRC-15 so far


@kernel
def _send(line: _Line, value: int, n: int) -> _Line:
    """Send the low `n` bits of `value`, the highest one first; a stuff bit goes out with the bit that follows it."""
    last, run, stuffed, crc = line
    for shift in range(n - 1, -1, -1):
        if run == MOST_EQUAL:
            last, run, stuffed = 1 - last, 1, stuffed + 1
        bit = value >> shift & 1
        run = run + 1 if bit == last else 1
        last = bit
        feedback = crc >> 14 ^ bit
        crc = crc << 1 & 0x7FFF
        if feedback:
            crc ^= CRC_15
    return _Line(last, run, stuffed, crc)


@kernel
def _send_data(line: _Line, data: Pointer[np.uint8], at: int, length: int) -> _Line:
    for k in range(length):
        line = _send(line, int(data[at + k]), 8)
    return line


@kernel
def arbitration(can_id: int) -> int:
    """Return the bits that decide who gets the bus, as a number: the lowest wins.

    `can_id` as in a record. The bits are those from behind the start of frame to RTR of an extended frame; a base
    frame's end with IDE, and zeros fill them up.
    """
    remote = 1 if can_id & REMOTE else 0
    if can_id & EXTENDED:
        identifier = can_id & EXTENDED_MASK
        return identifier >> 18 << 21 | 3 << 19 | (identifier & 0x3FFFF) << 1 | remote  # 3: SRR, IDE
    return (can_id & STANDARD_MASK) << 21 | remote << 20


@kernel
def _frame_bits(can_id: int, length: int, flags: int, data: Pointer[np.uint8], at: int) -> tuple[int, int]:
    """The bits of one frame at the nominal and at the data bit rate; its data begin at `data[at]`."""
    extended = can_id & EXTENDED != 0
    head = ARBITRATION_BITS if extended else 13  # ID, RTR, IDE
    line = _send(_Line(0, 1, 0, 0), arbitration(can_id) >> (ARBITRATION_BITS - head), head)  # behind the start of frame
    if flags & FDF == 0:
        control = 6 if extended else 5  # reserved bits, DLC
        sent = 0 if can_id & REMOTE else length
        line = _send_data(_send(line, length, control), data, at, sent)
        line = _send(line, line.crc, 15)
        end = 1 if line.run == MOST_EQUAL else 0
        return 1 + head + control + 8 * sent + 15 + line.stuffed + end + TAIL_BITS, 0
    dlc = 0
    while FD_LENGTHS[dlc] < length:
        dlc += 1
    line = _send(line, 5 if flags & BRS else 4, 3)  # FDF, a reserved bit, BRS
    nominal = 1 + head + 3 + line.stuffed + TAIL_BITS
    line = _send_data(_send(line, (16 if flags & ESI else 0) | dlc, 5), data, at, length)
    crc_field = LONG_CRC_FIELD_BITS if length > LONG_CRC else CRC_FIELD_BITS
    rest = 1 + head + 3 + line.stuffed + TAIL_BITS - nominal + 5 + 8 * length + crc_field
    return (nominal, rest) if flags & BRS else (nominal + rest, 0)


@native
def count(records: Pointer[np.uint8], n: int, bits: Pointer[int]) -> None:
    """The bits of n records of CAN_RECORD, two numbers each."""
    for k in range(n):
        at = k * RECORD
        can_id = 0
        for j in range(4):
            can_id |= int(records[at + j]) << (8 * j)
        length = int(records[at + LENGTH])
        bits[2 * k], bits[2 * k + 1] = _frame_bits(can_id, length, int(records[at + FLAGS]), records, at + DATA)


def count_bits(records: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the bits of each record at the nominal and at the data bit rate: int64[n, 2]."""
    bits = np.zeros((len(records), 2), np.int64)
    rows = np.ascontiguousarray(records)
    count(address(rows), len(rows), address(bits))
    return bits


_BITS = Cells(int, 2)


def frame_bits(record: bytes) -> tuple[int, int]:
    """Return the same of one record."""
    count(address(np.frombuffer(record, np.uint8)), 1, _BITS.at)
    nominal, fast = _BITS.array.tolist()
    return nominal, fast


def frame_seconds(records: NDArray[np.void], rates: BusRates) -> NDArray[np.float64]:
    """Return how long each record occupies a bus, in s, interframe space included: float64[n]."""
    bits = count_bits(records)
    seconds: NDArray[np.float64] = bits[:, 0] / rates.bitrate + bits[:, 1] / (rates.data_bitrate or rates.bitrate)
    return seconds
