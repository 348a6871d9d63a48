"""Samples and Hall edges of a run that goes on, put together as captures: they come by different ways, edges later."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from bench.signal.capture import Capture
from bench.signal.channels import flagged, reference_angle
from bench.signal.chunks import join, narrowed, no_edge_stream, no_edges, part
from bench.signal.trace import LOOKED_AT
from bench.signal.waveforms.sectors import SECTOR_WIDTH, steps_between
from protocol.signals import Flag, Unit
from protocol.streams import EdgeChunk, Gap, SampleChunk, StreamConfig

PIECE = 1.0
"""s of device time, counted from its zero, that make a piece."""
EDGES_LATE = 0.5
"""s that edges may come after samples dated as they are: on CAN they wait for a heartbeat."""
RATE = 4000.0
"""Samples a second that are looked at, about: of more, evenly spread ones are."""
FOLLOWED = math.pi / 2.0
"""Electrical rad from sample to sample, above which an encoder's turns cannot be followed."""
_BROKEN = Gap(0, 0, 0, False)


class Pieces:
    """Puts samples and edges of a drive together, piece by piece, some of the samples and of their channels.

    `edges`: whether they are streamed; `followed`: pieces in which the encoder cannot be followed are left out.
    """

    def __init__(
        self, stream: StreamConfig, edges: bool, parameters: Mapping[str, float], followed: bool = True
    ) -> None:
        channels = stream.channels
        there = {channel.name for channel in channels}
        self._theta, self._omega = reference_angle(channels), flagged(channels, Unit.RAD_PER_S, Flag.REFERENCE)
        self._stride = max(1, int(stream.rate // RATE))
        wanted = there.intersection((*LOOKED_AT, self._theta)) or {channels[0].name}
        self._config = replace(narrowed(stream, wanted), decimation=stream.decimation * self._stride)
        self._parameters, self._ticks = parameters, round(PIECE * stream.tick_hz)
        self._followed = followed
        self._wait = EDGES_LATE * stream.tick_hz if edges else 0.0
        self._none = no_edges(no_edge_stream(stream.node, stream.tick_hz, stream.pwm_hz))
        self.too_fast = False
        """Whether it turned too fast for the encoder to be followed from sample to sample."""
        self.too_late = False
        """Whether edges came later than a piece waits for them, or were dated as if they had."""
        self.restart()

    def restart(self) -> None:
        """Ticks begin anew."""
        self._samples: list[SampleChunk] = []
        self._came: list[EdgeChunk] = []
        self.settled, self._index, self._fastest = -1, -1, 0.0
        self._broken = [False, False]  # whether samples and edges have left something out

    def edges(self, chunk: EdgeChunk) -> None:
        """Take in edges."""
        self._none = self._none if len(self._none) else part(chunk, 0, 0)
        late = int(np.searchsorted(chunk.tick, self.settled, "right"))
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
        while self._samples:
            end, newest = (int(self._samples[0].tick[0]) // self._ticks + 1) * self._ticks, int(chunk.tick[-1])
            come = newest > end + self._wait or bool(self._came and self._came[-1].tick[-1] > end)
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
        self.settled, fastest, self._fastest = end, self._fastest, 0.0
        if self._theta and self._followed:
            gone = SECTOR_WIDTH * abs(float(steps_between(edges.hall_old, edges.hall_new).sum()))
            step = self._config.period_ticks * self._config.decimation
            lasts = max(n, int(samples.tick[-1] - samples.tick[0]) // step if n else 0)  # in samples, lost ones too
            too_fast = max(gone, fastest / self._config.rate * lasts) > FOLLOWED * lasts
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
