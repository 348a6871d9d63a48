"""Captures of a drive as runs: what `bench capture` does, and what `bench live` keeps after a trip.

Nothing here energises anything, or stops a stream: another host may be turning the motor meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.capture.memory import PATIENCE, CaptureMemory, held_words
from bench.capture.store import about, store
from bench.capture.wanted import Wanted
from bench.device.client import Client
from bench.device.node import Node
from bench.errors import BenchError
from bench.files import check_output
from bench.record.layout import part_name
from bench.rig.connection import find_drive
from bench.rig.metadata import run_info
from bench.rig.screen import Screen
from bench.rig.settings import Settings
from protocol.errors import HbpError
from protocol.links import open_link
from protocol.messages import CaptureReply

_SOON = 1.0  # s after which it is known how fast a link is


@dataclass(frozen=True)
class Stored:
    """A capture that became the run `path`: what it is, and how long it took to read, s."""

    path: Path
    about: dict[str, Any]
    channels: int
    span: tuple[float, float]
    """Device time of the first and the last sample, s."""
    reading: float

    def as_json(self) -> dict[str, Any]:
        """The same as plain data."""
        return {"path": str(self.path), **self.about, "channels": self.channels, "first_s": self.span[0],
                "last_s": self.span[1], "reading_s": self.reading}  # fmt: skip


class Capturing:
    """Captures of `node`, reached by `target`, for people at `screen`."""

    def __init__(self, node: Node, target: str, settings: Settings, screen: Screen) -> None:
        """Raises NodeError where the drive has no memory for captures."""
        self.node, self.target, self.settings, self.screen = node, target, settings, screen
        self.memory = CaptureMemory(node)
        self.advice = f"`bench capture {target} --at-fault -o RUN` fetches it"
        """How somebody gets what the drive holds."""

    def take(
        self, wanted: Wanted, path: Path, repeat: int = 1, timeout: float | None = None, overwrite: bool = False,
        note: str = "",
    ) -> Iterator[Stored]:  # fmt: skip
        """Arm, wait, read and store, `repeat` times; several become parts of `path`, as those of a run that is split.

        `timeout`: s that each trigger is waited for; None: for ever. However it is left, nothing is left armed. Raises
        BenchError.
        """
        paths = [path] if repeat == 1 else [part_name(path, number + 1) for number in range(repeat)]
        for each in paths:
            check_output(each, f"--out {each}", overwrite, recording=True)
        for number, each in enumerate(paths):
            armed = self.memory.arm(wanted)
            of = f" ({number + 1} of {repeat})" if repeat > 1 else ""
            self.screen.progress(f"armed{of}: waiting for {wanted.trigger.text}")
            try:
                status = self.memory.wait(armed.number, math.inf if timeout is None else timeout)
            except BaseException:
                with suppress(HbpError, BenchError):
                    self.memory.disarm(armed.number)
                raise
            if status is None:
                self.memory.disarm(armed.number)
                done = f" after {number} of {repeat} captures" if number else ""
                raise BenchError(f"no trigger '{wanted.trigger.text}' within {timeout:g} s{done}; nothing is armed now")
            yield self._keep(status, each, overwrite, wanted.trigger.text, wanted.pre, note)

    def fetch(self, path: Path, overwrite: bool = False, note: str = "", most: float = math.inf) -> Stored:
        """Read and store what the drive holds, whoever has armed it. Raises BenchError.

        It stays in the drive where reading it would take more than `most` s.
        """
        check_output(path, f"--out {path}", overwrite, recording=True)
        return self._keep(self.memory.frozen(), path, overwrite, note=note, most=most)

    def discard(self) -> str:
        """Give up what the drive holds; says what that was. Raises BenchError where it holds nothing."""
        words = held_words(self.node, self.memory.frozen())
        self.memory.give_up()
        return words

    def _keep(
        self, status: CaptureReply, path: Path, overwrite: bool, trigger: str = "", pre: float | None = None,
        note: str = "", most: float = math.inf,
    ) -> Stored:  # fmt: skip
        """Read, store, and only then give up what the drive holds."""
        began = self.node.client.now()

        def progress(done: int, size: int) -> None:
            took = self.node.client.now() - began
            if took > _SOON and took * size / done > most:
                raise BenchError(f"reading it takes {took * size / done:.0f} s on this link: {self.advice}")
            self.screen.progress(f"reading the capture: {done} of {size} bytes ({100 * done / size:.0f} %)")

        captured = self.memory.read(status, progress)
        took = self.node.client.now() - began
        told = about(captured, trigger, pre)
        more = {"note": note} if note else {}
        parameters = self.node.parameters()
        info = run_info(self.node, self.target, captured.stream.channels, parameters, self.settings, **more)
        store(captured, path, info, told, overwrite)
        self.memory.give_up()
        ticks, hz = captured.samples.tick, captured.stream.tick_hz
        span = float(ticks[0] / hz), float(ticks[-1] / hz)
        return Stored(path, told, len(captured.stream.channels), span, took)


@contextmanager
def listening(target: str, settings: Settings, screen: Screen) -> Iterator[Capturing]:
    """Connect to a drive for its captures only; a link that breaks is waited for. Raises BenchError and HbpError."""
    link = open_link(target)
    try:
        client = Client(link, reconnect=PATIENCE)
        drive = find_drive(client, target)
        drive.encoder = settings.encoder
        yield Capturing(drive, target, settings, screen)
    finally:
        link.close()
