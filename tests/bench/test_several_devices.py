"""Two devices that answer as one node are named, and neither is energised; a reboot is still called one."""

from __future__ import annotations

import itertools
import re

import pytest
from against import ACCEPT, HALL, INFO, LOOK, SPIN, WATCH, bench

from tests.choice import sampled
from tests.devices import serving
from tests.devices.device import Device
from tests.devices.serving import twins
from tests.devices.spec import State

COMMANDS = {"info": INFO, "devices": "devices TARGET", "spin": SPIN, "watch": WATCH, "hall": HALL, "passive": LOOK}
COMMANDS |= {"accept": ACCEPT, "conform": "conform TARGET --level 1"}
LINKS = {"bytes": ("bytes", False), "CAN": ("CAN", False), "CAN, frames in turn": ("CAN", True)}
NAMED = r"two devices answer as node 1 on \S+ \(serial LEFT-1 and RIGHT-2\): give one another number"
BY_BOOT = NAMED.replace("serial LEFT-1 and RIGHT-2", "boot [0-9a-f]{8} and [0-9a-f]{8}")
EVERY = [(command, link) for command in COMMANDS for link in LINKS]
LONGER = SPIN.replace("0.8", "2.5")


def energised(devices: list[Device]) -> list[str]:
    return [device.vocabulary.serial for device in devices if device.seen["START"] or device.outputs_on]


@pytest.mark.parametrize(("command", "link"), sampled("twins", EVERY, 8, campaign="links"))
def test_two_devices_of_one_number_are_named_and_nothing_is_energised(
    command: str, link: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where frames of both take turns no HELLO reply comes whole: then only their boot_ids are known."""
    carrier, in_turn = LINKS[link]
    with twins(carrier, "LEFT-1", "RIGHT-2", interleaved=in_turn) as devices:
        ran = bench(COMMANDS[command], devices[0], capsys)
    assert ran.code == 2, ran.text
    assert len(re.findall(BY_BOOT if in_turn else NAMED, ran.text)) == 1, ran.text
    assert "reboot" not in ran.text
    assert not any(device.seen["ARM"] for device in devices)


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
@pytest.mark.parametrize("serials", [("", ""), ("A", ""), ("A", "B", "C")])
def test_they_are_named_as_far_as_they_tell(
    serials: tuple[str, ...], carrier: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with twins(carrier, *serials) as devices:
        ran = bench(INFO, devices[0], capsys)
    boots = " and ".join(sorted(f"{device.boot_id:08x}" for device in devices))
    named = "3 devices answer as node 1" if len(serials) > 2 else rf"\(boot {boots}\)"
    assert re.search(named, ran.text), ran.text


RUNS = {
    "spin": (LONGER, 2.0),
    "watch": (WATCH.replace("0.4", "2.5"), 2.0),
    "hall": (HALL, 5.0),
    "accept": (ACCEPT, 0.6),
}
"""And until when one may join that is still seen."""
JOINING = [
    (command, carrier, round(0.1 + 0.05 * k, 2))
    for command, (_, until) in RUNS.items()
    for carrier in ("bytes", "CAN")
    for k in range(round(until / 0.05))
]


@pytest.mark.parametrize(("command", "carrier", "joins"), sampled("joining", JOINING, 5, campaign="links"))
def test_one_that_joins_a_run_stops_it(command: str, carrier: str, joins: float, capsys) -> None:
    """Also before it is armed, between ARM and START, and before the first setpoint is confirmed."""
    with twins(carrier, "LEFT-1", "RIGHT-2", joins=joins) as devices:
        ran = bench(RUNS[command][0], devices[0], capsys)
        ended = devices[0].link.clock()
    assert ran.code in (1, 2), ran.text
    assert re.search(NAMED, ran.text), ran.text
    assert "reboot" not in ran.text.replace("link, reboots", "")
    assert ended - joins < 2.0
    assert [device.state for device in devices] == [State.IDLE] * 2  # by STOP: neither has tripped
    assert devices[0].seen["STOP"] or not devices[0].seen["ARM"]


REBOOTS = [
    (command, carrier, after)
    for command in ("spin", "accept", "hall")
    for carrier in ("bytes", "CAN")
    for after in (0.0, 0.02, 0.05, 0.11, 0.3, 0.5)
]


@pytest.mark.parametrize(("command", "carrier", "after"), sampled("reboots", REBOOTS, 5, campaign="links"))
def test_a_reboot_is_a_reboot(command: str, carrier: str, after: float, capsys: pytest.CaptureFixture[str]) -> None:
    """So long after START."""
    with serving("full", ["reboots"], carrier, after=after) as device:
        ran = bench(COMMANDS[command], device, capsys)
    assert ran.code == (2 if command == "hall" else 1), ran.text  # 1 is a fault of the Hall sensors
    assert re.search(r"(the drive|node 1) has rebooted", ran.text), ran.text
    assert "two devices" not in ran.text
    assert not device.outputs_on


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
@pytest.mark.parametrize("command", ["spin", "watch", "accept"])
@pytest.mark.parametrize("changing", [False, True])
def test_a_device_whose_hello_has_another_boot_id_is_one_device(
    changing: bool, command: str, carrier: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mistake of the firmware: HELLO says 5, or another one each time; heartbeats say what is so."""
    with serving("full", [], carrier) as device:
        told, count = device.hello_fields, itertools.count(5)
        odd = lambda rx_max: told(rx_max) | {"boot_id": next(count) if changing else 5}  # noqa: E731
        device.hello_fields = odd  # type: ignore[method-assign]
        ran = bench(COMMANDS[command].replace("0.4", "2"), device, capsys)
    assert "two devices" not in ran.text
    assert not device.seen["ARM"]
    assert ran.code == 2
    assert re.search(
        r"boot_id is [0-9a-f]{8} in its HELLO and [0-9a-f]{8} in its heartbeats: fix the firmware", ran.text
    )
    assert "reboot" not in ran.text


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
def test_a_drive_that_boots_again_and_again_is_one_device(
    carrier: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with boot_ids that come back, such as those of a counter of one bit."""
    with serving("full", [], carrier) as device:
        advance, boots = device.advance, [7, 8]

        def booting() -> None:
            if device.seconds > 0.7:
                device.boot()
                device.boot_id = boots[0]
                boots.reverse()
            advance()

        device.advance = booting  # type: ignore[method-assign]
        ran = bench(WATCH.replace("0.4", "4"), device, capsys)
    assert "two devices" not in ran.text
    assert "has rebooted" in ran.text
