"""Three device sides say the same: in Python, in C, and `tests.devices`, which is written from SPEC.md alone.

Requests in any order, right, wrong and repeated, noise, faults and time. Not left to chance are the moments at which
something is due, and requests that mean something in the state that it is in.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_drive import CHANNELS, PARAMETERS, AloneLink, SmallDrive, edges_at, frames_in, identity, samples

from protocol.device.compiled import CompiledLink
from protocol.device.session import DeviceLink, TxQueue
from protocol.errors import Refused
from protocol.framing import ERROR, MAJOR, REPLY, Frame, encode_frame
from protocol.messages import (
    Alive,
    BlobRead,
    Command,
    ErrorCode,
    EventCode,
    Fault,
    Feature,
    Hello,
    MessageType,
    ParamCommit,
    ParamGet,
    ParamSet,
    Request,
    Setpoint,
    StateCommand,
    StreamGet,
    StreamSet,
    StreamStart,
    StreamStop,
    TimeSync,
)
from tests.choice import examples
from tests.devices.device import TICK_HZ
from tests.tools import needs

BOOT = 0xB0071D
TICKS = 1000  # in a PWM period
BLOB_BYTES = 32 * (len(CHANNELS) + len(PARAMETERS))

U8, U16, U32 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32))
F32 = st.one_of(
    st.sampled_from([0.0, 1.0, 2.5, 300.0, 301.0, 0.05, 0.2, 0.5, 1e-4, 1e5, 1e6, float("inf")]), st.floats(width=32)
)
IDS = st.lists(st.one_of(st.integers(1, 5), st.integers(1, 5), U16), max_size=7).map(tuple)
REQUEST = st.one_of(
    st.builds(Hello, st.integers(0, 1), st.just(1), st.just(1), st.sampled_from([127, 128, 1024])),
    st.builds(Hello, U32, st.integers(0, 2), st.integers(0, 3), U16),
    st.builds(TimeSync),
    st.builds(Alive, U32),
    st.builds(
        BlobRead, st.sampled_from([0, 0, 0, 1, 255]), U16, st.one_of(st.integers(-2, 1).map(BLOB_BYTES.__add__), U16)
    ),
    st.builds(ParamGet, st.one_of(st.integers(100, 105), U16)),
    st.builds(ParamSet, st.one_of(st.integers(100, 105), U16), F32),
    st.builds(ParamCommit),
    st.builds(StateCommand, st.sampled_from(Command), st.sampled_from([0, 0, BOOT, BOOT, 1, 2, 8, 10, 1 << 31])),
    st.builds(Setpoint, st.sampled_from([1, 1, 2, 3, 9]), U16, F32, F32),
    st.builds(
        StreamSet,
        st.sampled_from([0, 1, 2, 3, 4]), st.sampled_from([0, 0, 0, 1, 2, 3]),
        st.one_of(st.integers(0, 9), U16), st.one_of(st.integers(0, 30), U16), IDS,
    ),
    st.builds(StreamStart, st.one_of(st.integers(0, 15), U32)),
    st.builds(StreamStop, st.one_of(st.integers(0, 15), U32)),
    st.builds(StreamGet, st.integers(0, 5)),
)  # fmt: skip


def wire_of(message: Request, tid: int) -> bytes:
    tid = 0 if type(message) in (Alive, Setpoint) else tid
    return encode_frame(Frame(message.TYPE, MAJOR, tid, 1, message.pack()))


@st.composite
def wires(draw: st.DrawFn) -> bytes:
    """A request as a frame: as it should be, or with something wrong that its CRC hides."""
    message: Request = draw(REQUEST)
    tid = 0 if type(message) in (Alive, Setpoint) else draw(st.integers(1, 6))
    payload, kind, flags, node = message.pack(), int(message.TYPE), MAJOR, 1
    match draw(st.integers(0, 19)):
        case 0:
            payload = payload[:-1]
        case 1:
            payload += b"\0"
        case 2:
            payload = draw(st.binary(max_size=40))
        case 3:
            kind = draw(U8)
        case 4:
            flags = draw(U8)
        case 5:
            node = draw(st.integers(0, 3))
        case 6:
            tid = draw(st.sampled_from([0, 1, 65535]))
        case 7 if len(payload) > 0:
            at = draw(st.integers(0, len(payload) - 1))
            payload = payload[:at] + bytes([draw(U8)]) + payload[at + 1 :]
    return encode_frame(Frame(kind, flags, tid, node, payload))


ARM, START, STOP = (StateCommand(command, BOOT * (command == Command.ARM)) for command in list(Command)[:3])
PERIODS = st.one_of(st.integers(1, 400), st.sampled_from([1, 49, 50, 100, 199, 200, 201, 500]))
STEP = st.one_of(
    wires(),
    wires(),
    wires(),
    st.builds(wire_of, st.sampled_from([ARM, START, ARM, START, STOP]), st.integers(1, 6)),
    st.binary(min_size=1, max_size=20),  # noise
    PERIODS,
    st.integers(-5, -1),  # that many requests ago, again
    st.just("fed for as long as ARMED lasts"),
    st.sampled_from([Fault.HALL, Fault.OVERCURRENT | Fault.HALL]),
)


class Storeless(SmallDrive):
    """A small drive that stores nothing."""

    def commit(self) -> None:
        raise Refused("no store", ErrorCode.NOT_SUPPORTED)


def loose(frame: Frame) -> tuple:
    """What is to be the same: not the bits of a NaN, nor rounding of what devices predict."""
    payload: tuple = (frame.payload,)
    if frame.flags & ERROR and len(frame.payload) == 8:
        detail = struct.unpack("<f", frame.payload[4:])[0]
        payload = frame.payload[:4], "nan" if detail != detail else detail
    elif frame.type == MessageType.STREAM_SET and frame.is_reply:
        load = struct.unpack("<f", frame.payload[8:12])[0]
        payload = frame.payload[:8], f"{load:.5g}", frame.payload[12:]
    return frame.type, frame.flags, frame.tid, frame.node, *payload


def said_by(link: DeviceLink | CompiledLink | AloneLink) -> list[tuple]:
    """Frames in an order that SPEC does not leave to chance: replies and news, heartbeats, then each stream's."""

    def place(frame: Frame) -> tuple:
        streamed = frame.type in (MessageType.DATA, MessageType.EDGES)
        return frame.type == MessageType.HEARTBEAT, (frame.node, frame.payload[0]) if streamed else ()

    return [loose(frame) for frame in sorted(frames_in(link.data_to_send()), key=place)]


def tells_a_change(frame: tuple) -> bool:
    """Whether it is the EVENT PARAM_CHANGED, which a device of HBP 1.0 does not know."""
    kind, payload = frame[0], frame[4]
    return kind == MessageType.EVENT and payload[8:10] == bytes((EventCode.PARAM_CHANGED, 0))


MINOR_AT = 9  # in the payload of a HELLO reply


def without_choices(said: list[tuple]) -> list[tuple]:
    """Replies, and events in any order; without cfg_id, which a device chooses, minor, and changes of parameters."""
    found = []
    for kind, flags, *rest, payload in said:
        if tells_a_change((kind, flags, *rest, payload)):
            continue
        if flags & REPLY and not flags & ERROR:
            if kind == MessageType.STREAM_SET:
                rest = [*rest[:2], rest[2][:2] + rest[2][4:], rest[3]]
            elif kind == MessageType.HELLO:
                payload = payload[:MINOR_AT] + payload[MINOR_AT + 1 :]
            elif kind == MessageType.STREAM_GET:
                payload = payload[:8] + payload[10:]
        if flags & REPLY or kind == MessageType.EVENT:
            found.append((kind, flags, *rest, payload))
    return sorted(found, key=lambda frame: (frame[0] == MessageType.EVENT, repr(frame)))


def play(steps: list, links: list, fault: Callable[[Fault], None], compare: Callable[[], None]) -> None:
    """Do the same to all links, and compare after each step."""
    asked: list[bytes] = [b"\0"]
    period = 0

    def receive(data: bytes) -> None:
        for link in links:
            link.receive(data)

    def run(n: int) -> None:
        nonlocal period
        at = np.arange(period * TICKS + 7, (period + n - 1) * TICKS, 5 * TICKS)
        for link in links:
            for session in [] if isinstance(link, AloneLink) else link.sessions.values():
                session.push_edges(edges_at(at))
                session.push_samples(period, period * TICKS, samples(period, n))
            link.advance((period + n - 1) * TICKS)
        period += n
        compare()

    for link in links:
        link.advance(0)
        link.data_to_send()
    for step in steps:
        if isinstance(step, Fault):
            fault(step)
        elif isinstance(step, bytes):
            asked.append(step)
            receive(step)
        elif isinstance(step, str):
            for _ in range(34):
                receive(wire_of(Alive(1), 0))
                run(150)
        elif step < 0:
            receive(asked[max(step, -len(asked))])
        else:
            run(step)
        compare()


@needs("C compiler")
@examples(20, 300, campaign="c")
@given(st.lists(STEP, min_size=30, max_size=60), st.booleans(), st.booleans())
def test_c_says_what_python_says(steps: list, two_nodes: bool, means: bool) -> None:
    features = Feature.EDGES | (Feature.MEANS if means else Feature(0))
    python, c = DeviceLink(TxQueue(1 << 24)), CompiledLink(1 << 20)
    for link in (python, c):
        for node in (1, 2)[: 1 + two_nodes]:
            link.add(SmallDrive(), identity(node, tick_hz=TICK_HZ, pwm_hz=TICK_HZ // TICKS, features=features))

    def fault(bits: Fault) -> None:
        for link in (python, c):
            link.sessions[1].fault(bits)

    def compare() -> None:
        assert said_by(c) == said_by(python)
        for session in python.sessions.values():  # what they had their drives do
            told = [
                vars(each.app) | {"waveform": each.app.waveform.tolist()}
                for each in (session, c.sessions[session.identity.node])
            ]
            assert told[0] == told[1]

    play(steps, [python, c], fault, compare)


@pytest.mark.long("many random sessions")
@examples(30, 1000, campaign="c")
@given(st.lists(STEP, min_size=30, max_size=60))
def test_python_says_what_the_spec_says(steps: list) -> None:
    python, alone = DeviceLink(TxQueue(1 << 24)), AloneLink()
    session = python.add(Storeless(), identity(tick_hz=TICK_HZ, pwm_hz=TICK_HZ // TICKS))

    def fault(bits: Fault) -> None:
        session.fault(bits)
        alone.fault(bits)

    def compare() -> None:
        assert without_choices(said_by(python)) == without_choices(said_by(alone))
        health = asdict(session.heartbeat())
        told = alone.device.heartbeat_fields()
        chosen = ("tick", "edges", "tx_dropped")
        assert {key: health[key] for key in told if key not in chosen} == {k: told[k] for k in told if k not in chosen}
        assert list(session.app.values.values()) == list(alone.values.values())

    play(steps, [python, alone], fault, compare)
