"""The question on a real terminal: a drive that does not say that it is simulated, behind a pty, and `bench`."""

from __future__ import annotations

import fcntl
import math
import os
import pty
import re
import select
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest
from processes import ENVIRONMENT, LIMIT
from virtual_bus import in_real_time
from virtual_run import physical

from protocol.messages import DriveState
from sim.ports.byte_ports import PtyPort
from sim.ports.device import SimulatedDevice
from tests.choice import sampled

pytestmark = pytest.mark.slow


class PhysicalDrive:
    """A thread that runs such a drive in real time behind a pty, and keeps the states that it was in."""

    def __init__(self) -> None:
        self.device: SimulatedDevice = physical()
        for app in (session.app for session in self.device.sessions):
            app.set_param("watchdog", 1.0)
        self.port = PtyPort()
        self.states: set[DriveState] = set()
        with ExitStack() as stack:
            stack.callback(self.port.unplug)
            stack.enter_context(in_real_time(self.device, self.port, lambda: self.states.add(self.device.drive.state)))
            self.close = stack.pop_all().close


@pytest.fixture
def drive() -> Iterator[PhysicalDrive]:
    with closing(PhysicalDrive()) as drive:
        yield drive


def on_terminal(
    arguments: list[str], prompt: bytes, reply: bytes, after: float = 0.0, again: float = LIMIT
) -> tuple[int, str]:
    """Run `bench ARGUMENTS…` on a terminal; `reply` is typed `after` s from each time that it shows `prompt`.

    Where nothing comes of that within `again` s, it is typed again. Returns its exit code and all that it wrote.
    """
    seen, due = 0, math.inf

    def typed(text: bytes) -> bytes:
        nonlocal seen, due
        if text.count(prompt) > seen:
            seen, due = text.count(prompt), time.monotonic() + after
        if time.monotonic() < due:
            return b""
        due = time.monotonic() + again
        return reply

    return _conversation(arguments, typed)


def dialogue(arguments: list[str], exchanges: list[tuple[bytes, bytes]]) -> tuple[int, str]:
    """Run `bench ARGUMENTS…` on a terminal; each reply is typed once its prompt, a pattern, is shown after the last.

    Returns its exit code and all that it wrote.
    """
    left, read = list(exchanges), 0

    def typed(text: bytes) -> bytes:
        nonlocal read
        if not left or not (shown := re.compile(left[0][0]).search(text, read)):
            return b""
        read = shown.end()
        return left.pop(0)[1]

    code, text = _conversation(arguments, typed)
    assert not left, (left[0], text)
    return code, text


def _conversation(arguments: list[str], typed: Callable[[bytes], bytes]) -> tuple[int, str]:
    """Run `bench ARGUMENTS…` on a terminal, at which is typed what `typed` gives for all that was written so far."""
    controller, terminal = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "bench", *arguments],
        stdin=terminal, stdout=terminal, stderr=terminal, env=ENVIRONMENT | {"TERM": "xterm", "COLUMNS": "200"},
        start_new_session=True, preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(terminal)
    text = b""
    end = time.monotonic() + LIMIT
    try:
        while time.monotonic() < end:
            if keys := typed(text):
                os.write(controller, keys)
            if not select.select([controller], [], [], 0.05)[0]:
                continue
            try:
                data = os.read(controller, 4096)
            except OSError:  # the other end has gone
                break
            text += data
        return process.wait(LIMIT), text.decode()
    finally:
        process.kill()
        process.wait()
        os.close(controller)


def answer(drive: PhysicalDrive, reply: bytes) -> tuple[int, str]:
    """Run `bench live` on a terminal and answer its question."""
    options = ["--speed", "-300", "--duration", "0.5", "--viewer", "none"]
    return on_terminal(["live", drive.port.target, *options], b"[y/N]", reply)


@pytest.mark.parametrize(
    ("reply", "code"), sampled("refusal", [(b"n\n", 2), (b"\n", 2), (b"\x03", 130)], 1, campaign="terminal")
)
def test_anything_but_yes_leaves_the_drive_alone(drive: PhysicalDrive, reply: bytes, code: int) -> None:
    ended, text = answer(drive, reply)
    assert re.search(r"Spin simulated drive \(boot [0-9a-f]{8}\) on serial:\S+: up to 300 r/min, .*up to 8 A\. "
                     r"Is the shaft clear\? \[y/N\]", text)  # fmt: skip
    assert ended == code
    assert drive.states <= {DriveState.BOOT, DriveState.IDLE}
    assert "Traceback" not in text


def test_yes_spins_it(drive: PhysicalDrive) -> None:
    ended, text = answer(drive, b"y\n")
    assert ended == 0, text
    assert DriveState.RUNNING in drive.states
    assert drive.device.drive.state == DriveState.IDLE
    assert not drive.device.drive.app.outputs_on


@pytest.mark.long("a commissioning up to the resistance")
def test_an_ammeter_is_read_while_the_current_is_held_and_typed_in_after_it() -> None:
    arguments = ["commission", "sim", "--step", "r", "--ammeter", "b:0.2%"]
    asked = rb"read the ammeter in phase b, about 4 A, then press Enter: "
    code, text = dialogue(arguments, [(asked, b"\n"), (rb"ammeter in phase b, A: ", b"3.9\n")])
    assert code == 0, text
    assert re.search(r"the ammeter reads 3.9 A, the drive (3.9|4)\S* A, \+2.\d+ %: more than is usual", text), text
