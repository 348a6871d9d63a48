"""How sure a mean or a slope is, by its scatter over batches of time.

Samples that follow each other are alike, so their scatter says little about that of their mean. Means over long
batches are nearly independent: their scatter does. Where neighbouring batches are still alike, the standard error is
widened as that of a first-order autoregression.

Batch means: Law, Simulation Modeling and Analysis, 5th ed. 2015, ch. 9.5.3. Jackknife over batches: Efron and
Tibshirani, An Introduction to the Bootstrap, 1993, ch. 11. Nothing here knows a unit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

BATCHES = 24
LEAST_BATCHES = 8  # that have samples
LEAST = 10  # samples of a batch, in the mean
MOST_ALIKE = 0.9  # correlation of neighbouring batches that is believed at most
DRIFT = 0.5  # correlation beyond which the scatter is no noise: 1 in 300 of white noise has it by chance
ROUNDING = 1e-9  # of the largest: no scatter
QUANTILES = (12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622)
"""Two-sided, of Student's t at 95 %, with 1 to 9 degrees of freedom."""
NORMAL = 1.959964


def batch_of(tick: NDArray[np.int64], first: int, length: int) -> NDArray[np.int64]:
    """Batch 0 … BATCHES - 1 of each tick (n,), of `length` ticks from `first` on."""
    return (tick - first) * BATCHES // length


def standard_error(batches: F64, fitted: float = 0.0) -> tuple[float, float]:
    """Of the mean of `batches` (k,), wider where neighbours are alike; and their correlation, 0 where it is below.

    `fitted`: what a fit has taken from that correlation, about the number of its coefficients over k.
    """
    k = len(batches)
    rest = batches - batches.mean()
    square = float(rest @ rest)
    if square <= k * (ROUNDING * float(np.abs(batches).max())) ** 2:
        return 0.0, 0.0
    alike = min(max(float(rest[1:] @ rest[:-1]) / square + fitted, 0.0), MOST_ALIKE)
    return math.sqrt(square / (k - 1) / k * (1 + alike) / (1 - alike)), alike


def slope(sums: F64) -> F64:
    """Of least-squares lines; `sums` (5, …): number of samples, and their sums of x, y, x x and x y. NaN for one x."""
    n, x, y, xx, xy = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        found: F64 = (n * xy - x * y) / (n * xx - x * x)
    return found


def slope_error(sums: F64, fitted: float = 0.0) -> tuple[float, float]:
    """Standard error of the slope through all samples of k >= 3 batches, and how alike neighbours are.

    `sums` (5, k) as in `slope`. It is that of the batches' pseudo-values: what each adds to the slope of the others.
    It holds for noise that is forgotten within a batch: a slower one makes a slope of its own.
    """
    k = sums.shape[1]
    total = sums.sum(axis=1)
    pseudo: F64 = k * slope(total) - (k - 1) * slope(total[:, None] - sums)
    return standard_error(pseudo, fitted)


def student(freedom: int) -> float:
    """Two-sided quantile of Student's t at 95 %, with `freedom` >= 1 degrees, to 1e-4 (scipy takes 0.3 s to import).

    The expansion is 26.7.5 of Abramowitz and Stegun, Handbook of Mathematical Functions.
    """
    if freedom <= len(QUANTILES):
        return QUANTILES[freedom - 1]
    z, n = NORMAL, float(freedom)
    terms = (z**3 + z) / 4.0, (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0
    return z + terms[0] / n + terms[1] / n**2 + (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / (384.0 * n**3)
