"""Percentiles of a stream of numbers, in bounded memory."""

from __future__ import annotations

import math

import numpy as np


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
