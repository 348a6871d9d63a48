"""The device's end: at most once, explicit refusals, states, watchdog, parameters. Time is in ticks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from small_drive import DEFAULTS, PARAMETERS, SmallDrive, frames_in, identity, small_link, wire_of

from protocol.device.session import DeviceLink
from protocol.errors import Refused
from protocol.framing import ERROR, MAJOR, REPLY, Frame, encode_frame
from protocol.messages import (
    REPLIES,
    Alive,
    BlobRead,
    Command,
    DeviceEvent,
    DriveState,
    ErrorCode,
    ErrorReply,
    EventCode,
    Fault,
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
    StreamStop,
    TimeSync,
)

HZ = 20_000_000
BOOT_ID = 0xB0071D


class Wire:
    """Talks to a link as a host would, frame by frame, without a `HostSession`."""

    def __init__(self, link: DeviceLink) -> None:
        self.link = link
        self.session = link.sessions[1]
        self.app = self.session.app
        self.tids = itertools.count(1)
        self.tick = 0

    def frames(self) -> list[Frame]:
        return frames_in(self.link.data_to_send())

    def ask(self, message: Request, tid: int | None = None, node: int = 1) -> Payload:
        """Return the reply, whatever else comes before it."""
        tid = next(self.tids) if tid is None else tid
        self.link.receive(wire_of(message, tid, node))
        replies = [frame for frame in self.frames() if frame.is_reply and frame.tid == tid]
        assert len(replies) == 1
        assert replies[0].type == message.TYPE
        return (ErrorReply if replies[0].is_error else REPLIES[message.TYPE]).unpack(replies[0].payload)

    def tell(self, message: Request) -> None:
        self.link.receive(wire_of(message))

    def wait(self, seconds: float) -> None:
        self.tick += round(seconds * HZ)
        self.link.advance(self.tick)

    def events(self) -> list[tuple[int, float]]:
        events = (DeviceEvent.unpack(frame.payload) for frame in self.frames() if frame.type == MessageType.EVENT)
        return [(event.code, event.arg) for event in events]

    def heartbeats(self) -> list[Heartbeat]:
        return [Heartbeat.unpack(frame.payload) for frame in self.frames() if frame.type == MessageType.HEARTBEAT]


@pytest.fixture
def wire() -> Wire:
    return Wire(small_link()[0])


def refusing(refusal: Refused) -> Callable[..., None]:
    def refuse(*_: object) -> None:
        raise refusal

    return refuse


def run(wire: Wire) -> None:
    assert wire.ask(StateCommand(Command.ARM, BOOT_ID)).state is DriveState.ARMED
    assert wire.ask(StateCommand(Command.START)).state is DriveState.RUNNING


def test_boot_ends_with_the_first_tick() -> None:
    link = DeviceLink()
    session = link.add(SmallDrive(), identity())
    wire = Wire(link)
    assert session.state is wire.ask(Hello(1)).state is DriveState.BOOT
    expected = ErrorReply(ErrorCode.WRONG_STATE, MessageType.STATE_CMD, DriveState.BOOT)
    assert wire.ask(StateCommand(Command.ARM, BOOT_ID)) == expected
    link.advance(0)
    assert session.state is DriveState.IDLE


def test_hello_tells_who_it_is_and_changes_nothing(wire: Wire) -> None:
    run(wire)
    reply = wire.ask(Hello(77), node=0)
    assert (reply.nonce, reply.boot_id, reply.node, reply.nodes) == (77, BOOT_ID, 1, 1)
    assert (reply.major, reply.minor, reply.name, reply.firmware) == (1, 0, "small", "1.0")
    assert (reply.tick_hz, reply.pwm_hz, reply.ticks_per_period) == (HZ, 16_000, 1250)
    assert (reply.schema_crc, reply.state) == (wire.session.descriptor.crc, DriveState.RUNNING)
    assert wire.app.outputs_on


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


def test_descriptor_is_read_in_parts(wire: Wire) -> None:
    wire.ask(Hello(1, rx_max=128))
    blob = b""
    while True:
        reply = wire.ask(BlobRead(0, 1000, len(blob)))
        assert len(reply.data) <= 128 - 12
        blob += reply.data
        if len(blob) == reply.total:
            break
    assert blob == wire.session.descriptor.pack()
    assert wire.ask(BlobRead(0, 8, len(blob))).data == b""
    expected = ErrorReply(ErrorCode.OUT_OF_RANGE, MessageType.BLOB_READ, len(blob))
    assert wire.ask(BlobRead(0, 8, len(blob) + 1)) == expected


def test_a_repeated_request_is_answered_but_not_executed_again(wire: Wire) -> None:
    first = wire.ask(ParamSet(101, 7.0), tid=50)
    wire.app.values["gain"] = 8.0
    assert wire.ask(ParamSet(101, 7.0), tid=50) == first
    assert (wire.app.values["gain"], wire.app.calls) == (8.0, 1)
    wire.ask(ParamSet(101, 7.5), tid=50)  # same tid, other payload: another request
    assert (wire.app.values["gain"], wire.app.calls) == (7.5, 2)


def test_four_replies_are_kept(wire: Wire) -> None:
    for tid, calls in ((1, 1), (2, 2), (3, 3), (4, 4), (1, 4), (2, 4), (3, 4), (4, 4), (5, 5), (1, 6)):
        wire.ask(ParamSet(101, tid), tid=tid)
        assert wire.app.calls == calls


def test_a_new_host_may_use_the_same_tids(wire: Wire) -> None:
    for nonce, calls in ((1, 1), (1, 1), (2, 2)):  # a late repetition forgets nothing
        wire.ask(Hello(nonce), tid=1)
        wire.ask(ParamSet(101, 7.0), tid=2)
        assert wire.app.calls == calls


def test_time_is_never_replayed(wire: Wire) -> None:
    before = wire.ask(TimeSync(), tid=9).tx_tick
    wire.wait(0.01)
    assert wire.ask(TimeSync(), tid=9).tx_tick == before + HZ // 100


# States


def test_the_way_to_running_and_back(wire: Wire) -> None:
    run(wire)
    assert wire.app.outputs_on
    assert wire.ask(StateCommand(Command.STOP)).state is DriveState.IDLE
    assert not wire.app.outputs_on
    assert wire.app.states == [DriveState.IDLE, DriveState.ARMED, DriveState.RUNNING, DriveState.IDLE]


def test_armed_lapses_after_five_seconds(wire: Wire) -> None:
    wire.ask(StateCommand(Command.ARM, BOOT_ID))
    for _ in range(49):
        wire.wait(0.1)
        wire.tell(Alive(1))
    assert wire.session.state is DriveState.ARMED
    wire.frames()
    wire.wait(0.1)
    assert wire.session.state is DriveState.IDLE
    assert wire.events() == [(EventCode.ARM_LAPSED, 5.0), (EventCode.STATE_CHANGED, DriveState.IDLE)]
    assert not wire.app.outputs_on


def test_arming_starts_the_watchdog_and_arming_again_the_five_seconds(wire: Wire) -> None:
    wire.wait(60.0)
    for _ in range(60):
        wire.ask(StateCommand(Command.ARM, BOOT_ID))
        wire.wait(0.15)
    assert wire.session.state is DriveState.ARMED


def test_the_drive_may_refuse_to_be_armed(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire.app, "enter_state", refusing(Refused("DC link too low", ErrorCode.BUSY, 17.5)))
    refusal = ErrorReply(ErrorCode.BUSY, MessageType.STATE_CMD, 17.5)
    assert wire.ask(StateCommand(Command.ARM, BOOT_ID)) == refusal
    assert wire.session.state is DriveState.IDLE


@pytest.mark.parametrize("armed_only", [True, False])
def test_the_watchdog_ends_in_fault_with_outputs_off(wire: Wire, armed_only: bool) -> None:
    if armed_only:
        wire.ask(StateCommand(Command.ARM, BOOT_ID))
    else:
        run(wire)
    wire.wait(0.1999)
    assert wire.session.state is not DriveState.FAULT
    wire.frames()
    wire.wait(0.0001)
    assert wire.session.state is DriveState.FAULT
    assert not wire.app.outputs_on
    assert wire.events() == [(EventCode.STATE_CHANGED, DriveState.FAULT), (EventCode.FAULT, Fault.WATCHDOG)]
    assert wire.session.heartbeat().first_fault == Fault.WATCHDOG


def test_only_alive_and_accepted_setpoints_feed_the_watchdog(wire: Wire) -> None:
    run(wire)
    for feeding in (Alive(1), Setpoint(SetpointMode.SPEED, 1, 50.0)):
        wire.wait(0.15)
        wire.tell(feeding)
        wire.wait(0.15)
        assert wire.session.state is DriveState.RUNNING
        wire.tell(Alive(2))
    wire.wait(0.15)
    for other in (Hello(5), ParamGet(101), BlobRead(0, 10, 0), TimeSync(), StateCommand(Command.START), StreamStop()):
        wire.ask(other)
    wire.tell(Setpoint(SetpointMode.SPEED, 2, 1e9))  # out of range
    wire.tell(Setpoint(SetpointMode.TORQUE, 3, 1.0))  # a mode that it does not have
    wire.wait(0.05)
    assert wire.session.state is DriveState.FAULT
    assert not wire.app.outputs_on


def test_the_watchdog_time_is_a_parameter(wire: Wire) -> None:
    wire.ask(ParamSet(104, 0.5))
    run(wire)
    wire.wait(0.4)
    assert wire.session.heartbeat().watchdog_ms == 100
    assert wire.session.state is DriveState.RUNNING
    wire.wait(0.1)
    assert wire.session.state is DriveState.FAULT
    assert wire.session.heartbeat().watchdog_ms == 0xFFFF


def test_faults_latch_and_are_cleared_by_name(wire: Wire) -> None:
    run(wire)
    wire.session.fault(Fault.OVERCURRENT)
    assert not wire.app.outputs_on
    wire.session.fault(Fault.UNDERVOLTAGE | Fault.OVERCURRENT)
    beat = wire.session.heartbeat()
    assert (beat.faults, beat.first_fault) == (Fault.OVERCURRENT | Fault.UNDERVOLTAGE, Fault.OVERCURRENT)
    assert wire.ask(StateCommand(Command.STOP)).state is DriveState.FAULT  # outputs stay off, the latch stays
    kind = MessageType.STATE_CMD
    assert wire.ask(StateCommand(Command.ARM, BOOT_ID)) == ErrorReply(ErrorCode.WRONG_STATE, kind, DriveState.FAULT)
    clear = StateCommand(Command.FAULT_CLEAR, Fault.OVERCURRENT)
    assert wire.ask(clear) == ErrorReply(ErrorCode.FAULTS_CHANGED, kind, 10)
    wire.app.persisting = Fault.UNDERVOLTAGE
    clear = StateCommand(Command.FAULT_CLEAR, Fault.OVERCURRENT | Fault.UNDERVOLTAGE)
    assert wire.ask(clear) == ErrorReply(ErrorCode.FAULT_PERSISTS, kind, Fault.UNDERVOLTAGE)
    assert wire.session.state is DriveState.FAULT
    wire.app.persisting = Fault(0)
    assert wire.ask(clear).state is DriveState.IDLE
    beat = wire.session.heartbeat()
    assert (beat.faults, beat.first_fault) == (0, 0)
    assert wire.ask(clear) == ErrorReply(ErrorCode.WRONG_STATE, kind, DriveState.IDLE)


def test_a_fault_in_idle_latches_as_well(wire: Wire) -> None:
    wire.session.fault(Fault.HALL)
    assert wire.session.state is wire.ask(Hello(1)).state is DriveState.FAULT


# Setpoints


def test_setpoints_are_counted_whether_accepted_or_not(wire: Wire) -> None:
    wire.tell(Setpoint(SetpointMode.SPEED, 1, 10.0))  # not in IDLE
    run(wire)
    wire.tell(Setpoint(SetpointMode.SPEED, 2, 10.0))
    wire.tell(Setpoint(SetpointMode.SPEED, 3, 301.0))
    wire.tell(Setpoint(SetpointMode.SPEED, 4, math.nan))
    wire.tell(Setpoint(SetpointMode.SPEED, 5, 0.0, math.inf))
    wire.tell(Setpoint(SetpointMode.CURRENT, 6, 1.0))
    assert wire.app.setpoints == [(SetpointMode.SPEED, 10.0, 0.0)]
    beat = wire.session.heartbeat()
    assert (beat.setpoint_counter, beat.setpoints_rejected) == (2, 5)


# Parameters


def test_parameters_are_read_with_range_and_default(wire: Wire) -> None:
    wire.app.values["gain"] = 7.25
    reply = wire.ask(ParamGet(101))
    gain = PARAMETERS[0]
    assert (reply.value, reply.default) == (7.25, DEFAULTS["gain"])
    assert (reply.lo, reply.hi) == (float(np.float32(gain.lo)), float(np.float32(gain.hi)))


@pytest.mark.parametrize("value", [0.1, 1e-4, 1e5])  # also the ends of the range, although float32 rounds them
def test_the_reply_is_the_value_really_stored(wire: Wire, value: float) -> None:
    assert wire.ask(ParamSet(101, value)).stored == float(np.float32(value)) == wire.app.values["gain"]


@pytest.mark.parametrize(
    ("message", "code", "detail"),
    [
        (ParamSet(101, 1e6), ErrorCode.OUT_OF_RANGE, 1e5),
        (ParamSet(101, -1.0), ErrorCode.OUT_OF_RANGE, float(np.float32(1e-4))),
        (ParamSet(101, math.inf), ErrorCode.BAD_VALUE, math.inf),
        (ParamSet(102, 2.5), ErrorCode.BAD_VALUE, 2.5),
        (ParamSet(103, 1.0), ErrorCode.READ_ONLY, 103),
    ],
)
def test_what_cannot_be_set_is_refused(wire: Wire, message: ParamSet, code: ErrorCode, detail: float) -> None:
    before = dict(wire.app.values)
    assert wire.ask(message) == ErrorReply(code, MessageType.PARAM_SET, detail)
    assert wire.app.values == before


def test_idle_only_parameters_wait_for_outputs_off(wire: Wire) -> None:
    run(wire)
    refused = ErrorReply(ErrorCode.WRONG_STATE, MessageType.PARAM_SET, DriveState.RUNNING)
    assert wire.ask(ParamSet(102, 4)) == refused
    assert wire.ask(ParamSet(101, 4)).stored == 4
    assert wire.ask(ParamCommit()).code == ErrorCode.WRONG_STATE
    wire.ask(StateCommand(Command.STOP))
    assert wire.ask(ParamSet(102, 4)).stored == 4


def test_commit(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    wire.ask(ParamCommit())
    assert wire.app.commits == 1
    monkeypatch.setattr(wire.app, "commit", refusing(Refused("no file", ErrorCode.NOT_SUPPORTED)))
    assert wire.ask(ParamCommit()) == ErrorReply(ErrorCode.NOT_SUPPORTED, MessageType.PARAM_COMMIT, 0.0)


# Heartbeats and the link


def test_heartbeats_come_ten_times_a_second(wire: Wire) -> None:
    wire.frames()
    beats = []
    for _ in range(1000):
        wire.wait(0.001)
        beats += wire.heartbeats()
    assert [(beat.tick, beat.boot_id) for beat in beats] == [(k * HZ // 10, BOOT_ID) for k in range(1, 11)]


def test_unread_heartbeats_do_not_pile_up(wire: Wire) -> None:
    for _ in range(100):
        wire.wait(0.1)
    assert [beat.tick for beat in wire.heartbeats()] == [wire.tick]


def test_the_heartbeat_names_the_last_tid_and_the_damage(wire: Wire) -> None:
    wire.ask(ParamGet(101), tid=777)
    wire.link.receive(b"\0\x05abc\0")
    beat = wire.session.heartbeat()
    assert (beat.last_tid, beat.rx_bad) == (777, 1)


def test_two_nodes_on_one_link() -> None:
    link, first, _ = small_link()
    second = link.add(SmallDrive(), identity(node=2, boot_id=5))
    link.advance(1)
    wire = Wire(link)
    assert wire.ask(Hello(1), node=0).node == 1
    assert (wire.ask(Hello(1), node=2).node, wire.ask(Hello(1), node=1).nodes) == (2, 2)
    link.data_to_send()
    for flags in (REPLY, ERROR, REPLY | ERROR):  # replies are never answered, whomever they are for
        for node in (9, 1):
            link.receive(encode_frame(Frame(MessageType.PARAM_GET, MAJOR | flags, 5, node, b"")))
    assert link.data_to_send() == b""
    assert first.ignored == 6
    wire.ask(StateCommand(Command.ARM, 5), node=2)
    assert (first.state, second.state) == (DriveState.IDLE, DriveState.ARMED)
    wire.ask(ParamSet(101, 9.0), tid=900, node=1)
    wire.ask(ParamSet(101, 9.0), tid=900, node=2)
    assert first.app.values["gain"] == second.app.values["gain"] == 9.0
    link.add(SmallDrive(), identity(node=255))
    for taken in (2, 256):
        with pytest.raises(ValueError, match=f"node {taken} is taken or not in 1..255"):
            link.add(SmallDrive(), identity(node=taken))


def test_events_leave_room_for_replies(wire: Wire) -> None:
    for counter in range(5000):
        wire.tell(Setpoint(SetpointMode.SPEED, counter, 1.0))  # all rejected, each with an event
    wire.session.log(6, "Ω" * 5000)
    assert wire.ask(ParamGet(101)).value == DEFAULTS["gain"]
    wire.session.log(6, "Ω" * 5000)
    assert len(wire.frames()) == 1
    assert wire.session.setpoints_rejected == 5000


def test_a_link_that_nobody_reads_keeps_its_replies_bounded(wire: Wire) -> None:
    for tid in range(1, 2000):
        wire.link.receive(wire_of(ParamGet(101), tid))
    assert len(wire.session.tx) <= wire.session.tx.control_limit + 100
