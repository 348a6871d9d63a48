"""Percentiles of a stream of numbers, in bounded memory."""

from __future__ import annotations

import math
import threading

import numpy as np
from numpy.typing import NDArray

from sim.observers.against import BINS, BITS, LOW


class Percentiles:
    """Percentiles of any number of magnitudes, each 0 or more.

    The largest `KEPT` are kept as they are: a percentile that lies among them, which is each up to that number and
    99 % up to a hundred times as many, is that of `numpy.percentile`. All are counted in bins whose edges are 2^-8 of
    their value apart: any other percentile is the middle of its bin, within 0.2 %.
    """

    KEPT = 1 << 13

    def __init__(self, counts: NDArray[np.int64] | None = None) -> None:
        """`counts` (BINS,): where they are counted, by whoever calls `counted` instead of `add`."""
        self.n = 0
        self._lock = threading.RLock()  # one thread may ask while another adds
        self._waiting: list[NDArray[np.float64]] = []  # not looked at yet, so that few at a time cost little
        self._looked_at = 0
        self._top = np.empty(0)
        self._beyond: list[NDArray[np.float64]] = []  # counted, and perhaps among the largest
        self._many = 0  # of these
        self.least = -math.inf
        """The largest magnitude that is not to be kept as it is."""
        self._counts = counts  # none as long as all are kept

    def add(self, values: NDArray[np.float64] | float, count: int = 1) -> None:
        """Add magnitudes, shape (n,), or one, each `count` times."""
        with self._lock:
            self._waiting.append(np.repeat(values, count))
            self.n += len(self._waiting[-1])
            if self.n - self._looked_at > self.KEPT:
                self._look()

    def counted(self, n: int, beyond: NDArray[np.float64]) -> None:
        """Add n magnitudes that are among the counts already; `beyond` (m,): those of them that are beyond `least`."""
        self.n += n
        self._looked_at = self.n
        if len(beyond):
            self._beyond.append(beyond)
            self._many += len(beyond)
            if self._many > 4 * self.KEPT:
                self._look()

    def merge(self, other: Percentiles) -> None:
        """Add those that another has."""
        self._look()
        other._look()
        self.n += other.n
        self._looked_at = self.n
        if self._counts is not None or other._counts is not None:
            self._counts = self._all_counted() + other._all_counted()
        self._keep(other._top)

    def at(self, percent: float) -> float:
        """The value that `percent` of them do not exceed; NaN before the first one."""
        with self._lock:
            return self._at(percent)

    def _at(self, percent: float) -> float:
        self._look()
        if not self.n:
            return math.nan
        rank = (self.n - 1) * percent / 100.0
        below = self.n - len(self._top)
        if rank >= below:
            return float(np.interp(rank - below, np.arange(len(self._top)), np.sort(self._top)))
        assert self._counts is not None
        found = int(np.searchsorted(np.cumsum(self._counts), math.floor(rank), "right"))
        edges = np.array([found, found + 1]) + (np.array(LOW).view(np.int64) >> (52 - BITS))
        lo, hi = (edges << (52 - BITS)).view(np.float64)
        return float(0.5 * (lo + hi))

    def _look(self) -> None:
        """Count and keep those that wait."""
        values = np.concatenate([np.empty(0), *self._waiting])
        self._waiting, self._looked_at = [], self.n
        if self._counts is not None:
            self._counts += self._counted(values)
            values = values[~(values <= self.least)]  # NaN stays
        values = np.concatenate([values, *self._beyond])
        self._beyond, self._many = [], 0
        self._keep(values)

    def _keep(self, values: NDArray[np.float64]) -> None:
        whole = np.concatenate([self._top, values])
        if len(whole) > self.KEPT:
            if self._counts is None:
                self._counts = self._counted(whole)
            whole = np.partition(whole, len(whole) - self.KEPT)[-self.KEPT :]
            self.least = float(whole[0])
        self._top = whole

    def _all_counted(self) -> NDArray[np.int64]:
        return self._counted(self._top) if self._counts is None else self._counts

    def _counted(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """How many lie in each bin: the first bits of a float, taken as a whole number, rise with it."""
        shift = 52 - BITS
        bin = (np.ascontiguousarray(values).view(np.int64) >> shift) - (np.array(LOW).view(np.int64) >> shift)
        return np.bincount(np.clip(bin, 0, BINS - 1), minlength=BINS)
