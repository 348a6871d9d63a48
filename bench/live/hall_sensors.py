"""The Hall sensors of a run while it goes on: what `bench hall check` would say of a recording of it.

Samples and edges come by different ways and at different times; `Pieces` puts them together as captures. `HallJudge`
looks at each piece as it is complete, examines the last stretch every ten seconds and at once where an input returns
or has stopped to change, and all of the run at its end. So what an examination costs does not grow with the run, and a
fault that begins late in it is told as soon as one that begins early.
"""

from __future__ import annotations

import math
import queue
import re
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from bench.device.heard import ClockRestarted, Heard
from bench.findings import wiring
from bench.findings.finding import Finding
from bench.findings.health import examine
from bench.findings.thresholds import LEAST_PASSAGES, LEAST_TURNS, PULSES
from bench.signal import hall_inputs
from bench.signal.capture import Capture
from bench.signal.channels import flagged, reference_angle
from bench.signal.chunks import join, narrowed, no_edge_stream, no_edges, part
from bench.signal.trace import AROUND, LOOKED_AT, Edges, Trace
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, steps_between
from bench.signal.windows import Window, Windows
from protocol.signals import Flag, Unit
from protocol.streams import EdgeChunk, Gap, SampleChunk, StreamConfig

PIECE = 1.0
"""s that are looked at together."""
EDGES_LATE = 0.5
"""s that edges may come after samples dated as they are: on CAN they wait for a heartbeat."""
RATE = 4000.0
"""Samples a second that are looked at, about: of more, evenly spread ones are."""
FOLLOWED = math.pi / 2.0
"""Electrical rad from sample to sample, above which an encoder's turns cannot be followed."""
FIRST, EVERY, RECENT = 5.0, 10.0, 12.0
"""s after which the last stretch is examined at first, then again and again, and how long that is."""
RECENT_SAMPLES, RECENT_EDGES = 20_000, 4_000
"""Of it that are measured from, at most (of edges all, where one returned or stopped to come),"""
MOST, MOST_EDGES = 120_000, 60_000
"""and of the whole run."""
UNPLACED = 0.02
"""Share of edges in and beside gaps, above which too much was lost for judging where edges lie."""
MOST_PATIENT = 8
"""Pieces that are let go by at most, before what looks suspicious is examined again."""
OF_INPUTS = ("bounce", "pulses", "contact", "dead")
"""Findings that what came later does not take back."""
AT_ONCE = (*OF_INPUTS, "wiring", "pole_pairs", "encoder_slips", "encoder_reversed")
"""Findings that need no edge to be passed again and again; all others need `LEAST_PASSAGES` of each."""
_BROKEN = Gap(0, 0, 0, False)


class Said(NamedTuple):
    """A finding, with the first and the last tick of the piece after which it was made."""

    finding: Finding
    first: int
    last: int


class Pieces:
    """Puts samples and edges of a drive together, piece by piece, some of the samples and of their channels.

    `edges`: whether they are streamed.
    """

    def __init__(self, stream: StreamConfig, edges: bool, parameters: Mapping[str, float]) -> None:
        channels = stream.channels
        there = {channel.name for channel in channels}
        self._theta, self._omega = reference_angle(channels), flagged(channels, Unit.RAD_PER_S, Flag.REFERENCE)
        self._stride = max(1, int(stream.rate // RATE))
        wanted = there.intersection((*LOOKED_AT, self._theta)) or {channels[0].name}
        self._config = replace(narrowed(stream, wanted), decimation=stream.decimation * self._stride)
        self._parameters, self._edges = parameters, edges
        self._none = no_edges(no_edge_stream(stream.node, stream.tick_hz, stream.pwm_hz))
        self.too_fast = False
        """Whether it turned too fast for the encoder to be followed from sample to sample: such pieces are left out."""
        self.too_late = False
        """Whether edges came later than a piece waits for them, or were dated as if they had."""
        self.restart()

    def restart(self) -> None:
        """Ticks begin anew."""
        self._samples: list[SampleChunk] = []
        self._came: list[EdgeChunk] = []
        self._settled, self._index, self._fastest = -1, -1, 0.0
        self._broken = [False, False]  # whether samples and edges have left something out

    def edges(self, chunk: EdgeChunk) -> None:
        """Take in edges."""
        self._none = self._none if len(self._none) else part(chunk, 0, 0)
        late = int(np.searchsorted(chunk.tick, self._settled, "right"))
        self.too_late |= late > 0
        if late < len(chunk):
            self._came.append(part(chunk, late, len(chunk)))

    def samples(self, chunk: SampleChunk) -> Iterator[tuple[Capture, bool]]:
        """Take in samples; the pieces that are complete by it, each with whether it follows the one before."""
        if self._omega:
            self._fastest = max(self._fastest, float(np.abs(chunk.physical(self._omega)).mean()))
        rows = np.flatnonzero(chunk.index // chunk.config.decimation % self._stride == 0)
        if len(rows):
            raw = np.empty(len(rows), self._config.dtype)
            for channel in self._config.channels:
                raw[channel.name] = chunk.raw[channel.name][rows]
            index = chunk.index[rows]
            steps = np.diff(index, prepend=self._index if self._index >= 0 else index[0] - self._config.decimation)
            gaps = tuple(Gap(k, 0, 0, False) for k in np.flatnonzero(steps != self._config.decimation).tolist())
            self._index = int(index[-1])
            self._samples.append(SampleChunk(self._config, index, chunk.tick[rows], raw, gaps))
        tick_hz = chunk.config.tick_hz
        wait = EDGES_LATE * tick_hz if self._edges else 0.0
        while self._samples:
            end, newest = int(self._samples[0].tick[0]) + round(PIECE * tick_hz), int(chunk.tick[-1])
            come = newest > end + wait or bool(self._came and self._came[-1].tick[-1] > end)
            if newest <= end or not come:
                break
            yield from self._cut(end)

    def end(self) -> Iterator[tuple[Capture, bool]]:
        """What is left."""
        if self._samples:
            yield from self._cut(int(self._samples[-1].tick[-1]))

    def _cut(self, end: int) -> Iterator[tuple[Capture, bool]]:
        samples, edges = join(self._samples), join(self._came or [self._none])
        n, m = (int(np.searchsorted(chunk.tick, end, "right")) for chunk in (samples, edges))
        self._samples = [part(samples, n, len(samples))] if n < len(samples) else []
        self._came = [part(edges, m, len(edges))] if m < len(edges) else []
        samples, edges = part(samples, 0, n), part(edges, 0, m)
        self._settled, fastest, self._fastest = end, self._fastest, 0.0
        if self._theta:
            gone = SECTOR_WIDTH * abs(float(steps_between(edges.hall_old, edges.hall_new).sum()))
            too_fast = max(gone, fastest / self._config.rate * n) > FOLLOWED * n
            self.too_fast |= too_fast
            if too_fast or not np.isfinite(samples.physical(self._theta)).all():
                self._broken = [True, True]
                return
        follows = not self._broken[0]
        if not follows:
            samples = replace(samples, gaps=(_BROKEN, *samples.gaps))
        if self._broken[1] and m:
            edges = replace(edges, gaps=(_BROKEN, *edges.gaps))
        self._broken = [False, self._broken[1] and not m]
        yield Capture(samples, edges, self._parameters), follows


class HallJudge:
    """Judges a drive's Hall sensors by pieces of a run. `said`: what was found, each once, oldest first.

    Without a stream of `edges` samples tell of the wires, and no more.
    """

    def __init__(self, edges: bool) -> None:
        self._edges = edges
        self.said: deque[Said] = deque()
        self._named: dict[tuple[str, ...], Finding] = {}
        self._kept: list[Finding] = []  # of what was before the clock began anew
        self._patience = self._patient = 0
        self._begin()

    def restart(self) -> None:
        """Ticks begin anew: what was before is examined."""
        self._kept = self.end()
        self._begin()

    def _begin(self) -> None:
        self.whole = Trace(MOST, MOST_EDGES)
        self._windows, self._recent = Windows(AROUND), deque[Window]()
        self._next = FIRST

    def add(self, capture: Capture, follows: bool) -> None:
        """Look at a piece; `follows`: it follows the one before."""
        if not follows:
            for window in self._windows.end():
                self._look(window)
        for window in self._windows.add(capture):
            self._look(window)

    def end(self) -> list[Finding]:
        """What is wrong by all of the run, and what was with its inputs for a while."""
        for window in self._windows.end():
            self._look(window)
        found: list[Finding] = []
        if self.whole.samples:
            found += told(self.whole) if self._edges else wiring.by_samples(self.whole)
        found = [*self._kept, *found]
        if not any(finding.code in OF_INPUTS for finding in found):
            found += [finding for finding in self._named.values() if finding.code in OF_INPUTS]
        return found

    def _look(self, window: Window) -> None:
        edges = self.whole.add(window)
        if not self._edges:
            return
        self._recent.append(window)
        while len(self._recent) * PIECE > RECENT:
            self._recent.popleft()
        due = self.whole.seconds >= self._next
        if due:
            self._next = EVERY * (self.whole.seconds // EVERY + 1.0)
        elif self._patience:
            self._patience -= 1
            return
        elif not suspicious(edges, self.whole.tick_hz):
            return
        recent = Trace(RECENT_SAMPLES, RECENT_EDGES if due else MOST_EDGES)
        for each in self._recent:
            recent.add(each)
        ticks = window.samples.tick
        new = [finding for finding in told(recent) if _name(finding) not in self._named]
        for finding in new:
            self._named[_name(finding)] = finding
            self.said.append(Said(finding, int(ticks[0]), int(ticks[-1])))
        if not due:
            self._patient = 0 if new else min(2 * self._patient + 1, MOST_PATIENT)
            self._patience = self._patient


def told(trace: Trace) -> list[Finding]:
    """What is wrong by a trace that may be short: a run is made for something else than judging sensors.

    Of one direction a back-EMF that seems late is not told: starts and steps of the load turn it as well.
    """
    health = examine(trace, still_named=True)
    fit, one_way = health.measured.fit, min(health.turns.up, health.turns.down) < LEAST_TURNS
    well = fit is not None and int(fit.n.sum(axis=1).min()) >= LEAST_PASSAGES
    well = well and max(trace.unplaced, 2 * trace.breaks) <= UNPLACED * trace.came
    return [f for f in health.findings if f.code in AT_ONCE or (well and not (one_way and f.code == "encoder_late"))]


def suspicious(edges: Edges, tick_hz: float) -> bool:
    """Whether an input returned, or did not change while another did."""
    inputs = hall_inputs.read(edges, tick_hz)
    changed = np.bincount(inputs.changes.input, minlength=3)
    return len(inputs.returns) >= PULSES or bool(changed.min() == 0 and changed.max() >= SECTORS)


def _name(finding: Finding) -> tuple[str, ...]:
    """What tells it from others: its code, and the sensors that it names."""
    return (finding.code, *re.findall(r"\bsensor ([abc])\b", finding.cause))


class HallSensors:
    """Sink that has the Hall sensors of a run judged; `threaded`: by a thread of its own, so that it never waits."""

    def __init__(
        self, stream: StreamConfig, edges: bool, parameters: Mapping[str, float], threaded: bool = False
    ) -> None:
        self._drive, self.pieces, self._judge = stream.node, Pieces(stream, edges, parameters), HallJudge(edges)
        self.error = ""
        """Why nothing more was judged; empty where it was."""
        self._found: list[Finding] | None = None
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._judged, name="Hall sensors", daemon=True) if threaded else None
        if self._thread is not None:
            self._thread.start()

    def take(self, item: Heard) -> None:
        """Follow samples and edges of the drive."""
        match item:
            case EdgeChunk(config=StreamConfig(node=self._drive)):
                self.pieces.edges(item)
            case SampleChunk(config=StreamConfig(node=self._drive)):
                self._hand_on(self.pieces.samples(item))
            case ClockRestarted(node=self._drive):
                self._hand_on(self.pieces.end())
                self.pieces.restart()
                self._do(self._judge.restart)

    def news(self) -> Iterator[Said]:
        """What was found since the last call."""
        while self._judge.said:
            yield self._judge.said.popleft()

    @property
    def turned(self) -> float:
        """Electrical turns that were judged by the encoder."""
        return self._judge.whole.up + self._judge.whole.down

    def findings(self) -> list[Finding]:
        """What is wrong; what comes later is not judged."""
        if self._found is None:
            self._hand_on(self.pieces.end())
            self._do(self._end)
            if self._thread is not None:
                self._work.put(None)
                self._thread.join()
        return [] if self.pieces.too_late else self._found or []

    def _end(self) -> None:
        self._found = self._judge.end()

    def _hand_on(self, pieces: Iterator[tuple[Capture, bool]]) -> None:
        for piece in pieces:
            if not self.pieces.too_late:
                self._do(partial(self._judge.add, *piece))

    def _do(self, work: Callable[[], None]) -> None:
        if self._thread is None:
            work()
        else:
            self._work.put(work)

    def _judged(self) -> None:
        try:
            while (work := self._work.get()) is not None:
                work()
        except Exception as error:  # the motor turns on: the end of the run says that nothing was judged
            self.error = f"{type(error).__name__}: {error}"
