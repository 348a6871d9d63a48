"""Two hosts on one bus, devices that answer for one another, messages on identifiers that are not theirs."""

from __future__ import annotations

import numpy as np
import pytest
from can_pair import CLASSIC, FD, CanPair

from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.canmap.host import CanWire
from protocol.canmap.ids import CanClass, CanId
from protocol.canmap.transport import TransferEncoder
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.framing import ERROR, MAJOR, REPLY, Frame
from protocol.host import HeartbeatReceived, HostSession, ReplyReceived, RequestRefused
from protocol.messages import (
    Alive,
    Command,
    DriveState,
    ErrorCode,
    ErrorReply,
    Heartbeat,
    Hello,
    MessageType,
    ParamGet,
    ParamReply,
    Setpoint,
    SetpointMode,
    StateCommand,
    StreamEvent,
    StreamSet,
    TimeSync,
)
from protocol.streams import StreamConfig, TickReference

BOOT_ID = 0xB0071D


def running(rates: BusRates) -> CanPair:
    bus = CanPair(rates)
    bus.connect()
    bus.ask(StateCommand(Command.ARM, BOOT_ID))
    bus.ask(StateCommand(Command.START, 0))
    assert bus.app.outputs_on
    return bus


def send(bus: CanPair, frame: Frame, can_id: CanId, encoder: TransferEncoder) -> None:
    bus.device.receive(encoder.encode(can_id, frame.pack()))


def answers(bus: CanPair, host: int) -> list[tuple[int, bytes]]:
    """What the device says to a host: (tid, header and payload)."""
    wire = CanWire(CLASSIC, 1, False, host)
    return [
        (int.from_bytes(message[2:4], "little"), message)
        for message in wire.feed(bus.device.tx.take(), 0.0)
        if isinstance(message, bytes) and message[1] & REPLY
    ]


def test_a_repeated_request_is_executed_once_whatever_another_host_does_meanwhile() -> None:
    bus = CanPair(CLASSIC)
    encoders = [TransferEncoder(False, False), TransferEncoder(False, False)]

    def ask(host: int, tid: int, message: object) -> list[tuple[int, bytes]]:
        frame = Frame(message.TYPE, MAJOR, tid, 1, message.pack())  # type: ignore[attr-defined]
        send(bus, frame, CanId(CanClass.TO_DEVICE, 1, host), encoders[host])
        return answers(bus, host)

    ask(0, 1, Hello(1))
    ask(0, 2, StateCommand(Command.ARM, BOOT_ID))
    ask(0, 3, StateCommand(Command.START, 0))
    assert bus.app.outputs_on
    ask(1, 9, StateCommand(Command.STOP, 0))
    assert not bus.app.outputs_on
    ask(1, 1, Hello(2))
    for tid in range(20, 30):
        ask(1, tid, ParamGet(101))
    ask(1, 10, StateCommand(Command.ARM, BOOT_ID))
    assert bus.device.session.state is DriveState.ARMED
    repeated = ask(0, 3, StateCommand(Command.START, 0))  # its reply was lost
    assert bus.device.session.state is DriveState.ARMED
    assert not bus.app.outputs_on
    assert [tid for tid, _ in repeated] == [3]
    # the same tid and content from the other host are another request
    assert [tid for tid, _ in ask(1, 3, StateCommand(Command.STOP, 0))] == [3]
    assert bus.device.session.state is DriveState.IDLE


def test_a_message_on_an_identifier_that_is_not_its_own_is_not_obeyed() -> None:
    bus = CanPair(CLASSIC)
    arm = Frame(MessageType.STATE_CMD, MAJOR, 5, 1, StateCommand(Command.ARM, BOOT_ID).pack())
    alive = Frame(MessageType.ALIVE, MAJOR, 0, 1, Alive(1).pack())
    encoder = TransferEncoder(False, False)
    bus.device.tx.take()
    for frame, can_id in (
        (arm, CanId(CanClass.STATUS, 1, 5)),
        (arm._replace(node=0), CanId(CanClass.TO_DEVICE, 0, 0)),
        (alive, CanId(CanClass.TO_DEVICE, 1, 0)),
        (alive, CanId(CanClass.STATUS, 1, 1)),
    ):
        send(bus, frame, can_id, encoder)
    assert bus.device.session.state is DriveState.IDLE
    assert bus.device.counters.foreign == 4
    assert not bus.device.tx.take()
    for can_id in (CanId(CanClass.STATUS, 2, 5), CanId(CanClass.TO_DEVICE, 2, 0), CanId(CanClass.TO_HOST, 1, 0)):
        send(bus, arm, can_id, encoder)
    assert bus.device.counters.foreign > 4
    assert bus.device.session.state is DriveState.IDLE


def test_setpoint_and_alive_have_identifiers_of_their_own() -> None:
    bus = running(FD)
    bus.host.send(Setpoint(SetpointMode.SPEED, 7, 12.5, 0.0), 1)
    bus.host.send(Alive(1), 1)
    bus.exchange()
    assert bus.app.setpoints == [(SetpointMode.SPEED, 12.5, 0.0)]
    assert bus.to_device[-1]["id"].tolist() == [0x111, 0x115]


def test_stop_goes_ahead_and_needs_no_reply() -> None:
    bus = running(CLASSIC)
    bus.host.request(StateCommand(Command.STOP, 0), 1, bus.now)
    records = np.frombuffer(bus.host.data_to_send(), CAN_RECORD)
    assert (records["id"][0], records["length"][0]) == (0x010, 0)
    bus.device.receive(records[:1].tobytes())
    assert not bus.app.outputs_on
    assert bus.device.session.state is DriveState.IDLE
    bus.device.receive(records[1:].tobytes())
    bus.exchange()
    assert isinstance(bus.events[-1], ReplyReceived)


def host_with_request(request: object, node: int = 1) -> tuple[HostSession, TransferEncoder, int]:
    host = HostSession(CanWire(CLASSIC))
    tid = host.request(request, node, 0.0)  # type: ignore[arg-type]
    return host, TransferEncoder(False, False), tid


def test_a_reply_that_was_meant_for_another_host_settles_nothing() -> None:
    host, encoder, tid = host_with_request(ParamGet(102))

    def reply(number: int) -> bytes:
        payload = ParamReply(number, 1.0, 0.0, 2.0, 1.0).pack()
        return encoder.encode(CanId(CanClass.TO_HOST, 1, 0), Frame(0x11, MAJOR | REPLY, tid, 1, payload).pack())

    host.receive_data(reply(101), 0.1)
    assert host.next_event() is None
    assert host.counters.unexpected_replies == 1
    host.receive_data(reply(102), 0.1)
    event = host.next_event()
    assert isinstance(event, ReplyReceived)
    assert event.message.id == 102


def test_an_error_of_another_node_settles_nothing() -> None:
    host, encoder, tid = host_with_request(TimeSync())

    def error(code: ErrorCode) -> bytes:
        frame = Frame(0x02, MAJOR | REPLY | ERROR, tid, 9, ErrorReply(code, 0x02).pack())
        return encoder.encode(CanId(CanClass.TO_HOST, 9, 0), frame.pack())

    host.receive_data(error(ErrorCode.BUSY), 0.1)
    assert host.next_event() is None
    host.receive_data(error(ErrorCode.UNKNOWN_NODE), 0.1)
    assert isinstance(host.next_event(), RequestRefused)


def test_hosts_on_a_bus_do_not_start_with_the_same_tid() -> None:
    tids = {HostSession(CanWire(CLASSIC)).connect(nonce, 0.0) for nonce in (1, 2, 0x1234FFFF)}
    assert len(tids - {0}) == 3


@pytest.mark.parametrize("tick", [1 << 62, (1 << 64) - 1])
def test_a_heartbeat_from_the_end_of_time_is_no_heartbeat(tick: int) -> None:
    bus = CanPair(FD)
    heartbeat = Heartbeat(tick, 1, 0, 0, 0, 0, 0, 0, 0, 0, DriveState.IDLE, False)  # type: ignore[arg-type]
    frame = Frame(MessageType.HEARTBEAT, MAJOR, 0, 1, heartbeat.pack())
    bus.connect()
    bus.stream(("i_a",))
    bus.run(1600)
    bus.receive(
        np.frombuffer(TransferEncoder(True, False).encode(CanId(CanClass.STATUS, 1, 4), frame.pack()), CAN_RECORD)
    )
    bus.run(3200, tuple(range(1, 3200, 100)))
    assert tick not in [e.heartbeat.tick for e in bus.events if isinstance(e, HeartbeatReceived)]
    assert bus.host.counters.malformed == 1
    assert (np.diff(bus.samples().index) == 1).all()


def test_what_cannot_be_on_a_bus_is_refused() -> None:
    wire = CanWire(CLASSIC)
    with pytest.raises(LocalProtocolError, match="there is no node 16 on a CAN bus"):
        wire.encode(Frame(0x02, MAJOR, 1, 16, b""))
    for event, slot in ((StreamEvent.EDGES, 16), (StreamEvent.PWM, 32)):
        config = StreamConfig(1, 0, 1, event, 1, (), 1, slot, tick_hz=20_000_000, pwm_hz=16_000)
        with pytest.raises(RemoteProtocolError, match=f"slot {slot}"):
            wire.decoder(config, TickReference())


def test_edge_streams_never_share_a_slot() -> None:
    bus = CanPair(FD)
    bus.connect()
    first = bus.ask(StreamSet(0, StreamEvent.EDGES, 1, 20))
    for _ in range(40):
        other = bus.ask(StreamSet(1, StreamEvent.EDGES, 1, 20))
        assert other.slot != first.slot
