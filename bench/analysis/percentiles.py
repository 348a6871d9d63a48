"""Percentiles of a stream of numbers, in bounded memory."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


class Percentiles:
    """Percentiles of a stream of positive numbers, from a histogram with logarithmic bins 2 % apart.

    Reported values are the upper edges of their bins: never too small, at most 2 % too large.
    """

    _LOW = 1e-6
    _RATIO = 1.02
    _BINS = 1200

    def __init__(self) -> None:
        self._counts = np.zeros(self._BINS, dtype=np.int64)
        self._edges = self._LOW * self._RATIO ** np.arange(1, self._BINS + 1)

    def add(self, value: float, count: int = 1) -> None:
        """Add `value`, `count` times."""
        self._counts[min(int(np.searchsorted(self._edges, value)), self._BINS - 1)] += count

    @property
    def n(self) -> int:
        """How many numbers were added."""
        return int(self._counts.sum())

    def at(self, percent: float) -> float:
        """The value that `percent` of the numbers do not exceed; NaN before the first one."""
        if self.n == 0:
            return math.nan
        rank = math.ceil(self.n * percent / 100)
        return float(self._edges[int(np.searchsorted(np.cumsum(self._counts), max(rank, 1)))])


class Sizes:
    """Percentiles of any number of magnitudes, each 0 or more, in bounded memory.

    The largest `KEPT` are kept as they are: a percentile that lies among them, which is each up to that number and
    99 % up to a hundred times as many, is that of `numpy.percentile`. All are counted in bins whose edges are 2^-8 of
    their value apart: any other percentile is the middle of its bin, within 0.2 %.
    """

    KEPT = 1 << 13
    _BITS = 8  # of a float's mantissa, that tell bins apart
    _LOW, _OCTAVES = 2.0**-24, 44

    def __init__(self) -> None:
        self.n = 0
        self._top = np.empty(0)
        self._counts: NDArray[np.int64] | None = None  # none as long as all are kept

    def add(self, sizes: NDArray[np.float64]) -> None:
        """Add magnitudes, shape (n,)."""
        self.n += len(sizes)
        if self._counts is not None:
            self._counts += self._counted(sizes)
            sizes = sizes[~(sizes <= self._top.min())]  # NaN stays
        self._keep(sizes)

    def merge(self, other: Sizes) -> None:
        """Add those that another has."""
        self.n += other.n
        if self._counts is not None or other._counts is not None:
            self._counts = self._all_counted() + other._all_counted()
        self._keep(other._top)

    def at(self, percent: float) -> float:
        """The value that `percent` of them do not exceed; NaN before the first one."""
        if not self.n:
            return math.nan
        rank = (self.n - 1) * percent / 100.0
        below = self.n - len(self._top)
        if rank >= below:
            return float(np.interp(rank - below, np.arange(len(self._top)), np.sort(self._top)))
        assert self._counts is not None
        found = int(np.searchsorted(np.cumsum(self._counts), math.floor(rank), "right"))
        edges = np.array([found, found + 1]) + (np.array(self._LOW).view(np.int64) >> (52 - self._BITS))
        lo, hi = (edges << (52 - self._BITS)).view(np.float64)
        return float(0.5 * (lo + hi))

    def _keep(self, sizes: NDArray[np.float64]) -> None:
        whole = np.concatenate([self._top, sizes])
        if len(whole) > self.KEPT:
            if self._counts is None:
                self._counts = self._counted(whole)
            whole = np.partition(whole, len(whole) - self.KEPT)[-self.KEPT :]
        self._top = whole

    def _all_counted(self) -> NDArray[np.int64]:
        return self._counted(self._top) if self._counts is None else self._counts

    def _counted(self, sizes: NDArray[np.float64]) -> NDArray[np.int64]:
        """How many lie in each bin: the first bits of a float, taken as a whole number, rise with it."""
        shift, bins = 52 - self._BITS, self._OCTAVES << self._BITS
        bin = (np.ascontiguousarray(sizes).view(np.int64) >> shift) - (np.array(self._LOW).view(np.int64) >> shift)
        return np.bincount(np.clip(bin, 0, bins - 1), minlength=bins)
