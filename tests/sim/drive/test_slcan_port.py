"""The emulated slcan adapter: its answers as LAWICEL's, frames both ways, faults."""

from __future__ import annotations

import os
import select
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from can_rows import frame

from protocol.canmap.frame import BRS, ERROR, ERROR_CONTROLLER, ERROR_PROTOCOL, FDF, BusRates
from sim.ports.slcan_port import MAX_ANSWERS, SlcanPort

CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)


class Host:
    """A terminal on the adapter's pty: what it types, and what the adapter types back."""

    def __init__(self, rates: BusRates, path: Path | None = None) -> None:
        self.port = SlcanPort(path, rates)
        self.fd = -1
        self.open()

    def open(self) -> None:
        name = self.port.target.removeprefix("can:slcan/").partition("?")[0]
        self.fd = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def types(self, text: bytes) -> bytes:
        """Frames that this sends to the bus."""
        os.write(self.fd, text)
        assert select.select(self.port.read_fds(), [], [], 5.0)[0]
        return self.port.read()

    def sees(self, size: int) -> bytes:
        """What the adapter has written, once it is `size` bytes, and all that is there with them."""
        text = b""
        while select.select([self.fd], [], [], 5.0 if len(text) < size else 0.0)[0]:
            text += os.read(self.fd, 65536)
        return text

    def must_see(self, text: bytes) -> None:
        assert self.sees(len(text)) == text

    def close(self) -> None:
        os.close(self.fd)
        self.port.unplug()


@pytest.fixture
def classic() -> Iterator[Host]:
    host = Host(CLASSIC)
    yield host
    host.close()


@pytest.fixture
def fd() -> Iterator[Host]:
    host = Host(FD)
    yield host
    host.close()


# What is typed and what comes back, "." a carriage return, "!" a bell
ANSWERS = """
    V.>V1013. v.>v1013. N.>NSIM1. .>. C.>. S0.>. S.>! S10.>! s031C.>. s03.>! Y5.>. Y3.>! Z0.>. Z2.>! W0.>. X1.>. X0.>!
    M00000000.>. M0000.>! mFFFFFFFF.>. m00000000.>! F.>! O.F.>.F00. O.O.>.! O.S8.>.! O.C.S8.>... t1230.>! ?.>! z.>!
    O.C.t1230.>..! O.t1230.T000001230.>.z.Z. O.r1234.R000001234.>.z.Z. L.t1230.>.! O.t12.>.! O.d1230.b1230.>.!!
"""


@pytest.mark.parametrize("pair", ANSWERS.split())
def test_answers(classic: Host, pair: str) -> None:
    typed, answer = (text.replace(".", "\r").replace("!", "\a").encode() for text in pair.split(">"))
    frames = classic.types(typed)
    classic.must_see(answer)  # and no frame of its own
    assert len(frames) == 80 * answer.lower().count(b"z")
    assert classic.port.refused == answer.count(b"\a")


def test_time_stamps(classic: Host) -> None:
    classic.types(b"Z1\rO\r")
    classic.port.write(frame(0x123, b"\x01", time=60.2585))
    classic.must_see(b"\r\rt1231010102\r")  # 258 ms = 0x0102
    classic.types(b"C\rZ0\rO\r")
    classic.port.write(frame(0x123, b"\x01", time=60.2585))
    classic.must_see(b"\r\r\rt123101\r")


def test_listen_only_hears(classic: Host) -> None:
    assert classic.types(b"L\rt1230\r") == b""
    classic.port.write(frame(7))
    classic.must_see(b"\r\at0070\r")


def test_another_bit_rate_loses_frames_both_ways(classic: Host) -> None:
    assert classic.types(b"S6\rO\rt1230\rt1240\r") == b""
    assert classic.port.write(frame(1) * 3) == 240
    classic.must_see(b"\r\rz\rz\r")
    assert classic.port.mismatched == 5
    # the same host at the bus's own rate
    assert classic.types(b"C\rS8\rO\rt1230\r") == frame(0x123)
    assert classic.port.mismatched == 5


@pytest.mark.parametrize("registers", [0x0014, 0x0023, 0x4014, 0x001C, 0x0114, 0x411C, 0x432B])
@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 125_000])
def test_timing_registers_mean_what_python_can_says(registers: int, bitrate: int) -> None:
    timing = can.BitTiming.from_registers(8_000_000, registers >> 8, registers & 255)
    host = Host(BusRates(bitrate))
    assert bool(host.types(b"s%04X\rO\rt1230\r" % registers)) == (timing.bitrate == bitrate)
    host.close()


def test_another_data_bit_rate_loses_the_frames_that_switch(fd: Host) -> None:
    mixed = frame(1) + frame(2, b"", FDF) + frame(3, b"", FDF | BRS)
    assert fd.types(b"Y2\rO\rt0010\rd0020\rb0030\r") == mixed[:160]
    assert fd.port.write(mixed) == 240
    fd.must_see(b"\r\rz\rz\rz\rt0010\rd0020\r")
    assert fd.port.mismatched == 2
    assert fd.types(b"C\rY5\rO\rb0030\r") == mixed[160:]


def test_errors_of_the_bus_show_in_the_status(classic: Host) -> None:
    classic.types(b"O\r")
    records = frame(ERROR | ERROR_CONTROLLER, bytes([0, 0x08, *bytes(6)])) + frame(1)
    assert classic.port.write(records) == 160
    classic.types(b"F\rF\r")
    classic.must_see(b"\rt0010\rF04\rF00\r")  # warning; read once
    classic.port.write(frame(ERROR | ERROR_CONTROLLER, bytes([0, 0x10, *bytes(6)])))
    classic.port.write(frame(ERROR | ERROR_CONTROLLER, bytes([0, 0x01, *bytes(6)])))
    classic.port.write(frame(ERROR | ERROR_PROTOCOL, bytes(8)))
    classic.types(b"F\r")
    classic.must_see(b"FA8\r")  # passive, overrun, bus error


def test_a_full_pty_cuts_no_line_and_takes_no_more(fd: Host) -> None:
    fd.types(b"O\r")
    records = b"".join(frame(n % 2048, n.to_bytes(4, "little") + bytes(60), FDF | BRS) for n in range(3000))
    taken = 0
    for _ in range(10_000):
        step = fd.port.write(records[taken : taken + 80 * 64])
        taken += step
        if not step:
            break
    assert 0 < taken < len(records)
    assert taken % 80 == 0
    fd.types(b"F\r")  # its answer waits behind the line that was cut
    text = fd.sees(taken // 2)
    while text.count(b"\r") < 3002:  # the acknowledged O, 3000 frames, F00
        fd.port.read()
        taken += fd.port.write(records[taken : taken + 80 * 64])
        text += fd.sees(1)
    lines = text.removeprefix(b"\r").split(b"\r")
    lines.remove(b"F00")
    whole = [b"b%03XF" % (n % 2048) + n.to_bytes(4, "little").hex().upper().encode() + b"00" * 60 for n in range(3000)]
    assert lines == [*whole, b""]


def test_answers_to_a_host_that_does_not_read_are_bounded(classic: Host) -> None:
    asked = 0
    while not classic.port.answers_dropped and asked < 1_000_000:
        classic.types(b"V\r" * 1000)
        asked += 1000
    classic.types(b"?\r")
    while not classic.port.refused:  # all that was asked has been read
        classic.port.read()
    answers = asked + 1 - classic.port.answers_dropped
    assert answers * len(b"V1013\r") > MAX_ANSWERS  # what the pty holds, and then our own buffer
    text = b""
    while text.count(b"V") + text.count(b"\a") < answers:
        text += classic.sees(1)
        classic.port.read()
    assert set(text.rstrip(b"\a").split(b"\r")[1:]) == {b"V1013", b""}


def test_target_names_port_and_rates(tmp_path: Path) -> None:
    port = SlcanPort(tmp_path / "ttyCAN", FD)
    assert port.target == f"can:slcan/{tmp_path}/ttyCAN?bitrate=1000000&fd=1&data_bitrate=5000000"
    port.unplug()
    port = SlcanPort(None, BusRates(500_000))
    assert port.target.startswith("can:slcan//dev/")
    assert port.target.endswith("?bitrate=500000")
    port.unplug()


def test_unplugged_it_vanishes_and_comes_back_closed(tmp_path: Path) -> None:
    host = Host(CLASSIC, tmp_path / "ttyCAN")
    host.types(b"S0\rO\r")
    host.must_see(b"\r\r")
    host.port.unplug()
    assert not (tmp_path / "ttyCAN").is_symlink()
    assert host.port.read_fds() == []
    assert host.port.read() == b""
    assert host.port.write(frame(1)) == 80
    os.close(host.fd)
    host.port.plug()
    host.open()
    host.port.write(frame(2))
    assert host.types(b"O\rt1230\r") == frame(0x123)  # the bit rate went with the power
    host.port.write(frame(3))
    host.must_see(b"\rz\rt0030\r")
    host.close()
