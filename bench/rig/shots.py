"""Captures out of the drive's own memory, in a rig: around a trigger, and where a link is too slow to stream it all."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from bench.capture.decode import Captured
from bench.capture.memory import COMPLETE, CaptureMemory, Until
from bench.capture.store import about, store
from bench.capture.trigger import Trigger
from bench.capture.wanted import EDGES_PER_SECOND, MORE_EDGES, Wanted, room_for_edges
from bench.errors import BenchError, MemoryTooSmall
from bench.files import check_output
from bench.record.info import RunInfo
from bench.rig.drive import Drive
from bench.rig.streams import edge_rate
from bench.signal.capture import Capture
from protocol.descriptor import Channel
from protocol.errors import HbpError
from protocol.messages import CaptureState, StreamEvent
from protocol.signals import Signal
from protocol.streams import EDGE_RECORD, MAX_DECIMATION, StreamConfig

InfoOf = Callable[[tuple[Channel | Signal, ...]], RunInfo]
STRETCH = 2.5  # s that what happens in a block may last, where nobody says how long
SPARE = 0.3  # s that commands in a block may take beside what was said
SHARE = 0.3  # of a link that streams may take where captures are to be read beside them
_NOW, _STOPS = Trigger.parse("now"), Trigger.parse("state")


class Shot:
    """One capture: armed when its block is entered, read when it is left; see `bench.rig.rig.Rig.capture`.

    A trip of the drive in the block freezes it, too: it is read before DriveTripped goes on. After any other exception
    nothing is left armed.
    """

    def __init__(self, drive: Drive, until: Until, wanted: Wanted, timeout: float, info: InfoOf) -> None:
        """`until` lets the bench go on; `info` is what a run of these channels says of itself."""
        self._drive, self._until, self._wanted, self._timeout, self._info = drive, until, wanted, timeout, info
        self._memory = CaptureMemory(drive.node)
        self._number = 0
        self._captured: Captured | None = None

    def __enter__(self) -> Self:
        self._captured, self._number = None, self._memory.arm(self._wanted).number
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self._leave(error)
            return
        try:
            self._read(self._timeout, self._until)
        except BaseException as failure:
            self._leave(failure)
            raise

    def _read(self, timeout: float, until: Until | None) -> None:
        status = self._memory.wait(self._number, timeout, until)
        if status is None:
            self._memory.disarm(self._number)
            raise BenchError(f"no trigger '{self._wanted.trigger.text}' within {timeout:g} s; nothing is armed now")
        self._captured = self._memory.read(status)
        self._memory.give_up()

    def _leave(self, error: BaseException) -> None:
        """After an error: read what a trip has frozen, else leave nothing armed. What is wrong with that is no news."""
        with suppress(HbpError, BenchError):
            status = self._memory.status()
            came = status.number == self._number and status.state in (CaptureState.TRIGGERED, CaptureState.FROZEN)
            if came and isinstance(error, BenchError):
                self._read(COMPLETE, None)
            else:
                self._memory.disarm(self._number)

    @property
    def captured(self) -> Captured:
        """As it was read, with what the drive says of it. BenchError before that."""
        if self._captured is None:
            raise BenchError("nothing was captured yet: it is read when its block is left")
        return self._captured

    @property
    def capture(self) -> Capture:
        """Samples and Hall edges. BenchError before it was read."""
        return self.captured.capture(self._drive.parameters)

    @property
    def t0(self) -> float:
        """Device time of the trigger, s. BenchError before it was read."""
        return self.captured.status.tick / self.captured.stream.tick_hz

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Write it as a run. Raises BenchError."""
        path, captured = Path(path), self.captured
        check_output(path, str(path), overwrite, recording=True)
        told = about(captured, self._wanted.trigger.text, self._wanted.pre)
        store(captured, path, self._info(captured.stream.channels), told, overwrite)


class Held:
    """A stretch that the drive holds: read when it is first asked for, or before the next one begins.

    So what follows it can be done first: a load that the motor bears for a second is not left on it for a minute.
    """

    def __init__(self, number: int, seconds: float, read: Callable[[Held], Capture], whole: bool = True) -> None:
        """`whole`: what the memory does not hold of it counts as lost."""
        self.number, self.seconds, self.whole = number, seconds, whole
        self.first = self.last = -1
        self.parameters: Mapping[str, float] = {}
        self._read = read
        self._capture: Capture | None = None

    def end(self, first: int, last: int, parameters: Mapping[str, float]) -> None:
        """It lasted from one device tick to another, with these `parameters` of the drive."""
        self.first, self.last, self.parameters = first, last, parameters

    def read(self) -> Capture:
        """All of it, once it has ended. Raises BenchError, and HbpError of the link."""
        if self.last < 0:
            raise BenchError("the drive holds one stretch at a time, and this one goes on: end it before the next")
        if self._capture is None:
            self._capture = self._read(self)
        return self._capture


class FullRate:
    """What a test measures, out of the drive's memory at the PWM rate, where its link streams less.

    `channels` are held; `stream` is how they come. A stretch that is longer than the memory holds at the full rate is
    taken at a lower one, unless `full`: then BenchError says so.
    """

    def __init__(self, drive: Drive, until: Until, target: str, channels: tuple[Channel, ...], full: bool) -> None:
        """BenchError where the drive holds something that nobody has fetched."""
        self._drive, self._until, self.channels, self.full = drive, until, channels, full
        self._memory = CaptureMemory(drive.node)
        identity, status = drive.node.identity, self._memory.status()
        if status.state == CaptureState.FROZEN:
            raise BenchError(
                f"the tests need the drive's memory for captures, and it holds one: fetch it with `bench capture "
                f"{target} --at-fault -o RUN`, or give it up with --discard"
            )
        self.stream = StreamConfig(
            identity.node, 0, 0, StreamEvent.PWM, 1, channels, 1, tick_hz=identity.tick_hz, pwm_hz=identity.pwm_hz
        )
        self.room = status.room
        self._pending: Held | None = None  # a stretch that has ended, or goes on

    @property
    def holds(self) -> float:
        """s at every PWM period, beside the Hall edges of the highest speed, that the memory holds."""
        sample, edge = self.stream.dtype.itemsize, EDGE_RECORD.itemsize
        spare = 2 * sample + edge * (room_for_edges(0.0, 0.0) + 1)
        return (self.room - spare) / (sample * self.stream.rate + edge * self._edges_per_s)

    @property
    def _edges_per_s(self) -> float:
        return MORE_EDGES * (edge_rate(self._drive.node, self._drive.envelope) or EDGES_PER_SECOND)

    def record(self, seconds: float) -> Capture:
        """The next `seconds`. Raises DriveTripped, and BenchError where the memory does not hold them."""
        captured = self._read(self._begin(seconds), seconds, self._until)
        first = int(captured.samples.tick[0])
        return captured.capture(self._drive.parameters).ticks(first, first + round(seconds * self.stream.tick_hz))

    def begin(self, seconds: float | None) -> Held:
        """Take down what comes from now on, at least `seconds` of it, until the end of what it returns."""
        length = STRETCH if seconds is None else seconds + SPARE
        self._pending = Held(self._begin(length), length, self._finish)
        return self._pending

    def keep(self, before: float, after: float, edges_per_s: float | None) -> Held:
        """Of a drive that runs: the last `before` s, at most, until its outputs go off, and `after` s from then on.

        `edges_per_s`: Hall edges of a shaft that is slow, so that samples need not come in every PWM period; None: of
        one that is as fast as it may be.
        """
        number = self._arm(_STOPS, before, after, edges_per_s is None, edges_per_s)
        self._pending = Held(number, after, self._finish, whole=False)
        return self._pending

    def _finish(self, held: Held) -> Capture:
        """Read a stretch that has ended."""
        captured = self._read(held.number, held.seconds, None)
        capture = captured.capture(held.parameters)
        newest, hz = int(captured.samples.tick[-1]), self.stream.tick_hz
        if held.whole and newest < held.last - captured.stream.period_ticks * captured.stream.decimation:
            words = f"the drive's memory held no sample after {newest / hz:.4f} s: give record.stretch() its length"
            capture = replace(capture, dropped=(*capture.dropped, (newest, held.last, words)))
        return capture.ticks(held.first, held.last)

    def _begin(self, seconds: float) -> int:
        return self._arm(_NOW, 0.0, seconds, self.full)

    def _arm(self, trigger: Trigger, before: float, after: float, full: bool, edges_per_s: float | None = None) -> int:
        if self._pending is not None:
            self._pending.read()
            self._pending = None
        status = self._memory.status()
        if status.state == CaptureState.FROZEN:  # of a trip that a test has made
            self._memory.give_up()
        seconds, rate = before + after, self.stream.rate
        edges = room_for_edges(self._edges_per_s if edges_per_s is None else edges_per_s, seconds)
        fits = (self.room - EDGE_RECORD.itemsize * edges) // self.stream.dtype.itemsize
        decimation = math.ceil(seconds * rate / fits) if fits > 0 else 0
        if not 1 <= decimation <= (1 if full else MAX_DECIMATION):
            raise MemoryTooSmall(
                f"{seconds:g} s of {len(self.channels)} channels at {rate:g} Hz do not fit into the drive's "
                f"{self.room} bytes for captures"
            )
        names = [channel.name for channel in self.channels]
        return self._memory.arm(Wanted(trigger, seconds, before / seconds, names, decimation, edges)).number

    def _read(self, number: int, seconds: float, until: Until | None) -> Captured:
        status = self._memory.wait(number, seconds + COMPLETE, until)
        if status is None:
            raise BenchError(f"the drive did not complete a capture of {seconds:g} s in {seconds + COMPLETE:g} s")
        captured = self._memory.read(status)
        self._memory.give_up()
        return captured

    def close(self) -> None:
        """At the end of the rig: the drive waits for faults again, as it did before."""
        self._memory.give_up()
