"""The device side in C: frames in any pieces, and the same answers as the device side in Python to whatever comes."""

from __future__ import annotations

import struct
import subprocess
from pathlib import Path

import can_rows
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_drive import TICKS, SmallDrive, edges_at, frames_in, identity, samples, small_link_in_c, wire_of
from test_vectors import each

from protocol.canmap.compiled import CompiledCan
from protocol.canmap.device import CanDevice
from protocol.canmap.frame import CAN_RECORD, RECORD_BYTES, BusRates
from protocol.canmap.host import CanWire
from protocol.canmap.ids import CanClass
from protocol.canmap.transport import CanCounters, Reassembler
from protocol.device.compiled import SOURCE, CompiledLink, compiler
from protocol.device.session import DeviceLink
from protocol.device.tx import TxQueue
from protocol.framing import ERROR, MAJOR, REPLY, Frame, encode_frame, parse_frame
from protocol.messages import (
    Alive,
    BlobRead,
    Command,
    Fault,
    Hello,
    MessageType,
    ParamCommit,
    ParamGet,
    ParamSet,
    Request,
    Setpoint,
    StateCommand,
    StreamEvent,
    StreamGet,
    StreamSet,
    StreamStart,
    StreamStop,
    TimeSync,
)
from tests.choice import examples
from tests.tools import needs

BOOT = 0xB0071D
pytestmark = needs("C compiler")


HERE = Path(__file__).parent / "c"


def must_run(folder: Path, *sources: Path | str) -> None:
    """A program of these sources, which says nothing and ends with 0."""
    subprocess.run([*compiler(), "-I", SOURCE, *sources, "-o", folder / "program"], check=True)
    done = subprocess.run([folder / "program"], capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("", 0)


def test_the_usage_in_the_header_compiles(tmp_path: Path) -> None:
    comment = (SOURCE / "hbp.h").read_text(encoding="utf-8").split("#ifndef", 1)[0]
    usage = comment.split(" * USE.", 1)[1].split(" * A whole program", 1)[0]
    code = [line.removeprefix(" *     ").split("  //")[0] for line in usage.splitlines() if line.startswith(" *     ")]
    assert len(code) > 50
    file = tmp_path / "usage.c"
    file.write_text((HERE / "usage.h").read_text() + "\n".join(code) + "\n")
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-c"]
    subprocess.run([*compiler(), *flags, f"-I{SOURCE}", "-o", tmp_path / "usage.o", file], check=True)


@each("framing")
def test_frames_are_found_or_counted_however_they_come(case: dict) -> None:
    wire = bytes.fromhex(case["wire_hex"])
    good = case["verdict"] == "ok"
    step = 1 if len(wire) < 100 else 37
    for cut in range(0, len(wire) + 1, step):
        link, session, _ = small_link_in_c()
        link.data_to_send()
        link.receive(wire[:cut])
        link.receive(wire[cut:])
        assert session.bad == (case["verdict"] not in ("ok", "nothing"))
        if not good:
            assert link.data_to_send() == b""
        link.receive(b"\0" + wire_of(TimeSync(), 99))
        assert frames_in(link.data_to_send())[-1].tid == 99


# -- the same answers as the device side in Python ------------------------------------------------------------------

U8, U16, U32 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32))
F32 = st.one_of(st.sampled_from([0.0, 1.0, 2.5, 300.0, 301.0, 0.05, 0.2, 1.5, 1e6, float("inf")]), st.floats(width=32))
IDS = st.lists(st.one_of(st.integers(1, 5), U16), max_size=7).map(tuple)
REQUEST = st.one_of(
    st.builds(Hello, U32, st.integers(0, 2), st.integers(0, 3), st.one_of(st.sampled_from([127, 128, 1024]), U16)),
    st.builds(TimeSync),
    st.builds(Alive, U32),
    st.builds(BlobRead, st.sampled_from([0, 0, 0, 1, 2, 255]), U16, st.one_of(st.integers(0, 300), U32)),
    st.builds(ParamGet, st.one_of(st.integers(100, 105), U16)),
    st.builds(ParamSet, st.one_of(st.integers(100, 105), U16), F32),
    st.builds(ParamCommit),
    st.builds(StateCommand, st.sampled_from(Command), st.sampled_from([0, 0, BOOT, BOOT, 1, 2, 3, 7, 1 << 31])),
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


STEP = st.one_of(
    wires(),
    wires(),
    wires(),
    st.binary(min_size=1, max_size=20),  # noise
    st.integers(1, 400),  # PWM periods
    st.just("again"),
    st.sampled_from([Fault.HALL, Fault.OVERCURRENT | Fault.HALL]),
)


def told_by(data: bytes) -> list[tuple]:
    """Frames in an order that SPEC does not leave to chance: replies and news, heartbeats, then each stream's."""

    def place(frame: tuple) -> tuple:
        streamed = frame[0] in (MessageType.DATA, MessageType.EDGES)
        return frame[0] == MessageType.HEARTBEAT, (frame[3], frame[4][0]) if streamed else ()

    frames = [(f.type, f.flags, f.tid, f.node, f.payload) for f in frames_in(data)]
    return sorted(frames, key=place)


def same(ours: list[tuple], theirs: list[tuple]) -> bool:
    """Whether two devices said the same, the bits of a NaN and rounding of what they predict left out."""

    def loose(frame: tuple) -> tuple:
        kind, flags, tid, node, payload = frame
        if flags & ERROR and len(payload) == 8:
            detail = struct.unpack("<f", payload[4:])[0]
            return kind, flags, tid, node, payload[:4], "nan" if detail != detail else detail
        if kind == MessageType.STREAM_SET and flags & REPLY:
            load = struct.unpack("<f", payload[8:12])[0]
            return kind, flags, tid, node, payload[:8], f"{load:.5g}", payload[12:]
        return frame

    return list(map(loose, ours)) == list(map(loose, theirs))


@examples(75, 300, campaign="c")
@given(st.lists(STEP, max_size=40), st.booleans())
def test_same_answers_as_in_python(steps: list, two_nodes: bool) -> None:
    python, c = DeviceLink(TxQueue(1 << 22)), CompiledLink(1 << 20)
    sessions = []
    for link in (python, c):
        sessions.append(link.add(SmallDrive(), identity()))
        if two_nodes:
            link.add(SmallDrive(), identity(2))
    period = 0
    last = b""
    for link in (python, c):
        link.advance(0)
    for step in steps:
        if step == "again":
            step = last
        if isinstance(step, Fault):
            for session in sessions:
                session.fault(step)
        elif isinstance(step, bytes):
            last = step
            for link in (python, c):
                link.receive(step)
        else:
            tick = (period + step - 1) * TICKS
            at = np.arange(period * TICKS + 7, tick, 5 * TICKS)
            for session in sessions:
                session.push_edges(edges_at(at))
                session.push_samples(period, period * TICKS, samples(period, step))
            for link in (python, c):
                link.advance(tick)
            period += step
        ours, theirs = told_by(c.data_to_send()), told_by(python.data_to_send())
        assert same(ours, theirs), (ours, theirs)


# -- CAN --------------------------------------------------------------------------------------------------------------

CLASSIC, FD = BusRates(1_000_000), BusRates(1_000_000, 5_000_000)
SPOILT = st.one_of(
    st.just(("whole", 0)),
    st.just(("whole", 0)),
    st.tuples(st.sampled_from(["drop", "twice", "flip", "identifier", "remote"]), st.integers(0, 1 << 20)),
)


@st.composite
def can_steps(draw: st.DrawFn) -> tuple[Frame, int, tuple[str, int]]:
    """A request, the number of the host that sends it, and what happens to its frames."""
    message: Request = draw(REQUEST)
    tid = 0 if type(message) in (Alive, Setpoint) else draw(st.integers(1, 6))
    payload = message.pack()
    if draw(st.integers(0, 9)) == 0:
        payload = payload[:-1]
    kind = draw(U8) if draw(st.integers(0, 19)) == 0 else int(message.TYPE)
    return Frame(kind, MAJOR, tid, draw(st.sampled_from([1, 1, 1, 2])), payload), draw(st.integers(0, 2)), draw(SPOILT)


def spoilt(wire: bytes, how: str, number: int) -> bytes:
    """Frames of which one was lost, came twice, or is another."""
    rows = [wire[at : at + RECORD_BYTES] for at in range(0, len(wire), RECORD_BYTES)]
    at = number % len(rows)
    (row,) = np.frombuffer(rows[at], CAN_RECORD).copy()
    match how:
        case "drop":
            del rows[at]
        case "twice":
            rows.insert(at, rows[at])
        case "flip":
            row["data"][number // 8 % max(1, int(row["length"]))] ^= np.uint8(1 << number % 8)
            rows[at] = row.tobytes()
        case "identifier":
            row["id"] ^= 1 << number % (29 if row["id"] >> 31 else 11)
            rows[at] = row.tobytes()
        case "remote":
            row["id"] |= 0x40000000
            rows[at] = row.tobytes()
    return b"".join(rows)


def by_identifier(records: bytes) -> tuple[dict[int, list], list[tuple]]:
    """What is to be the same: length, flags and tail of a message's frames, all of a stream's; and the messages."""
    found: dict[int, list] = {}
    messages: list[tuple] = []
    parts: dict[int, Reassembler] = {}
    for number, data, flags in can_rows.parts(records):
        if number >> 8 & 7 > CanClass.TO_HOST:
            found.setdefault(number, []).append((data, flags))
            continue
        found.setdefault(number, []).append((len(data), data[-1], flags))
        raw = parts.setdefault(number, Reassembler(number >> 4 & 15, CanCounters())).feed(data)
        if raw is not None:
            frame = parse_frame(raw)
            messages.append((frame.type, frame.flags, frame.tid, frame.node, frame.payload))
    return found, sorted(messages, key=lambda frame: frame[0] == MessageType.HEARTBEAT)


@examples(75, 300, campaign="c")
@given(
    st.lists(st.one_of(can_steps(), can_steps(), st.integers(1, 400), st.just("again")), max_size=30),
    st.sampled_from([CLASSIC, FD]),
    st.booleans(),
)
def test_same_frames_as_in_python_on_can(steps: list, rates: BusRates, extended: bool) -> None:
    tx = TxQueue(1 << 24, 1 << 20)
    python = CanDevice(SmallDrive(), identity(), rates, extended, tx)
    c = CompiledCan(SmallDrive(), identity(), rates, extended, 1 << 13)
    wires = [CanWire(rates, 1, extended, host) for host in range(3)]
    python.advance(0)
    c.advance(0)
    period, last = 0, b""
    for step in steps:
        if isinstance(step, int):
            tick = (period + step - 1) * TICKS
            edges = edges_at(np.arange(period * TICKS + 7, tick, 5 * TICKS))
            for device in (python, c):
                device.session.push_edges(edges)
                device.session.push_samples(period, period * TICKS, samples(period, step))
                device.advance(tick)
            period += step
        else:
            if step != "again":
                frame, host, how = step
                last = spoilt(wires[host].encode(frame), *how)
            python.receive(last)
            c.receive(last)
        ours, theirs = b"".join(iter(c.take, b"")), tx.take()
        (our_frames, our_messages), (their_frames, their_messages) = by_identifier(ours), by_identifier(theirs)
        assert our_frames == their_frames
        assert same(our_messages, their_messages), (our_messages, their_messages)
        assert c.session.bad == python.counters.bad


@pytest.mark.parametrize("rates", [CLASSIC, FD], ids=["classic", "FD"])
@pytest.mark.parametrize("kind", [CanDevice, CompiledCan])
@pytest.mark.parametrize("away", [0.4, 0.6, 60.0, 2**32 / 20e6, 2**32 / 20e6 + 0.1])
def test_after_a_bus_that_was_away_comes_nothing_old(kind: type, away: float, rates: BusRates) -> None:
    """However long it was: a counter of 32 bits of ticks has come round by the last but one."""
    device, wire = kind(SmallDrive(), identity(), rates, False), CanWire(rates, 1)
    device.advance(0)
    config = StreamSet(0, StreamEvent.PWM, 1 if rates.fd else 8, 0, (1, 2))
    for tid, message in enumerate((config, StreamStart(1 << 0)), start=1):
        device.receive(wire.encode(Frame(int(message.TYPE), MAJOR, tid, 1, message.pack())))
    while device.take():
        pass
    tick = 0
    for period in range(0, 160, 16):
        device.session.push_samples(period, period * TICKS, samples(period, 16))
        tick = (period + 15) * TICKS
        device.advance(tick)
    tick += round(away * 20e6)
    device.advance(tick)
    classes = [number >> 8 & 7 for number, _, _ in can_rows.parts(b"".join(iter(device.take, b"")))]
    assert CanClass.STATUS in classes  # the heartbeat
    assert (max(classes) >= CanClass.SAMPLES) == (away < 0.5)


def test_a_fault_raised_any_number_of_times_is_seen(tmp_path: Path) -> None:
    """Between two polls the interrupt may raise faults over and over; none is lost, whatever the count."""
    must_run(tmp_path, HERE / "raise.c", SOURCE / "hbp.c")


def test_its_own_divisions_are_right(tmp_path: Path) -> None:
    """Against the compiler's, for indices and ticks of any size."""
    must_run(tmp_path, HERE / "divide.c")


@pytest.mark.parametrize("rate", [5760, 11520, 92160])
def test_streams_do_not_keep_a_reply_waiting_on_a_slow_link(rate: int) -> None:
    """What is before the reply takes less than the 250 ms after which a host asks again, though nobody read for 2 s."""
    link = CompiledLink(1 << 16, float(rate))
    session = link.add(SmallDrive(), identity())
    link.advance(0)
    link.receive(wire_of(StreamSet(0, StreamEvent.PWM, 16000 * 40 // rate, 20, (3, 4)), 1))
    link.receive(wire_of(StreamStart(1), 2))
    link.data_to_send()
    for period in range(0, 32000, 16):
        session.push_samples(period, period * TICKS, samples(period, 16))
        link.advance((period + 16) * TICKS)
    link.receive(wire_of(StateCommand(Command.STOP, 0), 3))
    sent = link.data_to_send()
    replies = [frame.tid for frame in frames_in(sent) if frame.is_reply]
    assert replies == [3]
    before = next(n for n in range(len(sent) + 1) if any(frame.tid == 3 for frame in frames_in(sent[:n])))
    assert 0 < before < 0.25 * rate


def test_what_is_wrong_with_a_configuration_is_named(tmp_path: Path) -> None:
    """hbp_add tells which channel or parameter is wrong, and how; one byte beyond the sample is seen."""
    must_run(tmp_path, HERE / "wrong.c", SOURCE / "hbp.c")


def test_other_options_in_another_file_are_told(tmp_path: Path) -> None:
    for options in ("-DHBP_TX_BYTES=4096", "-DHBP_CHANNELS=40", "-DHBP_EDGES=64"):
        own = [*compiler(), "-I", SOURCE]
        subprocess.run([*own, options, "-c", HERE / "other.c", "-o", tmp_path / "other.o"], check=True)
        must_run(tmp_path, tmp_path / "other.o", SOURCE / "hbp.c")
