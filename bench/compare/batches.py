"""Means of a quantity over batches of time, and how sure the difference of two runs is.

Two aligned runs are compared batch by batch, so that what both went through, a start or a step, cancels. Where the
differences of neighbouring batches are very much alike the difference is no noise about a mean, and nothing is said of
the mean but what is beyond all doubt. `bench.signal.batches` has the standard error. All quantities are in their own
unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.signal.batches import BATCHES, DRIFT, LEAST, LEAST_BATCHES, ROUNDING, batch_of, standard_error
from bench.signal.verdict import Verdict

F64 = NDArray[np.float64]

SURE = 3.0  # standard errors beyond which a difference is none of the noise
TOO_FEW, DRIFTS = "too few samples", "drifts"

VERDICT_WORDS = {Verdict.FAIL: "differs", Verdict.PASS: "same within noise", Verdict.INVALID: "unknown"}
"""Whether two runs differ in a quantity; unknown where there are too few samples, or the difference drifts."""


@dataclass(frozen=True)
class Difference:
    """Of B from A; NaN where it is unknown."""

    a: float
    b: float
    error: float
    """Standard error of b - a."""
    verdict: Verdict
    """See `VERDICT_WORDS`."""
    why: str = ""
    """Of what is unknown."""

    @property
    def value(self) -> float:
        """By how much B is larger."""
        return self.b - self.a

    @property
    def words(self) -> str:
        """The verdict, and of what is unknown why."""
        return VERDICT_WORDS[self.verdict] + (f": {self.why}" if self.why else "")


class Batches:
    """Count, sum and sum of squares of a quantity over `BATCHES` batches from tick `first` to `last`."""

    def __init__(self, first: int, last: int) -> None:
        self._first, self._length = first, last - first + 1
        self._sums: dict[str, F64] = {}

    def of(self, tick: NDArray[np.int64]) -> NDArray[np.int64]:
        """Batch 0 … BATCHES - 1 of each tick (n,)."""
        return batch_of(tick, self._first, self._length)

    def add(self, name: str, batch: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Add `values` (n,) in their batches (n,); those that are not finite count for nothing."""
        known = np.isfinite(values)
        batch, values = batch[known], values[known]
        sums = self._sums.setdefault(name, np.zeros((3, BATCHES)))
        for row, weights in zip(sums, (None, values, values * values), strict=True):
            row += np.bincount(batch, weights, BATCHES)

    def sums(self, name: str) -> F64:
        """(3, BATCHES): count, sum, sum of squares."""
        return self._sums.get(name, np.zeros((3, BATCHES)))


def of_means(a: F64, b: F64) -> Difference:
    """Difference of the means of a quantity; `a`, `b`: sums (3, BATCHES) of the runs A and B."""
    used = _used(a, b)
    if not used.any():
        return Difference(_mean(a), _mean(b), math.nan, Verdict.INVALID, TOO_FEW)
    return _judged(a[1, used] / a[0, used], b[1, used] / b[0, used])


def of_rms(a: F64, b: F64) -> Difference:
    """Difference of the root mean squares, see `of_means`."""
    return _of_roots(a, b, 0.0, 0.0)


def of_std(a: F64, b: F64) -> Difference:
    """Difference of the standard deviations about the mean of each run, see `of_means`."""
    return _of_roots(a, b, _mean(a), _mean(b))


def _of_roots(a: F64, b: F64, about_a: float, about_b: float) -> Difference:
    """sqrt(y) - sqrt(x) = (y - x) / (sqrt(x) + sqrt(y)), and so with its error, of mean squares about a number."""
    used = _used(a, b)
    squares = [
        (sums[2, used] - 2 * about * sums[1, used]) / sums[0, used] + about**2
        for sums, about in ((a, about_a), (b, about_b))
    ]
    if not used.any():
        return Difference(_root(a, about_a), _root(b, about_b), math.nan, Verdict.INVALID, TOO_FEW)
    found = _judged(*squares)
    root_a, root_b = math.sqrt(max(found.a, 0.0)), math.sqrt(max(found.b, 0.0))
    total = root_a + root_b
    return Difference(root_a, root_b, found.error / total if total else 0.0, found.verdict, found.why)


def _used(a: F64, b: F64) -> NDArray[np.bool_]:
    """Batches in which both have samples; none of them where that is too little."""
    used: NDArray[np.bool_] = (a[0] > 0) & (b[0] > 0)
    enough = used.sum() >= LEAST_BATCHES and all(sums[0, used].mean() >= LEAST for sums in (a, b))
    return used if enough else np.zeros(BATCHES, np.bool_)


def _mean(sums: F64) -> float:
    n = float(sums[0].sum())
    return float(sums[1].sum()) / n if n else math.nan


def _root(sums: F64, about: float) -> float:
    n = float(sums[0].sum())
    return math.sqrt(max(float((sums[2] - 2 * about * sums[1]).sum()) / n + about**2, 0.0)) if n else math.nan


def _judged(a: F64, b: F64) -> Difference:
    """Of means of the same batches (k,), k >= 2."""
    rest = b - a
    error, alike = standard_error(rest)
    mean_a, mean_b = float(a.mean()), float(b.mean())
    size = abs(mean_b - mean_a)
    if size > SURE * error and size > ROUNDING * max(abs(mean_a), abs(mean_b)):
        return Difference(mean_a, mean_b, error, Verdict.FAIL)
    if alike > DRIFT:
        return Difference(mean_a, mean_b, error, Verdict.INVALID, DRIFTS)
    return Difference(mean_a, mean_b, error, Verdict.PASS)
