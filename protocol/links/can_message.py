"""CAN frames between our records and python-can's messages, and what an error frame says.

This module opens no bus and keeps nothing. It knows no HBP.
"""

from __future__ import annotations

from collections.abc import Iterator

import can

from protocol.canmap.frame import (
    BRS,
    ERROR,
    ERROR_BUS,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_NO_ACK,
    ERROR_OVERFLOW,
    ERROR_PROTOCOL,
    ERROR_RESTARTED,
    ESI,
    EXTENDED,
    EXTENDED_MASK,
    FDF,
    MAX_DATA,
    RECORD,
    REMOTE,
    STANDARD_MASK,
    padded_length,
)

ERROR_KINDS = (
    "protocol", "no ack", "controller warning", "controller passive", "bus-off", "restarted", "overflow", "other",
)  # fmt: skip
"""What `error_kind` tells apart."""

WITH_KINDS = frozenset({"socketcan", "socketcand", "virtual"})
"""Interfaces of python-can whose error frames carry Linux's bits."""

_GRAVEST_FIRST = (
    ("bus-off", ERROR_BUS_OFF, 0),
    ("restarted", ERROR_RESTARTED, 0),
    ("overflow", ERROR_CONTROLLER, ERROR_OVERFLOW),
    ("controller passive", ERROR_CONTROLLER, 0x30),
    ("controller warning", ERROR_CONTROLLER, 0x0C),
    ("no ack", ERROR_NO_ACK, 0),
    ("protocol", ERROR_PROTOCOL | ERROR_BUS, 0),
)
"""Kinds of error frames: bits of the identifier, and of data[1] where those alone do not say it (else 0)."""


def to_record(message: can.Message, when: float, with_kinds: bool = True) -> bytes:
    """Return a message as a CAN_RECORD; `when` is its time in s. CAN FD data are padded to a length that there is.

    `with_kinds`: the identifier of an error frame is Linux's; where it is the driver's own it is left out.

    Raises:
        ValueError: an identifier or a length that CAN does not have.
    """
    number, data = message.arbitration_id, message.data
    if message.is_error_frame:
        number = ERROR | (number & EXTENDED_MASK if with_kinds else 0)
    else:
        if not 0 <= number <= (EXTENDED_MASK if message.is_extended_id else STANDARD_MASK):
            raise ValueError(f"no CAN identifier: {number:#x}")
        number |= (EXTENDED if message.is_extended_id else 0) | (REMOTE if message.is_remote_frame else 0)
    if len(data) > (MAX_DATA if message.is_fd else 8):
        raise ValueError(f"no length of a CAN frame: {len(data)}")
    length, flags = len(data), 0
    if message.is_remote_frame:
        length = min(message.dlc, 8)
    elif message.is_fd:
        length = padded_length(length)
        flags = FDF | BRS * message.bitrate_switch | ESI * message.error_state_indicator
    return RECORD.pack(number, length, flags, 0, when, bytes(data))


def to_messages(records: bytes) -> Iterator[can.Message]:
    """Give rows of CAN_RECORD as python-can's messages, to be sent."""
    for number, length, flags, _, _, data in RECORD.iter_unpack(records):
        remote, extended = bool(number & REMOTE), bool(number & EXTENDED)
        yield can.Message(
            arbitration_id=number & (EXTENDED_MASK if extended else STANDARD_MASK),
            is_extended_id=extended,
            is_remote_frame=remote,
            is_error_frame=bool(number & ERROR),
            is_fd=bool(flags & FDF),
            bitrate_switch=bool(flags & BRS),
            error_state_indicator=bool(flags & ESI),
            dlc=length,
            data=None if remote else data[:length],
            is_rx=False,
        )


def error_kind(number: int, detail: int) -> str:
    """Return which of `ERROR_KINDS` an error frame is, by its `id` and data[1]: the gravest thing that it says."""
    for kind, bits, details in _GRAVEST_FIRST:
        if number & bits and (not details or detail & details):
            return kind
    return "other"
