"""`bench sim` as a process: its first line, its signals and its end."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import DEVNULL, PIPE

import pytest
from small_host import SmallHost

from protocol.errors import LinkClosed
from protocol.links import open_link
from protocol.messages import DriveState, TimeSync
from tests.bench.processes import ENVIRONMENT, LIMIT, Sim

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

TCP = ("--tcp", "127.0.0.1:0")


@pytest.fixture
def start() -> Iterator[Callable[..., Sim]]:
    started: list[Sim] = []

    def build(*arguments: str) -> Sim:
        started.append(Sim(*arguments))
        return started[-1]

    yield build
    for each in started:
        each.close()


def test_tcp_first_line_is_the_target_other_machines_are_warned_of_and_sigterm_ends_it(
    start: Callable[..., Sim],
) -> None:
    sim = start("--tcp", "0.0.0.0:0", "--seed", "1")
    assert re.fullmatch(r"tcp:0\.0\.0\.0:\d+", sim.target)
    host = SmallHost(open_link(sim.target))
    host.stream()
    host.run(0.3)
    assert host.losses(1).samples.samples > 1000
    assert host.losses(1).samples.lost_by_index == 0
    sim.send(signal.SIGTERM)
    assert sim.end() == 0
    assert re.fullmatch(r"stopped after \d+ periods: \d+ frames sent, 0 dropped, .*late.*", sim.out[-1])
    with pytest.raises(LinkClosed):
        host.run(1.0)
    (line,) = sim.err
    assert line.startswith(f"warning: {sim.target} is open to other machines, and HBP has no authentication: ")


@pytest.mark.campaign("processes")
def test_a_busy_host_does_not_upset_the_pace(start: Callable[..., Sim]) -> None:
    host = SmallHost(open_link(start(*TCP).target))
    host.connect()
    for _ in range(400):  # each wakes the server between its steps
        host.request(TimeSync())
    host.stream(["status"], edges=False)
    host.run(0.4, alive=False)
    assert host.losses(1).samples.samples > 0.2 * 16000
    host.link.close()


CHILD = (sys.executable, "-X", "importtime", "-m", "sim.ports.embedded")


def test_a_child_ends_with_its_input_and_loads_no_more_than_a_drive_needs(tmp_path: Path) -> None:
    imports = tmp_path / "imports"
    with imports.open("w") as file, subprocess.Popen(CHILD, stdin=PIPE, stdout=PIPE, stderr=file, text=True) as child:
        assert child.stdout is not None
        while not child.stdout.readline().startswith("simulated drive"):
            assert child.poll() is None
        out, _ = child.communicate(timeout=LIMIT)
    assert child.returncode == 0
    assert out.startswith("stopped after ")
    loaded = set(re.findall(r"^import time:.*\| +(\w+)", imports.read_text(), re.MULTILINE))
    assert "llvmlite" in loaded
    assert not loaded & {"can", "click", "jinja2", "matplotlib", "numba", "pyarrow", "pytest", "rerun", "rich"}


@pytest.mark.campaign("processes")
def test_a_child_that_compiles_ends_with_its_input(tmp_path: Path) -> None:
    cold = ENVIRONMENT | {"NUMBA_CACHE_DIR": str(tmp_path)}
    with subprocess.Popen(CHILD, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, text=True, env=cold) as child:
        assert child.stdout is not None
        assert child.stdout.readline().startswith("compiling, once on this machine: ")
        out, _ = child.communicate(timeout=LIMIT)
    assert child.returncode in (0, -signal.SIGTERM)
    assert "target: " not in out


def test_cable_pulled_and_put_back_by_signals(start: Callable[..., Sim], tmp_path: Path) -> None:
    sim = start("--pty", "--link", str(tmp_path / "ttySIM"))
    assert sim.target == f"serial:{tmp_path / 'ttySIM'}"
    sim.send(signal.SIGUSR1)
    sim.line("^unplugged")
    assert list(tmp_path.iterdir()) == []
    sim.send(signal.SIGUSR2)
    assert sim.line("^target: (.*)", after=2)[1] == sim.target
    host = SmallHost(open_link(sim.target))
    assert host.connect().state is DriveState.IDLE
    host.link.close()
    sim.send(signal.SIGINT)
    assert sim.end() == 0
    assert list(tmp_path.iterdir()) == []
