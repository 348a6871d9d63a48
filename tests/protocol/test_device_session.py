"""The device's end: at most once, explicit refusals, states, watchdog, parameters. Time is in ticks."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
from small_drive import DEFAULTS, FEATURES, SmallDrive, frames_in, identity, small_link, wire_of

from protocol.device.session import DeviceLink
from protocol.device.tx import TxQueue
from protocol.errors import Refused
from protocol.framing import Frame
from protocol.messages import (
    REPLIES,
    BlobRead,
    BlobReply,
    BlobWrite,
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
    MessageType,
    ParamCommit,
    ParamGet,
    ParamSet,
    Payload,
    Request,
    Setpoint,
    SetpointMode,
    StateCommand,
    StreamEvent,
    StreamGet,
    StreamInfo,
    StreamSet,
)
from protocol.signals import Flag, Parameter, RawType, Signal, Unit

HZ = 20_000_000
BOOT_ID = 0xB0071D


class Wire:
    """Talks to a link as a host would, frame by frame, without a `HostSession`."""

    def __init__(self, link: DeviceLink) -> None:
        self.link = link
        self.session = link.sessions[1]
        self.app = self.session.app
        self.tids = itertools.count(1)

    def frames(self) -> list[Frame]:
        return frames_in(self.link.data_to_send())

    def ask(self, message: Request) -> Payload:
        """Return the reply, whatever else comes before it."""
        tid = next(self.tids)
        self.link.receive(wire_of(message, tid))
        (reply,) = [frame for frame in self.frames() if frame.is_reply and frame.tid == tid]
        assert reply.type == message.TYPE
        return (ErrorReply if reply.is_error else REPLIES[message.TYPE]).unpack(reply.payload)


class ManyChannels(SmallDrive):
    channels = tuple(Signal(n, f"c{n}", Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL, "") for n in range(1, 101))


def test_a_stream_is_told_with_as_many_ids_as_the_host_takes() -> None:
    link = DeviceLink(TxQueue())
    link.add(ManyChannels(), identity())
    wire = Wire(link)
    for rx_max, ids in ((1024, 100), (226, 100), (225, 99), (128, 51)):
        wire.ask(Hello(7, 1, 1, rx_max))
        wire.ask(StreamSet(0, StreamEvent.PWM, 1, 0, tuple(range(1, 101))))
        wire.ask(Hello(7, 1, 1, rx_max))
        told = wire.ask(StreamGet(0))
        assert isinstance(told, StreamInfo)
        assert told.channels == tuple(range(1, ids + 1))


@pytest.fixture
def wire() -> Wire:
    return Wire(small_link()[0])


def refusing(refusal: Refused) -> Callable[..., None]:
    def refuse(*_: object) -> None:
        raise refusal

    return refuse


def test_boot_ends_with_the_first_tick() -> None:
    link = DeviceLink()
    session = link.add(SmallDrive(), identity())
    wire = Wire(link)
    assert session.state is wire.ask(Hello(1)).state is DriveState.BOOT
    expected = ErrorReply(ErrorCode.WRONG_STATE, MessageType.STATE_CMD, DriveState.BOOT)
    assert wire.ask(StateCommand(Command.ARM, BOOT_ID)) == expected
    link.advance(0)
    assert session.state is DriveState.IDLE


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, ("", "")),
        ({"serial": "33FFD8054D48383611571943", "build": "9f2c61e"}, ("33FFD8054D48383611571943", "9f2c61e")),
        ({"serial": "0123456789" * 3, "build": "µ" * 13}, ("012345678901234567890123", "µ" * 12)),
    ],
)
def test_serial_and_build_are_told_in_the_smallest_frame_and_cut(given: dict[str, str], told: tuple[str, str]) -> None:
    reply = Wire(small_link(**given)[0]).ask(Hello(1, rx_max=128))
    assert (reply.serial, reply.build) == told
    assert len(reply.pack()) == 116


def test_the_drive_may_refuse_to_be_armed(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire.app, "enter_state", refusing(Refused("DC link too low", ErrorCode.BUSY, 17.5)))
    refusal = ErrorReply(ErrorCode.BUSY, MessageType.STATE_CMD, 17.5)
    assert wire.ask(StateCommand(Command.ARM, BOOT_ID)) == refusal
    assert wire.session.state is DriveState.IDLE


def test_a_fault_whose_cause_is_still_there_is_not_cleared(wire: Wire) -> None:
    wire.session.fault(Fault.UNDERVOLTAGE)
    wire.app.persisting = Fault.UNDERVOLTAGE
    clear = StateCommand(Command.FAULT_CLEAR, Fault.UNDERVOLTAGE)
    assert wire.ask(clear) == ErrorReply(ErrorCode.FAULT_PERSISTS, MessageType.STATE_CMD, Fault.UNDERVOLTAGE)
    assert wire.session.state is DriveState.FAULT
    wire.app.persisting = Fault(0)
    assert wire.ask(clear).state is DriveState.IDLE


def test_commit(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    wire.ask(ParamCommit())
    assert wire.app.commits == 1
    monkeypatch.setattr(wire.app, "commit", refusing(Refused("no file", ErrorCode.NOT_SUPPORTED)))
    assert wire.ask(ParamCommit()) == ErrorReply(ErrorCode.NOT_SUPPORTED, MessageType.PARAM_COMMIT, 0.0)


def test_unread_heartbeats_do_not_pile_up(wire: Wire) -> None:
    for tick in range(0, 20 * HZ, HZ // 10):
        wire.link.advance(tick)
    beats = [Heartbeat.unpack(frame.payload) for frame in wire.frames() if frame.type == MessageType.HEARTBEAT]
    assert [beat.tick for beat in beats] == [tick]


def test_a_node_has_a_number_of_its_own() -> None:
    link, _, _ = small_link()
    link.add(SmallDrive(), identity(node=255))
    for taken in (1, 256):
        with pytest.raises(ValueError, match=f"node {taken} is taken or not in 1..255"):
            link.add(SmallDrive(), identity(node=taken))


def test_events_leave_room_for_replies(wire: Wire) -> None:
    for counter in range(5000):
        wire.link.receive(wire_of(Setpoint(SetpointMode.SPEED, counter, 1.0)))  # all rejected, each with an event
    wire.session.log(6, "Ω" * 5000)
    assert wire.ask(ParamGet(101)).value == DEFAULTS["gain"]
    wire.session.log(6, "Ω" * 5000)
    assert len(wire.frames()) == 1
    assert wire.session.setpoints_rejected == 5000


def test_a_link_that_nobody_reads_keeps_its_replies_bounded(wire: Wire) -> None:
    for tid in range(1, 2000):
        wire.link.receive(wire_of(ParamGet(101), tid))
    assert len(wire.session.tx) <= wire.session.tx.control_limit + 100


# -- what HBP 1.1 adds ------------------------------------------------------------------------------------------------


class Commissioned(SmallDrive):
    """A drive with a parameter that no end of RUNNING outlasts, and a test signal."""

    parameters = (
        *SmallDrive.parameters,
        Parameter(160, "forced_speed", Unit.RAD_PER_S, -100, 100, Flag.PARAMETER | Flag.VOLATILE, ""),
        Parameter(164, "test", Unit.NONE, 0, 5, Flag.PARAMETER | Flag.WHOLE | Flag.VOLATILE, ""),
    )

    def __init__(self) -> None:
        super().__init__()
        self.values |= {"forced_speed": 0.0, "test": 0.0}

    def default_param(self, name: str) -> float:
        return 0.0 if name in ("forced_speed", "test") else super().default_param(name)


def commissioned(**changes: object) -> Wire:
    link = DeviceLink()
    link.add(Commissioned(), identity(**changes))
    link.advance(0)
    return Wire(link)


def changes_in(frames: list[Frame]) -> list[tuple[float, float]]:
    events = [DeviceEvent.unpack(frame.payload) for frame in frames if frame.type == MessageType.EVENT]
    return [(event.arg, event.detail) for event in events if event.code == EventCode.PARAM_CHANGED]


@pytest.mark.parametrize("end", ["stop", "fault", "watchdog"])
def test_volatile_parameters_are_at_their_default_once_running_has_ended(end: str) -> None:
    wire = commissioned()
    for request in (ParamSet(160, 50.0), ParamSet(101, 7.5)):
        wire.ask(request)
    for command, argument in ((Command.ARM, BOOT_ID), (Command.START, 0)):
        wire.ask(StateCommand(command, argument))
    wire.ask(ParamSet(164, 2.0))
    assert wire.app.values["forced_speed"] == 50.0  # set before START, still there
    wire.frames()
    if end == "stop":
        wire.link.receive(wire_of(StateCommand(Command.STOP, 0), 99))
    elif end == "fault":
        wire.session.fault(Fault.OVERCURRENT)
    else:
        wire.link.advance(HZ // 4)
    assert not wire.app.outputs_on
    assert changes_in(wire.frames()) == [(160, 0.0), (164, 0.0)]
    assert (wire.app.values["forced_speed"], wire.app.values["test"], wire.app.values["gain"]) == (0.0, 0.0, 7.5)


def test_a_change_of_a_parameter_is_told_once_and_no_other() -> None:
    wire = commissioned()
    told = []
    for request in (ParamSet(101, 7.5), ParamSet(101, 7.5), ParamSet(101, -1.0), ParamSet(102, 3.0), ParamSet(9, 1.0)):
        wire.link.receive(wire_of(request, next(wire.tids)))
        told.append(changes_in(wire.frames()))
    assert told == [[(101, 7.5)], [], [], [(102, 3.0)], []]


def test_the_waveform_is_the_apps_memory_and_is_left_alone_while_a_test_signal_is_on() -> None:
    wire = commissioned(features=Feature.WAVEFORM)
    assert isinstance(wire.ask(BlobWrite(4, 4, 2, b"\x01\x02\xff\x7f")), Empty)
    assert wire.app.waveform[:4].tolist() == [0, 0x0201, 32767, 0]
    wire.app.waveform[255] = -2
    assert wire.ask(BlobRead(4, 100, 510)) == BlobReply(4, 2, 510, 512, b"\xfe\xff")
    wire.ask(ParamSet(164, 1.0))
    assert wire.ask(BlobWrite(4, 2, 0, b"\x05\x05")) == ErrorReply(ErrorCode.BUSY, MessageType.BLOB_WRITE, 4.0)
    assert wire.app.waveform[0] == 0
    wire.ask(ParamSet(164, 0.0))
    assert isinstance(wire.ask(BlobWrite(4, 2, 0, b"\x05\x05")), Empty)


def test_meanings_are_lines_and_features_are_those_that_there_is_something_for() -> None:
    wire = commissioned(features=FEATURES, capture_bytes=0)
    assert wire.ask(Hello(1)).features == FEATURES & ~Feature.CAPTURE
    blob = wire.ask(BlobRead(3, 1000, 0)).data
    assert blob == "theta angle, ±π\ngain of everything\n".encode()


@pytest.mark.parametrize(
    ("meanings", "words"),
    [
        ({"nothing": "x"}, "'nothing', which is neither channel nor parameter"),
        ({"gain": "two\nlines"}, "'gain' has control characters, or more than 200 bytes"),
        ({"gain": "ü" * 101}, "'gain' has control characters, or more than 200 bytes"),
    ],
)
def test_a_meaning_that_cannot_be_is_a_bug_of_the_app(meanings: dict[str, str], words: str) -> None:
    app = SmallDrive()
    app.meanings = meanings  # type: ignore[assignment]
    with pytest.raises(ValueError, match=words):
        DeviceLink().add(app, identity(features=Feature.MEANINGS))
