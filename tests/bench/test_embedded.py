"""The embedded simulated drive: what it says when it cannot start, and that it survives a terminal's Ctrl-C."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bench.device.client import Client
from bench.device.simulator import EmbeddedDrive
from bench.errors import BenchError
from protocol.links import open_link


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"x = {'[' * 100_000}", "is nested too deeply"),
        ("[motor]\nR_s = -1", r"R_s must be > 0 ohm, got -1 \(motor.R_s in bad.toml\)"),
        ("é = 1".encode("latin-1"), "is not valid TOML"),
    ],
    ids=["nested", "out of range", "Latin-1"],
)
def test_a_configuration_that_it_cannot_have_is_one_line(tmp_path: Path, text: str | bytes, message: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    notes: list[str] = []
    with pytest.raises(BenchError, match=message) as refused, EmbeddedDrive(str(file), notes.append):
        pass
    assert refused.value.exit_code == 2
    assert "\n" not in str(refused.value)
    assert notes == []


def test_it_is_not_in_the_process_group_that_a_terminal_interrupts() -> None:
    with EmbeddedDrive() as drive:
        pid = drive._process.pid
        assert os.getpgid(pid) != os.getpgrp()
        assert os.getsid(pid) != os.getsid(0)
        link = open_link(drive.target)
        assert Client(link).connect().name == "simulated drive"
        link.close()
