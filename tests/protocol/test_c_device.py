"""The device side in C: frames in any pieces, and the same answers as the device side in Python to whatever comes."""

from __future__ import annotations

import subprocess
from pathlib import Path

import can_rows
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_drive import TICKS, SmallDrive, edges_at, frames_in, identity, pack_edges, samples, small_link_in_c, wire_of
from test_same_answers import REQUEST, U8, loose
from test_vectors import each

from protocol.canmap.compiled import POOL, CompiledCan
from protocol.canmap.device import CanDevice
from protocol.canmap.frame import CAN_RECORD, RECORD_BYTES, BusRates
from protocol.canmap.host import CanWire
from protocol.canmap.ids import CanClass
from protocol.canmap.transport import CanCounters, Reassembler
from protocol.device.compiled import SOURCE, CompiledLink, compiler, host_options
from protocol.device.tx import TxQueue
from protocol.framing import MAJOR, Frame, parse_frame
from protocol.messages import (
    Alive,
    Command,
    MessageType,
    Request,
    Setpoint,
    StateCommand,
    StreamEvent,
    StreamSet,
    StreamStart,
    TimeSync,
)
from tests.choice import examples
from tests.tools import needs

BOOT = 0xB0071D
pytestmark = needs("C compiler")


HERE = Path(__file__).parent / "c"
OWN = SOURCE / "hbp.c", SOURCE / "hbp_capture.c"


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


def test_an_edge_is_illegal_by_the_code_after_it_or_by_two_inputs_that_change() -> None:
    link, session, _ = small_link_in_c()
    link.receive(wire_of(StreamSet(0, StreamEvent.EDGES, 0, 0, ()), 1) + wire_of(StreamStart(1), 2))
    pairs = np.array([(old, new) for old in range(8) for new in range(8) if old != new])
    old, new = pairs.T
    for at in range(len(pairs)):
        one = np.array([at])
        session.push_edges(pack_edges(one, old[one], new[one], one < 0, one))
        link.advance(1000 + at)
    frames = [frame for frame in frames_in(link.data_to_send()) if frame.type == MessageType.EDGES]
    codes = np.frombuffer(b"".join(frame.payload[16:] for frame in frames), np.uint8)[4::8]
    changed = [bin(a ^ b).count("1") for a, b in pairs]
    illegal = [b in (0, 7) or n > 1 for (_, b), n in zip(pairs, changed, strict=True)]
    assert [(c & 7, c >> 3 & 7) for c in codes.tolist()] == [(a, b) for a, b in pairs.tolist()]
    assert (codes >> 6 & 1).tolist() == illegal


@each("framing")
def test_frames_are_found_or_counted_however_they_come(case: dict) -> None:
    wire = bytes.fromhex(case["wire_hex"])
    good = case["verdict"] == "ok"
    for cut in range(0, len(wire) + 1, max(1, len(wire) // 9)):
        link, session, _ = small_link_in_c()
        link.data_to_send()
        link.receive(wire[:cut])
        link.receive(wire[cut:])
        assert session.bad == (case["verdict"] not in ("ok", "nothing"))
        if not good:
            assert link.data_to_send() == b""
        link.receive(b"\0" + wire_of(TimeSync(), 99))
        assert frames_in(link.data_to_send())[-1].tid == 99


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
    messages: list[Frame] = []
    parts: dict[int, Reassembler] = {}
    for number, data, flags in can_rows.parts(records):
        if number >> 8 & 7 > CanClass.TO_HOST:
            found.setdefault(number, []).append((data, flags))
            continue
        found.setdefault(number, []).append((len(data), data[-1], flags))
        raw = parts.setdefault(number, Reassembler(number >> 4 & 15, CanCounters())).feed(data)
        if raw is not None:
            frame = parse_frame(raw)
            messages.append(frame)
    return found, list(map(loose, sorted(messages, key=lambda frame: frame.type == MessageType.HEARTBEAT)))


@examples(20, 300, campaign="c")
@given(
    st.lists(st.one_of(can_steps(), can_steps(), st.integers(1, 400), st.just("again")), min_size=20, max_size=40),
    st.sampled_from([CLASSIC, FD]),
    st.booleans(),
)
def test_same_frames_as_in_python_on_can(steps: list, rates: BusRates, extended: bool) -> None:
    tx = TxQueue(1 << 24, 1 << 20)
    python = CanDevice(SmallDrive(), identity(), rates, extended, tx)
    c = CompiledCan(SmallDrive(), identity(), rates, extended, host_options(POOL, 1 << 13))
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
        assert by_identifier(ours) == by_identifier(theirs)
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
    must_run(tmp_path, HERE / "raise.c", *OWN)


def test_its_own_divisions_are_right(tmp_path: Path) -> None:
    """Against the compiler's, for indices and ticks of any size."""
    must_run(tmp_path, HERE / "divide.c", SOURCE / "hbp_capture.c")


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
    must_run(tmp_path, HERE / "wrong.c", *OWN)


def test_other_options_in_another_file_are_told(tmp_path: Path) -> None:
    for options in ("-DHBP_TX_BYTES=4096", "-DHBP_CHANNELS=40", "-DHBP_EDGES=64"):
        own = [*compiler(), "-I", SOURCE]
        subprocess.run([*own, options, "-c", HERE / "other.c", "-o", tmp_path / "other.o"], check=True)
        must_run(tmp_path, tmp_path / "other.o", *OWN)
