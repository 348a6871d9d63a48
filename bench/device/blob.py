"""Blobs of a node, read in parts that can be asked for again, and that a slow link carries before it asks again."""

from __future__ import annotations

from bench.device.client import Client
from protocol.canmap.host import CanWire
from protocol.framing import MAX_PAYLOAD
from protocol.messages import BlobRead, BlobReply
from protocol.wire import ByteWire, HostWire

DESCRIPTOR, CAPTURE, MEANINGS, WAVEFORM = 0, 1, 3, 4
"""Numbers of blobs."""
_PART_TAKES = 0.05  # s, at most, that a part is under way: the request is repeated after 0.1 s
_SMALLEST_PART = 16
_CAN_DATA = 7  # bytes of a message in a classic frame


def part_bytes(wire: HostWire) -> int:
    """Bytes that are asked for at once: as many as a reply holds, or as the link carries in `_PART_TAKES`."""
    in_time = float(MAX_PAYLOAD)
    if isinstance(wire, ByteWire):
        in_time = wire.baud / 10 * _PART_TAKES
    elif isinstance(wire, CanWire) and not wire.rates.fd:
        in_time = _CAN_DATA * _PART_TAKES / wire.rates.seconds(_CAN_DATA + 1, extended=wire.extended)
    return int(max(min(in_time, MAX_PAYLOAD - BlobReply.FIXED_BYTES), _SMALLEST_PART))


def read_part(client: Client, node: int, blob: int, offset: int, length: int) -> BlobReply:
    """At most `length` bytes of node number `node` from `offset` on, as many as it gives at once; none at the end.

    Raises Refused for a blob that it does not have, NoReply and LinkError.
    """
    return client.request(BlobRead(id=blob, length=length, offset=offset), node, BlobReply)
