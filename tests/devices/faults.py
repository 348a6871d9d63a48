"""What a drive may get wrong, by name. Each is a device that overrides the step at which it happens; they combine.

`build(FULL, ["stop-refused", "watchdog-dead"])` makes a device with both.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np

from tests.devices.device import UNFED, Device, Peer
from tests.devices.motor import Samples
from tests.devices.spec import PWM, Code, Command, Event, Flag, Message, Mode, Raw, Refusal, State, Type, Unit
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


for _name, _argument in (("nan", nan), ("inf", inf), ("negative", -3.5)):
    fault(f"fits-{_name}")(_fits(_argument))


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
