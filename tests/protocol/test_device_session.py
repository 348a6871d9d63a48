"""The device's end: at most once, explicit refusals, states, watchdog, parameters. Time is in ticks."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
from small_drive import DEFAULTS, SmallDrive, frames_in, identity, small_link, wire_of

from protocol.device.session import DeviceLink
from protocol.device.tx import TxQueue
from protocol.errors import Refused
from protocol.framing import Frame
from protocol.messages import (
    REPLIES,
    Command,
    DriveState,
    ErrorCode,
    ErrorReply,
    Fault,
    Heartbeat,
    Hello,
    MessageType,
    ParamCommit,
    ParamGet,
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
from protocol.signals import Flag, RawType, Signal, Unit

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
