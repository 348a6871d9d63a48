"""The device side of HBP, as protocol/SPEC.md has it: requests, states, watchdog, parameters, heartbeats.

What goes wrong in `faults` overrides a method here; so each step that can go wrong is a method of its own.
"""

from __future__ import annotations

import itertools
import random
import struct
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from math import hypot, isfinite, nan
from typing import Any
from zlib import crc32

import numpy as np

from tests.devices.carriers import ByteCarrier, CanCarrier
from tests.devices.motor import U_DC, Motor, Samples, edges_between, hall_code
from tests.devices.spec import (
    ERROR,
    MAJOR,
    MAX_PAYLOAD,
    REPLY,
    Code,
    Command,
    Event,
    Fault,
    Flag,
    Message,
    Mode,
    Refusal,
    Role,
    State,
    Type,
)
from tests.devices.streams import Stream
from tests.devices.vocabulary import Vocabulary, encoded

TICK_HZ = 1_000_000
HEARTBEAT_TICKS = TICK_HZ // 10
ARMED_TICKS = 5 * TICK_HZ
WATCHDOG = 0.2  # s, without a parameter of that name
UNFED = 0xFFFF  # what is left of a watchdog that is not at work
I_MAX = 8.0  # A, and
OMEGA_M_MAX = 300.0  # mechanical rad/s, without parameters of these names
MOST_LATE = 5.0  # s of samples that are caught up

HELLO = struct.Struct("<IIBBHHxxIIIIBBBB16s16s24s24s")
HEARTBEAT = struct.Struct("<QIIIIIHHHHBBxxI")
SET = struct.Struct("<BBHHH")
LENGTHS = {
    Type.TIME_SYNC: 0, Type.ALIVE: 4, Type.BLOB_READ: 8, Type.PARAM_GET: 4, Type.PARAM_SET: 8, Type.PARAM_COMMIT: 0,
    Type.STATE_CMD: 8, Type.SETPOINT: 12, Type.STREAM_START: 4, Type.STREAM_STOP: 4, Type.STREAM_GET: 4,
}  # fmt: skip
UNACKNOWLEDGED = (Type.ALIVE, Type.SETPOINT)
ALWAYS_AFRESH = (Type.HELLO, Type.TIME_SYNC)


class Peer:
    """What is kept of one host: its nonce, the largest payload that it takes, the last replies."""

    def __init__(self, number: int = 0) -> None:
        self.number = number
        self.nonce = -1
        self.rx_max = 128
        self.kept: deque[tuple[Message, Message, bytes]] = deque(maxlen=4)
        """Request, its reply, and how that went: on CAN with the same transfer id again."""


class Device:
    """Node `node` of a link.

    `stream_kind` makes its streams.

    `after`: seconds after START at which a fault that needs a moment happens. `watchdog`: its time in s where there is
    no parameter `watchdog`; a test on a busy machine may want more than SPEC's.

    `seen` counts what was received by name (ARM, START, STOP, ALIVE, SETPOINT, HELLO…), `stops` has the times of the
    STOPs, CAN frames of class 0 included; `state`, `outputs_on` and `motor` are as they truly are.
    """

    node = 1
    stream_kind = Stream

    def __init__(
        self,
        vocabulary: Vocabulary,
        after: float = 1.0,
        pwm_hz: int = 1000,
        watchdog: float = WATCHDOG,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.vocabulary = self.words(vocabulary)
        self.after = after
        self.pwm_hz = pwm_hz
        self.watchdog = watchdog
        self.carrier: ByteCarrier | CanCarrier
        self.link: Any = None  # in virtual time
        self.seen: Counter[str] = Counter()
        self.stops: list[float] = []
        self._clock = clock
        self._peers: dict[int, Peer] = {}
        self._answers: dict[int, Callable[[Message, Peer], bytes]] = {
            Type.HELLO: self.hello, Type.TIME_SYNC: self.time_sync, Type.BLOB_READ: self.blob_read,
            Type.PARAM_GET: self.param_get, Type.PARAM_SET: self.param_set, Type.PARAM_COMMIT: self.param_commit,
            Type.STATE_CMD: self.state_cmd, Type.STREAM_SET: self.stream_set, Type.STREAM_START: self.stream_start,
            Type.STREAM_STOP: self.stream_stop, Type.STREAM_GET: self.stream_get, Type.ALIVE: self.alive,
            Type.SETPOINT: self.setpoint_message,
        }  # fmt: skip
        self.boot()

    def attach(self, carrier: ByteCarrier | CanCarrier) -> None:
        """Work on this carrier from now on; here faults of links change how it works."""
        self.carrier = carrier

    def boot(self) -> None:
        """Begin anew, as after a reset."""
        self.boot_id = random.getrandbits(32)
        self.values = {row.id: row.value for row in self.vocabulary.parameters}
        self.state = State.IDLE
        self.motor = Motor(self.vocabulary.pole_pairs)
        self.faults = self.first_fault = Fault(0)
        self.started_at: float | None = None
        """Seconds since boot of the last START that was obeyed."""
        self.edges = 0
        self.rejected = 0
        self.setpoint_counter = 0
        self.last_tid = 0
        self.tx_dropped = 0
        self.streams: dict[int, Stream] = {}
        self._cfg_ids = itertools.count(self.boot_id % 1000 + 1)
        self._born = self._clock()
        self._periods = 0
        self._armed_at = self._fed_at = 0
        self._next_heartbeat = 0

    # -- what it knows of itself --------------------------------------------------------------------------------

    @property
    def outputs_on(self) -> bool:
        """As the hardware has it."""
        return self.motor.setpoint is not None

    @property
    def seconds(self) -> float:
        """Since boot."""
        return self._clock() - self._born

    def tick(self) -> int:
        return int(self.seconds * TICK_HZ)

    def due(self) -> bool:
        """Whether it has been RUNNING for longer than `after` (and is)."""
        return self.state == State.RUNNING and self.seconds - (self.started_at or 0.0) >= self.after

    def value(self, name: str, otherwise: float = nan) -> float:
        """A parameter by name."""
        return next((self.values[row.id] for row in self.vocabulary.parameters if row.name == name), otherwise)

    def words(self, vocabulary: Vocabulary) -> Vocabulary:
        """What it says instead of `vocabulary`, for faults."""
        return vocabulary

    def descriptor(self) -> bytes:
        return self.vocabulary.descriptor()

    # -- receiving ----------------------------------------------------------------------------------------------

    def receive(self, message: Message, host: int = 0) -> None:
        """Look at a message of a host, and answer it; the checks are in SPEC's order."""
        if message.flags & (REPLY | ERROR):
            return
        peer = self._peers.setdefault(host, Peer(host))
        keeps = False
        try:
            self.admit(message)
            keeps = _kept(message)
            for request, reply, sent in peer.kept if keeps else ():
                if request == message:
                    self.answer_again(message, reply, peer, sent)
                    return
            payload = self.execute(message, peer)
        except Refusal as refusal:
            payload = struct.pack("<HBxf", refusal.code, message.type, refusal.detail)
            answer = Message(message.type, MAJOR | REPLY | ERROR, message.tid, self.node, payload)
        else:
            if message.type in UNACKNOWLEDGED:
                return
            self.last_tid = message.tid
            answer = Message(message.type, MAJOR | REPLY, message.tid, self.node, payload)
        self.answer(message, answer, peer, keeps)

    def answer(self, request: Message, answer: Message, peer: Peer, keeps: bool) -> None:
        """Send and perhaps keep a reply or a refusal."""
        sent = self.carrier.send(answer, peer.number)
        if keeps:
            peer.kept.append((request, answer, sent))

    def answer_again(self, request: Message, reply: Message, peer: Peer, sent: bytes) -> None:
        """Send a kept reply."""
        self.carrier.send(reply, peer.number, sent)

    def admit(self, message: Message) -> None:
        """What is checked before a repeated request is answered again. Raises Refusal."""
        if not self.is_here(message.node):
            raise Refusal(Code.UNKNOWN_NODE, message.node)
        if message.type != Type.HELLO and message.flags & 0xF != MAJOR:
            raise Refusal(Code.BAD_VERSION, MAJOR)
        if message.type not in self._answers:
            raise Refusal(Code.UNKNOWN_TYPE, message.type)
        if (message.tid == 0) != (message.type in UNACKNOWLEDGED):
            raise Refusal(Code.BAD_VALUE, message.tid)

    def execute(self, message: Message, peer: Peer) -> bytes:
        """Returns the payload of the reply; raises Refusal."""
        length = len(message.payload)
        if length != LENGTHS.get(message.type, length) or (
            message.type in (Type.HELLO, Type.STREAM_SET) and length < 8
        ):
            if message.type == Type.SETPOINT:
                self.reject(Code.BAD_LENGTH, length)
            raise Refusal(Code.BAD_LENGTH, length)
        if message.type != Type.STATE_CMD:
            self.seen[Type(message.type).name] += 1
        return self._answers[message.type](message, peer)

    def is_here(self, node: int) -> bool:
        return node in (0, self.node)

    # -- requests, each returning the payload of its reply ------------------------------------------------------

    def hello(self, message: Message, peer: Peer) -> bytes:
        nonce, lowest, highest, rx_max = struct.unpack_from("<IBBH", message.payload)
        if not lowest <= MAJOR <= highest:
            raise Refusal(Code.BAD_VERSION, MAJOR)
        if rx_max < 128:
            raise Refusal(Code.OUT_OF_RANGE, 128)
        if (nonce, rx_max) != (peer.nonce, peer.rx_max):
            peer.kept.clear()
        peer.nonce, peer.rx_max = nonce, rx_max
        return HELLO.pack(nonce, *self.hello_fields(rx_max).values())

    def hello_fields(self, rx_max: int) -> dict[str, Any]:
        """What follows the nonce in a HELLO reply."""
        return {
            "boot_id": self.boot_id, "major": MAJOR, "minor": 0, "rx_max": MAX_PAYLOAD,
            "tx_max": min(rx_max, MAX_PAYLOAD), "features": int(self.vocabulary.features),
            "schema_crc": crc32(self.descriptor()), "tick_hz": TICK_HZ, "pwm_hz": self.pwm_hz, "state": self.state,
            "node": self.node, "role": int(Role.DRIVE), "nodes": 1, "name": encoded(self.vocabulary.name),
            "firmware": encoded(self.vocabulary.firmware), "serial": encoded(self.vocabulary.serial),
            "build": encoded(self.vocabulary.build),
        }  # fmt: skip

    def time_sync(self, message: Message, peer: Peer) -> bytes:
        return struct.pack("<QQ", self.tick(), self.tick())

    def blob_read(self, message: Message, peer: Peer) -> bytes:
        blob, length, offset = struct.unpack("<BxHI", message.payload)
        if blob != 0:
            raise Refusal(Code.UNKNOWN_ID, blob)
        whole = self.descriptor()
        if offset > len(whole):
            raise Refusal(Code.OUT_OF_RANGE, len(whole))
        part = whole[offset : offset + min(length, min(peer.rx_max, MAX_PAYLOAD) - 12)]
        return struct.pack("<BxHII", blob, len(part), offset, len(whole)) + part

    def _parameter(self, number: int) -> Any:
        for row in self.vocabulary.parameters:
            if row.id == number:
                return row
        raise Refusal(Code.UNKNOWN_ID, number)

    def param_get(self, message: Message, peer: Peer) -> bytes:
        (number,) = struct.unpack("<Hxx", message.payload)
        row = self._parameter(number)
        return struct.pack("<Hxxffff", number, self.values[number], row.lo, row.hi, row.value)

    def param_set(self, message: Message, peer: Peer) -> bytes:
        number, value = struct.unpack("<Hxxf", message.payload)
        row = self._parameter(number)
        if row.flags & Flag.READ_ONLY:
            raise Refusal(Code.READ_ONLY, number)
        if not isfinite(value) or (row.flags & Flag.WHOLE and value != round(value)):
            raise Refusal(Code.BAD_VALUE, value)
        if not row.lo <= value <= row.hi:
            raise Refusal(Code.OUT_OF_RANGE, row.lo if value < row.lo else row.hi)
        if row.flags & Flag.IDLE_ONLY and self.outputs_on:
            raise Refusal(Code.WRONG_STATE, self.state)
        self.values[number] = value
        return struct.pack("<Hxxf", number, value)

    def hall_code(self, sector: int) -> int:
        """What it makes of its inputs in a sector, by SPEC 12."""
        pins = hall_code(sector) ^ int(self.value("hall_invert_hat", 0))
        exchanged = {0: "abc", 1: "bac", 2: "acb", 3: "cba", 4: "bca", 5: "cab"}[int(self.value("hall_swap_hat", 0))]
        return sum((pins >> "abc".index(on) & 1) << bit for bit, on in enumerate(exchanged))

    def param_commit(self, message: Message, peer: Peer) -> bytes:
        if self.outputs_on:
            raise Refusal(Code.WRONG_STATE, self.state)
        raise Refusal(Code.NOT_SUPPORTED)

    # -- states -------------------------------------------------------------------------------------------------

    def state_cmd(self, message: Message, peer: Peer) -> bytes:
        command, argument = struct.unpack("<BxxxI", message.payload)
        if command not in list(Command):
            raise Refusal(Code.BAD_VALUE, command)
        self.seen[Command(command).name] += 1
        if command == Command.ARM:
            state = self.arm(argument)
        elif command == Command.START:
            if argument:
                raise Refusal(Code.BAD_VALUE, argument)
            state = self.start()
        elif command == Command.STOP:
            self.stops.append(self.seconds)
            state = self.stop()
        else:
            state = self.clear(argument)
        return struct.pack("<Bxxx", state)

    def stop_frame(self) -> None:
        """A CAN frame of class 0: STOP without a reply."""
        self.stops.append(self.seconds)
        with suppress(Refusal):
            self.stop()

    def arm(self, token: int) -> State:
        if token != self.boot_id:
            raise Refusal(Code.BAD_TOKEN)
        if self.state not in (State.IDLE, State.ARMED):
            raise Refusal(Code.WRONG_STATE, self.state)
        self._armed_at = self._fed_at = self.tick()
        self.enter(State.ARMED)
        return self.state

    def start(self) -> State:
        if self.state not in (State.ARMED, State.RUNNING):
            raise Refusal(Code.WRONG_STATE, self.state)
        if self.state == State.ARMED:
            self.started_at = self.seconds
            self.motor.setpoint = self.at_start()
            self.enter(State.RUNNING)
        return self.state

    def at_start(self) -> tuple[Mode, float]:
        """The setpoint with which RUNNING begins."""
        return Mode.CURRENT, 0.0

    def stop(self) -> State:
        self.motor.setpoint = None
        if self.state != State.FAULT:
            self.enter(State.IDLE)
        return self.state

    def clear(self, faults: int) -> State:
        if self.state != State.FAULT:
            raise Refusal(Code.WRONG_STATE, self.state)
        if faults != self.faults:
            raise Refusal(Code.FAULTS_CHANGED, self.faults)
        self.faults = self.first_fault = Fault(0)
        self.enter(State.IDLE)
        return self.state

    def trip(self, fault: Fault) -> None:
        """Outputs off, and FAULT until it is cleared."""
        self.motor.setpoint = None
        self.enter(State.FAULT)
        if new := fault & ~self.faults:
            self.first_fault = self.first_fault or new
            self.faults |= new
            self.event(Event.FAULT, float(new))

    def enter(self, state: State) -> None:
        if state != self.state:
            self.state = state
            self.event(Event.STATE_CHANGED, float(state))

    # -- watchdog and setpoints ---------------------------------------------------------------------------------

    def alive(self, message: Message, peer: Peer) -> bytes:
        self._fed_at = self.tick()
        return b""

    def watchdog_left(self) -> int:
        """ms, as the heartbeat has it."""
        return max(0, self._ticks_left() * 1000 // TICK_HZ) if self.state in (State.ARMED, State.RUNNING) else UNFED

    def watchdog_expired(self) -> bool:
        return self._ticks_left() <= 0

    def _ticks_left(self) -> int:
        limit = self.value("watchdog", self.watchdog)
        return round((limit if isfinite(limit) else self.watchdog) * TICK_HZ) - (self.tick() - self._fed_at)

    def setpoint_message(self, message: Message, peer: Peer) -> bytes:
        mode, counter, value, value2 = struct.unpack("<BxHff", message.payload)
        try:
            self.set_point(mode, value, value2)
        except Refusal as refusal:
            self.reject(refusal.code, refusal.detail)
            return b""
        self.setpoint_counter = counter
        self._fed_at = self.tick()
        return b""

    def reject(self, code: int, detail: float) -> None:
        """Count and tell of a setpoint that is not accepted."""
        self.rejected += 1
        self.event(Event.SETPOINT_REJECTED, float(code), detail)

    def set_point(self, mode: int, value: float, value2: float) -> None:
        """Accept a setpoint, or raise Refusal."""
        if self.state != State.RUNNING:
            raise Refusal(Code.WRONG_STATE, self.state)
        for number in (value, value2):
            if not isfinite(number):
                raise Refusal(Code.BAD_VALUE, number)
        if mode not in self.vocabulary.modes:
            raise Refusal(Code.NOT_SUPPORTED, mode)
        speed = mode == Mode.SPEED
        limit = self.value("omega_m_max", OMEGA_M_MAX) if speed else self.value("i_max", I_MAX)
        if (abs(value) if speed else hypot(value, value2)) > limit:
            raise Refusal(Code.OUT_OF_RANGE, limit)
        self.motor.setpoint = Mode(mode), value

    # -- streams ------------------------------------------------------------------------------------------------

    def stream_set(self, message: Message, peer: Peer) -> bytes:
        number, event, decimation, latency, n = SET.unpack_from(message.payload)
        if len(message.payload) != SET.size + 2 * n:
            raise Refusal(Code.BAD_LENGTH, len(message.payload))
        if number > 3:
            raise Refusal(Code.OUT_OF_RANGE, 3)
        ids = struct.unpack_from(f"<{n}H", message.payload, SET.size)
        stream = self.stream_kind.asked(number, event, decimation, latency, ids, self.vocabulary)
        if number in self.streams and self.streams[number].running:
            raise Refusal(Code.BUSY, number)
        stream.tx_max = min(peer.rx_max, MAX_PAYLOAD)
        stream.cfg_id = next(self._cfg_ids) % 0xFFFF + 1
        others = [other for other in self.streams.values() if other.number != number]
        self.carrier.plan(stream, others, self.pwm_hz, self.boot_id)
        self.streams[number] = stream
        return struct.pack(
            "<BxHHHfBxxxQ", number, stream.cfg_id, stream.sample_bytes, stream.block, stream.total, stream.slot, 0
        )

    def stream_start(self, message: Message, peer: Peer) -> bytes:
        chosen = _bits(message)
        for number in chosen:
            if number not in self.streams:
                raise Refusal(Code.UNKNOWN_ID, number)
        for number in chosen:
            self.streams[number].running = True
        return b""

    def stream_stop(self, message: Message, peer: Peer) -> bytes:
        for number in sorted(_bits(message), key=lambda n: n in self.streams and not self.streams[n].edges):
            if number in self.streams:
                self.flush(self.streams[number], True)
                del self.streams[number]
        return b""

    def stream_get(self, message: Message, peer: Peer) -> bytes:
        number = message.payload[0]
        if number > 3:
            raise Refusal(Code.OUT_OF_RANGE, 3)
        if number not in self.streams:
            raise Refusal(Code.UNKNOWN_ID, number)
        s = self.streams[number]
        told = (number, s.running, s.event, s.slot, s.decimation, s.latency_ms, s.cfg_id, s.sample_bytes, s.block, 0)
        ids = [channel.id for channel in s.channels][: (min(peer.rx_max, MAX_PAYLOAD) - 26) // 2]
        return struct.pack(f"<BBBBHHHHHxxQH{len(ids)}H", *told, len(ids), *ids)

    def flush(self, stream: Stream, everything: bool = False) -> None:
        """Send what is full or late; edges at once, so that they are ahead of the samples after them."""
        for records in stream.take(self.tick(), everything or stream.edges, self.carrier.whole):
            if dropped := self.carrier.emit(stream, records, self.node):
                self.dropped(stream, dropped)
            else:
                stream.overrun = False

    def dropped(self, stream: Stream, frames: int) -> None:
        """So many frames found no room."""
        self.tx_dropped += frames
        stream.overrun = True

    # -- time ---------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """All that has come due: samples, edges, watchdog, heartbeat."""
        self.moment()
        due = self.tick() // self._ticks + 1
        if due - self._periods > MOST_LATE * self.pwm_hz:  # this process stood still: what nobody sampled is gone
            for stream in self.streams.values():
                self.flush(stream, True)
                stream.jumped = True
            self._periods = due - 1
        while self._periods < due:
            self._sample(min(due - self._periods, self.pwm_hz // 20))
            if self.sampled >= self._next_heartbeat:
                self._next_heartbeat = self.sampled // HEARTBEAT_TICKS * HEARTBEAT_TICKS + HEARTBEAT_TICKS
                self.heartbeat()
        now = self.tick()
        if self.state in (State.ARMED, State.RUNNING) and self.watchdog_expired():
            self.trip(Fault.WATCHDOG)
        if self.state == State.ARMED and now - self._armed_at >= ARMED_TICKS:
            self.event(Event.ARM_LAPSED, ARMED_TICKS / TICK_HZ)
            self.enter(State.IDLE)

    @property
    def _ticks(self) -> int:
        """In a PWM period."""
        return TICK_HZ // self.pwm_hz

    @property
    def sampled(self) -> int:
        """Tick of the last sample."""
        return max(0, self._periods - 1) * self._ticks

    def moment(self) -> None:
        """Called some hundred times a second, for faults."""

    def heartbeat(self) -> None:
        self.unsolicited(Type.HEARTBEAT, HEARTBEAT.pack(*self.heartbeat_fields().values()))

    def heartbeat_fields(self) -> dict[str, Any]:
        """At the tick of the last sample, because `edges` are those up to it."""
        return {
            "tick": self.sampled, "boot_id": self.boot_id, "faults": int(self.faults),
            "first_fault": int(self.first_fault), "tx_dropped": self.tx_dropped, "rx_bad": self.carrier.bad,
            "setpoint_counter": self.setpoint_counter, "setpoints_rejected": self.rejected & 0xFFFF,
            "last_tid": self.last_tid, "watchdog_ms": self.watchdog_left(), "state": int(self.state),
            "outputs_on": int(self.outputs_on), "edges": self.edges,
        }  # fmt: skip

    def event(self, code: Event, argument: float, detail: float = 0.0) -> None:
        self.unsolicited(Type.EVENT, struct.pack("<QHBxff", self.tick(), code, self.node, argument, detail))

    def log(self, text: bytes, level: int = 6) -> None:
        self.unsolicited(Type.LOG, bytes([level]) + text)

    def unsolicited(self, kind: Type, payload: bytes) -> None:
        self.carrier.send(Message(kind, MAJOR, 0, self.node, payload))

    def _sample(self, n: int) -> None:
        """The next `n` PWM periods: the motor, the edges, the samples."""
        ticks = self._ticks
        motor, rows = self.motor, []
        edges = []
        seconds, i_max = 1.0 / self.pwm_hz, self.value("i_max", I_MAX)
        for period in range(self._periods, self._periods + n):
            before = motor.theta
            motor.advance(seconds, i_max)
            reference = motor.setpoint[1] if motor.setpoint and motor.setpoint[0] == Mode.SPEED else 0.0
            rows.append((motor.theta, motor.pole_pairs * motor.speed, motor.pole_pairs * reference, motor.i_q))
            edges += edges_between(
                (period - 1) * ticks, before, period * ticks, motor.theta, motor.pole_pairs, self.hall_code
            )
        first = self._periods
        self._periods += n
        for stream in self.streams.values():
            if stream.running and stream.edges:
                stream.put_edges(edges, self.edges)
        self.edges += len(edges)
        sampled = [stream for stream in self.streams.values() if stream.running and not stream.edges]
        if sampled:
            samples = self._samples(first, rows)
            for stream in sampled:
                stream.put_samples(samples)
        for stream in sorted(self.streams.values(), key=lambda s: not s.edges):
            if stream.running:
                self.flush(stream)

    def _samples(self, first: int, rows: list[tuple[float, float, float, float]]) -> Samples:
        """What is measured in the periods from `first` on."""
        n, ticks, motor = len(rows), self._ticks, self.motor
        theta, omega, omega_ref, i_q = np.array(rows).T
        index = np.arange(first, first + n)
        pole_pairs = self.value("n_p", motor.pole_pairs)
        by_encoder = pole_pairs / motor.pole_pairs if isfinite(pole_pairs) else 1.0
        samples = Samples(
            period=ticks / TICK_HZ,
            tick=index * ticks,
            index=index,
            theta=theta,
            omega=omega,
            omega_ref=omega_ref,
            i_dq=1j * i_q,
            hall=np.array([self.hall_code(k) for k in range(6)])[(theta // (np.pi / 3)).astype(int) % 6],
            status=np.full(n, self.state | (int(self.value("observer", 0)) & 3) << 5),
            theta_enc=theta * by_encoder,
            omega_enc=omega * by_encoder,
            estimate=theta + 0.02 * np.sin(5.0 * theta),
            u_dc=U_DC + 0.1 * np.sin(0.001 * index),
        )
        self.distort(samples)
        return samples

    def distort(self, samples: Samples) -> None:
        """Where faults change what is measured."""


def _kept(message: Message) -> bool:
    """Whether a repeated one of these is answered again, not executed again."""
    stop = message.type == Type.STATE_CMD and message.payload[:1] == bytes([Command.STOP])
    return message.type not in ALWAYS_AFRESH and message.tid != 0 and not stop


def _bits(message: Message) -> list[int]:
    (mask,) = struct.unpack("<I", message.payload)
    return [number for number in range(32) if mask >> number & 1]
