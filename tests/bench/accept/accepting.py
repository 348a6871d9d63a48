"""`bench.accept.accept` in this process: tests given as text, a simulated drive whose link can be spoiled."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import pytest
from processes import ENVIRONMENT
from virtual_run import RecordingScreen, WatchedLink, at_rest

from bench.accept.accept import AcceptOptions, accept
from bench.accept.results import Measurement, RunResult, TestResult
from bench.device.node import DRIVE, SAMPLES
from protocol.framing import Deframer, parse_frame
from protocol.links import Link
from protocol.messages import Command, MessageType
from sim.ports.device import SimulatedDevice

HEAD = """
import math
import signal
import numpy as np
import pytest
from bench.accept import RPM, energises, limit, limits, needs, yes, Limits
def turn(drive, record, rpm=300):
    drive.start("vector-tracking")
    drive.speed(rpm=rpm)
    record.wait(0.1)
def trip(record):
    rig = record.rig
    rig.client.feed(1, on=False)
    rig.client.run_for(0.5)
"""


class SpoiltLink(WatchedLink):
    """A virtual link on which things go wrong when a test says so: `record.rig.client.link.lose = 1`.

    It keeps how the bench and its parameters stood each time it was opened.
    """

    def __init__(self, device: SimulatedDevice, on_call: Callable[[int], None] = lambda number: None) -> None:
        super().__init__(device, on_call)
        self.lose = 0  # so many frames of samples
        self.lost_at = 0.0  # s, virtual
        self.deaf = False  # the drive does not hear STOP
        self.opened: list[tuple[bool, dict[str, float]]] = []

    def open(self, target: str = "") -> Link:
        self.opened.append(self.left())
        self.deaf = False
        self.reopen()
        return self

    def left(self) -> tuple[bool, dict[str, float]]:
        """Whether both machines are idle, and their parameters."""
        return at_rest(self.device), {
            f"{session.identity.node}.{parameter.name}": session.app.get_param(parameter.name)
            for session in self.device.sessions
            for parameter in session.app.parameters
        }

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        frames = super().read(timeout, settle).split(b"\0")
        for number in range(1, len(frames) - 1):  # whole ones
            if self.lose and _is(frames[number], MessageType.DATA, SAMPLES):
                self.lose -= 1
                self.lost_at = self.clock()
                frames[number] = b""
        return b"\0".join(frames)

    def write(self, data: bytes) -> None:
        frames = data.split(b"\0")
        if self.deaf:
            frames = [raw for raw in frames if not _is(raw, MessageType.STATE_CMD, Command.STOP)]
        super().write(b"\0".join(frames))


def _is(raw: bytes, kind: MessageType, first: int) -> bool:
    frames = [parse_frame(frame) for frame in Deframer().feed(b"\0" + raw + b"\0")]
    return any(frame.node == DRIVE and frame.type == kind and frame.payload[0] == first for frame in frames)


def plain_pytest(directory: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Pytest itself, in a process of its own, of a project in that directory; text of what it printed."""
    (directory / "pytest.ini").write_text("[pytest]\n")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
    return subprocess.run(command, cwd=directory, env=ENVIRONMENT | environment, capture_output=True, text=True)


@dataclass(frozen=True)
class Run:
    """What came of it; no result where tests were only listed."""

    found: RunResult | None
    code: int
    screen: RecordingScreen
    directory: Path

    @property
    def result(self) -> RunResult:
        assert self.found is not None
        return self.found

    def __getitem__(self, name: str) -> TestResult:
        (found,) = (test for test in self.result.tests if test.name == name)
        return found

    @property
    def tests(self) -> dict[str, str]:
        return {test.name: str(test.verdict) for test in self.result.tests}

    @property
    def measured(self) -> dict[str, Measurement]:
        return {measurement.name: measurement for measurement in self.result.measurements}


@dataclass
class Accepting:
    """Writes test files to `directory` and runs them."""

    directory: Path
    screen: RecordingScreen = field(default_factory=RecordingScreen)
    numbers: Iterator[int] = field(default_factory=itertools.count)

    def write(self, text: str, name: str = "") -> Path:
        """A file of tests; its name is not that of any other in this process."""
        file = self.directory / f"own_{name or next(self.numbers)}_{self.directory.name}.py"
        file.write_text(HEAD + text)
        return file

    def __call__(self, text: str | Path | None = None, link: SpoiltLink | None = None, **options: object) -> Run:
        """Run tests, without any the shipped suite; with `link` on a target that it stands for, else on `sim`."""
        if text is not None:
            options = {"tests": (text if isinstance(text, Path) else self.write(text),)} | options
        with ExitStack() as stack:
            if link is not None:
                options = {"target": f"serial:{self.directory}/tty"} | options
                stack.enter_context(patch("bench.rig.connection.open_link", link.open))
            run, code = accept(AcceptOptions(**options), self.screen)  # type: ignore[arg-type]
        return Run(run, code, self.screen, self.directory)


@contextmanager
def accepting_in(directory: Path) -> Iterator[Accepting]:
    """In that directory, which is the present one meanwhile."""
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(directory)
        patched.delenv("BENCH_TARGET", raising=False)
        yield Accepting(directory)
