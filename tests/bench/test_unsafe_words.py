"""Where outputs may still be on that is said once, with what was seen, and why there was a STOP."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from against import ACCEPT, HALL, SPIN, bench

from tests.choice import sampled
from tests.devices import serving
from tests.devices.device import Device
from tests.devices.spec import State

COMMANDS = {"spin": SPIN.replace("0.8", "2.5"), "hall": HALL, "accept": ACCEPT}
WAYS = {
    "stop-ignored": r"answered STOP with IDLE, but its heartbeat says RUNNING, outputs on",
    "stop-outputs-stay": r"answered STOP with IDLE, but its heartbeat says IDLE, outputs on",
    "stop-unanswered watchdog-dead": r"did not answer STOP",
    "heartbeats-stop": r"no heartbeat came for \d+\.\d s, and the last one said RUNNING, outputs on",
    "heartbeats-stop stop-unanswered watchdog-dead": r"did not answer STOP",
}
CASES = [(way, command, carrier) for way in WAYS for command in COMMANDS for carrier in ("bytes", "CAN")]


def check(text: str, seen: str) -> None:
    """One sentence in each line, the result and the note of a run apart."""
    for line in text.splitlines():
        assert line.count("STILL BE ON") <= 1, line
        if "STILL BE ON: cut" in line:
            assert re.search(rf"STILL BE ON: cut the power\. node 1 on \S+ {seen}", line), line
            assert "outputs off" not in line


@pytest.mark.slow
@pytest.mark.parametrize(("way", "command", "carrier"), sampled("unsafe", CASES, 8, campaign="links"))
def test_it_is_said_once_with_what_was_seen(
    way: str, command: str, carrier: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving("full", way.split(), carrier, after=0.3) as device:
        ran = bench(COMMANDS[command], device, capsys)
    assert ran.code == 5, ran.text
    check(ran.out + ran.err, rf"(answered STOP with IDLE, but )?{WAYS[way]}")
    if way == "heartbeats-stop" and command == "spin":
        assert re.search(r"\(the drive: no heartbeat for \d\.\d s: its state is unknown\)", ran.text)


def silent_once(state: State) -> Callable[[Device], None]:
    """No heartbeat from `state` on, and no STOP is obeyed."""

    def make(device: Device) -> None:
        beat, seen = device.heartbeat, []

        def heartbeat() -> None:
            seen.extend([1] * (device.state == state))
            if not seen:
                beat()

        def answer(request: Any, *rest: Any) -> None:
            if not seen:
                as_usual(request, *rest)

        as_usual = device.answer
        device.heartbeat, device.answer = heartbeat, answer  # type: ignore[method-assign]

    return make


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
@pytest.mark.parametrize("command", COMMANDS)
def test_who_falls_silent_when_it_is_armed_is_stopped_for_that(
    command: str, carrier: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving("full", [], carrier) as device:
        silent_once(State.ARMED)(device)
        ran = bench(COMMANDS[command], device, capsys)
        assert not device.seen["START"]
    assert ran.code == 5, ran.text
    check(ran.out + ran.err, r"did not answer STOP(: nothing came of it for \d+\.\d\d s)? \(3 tries\)")
    if command != "hall":
        assert "(refusing to energise node 1: it answered ARM with ARMED, but no heartbeat came in the 0." in ran.text


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
@pytest.mark.parametrize("command", COMMANDS)
def test_without_heartbeats_nothing_is_armed(command: str, carrier: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Also where they cease when it has been found to be at rest."""
    with serving("full", [], carrier) as device:
        beat = device.heartbeat
        device.heartbeat = lambda: beat() if not device.seen["BLOB_READ"] else None  # type: ignore[method-assign]
        ran = bench(COMMANDS[command], device, capsys)
    assert ran.code == 2, ran.text
    assert re.search(r"sends no heartbeat( \(one every 100 ms is due\).*; nothing was armed)?", ran.text), ran.text
    assert not device.seen["ARM"]
    assert "STILL BE ON" not in ran.text
