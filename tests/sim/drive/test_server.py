"""The real-time server: its schedule, and a whole conversation over a real pty and loopback TCP.

Here the server is stepped by hand on a clock of the test's own, so that nothing waits; the processes are in
`test_server_process.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from small_host import SmallHost

from protocol.device.session import DeviceLink
from protocol.device.tx import TxQueue
from protocol.links import open_link
from protocol.messages import Command, DriveState, Fault, SetpointMode
from sim.config.params import ConfigError, load_params
from sim.ports.byte_ports import Port, PtyPort, TcpPort
from sim.ports.device import SimulatedDevice
from sim.ports.networks import ByteNetwork
from sim.ports.server import (
    LATE,
    LATE_PERIOD,
    MAX_BEHIND,
    STEP,
    Schedule,
    ServeOptions,
    Server,
    parse_override,
    serve,
)

PARAMS = load_params()


class Bench:
    """A server on a port, and a clock that moves as `serve` looks after it."""

    def __init__(self, port: Port, baud: int | None = None, **arguments: object) -> None:
        self.now = 100.0
        self.port = port
        self.device = SimulatedDevice(PARAMS, **arguments)  # type: ignore[arg-type]
        self.told: list[str] = []
        self.server = Server(self.device, port, self.now, baud, self.told.append)
        self.hosts: list[SmallHost] = []

    def step(self) -> None:
        self.now += 0.001 if self.server.full else STEP  # when the host has made room
        self.server.step(self.now)

    def host(self, target: str | None = None) -> SmallHost:
        host = SmallHost(open_link(target or self.port.target), self.step, wait=0.001)
        self.hosts.append(host)
        self.step()
        return host

    def run(self, host: SmallHost, seconds: float, feed: bool = True) -> None:
        end = self.now + seconds
        while self.now < end:
            if feed:
                host.alive()
            host.poll()

    def close(self) -> None:
        for host in self.hosts:
            host.link.close()
        self.port.unplug()


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def build(kind: str, baud: int | None = None, **arguments: object) -> Bench:
        port = TcpPort("127.0.0.1", 0) if kind == "tcp" else PtyPort(tmp_path / "ttySIM", baud)
        bench = Bench(port, baud, **arguments)
        made.append(bench)
        return bench

    yield build
    for bench in made:
        bench.close()


def test_schedule_keeps_the_rate_however_it_is_asked() -> None:
    rng = np.random.default_rng(1)
    schedule, now, done = Schedule(16000, 50.0), 50.0, 0
    for _ in range(2000):
        now += rng.uniform(0.0, 0.02)
        done += schedule.due(now)
        assert 0.0 <= (now - 50.0) * 16000 - done < 1.0
    assert schedule.late == 0


def test_schedule_skips_what_it_cannot_catch_up() -> None:
    schedule = Schedule(16000, 0.0)
    assert schedule.due(0.005) == 80
    n = schedule.due(10.0)  # suspended
    assert n == pytest.approx(MAX_BEHIND * 16000, abs=1)
    assert schedule.late == 1
    assert schedule.skipped == pytest.approx(9.995 - MAX_BEHIND)
    assert schedule.due(10.005) == pytest.approx(80, abs=1)
    assert schedule.late == 1


def test_a_drive_that_was_kept_from_running_says_so_now_and_then(make: Callable[..., Bench]) -> None:
    bench = make("tcp")
    host = bench.host()
    host.connect()

    def stand_still(seconds: float) -> None:
        bench.now += seconds
        bench.run(host, 0.1)

    stand_still(LATE - 2 * STEP)
    assert bench.told == []
    stand_still(0.08)
    (line,) = bench.told
    behind = int(re.fullmatch(r"the simulated drive stood still for (\d+) ms: this machine is too busy", line)[1])
    assert 80 <= behind <= 80 + 2 * STEP * 1000
    assert host.kept.notes == [f"WARN: {line}"]
    stand_still(0.08)
    assert len(bench.told) == 1  # it would say nothing else any more
    stand_still(LATE_PERIOD)
    assert len(bench.told) == 2
    assert bench.server.schedule.late == 1  # the others were caught up


def test_schedule_of_a_clock_that_steps_back_waits() -> None:
    schedule = Schedule(16000, 0.0)
    schedule.due(0.01)
    assert schedule.due(0.0) == 0
    assert schedule.due(0.02) == 160


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_a_host_that_vanishes_ends_in_the_watchdog_and_the_next_one_finds_out(
    make: Callable[..., Bench], kind: str
) -> None:
    lines: list[str] = []
    bench = make(kind, notice=lines.append)
    host = bench.host()
    host.stream()
    host.start()
    host.setpoint(SetpointMode.SPEED, 50.0)
    bench.run(host, 0.2)
    assert bench.device.bench.outputs_on
    host.link.close()  # as a kill -9 does
    start = bench.now
    while bench.device.bench.outputs_on:
        bench.step()
    assert bench.now - start <= 0.2 + 2 * STEP
    assert "ms after the last ALIVE: watchdog (node 1, simulated drive)" in lines[-1]
    for _ in range(200):  # nobody reads: nothing hangs
        bench.step()
    host = bench.host()
    assert host.connect().state is DriveState.FAULT
    assert host.command(Command.FAULT_CLEAR, Fault.WATCHDOG) is DriveState.IDLE
    host.stream()
    bench.run(host, 0.1)
    assert host.losses(1).samples.lost_by_index == 0


def test_nobody_reads_a_pty_costs_counted_frames_only(make: Callable[..., Bench]) -> None:
    bench = make("pty", network=ByteNetwork(DeviceLink(TxQueue(50_000))))
    host = bench.host()
    host.stream()
    end = bench.now + 1.0
    while bench.now < end:
        bench.step()
    assert bench.device.frames_dropped > 0
    bench.run(host, 0.3)
    loss = host.losses(1).samples
    assert loss.lost_by_seq == host.heartbeats[1].tx_dropped == bench.device.frames_dropped
    index = host.samples().index
    assert index[-1] - index[0] + 1 == loss.samples + loss.lost_by_index
    assert host.session.counters.framing.bad == 0


def test_a_uart_is_paced(make: Callable[..., Bench]) -> None:
    bench = make("pty", baud=115200, network=ByteNetwork(DeviceLink(TxQueue(capacity=11520.0))))
    start = bench.now
    host = bench.host()
    host.stream(["theta_true"], edges=False, decimation=16)
    assert 3000 < host.bytes_in <= 11_520 * (bench.now - start + 0.02)
    bench.run(host, 1.0, feed=False)
    assert host.losses(1).samples.lost_by_index == 0


@pytest.mark.parametrize(
    ("text", "pair"),
    [
        ("motor.R_s=0.2", ("motor.R_s", 0.2)),
        ("firmware.observer = 1", ("firmware.observer", 1)),
        ("hall.delta_deg=[0, 0, 0, 0, 0, 0.5]", ("hall.delta_deg", [0, 0, 0, 0, 0, 0.5])),
    ],
)
def test_overrides(text: str, pair: tuple[str, object]) -> None:
    assert parse_override(text) == pair


@pytest.mark.parametrize("text", ["motor.R_s", "=1", "motor.R_s=", "motor.R_s=fast", "motor.R_s=1\nx=2"])
def test_bad_overrides(text: str) -> None:
    with pytest.raises(ConfigError):
        load_params(None, dict([parse_override(text)]))


def test_a_drive_that_cannot_be_leaves_no_link(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="R_s must be > 0 ohm, got -1"):
        serve(ServeOptions(link=tmp_path / "x", overrides={"motor.R_s": -1}), print)
    assert list(tmp_path.iterdir()) == []
