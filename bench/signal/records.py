"""Whether a drive's EDGES records and its channel `hall` tell the same: each edge goes on from the one before it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.signal.capture import Capture
from protocol.streams import EdgeChunk

SETTLED = 2.0
"""Samples after an edge, from which on the channel has its code; it has it until one before the next edge."""


class Records:
    """Counts over captures that follow each other; edges beside a gap are left out."""

    def __init__(self) -> None:
        self.pairs = self.broken = self.turned = 0
        """Edges that follow another; of them, whose code before is not the code after that one; and whose code after is
        the code before that one, as where the two are exchanged."""
        self.compared = self.unlike = 0
        """Samples between two edges that follow each other; of them, with another code than after the first."""
        self.changes = 0
        """Of the code from sample to sample."""
        self._last: EdgeChunk | None = None
        self._code: tuple[int, int] | None = None  # index and code of the last sample

    def add(self, capture: Capture, own: slice, hall: NDArray[np.int64] | None) -> None:
        """The edges of a capture, and its `own` samples; `hall`: the codes of all its samples, None: not recorded."""
        edges = capture.edges
        if len(edges):
            self._follow(edges)
        if hall is None:
            return
        index, codes = capture.samples.index[own], hall[own]
        step = capture.samples.config.index_step
        if self._code is not None and index[0] == self._code[0] + step:
            self.changes += int(codes[0] != self._code[1])
        self.changes += int(np.count_nonzero((np.diff(codes) != 0) & (np.diff(index) == step)))
        self._code = int(index[-1]), int(codes[-1])
        if len(edges) > 1 and (np.diff(edges.tick) >= 0).all():
            self._compare(edges, capture.samples.tick[own], codes, step * capture.samples.config.period_ticks)

    def _follow(self, edges: EdgeChunk) -> None:
        before = [] if self._last is None else [self._last]
        index, old, new = (
            np.concatenate([*(getattr(last, name)[-1:] for last in before), getattr(edges, name)])
            for name in ("index", "hall_old", "hall_new")
        )
        follows = np.diff(index) == 1
        self.pairs += int(np.count_nonzero(follows))
        self.broken += int(np.count_nonzero(follows & (old[1:] != new[:-1])))
        self.turned += int(np.count_nonzero(follows & (new[1:] == old[:-1])))
        self._last = edges

    def _compare(self, edges: EdgeChunk, tick: NDArray[np.int64], codes: NDArray[np.int64], period: int) -> None:
        at = np.searchsorted(edges.tick, tick, "right") - 1
        there = (at >= 0) & (at < len(edges) - 1)
        at, tick, codes = at[there], tick[there], codes[there]
        sure = (edges.index[at + 1] == edges.index[at] + 1) & (tick >= edges.tick[at] + SETTLED * period)
        sure &= tick <= edges.tick[at + 1] - period
        self.compared += int(np.count_nonzero(sure))
        self.unlike += int(np.count_nonzero(sure & (codes != edges.hall_new[at])))
