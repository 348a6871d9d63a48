"""The device's end of a session, without I/O: one `DeviceSession` a node, one `DeviceLink` a link.

Requests are answered at most once: the last four replies are kept and sent again to a repeated request. Every
refusal is an explicit code; silence follows only a damaged frame. Time is the device's own tick, an argument.
This module never controls a motor: that is the `DeviceApp`'s.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.descriptor import Descriptor
from protocol.device.app import DeviceApp, Extras, Identity
from protocol.device.blobs import CONTROL, Blobs, meanings_blob
from protocol.device.capture import Capture
from protocol.device.carrier import ByteCarrier, Carrier
from protocol.device.parameters import ParameterTable
from protocol.device.records import Samples
from protocol.device.state import StateMachine
from protocol.device.streams import StreamTable
from protocol.device.tx import TxQueue
from protocol.errors import Refused
from protocol.framing import ERROR, MAJOR, MINOR, REPLY, Deframer, Frame, ReceiverCounters, parse_frame
from protocol.messages import (
    REQUESTS,
    UNACKNOWLEDGED,
    Alive,
    BlobRead,
    BlobWrite,
    CaptureArm,
    CaptureStatus,
    Command,
    DeviceEvent,
    DriveState,
    Empty,
    ErrorCode,
    ErrorReply,
    EventCode,
    Fault,
    Feature,
    Heartbeat,
    Hello,
    HelloReply,
    Log,
    Message,
    MessageType,
    ParamCommit,
    ParamGet,
    ParamSet,
    Payload,
    PayloadError,
    Request,
    Setpoint,
    StateCommand,
    StateReply,
    StreamGet,
    StreamSet,
    StreamStart,
    StreamStop,
    TimeSync,
    TimeSyncReply,
)
from protocol.validity import MIN_RX_MAX

__all__ = ["DeviceApp", "DeviceLink", "DeviceSession", "Identity", "TxQueue"]

HEARTBEATS_PER_SECOND = 10
REPLIES_KEPT = 4


@dataclass(slots=True)
class _Peer:
    """What is remembered of a host: its last HELLO, and the last requests with their replies."""

    tx_max: int
    hello: tuple[int, int] | None = None  # nonce and rx_max
    replies: deque[tuple[bytes, bytes]] = field(default_factory=lambda: deque(maxlen=REPLIES_KEPT))


class DeviceSession:
    """One device on a link. `link_counters` are those of the link's receiver, for the heartbeat."""

    def __init__(self, app: DeviceApp, identity: Identity, carrier: Carrier, link_counters: ReceiverCounters) -> None:
        if identity.tick_hz % identity.pwm_hz:
            raise ValueError(f"tick_hz {identity.tick_hz} is no multiple of pwm_hz {identity.pwm_hz}")
        for text in (identity.name, identity.firmware, identity.serial, identity.build):
            if CONTROL.search(text):
                raise ValueError(f"control characters in {text!r}")
        self.app = app
        extras = Extras.of(app)
        self.identity = identity = replace(identity, features=extras.features(identity))
        self.nodes = 1  # on the link
        self.tx = carrier.tx
        self.descriptor = Descriptor.of(app.channels, app.parameters)
        self.machine = StateMachine(app, identity.boot_id, identity.tick_hz, self._changed)
        self.streams = StreamTable(identity, app.channels, carrier)
        self.parameters = ParameterTable(app, self.event)
        self.capture = None
        if identity.features & Feature.CAPTURE:
            self.capture = Capture(identity, app.channels, extras.fault_channels, lambda: self.machine.faults)
        self.ignored = 0  # frames that are replies themselves
        self.setpoints_rejected = 0
        self._encode = carrier.encode
        self._link_counters = link_counters
        self._blobs = self._make_blobs(extras)
        self._tick = 0
        self._next_heartbeat = 0
        self._setpoint_counter = 0
        self._last_tid = 0
        self._running = False
        self._in_use: tuple[frozenset[str], ...] = (frozenset(),) * 3  # of streams, of the capture, of both
        self._peers: defaultdict[int, _Peer] = defaultdict(lambda: _Peer(identity.tx_max))
        self._peer = self._peers[0]
        self._handlers: dict[type[Request], Callable[[Any], Payload | None]] = {
            Hello: self._hello,
            TimeSync: lambda _: TimeSyncReply(self._tick, self._tick),
            Alive: lambda _: self.machine.feed(self._tick),
            BlobRead: lambda asked: self._blobs.read(asked, self._peer.tx_max),
            ParamGet: self.parameters.get,
            ParamSet: lambda asked: self.parameters.set(asked, self.state),
            ParamCommit: self._param_commit,
            StateCommand: lambda asked: StateReply(self.machine.command(asked.command, asked.argument, self._tick)),
            Setpoint: self._setpoint,
            StreamSet: lambda asked: self.streams.configure(asked, self._peer.tx_max),
            StreamStart: lambda asked: self.streams.start(asked.mask),
            StreamStop: lambda asked: self.streams.stop(asked.mask),
            StreamGet: lambda asked: self.streams.describe(asked.stream, self._peer.tx_max),
        }
        if capture := self.capture:
            self._handlers[CaptureArm] = lambda asked: capture.arm(asked, self._peer.tx_max)
            self._handlers[CaptureStatus] = lambda _: capture.describe(self._peer.tx_max)
        if identity.features & Feature.WAVEFORM:
            self._handlers[BlobWrite] = self._blobs.write

    @property
    def state(self) -> DriveState:
        """The state now."""
        return self.machine.state

    @property
    def channels(self) -> frozenset[str]:
        """Names of the channels that are in use: those that streams are configured with, and those of the capture."""
        streams, capture = self.streams.channels, self.capture.channels if self.capture else frozenset()
        if self._in_use[0] is not streams or self._in_use[1] is not capture:
            self._in_use = streams, capture, streams | capture
        return self._in_use[2]

    def advance(self, tick: int) -> None:
        """Let time pass up to the device's 64-bit `tick`: watchdog, lapse, late stream blocks, heartbeat."""
        self._tick = tick
        self.machine.advance(tick)
        self.streams.advance(tick)
        if self.capture and self.capture.news:
            self.capture.news = False
            self.event(EventCode.CAPTURED, float(self.capture.number), float(self.capture.trigger))
        if tick >= self._next_heartbeat:
            period = self.identity.tick_hz // HEARTBEATS_PER_SECOND
            self._next_heartbeat = tick - tick % period + period
            frame = Frame(MessageType.HEARTBEAT, MAJOR, 0, self.identity.node, self.heartbeat().pack())
            self.tx.put_latest(self.identity.node, self._encode(frame))

    def push_samples(self, index0: int, tick0: int, samples: Samples) -> None:
        """Take n samples of consecutive PWM periods, one field per channel of the app, in its order; they are kept.

        `index0`, `tick0`: PWM-period count and tick of the first. All edges up to the last sample's tick
        must have been pushed before.
        """
        self.streams.push_samples(index0, tick0, samples, self.channels)  # the capture keeps what is made here
        if self.capture:
            self.capture.push_samples(index0, tick0, samples)

    def push_edges(self, records: NDArray[np.void]) -> None:
        """Take Hall edges in order of time, as `protocol.streams.EDGE_RECORD`."""
        if self.capture:
            self.capture.push_edges(records, self.streams.edges, self._tick)
        self.streams.push_edges(records, self._tick)

    def fault(self, bits: Fault) -> None:
        """Latch faults: outputs off, state FAULT."""
        self.machine.fault(bits)

    def event(self, code: EventCode, arg: float = 0.0, detail: float = 0.0) -> None:
        """Send an EVENT."""
        self._send(DeviceEvent(self._tick, code, self.identity.node, arg, detail))

    def log(self, level: int, text: str) -> None:
        """Send a LOG."""
        self._send(Log(level, CONTROL.sub(" ", text)[: (self._peer.tx_max - 1) // 4]))

    def heartbeat(self) -> Heartbeat:
        """Return the health as of now."""
        machine = self.machine
        return Heartbeat(
            tick=self._tick,
            boot_id=self.identity.boot_id,
            faults=machine.faults,
            first_fault=machine.first_fault,
            tx_dropped=self.streams.dropped & 0xFFFFFFFF,
            rx_bad=self._link_counters.bad & 0xFFFFFFFF,
            setpoint_counter=self._setpoint_counter,
            setpoints_rejected=self.setpoints_rejected & 0xFFFF,
            last_tid=self._last_tid,
            watchdog_ms=machine.watchdog_ms(self._tick),
            state=machine.state,
            outputs_on=self.app.outputs_on,
            edges=self.streams.edges & 0xFFFFFFFF,
        )

    def receive(self, raw: bytes, host: int = 0) -> None:
        """Handle a frame (header + payload) that is meant for this node; `host`: number of its sender on the link."""
        self._peer = self._peers[host]
        frame = parse_frame(raw)
        if frame.is_reply or frame.is_error:
            self.ignored += 1
            return
        kind = REQUESTS.get(frame.type)
        if kind not in self._handlers:  # it belongs to a feature that the device does not have
            kind = None
        if frame.type != MessageType.HELLO and frame.major != MAJOR:
            self.refuse(frame, ErrorCode.BAD_VERSION, MAJOR)
        elif kind is None:
            self.refuse(frame, ErrorCode.UNKNOWN_TYPE, frame.type)
        elif (frame.tid == 0) != (frame.type in UNACKNOWLEDGED):
            self.refuse(frame, ErrorCode.BAD_VALUE, frame.tid)
        elif frame.tid == 0 or _always_executed(frame):
            self._execute(kind, frame)
        else:
            for seen, wire in self._peer.replies:
                if seen == raw:
                    self.tx.put_control(wire)
                    return
            self._peer.replies.append((raw, self._execute(kind, frame)))

    def stop(self) -> None:
        """Carry out a STOP that nobody waits for."""
        self.machine.command(Command.STOP, 0, self._tick)

    def refuse(self, frame: Frame, code: ErrorCode, detail: float = 0.0) -> bytes:
        """Answer a frame with an error; return the answer's bytes."""
        return self._answer(frame, ErrorReply(code, frame.type, detail), REPLY | ERROR)

    def _execute(self, kind: type[Request], frame: Frame) -> bytes:
        try:
            reply = self._handlers[kind](kind.unpack(frame.payload))
        except PayloadError as error:
            code, detail = ErrorCode.BAD_VALUE, error.value
            if error.bad_length:
                code, detail = ErrorCode.BAD_LENGTH, len(frame.payload)
            if kind is Setpoint:
                self._reject_setpoint(code, detail)
            return self.refuse(frame, code, detail)
        except Refused as refusal:
            return self.refuse(frame, ErrorCode(refusal.code), refusal.detail)
        if kind.TYPE in UNACKNOWLEDGED:
            return b""
        self._last_tid = frame.tid
        return self._answer(frame, reply or Empty(), REPLY)

    def _answer(self, frame: Frame, reply: Payload, flags: int) -> bytes:
        wire = self._encode(Frame(frame.type, MAJOR | flags, frame.tid, self.identity.node, reply.pack()))
        self.tx.put_control(wire)
        return wire

    def _changed(self, code: EventCode, arg: float) -> None:
        """Follow what the state machine has just done, and tell it."""
        self.event(code, arg)
        if code is EventCode.STATE_CHANGED:
            was_running, self._running = self._running, self.state is DriveState.RUNNING
            if was_running and not self._running:
                self.parameters.reset_volatile()
            if self.capture and self.state is not DriveState.FAULT:  # FAULT tells itself
                self.capture.state_changed(self._tick)
        elif code is EventCode.FAULT and self.capture:
            self.capture.fault(self._tick)

    def _make_blobs(self, extras: Extras) -> Blobs:
        features, meanings = self.identity.features, None
        if features & Feature.MEANINGS:
            names = {each.name for each in (*self.descriptor.channels, *self.descriptor.parameters)}
            meanings = meanings_blob(extras.meanings, names)
        waveform = extras.waveform if features & Feature.WAVEFORM else None
        return Blobs(self.descriptor.pack(), self.capture, meanings, waveform, lambda: self.parameters.testing)

    def _send(self, message: Message) -> None:
        self.tx.put_event(self._encode(Frame(message.TYPE, MAJOR, 0, self.identity.node, message.pack())))

    def _hello(self, request: Hello) -> HelloReply:
        if not request.major_min <= MAJOR <= request.major_max:
            raise Refused("no common version", ErrorCode.BAD_VERSION, MAJOR)
        if request.rx_max < MIN_RX_MAX:
            raise Refused(f"rx_max {request.rx_max}", ErrorCode.OUT_OF_RANGE, MIN_RX_MAX)
        identity = self.identity
        peer = self._peer
        peer.tx_max = min(identity.tx_max, request.rx_max)
        if (request.nonce, request.rx_max) != peer.hello:  # a new host may use the same tids again
            peer.hello = request.nonce, request.rx_max
            peer.replies.clear()
        told = asdict(identity) | {"tx_max": peer.tx_max, "nonce": request.nonce, "nodes": self.nodes}
        del told["tick0"], told["capture_bytes"]  # other replies have them
        return HelloReply(major=MAJOR, minor=MINOR, schema_crc=self.descriptor.crc, state=self.state, **told)

    def _setpoint(self, request: Setpoint) -> None:
        try:
            if self.state is not DriveState.RUNNING:
                raise Refused("not RUNNING", ErrorCode.WRONG_STATE, self.state)
            for value in (request.value, request.value2):
                if not math.isfinite(value):
                    raise Refused(f"setpoint {value}", ErrorCode.BAD_VALUE, value)
            self.app.setpoint(request.mode, request.value, request.value2)
        except Refused as refusal:
            self._reject_setpoint(ErrorCode(refusal.code), refusal.detail)
            return
        self._setpoint_counter = request.counter
        self.machine.feed(self._tick)

    def _reject_setpoint(self, code: ErrorCode, detail: float) -> None:
        self.setpoints_rejected += 1
        self.event(EventCode.SETPOINT_REJECTED, float(code), detail)

    def _param_commit(self, request: ParamCommit) -> None:
        if self.app.outputs_on:
            raise Refused("outputs are on", ErrorCode.WRONG_STATE, self.state)
        self.app.commit()


def _always_executed(frame: Frame) -> bool:
    """Whether a request is no repetition even where an equal one was answered before.

    An old answer to HELLO or TIME_SYNC would mislead, and a STOP must stop whatever was said before.
    """
    if frame.type in (MessageType.HELLO, MessageType.TIME_SYNC):
        return True
    return frame.type == MessageType.STATE_CMD and frame.payload[:1] == bytes((Command.STOP,))


class DeviceLink:
    """Several devices behind one byte link, the first of which answers to node 0."""

    def __init__(self, tx: TxQueue | None = None) -> None:
        self.tx = TxQueue() if tx is None else tx
        self.deframer = Deframer()
        self.sessions: dict[int, DeviceSession] = {}

    def add(self, app: DeviceApp, identity: Identity) -> DeviceSession:
        """Return the session of one more device; ValueError if its node is taken."""
        if identity.node in self.sessions or not 1 <= identity.node <= 255:
            raise ValueError(f"node {identity.node} is taken or not in 1..255")
        session = DeviceSession(app, identity, ByteCarrier(self.tx), self.deframer.counters)
        self.sessions[identity.node] = session
        for each in self.sessions.values():
            each.nodes = len(self.sessions)
        return session

    def receive(self, data: bytes) -> None:
        """Take bytes from the link, cut anywhere."""
        for raw in self.deframer.feed(data):
            first = next(iter(self.sessions.values()))
            session = self.sessions.get(raw[6]) if raw[6] else first
            if session is None:
                frame = parse_frame(raw)
                if frame.is_reply or frame.is_error:
                    first.ignored += 1
                else:
                    first.refuse(frame, ErrorCode.UNKNOWN_NODE, raw[6])
            else:
                session.receive(raw)

    def advance(self, tick: int) -> None:
        """Let time pass up to the 64-bit `tick` for every device."""
        for session in self.sessions.values():
            session.advance(tick)

    def __len__(self) -> int:
        """Bytes that wait for the link."""
        return len(self.tx)

    def data_to_send(self, limit: int | None = None) -> bytes:
        """Return and forget the bytes that wait for the link, at most `limit`."""
        fits = limit is None or len(self.tx) <= limit
        return self.tx.take(None if fits else limit)  # all at once is quicker than frame by frame
