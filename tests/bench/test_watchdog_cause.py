"""A watchdog that ran out, and why: a pause of this host, a link that carried nothing, or a watchdog that is too short.

In virtual time, on the test device; the truth is what was done to its link.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import pytest
from against import ACCEPT, HALL, SPIN, bench
from virtual_run import run

from bench.device.node import Node
from protocol.errors import LinkClosed
from tests.choice import sampled
from tests.devices import FULL, serving
from tests.devices.device import Device
from tests.devices.spec import Fault, State

COMMANDS = {"spin": SPIN.replace("0.8", "1.5"), "hall": HALL, "accept": ACCEPT}
QUICK = replace(
    FULL, parameters=tuple(replace(row, value=0.2) if row.name == "watchdog" else row for row in FULL.parameters)
)
SEEN = 0.06  # s that what this host says of a time may be beside it: turns of its loop


class Trouble:
    """What is done to the link of a device, `seconds` long, once it is in `state` for `after` s."""

    def __init__(self, device: Device, state: State, seconds: float, after: float) -> None:
        self.device, self.link, self.state, self.seconds, self.after = device, device.link, state, seconds, after
        self.since: float | None = None
        self.began: float | None = None
        self._read, self._write = self.link.read, self.link.write
        self.link.read, self.link.write = self.read, self.write

    @property
    def now(self) -> bool:
        at = self.link.clock()
        if self.since is None and self.device.state == self.state:
            self.since = at
        if self.began is None and self.since is not None and at >= self.since + self.after:
            self.began = at
        return self.began is not None and at < self.began + self.seconds

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        return self._read(timeout, settle)

    def write(self, data: bytes) -> None:
        self._write(data)


class Paused(Trouble):
    """This program stands still."""

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        if self.now:
            self.link.idle(self.seconds)
        return self._read(timeout, settle)


class Deaf(Trouble):
    """What this host sends is lost."""

    def write(self, data: bytes) -> None:
        if not self.now:
            self._write(data)


class Dead(Deaf):
    """What the device sends is lost, too."""

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        data = self._read(timeout, settle)
        return b"" if self.now else data


class Gone(Trouble):
    """The link itself is lost, and comes back."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.link.reopen = self.reopen

    def require(self) -> None:
        if self.now:
            raise LinkClosed("it is gone")

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        self.require()
        return self._read(timeout, settle)

    def write(self, data: bytes) -> None:
        self.require()
        self._write(data)

    def reopen(self) -> None:
        self.link.idle(0.01)
        self.link.port.to_host.clear()
        self.require()


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
@pytest.mark.parametrize("seconds", [0.3, 0.7, 3.0])
def test_an_outage_is_the_cause(seconds: float, carrier: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.device.client.REOPEN_PERIOD", 0.0)
    with serving(QUICK, [], carrier) as device:
        Gone(device, State.RUNNING, seconds, 0.2)
        ended = run(device.link, yes=True, duration=5.0)
        assert not device.outputs_on
    said = re.search(r"WATCHDOG: this host sent no ALIVE .*, because \S+ was gone for (\d\.\d\d) s", ended.words)
    assert said and abs(float(said[1]) - seconds) < SEEN, ended.words  # noqa: PT018


KINDS: dict[str, tuple[type[Trouble], str]] = {
    "paused": (Paused, r"this host sent no ALIVE for (\d\.\d\d) s \(it was starved of CPU or stopped"),
    "dead": (Dead, r"(?:drive was silent|nothing came of it) for (\d\.\d\d) s: the link carried nothing"),
    "deaf": (Deaf, r"this host sent an ALIVE at least every 0\.\d\d s: the link lost them or carried them late"),
}
MOMENTS = {"ARMED": (State.ARMED, 0.0), "RUNNING": (State.RUNNING, 0.3)}
CASES = list(product(KINDS, MOMENTS, COMMANDS, ("bytes", "CAN"), (0.5, 0.75, 2.0)))


@pytest.mark.parametrize(
    ("kind", "moment", "command", "carrier", "seconds"), sampled("watchdog", CASES, 14, campaign="links")
)
def test_whatever_kept_the_watchdog_unfed_is_named(
    kind: str, moment: str, command: str, carrier: str, seconds: float, capsys: pytest.CaptureFixture[str]
) -> None:
    trouble, words = KINDS[kind]
    with serving(QUICK, [], carrier) as device:
        trips: list[Fault] = []
        trip = device.trip
        device.trip = lambda fault: (trips.append(fault), trip(fault))  # type: ignore[method-assign]
        trouble(device, *MOMENTS[moment][:1], seconds, MOMENTS[moment][1])
        ran = bench(COMMANDS[command], device, capsys)
        assert not device.outputs_on
    assert trips == [Fault.WATCHDOG]
    text = ran.text.replace("- ", "")
    if "did not answer" in text and "tripped" not in text:  # the request was lost with all else
        named = re.search(r"did not answer (\w+ in 3 tries|STOP): (nothing came of it|it is heard, and did not)", text)
    else:
        named = re.search(r"tripped:? WATCHDOG", text) and re.search(words, text)
        if named and kind == "paused":
            assert abs(float(named[1]) - seconds) < SEEN, text
    assert named, text
    assert "WRONG_STATE" not in text
    assert ran.code in ((0, 1, 2) if command == "hall" else (1, 2))


@pytest.mark.slow
@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
@pytest.mark.parametrize("seconds", [0.25, 0.8, 4.9])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_trip_between_arm_and_start_is_named_with_its_cause(
    command: str, seconds: float, carrier: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    start, pauses = Node.start, [seconds]

    def late(node: Node) -> None:
        node.client.link.idle(pauses.pop() if pauses else 0.0)  # type: ignore[attr-defined]
        start(node)

    monkeypatch.setattr(Node, "start", late)
    with serving(QUICK, [], carrier) as device:
        ran = bench(COMMANDS[command], device, capsys)
        assert not device.outputs_on
    assert "WRONG_STATE" not in ran.text
    said = re.search(r"no ALIVE for (\d\.\d\d) s \(it was starved of CPU or stopped", ran.text)
    assert said and abs(float(said[1]) - seconds) < SEEN, ran.text  # noqa: PT018


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
@pytest.mark.parametrize("watchdog", [0.01, 0.03])
def test_a_watchdog_that_is_shorter_than_any_host_feeds_it_is_the_cause(watchdog: float, carrier: str) -> None:
    """Told, by the parameter `watchdog`, or not: then that it may be shorter than it tells is all that is known."""
    told = tuple(replace(r, value=watchdog, lo=0.0) if r.name == "watchdog" else r for r in FULL.parameters)
    with serving(replace(FULL, parameters=told), [], carrier) as device:
        ended = run(device.link, yes=True)
        assert not device.outputs_on
    assert re.search(
        rf"WATCHDOG: this host sent no ALIVE for 0\.\d\d s, and its watchdog waits {watchdog} s only", ended.words
    )
    untold = tuple(row for row in FULL.parameters if row.name != "watchdog")
    with serving(replace(FULL, parameters=untold), [], carrier, watchdog=watchdog) as device:
        ended = run(device.link, yes=True)
        assert not device.outputs_on
    assert re.search(r"WATCHDOG: .* or the drive's watchdog is shorter than the 0\.2 s that it tells", ended.words)


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
def test_a_fault_that_is_no_watchdog_has_no_such_cause(carrier: str) -> None:
    def overspeed(device: Device, boot: Callable[[], None] | None = None) -> None:
        if device.state == State.RUNNING:
            device.trip(Fault.OVERSPEED)

    with serving(QUICK, [], carrier) as device:
        device.moment = lambda: overspeed(device)  # type: ignore[method-assign]
        ended = run(device.link, yes=True)
    assert ended.words.endswith("tripped: OVERSPEED")
