"""Target strings: what is accepted, and that each refusal names the part at fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from protocol.canmap import ids
from protocol.canmap.frame import BusRates
from protocol.errors import TargetError
from protocol.links import CanTarget, SerialTarget, TcpTarget, parse_target
from protocol.links.target import DEFAULT_BAUD, MAX_HOST, MAX_NODE


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("serial:/dev/ttyACM0", SerialTarget("/dev/ttyACM0", DEFAULT_BAUD)),
        ("serial:/dev/ttyACM0?baud=3000000", SerialTarget("/dev/ttyACM0", 3_000_000)),
        ("serial:COM3?baud=921600", SerialTarget("COM3", 921_600)),
        (r"serial:\\.\COM10?baud=921600", SerialTarget(r"\\.\COM10", 921_600)),
        ("tcp:127.0.0.1:7000", TcpTarget("127.0.0.1", 7000)),
        ("tcp:bench.local:1", TcpTarget("bench.local", 1)),
        ("tcp:[::1]:65535", TcpTarget("::1", 65535)),
        ("can:", CanTarget()),
        ("can:virtual", CanTarget("virtual")),
        ("can:/bench", CanTarget(None, "bench")),
        ("can:socketcan/can0", CanTarget("socketcan", "can0")),
        ("can:slcan//dev/ttyACM0", CanTarget("slcan", "/dev/ttyACM0")),
        ("can:etas/ETAS://ETH/ES910:abcd/CAN:1", CanTarget("etas", "ETAS://ETH/ES910:abcd/CAN:1")),
        ("can:socketcan/can0?node=15&ext=1", CanTarget("socketcan", "can0", node=15, extended=True)),
        ("can:?context=bench", CanTarget(context="bench")),
        ("can:socketcan/can0?host_number=1", CanTarget("socketcan", "can0", host=1)),
        ("can:socketcan/can0?node=2&ext=1&host_number=15", CanTarget("socketcan", "can0", (), 2, True, None, 15)),
        (
            "can:socketcand/can0?host=10.0.0.5&port=29536&host_number=3",
            CanTarget("socketcand", "can0", (("host", "10.0.0.5"), ("port", "29536")), host=3),
        ),
        (
            "can:pcan/PCAN_USBBUS1?fd=1&bitrate=500000&data_bitrate=5000000&node=2",
            CanTarget(
                "pcan", "PCAN_USBBUS1", (("fd", "1"), ("bitrate", "500000"), ("data_bitrate", "5000000")), node=2
            ),
        ),
    ],
)
def test_reads_and_writes_back(text: str, target: object) -> None:
    assert parse_target(text) == target
    assert str(parse_target(text)) == text


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("can:slcan/dev/ttyACM0", "can:slcan//dev/ttyACM0"),
        ("can:virtual/", "can:virtual"),
        ("can:virtual/x?ext=0&node=1", "can:virtual/x"),
        ("can:virtual/x?host_number=0", "can:virtual/x"),
        ("can:virtual/x?host_number=2&node=4", "can:virtual/x?node=4&host_number=2"),
        ("can:virtual/x?node=4&bitrate=125000", "can:virtual/x?bitrate=125000&node=4"),
    ],
)
def test_two_ways_to_write_a_can_target(text: str, same: str) -> None:
    assert str(parse_target(text)) == same
    assert parse_target(text) == parse_target(same)


@pytest.mark.parametrize(
    ("query", "rates"),
    [
        ("", BusRates(1_000_000)),
        ("?bitrate=250000", BusRates(250_000)),
        ("?fd=0&bitrate=250000", BusRates(250_000)),
        ("?fd=1", BusRates(1_000_000, 5_000_000)),
        ("?fd=1&bitrate=500000&data_bitrate=2000000", BusRates(500_000, 2_000_000)),
    ],
)
def test_bit_rates_of_a_can_target(query: str, rates: BusRates) -> None:
    target = parse_target(f"can:pcan/x{query}")
    assert target.rates == rates


def test_nodes_and_hosts_are_those_of_the_identifiers() -> None:
    assert (MAX_NODE, MAX_HOST) == (ids.MAX_NODE, ids.SLOTS - 1)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["unknown target", "serial:", "tcp:", "can:"]),
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
        ("serial:/dev/x?baud=99999999999", ["'99999999999'", "50000000"]),
        ("tcp:localhost", ["HOST:PORT"]),
        ("tcp::7000", ["HOST:PORT"]),
        ("tcp:localhost:0", ["from 1 to 65535", "'0'"]),
        ("tcp:localhost:65536", ["'65536'"]),
        ("tcp:::1:7000", ["brackets"]),
        ("tcp:localhost:1?baud=9600", ["unknown key 'baud'"]),
        ("cn:virtual/x", ["did you mean can:?"]),
        ("can:virtual/x?node=0", ["node must be a whole number from 1 to 15, got '0'"]),
        ("can:virtual/x?node=16", ["from 1 to 15", "'16'"]),
        ("can:virtual/x?host_number=16", ["host_number must be a whole number from 0 to 15, got '16'"]),
        ("can:virtual/x?host_number=-1", ["host_number", "from 0 to 15", "'-1'"]),
        ("can:virtual/x?ext=yes", ["ext must be", "'yes'"]),
        ("can:virtual/x?fd=true", ["fd must be", "'true'"]),
        ("can:virtual/x?bitrate=1M", ["bitrate", "whole number", "'1M'"]),
        ("can:virtual/x?bitrate=1000001", ["1000000"]),
        ("can:virtual/x?data_bitrate=2000000", ["add fd=1"]),
        ("can:virtual/x?fd=1&bitrate=500000&data_bitrate=250000", ["data_bitrate", "from 500000"]),
        ("can:virtual?channel=x", ["channel is not an option", "can:INTERFACE/CHANNEL"]),
        ("can:?interface=virtual", ["interface is not an option"]),
    ],
)
def test_refuses_in_one_line(text: str, parts: list[str]) -> None:
    with pytest.raises(TargetError) as caught:
        parse_target(text)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_however_one_place_is_written_it_is_one(tmp_path: Path) -> None:
    port = tmp_path / "ttyACM0"
    port.touch()
    (tmp_path / "by-id").symlink_to(port)
    one = ("serial:{}/ttyACM0", "serial:{}/by-id?baud=3000000", "serial:{}/../{name}/ttyACM0")
    for same in (
        [way.format(tmp_path, name=tmp_path.name) for way in one],
        ["tcp:localhost:7000", "tcp:127.0.0.1:7000", "tcp:LOCALHOST:7000"],
        ["can:socketcan/can0", "can:socketcan/can0?node=2", "can:socketcan/can0?bitrate=500000"],
        ["serial:/dev/ttyACM9", "can:slcan/dev/ttyACM9", "can:slcan/dev/ttyACM9?fd=1"],
        ["serial:COM10", "serial:com10?baud=9600", r"serial:\\.\COM10", "can:slcan/COM10?bitrate=500000"],
    ):
        assert len({parse_target(text).place for text in same}) == 1
    others = [
        "tcp:127.0.0.1:7001",
        "tcp:[::1]:7000",
        "can:socketcan/can1",
        "serial:COM1",
        "serial:COM10",
        "can:virtual/can0",
        "can:",
        f"serial:{tmp_path}",
    ]
    assert len({parse_target(text).place for text in others}) == len(others)
