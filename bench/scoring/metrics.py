"""Statistics of an error, and by how long an estimate is late. Pure functions of numpy arrays, which know no unit.

What cannot be told is None: a statistic of no samples, a lag without a change of speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]
Figures = dict[str, float | int | None]

PERCENTILE = 99.0
LAG_SPAN = 0.2  # the least range of speeds, as a share of the largest, from which a lag can be told
MAX_LAG = 0.05  # s, the longest that is looked for
ITERATIONS = 12


def error_figures(error: F64) -> Figures:
    """Figures of an error (n,) in its own unit.

    n: number of samples; bias: mean; std: standard deviation of the population about it; rms: about zero; max: largest
    magnitude; p99: magnitude that 99 % of the samples do not exceed.
    """
    if not len(error):
        return {"n": 0, "bias": None, "std": None, "rms": None, "max": None, "p99": None}
    size = np.abs(error)
    return {
        "n": len(error),
        "bias": float(error.mean()),
        "std": float(error.std()),
        "rms": float(np.sqrt(np.mean(error * error))),
        "max": float(size.max()),
        "p99": float(np.percentile(size, PERCENTILE)),
    }


def lag_by_speed(omega: F64, error: F64) -> float | None:
    """By how many seconds an angle is late: the slope of its error (n,) rad over the speed `omega` (n,) rad/s.

    An angle that is tau late errs by omega tau, so the slope of the straight line nearest to the samples is tau; what
    does not depend on speed, such as a misplaced zero, drops out. None where the speeds span too little.
    """
    if len(omega) < 2 or np.ptp(omega) < LAG_SPAN * np.abs(omega).max():
        return None
    x = omega - omega.mean()
    square = float(x @ x)
    return float(x @ error / square) if square > 0.0 else None


class Pair(NamedTuple):
    """A quantity and its estimate, (n,) each, `rate` samples a second without a gap; `where` (n,): those that count."""

    actual: F64
    estimate: F64
    where: Flags
    rate: float


def lag_in_time(pairs: Sequence[Pair]) -> float | None:
    """By how many seconds the estimates are late behind the actual quantities.

    The shift tau that makes the sum of (estimate(t) - actual(t - tau))^2 least, which is where their cross-correlation
    is largest; found between samples, by Gauss and Newton's iteration. None where nothing changes, and for a shift
    beyond `MAX_LAG`.
    """
    known = [(p, np.flatnonzero(p.where), np.gradient(p.actual) * p.rate) for p in pairs if np.any(p.where)]
    tau = 0.0
    for _ in range(ITERATIONS):
        square = product = 0.0
        for pair, at, slope in known:
            index = np.arange(len(slope))
            shifted = np.interp(at - tau * pair.rate, index, pair.actual)
            change = np.interp(at - tau * pair.rate, index, slope)
            square += float(change @ change)
            product += float(change @ (shifted - pair.estimate[at]))
        if square == 0.0:
            return None
        tau += product / square
        if abs(tau) > MAX_LAG:
            return None
    return tau
