"""What a drive may get wrong, by name. Each is a device that overrides the step at which it happens; they combine.

`build(FULL, ["stop-refused", "watchdog-dead"])` makes a device with both.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np
from cobs import cobs

from tests.devices.can_carriers import Assembler
from tests.devices.carriers import HEAD
from tests.devices.device import UNFED, Device, Peer
from tests.devices.motor import Samples
from tests.devices.spec import ERROR, PWM, Code, Command, Event, Flag, Message, Mode, Raw, Refusal, State, Type, Unit
from tests.devices.streams import Record, Stream
from tests.devices.vocabulary import FULL, Channel, Vocabulary, encoded

FAULTS: dict[str, type[Device]] = {}


def fault(name: str) -> Callable[[type[Device]], type[Device]]:
    """Enter a device under this name."""

    def enter(kind: type[Device]) -> type[Device]:
        FAULTS[name] = kind
        return kind

    return enter


def build(vocabulary: Vocabulary = FULL, faults: Iterable[str] = (), **options: Any) -> Device:
    """A device of this vocabulary with these faults; `options` are those of `Device`. KeyError for an unknown fault."""
    kinds = tuple(FAULTS[name] for name in faults)
    return type("Faulty", (*kinds, Device), {})(vocabulary, **options) if kinds else Device(vocabulary, **options)


# -- STOP -------------------------------------------------------------------------------------------------------------


@fault("stop-ignored")
class StopIgnored(Device):
    """STOP is confirmed with IDLE, and the drive goes on RUNNING; its watchdog does not end that either."""

    def stop(self) -> State:
        return State.IDLE

    def watchdog_expired(self) -> bool:
        return False


@fault("stop-outputs-stay")
class StopOutputsStay(Device):
    """STOP is confirmed with IDLE and the state is IDLE, but outputs_on stays 1."""

    def stop(self) -> State:
        setpoint = self.motor.setpoint
        super().stop()
        self.motor.setpoint = setpoint
        return self.state


@fault("stop-says-running")
class StopSaysRunning(Device):
    """The reply to STOP says RUNNING, and so it is."""

    def stop(self) -> State:
        return self.state


@fault("stop-refused")
class StopRefused(Device):
    """STOP is refused (BUSY)."""

    def stop(self) -> State:
        raise Refusal(Code.BUSY, 0)


@fault("stop-unanswered")
class StopUnanswered(StopSaysRunning):
    """STOP is neither obeyed nor answered."""

    def answer(self, request: Message, answer: Message, peer: Peer, keeps: bool) -> None:
        if request.type != Type.STATE_CMD or request.payload[0] != Command.STOP:
            super().answer(request, answer, peer, keeps)


@fault("stop-third-time")
class StopThirdTime(Device):
    """STOP is obeyed from the third one on; before that it is confirmed with the state as it is."""

    def stop(self) -> State:
        return super().stop() if len(self.stops) >= 3 else self.state


# -- START, and leaving RUNNING -----------------------------------------------------------------------------------


@fault("start-stays-armed")
class StartStaysArmed(Device):
    """START is answered with RUNNING, but the drive stays ARMED."""

    def start(self) -> State:
        return State.RUNNING


@fault("start-says-armed")
class StartSaysArmed(Device):
    """The reply to START says ARMED, and so it is."""

    def start(self) -> State:
        return self.state


@fault("leaves-running")
class LeavesRunning(Device):
    """It goes to IDLE by itself, without a fault, as after a STOP from elsewhere."""

    def moment(self) -> None:
        super().moment()
        if self.due():
            Device.stop(self)


@fault("foreign-stop")
class ForeignStop(Device):
    """Somebody else on the CAN bus sends a frame of class 0."""

    def moment(self) -> None:
        super().moment()
        if self.due():
            self.carrier.foreign(self.node << 4, b"")  # type: ignore[attr-defined]  # on CAN only


@fault("reboots")
class Reboots(Device):
    """A reset in the middle of a run."""

    def moment(self) -> None:
        super().moment()
        if self.due():
            self.boot()


# -- watchdog, heartbeats, replies -------------------------------------------------------------------------------------


@fault("no-watchdog")
class NoWatchdog(Device):
    """watchdog_ms is 0xFFFF in ARMED and RUNNING: there is none at work."""

    def watchdog_left(self) -> int:
        return UNFED


@fault("no-watchdog-running")
class NoWatchdogRunning(Device):
    """watchdog_ms is as it should be in ARMED and 0xFFFF in RUNNING."""

    def watchdog_left(self) -> int:
        return UNFED if self.state == State.RUNNING else super().watchdog_left()


@fault("watchdog-dead")
class WatchdogDead(Device):
    """The watchdog counts down and never trips."""

    def watchdog_expired(self) -> bool:
        return False


@fault("heartbeats-stop")
class HeartbeatsStop(Device):
    """No more heartbeats; all else goes on."""

    def heartbeat(self) -> None:
        if self.started_at is None or self.seconds - self.started_at < self.after:
            super().heartbeat()


def _answers_with(tid: Callable[[int], int]) -> type[Device]:
    """Replies, but those to HELLO, have another tid than their request."""

    class OtherTid(Device):
        def answer(self, request: Message, answer: Message, peer: Peer, keeps: bool) -> None:
            if request.type != Type.HELLO:
                answer = answer._replace(tid=tid(answer.tid))
            super().answer(request, answer, peer, keeps)

    return OtherTid


fault("tid-zero")(_answers_with(lambda tid: 0))
fault("tid-other")(_answers_with(lambda tid: tid % 0xFFFF + 1))


# -- a motor that cannot be right ---------------------------------------------------------------------------------


@fault("does-not-turn")
class DoesNotTurn(Device):
    """The shaft stands still at i_max, as with exchanged Hall wires."""

    def moment(self) -> None:
        super().moment()
        self.motor.jammed = True


@fault("estimate-off")
class EstimateOff(Device):
    """The position estimates are 103 deg off."""

    def distort(self, samples: Samples) -> None:
        super().distort(samples)
        samples.estimate += math.radians(103)


@fault("overcurrent")
class Overcurrent(Device):
    """Three times i_max flows while it runs, and nothing trips."""

    def distort(self, samples: Samples) -> None:
        super().distort(samples)
        if self.state == State.RUNNING:
            samples.i_dq = np.full(len(samples.index), 3j * self.value("i_max", 8.0))


@fault("backwards")
class Backwards(Device):
    """The shaft turns against the setpoint."""

    def set_point(self, mode: int, value: float, value2: float) -> None:
        super().set_point(mode, value, value2)
        self.motor.setpoint = Mode(mode), -value


# -- setpoints ------------------------------------------------------------------------------------------------------


def _rejects(code: Code) -> type[Device]:
    """Every setpoint is rejected with this code."""

    class Rejects(Device):
        def set_point(self, mode: int, value: float, value2: float) -> None:
            raise Refusal(code, 10)

    return Rejects


for _code in (Code.OUT_OF_RANGE, Code.WRONG_STATE, Code.BAD_VALUE):
    fault(f"rejects-{_code.name.lower().replace('_', '-')}")(_rejects(_code))


# -- numbers ----------------------------------------------------------------------------------------------------------


def _faulty_event(argument: float) -> type[Device]:
    """EVENT FAULT with this argument, idle and running, and no fault in the heartbeat."""

    class FaultyEvent(Device):
        beats = 0

        def heartbeat(self) -> None:
            super().heartbeat()
            self.beats += 1
            if self.beats % 3 == 0:
                self.event(Event.FAULT, argument)

    return FaultyEvent


for _name, _argument in (("inf", inf), ("nan", nan), ("1e20", 1e20), ("negative", -1.0)):
    fault(f"event-fault-{_name}")(_faulty_event(_argument))


def _fits(detail: float) -> type[Device]:
    """STREAM_SET of samples is refused with DOES_NOT_FIT and this detail."""

    class DoesNotFit(Device):
        def stream_set(self, message: Message, peer: Peer) -> bytes:
            if message.payload[1] == PWM:
                raise Refusal(Code.DOES_NOT_FIT, detail)
            return super().stream_set(message, peer)

    return DoesNotFit


def _load(told: float) -> type[Device]:
    """Samples fit from decimation 2 on, and their load is this."""

    class Load(Device):
        def stream_set(self, message: Message, peer: Peer) -> bytes:
            if message.payload[1] == PWM and int.from_bytes(message.payload[2:4], "little") < 2:
                raise Refusal(Code.DOES_NOT_FIT, 2.0)
            reply = super().stream_set(message, peer)
            return reply[:8] + struct.pack("<f", told) + reply[12:]

    return Load


for _name, _argument in (("nan", nan), ("inf", inf), ("negative", -3.5)):
    fault(f"fits-{_name}")(_fits(_argument))
    fault(f"load-{_name}")(_load(_argument))


def _value_of(name: str, value: float) -> type[Device]:
    """A parameter that has this value."""

    class ValueOf(Device):
        def boot(self) -> None:
            super().boot()
            for row in self.vocabulary.parameters:
                if row.name == name:
                    self.values[row.id] = value

    return ValueOf


for _name, _argument in (("zero", 0.0), ("nan", nan), ("inf", inf), ("negative", -4.0)):
    fault(f"n-p-{_name}")(_value_of("n_p", _argument))
fault("wrong-pole-pairs")(_value_of("n_p", 2.0 * FULL.pole_pairs))  # by which the angle of the encoder is made
fault("i-max-nan")(_value_of("i_max", nan))
fault("watchdog-nan")(_value_of("watchdog", nan))


def _hello(**fields: Any) -> type[Device]:
    """HELLO says something else."""

    class OddHello(Device):
        def hello_fields(self, rx_max: int) -> dict[str, Any]:
            return super().hello_fields(rx_max) | fields

    return OddHello


fault("pwm-hz-zero")(_hello(pwm_hz=0))
fault("tick-hz-zero")(_hello(tick_hz=0))
fault("tick-hz-odd")(_hello(tick_hz=1_000_001))
fault("role-7")(_hello(role=7))
fault("nodes-zero")(_hello(nodes=0))
fault("nodes-absent")(_hello(nodes=255))  # only one is there
fault("tx-max-zero")(_hello(tx_max=0))


@fault("state-9")
class State9(Device):
    """The state in HELLO and heartbeats is 9 while it is IDLE."""

    def hello_fields(self, rx_max: int) -> dict[str, Any]:
        return self._odd(super().hello_fields(rx_max))

    def heartbeat_fields(self) -> dict[str, Any]:
        return self._odd(super().heartbeat_fields())

    def _odd(self, fields: dict[str, Any]) -> dict[str, Any]:
        return fields | {"state": 9} if self.state == State.IDLE else fields


@fault("nodes-255")
class Nodes255(Device):
    """HELLO says 255 nodes, and each of them answers."""

    asked = 1

    def is_here(self, node: int) -> bool:
        self.asked = node or 1
        return True

    def hello_fields(self, rx_max: int) -> dict[str, Any]:
        return super().hello_fields(rx_max) | {"nodes": 255, "node": self.asked}

    def answer(self, request: Message, answer: Message, peer: Peer, keeps: bool) -> None:
        super().answer(request, answer._replace(node=self.asked), peer, keeps)

    def heartbeat(self) -> None:
        for self.node in range(1, 256):
            super().heartbeat()
        self.node = 1


# -- the descriptor ---------------------------------------------------------------------------------------------------


@fault("no-channels")
class NoChannels(Device):
    """The descriptor has parameters only."""

    def words(self, vocabulary: Vocabulary) -> Vocabulary:
        return replace(vocabulary, channels=())


@fault("channels-600")
class Channels600(Device):
    """600 channels of a byte."""

    def words(self, vocabulary: Vocabulary) -> Vocabulary:
        rows = (
            Channel(number, f"c{number}", Raw.U8, Unit.NONE, Flag.NONE, 1.0, lambda s: s.index % 256)
            for number in range(1, 601)
        )
        return replace(vocabulary, channels=tuple(rows))


@fault("descriptor-endless")
class DescriptorEndless(Device):
    """The descriptor is said to have 2^32 - 1 bytes; it ends after the first 64 KiB, so that a host does too."""

    def blob_read(self, message: Message, peer: Peer) -> bytes:
        blob, length, offset = struct.unpack("<BxHI", message.payload)
        length = 0 if offset > 65536 else length
        return struct.pack("<BxHII", blob, length, offset, 0xFFFFFFFF) + bytes(length)


@fault("descriptor-crc")
class DescriptorCrc(Device):
    """HELLO announces another CRC than the descriptor has."""

    def hello_fields(self, rx_max: int) -> dict[str, Any]:
        fields = super().hello_fields(rx_max)
        return fields | {"schema_crc": fields["schema_crc"] ^ 1}


# -- text and samples -------------------------------------------------------------------------------------------------

TITLE, CLEAR, OVERRIDE = "\x1b]0;owned\x07", "\x1b[2J\x1b[H", "\u202egnp.evird"


@fault("control-characters")
class ControlCharacters(Device):
    """Window title, clear screen, right-to-left and new lines in all texts of HELLO, names of channels and LOG."""

    beats = 0

    def words(self, vocabulary: Vocabulary) -> Vocabulary:
        names = (TITLE, CLEAR, OVERRIDE, "two\nlines", "a\x9b31mred", "b\rc")
        kept, last = vocabulary.channels[: -len(names)], vocabulary.channels[-len(names) :]
        channels = (*kept, *(replace(row, name=name) for row, name in zip(last, names, strict=False)))
        parameters = (*vocabulary.parameters, replace(vocabulary.parameters[0], id=900, name=CLEAR))
        return replace(
            vocabulary, name=TITLE + "!", firmware=CLEAR + "1.0", serial=OVERRIDE, build="2\n" + TITLE,
            channels=channels, parameters=parameters,
        )  # fmt: skip

    def heartbeat(self) -> None:
        super().heartbeat()
        self.beats += 1
        if self.beats % 2:
            self.log(f"{TITLE}{CLEAR}{OVERRIDE}\nerror: not ours\r".encode(), 4)


@fault("bad-utf8")
class BadUtf8(Device):
    """Names that are no UTF-8."""

    def words(self, vocabulary: Vocabulary) -> Vocabulary:
        first, *rest = vocabulary.channels
        channels = (replace(first, name=b"\xff\xfe" + encoded(first.name)[:6]), *rest)
        own = replace(vocabulary, name=b"dr\xc3ive \xff", firmware=b"\x80", serial=b"\xff" * 24, build=b"\xe2\x82")
        return replace(own, channels=channels)

    def heartbeat(self) -> None:
        super().heartbeat()
        self.log(b"\xf0\x28 half a letter: \xe2\x82")


@fault("log-flood")
class LogFlood(Device):
    """Two thousand lines of LOG a second."""

    def moment(self) -> None:
        super().moment()
        while self.lines < 2000 * self.seconds:
            self.lines += 1
            self.log(b"line %d" % self.lines, 3)

    def boot(self) -> None:
        super().boot()
        self.lines = 0


@fault("nan-samples")
class NanSamples(Device):
    """Every f32 channel is NaN."""

    def words(self, vocabulary: Vocabulary) -> Vocabulary:
        channels = (
            replace(row, values=lambda s: np.full(len(s.index), nan)) if row.raw == Raw.F32 else row
            for row in vocabulary.channels
        )
        return replace(vocabulary, channels=tuple(channels))


# -- what `bench conform` must find -----------------------------------------------------------------------------------


@fault("answers-damaged")
class AnswersDamaged(Device):
    """A frame with a wrong CRC is counted, and answered all the same."""

    def attach(self, carrier: Any) -> None:
        super().attach(carrier)
        carrier.salvaged = _without_crc


def _without_crc(frame: bytes) -> Message | None:
    try:
        body = cobs.decode(frame)[:-4]
    except cobs.DecodeError:
        return None
    if not 8 <= len(body) <= 1032:
        return None
    kind, flags, tid, length, node = HEAD.unpack_from(body)
    return Message(kind, flags, tid, node, body[8:]) if length == len(body) - 8 else None


@fault("rx-bad-zero")
class RxBadZero(Device):
    """Damaged frames are not counted."""

    def heartbeat_fields(self) -> dict[str, Any]:
        return super().heartbeat_fields() | {"rx_bad": 0}


@fault("length-before-type")
class LengthBeforeType(Device):
    """An unknown type with a payload is told its length."""

    def admit(self, message: Message) -> None:
        if message.type not in list(Type) and message.payload:
            raise Refusal(Code.BAD_LENGTH, len(message.payload))
        super().admit(message)


@fault("wrong-detail")
class WrongDetail(Device):
    """The refusal of another blob has the detail 0."""

    def blob_read(self, message: Message, peer: Peer) -> bytes:
        if message.payload[0]:
            raise Refusal(Code.UNKNOWN_ID, 0)
        return super().blob_read(message, peer)


@fault("retry-executed")
class RetryExecuted(Device):
    """A repeated request has the kept reply, and is executed once more."""

    def answer_again(self, request: Message, reply: Message, peer: Peer, transfer: int) -> None:
        with suppress(Refusal):
            self.execute(request, peer)
        super().answer_again(request, reply, peer, transfer)


@fault("reply-kept-once")
class ReplyKeptOnce(Device):
    """A reply is kept until the next one only."""

    def answer(self, request: Message, answer: Message, peer: Peer, keeps: bool) -> None:
        super().answer(request, answer, peer, keeps)
        if keeps and not answer.flags & ERROR:
            for kept in [kept for kept in peer.kept if kept[1] != answer and not kept[1].flags & ERROR]:
                peer.kept.remove(kept)


@fault("tick-back")
class TickBack(Device):
    """Every fifth TIME_SYNC tells the time of 8 ms ago."""

    asked = 0

    def time_sync(self, message: Message, peer: Peer) -> bytes:
        self.asked += 1
        tick = self.tick() - (8000 if self.asked % 5 == 0 else 0)
        return struct.pack("<QQ", max(0, tick), max(0, tick))


@fault("blob-past-end")
class BlobPastEnd(Device):
    """A read past the end of the descriptor has an empty answer."""

    def blob_read(self, message: Message, peer: Peer) -> bytes:
        blob, _, offset = struct.unpack("<BxHI", message.payload)
        total = len(self.descriptor())
        if blob == 0 and offset > total:
            return struct.pack("<BxHII", 0, 0, offset, total)
        return super().blob_read(message, peer)


@fault("read-only-set")
class ReadOnlySet(Device):
    """A READ_ONLY parameter is set all the same."""

    def param_set(self, message: Message, peer: Peer) -> bytes:
        number, value = struct.unpack("<Hxxf", message.payload)
        if self._parameter(number).flags & Flag.READ_ONLY:
            self.values[number] = value
            return struct.pack("<Hxxf", number, value)
        return super().param_set(message, peer)


@fault("parameter-clipped")
class ParameterClipped(Device):
    """A value beyond the range of a parameter sets it to the end of that."""

    def param_set(self, message: Message, peer: Peer) -> bytes:
        number, value = struct.unpack("<Hxxf", message.payload)
        try:
            return super().param_set(message, peer)
        except Refusal as refusal:
            if refusal.code != Code.OUT_OF_RANGE:
                raise
            value = self.values[number] = refusal.detail
        return struct.pack("<Hxxf", number, value)


@fault("last-tid-of-refused")
class LastTidOfRefused(Device):
    """last_tid is that of the last request, refused or not."""

    def answer(self, request: Message, answer: Message, peer: Peer, keeps: bool) -> None:
        super().answer(request, answer, peer, keeps)
        self.last_tid = request.tid


@fault("heartbeats-slow")
class HeartbeatsSlow(Device):
    """A heartbeat every 200 ms."""

    beats = 0

    def heartbeat(self) -> None:
        self.beats += 1
        if self.beats % 2:
            super().heartbeat()


# -- streams that lie -------------------------------------------------------------------------------------------------


@fault("drop-uncounted")
class DropUncounted(Device):
    """Frames that find no room are not counted in tx_dropped."""

    def dropped(self, stream: Stream, frames: int) -> None:
        super().dropped(stream, 0)


@fault("seq-of-sent")
class SeqOfSent(Device):
    """seq counts the frames that were sent only."""

    def dropped(self, stream: Stream, frames: int) -> None:
        super().dropped(stream, frames)
        stream.seq = (stream.seq - frames) & 0xFFFF


@fault("overrun-missing")
class OverrunMissing(Device):
    """No frame carries OVERRUN."""

    def dropped(self, stream: Stream, frames: int) -> None:
        super().dropped(stream, frames)
        stream.overrun = False


@fault("cfg-id-stale")
class CfgIdStale(Device):
    """Frames carry the cfg_id of the configuration before."""

    before = 0
    newest = 0

    def stream_set(self, message: Message, peer: Peer) -> bytes:
        reply = super().stream_set(message, peer)
        self.before, self.newest = self.newest, self.streams[message.payload[0]].cfg_id
        return reply

    def flush(self, stream: Stream, everything: bool = False) -> None:
        now, stream.cfg_id = stream.cfg_id, self.before or stream.cfg_id
        super().flush(stream, everything)
        stream.cfg_id = now


@fault("get-stale")
class GetStale(Device):
    """STREAM_GET tells the cfg_id of the first configuration since boot."""

    first = 0

    def stream_get(self, message: Message, peer: Peer) -> bytes:
        told = super().stream_get(message, peer)
        self.first = self.first or int.from_bytes(told[8:10], "little")
        return told[:8] + self.first.to_bytes(2, "little") + told[10:]


def _streams(name: str, kind: type[Stream]) -> None:
    """A fault of the streams themselves."""
    fault(name)(type(kind.__name__, (Device,), {"stream_kind": kind, "__doc__": kind.__doc__}))


class IndexOdd(Stream):
    """The periods are taken one too early: their index cannot be divided by the decimation."""

    def taken(self, index: np.ndarray) -> np.ndarray:
        return (index + 1) % self.decimation == 0


class SampleTickBack(Stream):
    """Every third frame has a tick of 3 ms ago."""

    def frame(self, records: list[Record]) -> tuple[Type, bytes]:
        index, tick, data = records[0]
        return super().frame([(index, tick - 3000 * (self.seq % 3 == 2), data), *records[1:]])


class ChannelsSorted(Stream):
    """Channels lie in a sample by their ids, however they are named."""

    def put_samples(self, samples: Samples) -> None:
        named, self.channels = self.channels, tuple(sorted(self.channels, key=lambda channel: channel.id))
        super().put_samples(samples)
        self.channels = named


_streams("index-odd", IndexOdd)
_streams("sample-tick-back", SampleTickBack)
_streams("channels-sorted", ChannelsSorted)


class SamplesOfThePast(Stream):
    """Indices and ticks of samples are those of 120 samples before: they do not lie beside edges and events."""

    def frame(self, records: list[Record]) -> tuple[Type, bytes]:
        (index, tick, data), *rest = records
        late = 0 if self.edges else 120 * self.decimation
        return super().frame([(index - late, tick - 1000 * late, data), *rest])


_streams("samples-of-the-past", SamplesOfThePast)


@fault("samples-of-the-future")
class SamplesOfTheFuture(Device):
    """Samples have ticks that are 0.2 s late, as `tick0` is."""

    class stream_kind(Stream):  # noqa: N801
        def frame(self, records: list[Record]) -> tuple[Type, bytes]:
            (index, tick, data), *rest = records
            return super().frame([(index, tick if self.edges else tick + 200_000, data), *rest])

    def stream_set(self, message: Message, peer: Peer) -> bytes:
        return self._later(super().stream_set(message, peer))

    def stream_get(self, message: Message, peer: Peer) -> bytes:
        return self._later(super().stream_get(message, peer))

    def _later(self, reply: bytes) -> bytes:
        return reply[:16] + struct.pack("<Q", 200_000) + reply[24:]


@fault("busy-ignored")
class BusyIgnored(Device):
    """A running stream can be configured anew."""

    def stream_set(self, message: Message, peer: Peer) -> bytes:
        stream = self.streams.get(message.payload[0])
        running = stream is not None and stream.running
        if stream is not None:
            stream.running = False
        try:
            return super().stream_set(message, peer)
        except Refusal:
            if stream is not None:
                stream.running = running
            raise


@fault("stop-drops")
class StopDrops(Device):
    """STREAM_STOP throws away what waits."""

    def stream_stop(self, message: Message, peer: Peer) -> bytes:
        for stream in self.streams.values():
            stream.waiting.clear()
        return super().stream_stop(message, peer)


@fault("edges-after-samples")
class EdgesAfterSamples(Device):
    """Edges wait for 30 ms; samples do not wait for them."""

    def flush(self, stream: Stream, everything: bool = False) -> None:
        newest = stream.waiting[0][1] if stream.edges and stream.waiting else -math.inf
        if everything or not stream.edges or self.tick() - newest >= 30_000:
            super().flush(stream, everything)


# -- states and setpoints that lie ------------------------------------------------------------------------------------


@fault("stop-confirmed-only")
class StopConfirmedOnly(Device):
    """STOP is confirmed with IDLE and not obeyed; the watchdog is at work."""

    def stop(self) -> State:
        return State.IDLE if self.state != State.FAULT else self.state


@fault("stop-refused-in-fault")
class StopRefusedInFault(Device):
    """STOP in FAULT is refused."""

    def stop(self) -> State:
        if self.state == State.FAULT:
            raise Refusal(Code.WRONG_STATE, self.state)
        return super().stop()


@fault("stop-once")
class StopOnce(Device):
    """A repeated STOP is answered, and not executed again."""

    last: Message | None = None

    def state_cmd(self, message: Message, peer: Peer) -> bytes:
        if message.payload[0] == Command.STOP and message == self.last:
            return struct.pack("<Bxxx", State.IDLE)
        if message.payload[0] == Command.STOP:
            self.last = message
        return super().state_cmd(message, peer)


@fault("state-before-token")
class StateBeforeToken(Device):
    """ARM in a state that forbids it is told the state, whatever its token."""

    def arm(self, token: int) -> State:
        if self.state not in (State.IDLE, State.ARMED):
            raise Refusal(Code.WRONG_STATE, self.state)
        return super().arm(token)


@fault("start-without-arm")
class StartWithoutArm(Device):
    """START in IDLE is obeyed."""

    def start(self) -> State:
        if self.state == State.IDLE:
            self.arm(self.boot_id)
        return super().start()


@fault("outputs-told-off")
class OutputsToldOff(Device):
    """outputs_on is 0, whatever is on."""

    def heartbeat_fields(self) -> dict[str, Any]:
        return super().heartbeat_fields() | {"outputs_on": 0}


@fault("armed-for-ever")
class ArmedForEver(Device):
    """ARMED does not lapse."""

    def advance(self) -> None:
        self._armed_at = self.tick()
        super().advance()


def _watchdog_at(share: float) -> type[Device]:
    """The watchdog waits for this share of its time, whatever it tells."""

    class WatchdogAt(Device):
        def watchdog_expired(self) -> bool:
            waits = self.value("watchdog", self.watchdog) * share
            return self.tick() - self._fed_at >= waits * 1e6

    return WatchdogAt


fault("watchdog-late")(_watchdog_at(2.0))
fault("watchdog-early")(_watchdog_at(0.75))


@fault("watchdog-fed-by-requests")
class WatchdogFedByRequests(Device):
    """Any request feeds the watchdog."""

    def execute(self, message: Message, peer: Peer) -> bytes:
        if message.type != Type.SETPOINT:
            self._fed_at = self.tick()
        return super().execute(message, peer)


@fault("watchdog-fed-by-rejected")
class WatchdogFedByRejected(Device):
    """A rejected setpoint feeds the watchdog."""

    def reject(self, code: int, detail: float) -> None:
        super().reject(code, detail)
        self._fed_at = self.tick()


@fault("fault-clear-any")
class FaultClearAny(Device):
    """FAULT_CLEAR clears whatever it names."""

    def clear(self, faults: int) -> State:
        return super().clear(self.faults)


@fault("setpoint-clipped")
class SetpointClipped(Device):
    """A setpoint beyond the limit is made the limit."""

    def set_point(self, mode: int, value: float, value2: float) -> None:
        try:
            super().set_point(mode, value, value2)
        except Refusal as refusal:
            if refusal.code != Code.OUT_OF_RANGE:
                raise
            super().set_point(mode, math.copysign(refusal.detail, value), value2)


@fault("rejections-uncounted")
class RejectionsUncounted(Device):
    """Rejected setpoints are not counted."""

    def heartbeat_fields(self) -> dict[str, Any]:
        return super().heartbeat_fields() | {"setpoints_rejected": 0}


@fault("edges-uncounted")
class EdgesUncounted(Device):
    """The heartbeat counts half of the edges."""

    def heartbeat_fields(self) -> dict[str, Any]:
        return super().heartbeat_fields() | {"edges": self.edges // 2}


# -- CAN --------------------------------------------------------------------------------------------------------------


def _assembles(assembler: type[Assembler]) -> type[Device]:
    """Transfers are put together like this."""

    class OtherAssembler(Device):
        def attach(self, carrier: Any) -> None:
            super().attach(carrier)
            carrier.assembler = assembler

    return OtherAssembler


class _TakesRepeated(Assembler):
    def repeated(self, data: bytes) -> bool:
        single = data[-1] & 0xC0 == 0xC0
        return super().repeated(data) and not single


class _AnyToggle(Assembler):
    @staticmethod
    def expected(tail: int, toggle_and_id: int) -> bool:
        return tail & 31 == toggle_and_id & 31


fault("can-repeated-executed")(_assembles(_TakesRepeated))
fault("can-toggle-unchecked")(_assembles(_AnyToggle))


@fault("can-stop-frame-ignored")
class CanStopFrameIgnored(Device):
    """A frame of class 0 does nothing."""

    def stop_frame(self) -> None:
        self.stops.append(self.seconds)


@fault("can-node-0-answered")
class CanNode0Answered(Device):
    """Any request to node 0 is answered."""

    def attach(self, carrier: Any) -> None:
        super().attach(carrier)
        carrier.for_everybody = tuple(Type)
