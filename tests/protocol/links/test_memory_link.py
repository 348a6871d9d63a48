"""The memory link: virtual and real time, and each fault."""

from __future__ import annotations

import queue
import threading

import pytest

from protocol.errors import LinkClosed, LinkNotFound
from protocol.links.base import MAX_READ
from protocol.links.memory import VirtualClock, memory_pair


def test_a_read_moves_the_virtual_clock_by_its_timeout() -> None:
    clock = VirtualClock(5.0)
    host, device = memory_pair(clock)
    assert host.read(0.25) == b""
    assert clock.now == host.clock() == device.clock() == 5.25
    device.write(b"x")
    assert host.read(0.25) == b"x"
    assert clock.now == 5.25


def test_delay_arrives_when_due_and_not_before() -> None:
    clock = VirtualClock()
    host, device = memory_pair(clock)
    device.faults.delay = 0.1
    device.write(b"late")
    assert host.read(0.0) == b""
    assert host.read(0.05) == b""
    assert host.read(10.0) == b"late"
    assert clock.now == pytest.approx(0.1)


def test_settle_collects() -> None:
    clock = VirtualClock()
    host, device = memory_pair(clock)
    for delay in (0.001, 0.002, 0.5):
        device.faults.delay = delay
        device.write(b"%g " % delay)
    assert host.read(1.0, settle=0.01) == b"0.001 0.002 "


def test_faults_are_of_one_direction_and_repeat_with_the_seed() -> None:
    def spoil(seed: int) -> bytes:
        host, device = memory_pair(VirtualClock(), seed)
        device.faults.drop = 0.1
        device.faults.corrupt = 0.1
        device.write(bytes(1000))
        host.write(b"clean")
        assert device.read(0.0) == b"clean"
        return host.read(0.0)

    first = spoil(1)
    assert first == spoil(1)
    assert first != spoil(2)
    assert 850 < len(first) < 950  # 1000 +- 5 sigma of 9.5 at 10 % lost
    assert 50 < sum(byte != 0 for byte in first) < 140


def test_large_writes_come_in_bounded_reads() -> None:
    host, device = memory_pair(VirtualClock())
    device.write(bytes(MAX_READ + 10))
    assert [len(host.read(0.0)) for _ in range(3)] == [MAX_READ, 10, 0]


def test_unplug_and_plug() -> None:
    host, device = memory_pair(VirtualClock())
    device.write(b"under way")
    host.unplug()
    for end in (host, device):
        with pytest.raises(LinkClosed, match=f"{end.name} is gone"):
            end.read(1.0)
        with pytest.raises(LinkNotFound, match="unplugged"):
            end.reopen()
    host.plug()
    with pytest.raises(LinkClosed, match="is closed"):
        host.write(b"x")
    host.reopen()
    device.reopen()
    device.write(b"back")
    assert host.read(0.0) == b"back"


def test_real_time_wakes_for_the_other_thread() -> None:
    host, device = memory_pair()
    assert host.read(0.001) == b""
    got: queue.SimpleQueue[object] = queue.SimpleQueue()

    def read() -> None:
        try:
            while True:
                got.put(host.read(30.0))
        except LinkClosed as error:
            got.put(error)

    reader = threading.Thread(target=read)
    reader.start()
    device.write(b"hello")
    assert got.get(timeout=10.0) == b"hello"
    device.unplug()
    assert isinstance(got.get(timeout=10.0), LinkClosed)
    reader.join(10.0)
