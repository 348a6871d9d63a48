"""Electrical revolutions by the Hall sensors beside those by the encoder: wrong pole pairs, or an encoder that slips.

A recording tells at which angle of the encoder each edge came, so `of_edges` sees which number makes them repeat. A run
counts sectors while edges come later than samples: `ComparedTurns` has their ratio alone, and names what else it may
be. Their thresholds differ, see `bench.findings.thresholds`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.findings.finding import Finding
from bench.findings.thresholds import COMPARED_TURNS, POLE_PAIR_OFF, RATIO_OFF, ROUNDS
from bench.signal.position import wrap
from bench.signal.waveforms.sectors import SECTOR_WIDTH
from protocol.streams import EdgeChunk, SampleChunk

BLOCK = 0.25  # s over which Hall sensors and encoder are compared
FOLLOWED = math.pi / 2  # electrical rad between two samples, above which an encoder's turns cannot be counted by them
EDGES_LATE = 0.5  # s that edges may come after samples dated as they are: on CAN they wait for a heartbeat


class _Block(NamedTuple):
    """Samples after the tick `start`, up to `end`: how many, and the electrical rad that the encoder turned in them."""

    start: int
    end: int
    samples: int
    turned: float


class ComparedTurns:
    """Electrical revolutions by the Hall sensors beside those by the encoder, in blocks of the drive's own time.

    Samples and edges come by different ways and at different times; a block waits for its edges. One beside a gap is
    left out. `rate`: samples a second; `n_p`: the drive's, None if it tells none.
    """

    def __init__(self, rate: float, n_p: float | None) -> None:
        self._rate, self._n_p = rate, n_p
        self._blocks: deque[_Block] = deque()  # whose edges may not all have come
        self._start = self._samples = 0
        self._turned = 0.0
        self._last_theta: float | None = None
        self._ticks = np.zeros(0, np.int64)
        self._steps = np.zeros(0)  # NaN behind lost ones
        self._hall_along = self._turned_total = 0.0  # electrical rad, of all blocks
        self.too_fast = False
        """Whether it turned too fast for the encoder to be followed from sample to sample."""
        self.too_late = False
        """Whether edges came later than a block waits for them, or were dated as if they had: nothing is told."""
        self._settled = -1  # the end of the last block that was compared

    @property
    def compared(self) -> bool:
        """Whether it turned far enough, and every edge came in time."""
        return self._turned_total >= COMPARED_TURNS * math.tau and not self.too_late

    def edges(self, chunk: EdgeChunk, steps: NDArray[np.float64]) -> None:
        """Take in what the Hall sensors showed; `steps`: their `sectors`."""
        self.too_late |= bool(chunk.tick[0] <= self._settled)
        steps = steps.copy()
        steps[[gap.position for gap in chunk.gaps if gap.lost_samples]] = np.nan
        self._ticks, self._steps = np.append(self._ticks, chunk.tick), np.append(self._steps, steps)

    def samples(self, chunk: SampleChunk, theta: NDArray[np.float64] | None, step: float = 0.0) -> None:
        """Take in the encoder's electrical angle, rad, or None: nothing is compared; `step`: rad between two."""
        too_fast = step > FOLLOWED
        self.too_fast |= too_fast
        end = int(chunk.tick[-1])
        if theta is None or chunk.gaps or self._last_theta is None or too_fast:
            self._start, self._samples, self._turned = end, 0, 0.0
        else:
            self._turned += float(wrap(np.diff(theta, prepend=self._last_theta)).sum())
            self._samples += len(chunk)
        self._last_theta = None if theta is None else float(theta[-1])
        if self._samples >= BLOCK * self._rate:
            self._blocks.append(_Block(self._start, end, self._samples, self._turned))
            self._start, self._samples, self._turned = end, 0, 0.0
        wait = EDGES_LATE * chunk.config.tick_hz
        while self._blocks and (
            self._blocks[0].end < end - wait or (len(self._ticks) and self._blocks[0].end < self._ticks[-1])
        ):
            self._compare(self._blocks.popleft())
        wanted = self._ticks > (self._blocks[0].start if self._blocks else self._start)
        self._ticks, self._steps = self._ticks[wanted], self._steps[wanted]

    def _compare(self, block: _Block) -> None:
        self._settled = block.end
        first, behind = np.searchsorted(self._ticks, (block.start, block.end), side="right")
        hall = SECTOR_WIDTH * float(np.nansum(self._steps[first:behind]))
        lost = bool(np.isnan(self._steps[first : behind + 1]).any())  # before an edge in it, or before the next one
        if abs(hall) > FOLLOWED * block.samples:
            self.too_fast = True
        elif abs(block.turned) > SECTOR_WIDTH and not lost:
            self._hall_along += math.copysign(hall, hall * block.turned)
            self._turned_total += abs(block.turned)

    def findings(self) -> Iterator[Finding]:
        """What is wrong, if they disagree."""
        if not self.compared:
            return
        ratio, bound, n_p = self._hall_along / self._turned_total, RATIO_OFF, self._n_p
        if n_p is not None and self._turned_total > ROUNDS * n_p * math.tau:
            bound = min(bound, POLE_PAIR_OFF / n_p)
        if abs(ratio - 1.0) <= bound:
            return
        turned, hall = self._turned_total / math.tau, self._hall_along / math.tau
        cause = "Hall sensors and encoder do not turn alike"
        if n_p is not None and ratio > 0.0 and round(ratio * n_p) not in (0, n_p):
            cause = f"n_p = {n_p:g} is wrong, or sensors or encoder are ({n_p * ratio:.1f} would fit)"
        yield Finding(
            "turns",
            cause,
            (f"the encoder counts {turned:.1f} electrical revolutions, the Hall sensors {hall:.1f} in that direction",),
            "check the Hall sensors: that tells pole pairs from an encoder that slips",
        )
