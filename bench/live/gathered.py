"""Telemetry in larger pieces, for sinks that count and judge: what they do for a chunk costs more than its samples."""

from __future__ import annotations

from collections.abc import Sequence

from bench.device.client import Sink
from bench.signal.chunks import Chunk, join
from protocol.messages import DeviceEvent, Heartbeat
from protocol.streams import EdgeChunk, SampleChunk

PERIOD = 0.1  # s of device time


class Gathered(Sink):
    """Sink that hands samples and edges on to `sinks` every 0.1 s, joined by stream; all else as it comes.

    `flush` hands on what is held back: before something is asked of the sinks, or told to them.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = sinks
        self._edges: list[EdgeChunk] = []
        self._samples: list[SampleChunk] = []
        self._due: tuple[int, int] = (0, 0)  # ticks between which more is held back

    def edges(self, chunk: EdgeChunk) -> None:
        """Hold them back."""
        self._edges.append(chunk)
        self._look(chunk)

    def samples(self, chunk: SampleChunk) -> None:
        """Hold them back; the very first are handed on at once."""
        self._samples.append(chunk)
        self._look(chunk)

    def _look(self, chunk: SampleChunk | EdgeChunk) -> None:
        """Hand on what is due, and when the drive's time has gone back: it has rebooted."""
        if not len(chunk):
            return
        newest = int(chunk.tick[-1])
        if not self._due[0] <= newest < self._due[1]:
            self._due = newest, newest + round(PERIOD * chunk.config.tick_hz)
            self.flush()

    def flush(self) -> None:
        """Hand on what is held back."""
        edges, self._edges = self._edges, []
        samples, self._samples = self._samples, []
        for sink in self._sinks:
            for some_edges in _by_stream(edges):
                sink.edges(some_edges)
            for some_samples in _by_stream(samples):
                sink.samples(some_samples)

    def heartbeat(self, node: int, heartbeat: Heartbeat) -> None:
        """Hand it on."""
        for sink in self._sinks:
            sink.heartbeat(node, heartbeat)

    def event(self, node: int, event: DeviceEvent) -> None:
        """Hand it on."""
        for sink in self._sinks:
            sink.event(node, event)


def _by_stream(chunks: Sequence[Chunk]) -> list[Chunk]:
    groups: dict[int, list[Chunk]] = {}
    for chunk in chunks:
        groups.setdefault(id(chunk.config), []).append(chunk)
    return [join(group) for group in groups.values()]
