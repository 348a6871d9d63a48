"""`bench` in this process against the test device: what it printed, how it ended, what the device saw."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from unittest.mock import patch

import pytest

from bench.cli import main
from bench.conform.run import Options
from tests.devices.device import Device

SPIN = "live TARGET --speed 300 --duration 0.8 --yes --viewer none"
WATCH = "live TARGET --duration 0.4 --viewer none"
INFO = "info TARGET"
HALL = "hall check TARGET --yes --speed 480"
LOOK = "hall check TARGET --passive --duration 0.4"
ACCEPT = "accept TARGET -k test_stop --yes"
REAL_LINKS = tuple(pytest.param(link, marks=pytest.mark.real_links) for link in ("pty", "tcp", "slcan", "virtual"))
LINKS = ("bytes", "CAN", *REAL_LINKS)
CAN = ("CAN", "slcan", "virtual")
OPENED = ("bench.live.run", "bench.device.description", "bench.rig.connection", "protocol.links")
"""Modules that open a link."""
PATIENCE = 30.0  # s that a command may take at most


@dataclass(frozen=True)
class Ran:
    """How a command ended. An exception that it did not foresee is raised instead, and so is a traceback."""

    code: int
    out: str
    err: str

    @property
    def text(self) -> str:
        """All that was printed, in one line: a message may be folded."""
        return " ".join((self.out + " " + self.err).split())


def _main(arguments: list[str]) -> object:
    try:
        main(arguments)
    except SystemExit as ended:
        return ended.code
    return 0


def said(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> tuple[str, str]:
    """What `bench ARGUMENTS…` prints on both outputs; it must end with `code`."""
    ended = _main(list(arguments))
    read = capsys.readouterr()
    assert ended == code, read
    return read.out, read.err


def bench(command: str, device: Device, capsys: pytest.CaptureFixture[str], patience: float = PATIENCE) -> Ran:
    """Run `command`, in which TARGET stands for the device. AssertionError if it takes longer than `patience` s."""
    capsys.readouterr()
    began = time.monotonic()
    with ExitStack() as stack:
        if device.link is not None:
            for place in OPENED:
                stack.enter_context(patch(f"{place}.open_link", lambda target: device.link))
            stack.enter_context(patch("bench.conform.run.Options", partial(Options, idle=device.link.idle)))
        code = _main([device.carrier.target if word == "TARGET" else word for word in command.split()])
    took = time.monotonic() - began
    printed = capsys.readouterr()
    assert isinstance(code, int), code
    assert "Traceback" not in printed.out + printed.err, printed.err
    assert took < patience, f"{command} took {took:.0f} s"
    return Ran(code, printed.out, printed.err)
