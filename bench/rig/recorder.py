"""Collects what a drive streams during one test, and hands out stretches of it as captures.

A sink of the client: chunks come in as they are decoded. It never asks the drive for anything and never waits;
`bench.rig.rig` does both.
"""

from __future__ import annotations

from collections.abc import Mapping

from bench.device.counters import DeviceCounters
from bench.device.heard import Heard, Misdated, Missing, ParameterSet
from bench.errors import BenchError
from bench.record.changes import course, settled
from bench.signal.capture import Capture
from bench.signal.chunks import LostStretches, between, join, no_edges, streams_none
from bench.signal.parameters import ParameterCourse
from protocol.host import HeartbeatReceived
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig
from protocol.text import counted


class Recorder:
    """Sink that keeps everything that node `drive` streams, from now on; its edges come as `expect` said."""

    def __init__(self, drive: int) -> None:
        self.tick_hz = 0
        self.device = DeviceCounters()
        self.dropped: list[tuple[int, int, str]] = []
        """Stretches, from tick to tick, in which something was lost, in words."""
        self._drive = drive
        self._samples: list[SampleChunk] = []
        self._edges: list[EdgeChunk] = []
        self._parameters: Mapping[str, float] = {}  # before any of them
        self._set: list[ParameterSet] = []
        self._lost = LostStretches()
        self._beats = 0, 0  # the drive's counts of edges, by its first heartbeat and its last

    # -- sink ---------------------------------------------------------------------------------------------------

    def take(self, item: Heard) -> None:
        """Keep samples and edges, follow the drive's own counts, remember what was lost."""
        match item:
            case SampleChunk():
                self.dropped += self._lost.before(item)
                self._samples.append(item)
            case EdgeChunk():
                self.dropped += self._lost.before(item)
                self._edges.append(item)
            case HeartbeatReceived(node=self._drive, heartbeat=heartbeat):
                self._beats = (self._beats[0] if self.device.seen else heartbeat.edges), heartbeat.edges
                self.device.add(heartbeat)
            case Missing(node=self._drive, samples=samples, edges=edges):
                self.dropped += self._lost.at_the_end(samples, edges, self.tick_hz)
            case ParameterSet(node=self._drive):
                self._set.append(item)
            case Misdated(tick, self._drive, text):
                self.dropped.append((tick, tick, text))

    # -- for the rig --------------------------------------------------------------------------------------------

    def expect(self, edges: StreamConfig, parameters: Mapping[str, float]) -> None:
        """Hall edges will come like this, if the shaft turns; `parameters` are the drive's now."""
        self.tick_hz, self._parameters = edges.tick_hz, dict(parameters)
        self._edges = [no_edges(edges)]

    @property
    def newest(self) -> int:
        """Device tick of the newest sample, -1 before the first."""
        return int(self._samples[-1].tick[-1]) if self._samples else -1

    def latest(self, channel: str) -> float:
        """The newest value of a channel. BenchError before the first sample, or where there is no such channel."""
        if not self._samples:
            raise BenchError(f"no sample received yet: '{channel}' is unknown")
        chunk = self._samples[-1]
        if channel not in (chunk.raw.dtype.names or ()):
            raise BenchError(f"channel '{channel}' is not in the stream")
        return float(chunk.physical(channel)[-1])

    @property
    def sets(self) -> int:
        """How many parameters have been set so far."""
        return len(self._set)

    def course(self, sets: int = 0) -> ParameterCourse:
        """The drive's parameters when so many had been set, and what has changed since then."""
        before = {change.name: change.value for change in self._set[:sets]}
        return course({**self._parameters, **before}, settled(self._set[sets:]))

    def capture(self, first: int, last: int, sets: int | None = None) -> Capture:
        """What lies between the ticks `first` and `last`, both included. BenchError if that is nothing.

        `sets`: how many parameters had been set when it began; None: as many as were before its first sample. The time
        alone does not tell it: in virtual time the drive's clock may stand still meanwhile.
        """
        chunks = [c for c in self._samples if c.tick[-1] >= first and c.tick[0] <= last]
        if not chunks:
            raise BenchError(f"no sample between {self._at(first)} and {self._at(last)}")
        samples = join([between(chunk, first, last) for chunk in chunks])
        near = [c for c in self._edges if not len(c) or (c.tick[-1] >= first and c.tick[0] <= last)]
        edges = join([between(chunk, first, last) for chunk in near or self._edges[:1]])
        dropped = [stretch for stretch in self.dropped if stretch[0] <= last and stretch[1] >= first]
        came = any(map(len, self._edges)) or streams_none(edges.config)
        if not came and (counted_edges := self._beats[1] - self._beats[0] & 0xFFFFFFFF):
            dropped.append(
                (first, last, f"{counted(counted_edges, 'Hall edge')} were lost: all that the drive counted")
            )
        if self.newest < last:
            dropped.append((self.newest, last, f"no sample received after {self._at(self.newest)}"))
        known = self.course().since(int(samples.tick[0])) if sets is None else self.course(sets)
        return Capture(samples, edges, known, tuple(dropped))

    def count(self) -> tuple[int, int]:
        """Samples and edges so far."""
        return sum(len(c) for c in self._samples), sum(len(c) for c in self._edges)

    @property
    def seconds(self) -> float:
        """Device time from the first sample to the newest, whatever was lost between them."""
        return (self.newest - int(self._samples[0].tick[0])) / self.tick_hz if self._samples else 0.0

    def _at(self, tick: int) -> str:
        return f"{tick / self.tick_hz:.4f} s"
