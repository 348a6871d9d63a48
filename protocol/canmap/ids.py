"""CAN identifiers of HBP: class, node and slot in 11 bits, or the same behind a fixed prefix in 29.

    class (3 bits) | node (4 bits) | slot (4 bits)

This module knows no payload.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from protocol.canmap.frame import ERROR, EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK
from protocol.codes import MessageType

MAX_NODE = 15
BROADCAST = 0  # node of STOP and of HELLO that means every device
SLOTS = 16  # of a class and node
STREAM_SLOTS = 2 * SLOTS  # both stream classes: slot 16 is slot 0 of the second one
EXTENDED_PREFIX = 0x4842 << 11  # "HB"


class CanClass(IntEnum):
    """Class of a frame: the lower, the sooner it gets the bus."""

    STOP = 0  # from a host
    STATUS = 1  # HEARTBEAT, EVENT, LOG from a device; ALIVE, SETPOINT from a host
    TO_DEVICE = 2
    TO_HOST = 3
    EDGES = 4
    SAMPLES = 5
    SAMPLES_2 = 6
    FREE = 7  # not HBP's


class CanId(NamedTuple):
    """An identifier taken apart."""

    kind: int
    node: int
    slot: int

    def pack(self, extended: bool) -> int:
        """Return the `id` of a record."""
        base = self.kind << 8 | self.node << 4 | self.slot
        return base | EXTENDED | EXTENDED_PREFIX if extended else base


def parse_id(can_id: int, extended: bool) -> CanId | None:
    """Return the parts of a record's `id`; None if it is none of HBP's on a bus of this form."""
    if can_id & (ERROR | REMOTE) or bool(can_id & EXTENDED) != extended:
        return None
    if extended and can_id & EXTENDED_MASK & ~STANDARD_MASK != EXTENDED_PREFIX:
        return None
    kind = can_id >> 8 & 7
    return None if kind == CanClass.FREE else CanId(kind, can_id >> 4 & 15, can_id & 15)


_STATUS = (MessageType.HEARTBEAT, MessageType.ALIVE, MessageType.SETPOINT, MessageType.EVENT, MessageType.LOG)
STATUS_SLOTS: dict[int, int] = {kind: kind & 0x0F for kind in _STATUS}
"""Slot of a message in class STATUS: the low half of its type."""


def stream_id(node: int, slot: int) -> CanId:
    """Return the identifier of a frame of samples; `slot` in 0..31."""
    return CanId(CanClass.SAMPLES + slot // SLOTS, node, slot % SLOTS)
