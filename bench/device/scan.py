"""Who is on a link: a HELLO to everybody, and the answers. Changes nothing in any device."""

from __future__ import annotations

import secrets
from dataclasses import dataclass

from bench.device.client import several_devices, unanswered
from protocol.canmap.host import CanWire
from protocol.framing import MAJOR, Frame
from protocol.host import HostSession, SeveralDevices
from protocol.links.base import Link
from protocol.messages import Hello, HelloReply
from protocol.wire import ByteWire, HostWire

REPEAT = 0.1  # s between HELLOs
MORE = 0.3  # s that further nodes are waited for after the last one that was found
AT_ONCE = 64  # HELLOs to further nodes, at most; on a UART as many as it carries with their answers:
EXCHANGE = 160  # bytes of HELLO and its reply
_TID = 1


@dataclass(frozen=True)
class Found:
    """Who is on a link: what the devices say of themselves, and words for what is wrong there."""

    replies: list[HelloReply]
    """In the order of their nodes; several devices of one node are all here."""
    several: list[str]
    """Of each node as which several devices answer."""
    advice: str
    """What to look at where nobody answers."""


def scan(link: Link, seconds: float = 1.0) -> list[HelloReply]:
    """Return the replies that `look_around` finds."""
    return look_around(link, seconds).replies


def look_around(link: Link, seconds: float = 1.0, patience: float | None = None) -> Found:
    """Return what the devices that answer within `seconds` say of themselves, in the order of their nodes.

    On a CAN bus every device is asked at once, on a byte link each node that the first one names; there the first
    answer is waited for `patience` s, None: as long as a device may take to boot. Raises LinkError.
    """
    wire = link.wire()
    session, hello = HostSession(wire), Hello(secrets.randbits(32))
    session.look_for(hello, _TID)
    several: dict[int, frozenset[int]] = {}
    found = session.devices
    heard = 0
    asked = 0  # how often nodes beside the first one were
    link.write(wire.preamble())
    began = next_hello = link.clock() + wire.delay
    end = began + (seconds if wire.shared else max(seconds, wire.patience if patience is None else patience))
    while (now := link.clock()) < end:
        if now >= next_hello:
            next_hello = now + REPEAT
            announced = {n for replies in found.values() for n in range(1, replies[-1].nodes + 1)}
            missing = sorted(announced - found.keys()) if not wire.shared else []
            for k in range(min(_at_once(wire), len(missing))):
                link.write(_ask(wire, hello, missing[(asked + k) % len(missing)]))
            asked += _at_once(wire)
            link.write(_ask(wire, hello, 0))
        before = len(found)
        data = link.read(max(0.0, min(next_hello, end) - now))
        heard += len(data)
        session.receive_data(data, link.clock())
        if len(found) > before:
            end = max(link.clock() + MORE, min(end, link.clock() + seconds) if not before else end)
        while (event := session.next_event()) is not None:
            if isinstance(event, SeveralDevices):
                several[event.node] = event.boot_ids
    replies = {
        node: [reply for reply in found[node] if reply is found[node][-1] or reply.boot_id in several.get(node, ())]
        for node in sorted(found)
    }
    words = [several_devices(node, link.name, replies.get(node, ()), boots) for node, boots in several.items()]
    return Found([reply for each in replies.values() for reply in each], words, unanswered(link, session, heard))


def _at_once(wire: HostWire) -> int:
    if not isinstance(wire, ByteWire):
        return AT_ONCE
    return round(min(AT_ONCE, max(1.0, wire.baud / 10 * REPEAT / EXCHANGE)))


def _ask(wire: HostWire, hello: Hello, node: int) -> bytes:
    frame = Frame(hello.TYPE, MAJOR, _TID, node, hello.pack())
    return wire.to_everybody(frame) if isinstance(wire, CanWire) else wire.encode(frame)
