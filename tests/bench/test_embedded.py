"""The embedded simulated drive: what it says when it cannot start, what it survives, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from collect import Bench

from bench.device.client import Client
from bench.device.simulator import EmbeddedDrive
from bench.errors import BenchError
from protocol.links import open_link
from protocol.messages import DriveState


@pytest.mark.parametrize(("text", "message"), [
    (f"x = {'[' * 100_000}", "is nested too deeply"),
    ("[motor]\nR_s = -1", r"R_s must be > 0 ohm, got -1 \(motor.R_s in bad.toml\)"),
    ("é = 1".encode("latin-1"), "is not valid TOML"),
], ids=["nested", "out of range", "Latin-1"])  # fmt: skip
def test_a_configuration_that_it_cannot_have_is_one_line(tmp_path: Path, text: str | bytes, message: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    notes: list[str] = []
    with pytest.raises(BenchError, match=message) as refused, EmbeddedDrive(str(file), notes.append):
        pass
    assert refused.value.exit_code == 2
    assert "\n" not in str(refused.value)
    assert notes == []


@pytest.mark.slow
def test_it_is_not_in_the_process_group_that_a_terminal_interrupts() -> None:
    with EmbeddedDrive() as drive:
        pid = drive._process.pid
        assert os.getpgid(pid) != os.getpgrp()
        assert os.getsid(pid) != os.getsid(0)
        link = open_link(drive.target)
        assert Client(link).connect().name == "simulated drive"
        link.close()


@pytest.mark.slow
def test_it_goes_on_when_nobody_reads_what_it_says() -> None:
    with EmbeddedDrive() as drive:
        link = open_link(drive.target)
        bench = Bench(link)
        bench.turn(50.0)  # it says that the outputs are on
        assert bench.drive.stop() == DriveState.IDLE
        bench.client.run_for(0.1)
        assert bench.drive.state == DriveState.IDLE
        assert drive._process.poll() is None
        link.close()


@pytest.mark.slow
def test_its_time_begins_when_the_host_connects() -> None:
    with EmbeddedDrive() as drive:
        with pytest.raises(subprocess.TimeoutExpired):  # it goes on, and waits
            drive._process.wait(0.3)
        began = time.monotonic()
        link = open_link(drive.target)
        client = Client(link)
        hello = client.connect()
        assert client.wait(lambda: hello.node in client.heartbeats, 5.0)
        assert client.heartbeats[hello.node].tick < (time.monotonic() - began) * hello.tick_hz
        link.close()


@pytest.mark.slow
def test_it_ends_while_it_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    class Enough(Exception):
        pass

    def note(text: str) -> None:
        assert text.startswith("compiling, once on this machine: ")
        raise Enough

    drive = EmbeddedDrive(note=note)
    with pytest.raises(Enough), drive:
        pass
    assert drive._process.returncode in (0, -signal.SIGTERM)  # it was not killed
