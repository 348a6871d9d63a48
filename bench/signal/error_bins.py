"""Position errors put together by where they occur, over the electrical angle and over the speed, in bounded memory.

Errors are actual minus estimated, electrical degrees. Samples may come in any pieces; nothing here keeps them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.signal.percentiles import Percentiles
from bench.signal.position import Moments

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Figures = dict[str, float | int | None]

BINS = 120  # of the electrical angle
ANGLES = (np.arange(BINS) + 0.5) * 360.0 / BINS
"""The middle of each bin of the angle, degrees."""
NARROWEST = 10.0  # r/min: a bin of the speed, as long as there are few
WIDER = 5  # times: odd, so that the middles of wide bins are middles of narrow ones, and a round speed stays in one
MOST = 80  # bins of the speed
PERCENTILE = 99.0


class Errors:
    """Figures of an error in its own unit."""

    def __init__(self, counts: I64 | None = None) -> None:
        """`counts`: see `Percentiles`."""
        self._moments, self._sizes = Moments(), Percentiles(counts)

    def add(self, error: F64) -> None:
        """Add samples of it, (n,)."""
        self._moments.add(error)
        self._sizes.add(np.abs(error))

    def counted(self, moments: Moments, beyond: F64) -> None:
        """Add samples that have been counted, see `Percentiles`."""
        self._moments.merge(moments)
        self._sizes.counted(moments.n, beyond)

    @property
    def least(self) -> float:
        """See `Percentiles`."""
        return self._sizes.least

    def merge(self, other: Errors) -> None:
        """Add those that another has."""
        self._moments.merge(other._moments)
        self._sizes.merge(other._sizes)

    @property
    def n(self) -> int:
        """Number of samples."""
        return self._moments.n

    @property
    def mean(self) -> float:
        """Mean; 0 of none."""
        return self._moments.mean

    @property
    def rms(self) -> float:
        """Root of the mean square; NaN of none."""
        return self._moments.rms

    def size(self, percent: float) -> float:
        """The magnitude that `percent` of the samples do not exceed, see `Percentiles`; NaN of none."""
        return self._sizes.at(percent)

    def figures(self) -> Figures:
        """All of them by name.

        n: number of samples; bias: mean; std: standard deviation of the population about it; rms: about zero; max:
        largest magnitude; p99: magnitude that 99 % of the samples do not exceed. None where there is no sample.
        """
        m = self._moments
        values = (m.mean, m.std, self.rms, m.peak, self.size(PERCENTILE)) if m.n else (None,) * 5
        return {"n": m.n} | dict(zip(("bias", "std", "rms", "max", "p99"), values, strict=True))


def angle_bins(theta: F64, bins: int = BINS) -> I64:
    """The bin of each angle (n,) in rad, wrapped or not."""
    found: I64 = np.floor(np.mod(theta, math.tau) * (bins / math.tau)).astype(np.int64) % bins
    return found


class ErrorByAngle:
    """Errors by the electrical angle, (2, BINS) each: a shaft that turns forward, and one that turns in reverse."""

    def __init__(self) -> None:
        self.sums = np.zeros((5, 2, BINS))
        """Number, sum, sum of squares, least and largest: what `sim.observers.against` adds to."""
        self.n, self._sum, self._squares, self.lo, self.hi = self.sums
        self.lo[:], self.hi[:] = np.inf, -np.inf

    def add(self, bins: I64, error: F64, reverse: NDArray[np.bool_]) -> None:
        """Add errors at angles in these bins, (n,) each; those that are not finite count for nothing."""
        known = np.isfinite(error)
        at, error = (bins + BINS * reverse)[known], error[known]
        for row, weights in ((self.n, None), (self._sum, error), (self._squares, error * error)):
            row += np.bincount(at, weights, 2 * BINS).reshape(2, BINS)
        np.minimum.at(self.lo.reshape(-1), at, error)
        np.maximum.at(self.hi.reshape(-1), at, error)

    def merge(self, other: ErrorByAngle) -> None:
        """Add those of another."""
        self.sums[:3] += other.sums[:3]
        np.minimum(self.lo, other.lo, out=self.lo)
        np.maximum(self.hi, other.hi, out=self.hi)

    def band(self) -> tuple[F64, F64]:
        """Mean and standard deviation in each bin, by direction, (2, BINS) each; NaN where n is 0."""
        return _band(self.n, self._sum, self._squares)

    def both(self) -> tuple[F64, F64]:
        """The same of both directions together, (BINS,) each."""
        return _band(*(each.sum(axis=0) for each in (self.n, self._sum, self._squares)))

    @property
    def overall(self) -> dict[str, float]:
        """Mean, std and rms of all samples."""
        n, total, square = (float(each.sum()) for each in (self.n, self._sum, self._squares))
        mean = total / n
        return {"mean": mean, "std": math.sqrt(max(square / n - mean**2, 0.0)), "rms": math.sqrt(square / n)}


def _band(n: F64, total: F64, squares: F64) -> tuple[F64, F64]:
    with np.errstate(invalid="ignore"):
        mean = total / n
        return mean, np.sqrt(np.maximum(squares / n - mean**2, 0.0))


class BySpeed(NamedTuple):
    """Errors by bins of the speed, (k,) each, k bins in the order of their speeds."""

    rpm: F64
    """The middle of each bin; negative for a shaft that turns in reverse."""
    n: I64
    mean: F64
    rms: F64
    percentile: F64
    """Size that 95 % of the errors do not exceed."""
    width: float
    """Of a bin, r/min."""


class ErrorBySpeed:
    """Errors by estimate and bin of the speed. Bins become wider where there would be too many."""

    PERCENT = 95.0

    def __init__(self, rate: float, n_p: int) -> None:
        """`rate`: samples a second; `n_p`: electrical turns in one of the speeds that will be added."""
        self._samples_of_a_turn = 60.0 * rate / n_p  # at 1 r/min
        self.width = NARROWEST
        """Of a bin, r/min."""
        self._bins: dict[str, dict[int, Errors]] = {}

    def add(self, name: str, rpm: F64, error: F64) -> None:
        """Add errors of the estimate `name` at the speeds `rpm`, (n,) each; those that are not finite do not count."""
        known = np.isfinite(error) & np.isfinite(rpm)
        rpm, error = rpm[known], error[known]
        while True:
            keys = np.floor(rpm / self.width + 0.5).astype(np.int64)
            present = set(keys.tolist())
            if len(present.union(*self._bins.values())) <= MOST:
                break
            self._widen()
        for key in present:
            self._bins.setdefault(name, {}).setdefault(key, Errors()).add(error[keys == key])

    def _widen(self) -> None:
        self.width *= WIDER
        for name, bins in self._bins.items():
            wide: dict[int, Errors] = {}
            for key, old in bins.items():
                wide.setdefault((key + WIDER // 2) // WIDER, Errors()).merge(old)
            self._bins[name] = wide

    def result(self) -> dict[str, BySpeed]:
        """The estimates of which there are samples; a bin with less than an electrical turn is left out."""
        turn, found = self._samples_of_a_turn / self.width, {}
        for name, bins in self._bins.items():
            if keys := sorted(key for key, its in bins.items() if its.n * abs(key) >= turn):
                rows = [(k * self.width, b.n, b.mean, b.rms, b.size(self.PERCENT)) for k in keys for b in (bins[k],)]
                rpm, n, mean, rms, percentile = np.array(rows).T
                found[name] = BySpeed(rpm, n, mean, rms, percentile, self.width)
        return found
