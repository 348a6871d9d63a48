"""Who else has a serial port open, as Linux tells it; and what an slcan adapter sends that is none."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from bench.device.client import Client
from protocol.errors import LinkBusy, NoReply
from protocol.links import open_link
from protocol.links.rivals import rivals
from sim.ports.byte_ports import PtyPort

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells")


@pytest.fixture
def raw() -> Iterator[tuple[int, str]]:
    """An adapter that is only a pty: the test writes its lines."""
    master, slave = os.openpty()
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


READER = """
import os, sys, time
fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
print("open", flush=True)
time.sleep(60)
"""


@pytest.fixture
def reader(port: PtyPort) -> Iterator[subprocess.Popen[str]]:
    """A program that has the port open and locks nothing."""
    path = port.target.removeprefix("serial:")
    with subprocess.Popen([sys.executable, "-c", READER, path], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        yield process
        process.kill()


def test_another_program_is_named(port: PtyPort, reader: subprocess.Popen[str]) -> None:
    (named,) = rivals(port.target.removeprefix("serial:"))
    comm = Path(f"/proc/{reader.pid}/comm").read_text().strip()
    assert named == f"{comm} (pid {reader.pid})"


def test_it_is_said_where_nothing_is_heard(
    port: PtyPort, reader: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("protocol.links.serial.BOOT", 0.05)
    with closing(open_link(port.target)) as link, pytest.raises(NoReply) as failure:
        Client(link).connect()
    assert f"(pid {reader.pid}) has {link.target.port} open, too, and may take what comes: close it" in str(
        failure.value
    )  # type: ignore[attr-defined]


def test_nobody_is_named_where_nobody_is(port: PtyPort, monkeypatch: pytest.MonkeyPatch) -> None:
    assert rivals(port.target.removeprefix("serial:")) == []
    assert rivals("/dev/ttyNOT-THERE") == []
    monkeypatch.setattr("protocol.links.rivals.PROC", Path("/not/there"))
    assert rivals(port.target.removeprefix("serial:")) == []


def test_the_other_end_of_a_pty_is_no_rival(tmp_path: Path) -> None:
    """`bench sim --pty` has its own port open, to keep it alive."""
    code = (
        "import sys; from pathlib import Path; from sim.ports.byte_ports import PtyPort;"
        "port = PtyPort(Path(sys.argv[1])); print('open', flush=True); sys.stdin.read()"
    )
    path = tmp_path / "ttySIM"
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        assert rivals(str(path)) == []
        process.communicate(timeout=10)


def test_who_holds_the_lock_is_named(port: PtyPort) -> None:
    code = (
        "import sys; from protocol.links import open_link; link = open_link(sys.argv[1]);"
        "print('open', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, port.target], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "open\n"
        with pytest.raises(LinkBusy, match=rf"is held by another program \(\S+ \(pid {holder.pid}\)\): close it"):
            open_link(port.target)
        holder.communicate(timeout=10)


def test_an_adapter_that_sends_other_text_is_told_so(raw: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.canmap.host.CanWire.patience", 0.3)
    master, path = raw
    with ExitStack() as stack:
        link = stack.enter_context(closing(open_link(f"can:slcan/{path}")))
        writer = threading.Thread(target=os.write, args=(master, b"Ready \x1b[2J\r\n" + b"= 17\r\n" * 40))
        writer.start()
        writer.join()
        with pytest.raises(NoReply) as failure:
            Client(link).connect()
    assert "the adapter sent text that is no slcan (41 lines), such as 'Ready \\x1b[2J'" in str(failure.value)
