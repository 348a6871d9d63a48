"""The host's end: connect, one request at a time, retries, strangers, reboots. Time is a number here."""

from __future__ import annotations

from dataclasses import replace

import pytest
from small_drive import edges_at, frames_in, samples, small_link, wire_of

from protocol.canmap.frame import BusRates
from protocol.canmap.host import CanWire
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.framing import ERROR, MAJOR, REPLY, Frame, encode_frame
from protocol.host import (
    Connected,
    DeviceEventReceived,
    Event,
    HeartbeatReceived,
    HostSession,
    LogReceived,
    Rebooted,
    ReplyReceived,
    ReplyUnusable,
    RequestRefused,
    RequestTimedOut,
    SeveralDevices,
)
from protocol.messages import (
    Alive,
    BlobRead,
    BlobReply,
    DeviceEvent,
    DriveState,
    Empty,
    ErrorCode,
    ErrorReply,
    Heartbeat,
    Hello,
    HelloReply,
    Log,
    MessageType,
    ParamCommit,
    ParamGet,
    ParamReply,
    ParamSet,
    Request,
    Role,
    StreamEvent,
    StreamSet,
    StreamStart,
    TimeSync,
    TimeSyncReply,
)
from protocol.wire import StreamFrames


def events(host: HostSession) -> list[Event]:
    return list(iter(host.next_event, None))


def only(host: HostSession, kind: type[Event]) -> Event:
    """Return the only event, which must be of this kind."""
    (event,) = events(host)
    assert isinstance(event, kind)
    return event


def sent(host: HostSession) -> list[Frame]:
    return frames_in(host.data_to_send())


def reply(type_: int, tid: int, payload: bytes, node: int = 1, flags: int = REPLY) -> bytes:
    return encode_frame(Frame(type_, MAJOR | flags, tid, node, payload))


def unasked(type_: int, payload: bytes, major: int = MAJOR) -> bytes:
    return encode_frame(Frame(type_, major, 0, 1, payload))


def hello_reply(nonce: int, boot_id: int = 7, node: int = 1) -> bytes:
    _, session, _ = small_link(boot_id=boot_id, node=node)
    return session._hello(Hello(nonce)).pack()


def greeted(answer: bytes) -> HostSession:
    """Return a session whose HELLO with the nonce 5 at t = 0 has had this answer after 10 ms."""
    session = HostSession()
    session.connect(5, 0.0)
    session.data_to_send()
    session.receive_data(b"\0" + reply(1, 1, answer), 0.01)
    return session


@pytest.fixture
def host() -> HostSession:
    """A session connected at t = 0 with a round trip of 10 ms."""
    session = greeted(hello_reply(5))
    events(session)
    return session


def test_connect_ends_half_frames_and_says_hello() -> None:
    host = HostSession()
    host.connect(0x1234, 5.0)
    data = host.data_to_send()
    assert data.startswith(bytes(16))
    assert [Hello.unpack(frame.payload) for frame in frames_in(data)] == [Hello(0x1234)]
    host.receive_data(b"garbage\0" + reply(1, 1, hello_reply(0x1234)), 5.02)
    event = only(host, Connected)
    assert (event.hello.name, host.hellos[1], host.busy) == ("small", event.hello, False)
    assert host.round_trip == pytest.approx(0.02)


def test_hello_is_repeated_with_back_off_for_as_long_as_it_takes() -> None:
    host = HostSession()
    host.connect(1, 0.0)
    host.data_to_send()
    for due in (0.1, 0.3, 0.7, 1.5, 2.5, 3.5, 4.5, 5.5):
        host.tick(due - 1e-6)
        assert sent(host) == []
        host.tick(due * (1 + 1e-9))  # each repetition counts from the one before
        assert [frame.type for frame in sent(host)] == [MessageType.HELLO]
    assert events(host) == []


def test_only_the_matching_nonce_connects() -> None:
    host = greeted(hello_reply(4))
    assert events(host) == []
    assert host.counters.unexpected_replies == 1
    host.receive_data(reply(1, 1, hello_reply(5)), 0.02)
    only(host, Connected)


def test_a_device_of_another_major_is_reported() -> None:
    host = HostSession()
    host.connect(2, 0.0)
    error = ErrorReply(ErrorCode.BAD_VERSION, MessageType.HELLO, 2.0)
    host.receive_data(b"\0" + encode_frame(Frame(1, 2 | REPLY | ERROR, 1, 1, error.pack())), 0.01)
    assert events(host) == [RequestRefused(1, 1, error)]
    host.receive_data(unasked(MessageType.LOG, b"\6hi", major=2), 0.02)
    assert events(host) == []
    assert host.counters.other_versions == 1


def test_one_request_at_a_time(host: HostSession) -> None:
    host.request(ParamGet(5), 1, 1.0)
    with pytest.raises(LocalProtocolError, match="PARAM_SET cannot be sent while PARAM_GET waits for its reply"):
        host.request(ParamSet(5, 1.0), 1, 1.0)
    host.cancel()
    host.request(ParamSet(5, 1.0), 1, 1.0)


def test_acknowledged_and_unacknowledged_messages_do_not_mix(host: HostSession) -> None:
    with pytest.raises(LocalProtocolError, match="ALIVE has no reply: use send"):
        host.request(Alive(1), 1, 1.0)
    with pytest.raises(LocalProtocolError, match="PARAM_GET has a reply: use request"):
        host.send(ParamGet(1), 1)
    host.send(Alive(7), 2)
    assert sent(host) == [Frame(MessageType.ALIVE, MAJOR, 0, 2, Alive(7).pack())]


@pytest.mark.parametrize(("request_", "base"), [(ParamGet(5), 0.1), (ParamCommit(), 2.0)])
def test_three_tries_with_the_same_tid_then_a_time_out(host: HostSession, request_: Request, base: float) -> None:
    tid = host.request(request_, 1, 1.0)
    first = sent(host)
    timeout = base + 2 * 0.01
    for due in (1.0 + timeout, 1.0 + 2 * timeout):
        host.tick(due - 1e-6)
        assert sent(host) == []
        host.tick(due * (1 + 1e-9))
        assert sent(host) == first
    host.tick(1.0 + 3 * timeout + 1e-6)
    assert sent(host) == []
    assert events(host) == [RequestTimedOut(tid, 1, request_.TYPE, 3)]
    assert not host.busy
    assert host.counters.retries == 2
    host.receive_data(reply(MessageType.PARAM_GET, tid, ParamReply(5, 1, 0, 2, 1).pack()), 9.0)
    assert events(host) == []  # too late
    assert host.counters.unexpected_replies == 1


def test_a_reply_after_a_retry_counts_once(host: HostSession) -> None:
    tid = host.request(ParamCommit(), 1, 1.0)
    host.tick(3.5)
    answer = reply(MessageType.PARAM_COMMIT, tid, b"")
    host.receive_data(answer + answer, 3.55)
    event = only(host, ReplyReceived)
    assert (event.tid, event.message) == (tid, Empty())
    assert host.counters.unexpected_replies == 1
    assert host.round_trip == pytest.approx(0.01)  # which transmission was answered is unknown: no measurement


def test_strangers_are_counted_and_dropped(host: HostSession) -> None:
    tid = host.request(ParamGet(5), 1, 1.0)
    good = ParamReply(5, 1, 0, 2, 1).pack()
    strangers = [
        reply(MessageType.PARAM_GET, tid + 1, good),
        reply(MessageType.PARAM_SET, tid, good),
        reply(MessageType.PARAM_GET, tid, good, node=2),
        reply(MessageType.PARAM_GET, 0, ErrorReply(1, 2, 0).pack(), flags=REPLY | ERROR),
    ]
    host.receive_data(b"".join(strangers), 1.01)
    assert host.counters.unexpected_replies == 4
    host.receive_data(unasked(MessageType.HEARTBEAT, bytes(7)) + unasked(MessageType.DATA, bytes(15)), 1.02)
    host.receive_data(reply(MessageType.PARAM_GET, tid, good, flags=ERROR), 1.02)
    assert host.counters.malformed == 3
    host.receive_data(unasked(0x7E, b""), 1.02)
    host.receive_data(reply(MessageType.PARAM_GET, tid, good, flags=0), 1.02)
    assert host.counters.unknown_types == 2
    assert events(host) == []
    assert host.busy
    host.receive_data(reply(MessageType.PARAM_GET, tid, good), 1.03)
    only(host, ReplyReceived)


def unusable(host: HostSession) -> str:
    """What is wrong with the reply that the host has just had: nothing else happened, and it does not ask again."""
    event = only(host, ReplyUnusable)
    assert (host.busy, host.counters.malformed) == (False, 1)
    assert isinstance(event.error, RemoteProtocolError)
    return str(event.error)


def test_a_reply_that_cannot_be_read_is_an_event(host: HostSession) -> None:
    tid = host.request(ParamGet(5), 1, 1.0)
    host.receive_data(reply(MessageType.PARAM_GET, tid, ParamReply(5, 1, 0, 2, 1).pack()[:-1]), 1.01)
    text = unusable(host)
    assert text.startswith("the reply of node 1 to PARAM_GET cannot be read: ParamReply of 19 bytes, expected 20")


@pytest.mark.parametrize("total", [131_104, 0xFFFFFFFF, 33])
def test_a_descriptor_that_cannot_be_is_refused_at_once(host: HostSession, total: int) -> None:
    tid = host.request(BlobRead(0, 512, 0), 1, 1.0)
    host.receive_data(reply(MessageType.BLOB_READ, tid, BlobReply(0, 4, 0, total, b"abcd").pack()), 1.01)
    assert f"the descriptor of node 1 has {total} bytes" in unusable(host)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"major": 2}, "the device speaks HBP 2.1, this host 1"),
        ({"node": 0}, "node is 0"),
        ({"node": 2}, "node is 2, must be the frame's"),
        ({"rx_max": 127}, "rx_max is 127, must be at least 128"),
        ({"pwm_hz": 0}, "pwm_hz is 0"),
        ({"tick_hz": 0}, "tick_hz is 0, must be a multiple of pwm_hz = 16000"),
        ({"tick_hz": 20_000_001}, "tick_hz is 20000001, must be a multiple of pwm_hz = 16000"),
        ({"name": ""}, "name is empty"),
    ],
)
def test_a_hello_that_cannot_be_is_refused(changes: dict[str, object], words: str) -> None:
    host = greeted(replace(HelloReply.unpack(hello_reply(5)), **changes).pack())
    text = unusable(host)
    assert text.startswith("HELLO of node 1: ")
    assert words in text
    assert not host.hellos


def test_a_hello_without_serial_and_build_is_too_short() -> None:
    assert "HelloReply of 68 bytes, expected 116" in unusable(greeted(hello_reply(5)[:68]))


def test_a_hello_that_is_only_odd_connects() -> None:
    odd = replace(HelloReply.unpack(hello_reply(5)), role=Role(7), state=DriveState(9), nodes=0, firmware="", tx_max=0)
    event = only(greeted(odd.pack()), Connected)
    assert (event.hello.role.name, event.hello.state.name) == ("role 7", "state 9")


def test_node_zero_takes_the_answer_of_whoever_is_there(host: HostSession) -> None:
    tid = host.request(ParamCommit(), 0, 1.0)
    host.receive_data(reply(MessageType.PARAM_COMMIT, tid, b"", node=3), 1.01)
    assert only(host, ReplyReceived).node == 3


def test_tid_wraps_from_65535_to_1() -> None:
    host = HostSession(CanWire(BusRates(1_000_000)))  # where the nonce says with which one a host begins
    tids = [host.connect(0x5678FFFC, 0.0)]
    for _ in range(4):
        host.cancel()
        tids.append(host.request(ParamCommit(), 1, 1.0))
    assert tids == [65533, 65534, 65535, 1, 2]


def test_the_round_trip_is_smoothed_and_bounded(host: HostSession) -> None:
    now = 1.0
    for _ in range(40):
        tid = host.request(StreamStart(0), 1, now)
        now += 0.03
        host.receive_data(reply(MessageType.STREAM_START, tid, b""), now)
    assert host.round_trip == pytest.approx(0.03, rel=0.01)
    tid = host.request(StreamStart(0), 1, now)
    host.receive_data(reply(MessageType.STREAM_START, tid, b""), now + 3600)
    assert host.round_trip <= 1.0


def test_unsolicited_messages_are_events(host: HostSession) -> None:
    beat = small_link(boot_id=7)[1].heartbeat()
    happening, log = DeviceEvent(5, 1, 1, 2.0), Log(6, "hello")
    for type_, message in ((0x04, beat), (0x42, happening), (0x43, log)):
        host.receive_data(unasked(type_, message.pack()), 1.0)
    assert events(host) == [HeartbeatReceived(1, beat), DeviceEventReceived(1, happening), LogReceived(1, log)]


def test_a_reboot_shows_in_hello_and_in_the_heartbeat(host: HostSession) -> None:
    host.request(Hello(55), 1, 1.0)
    host.receive_data(reply(1, 2, hello_reply(55, boot_id=8)), 1.01)
    assert events(host)[0] == Rebooted(1, 7, 8)
    beat = small_link(boot_id=9)[1].heartbeat()
    host.receive_data(unasked(0x04, beat.pack()) * 2, 2.0)
    assert [event for event in events(host) if isinstance(event, Rebooted)] == [Rebooted(1, 8, 9)]


def boots(host: HostSession, boot_ids: str, period: float) -> list[str]:
    """Hear a heartbeat of each of these boots, `period` s apart; what the session makes of that, by its letters."""
    told = []
    for k, letter in enumerate(boot_ids):
        beat = small_link(boot_id=ord(letter))[1].heartbeat()
        host.receive_data(unasked(0x04, beat.pack()), 1.0 + k * period)
        for event in events(host):
            if isinstance(event, Rebooted):
                told.append(f"{chr(event.old)}>{chr(event.new)}")
            elif isinstance(event, SeveralDevices):
                told.append("+".join(sorted(map(chr, event.boot_ids))))
    return told


@pytest.mark.parametrize(
    ("boot_ids", "period", "told"),
    [
        ("AAABBB", 0.1, ["A>B"]),
        ("AABABBB", 0.05, ["A>B", "B>A", "A>B"]),  # one heartbeat was late
        ("ABABABAB", 0.05, ["A>B", "B>A", "A>B", "A+B"]),
        ("AABBAABBAABB", 0.05, ["A>B", "B>A", "A>B", "A+B"]),
        ("ABCABCABC", 0.03, ["A>B", "B>C", "C>A", "A>B", "A+B+C"]),
        (
            "ABABAB",
            1.0,
            ["A>B", "B>A", "A>B", "B>A", "A>B"],
        ),  # boots every second, by a counter of one bit
        ("ABCDEFG", 0.1, ["A>B", "B>C", "C>D", "D>E", "E>F", "F>G"]),
    ],
)
def test_boot_ids_in_turn_are_several_devices(boot_ids: str, period: float, told: list[str]) -> None:
    assert boots(HostSession(), "".join(boot_ids), period) == told


@pytest.mark.parametrize("late", [0.0, 0.02, 5.0])
def test_two_answers_to_one_hello_are_two_devices(late: float) -> None:
    host = greeted(hello_reply(5, boot_id=7))
    host.receive_data(reply(1, 1, hello_reply(5, boot_id=7)) + reply(1, 1, hello_reply(6, boot_id=8)), 0.02)
    assert not any(isinstance(event, SeveralDevices) for event in events(host))  # the same, and another host's
    host.receive_data(reply(1, 1, hello_reply(5, boot_id=8)), 0.02 + late)
    assert SeveralDevices(1, frozenset({7, 8}), 0) in events(host)
    assert [said.boot_id for said in host.devices[1]] == [7, 8]


def test_an_answer_to_the_first_hello_and_one_to_the_next_may_be_a_reboot() -> None:
    host = HostSession()
    host.connect(5, 0.0)
    host.tick(0.1)
    host.receive_data(b"\0" + reply(1, 1, hello_reply(5, boot_id=7)), 0.11)
    host.receive_data(reply(1, 1, hello_reply(5, boot_id=8)), 0.12)
    told = [event for event in events(host) if isinstance(event, Rebooted | SeveralDevices)]
    assert told == [Rebooted(1, 7, 8)]


def test_while_something_is_heard_hello_is_repeated_soon() -> None:
    host = HostSession()
    host.connect(5, 0.0, delay=0.5)
    assert sent(host) == []
    times = []
    for k in range(500):  # 10 ms
        now = k * 0.01
        if k >= 400 and k % 10 == 0:
            host.receive_data(b"\0" + unasked(0x04, small_link()[1].heartbeat().pack()), now)
        host.tick(now)
        times += [round(now, 2)] * len(sent(host))
    assert times == pytest.approx([0.5, 0.6, 0.8, 1.2, 2.0, 3.0, 4.0, 4.25, 4.5, 4.75], abs=0.025)


def test_hello_to_a_second_node_is_a_plain_request(host: HostSession) -> None:
    tid = host.request(Hello(56), 2, 1.0)
    host.receive_data(reply(1, tid, hello_reply(56, boot_id=3, node=2), node=2), 1.01)
    assert isinstance(only(host, ReplyReceived).message, HelloReply)
    assert set(host.hellos) == {1, 2}


def test_the_tick_reference_follows_heartbeats_and_time_sync(host: HostSession) -> None:
    tid = host.request(TimeSync(), 1, 1.0)
    host.receive_data(reply(MessageType.TIME_SYNC, tid, TimeSyncReply(100, 1 << 40).pack()), 1.01)
    assert host.tick_reference(1).tick == 1 << 40
    later = (1 << 40) + 2_000_000
    host.receive_data(unasked(0x04, Heartbeat(later, 7, *([0] * 10)).pack()), 1.11)
    assert (host.tick_reference(1).tick, host.tick_reference(2).tick) == (later, 0)


def test_reconnecting_drops_half_a_frame_and_the_outstanding_request(host: HostSession) -> None:
    tid = host.request(ParamCommit(), 1, 1.0)
    whole = reply(MessageType.PARAM_COMMIT, tid, b"")
    host.receive_data(whole[:6], 1.01)
    host.connect(9, 2.0)
    host.receive_data(whole[6:] + reply(1, tid + 1, hello_reply(9, boot_id=7)), 2.01)
    only(host, Connected)


def test_stream_frames_come_as_one_event_a_stream_with_edges_first(host: HostSession) -> None:
    link, device, _ = small_link(boot_id=7)
    link.receive(wire_of(StreamSet(0, StreamEvent.PWM, 1, 20, (1, 2)), 1))
    link.receive(wire_of(StreamSet(1, StreamEvent.EDGES, 1, 20), 2))
    link.receive(wire_of(StreamSet(2, StreamEvent.PWM, 10, 20, (5,)), 3))
    link.receive(wire_of(StreamStart(7), 4))
    link.data_to_send()
    for first in range(0, 4000, 400):
        device.push_edges(edges_at([first * 1250 + 5]))
        device.push_samples(first, first * 1250, samples(first, 400))
    host.receive_data(link.data_to_send(), 1.0)
    got = events(host)
    assert all(isinstance(event, StreamFrames) for event in got)
    assert [(e.stream, e.type, len(e.frames)) for e in got] == [(1, 0x41, 10), (0, 0x40, 12), (2, 0x40, 12)]


def test_order_between_streams_and_other_messages_is_kept(host: HostSession) -> None:
    data, log = unasked(MessageType.DATA, bytes(20)), unasked(MessageType.LOG, b"\6x")
    host.receive_data(data + log + data + data, 1.0)
    kinds = [(type(e).__name__, len(getattr(e, "frames", ()))) for e in events(host)]
    assert kinds == [("StreamFrames", 1), ("LogReceived", 0), ("StreamFrames", 2)]
