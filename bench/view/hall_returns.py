"""Bounces and pulses a second, by Hall sensor: what of an input's changes returned, as `bench.signal.pulses` counts it.

A second is counted when its edges have come: on CAN they wait for a heartbeat. What is a bounce and what a pulse is
told by the last seconds together.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from bench.signal import hall_inputs, pulses
from bench.signal.chunks import join, part
from bench.signal.trace import Edges, Floats, Ints, speed
from protocol.streams import EdgeChunk

EDGES_LATE, TOGETHER = 0.5, 4  # s; s that are looked at together
RATE = 4000.0  # samples a second of the encoder that are looked at


class HallReturns:
    """Takes edges and samples as they come, and gives a row for each second of device time that has ended."""

    def __init__(self, tick_hz: int) -> None:
        self._second = tick_hz
        self.restart()

    def restart(self) -> None:
        """Ticks begin anew."""
        self._edges: list[EdgeChunk] = []
        self._angle: deque[tuple[Ints, Floats]] = deque()  # ticks, and rad by the encoder
        self._end: int | None = None  # of the second that goes on

    def edges(self, chunk: EdgeChunk) -> None:
        """Take edges."""
        self._edges.append(chunk)

    def samples(self, tick: Ints, theta: Floats | None) -> tuple[Ints, Ints]:
        """Take samples at ticks (n,), with the electrical angle by the encoder, rad (n,), where there is one.

        Returns the seconds that have ended: their ends (k,) in ticks, and returns (k, 6), bounces of a, b, c and
        pulses.
        """
        first, last = int(tick[0]), int(tick[-1])
        if self._end is None or first - self._end > TOGETHER * self._second:
            self._end = first - first % self._second
        if theta is not None:
            step = max(1, round(len(tick) * self._second / RATE / max(1, last - first)))
            self._angle.append((tick[::step], theta[::step].astype(np.float64)))
            while int(self._angle[0][0][-1]) < self._end - (TOGETHER + 1) * self._second:
                self._angle.popleft()
        ends, found = [], []
        while last >= self._end + self._second * EDGES_LATE:
            ends.append(self._end)
            found.append(self._count(self._end))
            self._end += self._second
        return np.array(ends, np.int64), np.array(found, np.int64).reshape(-1, 6)

    def _count(self, end: int) -> Ints:
        if not self._edges:
            return np.zeros(6, np.int64)
        whole = join(self._edges)
        first = int(np.searchsorted(whole.tick, end - TOGETHER * self._second))
        whole = part(whole, first, len(whole))
        self._edges = [whole] if len(whole) else []
        stretch = np.searchsorted(sorted(gap.position for gap in whole.gaps), np.arange(len(whole)), "right")
        old, new = (codes.astype(np.int64) & 7 for codes in (whole.hall_old, whole.hall_new))
        theta, omega = self._motion(whole.tick)
        edges = Edges(whole.tick, old, new, theta, omega, np.zeros(len(whole)), stretch)
        returns = hall_inputs.read(edges, self._second).returns
        now = (returns.tick > end - self._second) & (returns.tick <= end)
        kinds = pulses.kinds(returns)
        return np.concatenate([np.bincount(returns.input[kind & now], minlength=3) for kind in kinds])

    def _motion(self, tick: Ints) -> tuple[Floats, Floats]:
        """Angle and speed at ticks (n,), by the encoder; NaN without one."""
        if not self._angle or not len(tick):
            return np.full(len(tick), np.nan), np.full(len(tick), np.nan)
        at, theta = (np.concatenate(column) for column in zip(*self._angle, strict=True))
        theta = np.unwrap(theta)
        return np.interp(tick, at, theta), np.interp(tick, at, speed(theta, at / self._second))
