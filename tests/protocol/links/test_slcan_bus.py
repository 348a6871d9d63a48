"""The slcan bus against the emulated adapter over a real pty, and under python-can's own tools."""

from __future__ import annotations

import asyncio
import os
import select
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest
from can_rows import CLASSIC_MESSAGES, FD_MESSAGES, frame, records_of, untimed

from protocol.canmap.frame import BRS, CAN_RECORD, EXTENDED, FDF, BusRates
from protocol.links.slcan_bus import SlcanBus
from sim.ports.slcan_port import SlcanPort

CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)


def sent_by_host(port: SlcanPort, count: int) -> bytes:
    """The next `count` frames that the host sends to the bus."""
    records = b""
    while len(records) <= 80 * count and select.select(port.read_fds(), [], [], 5.0)[0]:
        records += port.read()
        if len(records) == 80 * count:
            break
    return records


def received(bus: SlcanBus, count: int, settle: float = 0.0) -> bytes:
    """The next `count` frames from the bus, or more if they come together."""
    records = b""
    while len(records) < 80 * count and (more := bus.recv_records(5.0, settle)):
        records += more
    return records


@contextmanager
def opened(path: Path, rates: BusRates, **keywords: object) -> Iterator[tuple[SlcanPort, SlcanBus]]:
    """An adapter, and a bus on it: the adapter has read the commands that open its channel, and answered them."""
    port = SlcanPort(path / "ttyCAN", rates)
    obeying = threading.Thread(target=sent_by_host, args=(port, 0))
    obeying.start()
    bus = SlcanBus(str(path / "ttyCAN"), **keywords)
    obeying.join()
    assert port.refused == 0
    yield port, bus
    bus.shutdown()
    port.unplug()


@pytest.fixture
def classic(tmp_path: Path) -> Iterator[tuple[SlcanPort, SlcanBus]]:
    with opened(tmp_path, CLASSIC, bitrate=1_000_000) as ends:
        yield ends


@pytest.fixture
def fd(tmp_path: Path) -> Iterator[tuple[SlcanPort, SlcanBus]]:
    with opened(tmp_path, FD, bitrate=1_000_000, fd=True, data_bitrate=5_000_000) as ends:
        yield ends


@pytest.mark.parametrize(("kind", "messages"), [("classic", CLASSIC_MESSAGES), ("fd", CLASSIC_MESSAGES + FD_MESSAGES)])
def test_messages_and_records_both_ways(kind: str, messages: list[can.Message], request: pytest.FixtureRequest) -> None:
    port, bus = request.getfixturevalue(kind)
    for msg in messages:
        bus.send(msg)
    assert sent_by_host(port, len(messages)) == records_of(messages)
    assert port.write(records_of(messages)) == 80 * len(messages)
    for msg in messages:
        got = bus.recv(5.0)
        assert got.equals(msg, timestamp_delta=None), f"{got} is not {msg}"
        assert abs(got.timestamp - time.time()) < 5.0
    records = records_of(messages)
    bus.send_records(records)
    assert sent_by_host(port, len(messages)) == records
    before = time.monotonic()
    port.write(frame(1) + frame(2) + records)
    assert bus.recv(5.0).arbitration_id == 1  # has read more, which is not lost
    rows = received(bus, 1 + len(messages), settle=0.001)
    assert untimed(rows) == frame(2) + records
    times = np.frombuffer(rows, CAN_RECORD)["time"]
    assert before <= times.min() <= times.max() <= time.monotonic()
    assert (bus.refused, bus.malformed, port.refused, port.mismatched) == (0, 0, 0, 0)


def test_nothing_there_is_empty_within_the_timeout(classic: tuple[SlcanPort, SlcanBus]) -> None:
    port, bus = classic
    bus.send(CLASSIC_MESSAGES[0])
    sent_by_host(port, 1)  # writes its z: an acknowledgement does not end the wait
    start = time.monotonic()
    assert bus.recv_records(0.05) == b""
    assert bus.recv_records(0.0) == b""
    assert bus.recv(0.0) is None
    assert 0.05 <= time.monotonic() - start < 2.0


def test_an_fd_frame_between_two_lengths_is_padded(fd: tuple[SlcanPort, SlcanBus]) -> None:
    port, bus = fd
    bus.send(can.Message(arbitration_id=1, is_fd=True, data=b"\xff" * 9))
    assert sent_by_host(port, 1) == frame(1 | EXTENDED, b"\xff" * 9 + bytes(3), FDF)


def test_frames_that_do_not_fit_the_bus(classic: tuple[SlcanPort, SlcanBus]) -> None:
    _, bus = classic
    with pytest.raises(can.CanOperationError, match=r"slcan .*ttyCAN: a CAN FD frame needs a bus opened with fd=True"):
        bus.send(FD_MESSAGES[0])
    with pytest.raises(can.CanOperationError, match="slcan has no line for a frame with id 0x20000000"):
        bus.send(can.Message(is_error_frame=True))


@pytest.fixture
def raw() -> Iterator[tuple[int, str]]:
    """An adapter that is only a pty: the test writes its lines."""
    master, slave = os.openpty()
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize("end", [b"\r", b"\r\n", b"\n"])
@pytest.mark.parametrize("refuses", [b"", b"S8"])
def test_an_adapter_may_end_its_lines_as_println_does(raw: tuple[int, str], end: bytes, refuses: bytes) -> None:
    """Each command has its answer all the same, and a bell is one; then frames come."""
    master, path = raw

    def adapter() -> None:
        told = b""
        while not told.endswith(b"O\r"):
            told += os.read(master, 100)
        for command in told.split(b"\r")[:-1]:
            os.write(master, b"\a" if refuses and command == refuses else end)
        os.write(master, b"t0010" + end + b"t00218A" + end + b"T000000030" + end)

    answering = threading.Thread(target=adapter)
    answering.start()
    try:
        if refuses:
            with pytest.raises(can.CanInitializationError, match="refused the bit rate 1000000"):
                SlcanBus(path, bitrate=1_000_000)
            return
        with SlcanBus(path, bitrate=1_000_000) as bus:
            rows = b""
            while len(rows) < 3 * CAN_RECORD.itemsize and (more := bus.recv_records(5.0)):
                rows += more
            assert np.frombuffer(rows, CAN_RECORD)["id"].tolist() == [1, 2, 3 | EXTENDED]
            assert (bus.malformed, bus.refused, list(bus.replies)) == (0, 0, [])
    finally:
        answering.join()


def test_damaged_lines_are_counted_and_answers_kept(raw: tuple[int, str]) -> None:
    master, path = raw
    with SlcanBus(path) as bus:
        os.write(master, b"t12\rF04\r\a\xff\rz\r\a\rV1013\rt0010\r")
        assert untimed(bus.recv_records(5.0)) == frame(1)
        assert (bus.malformed, bus.refused, list(bus.replies)) == (2, 2, [b"F04", b"V1013"])


@pytest.mark.parametrize(
    ("keywords", "typed"),
    [
        ({}, b"\rC\rO\r"),
        ({"bitrate": 500_000, "single_handle": True}, b"\rC\rS6\rO\r"),
        ({"bitrate": 83_300, "listen_only": True, "timeout": 5.0}, b"\rC\rS9\rL\r"),
        ({"bitrate": 1_000_000, "fd": True}, b"\rC\rS8\rO\r"),
        ({"bitrate": 1_000_000, "data_bitrate": 8_000_000}, b"\rC\rS8\rY8\rO\r"),
        ({"timing": can.BitTiming.from_registers(8_000_000, 0x03, 0x1C)}, b"\rC\rs031C\rO\r"),
        (
            {"timing": can.BitTimingFd.from_sample_point(80_000_000, 500_000, 80.0, 2_000_000, 80.0)},
            b"\rC\rS6\rY2\rO\r",
        ),
    ],
)
def test_commands_that_open_it(raw: tuple[int, str], keywords: dict[str, object], typed: bytes) -> None:
    master, path = raw
    bus = SlcanBus(path, **keywords)
    assert os.read(master, 100) == typed
    assert (bus.protocol is can.CanProtocol.CAN_FD) == ("fd" in keywords or b"Y" in typed)
    bus.shutdown()
    assert os.read(master, 100) == b"C\r"
    bus.shutdown()
    assert not select.select([master], [], [], 0.0)[0]


def test_arguments_that_mean_nothing(raw: tuple[int, str]) -> None:
    _, path = raw
    with pytest.raises(ValueError, match=r"bitrate 800000 is not an slcan rate: choose one of 10000, .*1000000, 83300"):
        SlcanBus(path, bitrate=800_000)
    with pytest.raises(ValueError, match=r"data_bitrate 4000000 is not an slcan rate: .* 2000000, 5000000, 8000000"):
        SlcanBus(path, fd=True, bitrate=500_000, data_bitrate=4_000_000)
    with pytest.raises(ValueError, match="the port's rate must be a whole number, got 'fast'"):
        SlcanBus(f"{path}@fast")
    with pytest.raises(ValueError, match="must name a serial port"):
        SlcanBus("")
    with pytest.raises(TypeError, match="'bitrat'"):
        SlcanBus(path, bitrat=500_000)
    for wait in ("abc", -1):
        with pytest.raises(ValueError, match=f"sleep_after_open must be a number of seconds from 0 on, got '{wait}'"):
            SlcanBus(path, sleep_after_open=wait)


@contextmanager
def answering(master: int, answers: bytes) -> Iterator[list[bytes]]:
    """An adapter that gives these answers once it has been told to open; the list gets what it was told."""
    told: list[bytes] = []

    def answer() -> None:
        text = b""
        while not text.endswith((b"O\r", b"L\r")):
            text += os.read(master, 100)
        told.append(text)
        os.write(master, answers)

    thread = threading.Thread(target=answer)
    thread.start()
    yield told
    thread.join()


# LAWICEL's CAN232 answers \r or a bell to each line; not every adapter answers an empty line
@pytest.mark.parametrize(
    ("keywords", "answers"),
    [
        ({"bitrate": 500_000}, b"\r\r\r\r"),
        ({"bitrate": 500_000}, b"\r\a\r\r"),  # no channel to close
        ({"bitrate": 500_000}, b"\a\a\r\r"),
        ({"bitrate": 500_000, "data_bitrate": 2_000_000}, b"\r\a\r\r\r"),
        ({}, b"\r\r\r"),
        ({"bitrate": 500_000}, b"\a\r\r"),  # the empty line is not answered
        ({"bitrate": 500_000}, b"z\r\r\az\r\r\r"),  # acknowledged frames of another program
    ],
)
def test_an_adapter_that_answers_is_open_at_once(
    raw: tuple[int, str], monkeypatch: pytest.MonkeyPatch, keywords: dict[str, int], answers: bytes
) -> None:
    monkeypatch.setattr("protocol.links.slcan_bus.ANSWER_TIMEOUT", 30.0)
    master, path = raw
    started = time.monotonic()
    with answering(master, answers), SlcanBus(path, **keywords) as bus:
        assert time.monotonic() - started < 10.0
        assert bus.recv_records(0.0) == b""
        assert (bus.refused, bus.malformed) == (0, 0)


@pytest.mark.parametrize(
    ("keywords", "answers", "match"),
    [
        ({"bitrate": 750_000}, b"\r\r\a\r", r"the adapter refused the bit rate 750000 \(S7\)"),
        ({"bitrate": 750_000}, b"\a\a\r", r"the adapter refused the bit rate 750000 \(S7\)"),
        ({"bitrate": 750_000}, b"\r\a\a\a", r"the adapter refused the bit rate 750000 \(S7\)"),
        ({"bitrate": 500_000, "data_bitrate": 8_000_000}, b"\r\a\r\a\r", r"the data bit rate 8000000 \(Y8\)"),
        ({"timing": can.BitTiming.from_registers(8_000_000, 0x03, 0x1C)}, b"\r\a\a\r", r"rate 125000 \(s031C\)"),
        ({"bitrate": 500_000}, b"\r\r\r\a", r"the adapter refused to open \(O\)"),
        ({"listen_only": True}, b"\r\r\a", r"the adapter refused to open in order to listen only \(L\)"),
    ],
)
def test_a_refused_command_fails_the_opening(
    raw: tuple[int, str], keywords: dict[str, object], answers: bytes, match: str
) -> None:
    master, path = raw
    with answering(master, answers), pytest.raises(can.CanInitializationError, match=match):
        SlcanBus(path, **keywords)
    assert os.read(master, 100) == b"C\r"
    SlcanBus(path).shutdown()  # the port was let go


@pytest.mark.parametrize("text", [b"", b"\a", b"READY\r\n\a\a\a\a\a\a\a", b"\x07\x07\x07\x07\x00\xff\x07\r\x07"])
def test_nothing_is_concluded_from_silence_or_foreign_text(raw: tuple[int, str], text: bytes) -> None:
    master, path = raw
    started = time.monotonic()
    with answering(master, text) as told, SlcanBus(path, bitrate=500_000):
        assert time.monotonic() - started < 5.0
        assert told == [b"\rC\rS6\rO\r"]


def test_frames_among_the_answers_are_kept(raw: tuple[int, str]) -> None:
    master, path = raw
    before = time.monotonic()
    with answering(master, b"\r\rt0010\r\rt0021AA\r\rt0030\r"), SlcanBus(path, bitrate=500_000) as bus:
        got = received(bus, 3)
        assert untimed(got) == frame(1) + frame(2, b"\xaa") + frame(3)
        assert before <= np.frombuffer(got, CAN_RECORD)["time"].min()


def test_rate_of_the_port(raw: tuple[int, str]) -> None:
    master, path = raw
    for channel, keywords in ((f"{path}@230400", {"tty_baudrate": 9600}), (path, {"tty_baudrate": 230_400})):
        with SlcanBus(channel, **keywords):
            assert termios.tcgetattr(master)[5] == termios.B230400


def test_hardware_handshake(raw: tuple[int, str]) -> None:
    master, path = raw
    for rtscts in (False, True):
        with SlcanBus(path, rtscts=rtscts):
            attributes = termios.tcgetattr(master)
            assert bool(attributes[2] & termios.CRTSCTS) == rtscts
            assert attributes[6][termios.VMIN] == 1  # an empty read means that the port is gone, never nothing to read


def test_unplug_delivers_what_had_come_and_then_names_the_port(classic: tuple[SlcanPort, SlcanBus]) -> None:
    port, bus = classic
    port.write(frame(1) + frame(2) + frame(3))
    got = [bus.recv(5.0)]  # has read all three
    port.unplug()
    got += [bus.recv(5.0), bus.recv(5.0)]
    assert [msg and msg.arbitration_id for msg in got] == [1, 2, 3]
    with pytest.raises(can.CanOperationError, match="ttyCAN is gone"):
        bus.recv(5.0)
    for use in (lambda: bus.recv_records(5.0), lambda: bus.send(CLASSIC_MESSAGES[0])):
        with pytest.raises(can.CanOperationError, match="ttyCAN"):
            use()


def test_unplug_ends_an_endless_wait(classic: tuple[SlcanPort, SlcanBus]) -> None:
    port, bus = classic
    timer = threading.Timer(0.05, port.unplug)
    timer.start()
    with pytest.raises(can.CanOperationError, match="ttyCAN is gone"):
        bus.recv()
    timer.join()


def test_a_line_that_was_cut_is_ended_before_the_next_one(
    raw: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    master, path = raw
    with SlcanBus(path) as bus:
        os.read(master, 100)
        write = os.write

        def interrupted(fd: int, data: bytes) -> int:
            write(fd, bytes(data)[:4])
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(os, "write", interrupted)
            with pytest.raises(KeyboardInterrupt):
                bus.send_records(frame(0x123, b"ab"))
        for _ in range(2):
            bus.send_records(frame(0x123, b"ab"))
        expected = b"t123" + b"\r" + b"t12326162\r" * 2
        got = b""
        while len(got) < len(expected) and select.select([master], [], [], 5.0)[0]:
            got += os.read(master, 100)
        assert got == expected


def test_one_thread_receives_while_two_send(fd: tuple[SlcanPort, SlcanBus]) -> None:
    port, bus = fd
    batches, each = 40, 50  # more than the pty takes at once
    stop = threading.Event()
    failed: list[can.CanError] = []

    def echo() -> None:
        rest = b""
        while not stop.is_set():
            select.select(port.read_fds(), [], [], 0.001)
            rest += port.read()
            rest = rest[port.write(rest) :]

    def send(number: int) -> None:
        try:
            for n in range(batches):
                bus.send_records(frame(number, n.to_bytes(8, "little") * 8, FDF | BRS) * each)
        except can.CanError as error:
            failed.append(error)

    threads = [threading.Thread(target=echo), *(threading.Thread(target=send, args=(number,)) for number in (1, 2))]
    for thread in threads:
        thread.start()
    got = received(bus, 2 * batches * each, settle=0.002)
    stop.set()
    for thread in threads:
        thread.join()
    assert failed == []
    records = np.frombuffer(got, CAN_RECORD)
    for number in (1, 2):
        data = records["data"][records["id"] == number]
        assert data.tobytes() == b"".join(n.to_bytes(8, "little") * 8 * each for n in range(batches))
    assert (bus.malformed, bus.refused, port.refused) == (0, 0, 0)


def test_notifier_logger_and_filters(fd: tuple[SlcanPort, SlcanBus], tmp_path: Path) -> None:
    """Under python-can's own tools, in an event loop."""
    port, bus = fd
    bus.set_filters([{"can_id": 0x700, "can_mask": 0x700, "extended": False}])
    messages = CLASSIC_MESSAGES[:9]

    async def listen() -> list[can.Message]:
        reader, logger = can.AsyncBufferedReader(), can.Logger(tmp_path / "log.blf")
        with can.Notifier(bus, [reader, logger], timeout=0.02, loop=asyncio.get_running_loop()):  # it stops the logger
            port.write(records_of([*FD_MESSAGES, *messages]))
            return [await asyncio.wait_for(reader.get_message(), 5.0) for _ in messages]

    got = asyncio.run(listen())
    with can.LogReader(tmp_path / "log.blf") as logged:
        for msg, heard, kept in zip(messages, got, logged, strict=True):
            assert heard.equals(msg, timestamp_delta=None)
            assert kept.equals(msg, timestamp_delta=None, check_channel=False)
