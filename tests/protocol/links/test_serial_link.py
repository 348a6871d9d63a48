"""The serial link over a real pty: lock, noise, unplug and replug, a full line, rates."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import pytest
import serial

from protocol.errors import LinkBusy, LinkClosed, LinkError, LinkNotFound, TargetError
from protocol.links import open_link
from protocol.links.base import MAX_READ, SLICE
from protocol.links.serial import SerialLink
from protocol.links.serial_port import PolledPort, line_rate
from sim.ports.byte_ports import PtyPort


@pytest.fixture(params=["descriptor", "polled"], autouse=True)
def opened_as(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """How this process reads and writes a port: as on Linux and macOS, or by pyserial's calls alone, as on Windows."""
    if request.param == "polled":
        monkeypatch.setattr("protocol.links.serial.OPENED", PolledPort)
    return str(request.param)


def test_read_takes_all_that_has_come(port: PtyPort, link: SerialLink) -> None:
    sent = os.urandom(9000)  # more than one read of the line discipline
    written = port.write(sent)
    assert link.read(2.0, settle=0.001)[:4000] == sent[:4000]
    assert written <= MAX_READ


def test_a_read_ends_in_time_however_much_goes_on_coming(
    port: PtyPort, link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bytes trickle in for a second, never as far apart as more is waited for after a read of all that Linux holds."""
    monkeypatch.setattr("protocol.links.base.REFILL", 0.2)
    writer = threading.Thread(target=lambda: [(port.write(b"x"), time.sleep(0.002)) for _ in range(500)])
    writer.start()
    assert 1 <= len(link.read(2.0, settle=0.02)) < 250
    writer.join()


def test_an_interrupted_read_loses_nothing(port: PtyPort, link: SerialLink) -> None:
    """A signal's exception within a read that collects: what it had taken comes with the next one."""
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        port.write(b"taken before, ")
        signal.setitimer(signal.ITIMER_REAL, 5 * SLICE)
        with pytest.raises(KeyboardInterrupt):
            link.read(2.0, settle=60.0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    port.write(b"and after")
    got = link.read(2.0)
    while len(got) < 23 and (more := link.read(2.0)):
        got += more
    assert got == b"taken before, and after"


def test_bytes_stolen_by_another_reader_are_no_unplug(port: PtyPort, link: SerialLink) -> None:
    port.write(b"abc")
    os.set_blocking(port._slave, False)
    assert os.read(port._slave, 10) == b"abc"
    assert link.read(0.0) == b""


def test_unplug_delivers_the_tail_then_names_the_port(port: PtyPort, link: SerialLink) -> None:
    port.write(b"last words")
    assert link.read(2.0) == b"last words"
    port.unplug()
    with pytest.raises(LinkClosed, match="ttyBENCH is gone"):
        link.read(2.0)
    with pytest.raises(LinkClosed, match="ttyBENCH is closed"):
        link.read(2.0)
    with pytest.raises(LinkClosed, match="ttyBENCH"):
        link.write(b"x")


def test_write_to_an_unplugged_port(port: PtyPort, link: SerialLink) -> None:
    port.unplug()
    with pytest.raises(LinkClosed, match="ttyBENCH is gone"):
        link.write(b"x")


def test_old_bytes_are_not_delivered_after_reopen(port: PtyPort, link: SerialLink) -> None:
    link.close()
    port.write(b"nobody was there")
    link.reopen()
    assert link.read(0.0) == b""


def test_port_held_by_another_process(port: PtyPort) -> None:
    code = (
        "import sys; from protocol.links import open_link; link = open_link(sys.argv[1]);"
        "print('open', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, port.target], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout.readline() == b"open\n"
        with pytest.raises(LinkBusy, match=r"ttyBENCH is held by another program"):
            open_link(port.target)
        holder.communicate(timeout=10)
    open_link(port.target).close()


def test_a_line_that_takes_nothing_fails_within_the_limit(link: SerialLink, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.links.base.WRITE_TIMEOUT", 0.02)
    start = time.monotonic()
    with pytest.raises(LinkError, match=r"took \d+ of 1000000 bytes in 0.02 s"):
        link.write(bytes(1_000_000))
    assert time.monotonic() - start < 5.0


def test_missing_port_lists_the_ones_that_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Info:
        def __init__(self, device: str) -> None:
            self.device = device

    path = tmp_path / "ttyNONE"
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [Info("/dev/ttyS7"), Info("/dev/ttyS9")])
    with pytest.raises(LinkNotFound, match=r"no port .*ttyNONE; ports here: /dev/ttyS7, /dev/ttyS9"):
        open_link(f"serial:{path}")
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    with pytest.raises(LinkNotFound, match="this machine has no serial port"):
        open_link(f"serial:{path}")


def test_a_file_is_not_a_port(tmp_path: Path) -> None:
    plain = tmp_path / "notes.txt"
    plain.write_text("x")
    for path in (plain, tmp_path):
        with pytest.raises(LinkError, match="is not a serial port"):
            open_link(f"serial:{path}")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the rate of a port")
@pytest.mark.parametrize("baud", [300, 115200, 3_000_000, 1_234_567])
def test_rate_reaches_the_port(port: PtyPort, baud: int) -> None:
    link = open_link(f"{port.target}?baud={baud}")
    assert line_rate(port._master) == baud
    link.close()


def test_a_rate_that_the_driver_changes_is_refused(
    port: PtyPort, monkeypatch: pytest.MonkeyPatch, opened_as: str
) -> None:
    if opened_as == "polled":
        pytest.skip("Windows refuses the rate itself")
    monkeypatch.setattr("protocol.links.serial_port.line_rate", lambda fd: 9600)
    with pytest.raises(TargetError, match=r"cannot run at 3000000 baud \(its driver would run at 9600\)"):
        open_link(f"{port.target}?baud=3000000")
    monkeypatch.undo()
    open_link(port.target).close()  # and the port was let go


REFUSED = "could not open port 'COM7': {}"  # pyserial's serialwin32, with the repr of Windows' error
CONFIGURED = "Cannot configure port, something went wrong. Original message: {}"


@pytest.mark.parametrize(
    ("words", "kind", "said"),
    [
        (REFUSED.format("PermissionError(13, 'Access is denied.', None, 5)"), LinkBusy, "held by another program"),
        (REFUSED.format("PermissionError(13, 'Zugriff verweigert', None, 5)"), LinkBusy, "held by another program"),
        (
            REFUSED.format("FileNotFoundError(2, 'The system cannot find the file specified.', None, 2)"),
            LinkNotFound,
            "no port COM7; ports here: COM1",
        ),
        (
            REFUSED.format("OSError(22, 'The semaphore timeout period has expired.', None, 121)"),
            LinkError,
            "cannot open COM7: .*semaphore",
        ),
        (
            CONFIGURED.format("OSError(22, 'The parameter is incorrect.', None, 87)"),
            TargetError,
            "COM7 cannot run at 921600 baud: choose another rate",
        ),
    ],
)
def test_what_windows_says_of_a_port_is_told_as_elsewhere(
    words: str, kind: type[Exception], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object, **keywords: object) -> None:
        raise serial.SerialException(words)

    monkeypatch.setattr("serial.Serial", refuse)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [types.SimpleNamespace(device="COM1")])
    with pytest.raises(kind, match=said):
        open_link("serial:COM7?baud=921600")
