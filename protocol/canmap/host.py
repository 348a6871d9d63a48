"""The host's end of a CAN bus (a `protocol.wire.HostWire`). No I/O.

What the link reads are rows of CAN_RECORDs. Stream frames are sorted to their streams; those of a node of which no
heartbeat has come for a while are held back until the next one, because their counters alone do not say what time they
are of. This module never looks into a message, but for a heartbeat's time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.canmap.decoders import CanEdgeDecoder, CanFrames, CanSampleDecoder
from protocol.canmap.frame import CAN_RECORD, ERROR, FDF, STANDARD_MASK, BusRates
from protocol.canmap.ids import BROADCAST, MAX_NODE, SLOTS, STATUS_SLOTS, STREAM_SLOTS, CanClass, CanId, parse_id
from protocol.canmap.layout import sample_layout
from protocol.canmap.transport import NODE_OFFSET, CanCounters, Reassembler, TransferEncoder, pack_record
from protocol.codes import Command
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.framing import HEADER_BYTES, Frame
from protocol.messages import Heartbeat, MessageType, PayloadError, StreamEvent
from protocol.streams import Beat, StreamConfig, TickReference
from protocol.wire import PATIENCE, Decoder, StreamFrames

OVERDUE = 0.35  # s without a heartbeat after which a node's stream frames are held back: three of them, and some
MAX_BEATS = 16  # heartbeats of a node that are remembered
MAX_HELD = 1 << 15  # frames of a node

_DEVICE_STATUS = {STATUS_SLOTS[kind] for kind in (MessageType.HEARTBEAT, MessageType.EVENT, MessageType.LOG)}
_HEARTBEAT = STATUS_SLOTS[MessageType.HEARTBEAT]
_FOREIGN, _MESSAGE, _STALE = -1, -2, -3  # what an identifier is, where it belongs to no route


class _Route(NamedTuple):
    node: int
    stream: int
    type: MessageType
    ids: tuple[int, ...]


@dataclass(slots=True)
class _Node:
    """What is known of a node: its last heartbeats, when the newest came, and what is held back for the next one."""

    beats: tuple[Beat, ...] = ()
    heard: float = -1e9
    held: list[NDArray[np.void]] = field(default_factory=list)
    n_held: int = 0
    fd: bool | None = None  # format of its messages
    clock: TickReference | None = None  # the session's, once there is a stream
    boot_id: int | None = None


class CanWire:
    """HBP on CAN.

    Args:
        rates: of the bus; they decide the frame format.
        node: the device that node 0 of a message means.
        extended: 29-bit identifiers.
        host: number of this host among those on the bus, 0..15.
    """

    shared = True
    patience = PATIENCE
    delay = 0.0

    def __init__(self, rates: BusRates, node: int = 1, extended: bool = False, host: int = 0) -> None:
        self.counters = CanCounters()
        self.rates = rates
        self.extended = extended
        self.busy_seconds = 0.0
        """For how long the frames that were heard and sent occupied the bus."""
        self.node = node
        self.host = host
        self._encoder = TransferEncoder(rates.fd, extended)
        self._reassemblers: dict[CanId, Reassembler] = {}
        self._routes: list[_Route] = []
        self._meaning = self._meanings()  # of the low 11 bits of an identifier: number of a route, or what it is else
        self._nodes: dict[int, _Node] = {}

    def preamble(self) -> bytes:
        """See `HostWire.preamble`: nothing has to be written."""
        self._reassemblers.clear()
        for node in self._nodes.values():
            self._give_up(node)
        self._nodes.clear()
        return b""

    def forget(self, node: int) -> None:
        """See `HostWire.forget`: its slots may have another meaning now."""
        self._give_up(self._nodes.setdefault(node, _Node()))
        self._routes = [route for route in self._routes if route.node != node]
        self._meaning = self._meanings()

    def _give_up(self, node: _Node) -> None:
        self.counters.overdue += node.n_held
        node.held, node.n_held = [], 0

    def encode(self, frame: Frame) -> bytes:
        """See `HostWire.encode`. A STOP goes ahead of all else, then again as a request that is answered."""
        node = frame.node or self.node
        if node > MAX_NODE:
            raise LocalProtocolError(f"there is no node {node} on a CAN bus: they are 1 to {MAX_NODE}")
        return self._encoded(frame, node)

    def to_everybody(self, frame: Frame) -> bytes:
        """Return what is written for a HELLO that every device on the bus answers."""
        return self._encoded(frame, BROADCAST)

    def _encoded(self, frame: Frame, node: int) -> bytes:
        can_id = CanId(CanClass.TO_DEVICE, node, self.host)
        if frame.type in STATUS_SLOTS:
            can_id = CanId(CanClass.STATUS, node, STATUS_SLOTS[frame.type])
        wire = self._encoder.encode(can_id, frame._replace(node=node).pack())
        if frame.type == MessageType.STATE_CMD and frame.payload[:1] == bytes((Command.STOP,)):
            wire = stop_record(node, self.extended, self.rates.fd) + wire
        self.busy_seconds += self.rates.occupied(np.frombuffer(wire, CAN_RECORD))
        return wire

    def feed(self, data: bytes, now: float) -> list[bytes | StreamFrames]:
        """See `HostWire.feed`."""
        records = np.frombuffer(data, CAN_RECORD)
        self.busy_seconds += self.rates.occupied(records[records["id"] & ERROR == 0])
        meaning = self._look(records)
        out: list[bytes | StreamFrames] = []
        done = 0
        for at in np.flatnonzero(meaning == _MESSAGE).tolist():
            record = records[at]
            message = self._receive(record)
            if message is None:
                continue
            out += self._streams(records[done:at], meaning[done:at], now)
            done = at
            out.append(message)
            if message[0] == MessageType.HEARTBEAT:
                out += self._heartbeat(message, float(record["time"]))
        return out + self._streams(records[done:], meaning[done:], now)

    def _meanings(self) -> NDArray[np.int16]:
        """Return the table of what the identifiers mean."""
        self._routes_of = {
            node: [number for number, route in enumerate(self._routes) if route.node == node]
            for node in {route.node for route in self._routes}
        }
        table = np.full(STANDARD_MASK + 1, _FOREIGN, np.int16)
        for can_id in range(STANDARD_MASK + 1):
            parts = parse_id(can_id, extended=False)
            if parts is None or parts.node == BROADCAST:
                continue
            status = parts.kind == CanClass.STATUS and parts.slot in _DEVICE_STATUS
            if status or (parts.kind == CanClass.TO_HOST and parts.slot == self.host):
                table[can_id] = _MESSAGE
            elif parts.kind >= CanClass.EDGES:
                table[can_id] = _STALE
        for number, route in enumerate(self._routes):
            table[[can_id & STANDARD_MASK for can_id in route.ids]] = number
        return table

    def _look(self, records: NDArray[np.void]) -> NDArray[np.int16]:
        """Return what each frame's identifier means; those that are none of ours are counted."""
        ids = records["id"]
        meaning: NDArray[np.int16] = self._meaning[ids & STANDARD_MASK]
        other = (ids & ~np.uint32(STANDARD_MASK)) != CanId(0, 0, 0).pack(self.extended)
        if other.any():
            meaning[other] = _FOREIGN
            errors = int(((ids & ERROR) != 0).sum())
            self.counters.error_frames += errors
            self.counters.foreign -= errors
        foreign = int((meaning == _FOREIGN).sum())
        self.counters.foreign += foreign
        self.counters.frames += len(records) - foreign
        return meaning

    def _receive(self, record: np.void) -> bytes | None:
        """Take a frame of a message; return the message that it completes."""
        parts = parse_id(int(record["id"]), self.extended)
        assert parts is not None
        if parts not in self._reassemblers:
            self._reassemblers[parts] = Reassembler(parts.node, self.counters)
        message = self._reassemblers[parts].feed(record["data"][: record["length"]].tobytes())
        if message is not None:
            self._nodes.setdefault(parts.node, _Node()).fd = bool(record["flags"] & FDF)
        return message

    def _heartbeat(self, message: bytes, time: float) -> list[StreamFrames]:
        """Note a heartbeat; return what was held back for it."""
        try:
            heartbeat = Heartbeat.unpack(message[HEADER_BYTES:])
        except PayloadError:  # the session counts it
            return []
        node = self._nodes[message[NODE_OFFSET]]
        first = not node.beats
        same, node.boot_id = heartbeat.boot_id == node.boot_id, heartbeat.boot_id
        tick = node.clock.as_it_can_be(heartbeat.tick) if same and node.clock else heartbeat.tick
        before = (beat for beat in node.beats if beat.tick <= tick)  # of others the time has turned out to be wrong
        node.beats = (*before, Beat(tick, heartbeat.edges))[-MAX_BEATS:]
        node.heard = time
        if not node.held:
            return []
        records = np.concatenate(node.held)
        if first and time - float(records["time"][0]) > OVERDUE:
            self._give_up(node)
            return []
        node.held, node.n_held = [], 0
        return self._by_stream(records, self._meaning[records["id"] & STANDARD_MASK], node.beats, held=True)

    def _streams(self, records: NDArray[np.void], meaning: NDArray[np.int16], now: float) -> list[StreamFrames]:
        """Return the stream frames among these by stream, but for those that are held back."""
        out: list[StreamFrames] = []
        self.counters.stale += int((meaning == _STALE).sum())
        for number, routes in self._routes_of.items():
            chosen = np.isin(meaning, routes) if len(self._routes_of) > 1 else meaning >= 0
            if not chosen.any():
                continue
            node = self._nodes.setdefault(number, _Node())
            if not node.beats or node.held or now - node.heard > OVERDUE:
                self._hold(node, records[chosen])
            else:
                out += self._by_stream(records[chosen], meaning[chosen], node.beats)
        return out

    def _by_stream(
        self, records: NDArray[np.void], meaning: NDArray[np.int16], beats: tuple[Beat, ...], held: bool = False
    ) -> list[StreamFrames]:
        """Return frames by stream, those of edges first."""
        out: list[StreamFrames] = []
        left = len(records)
        for number, route in enumerate(self._routes):
            mine = records[meaning == number]
            left -= len(mine)
            if len(mine):
                out.append(StreamFrames(route.node, route.stream, route.type, CanFrames(mine, beats, held)))
        self.counters.stale += left
        return out

    def _hold(self, node: _Node, records: NDArray[np.void]) -> None:
        room = MAX_HELD - node.n_held
        self.counters.overdue += max(0, len(records) - room)
        if room > 0:
            node.held.append(records[:room])
            node.n_held += len(node.held[-1])

    def decoder(self, config: StreamConfig, reference: TickReference) -> Decoder:
        """See `HostWire.decoder`. Raises RemoteProtocolError if host and device are not of one mind on the format."""
        node = self._nodes.setdefault(config.node, _Node())
        node.clock = reference
        node.beats = tuple(beat for beat in node.beats if reference.as_it_can_be(beat.tick) == beat.tick)
        config = replace(config, tick0=config.tick0 - reference.shift)
        if node.fd is not None and node.fd != self.rates.fd:
            here, there = ("CAN FD", "classic CAN") if self.rates.fd else ("classic CAN", "CAN FD")
            fix = "remove fd=1 from" if self.rates.fd else "add fd=1 and data_bitrate to"
            raise RemoteProtocolError(f"the device sends {there} frames, {here} was asked for: {fix} the target")
        slots = SLOTS if config.event == StreamEvent.EDGES else STREAM_SLOTS
        if config.slot >= slots:
            raise RemoteProtocolError(f"stream {config.stream}: the device gives it slot {config.slot} of {slots}")
        decoder: CanSampleDecoder | CanEdgeDecoder
        if config.event == StreamEvent.EDGES:
            kind = MessageType.EDGES
            decoder = CanEdgeDecoder(config, reference, self.extended)
        else:
            kind = MessageType.DATA
            widths = [np.dtype(channel.raw.dtype).itemsize for channel in config.channels]
            layout = sample_layout(widths, self.rates.fd, config.block)
            if layout.samples != config.block:
                raise RemoteProtocolError(
                    f"stream {config.stream}: {config.block} samples a frame by the device, but {layout.samples} fit"
                )
            decoder = CanSampleDecoder(config, layout, reference, self.extended)
        others = [route for route in self._routes if (route.node, route.stream) != (config.node, config.stream)]
        # edges first, so that they never trail samples
        self._routes = sorted([*others, _Route(config.node, config.stream, kind, decoder.ids)], key=lambda r: -r.type)
        self._meaning = self._meanings()
        return decoder

    def advice(self, heard: bool) -> str:
        """See `HostWire.advice`."""
        if heard:
            return f"check that node {self.node} is an HBP device, and its frame format and identifiers"
        return "check power, cable, termination, the bit rates and the node"

    def unanswered(self, nodes: Sequence[int]) -> str:
        """See `HostWire.unanswered`."""
        if self.node in nodes:
            what = f"node {self.node} is heard, and does not hear this program"
            mixed = "; or two devices have this number, and what they send is mixed" if self.counters.bad else ""
            return f"{what}: check the adapter's TX wire, and that it may send{mixed}"
        there = ", ".join(map(str, nodes))
        return f"node {self.node} is not there, but {there}: add node={nodes[0]} to the target"


def stop_record(node: int, extended: bool, fd: bool) -> bytes:
    """Return the frame that stops a node, or every node (BROADCAST), whatever else is on the bus."""
    return pack_record(CanId(CanClass.STOP, node, 0).pack(extended), b"", fd)
