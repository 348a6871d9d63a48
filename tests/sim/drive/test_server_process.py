"""`python -m sim` as a process: its first line, its signals, its end, and the death of its host."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from small_host import SmallHost

from protocol.errors import LinkClosed, LinkNotFound
from protocol.links import open_link
from protocol.messages import DriveState, SetpointMode, TimeSync

LIMIT = 60.0  # s, for whatever is awaited; compiling is the longest


class Process:
    """A simulator process whose lines are read with a limit."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sim", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self._rest = b""

    def line(self, pattern: str) -> str:
        """The next line that holds the pattern."""
        assert self.process.stdout is not None
        fd = self.process.stdout.fileno()
        end = time.monotonic() + LIMIT
        while True:
            line, newline, rest = self._rest.partition(b"\n")
            if newline:
                self._rest = rest
                if re.search(pattern, line.decode()):
                    return line.decode()
                continue
            assert select.select([fd], [], [], max(0.0, end - time.monotonic()))[0], f"no line {pattern}"
            data = os.read(fd, 4096)
            assert data, f"ended without a line {pattern}"
            self._rest += data

    def target(self) -> str:
        return self.line("^target: ").removeprefix("target: ")

    def end(self) -> int:
        return self.process.wait(LIMIT)


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    started: list[Process] = []

    def build(*arguments: str) -> Process:
        started.append(Process(*arguments))
        return started[-1]

    yield build
    for each in started:
        each.process.kill()
        each.process.communicate()


def test_tcp_first_line_is_the_target_and_sigterm_ends_it_cleanly(start: Callable[..., Process]) -> None:
    process = start("--tcp", "127.0.0.1:0", "--seed", "1")
    assert process.process.stdout is not None
    target = process.target()
    assert re.fullmatch(r"tcp:127\.0\.0\.1:\d+", target)
    host = SmallHost(open_link(target))
    host.stream()
    host.run(0.3)
    assert host.decoders[1, 0].counters.samples > 1000
    assert host.decoders[1, 0].counters.lost_by_index == 0
    process.process.send_signal(signal.SIGTERM)
    closing = process.line("^stopped")
    assert re.fullmatch(r"stopped after \d+ periods: \d+ frames sent, 0 dropped, .*late.*", closing)
    assert process.end() == 0
    with pytest.raises(LinkClosed):
        host.run(1.0)


def test_a_busy_host_does_not_upset_the_pace(start: Callable[..., Process]) -> None:
    process = start("--tcp", "127.0.0.1:0")
    host = SmallHost(open_link(process.target()))
    host.connect()
    for _ in range(400):  # each wakes the server between its steps
        host.request(TimeSync())
    host.stream(["status"], edges=False)
    host.run(0.4, alive=False)
    assert host.decoders[1, 0].counters.samples > 0.2 * 16000
    host.link.close()


def test_end_of_stdin_ends_the_embedded_drive(start: Callable[..., Process]) -> None:
    process = start("--tcp", "127.0.0.1:0", "--exit-with-parent")
    open_link(process.target()).close()
    assert process.process.stdin is not None
    process.process.stdin.close()
    process.process.stdin = None
    process.line("^stopped")
    assert process.end() == 0


def test_a_killed_host_ends_in_outputs_off(start: Callable[..., Process], tmp_path: Path) -> None:
    process = start("--pty", "--link", str(tmp_path / "ttySIM"))
    target = process.target()
    assert target == f"serial:{tmp_path / 'ttySIM'}"
    host = SmallHost(open_link(target))
    host.start()
    host.setpoint(SetpointMode.SPEED, 50.0)
    host.run(0.3)
    assert host.heartbeats[1].outputs_on
    process.line("outputs on .node 1")
    killed = time.monotonic()
    host.link.close()  # no STOP, no more ALIVE
    line = process.line("outputs off .*watchdog .node 1, simulated drive")
    unfed = float(line.split()[2])
    assert 200 <= unfed <= 250
    assert time.monotonic() - killed < 5.0
    host = SmallHost(open_link(target))
    assert host.connect().state is DriveState.FAULT
    host.link.close()


def test_cable_pulled_and_put_back_by_signals(start: Callable[..., Process], tmp_path: Path) -> None:
    process = start("--pty", "--link", str(tmp_path / "ttySIM"))
    target = process.target()
    host = SmallHost(open_link(target))
    host.connect()
    process.process.send_signal(signal.SIGUSR1)
    process.line("^unplugged")
    with pytest.raises(LinkClosed):
        host.run(5.0)
    with pytest.raises(LinkNotFound):
        host.link.reopen()
    process.process.send_signal(signal.SIGUSR2)
    assert process.target() == target
    host.link.reopen()
    assert host.connect().state is DriveState.IDLE
    host.link.close()
    process.process.send_signal(signal.SIGINT)
    assert process.end() == 0
    assert list(tmp_path.iterdir()) == []


def test_a_port_that_other_machines_reach_is_warned_of(start: Callable[..., Process]) -> None:
    process = start("--tcp", "0.0.0.0:0")
    target = process.target()
    process.process.send_signal(signal.SIGTERM)
    _, errors = process.process.communicate(timeout=LIMIT)
    (line,) = errors.decode().splitlines()
    assert line.startswith(f"warning: {target} is open to other machines, and HBP has no authentication: ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "motor.R_s=-1"], "R_s must be > 0 ohm, got -1"),
        (["--set", "motor.Rs=1"], "unknown key motor.Rs"),
        (["--config", "/nowhere.toml"], "no configuration file /nowhere.toml"),
        (["--config", "DEEP.toml"], "DEEP.toml is nested too deeply"),
        (["--tcp", "127.0.0.1"], "HOST:PORT"),
        (["--tcp", "127.0.0.1:99999"], "from 0 to 65535"),
        (["--link", "/nowhere/tty"], "cannot make the link /nowhere/tty"),
        (["--baud", "0"], "baud"),
    ],
)
def test_errors_are_one_line(start: Callable[..., Process], tmp_path: Path, arguments: list[str], message: str) -> None:
    deep = tmp_path / "DEEP.toml"
    deep.write_text(f"x = {'[' * 100_000}")
    process = start(*[str(deep) if argument == deep.name else argument for argument in arguments])
    out, error = process.process.communicate(timeout=LIMIT)
    assert process.process.returncode == 2
    assert out == b""
    assert error.count(b"\n") == 1
    assert message in error.decode()
