"""Target strings: what is accepted, and that each refusal names the part at fault."""

from __future__ import annotations

import pytest

from protocol.errors import TargetError
from protocol.links import SerialTarget, TcpTarget, parse_target
from protocol.links.target import DEFAULT_BAUD


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("serial:/dev/ttyACM0", SerialTarget("/dev/ttyACM0", DEFAULT_BAUD)),
        ("serial:/dev/ttyACM0?baud=3000000", SerialTarget("/dev/ttyACM0", 3_000_000)),
        ("serial:COM3?baud=921600", SerialTarget("COM3", 921_600)),
        ("tcp:127.0.0.1:7000", TcpTarget("127.0.0.1", 7000)),
        ("tcp:bench.local:1", TcpTarget("bench.local", 1)),
        ("tcp:[::1]:65535", TcpTarget("::1", 65535)),
    ],
)
def test_reads_and_writes_back(text: str, target: object) -> None:
    assert parse_target(text) == target
    assert str(parse_target(text)) == text


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["unknown target", "serial:", "tcp:"]),
        ("serail:/dev/ttyACM0", ["serail", "did you mean serial:?"]),
        ("usb:1", ["unknown target 'usb:1'", "serial:", "tcp:"]),
        ("/dev/ttyACM0", ["serial:/dev/ttyACM0"]),
        ("COM3", ["serial:COM3"]),
        ("serial:", ["names no port"]),
        ("serial:/dev/x?speed=1", ["unknown key 'speed'", "baud"]),
        ("serial:/dev/x?baud", ["'baud' is not key=value"]),
        ("serial:/dev/x?baud=", ["not key=value"]),
        ("serial:/dev/x?baud=9600&baud=1", ["baud twice"]),
        ("serial:/dev/x?baud=fast", ["'fast'", "whole number"]),
        ("serial:/dev/x?baud=0", ["'0'", "300"]),
        ("serial:/dev/x?baud=-9600", ["'-9600'"]),
        ("serial:/dev/x?baud=99999999999", ["'99999999999'", "50000000"]),
        ("tcp:localhost", ["HOST:PORT"]),
        ("tcp::7000", ["HOST:PORT"]),
        ("tcp:localhost:", ["port must be a whole number"]),
        ("tcp:localhost:0", ["from 1 to 65535", "'0'"]),
        ("tcp:localhost:65536", ["'65536'"]),
        ("tcp:::1:7000", ["brackets"]),
        ("tcp:localhost:1?baud=9600", ["unknown key 'baud'"]),
    ],
)
def test_refuses_in_one_line(text: str, parts: list[str]) -> None:
    with pytest.raises(TargetError) as caught:
        parse_target(text)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message
