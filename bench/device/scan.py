"""Who is on a link: a HELLO to everybody, and the answers. Changes nothing in any device."""

from __future__ import annotations

import secrets

from protocol.canmap.host import CanWire
from protocol.framing import MAJOR, Frame, parse_frame
from protocol.links.base import Link
from protocol.messages import Hello, HelloReply, MessageType, PayloadError
from protocol.wire import HostWire, StreamFrames

REPEAT = 0.1  # s between HELLOs
_TID = 1


def scan(link: Link, seconds: float = 1.0) -> list[HelloReply]:
    """Return what the devices that answer within `seconds` say of themselves, in the order of their nodes.

    On a CAN bus every device is asked at once, on a byte link each node that the first one names. Raises LinkError.
    """
    wire = link.wire()
    hello = Hello(secrets.randbits(32))
    found: dict[int, HelloReply] = {}
    asked: set[int] = set()
    link.write(wire.preamble())
    end = link.clock() + seconds
    next_hello = link.clock()
    while (now := link.clock()) < end:
        nodes = {n for reply in found.values() for n in range(1, reply.nodes + 1)} if not wire.shared else set()
        if now >= next_hello or nodes - asked - found.keys():
            next_hello = now + REPEAT
            for node in sorted(nodes - found.keys()) or [0]:
                asked.add(node)
                link.write(_ask(wire, hello, node))
        for item in wire.feed(link.read(min(REPEAT, end - now)), link.clock()):
            reply = None if isinstance(item, StreamFrames) else _answer(item, hello.nonce)
            if reply is not None:
                found[reply.node] = reply
    return [found[node] for node in sorted(found)]


def _ask(wire: HostWire, hello: Hello, node: int) -> bytes:
    frame = Frame(hello.TYPE, MAJOR, _TID, node, hello.pack())
    return wire.to_everybody(frame) if isinstance(wire, CanWire) else wire.encode(frame)


def _answer(message: bytes, nonce: int) -> HelloReply | None:
    frame = parse_frame(message)
    if frame.type != MessageType.HELLO or not frame.is_reply or frame.is_error:
        return None
    try:
        reply = HelloReply.unpack(frame.payload)
    except PayloadError:
        return None
    return reply if reply.nonce == nonce else None
