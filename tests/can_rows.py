"""CAN frames for tests: as rows of CAN_RECORD, and as python-can's messages."""

from __future__ import annotations

from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from protocol.canmap.frame import BRS, CAN_RECORD, FD_LENGTHS, FDF

Records = NDArray[np.void]
Part = tuple[int, bytes, int]  # identifier, data, flags


def record(number: int, data: bytes = b"", flags: int = 0, length: int | None = None, time: float = 0.0) -> Records:
    """One row; `length`: of a remote frame, which has no data."""
    made = np.zeros(1, CAN_RECORD)
    made["id"], made["flags"], made["time"] = number, flags, time
    made["length"] = len(data) if length is None else length
    made["data"][0, : len(data)] = list(data)
    return made


def frame(number: int, data: bytes = b"", flags: int = 0, time: float = 0.0) -> bytes:
    return record(number, data, flags, None, time).tobytes()


def records(*frames: Part, when: float = 0.0) -> bytes:
    return b"".join(frame(*each, when) for each in frames)


def parts(data: bytes) -> list[Part]:
    rows = np.frombuffer(data, CAN_RECORD)
    return [(int(row["id"]), bytes(row["data"][: row["length"]]), int(row["flags"])) for row in rows]


def untimed(data: bytes) -> bytes:
    rows = np.frombuffer(data, CAN_RECORD).copy()
    rows["time"] = 0.0
    return rows.tobytes()


def standard(number: int, data: bytes = b"", **more: Any) -> can.Message:
    """A message with an identifier of 11 bits."""
    return can.Message(arbitration_id=number, is_extended_id=False, data=data, **more)


CLASSIC_MESSAGES = [
    *(standard(0x7A5, bytes(range(n))) for n in range(9)),
    can.Message(arbitration_id=0x1ABCDEF5, data=b"\x00\xff\x0d\x07"),
    standard(0x001, is_remote_frame=True, dlc=8),
    can.Message(arbitration_id=0x1FFFFFFF, is_remote_frame=True, dlc=0),
]
FD_MESSAGES = [
    can.Message(arbitration_id=0x123, is_extended_id=extended, is_fd=True, bitrate_switch=brs, data=bytes(range(n)))
    for n in FD_LENGTHS
    for extended in (False, True)
    for brs in (False, True)
]


def record_of(msg: can.Message) -> Records:
    number = msg.arbitration_id | msg.is_extended_id << 31 | msg.is_remote_frame << 30
    return record(number, bytes(msg.data), msg.is_fd * FDF | msg.bitrate_switch * BRS, length=msg.dlc)


def records_of(messages: list[can.Message]) -> bytes:
    return b"".join(record_of(msg).tobytes() for msg in messages)
