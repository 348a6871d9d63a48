"""Minima and maxima over short bins: what the plots of the last half minute show instead of every sample.

Averages would shrink the peaks that the bench is there to find. Per bin two rows come out, the minimum at the bin's
start and the maximum at its middle, so that a line through them draws the band that the signal fills. References are
the exception: their bands would hide what follows them, so both rows hold the mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Rows = tuple[NDArray[np.int64], NDArray[np.float32]]


class TrendBinner:
    """Cuts a run into bins of `bin_ns` nanoseconds and hands them out in lots of `lot` bins or more.

    The first `bands` terms come out as minimum and maximum, the others as mean.
    """

    def __init__(self, bin_ns: int, bands: int, lot: int) -> None:
        self._bin_ns = bin_ns
        self._bands = bands
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
        bands, others = values[: self._bands, :n], values[self._bands :, :n]
        rows = np.empty((len(values), len(times)), np.float32)
        rows[: self._bands, ::2] = np.minimum.reduceat(bands, starts, axis=1)
        rows[: self._bands, 1::2] = np.maximum.reduceat(bands, starts, axis=1)
        means = np.add.reduceat(others, starts, axis=1) / np.diff(starts, append=n).astype(np.float32)
        rows[self._bands :] = np.repeat(means, 2, axis=1)
        return times, rows
