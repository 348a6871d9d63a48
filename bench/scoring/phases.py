"""When the shaft stands, starts, runs steadily, changes its speed or turns round, told from the encoder's angle alone.

The thresholds stand here once; docs/score.md says what they mean. Times are centred on the sample, so nothing here
lags.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bench.analysis.units import RPM

F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]

SPEED_WINDOW = 0.01  # s over which the speed is the difference of the angle
SLOPE_WINDOW = 0.04  # s over which the slope is the difference of the speed
MOVING_RPM = 10.0  # r/min above which the shaft moves
TRANSIENT_RPM_S = 500.0  # (r/min)/s above which the speed changes
AFTER = 0.1  # s after such a change that count as transient too
STAND = 0.1  # s without motion after which motion is a start
BEFORE_START, START_UP = 0.01, 0.3  # s before and after the start that count as start-up
REVERSAL = 0.1  # s before and after zero speed that count as reversal
SPEED_EDGES = (0.0, 75.0, 150.0, 350.0, 750.0, 1500.0, 2500.0, 4000.0, 7500.0, 15000.0, 35000.0, 75000.0)
"""r/min; none at a round speed, so that one that is held falls into one bin."""


@dataclass(frozen=True)
class Phases:
    """Where, of n samples, the shaft does what: masks (n,). Those but `moving` exclude each other."""

    moving: Flags
    steady: Flags
    transient: Flags
    start_up: Flags
    reversal: Flags
    starts: int
    reversals: int


def speed_of(theta: F64, rate: float) -> F64:
    """Speed (n,), rad/s, of the angle `theta` (n,) rad, wrapped or not, at `rate` samples a second without a gap."""
    return _difference(np.unwrap(theta), SPEED_WINDOW, rate)


def phases_of(omega: F64, usable: Flags, rate: float, pole_pairs: int) -> Phases:
    """Phases of the electrical speed `omega` (n,) rad/s, `rate` a second without a gap, where `usable` (n,) is set."""
    rpm = omega / (RPM * pole_pairs)
    n = len(rpm)
    direction = np.where(np.abs(rpm) > MOVING_RPM, np.sign(rpm), 0.0).astype(np.int64)
    start_up, reversal = np.zeros(n, bool), np.zeros(n, bool)
    starts = reversals = 0
    runs = np.concatenate([[0], np.flatnonzero(np.diff(direction)) + 1, [n]])
    last = 0  # direction of the last motion; 0: it has stood since
    for begin, end in pairwise(runs.tolist()):
        now = int(direction[begin])
        if now == 0:
            if begin == 0 or end - begin >= STAND * rate:  # before the first sample it stood, for all that is known
                last = 0
                if end < n and usable[end]:
                    starts += 1
                    start_up[_span(end, BEFORE_START * rate, START_UP * rate, n)] = True
            continue
        if last and now != last and usable[begin]:
            reversals += 1
            reversal[_span(begin, REVERSAL * rate, REVERSAL * rate, n)] = True
        last = now
    moving = (direction != 0) & usable
    start_up &= usable
    reversal &= usable & ~start_up
    changing = _held(np.abs(_difference(rpm, SLOPE_WINDOW, rate)) > TRANSIENT_RPM_S, AFTER * rate)
    free = moving & ~start_up & ~reversal
    return Phases(moving, free & ~changing, free & changing, start_up, reversal, starts, reversals)


def speed_bins(rpm: F64) -> dict[str, NDArray[np.int64]]:
    """Positions of the speeds `rpm` (n,) by bin, as "350_to_750" or "-750_to_-350"; bins without samples are left
    out.
    """
    size = np.digitize(np.abs(rpm), SPEED_EDGES) - 1
    found: dict[str, NDArray[np.int64]] = {}
    for sign in (-1, 1):
        bins = sorted(set(np.unique(size[rpm * sign > 0]).tolist()), reverse=sign < 0)
        for k in bins:
            lo, hi = (f"{SPEED_EDGES[j]:g}" if j < len(SPEED_EDGES) else "up" for j in (k, k + 1))
            name = f"{lo}_to_{hi}" if sign > 0 else f"-{hi}_to_-{lo}"
            found[name] = np.flatnonzero((size == k) & (rpm * sign > 0))
    return found


def _difference(values: F64, window: float, rate: float) -> F64:
    """Central difference quotient over `window` s; one-sided at the ends."""
    n, half = len(values), max(1, round(0.5 * window * rate))
    index = np.arange(n)
    after, before = np.minimum(index + half, n - 1), np.maximum(index - half, 0)
    quotient: F64 = (values[after] - values[before]) * rate / np.maximum(after - before, 1)
    return quotient


def _held(flags: Flags, samples: float) -> Flags:
    """Also set for `samples` after each that is set."""
    index = np.arange(len(flags))
    last = np.maximum.accumulate(np.where(flags, index, -len(flags) - round(samples)))
    held: Flags = index - last <= samples
    return held


def _span(at: int, before: float, after: float, n: int) -> slice:
    return slice(max(0, at - round(before)), min(n, at + round(after)))
