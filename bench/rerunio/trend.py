"""Minima and maxima over short bins: what the plots of the last half minute show instead of every sample.

Averages would shrink the peaks that the bench is there to find. Per bin two rows come out, the minimum at the bin's
start and the maximum at its middle, so that a line through them draws the band that the signal fills.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Rows = tuple[NDArray[np.int64], NDArray[np.float32]]


class TrendBinner:
    """Cuts a run into bins of `bin_ns` nanoseconds and hands them out in lots of `lot` bins or more."""

    def __init__(self, bin_ns: int, lot: int = 10) -> None:
        self._bin_ns = bin_ns
        self._lot = lot
        self._t: list[NDArray[np.int64]] = []
        self._values: list[NDArray[np.float32]] = []

    def add(self, t_ns: NDArray[np.int64], values: NDArray[np.float32]) -> Rows | None:
        """Add samples at `t_ns`, shape (n,), of all terms, shape (terms, n).

        Returns the times, shape (2 bins,), and values, shape (terms, 2 bins), of the full bins once there are enough.
        """
        self._t.append(t_ns)
        self._values.append(values)
        if t_ns[-1] // self._bin_ns - self._t[0][0] // self._bin_ns < self._lot:
            return None
        return self._take(whole=False)

    def rest(self) -> Rows | None:
        """Return what is left, the last bin as far as it is filled."""
        return self._take(whole=True) if self._t else None

    def _take(self, whole: bool) -> Rows:
        t_ns, values = np.concatenate(self._t), np.concatenate(self._values, axis=1)
        bins = t_ns // self._bin_ns
        n = len(bins) if whole else int(np.searchsorted(bins, bins[-1]))
        self._t, self._values = ([], []) if whole else ([t_ns[n:]], [values[:, n:]])
        starts = np.concatenate([[0], np.flatnonzero(np.diff(bins[:n])) + 1])
        times = np.repeat(bins[starts] * self._bin_ns, 2)
        times[1::2] += self._bin_ns // 2
        rows = np.empty((len(values), len(times)), np.float32)
        rows[:, ::2] = np.minimum.reduceat(values[:, :n], starts, axis=1)
        rows[:, 1::2] = np.maximum.reduceat(values[:, :n], starts, axis=1)
        return times, rows
