"""What returned on the Hall inputs: bounces at edges, pulses elsewhere, and whether these come with the current.

What couples in from the power stage grows with the current, so time is cut into bins of the current's size, each of the
same number of samples, and the pulses in each are counted. Nothing here says whether there are too many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.signal.hall_inputs import CHANCE, NEAR, Bools, Inputs, Returns, by_chance
from bench.signal.trace import SLOW, Floats, Trace

BINS = 4
SURE = 3.0
"""Standard deviations by which the rates in the halves of higher and lower current must differ to be told apart,"""
APART = 1.5
"""and by how much, times: an interference that comes with the current is not there without it."""
ONE_WAY = 0.1
"""Share of the other level, below which returns are to one level only."""

FEW, LIKELY = 5, 0.05
"""Returns of an input, below which it is taken to do what all do; and the chance of so many at edges, above which they
lie anywhere: between that and `CHANCE` those at edges may be either."""


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
    """The pulses of a trace that lie anywhere, and the bounces, which lie at edges."""

    n: int
    rate: float
    """1/s over all of the recorded time."""
    by_input: tuple[int, ...]
    widest: float
    """s; NaN for none."""
    bounces: tuple[int, ...]
    """By input."""
    sure: tuple[bool, ...]
    """Whether those of an input are bounces beyond doubt: else so many may lie at edges by chance."""
    bounce_width: tuple[float, float]
    """s, of the middle and of the widest bounce; NaN for none."""
    bins: tuple[CurrentBin, ...]
    """From the lowest current to the highest; empty where no current was recorded, or it hardly changed."""
    excess: float
    """Pulses in the half of higher current above those in the half of lower, in standard deviations; NaN for none."""

    @property
    def with_current(self) -> bool:
        """Whether they come with the current, beyond doubt."""
        return bool(self.bins) and self.excess > SURE and self.bins[-1].rate > APART * self.bins[0].rate


def count(trace: Trace, inputs: Inputs) -> Pulses:
    """Count what returned within a small part of a sector."""
    returns = inputs.returns
    bounces, pulses, chance = kinds(returns)
    n = int(np.count_nonzero(pulses))
    bins: list[CurrentBin] = []
    excess = math.nan
    turns = np.abs(trace.some.omega) >= SLOW if trace.encoder else np.ones(len(trace.some.current), bool)
    current = trace.some.current[turns]  # where it stands nothing is counted
    if len(current) and np.isfinite(current).all() and np.isfinite(returns.current).all():
        bounds = np.unique(np.quantile(current, np.linspace(0.0, 1.0, BINS + 1)))
        if len(bounds) == BINS + 1:
            at = np.clip(np.searchsorted(bounds, returns.current[pulses], "right") - 1, 0, BINS - 1)
            per_bin = np.bincount(at, minlength=BINS)
            time = trace.measured * len(current) / len(turns) / BINS
            bins = [
                CurrentBin(float(lo), float(hi), int(k), int(k) / time)
                for lo, hi, k in zip(bounds[:-1], bounds[1:], per_bin, strict=True)
            ]
            low, high = int(per_bin[: BINS // 2].sum()), int(per_bin[BINS // 2 :].sum())
            excess = (high - low) / math.sqrt(high + low) if high + low else math.nan
    width = returns.width[bounces]
    return Pulses(
        n,
        n / trace.measured,
        _by_input(returns, pulses),
        float(returns.width[pulses].max()) if n else math.nan,
        _by_input(returns, bounces),
        tuple((chance <= CHANCE).tolist()),
        (float(np.median(width)), float(width.max())) if len(width) else (math.nan, math.nan),
        tuple(bins),
        excess,
    )


def kinds(returns: Returns) -> tuple[Bools, Bools, Floats]:
    """Which of them are bounces, or may be, which are pulses; and by input the chance that pulses look so."""
    short, chance = returns.travel < NEAR, _by_chance(returns)
    bounces = short & returns.at_edge & (chance < LIKELY)[returns.input]
    return bounces, short & ~bounces, chance


def _by_chance(returns: Returns) -> Floats:
    """By input, the chance with which so many lie at edges: after one the old level comes back, to 0 and to 1.

    What always returns from one level, and not only at edges, is a contact. An input with few returns does what all do.
    """
    found, short = np.ones(3), returns.travel < NEAR
    for number in range(3):
        own = short & (returns.input == number)
        if np.count_nonzero(own) < FEW:
            own = short
        n, near, high = (int(np.count_nonzero(own & which)) for which in (own, returns.at_edge, returns.high))
        if ONE_WAY * n < high < (1.0 - ONE_WAY) * n or near > (1.0 - 2.0 * ONE_WAY) * n:
            found[number] = by_chance(returns, own)
    return found


def _by_input(returns: Returns, which: Bools) -> tuple[int, ...]:
    return tuple(np.bincount(returns.input[which], minlength=3).tolist())
