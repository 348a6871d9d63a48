"""A serial port that is read ahead by a process of its own, over a real pty: order, depth, unplug, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import LinkClosed
from protocol.links import open_link
from protocol.links.rivals import rivals
from protocol.links.serial import SerialLink
from sim.ports.byte_ports import PtyPort

TURN = 0.02  # s, of the client
MUCH = 1e6  # bytes/s
LIMIT = 20.0  # s, on a busy machine
DEEP = 200_000  # bytes: many times what a pty holds


class Stream:
    """Numbers, as bytes that come one after the other; `put` has the port take as much as it does within the limit."""

    def __init__(self, port: PtyPort) -> None:
        self._port, self._data, self.sent = port, np.arange(1 << 20, dtype="<u4").tobytes(), 0
        self.got = bytearray()

    def put(self, n: int, limit: float = LIMIT) -> bool:
        end, until = time.monotonic() + limit, self.sent + n
        while self.sent < until and time.monotonic() < end:
            taken = self._port.write(self._data[self.sent : min(until, self.sent + 4096)])
            self.sent += taken
            if not taken:
                time.sleep(0.001)  # a full pty says nothing when it is no longer
        return self.sent == until

    def take(self, link: SerialLink) -> None:
        """Read until all has come, in order."""
        end = time.monotonic() + LIMIT
        while len(self.got) < self.sent and time.monotonic() < end:
            self.got += link.read(TURN, TURN)
        assert self.got == self._data[: self.sent]


@pytest.fixture
def stream(port: PtyPort, link: SerialLink) -> Stream:
    """A stream whose port is read ahead: what came until then came, too."""
    stream, end = Stream(port), time.monotonic() + LIMIT
    link.expect(MUCH)
    while not (link._ahead is not None and link._ahead.ready()) and time.monotonic() < end:
        assert stream.put(3000)
        stream.take(link)
    assert link._ahead is not None
    return stream


def test_what_a_host_does_not_read_waits(stream: Stream, link: SerialLink) -> None:
    """The port takes many times what it holds while nobody asks for it; then all of it comes, in order."""
    assert stream.put(DEEP)
    stream.take(link)


def test_a_port_that_is_not_read_ahead_takes_no_more_than_it_holds(port: PtyPort, link: SerialLink) -> None:
    stream = Stream(port)
    assert not stream.put(DEEP, limit=0.2)
    stream.take(link)


def test_all_comes_in_order_from_before_it_is_read_ahead_on(port: PtyPort, link: SerialLink) -> None:
    stream = Stream(port)
    link.expect(MUCH)
    writer = threading.Thread(target=lambda: stream.put(DEEP))
    writer.start()
    while writer.is_alive():
        stream.got += link.read(TURN, TURN)
    writer.join()
    stream.take(link)
    assert stream.sent == DEEP
    assert link._ahead is not None


def test_a_port_of_which_little_is_expected_is_not_read_ahead(port: PtyPort, link: SerialLink) -> None:
    link.expect(11_520)
    port.write(bytes(500))
    assert link.read(LIMIT, TURN)
    assert link._ahead is None


def test_a_request_is_written_and_its_reply_comes_at_once(port: PtyPort, stream: Stream, link: SerialLink) -> None:
    link.write(b"request")
    assert port.read() == b"request"
    assert stream.put(10)
    began = time.monotonic()
    assert link.read(LIMIT) == stream._data[stream.sent - 10 : stream.sent]
    assert time.monotonic() - began < LIMIT / 2


def test_unplugged_it_delivers_the_tail_then_names_the_port(port: PtyPort, stream: Stream, link: SerialLink) -> None:
    assert stream.put(5000)
    stream.take(link)
    pid = link._ahead.pid
    port.unplug()
    with pytest.raises(LinkClosed, match="ttyBENCH is gone"):
        link.read(LIMIT, TURN)
    assert not Path("/proc", str(pid)).exists()
    port.plug()
    link.reopen()
    port.write(b"again")
    assert link.read(LIMIT) == b"again"


def test_old_bytes_are_not_delivered_after_reopen(port: PtyPort, stream: Stream, link: SerialLink) -> None:
    assert stream.put(DEEP)
    link.reopen()
    port.write(b"new")
    assert link.read(LIMIT).endswith(b"new")
    assert link.read(0.0) == b""


def test_a_read_waits_as_long_as_it_was_told_to(port: PtyPort, stream: Stream, link: SerialLink) -> None:
    """Just after something has come, too."""
    began = time.monotonic()
    assert link.read(0.3, TURN) == b""
    assert time.monotonic() - began >= 0.3
    writer = threading.Timer(0.1, lambda: port.write(b"late"))
    writer.start()
    assert link.read(LIMIT, TURN) == b"late"


def test_where_its_process_is_killed_the_port_is_read_from_here(stream: Stream, link: SerialLink) -> None:
    os.kill(link._ahead.pid, signal.SIGKILL)
    end = time.monotonic() + LIMIT
    while link._ahead is not None and time.monotonic() < end:
        assert link.read(TURN, TURN) == b""
    for _ in range(3):
        assert stream.put(3000)
        stream.take(link)
    assert link._ahead is None


def test_an_interrupted_read_loses_nothing(stream: Stream, link: SerialLink) -> None:
    assert stream.put(2000)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with pytest.raises(KeyboardInterrupt):
            link.read(60.0, settle=60.0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert stream.put(2000)
    stream.take(link)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells")
def test_it_is_no_rival_of_its_own_link_and_no_second_one_of_others(
    port: PtyPort, stream: Stream, link: SerialLink
) -> None:
    assert link.oddities() == []
    path = port.target.removeprefix("serial:")
    code = f"from protocol.links.rivals import rivals; print(len(rivals({path!r})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT, check=True)
    assert done.stdout == "1\n"
    assert rivals(path, link._ahead.pid) == []


HOST = """
import sys, time
from protocol.links import open_link
link = open_link(sys.argv[1])
link.expect(1e6)
while not link._ahead.ready():
    link.read(0.02, 0.02)
print(link._ahead.pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("streaming", [True, False])
def test_a_host_that_is_killed_leaves_none_behind(port: PtyPort, streaming: bool) -> None:
    """Also where nothing comes of the port any more, by which it could notice."""
    with subprocess.Popen(
        [sys.executable, "-c", HOST, port.target], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as host:
        assert host.stdout is not None
        told: list[str] = []
        waiting = threading.Thread(target=lambda: told.append(host.stdout.readline()))
        waiting.start()
        while waiting.is_alive():
            port.write(bytes(2000))
            waiting.join(0.01)
        host.kill()
        host.wait()
    pid, end = int(told[0]), time.monotonic() + LIMIT
    while Path("/proc", str(pid)).exists() and time.monotonic() < end:
        if streaming:
            port.write(bytes(100))
        time.sleep(0.005)
        with suppress(ChildProcessError, OSError):
            if (
                Path("/proc", str(pid), "stat").read_text().split(") ")[1].startswith("Z")
            ):  # whoever inherits it is slow
                break
    else:
        assert not Path("/proc", str(pid)).exists()
    open_link(port.target).close()  # nobody holds it
