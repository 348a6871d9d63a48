"""A device whose name, firmware, channels, parameters and log lines are hostile: everywhere its text is only text."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from html import escape
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import pytest
from shared import Terminal
from virtual_run import WatchedLink, reached_by, simulated

from bench.cli import main
from bench.record.reader import Run
from protocol.descriptor import Descriptor
from protocol.messages import Feature, Log
from sim.ports.device import SimulatedDevice

NAME = "\x1b]0;pwn\x07[red]x"
FIRMWARE = "\u202e\x9b2J|`<b>"
SERIAL = "\x1b[2J|`<u>\u202e"
SERIAL_SHOWN = r"\x1b[2J|`<u>\u202e"
BUILD = "\x9d0;pwn\x9c\r\n[red]"
BUILD_SHOWN = r"\x9d0;pwn\x9c\r\n[red]"
CHANNEL = "\x1b[2J|`<i>[red]"
CHANNEL_SHOWN = r"\x1b[2J|`<i>[red]"
PARAMETER = "\x1b[35;5mp\r"
LOG = "all is well\r\x1b[7A\x1b[2Kerror: \u2066none\x00\x9d0;pwn\x9c <script>"
RAW = ("\x1b]", "\x07", "\x1b[2J", "\x1b[35;5m", "\x1b[7A", "\u202e", "\u2066", "\x9b", "\x9c", "\x9d", "\x00")
"""What must never reach a terminal or a file for people; nothing of it is rich's own."""


def hostile(simulates: bool = True) -> SimulatedDevice:
    """A simulated drive that calls itself and some of its things so, and says `LOG` in each heartbeat's time."""
    device = simulated()
    session = device.drive
    features = session.identity.features
    session.identity = replace(
        session.identity, name=NAME, firmware=FIRMWARE, serial=SERIAL, build=BUILD,
        features=features if simulates else features & ~Feature.SIMULATED,
    )  # fmt: skip
    told = session.descriptor
    session.descriptor = Descriptor(
        tuple(replace(c, name=CHANNEL) if c.name == "theta_sc" else c for c in told.channels),
        tuple(replace(p, name=PARAMETER) if p.name == "k_i_vt" else p for p in told.parameters),
    )
    session._blobs._fixed[0] = session.descriptor.pack()
    return device


@pytest.fixture
def on_terminal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., tuple[int, str]]:
    """Run `bench ARGUMENTS…` on a terminal; whatever target it opens is `device`, which logs at every 50th call."""
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.chdir(tmp_path)

    def run(device: SimulatedDevice, *arguments: str, reply: str = "") -> tuple[int, str]:
        def link(target: str) -> WatchedLink:
            send = device.drive._send  # log() would have no control characters
            return WatchedLink(device, lambda number: None if number % 50 else send(Log(3, LOG)))

        code, typed, shown = 0, Terminal(reply), Terminal()
        with (
            reached_by(link("")),
            patch("bench.rig.connection.open_link", link),
            patch("protocol.links.open_link", link),
            patch.multiple(sys, __stdin__=typed, stdin=typed, stdout=shown, stderr=shown),
        ):
            try:
                main(list(arguments))
            except SystemExit as ended:
                code = ended.code if isinstance(ended.code, int) else 0
        return code, shown.getvalue()

    return run


def harmless(text: str) -> bool:
    return not any(raw in text for raw in RAW)


OWN_TEST = """
from bench.accept import energises, limit
@limit("n_p", lo=1)
@energises(rpm=100, current=4)
def test_it(drive, record, measure):
    record.wait(0.1)
    measure("n_p", drive.n_p, record(0.1))
"""


def test_info_and_devices(on_terminal: Callable[..., tuple[int, str]]) -> None:
    device = hostile()
    code, text = on_terminal(device, "info", "serial:x")
    assert code == 0
    assert harmless(text)
    for shown in (
        r"\x1b]0;pwn\x07[red]x", r"\u202e\x9b2J|`<b>", SERIAL_SHOWN, BUILD_SHOWN, CHANNEL_SHOWN, r"\x1b[35;5mp\r"
    ):  # fmt: skip
        assert shown in text
    code, text = on_terminal(device, "devices", "serial:x")
    assert code == 0
    assert harmless(text)
    for shown in (r"\x1b]0;pwn\x07[red]x", SERIAL_SHOWN, BUILD_SHOWN):
        assert shown in text


def test_a_usb_device_that_names_itself_so(on_terminal: Callable[..., tuple[int, str]], monkeypatch) -> None:
    class Port(SimpleNamespace):
        def __lt__(self, other: object) -> bool:
            return False

    port = Port(device="/dev/ttyACM0", description=NAME, manufacturer=FIRMWARE, serial_number=CHANNEL, vid=1, pid=2)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [port])
    monkeypatch.setattr("can.detect_available_configs", lambda *_, **__: [])
    code, text = on_terminal(hostile(), "devices")
    assert code == 0
    assert harmless(text)
    assert r"\x1b]0;pwn\x07[red]x" in text


def test_live_and_what_it_records(on_terminal: Callable[..., tuple[int, str]]) -> None:
    code, text = on_terminal(
        hostile(), "live", "serial:x", "--duration", "1", "--viewer", "none", "--save", "run.run",
        "--channels", f"+{CHANNEL_SHOWN}",
    )  # fmt: skip
    assert code == 0
    assert harmless(text)
    assert r"\x1b]0;pwn\x07[red]x \u202e\x9b2J|`<b> on serial:x" in text
    assert r"all is well\r\x1b[7A\x1b[2Kerror: \u2066none\x00\x9d0;pwn\x9c <script>" in text
    run = Run("run.run")
    assert (run.info.identity["serial"], run.info.identity["build"]) == (SERIAL_SHOWN, BUILD_SHOWN)
    assert CHANNEL_SHOWN in {channel.name for channel in run.info.channels}
    assert len(run.samples.physical(CHANNEL_SHOWN)) == len(run.samples) > 0
    assert r"\x1b[35;5mp\r" in run.info.parameters
    assert harmless("".join(note.text for note in run.notes))


@pytest.mark.parametrize("arguments", [
    ("live", "serial:x", "--speed", "100", "--viewer", "none"),
    ("hall", "check", "serial:x"),
    ("accept", "serial:x", "--tests", "own_question.py"),
])  # fmt: skip
def test_the_question_whether_the_shaft_is_clear(on_terminal, arguments) -> None:
    Path("own_question.py").write_text(OWN_TEST)
    code, text = on_terminal(hostile(simulates=False), *arguments, reply="n\n")
    assert code == 2
    assert harmless(text)
    assert re.search(r"Spin \\x1b\]0;pwn\\x07\[red\]x \(boot [0-9a-f]{8}\) on serial:x: .* Is the shaft clear\?", text)


def test_the_report_of_accept(on_terminal: Callable[..., tuple[int, str]]) -> None:
    Path("own_it.py").write_text(OWN_TEST)
    code, text = on_terminal(hostile(), "accept", "serial:x", "--tests", "own_it.py", "--report", "out")
    assert code == 0, text
    assert harmless(text)
    page = Path("out/report.html").read_text()
    assert harmless(page)
    assert r"\x1b]0;pwn\x07[red]x" in page
    assert "|`&lt;b&gt;" in page
    assert escape(SERIAL_SHOWN) in page
    assert BUILD_SHOWN in page
    for tag in ("<b>", "<u>", "<i>[red]", "<script"):
        assert tag not in page
    assert sorted(str(path) for path in Path("out").rglob("*.run")) == ["out/recordings/it.run"]
    assert harmless(Run("out/recordings/it.run").summary)
