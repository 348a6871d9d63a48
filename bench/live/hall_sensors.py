"""The Hall sensors of a run while it goes on: what `bench hall check` would say of a recording of it.

`HallJudge` looks at each piece as it is complete, examines the last stretch every ten seconds and at once where an
input returns or has stopped to change, and all of the run at its end. So what an examination costs does not grow with
the run, and a fault that begins late in it is told as soon as one that begins early.
"""

from __future__ import annotations

import queue
import re
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
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
from bench.signal.pieces import PIECE, Pieces
from bench.signal.trace import AROUND, Edges, Trace
from bench.signal.waveforms.sectors import SECTORS, steps_between
from bench.signal.windows import Window, Windows
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

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
AT_ONCE = (*OF_INPUTS, "edge_records", "hall_codes", "wiring", "pole_pairs", "encoder_slips", "encoder_reversed")
"""Findings that need no edge to be passed again and again; all others need `LEAST_PASSAGES` of each."""


class Said(NamedTuple):
    """A finding, with the first and the last tick of the piece after which it was made."""

    finding: Finding
    first: int
    last: int


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
        for window in [*([] if follows else self._windows.end()), *self._windows.add(capture)]:
            self._look(window)

    def end(self) -> list[Finding]:
        """What is wrong by all of the run, and what was with its inputs for a while."""
        for window in self._windows.end():
            self._look(window)
        found = list(self._kept)
        if self.whole.samples:
            found += told(self.whole) if self._edges else wiring.by_samples(self.whole)
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
        new = [finding for finding in told(recent) if _name(finding) not in self._named]
        for finding in new:
            self._named[_name(finding)] = finding
            self.said.append(Said(finding, *window.samples.tick[[0, -1]].tolist()))
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
    gone = steps_between(edges.old, edges.new)
    if abs(gone.sum()) == len(gone) and np.abs(gone).max(initial=0.0) <= 1.0:  # sector after sector, one way
        return False
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
