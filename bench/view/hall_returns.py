"""Bounces and pulses a second, by Hall sensor: what of an input's changes returned, as `bench.signal.pulses` counts it.

A second is counted when its edges have come. What is a bounce and what a pulse is told by the last seconds together.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from bench.signal import hall_inputs, pulses
from bench.signal.capture import Capture, joined
from bench.signal.pieces import Pieces
from bench.signal.trace import Ints, Trace
from bench.signal.windows import Window
from protocol.streams import EdgeChunk, SampleChunk

TOGETHER = 4  # pieces of a second that are looked at together


class HallReturns:
    """Takes edges and samples as they come, and gives a row for each second of device time that has ended."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Ticks begin anew."""
        self._pieces: Pieces | None = None
        self._early: list[EdgeChunk] = []  # before any sample
        self._recent: deque[Capture] = deque(maxlen=TOGETHER)

    def edges(self, chunk: EdgeChunk) -> None:
        """Take edges."""
        (self._early.append if self._pieces is None else self._pieces.edges)(chunk)

    def samples(self, chunk: SampleChunk) -> tuple[Ints, Ints]:
        """Take samples.

        Returns the seconds that have ended: their ends (k,) in ticks, and returns (k, 6), bounces of a, b, c and
        pulses. The first row is 0, where the second of the first sample began.
        """
        ends, found, second = [], [], chunk.config.tick_hz
        if self._pieces is None:
            self._pieces = Pieces(chunk.config, True, {}, followed=False)
            for early in self._early:
                self._pieces.edges(early)
            ends, found = [int(chunk.tick[0]) // second * second], [np.zeros(6, np.int64)]
        for capture, _ in self._pieces.samples(chunk):
            self._recent.append(capture)
            ends.append(self._pieces.settled)
            found.append(self._count(self._pieces.settled - second))
        return np.array(ends, np.int64), np.array(found, np.int64).reshape(-1, 6)

    def _count(self, since: int) -> Ints:
        whole = joined(list(self._recent))
        edges = Trace().add(Window(whole, slice(0, len(whole))))
        returns = hall_inputs.read(edges, whole.tick_hz).returns
        *kinds, _ = pulses.kinds(returns)
        return np.concatenate(
            [np.bincount(returns.input[kind & (returns.tick > since)], minlength=3) for kind in kinds]
        )
