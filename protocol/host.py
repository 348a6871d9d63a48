"""The host's end of a session, without I/O: bytes and times in, events and bytes out.

One request is outstanding at a time; it is repeated with the same tid until its reply comes or three tries
are spent. Stream frames are not decoded here, only collected: one event per stream and call. Whatever
arrives damaged, late or unasked is counted and dropped. This module never sleeps and never reads a clock.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from protocol.errors import DeviceDefect, HbpError, LocalProtocolError
from protocol.framing import MAJOR, Frame, ReceiverCounters, parse_frame
from protocol.messages import (
    REPLIES,
    UNACKNOWLEDGED,
    UNSOLICITED,
    DeviceEvent,
    ErrorCode,
    ErrorReply,
    Heartbeat,
    Hello,
    HelloReply,
    Log,
    Message,
    MessageType,
    Payload,
    PayloadError,
    Request,
    TimeSyncReply,
)
from protocol.streams import QUEUED, StreamConfig, TickReference, WrongTime
from protocol.validity import check_reply
from protocol.wire import ByteWire, Decoder, HostWire, StreamFrames

TRIES = 3
BASE_TIMEOUT = 0.1  # s, to which two round trips are added
COMMIT_TIMEOUT = 2.0  # s likewise, of PARAM_COMMIT: flash is slow
MAX_ROUND_TRIP = 1.0  # s, as far as timeouts go
_ECHOED = ("nonce", "id", "offset", "stream")  # fields of requests that come back in their replies
HELLO_INTERVALS = (0.1, 0.2, 0.4, 0.8, 1.0)  # s between HELLOs; the last one goes on
AGAIN = 0.25  # s between HELLOs, at most, while something is heard: a device that has just booted is asked soon
IN_TURN = 2.0  # s in which boot_ids that come in turn are those of several devices: a device boots no faster
RETURNS = 3  # of heartbeats to a boot_id that was there before; a single one may have been late


class Connected(NamedTuple):
    """The device answered `connect`."""

    hello: HelloReply


class ReplyReceived(NamedTuple):
    """The reply to request `tid`; `round_trip` in s from its last transmission."""

    tid: int
    node: int
    message: Payload
    round_trip: float


class RequestRefused(NamedTuple):
    """The device refused request `tid`."""

    tid: int
    node: int
    error: ErrorReply


class RequestTimedOut(NamedTuple):
    """Request `tid` of type `type` had no reply after `tries` transmissions."""

    tid: int
    node: int
    type: MessageType
    tries: int


class ReplyUnusable(NamedTuple):
    """Request `tid` was answered with what a host cannot work with. It is not repeated: nothing would change."""

    tid: int
    node: int
    error: HbpError


class HeartbeatReceived(NamedTuple):
    """A device's health."""

    node: int
    heartbeat: Heartbeat


class DeviceEventReceived(NamedTuple):
    """Something happened at a device."""

    node: int
    event: DeviceEvent


class LogReceived(NamedTuple):
    """A device's line of text."""

    node: int
    log: Log


class Rebooted(NamedTuple):
    """A device has another boot_id than before: whatever was set up in it is gone."""

    node: int
    old: int
    new: int


class SeveralDevices(NamedTuple):
    """Several devices answer as one node: two answers to one HELLO, or their boot_ids in turn."""

    node: int
    boot_ids: frozenset[int]
    reboots: int
    """How often that was taken for a reboot before."""


Event = (
    Connected
    | ReplyReceived
    | RequestRefused
    | RequestTimedOut
    | ReplyUnusable
    | HeartbeatReceived
    | DeviceEventReceived
    | LogReceived
    | StreamFrames
    | Rebooted
    | SeveralDevices
)


@dataclass(slots=True)
class HostCounters:
    """Frames that were intact but dropped, and requests that were repeated."""

    framing: ReceiverCounters
    unexpected_replies: int = 0  # to no outstanding request, or to another nonce
    malformed: int = 0  # payload that its message does not allow
    unknown_types: int = 0
    other_versions: int = 0
    retries: int = 0


@dataclass(slots=True)
class _Pending:
    message: Request
    frame: Frame
    connecting: bool
    sent: float
    deadline: float
    tries: int = 1
    answers: dict[int, HelloReply] = field(default_factory=dict)  # to a HELLO, by node: the first of each


class HostSession:
    """One link's host end. Feed it with `receive_data` and `tick`; empty `next_event` and `data_to_send`.

    `wire` is the link's language, that of byte links by default.
    """

    def __init__(self, wire: HostWire | None = None) -> None:
        self.wire: HostWire = ByteWire() if wire is None else wire
        self.counters = HostCounters(self.wire.counters)
        self.hellos: dict[int, HelloReply] = {}  # newest reply by node
        self.devices: dict[int, list[HelloReply]] = {}
        """By node, what each boot of each device that answered has said, the newest last."""
        self.heard: set[int] = set()
        """Nodes of which something has come that only a device sends."""
        self.echoes = 0
        """Requests that came back: those of this host, or another one's."""
        self.round_trip = 0.0  # s, smoothed
        self._boot_ids: dict[int, int] = {}
        self._beats: dict[int, list[tuple[float, int]]] = {}  # by node, when heartbeats began to have which boot_id
        self._several: dict[int, frozenset[int]] = {}
        self._hello: _Pending | None = None  # the last one, answered or not
        self._references: dict[int, TickReference] = {}
        self._events: deque[Event] = deque()
        self._out: list[bytes] = []
        self._pending: _Pending | None = None
        self._tid = 0
        self._now = 0.0

    @property
    def busy(self) -> bool:
        """Whether a request is outstanding."""
        return self._pending is not None

    def tick_reference(self, node: int) -> TickReference:
        """Return the node's tick reference, kept fresh by its heartbeats and TIME_SYNC replies."""
        if node not in self._references:
            self._references[node] = TickReference(now=self._now)
        return self._references[node]

    def wrong_times(self) -> list[tuple[int, WrongTime]]:
        """Return and forget what was dated as it cannot be, with its node."""
        found = [(node, wrong) for node, reference in self._references.items() for wrong in reference.wrong]
        for _, reference in self._references.items() if found else ():
            reference.wrong.clear()
        return found

    def connect(self, nonce: int, now: float, node: int = 0, delay: float = 0.0) -> int:
        """Say HELLO until it is answered, for the first time after `delay` s; return the tid.

        What was outstanding is abandoned. `nonce` must be new and unguessed by older traffic; `now` in s, of any
        monotonic clock.
        """
        self._pending = None
        self._tid = nonce & 0xFFFF if self.wire.shared else self._tid
        return self._transmit(Hello(nonce), node, now, connecting=True, delay=delay)

    def look_for(self, hello: Hello, tid: int) -> None:
        """Note in `devices` who answers this HELLO, which the caller sends, as often as it likes, to whomever."""
        self._hello = _Pending(hello, Frame(hello.TYPE, MAJOR, tid, 0, b""), True, 0.0, 0.0, tries=TRIES)

    def request(self, message: Request, node: int, now: float) -> int:
        """Send a request and return its tid; node 0 is the device at the other end.

        Raises LocalProtocolError if one is outstanding or the message is unacknowledged.
        """
        if self._pending is not None:
            busy = self._pending.message.TYPE.name
            raise LocalProtocolError(f"{message.TYPE.name} cannot be sent while {busy} waits for its reply")
        if message.TYPE in UNACKNOWLEDGED:
            raise LocalProtocolError(f"{message.TYPE.name} has no reply: use send")
        return self._transmit(message, node, now, connecting=False)

    def send(self, message: Request, node: int) -> None:
        """Send an unacknowledged message (ALIVE, SETPOINT)."""
        if message.TYPE not in UNACKNOWLEDGED:
            raise LocalProtocolError(f"{message.TYPE.name} has a reply: use request")
        self._out.append(self.wire.encode(Frame(message.TYPE, MAJOR, 0, node, message.pack())))

    def cancel(self) -> None:
        """Abandon the outstanding request, if any; a late reply counts as unexpected."""
        self._pending = None

    def data_to_send(self) -> bytes:
        """Return and forget the bytes that are to be written."""
        data = b"".join(self._out)
        self._out.clear()
        return data

    def next_event(self) -> Event | None:
        """Return and forget the oldest event, None if there is none."""
        return self._events.popleft() if self._events else None

    def tick(self, now: float) -> None:
        """Repeat or give up the outstanding request, if it is time."""
        pending = self._pending
        if pending is None or now < pending.deadline:
            return
        if not pending.connecting and pending.tries >= TRIES:
            self._pending = None
            kind = pending.message.TYPE
            self._events.append(RequestTimedOut(pending.frame.tid, pending.frame.node, kind, pending.tries))
            return
        if pending.connecting and not pending.tries:
            self._out.append(self.wire.preamble())
        self._out.append(self.wire.encode(pending.frame))
        self.counters.retries += pending.tries > 0
        pending.sent = now
        pending.tries += 1
        pending.deadline = now + self._timeout(pending)

    def receive_data(self, data: bytes, now: float) -> None:
        """Take bytes from the link, cut anywhere."""
        for reference in self._references.values():
            reference.now = now
        self._now = now
        for item in self.wire.feed(data, now):
            if isinstance(item, StreamFrames):
                self._hear(item.node, now)
                self._events.append(item)
            else:
                self._receive(parse_frame(item), now)

    def decoder(self, config: StreamConfig) -> Decoder:
        """Return a decoder for the frames of a stream, as it was just configured."""
        return self.wire.decoder(config, self.tick_reference(config.node))

    def _receive(self, frame: Frame, now: float) -> None:
        counters = self.counters
        if frame.major != MAJOR and frame.type != MessageType.HELLO:
            counters.other_versions += 1
        elif frame.is_error and not frame.is_reply:
            counters.malformed += 1
        elif frame.is_reply:
            self._hear(frame.node, now)
            self._receive_reply(frame, now)
        elif frame.type in UNSOLICITED:
            self._hear(frame.node, now)
            try:
                message = UNSOLICITED[frame.type].unpack(frame.payload)
            except PayloadError as error:
                counters.malformed += 1
                self.tick_reference(frame.node).cannot_be(f"{MessageType(frame.type).name} ({error})")
            else:
                self._receive_unsolicited(frame.node, message, now)
        elif frame.type in (MessageType.DATA, MessageType.EDGES):
            counters.malformed += 1
        else:
            self.echoes += frame.type in REPLIES
            counters.unknown_types += 1

    def _hear(self, node: int, now: float) -> None:
        """Something of a device has come: if HELLO waits for its answer, ask again soon."""
        self.heard.add(node)
        pending = self._pending
        if pending is not None and pending.connecting and pending.tries:
            pending.deadline = min(pending.deadline, max(now, pending.sent + AGAIN))

    def _receive_unsolicited(self, node: int, message: Message, now: float) -> None:
        if isinstance(message, Heartbeat):
            self._note_beat(node, message.boot_id, now)
            tick = self.tick_reference(node).hear(message.tick, "a heartbeat")
            self._events.append(HeartbeatReceived(node, replace(message, tick=tick)))
        elif isinstance(message, DeviceEvent):
            tick = self.tick_reference(node).hear(message.tick, "an event", QUEUED)
            self._events.append(DeviceEventReceived(node, replace(message, tick=tick)))
        elif isinstance(message, Log):
            self._events.append(LogReceived(node, message))

    def _receive_reply(self, frame: Frame, now: float) -> None:
        pending = self._pending
        if frame.type == MessageType.HELLO and not frame.is_error:
            self._note_hello(frame)
        if pending is None or frame.tid != pending.frame.tid or frame.type != pending.message.TYPE:
            self.counters.unexpected_replies += 1
            return
        try:
            message = (ErrorReply if frame.is_error else REPLIES[frame.type]).unpack(frame.payload)
        except PayloadError as error:
            name = pending.message.TYPE.name
            self._unusable(frame, DeviceDefect(f"the reply of node {frame.node} to {name} cannot be read: {error}"))
            return
        other_node = pending.frame.node not in (0, frame.node)
        if isinstance(message, ErrorReply) and message.code == ErrorCode.UNKNOWN_NODE:
            other_node = False  # the link's first device answers for one that is not there
        echoed = ((getattr(pending.message, name, None), getattr(message, name, None)) for name in _ECHOED)
        if other_node or any(asked != answered and None not in (asked, answered) for asked, answered in echoed):
            self.counters.unexpected_replies += 1  # meant for another host
            return
        if isinstance(message, ErrorReply):
            self._pending = None
            self._events.append(RequestRefused(frame.tid, frame.node, message))
            return
        try:
            check_reply(message, frame.node)
        except HbpError as error:
            self._unusable(frame, error)
            return
        self._pending = None
        round_trip = now - pending.sent
        if pending.tries == 1 and frame.type != MessageType.PARAM_COMMIT:  # else it says nothing of the link
            smoothed = 0.75 * self.round_trip + 0.25 * round_trip if self.round_trip else round_trip
            self.round_trip = min(smoothed, MAX_ROUND_TRIP)
        if isinstance(message, HelloReply):
            self.hellos[frame.node] = message
            self.tick_reference(frame.node).tick_hz = message.tick_hz
        elif isinstance(message, TimeSyncReply):
            sent = self.tick_reference(frame.node).hear(message.tx_tick, "the reply to TIME_SYNC")
            message = replace(message, rx_tick=message.rx_tick - message.tx_tick + sent, tx_tick=sent)
        if pending.connecting and isinstance(message, HelloReply):
            self._events.append(Connected(message))
        else:
            self._events.append(ReplyReceived(frame.tid, frame.node, message, round_trip))

    def _unusable(self, frame: Frame, error: HbpError) -> None:
        self.counters.malformed += 1
        self._pending = None
        self._events.append(ReplyUnusable(frame.tid, frame.node, error))

    def _note_hello(self, frame: Frame) -> None:
        """A HELLO reply, asked for or the second one: who is there, and whether that is one device."""
        asked = self._hello
        try:
            reply = HelloReply.unpack(frame.payload)
        except PayloadError:
            return
        if asked is None or reply.nonce != getattr(asked.message, "nonce", None) or reply.node != frame.node:
            return
        said = self.devices.setdefault(frame.node, [])
        before = [each for each in said if (each.boot_id, each.serial) == (reply.boot_id, reply.serial)]
        self.devices[frame.node] = [*(each for each in said if each not in before), reply]
        first = asked.answers.setdefault(frame.node, reply)
        if asked.tries == 1 and (first.boot_id, first.serial) != (reply.boot_id, reply.serial):
            self._tell_several(frame.node, {first.boot_id, reply.boot_id}, 0)
        elif any(each.boot_id == reply.boot_id and each.serial != reply.serial for each in said):
            self._tell_several(frame.node, {reply.boot_id}, 0)  # nobody changes that
        self._note_boot(frame.node, reply.boot_id)

    def _note_boot(self, node: int, boot_id: int) -> None:
        old = self._boot_ids.setdefault(node, boot_id)
        if old != boot_id and node not in self._several:
            self._boot_ids[node] = boot_id
            self.wire.forget(node)
            self.tick_reference(node).restart()
            self._events.append(Rebooted(node, old, boot_id))

    def _note_beat(self, node: int, boot_id: int, now: float) -> None:
        """A heartbeat's boot_id: where those of more than one boot come back and back, they are of several devices."""
        beats = [each for each in self._beats.get(node, ()) if now - each[0] < IN_TURN]
        if not beats or beats[-1][1] != boot_id:
            self._beats[node] = beats = [*beats, (now, boot_id)]
        boots = [each for _, each in beats]
        back = [each for k, each in enumerate(boots) if each in boots[:k]]
        if len(back) >= RETURNS and len(set(back)) > 1:
            self._tell_several(node, set(boots), len(boots) - 2)
        self._note_boot(node, boot_id)

    def _tell_several(self, node: int, boot_ids: set[int], reboots: int) -> None:
        known = self._several.get(node, frozenset())
        if not boot_ids <= known:
            self._several[node] = known | boot_ids
            self._events.append(SeveralDevices(node, self._several[node], reboots))

    def _transmit(self, message: Request, node: int, now: float, connecting: bool, delay: float = 0.0) -> int:
        tid = self._tid % 0xFFFF + 1
        frame = Frame(message.TYPE, MAJOR, tid, node, message.pack())
        self._tid = tid
        pending = self._pending = _Pending(message, frame, connecting, now, now + delay, tries=0)
        if message.TYPE == MessageType.HELLO:
            self._hello = pending
        self.tick(now)
        return tid

    def _timeout(self, pending: _Pending) -> float:
        if pending.connecting:
            return HELLO_INTERVALS[min(pending.tries, len(HELLO_INTERVALS)) - 1]
        commits = pending.message.TYPE == MessageType.PARAM_COMMIT
        return (COMMIT_TIMEOUT if commits else BASE_TIMEOUT) + 2 * self.round_trip
