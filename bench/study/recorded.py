"""The recording of a drive without a link: what a rig would have streamed of it, sample by sample."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.record.writer import RunWriter
from bench.rig.metadata import run_info
from bench.rig.rig import Rig
from protocol.signals import Flag
from protocol.streams import SampleChunk, StreamConfig, unpack_edges
from sim.ports.direct import Recorded


class DirectRun:
    """Takes what a drive has recorded over some periods, and writes it to a run."""

    def __init__(self, writer: RunWriter, samples: StreamConfig, edges: StreamConfig) -> None:
        self._writer, self._samples, self._edges, self._next = writer, samples, edges, 0

    def __call__(self, recorded: Recorded) -> None:
        """Write it."""
        k, n = np.arange(recorded.n, dtype=np.int64), len(recorded.edges)
        if n:
            index = np.arange(self._next, self._next + n, dtype=np.int64)
            self._writer.take(unpack_edges(self._edges, recorded.edges, recorded.edge_tick, index, ()))
            self._next += n
        tick = recorded.tick + k * self._samples.period_ticks
        raw = recorded.raw(self._samples.channels)
        self._writer.take(SampleChunk(self._samples, recorded.index + k, tick, raw, ()))


@contextmanager
def recording(path: Path, rig: Rig, more: Collection[str]) -> Iterator[DirectRun]:
    """Records to the run `path` what `rig`, one with such a drive, streams, the plant's state and the channels `more`.

    The rig is closed.
    """
    with rig:
        assert rig.samples is not None
        wanted = {channel.name for channel in rig.samples.channels}.union(more)
        known = rig.drive.node.descriptor.channels
        channels = tuple(one for one in known if one.name in wanted or one.flags & Flag.TRUTH)
        samples = replace(rig.samples, channels=channels)
        edges = next(one for one in rig.drive.node.active_streams() if not one.channels)
        info = run_info(rig.drive.node, rig.plan.target, samples.channels, rig.drive.parameters, rig.plan.settings)
    writer = RunWriter(path, info)
    try:
        yield DirectRun(writer, samples, edges)
    finally:
        writer.close()
