"""Captures in the device against a model that goes period by period, however what happens is pushed."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import capture_model as model
import numpy as np
import pytest
from capture_model import Asked, Course, Edge, Kind
from hypothesis import given
from hypothesis import strategies as st
from small_drive import SmallDrive, edges_at, frames_in, identity, small_link, whole_blob, wire_of

from protocol.descriptor import sample_dtype
from protocol.device.records import LateSamples
from protocol.device.session import DeviceLink, DeviceSession
from protocol.messages import (
    BlobRead,
    BlobReply,
    CaptureArm,
    CaptureReply,
    CaptureState,
    CaptureStatus,
    CaptureTrigger,
    Command,
    DeviceEvent,
    ErrorReply,
    EventCode,
    Fault,
    Feature,
    MessageType,
    Request,
    StateCommand,
)
from protocol.signals import Flag, RawType, Signal, Unit
from protocol.streams import EDGE_RECORD
from tests.choice import examples

TICK_HZ, PWM_HZ = 20_000_000, 16_000
PERIOD = TICK_HZ // PWM_HZ
KINDS = (
    Kind("u8"),
    Kind("i16", 0.25),
    Kind("f32"),
    Kind("u32", 1.0, -3.0),
    Kind("i8", -0.5, 1.0),
)
CHANNELS = tuple(
    Signal(7 * n + 1, f"c{n}", Unit.A, RawType[kind.type.upper()], kind.scale, Flag.CHANNEL, "", kind.offset)
    for n, kind in enumerate(KINDS)
)
MEMORY = 4096


class Drive(SmallDrive):
    channels = CHANNELS


class Device:
    """A drive of these channels behind a link, and requests to it."""

    def __init__(self, tick0: int = 0, **changes: object) -> None:
        self.link = DeviceLink()
        values = {"features": Feature.EDGES | Feature.CAPTURE, "capture_bytes": MEMORY, "tick0": tick0} | changes
        self.session: DeviceSession = self.link.add(Drive(), identity(**values))
        self.link.advance(tick0)
        self.events: list[DeviceEvent] = []
        self._tid = 0

    def ask(self, message: Request) -> bytes:
        """Return the payload of the reply; collect events."""
        self._tid += 1
        self.link.receive(wire_of(message, self._tid))
        return self.said()[-1]

    def said(self) -> list[bytes]:
        replies = []
        for frame in frames_in(self.link.data_to_send()):
            if frame.type == MessageType.EVENT:
                self.events.append(DeviceEvent.unpack(frame.payload))
            elif frame.is_reply:
                assert not frame.is_error, ErrorReply.unpack(frame.payload)
                replies.append(frame.payload)
        return replies

    def status(self) -> CaptureReply:
        return CaptureReply.unpack(self.ask(CaptureStatus()))

    def blob(self, part: int = 1000) -> bytes:
        """Blob 1, read in parts."""
        return whole_blob(lambda request: BlobReply.unpack(self.ask(request)), part)


def raw_of(rows: Sequence[Sequence[float]]) -> np.ndarray:
    return np.array([tuple(row) for row in rows], sample_dtype(CHANNELS))


def records_of(edges: Sequence[Edge]) -> np.ndarray:
    return np.frombuffer(b"".join(edge.packed() for edge in edges), EDGE_RECORD)


values = st.tuples(
    st.integers(0, 3), st.integers(-4, 4), st.sampled_from([-1.0, 0.0, -0.0, 0.5, 1.0, float("nan")]),
    st.integers(0, 8), st.integers(-3, 3),
)  # fmt: skip


@st.composite
def courses(draw: st.DrawFn) -> tuple[Asked, Course, list[int]]:
    """A capture, what happens to it, and in what portions that is pushed."""
    n = draw(st.integers(1, 90))
    begin = draw(st.integers(0, 12))
    tick0 = draw(st.sampled_from([0, 5, (1 << 32) - 20 * PERIOD]))
    ends = [tick0 + (begin - 1) * PERIOD + 1, tick0 + (begin + n - 1) * PERIOD]
    near = st.integers(*ends) | st.integers(begin, begin + n - 1).map(lambda k: tick0 + k * PERIOD)
    ticks = sorted(draw(st.lists(near, max_size=24)))
    edges, code = [], 1
    for tick in ticks:
        new = draw(st.sampled_from([each for each in (1, 3, 2, 0, 7) if each != code]))
        edges.append(Edge(tick, code, new, draw(st.booleans()), tick & 0xFFFF))
        code = new
    channels = draw(st.lists(st.integers(0, 4), min_size=1, unique=True).map(tuple))
    trigger = draw(st.sampled_from([t for t in CaptureTrigger if t != CaptureTrigger.OFF]))
    seconds = st.sampled_from([0.0, 1e-6, 6.25e-5, 1e-3, -1.0])
    level = draw(seconds if trigger == CaptureTrigger.PULSE else st.sampled_from([-1.0, -0.5, 0.0, 0.5, 2.0, 4.0]))
    asked = Asked(
        int(trigger), draw(st.integers(1, 6)), draw(st.integers(0, 25)), draw(st.integers(1, 25)),
        float(np.float32(level)), draw(st.integers(0, 4)), draw(st.integers(0, 8)), channels,
    )  # fmt: skip
    moment = st.none() | st.integers(begin, begin + n - 1)
    course = Course(
        KINDS, begin, draw(st.lists(values, min_size=n, max_size=n)), edges, draw(st.integers(0, 3)),
        tick0, PERIOD, TICK_HZ, draw(moment), draw(moment),
    )  # fmt: skip
    cuts = draw(st.lists(st.integers(begin + 1, begin + n), max_size=12))
    cuts += [at + 1 for at in (course.fault, course.state) if at is not None]
    return asked, course, sorted({*cuts, begin + n})


@examples(40, 3000, campaign="c")
@given(courses(), st.booleans(), st.integers(1, 1024))
def test_blob_1_is_that_of_the_model_in_whatever_portions(
    given_course: tuple[Asked, Course, list[int]], late: bool, part: int
) -> None:
    asked, course, cuts = given_course
    device = Device(course.tick0)
    session = device.session
    if course.begin:
        session.push_edges(edges_at([course.tick0] * course.edges_before))
        session.push_samples(0, course.tick0, raw_of([values_before(k) for k in range(course.begin)]))
        device.link.advance(course.tick(course.begin - 1))
    elif course.edges_before:
        session.push_edges(edges_at([course.tick0] * course.edges_before))
    ids = tuple(CHANNELS[n].id for n in asked.channels)
    request = arm(
        CaptureTrigger(asked.trigger), asked.before, asked.after, decimation=asked.decimation, level=asked.level,
        channel=CHANNELS[asked.channel].id, edges=asked.edges, channels=ids,
    )  # fmt: skip
    armed = CaptureReply.unpack(device.ask(request))
    state = CaptureState.TRIGGERED if asked.trigger == CaptureTrigger.NOW else CaptureState.ARMED
    assert (armed.state, armed.trigger, armed.channels) == (state, asked.trigger, ids)
    device.events.clear()
    first, sent = course.begin, 0
    for cut in cuts:
        upto = sum(edge.tick <= course.tick(cut - 1) for edge in course.edges)
        session.push_edges(records_of(course.edges[sent:upto]))
        raw = raw_of(course.rows[first - course.begin : cut - course.begin])
        pushed = LateSamples(len(raw), lambda names, raw=raw: with_only(raw, names)) if late else raw
        session.push_samples(first, course.tick(first), pushed)
        device.link.advance(course.tick(cut - 1))
        if course.state == cut - 1 and (course.fault is None or course.fault >= course.state):
            device.link.receive(wire_of(StateCommand(Command.ARM, 0xB0071D), 9999))
        if course.fault == cut - 1:
            session.fault(Fault.HALL)
        first, sent = cut, upto
    device.link.advance(course.tick(first))
    told = device.status()
    expected = model.captured(asked, course)
    captured = [event for event in device.events if event.code == EventCode.CAPTURED]
    if expected is None:
        assert told.state in (CaptureState.ARMED, CaptureState.TRIGGERED)
        assert (told.first, told.records, told.size, told.crc, told.tick, told.index, told.faults) == (0,) * 7
        assert not captured
        return
    blob, reply = expected
    assert told.state == CaptureState.FROZEN
    assert {name: int(getattr(told, name)) for name in reply} == reply
    assert device.blob(part) == blob
    if reply["trigger"] == CaptureTrigger.FAULT or course.fault is None:
        assert told.faults == (Fault.HALL if reply["trigger"] == CaptureTrigger.FAULT else Fault(0))
    assert [(event.arg, event.detail) for event in captured] == [(told.number, reply["trigger"])]
    assert device.status() == told


def values_before(k: int) -> tuple[float, ...]:
    """Raw values of a period before arming, which fulfil every condition: none of them may count."""
    return (k % 3, 4 * (-1) ** k, 1.0, 8 * (k % 2), k % 3)


def with_only(raw: np.ndarray, names: frozenset[str]) -> np.ndarray:
    """Samples in which no other channels are right."""
    made = np.full(len(raw), 99).astype([(name, raw.dtype[name]) for name in raw.dtype.names])
    for name in names:
        made[name] = raw[name]
    return made


# -- what a host asks -------------------------------------------------------------------------------------------------


def arm(trigger: CaptureTrigger = CaptureTrigger.NOW, before: int = 3, after: int = 5, **changes: object) -> CaptureArm:
    return CaptureArm(trigger, before=before, after=after, **{"channels": (1, 8), "edges": 4} | changes)


def push(device: Device, index: int, n: int, edges: Sequence[int] = ()) -> None:
    device.session.push_edges(edges_at(edges))
    device.session.push_samples(index, index * PERIOD, raw_of([values_before(index + k) for k in range(n)]))
    device.link.advance((index + n - 1) * PERIOD)


def refusal(device: Device, message: Request) -> tuple[int, float]:
    device.link.receive(wire_of(message, 77))
    (frame,) = (each for each in frames_in(device.link.data_to_send()) if each.is_reply)
    assert frame.is_error
    told = ErrorReply.unpack(frame.payload)
    return told.code, told.detail


def test_unasked_the_last_periods_before_a_fault_are_held() -> None:
    device = Device(capture_bytes=1 << 16)
    told = device.status()
    assert (told.state, told.trigger, told.number, told.decimation) == (CaptureState.ARMED, CaptureTrigger.FAULT, 1, 1)
    assert told.channels == tuple(channel.id for channel in CHANNELS)
    assert told.before > told.after > 0
    assert told.before + told.after == PWM_HZ // 4  # a quarter of a second fits
    push(device, 0, 5000, [7])
    device.session.fault(Fault.OVERCURRENT)
    device.session.fault(Fault.HALL)  # not another trigger
    push(device, 5000, 1000, [5001 * PERIOD])
    frozen = device.status()
    assert (frozen.state, frozen.faults, frozen.index) == (CaptureState.FROZEN, Fault.OVERCURRENT, 4999)
    assert (frozen.first, frozen.records, frozen.edges) == (told.before, told.before + told.after, 1)
    blob = device.blob()
    raw = np.frombuffer(blob[: frozen.records * frozen.sample_bytes], sample_dtype(CHANNELS))
    assert raw.tobytes() == raw_of([values_before(4999 - frozen.first + k) for k in range(frozen.records)]).tobytes()
    device.ask(StateCommand(Command.FAULT_CLEAR, int(Fault.OVERCURRENT | Fault.HALL)))
    push(device, 6000, 100)
    assert device.status() == frozen  # it stays, whatever happens
    assert refusal(device, arm()) == (12, frozen.number)
    off = CaptureReply.unpack(device.ask(CaptureArm(CaptureTrigger.OFF, 9, 0, 0, 0, float("nan"))))
    assert (off.state, off.trigger, off.number) == (CaptureState.ARMED, CaptureTrigger.FAULT, frozen.number + 1)
    assert refusal(device, BlobRead(1, 10, 0)) == (7, 1)


def test_a_device_that_names_channels_for_a_fault_holds_these() -> None:
    class Choosy(Drive):
        fault_channels = ("c2", "c0")

    link = DeviceLink()
    session = link.add(Choosy(), identity(features=Feature.CAPTURE, capture_bytes=1000))
    link.receive(wire_of(CaptureStatus(), 1))
    (reply,) = (frame for frame in frames_in(link.data_to_send()) if frame.is_reply)
    told = CaptureReply.unpack(reply.payload)
    assert told.channels == (CHANNELS[2].id, CHANNELS[0].id)
    assert told.before + told.after == 1000 // 5
    assert session.channels == {"c0", "c2"}


def test_no_memory_no_capture() -> None:
    link, session, _ = small_link(features=Feature.EDGES | Feature.CAPTURE, capture_bytes=0)
    assert not session.identity.features & Feature.CAPTURE
    link.data_to_send()
    link.receive(wire_of(CaptureStatus(), 1))
    (reply,) = frames_in(link.data_to_send())[:1]
    assert ErrorReply.unpack(reply.payload).code == 1
    little = Device(capture_bytes=4)
    told = little.status()
    assert told == CaptureReply(CaptureState.OFF, CaptureTrigger.OFF, *[0] * 12, 4, 0, 0, Fault(0), ())


def test_another_arming_gives_up_what_waits_and_has_another_number() -> None:
    device = Device()
    numbers = {device.status().number}
    for trigger in (CaptureTrigger.FAULT, CaptureTrigger.NOW, CaptureTrigger.ABOVE, CaptureTrigger.OFF):
        reply = CaptureReply.unpack(device.ask(arm(trigger, level=1e9, channel=1)))
        assert reply.number not in numbers | {0}
        numbers.add(reply.number)
        push(device, device.session.heartbeat().tick // PERIOD + 1, 4)


def test_periods_that_are_missing_are_in_no_capture() -> None:
    device = Device()
    device.ask(arm(CaptureTrigger.FAULT, before=10, after=2))
    push(device, 0, 20)
    push(device, 30, 3)
    device.session.fault(Fault.HALL)
    push(device, 33, 5)
    told = device.status()
    assert (told.first, told.records, told.index) == (2, 4, 32)
    device.ask(CaptureArm(CaptureTrigger.OFF))
    device.ask(arm(before=0, after=50))
    push(device, 38, 10)
    push(device, 60, 10)
    told = device.status()
    assert (told.state, told.first, told.records, told.index) == (CaptureState.FROZEN, 0, 10, 38)


@pytest.mark.parametrize("apart", [10, 5])
def test_edges_that_have_no_room_are_counted_however_many(apart: int) -> None:
    device = Device(capture_bytes=1 << 20)
    device.ask(arm(CaptureTrigger.FAULT, before=3, after=5, edges=2, decimation=50_000))
    for index in range(0, 450_000, 50_000):
        push(device, index, 50_000, range(index * PERIOD, (index + 50_000) * PERIOD, apart * PERIOD))
        if index == 150_000:
            device.session.fault(Fault.HALL)
    told = device.status()
    assert (told.state, told.first, told.records, told.edges) == (CaptureState.FROZEN, 3, 8, 2)
    lost = 7 * 50_000 // apart + 1 - 2
    assert told.first_edge == 400_000 // apart - 1
    assert told.edges_lost == lost if apart == 10 else lost <= told.edges_lost <= 1.5 * lost  # too many to be kept


def test_a_capture_is_streamed_beside() -> None:
    """What streams and the capture ask of samples that are made late are the channels of both."""
    device = Device()
    asked: list[frozenset[str]] = []

    def make(names: frozenset[str]) -> np.ndarray:
        asked.append(names)
        return raw_of([values_before(k) for k in range(50)])

    device.ask(arm(CaptureTrigger.ABOVE, before=2, after=3, level=0.5, channel=CHANNELS[3].id))
    assert device.session.channels == {"c0", "c1", "c3"}
    device.session.push_samples(0, 0, LateSamples(50, make))
    assert frozenset().union(*asked) == {"c0", "c1", "c3"}
    assert device.session.channels == frozenset()  # it is complete
    told = device.status()
    assert (told.index, told.records) == (1, 4)
    assert device.blob() == b"".join(struct.pack("<Bh", *values_before(k)[:2]) for k in range(4))
