"""Connecting to a board that boots first, that hears nothing, or that is not alone on its wires. In virtual time."""

from __future__ import annotations

import re

import pytest
from against import INFO, bench

from bench.device.client import Client
from protocol.errors import NoReply
from protocol.framing import Deframer, encode_frame, parse_frame
from protocol.links.serial import BOOT
from protocol.links.target import parse_target
from tests.choice import sampled
from tests.devices import serving
from tests.devices.device import Device

SOON = 0.4  # s from the first heartbeat, which comes at once, to the answer


def connected(device: Device, open_delay: float = 0.0) -> float:
    """When it was found, s after it was opened; a byte link has the patience of a serial port."""
    device.link.patience, device.link.delay = BOOT, open_delay
    Client(device.link).connect()
    return float(device.link.clock())


TIMES = [("bytes", t) for t in (0.05, 0.8, 1.5, 2.45, 2.6, 3.0, 3.5, 4.9, 6.0)]
TIMES += [("CAN", t) for t in (0.05, 0.8, 1.5, 2.45, 2.6, 2.9)]


@pytest.mark.parametrize(("carrier", "boots"), sampled("boots", TIMES, 8, campaign="links"))
def test_a_board_that_boots_when_it_is_opened_is_found_as_soon_as_it_is_up(carrier: str, boots: float) -> None:
    with serving("full", ["boots"], carrier, after=boots) as device:
        assert boots <= connected(device) < boots + SOON
        assert device.seen["HELLO"] < 8


@pytest.mark.parametrize("boots", [1.0, 2.6, 6.0])
def test_a_board_that_speaks_before_it_resets_is_waited_for(boots: float) -> None:
    """Its port was open in another program: a heartbeat is heard, then it boots."""
    with serving("full", ["boots"], "bytes", after=boots) as device:
        device.heartbeat()
        assert boots <= connected(device) < boots + 1.0 + SOON


@pytest.mark.parametrize(("delay", "found"), [(0.0, False), (1.0, False), (2.5, True), (5.0, True)])
def test_nothing_is_sent_to_a_boot_loader_for_as_long_as_is_said(delay: float, found: bool) -> None:
    """It takes the first byte within 2 s for the beginning of an update, and never starts its program."""
    with serving("full", ["boots"], "bytes", after=2.0) as device:
        write, clock = device.link.write, device.link.clock

        def into_boot_loader(data: bytes) -> None:
            if clock() < 2.0:
                device.after = 1e9
            write(data)

        device.link.write = into_boot_loader
        if found:
            assert delay <= connected(device, delay) < max(delay, 2.0) + SOON
        else:
            with pytest.raises(NoReply, match=r"within 7 s \(0 bytes heard"):
                connected(device, delay)


@pytest.mark.parametrize(("text", "delay"), [("2", 2.0), ("0.5", 0.5), ("60", 60.0)])
def test_the_target_says_how_long(text: str, delay: float) -> None:
    target = parse_target(f"serial:/dev/ttyACM0?open_delay={text}&baud=9600")
    assert (target.open_delay, target.baud) == (delay, 9600)  # type: ignore[attr-defined]
    assert parse_target(str(target)) == target


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
@pytest.mark.parametrize("command", [INFO, "devices TARGET", "live TARGET --speed 100 --yes --viewer none"])
def test_a_device_that_is_heard_and_hears_nothing(command: str, carrier: str, capsys) -> None:
    with serving("full", ["deaf"], carrier) as device:
        ran = bench(command, device, capsys)
    assert ran.code == 2
    assert re.search(r"is heard, and does not hear this program: check .* TX", ran.text), ran.text
    assert not re.search("baud|bit rate|power", ran.text)


def test_who_hears_only_itself_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with serving("full", ["boots"], "bytes", after=1e9) as device:
        write = device.link.write

        def echoed(data: bytes) -> None:
            device.link.port.to_host += data
            write(data)

        device.link.write = echoed
        ran = bench(INFO, device, capsys)
    assert "only what this program sends is heard" in ran.text
    assert "HBP device is heard" not in ran.text


def test_an_echo_beside_the_answers_is_no_second_device(capsys: pytest.CaptureFixture[str]) -> None:
    with serving("full", [], "bytes") as device:
        write = device.link.write

        def echoed(data: bytes) -> None:
            device.link.port.to_host += data
            write(data)

        device.link.write = echoed
        ran = bench(INFO, device, capsys)
    assert ran.code == 0, ran.text


def test_a_node_that_is_not_there_where_others_are(capsys: pytest.CaptureFixture[str]) -> None:
    with serving("full", [], "CAN") as device:
        wire = device.link.wire
        device.link.wire = lambda: (made := wire(), setattr(made, "node", 7))[0]
        ran = bench("live TARGET --viewer none", device, capsys)
    assert ran.code == 2
    assert "node 7 is not there, but 1: add node=1 to the target" in ran.text


def test_an_answer_that_comes_twice_is_one_device() -> None:
    """A bridge that repeats frames, or a device that answers twice: both answers are the same."""
    with serving("full", [], "bytes") as device:
        read, deframer = device.link.read, Deframer()
        deframer.feed(b"\0")

        def twice(timeout: float, settle: float = 0.0) -> bytes:
            frames = [encode_frame(parse_frame(raw)) for raw in deframer.feed(read(timeout, settle))]
            return b"".join(frame + frame for frame in frames)

        device.link.read = twice
        client = Client(device.link)
        assert client.connect().node == 1
        assert not client.several
