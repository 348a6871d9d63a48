"""False pulses on the Hall inputs: how many, how wide, on which, and whether they come with the current.

What couples in from the power stage grows with the current, so time is cut into bins of the current's size, each of the
same number of samples, and the pulses in each are counted. Nothing here says whether there are too many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.signal.trace import Trace

BINS = 4
SURE = 3.0
"""Standard deviations by which the rates in the halves of higher and lower current must differ to be told apart."""


@dataclass(frozen=True)
class CurrentBin:
    """A range of the current, A, and the pulses in it."""

    lo: float
    hi: float
    n: int
    rate: float
    """1/s."""


@dataclass(frozen=True)
class Pulses:
    """The false pulses of a trace."""

    n: int
    rate: float
    """1/s over all of the recorded time."""
    by_input: tuple[int, ...]
    widest: float
    """s; NaN for none."""
    bins: tuple[CurrentBin, ...]
    """From the lowest current to the highest; empty where no current was recorded, or it hardly changed."""
    excess: float
    """Pulses in the half of higher current above those in the half of lower, in standard deviations; NaN for none."""

    @property
    def with_current(self) -> bool:
        """Whether they come with the current, beyond doubt."""
        return self.excess > SURE


def count(trace: Trace) -> Pulses:
    """Count the false pulses."""
    pulses = trace.pulses
    n = len(pulses.input)
    bins: list[CurrentBin] = []
    excess = math.nan
    if np.isfinite(trace.some.current).all():
        bounds = np.unique(np.quantile(trace.some.current, np.linspace(0.0, 1.0, BINS + 1)))
        if len(bounds) == BINS + 1:
            per_bin = np.bincount(
                np.clip(np.searchsorted(bounds, pulses.current, "right") - 1, 0, BINS - 1), minlength=BINS
            )
            time = trace.seconds / BINS
            bins = [
                CurrentBin(float(lo), float(hi), int(k), int(k) / time)
                for lo, hi, k in zip(bounds[:-1], bounds[1:], per_bin, strict=True)
            ]
            low, high = int(per_bin[: BINS // 2].sum()), int(per_bin[BINS // 2 :].sum())
            excess = (high - low) / math.sqrt(high + low) if high + low else math.nan
    return Pulses(
        n,
        n / trace.seconds,
        tuple(np.bincount(pulses.input, minlength=3).tolist()),
        float(pulses.width.max()) if n else math.nan,
        tuple(bins),
        excess,
    )
