"""CAN frames as fixed records, and how long they occupy a bus.

A `CAN_RECORD` is Linux's `struct canfd_frame` with a time of arrival: the same bits in `id` and `flags`. A row of them
is what a CAN link reads and writes, so that many frames are one numpy array. This module knows no HBP.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

MAX_DATA = 64

CAN_RECORD = np.dtype([
    ("id", "<u4"), ("length", "u1"), ("flags", "u1"), ("reserved", "<u2"), ("time", "<f8"), ("data", "u1", (MAX_DATA,)),
])  # fmt: skip
"""`length` in data bytes; `time` in s of the link's clock when the frame had arrived, 0 in frames to be sent."""

RECORD = struct.Struct(f"<IBBHd{MAX_DATA}s")
"""A CAN_RECORD as `struct` reads it, for one frame at a time."""

RECORD_BYTES = CAN_RECORD.itemsize

EXTENDED = 0x80000000  # bit of `id`: 29-bit identifier
REMOTE = 0x40000000  # bit of `id`: a remote frame, without data
ERROR = 0x20000000  # bit of `id`: an error frame, as the adapter reports it; the identifier holds ErrorKind bits
STANDARD_MASK = 0x7FF
EXTENDED_MASK = 0x1FFFFFFF

BRS = 1  # bit of `flags`: bit-rate switch
ESI = 2  # bit of `flags`: the sender is error passive
FDF = 4  # bit of `flags`: CAN FD frame

# What an error frame says, with the bits that Linux uses (include/uapi/linux/can/error.h).
ERROR_CONTROLLER = 0x004  # data[1]: ERROR_OVERFLOW or a change to warning or passive
ERROR_PROTOCOL = 0x008  # bit, stuff, form, CRC error
ERROR_NO_ACK = 0x020
ERROR_BUS_OFF = 0x040
ERROR_BUS = 0x080
ERROR_RESTARTED = 0x100
ERROR_OVERFLOW = 0x03  # bits of data[1] with ERROR_CONTROLLER: a buffer of the adapter ran over

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data bytes of a CAN FD frame by its DLC."""


def padded_length(length: int) -> int:
    """Return the shortest length of a CAN FD frame that holds `length` bytes."""
    return next(each for each in FD_LENGTHS if each >= length)


@dataclass(frozen=True, slots=True)
class BusRates:
    """Bit rates of a bus in bit/s; `data_bitrate` is that of CAN FD's data phase, None on a classic bus."""

    bitrate: int = 1_000_000
    data_bitrate: int | None = None

    @property
    def fd(self) -> bool:
        """Whether the bus carries CAN FD frames."""
        return self.data_bitrate is not None

    def __str__(self) -> str:
        text = f"{self.bitrate / 1e6:g} Mbit/s"
        return text if self.data_bitrate is None else f"FD {self.bitrate / 1e6:g}/{self.data_bitrate / 1e6:g} Mbit/s"

    def seconds(self, length: int, *, extended: bool = False, fd: bool | None = None, worst: bool = False) -> float:
        """Return how long a frame with `length` data bytes occupies the bus, interframe space included.

        With as many stuff bits as random data have on average, or with as many as there can be (`worst`). `fd`: frame
        format, that of the bus by default; FD frames switch the bit rate.
        """
        return _frame_seconds(self, length, extended, self.fd if fd is None else fd, worst)

    def occupied(self, records: NDArray[np.void]) -> float:
        """Return how long these frames occupied the bus, in s, by the average of stuff bits."""
        kinds = (records["id"] >> 31).astype(np.uint32) << 16
        kinds |= (records["flags"] & (FDF | BRS)).astype(np.uint32) << 8 | records["length"]
        keys, counts = np.unique(kinds, return_counts=True)
        total = 0.0
        for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
            fd, rate = bool(key >> 8 & FDF), bool(key >> 8 & BRS)
            rates = self if rate or not fd else BusRates(self.bitrate, self.bitrate)
            total += count * rates.seconds(key & 0xFF, extended=bool(key >> 16), fd=fd)
        return total


_RANDOM = 30  # random data have a stuff bit after so many bits on average: 2 + 4 + 8 + 16
_WORST = 4  # and the worst data have one after so many


@lru_cache(maxsize=1024)
def _frame_seconds(rates: BusRates, length: int, extended: bool, fd: bool, worst: bool) -> float:
    def stuff(bits: int) -> float:
        return bits // _WORST if worst else bits / _RANDOM

    tail = 13  # CRC delimiter, ACK and its delimiter, EOF, interframe space: never stuffed
    if not fd:
        stuffed = (54 if extended else 34) + 8 * length
        return (stuffed + stuff(stuffed - 1) + tail) / rates.bitrate
    arbitration = 36 if extended else 17  # SOF to BRS
    data = 1 + 4 + 8 * length  # ESI, DLC, data
    crc = 4 + 21 + 7 if length > 16 else 4 + 17 + 6  # stuff count, CRC, fixed stuff bits
    slow = arbitration + stuff(arbitration - 1) + tail
    return slow / rates.bitrate + (data + stuff(data) + crc) / (rates.data_bitrate or rates.bitrate)
