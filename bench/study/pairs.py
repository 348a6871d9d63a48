"""Two designs on the same drives: which is better, and by how much."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from bench.signal.limits import Limits
from bench.study.drives import Drives
from bench.study.rows import F64
from bench.study.statistics import Estimate, Z, figure, mean, not_normal, percent, plus_minus, share, span, varies

SURE = 0.05
LEAST = 6  # pairs, below which signs and ranks cannot be sure of anything


@dataclass(frozen=True)
class YieldPair:
    """A test, or all, on the drives that passed or failed in both designs."""

    test: str
    a: str
    b: str
    n: int
    only_a: int
    """Drives that pass in `a` and fail in `b`."""
    only_b: int
    p: float
    """Of so unequal a number by chance: McNemar's exact test."""
    difference: Estimate
    """Yield of `b` less that of `a`: D. G. Bonett, R. M. Price, J. Educ. Behav. Stat. 37 (2012), 479."""
    verdict: str
    """In words."""


@dataclass(frozen=True)
class ValuePair:
    """A measurement on the drives that have it in both designs: mean over repetitions in `b` less that in `a`."""

    name: str
    a: str
    b: str
    unit: str
    n: int
    sd_of_a: float
    difference: Estimate
    """The mean, by Student's t."""
    p: float
    """Of so unequal signs and ranks by chance: Wilcoxon's signed-rank test."""
    spread: Estimate | None
    """sd in `b` over sd in `a` (E. J. G. Pitman, Biometrika 31 (1939), 9); None where values are plainly not normal."""
    better: Estimate | None
    """Share of drives further within the limits in `b`, of those that differ; None without limits."""
    verdict: str
    """In words."""


def yield_pairs(a: Drives, b: Drives) -> list[YieldPair]:
    """By test that both designs have, all of these first."""
    tests = [test for test in a.tests if test in b.tests]
    at_a, at_b = _same(a, b)
    in_b, found = b.outcomes(tests), []
    for test, in_a in a.outcomes(tests).items():
        (pass_a, fail_a), (pass_b, fail_b) = (each[at_a] for each in in_a), (each[at_b] for each in in_b[test])
        n = int(((pass_a | fail_a) & (pass_b | fail_b)).sum())
        if n:
            found.append(_yield_pair(test, a, b, n, int((pass_a & fail_b).sum()), int((fail_a & pass_b).sum())))
    return found


def _yield_pair(test: str, a: Drives, b: Drives, n: int, only_a: int, only_b: int) -> YieldPair:
    names = (a.rows.designs[a.design], b.rows.designs[b.design])
    p = float(stats.binomtest(only_a, only_a + only_b).pvalue) if only_a + only_b else 1.0
    found = yield_difference(only_a, only_b, n)
    size = Estimate(abs(found.value), *sorted((abs(found.lo), abs(found.hi))))
    points, least = (percent(value).replace("%", "points") for value in (size.value, max(-found.lo, found.hi)))
    words = f"{'higher' if found.value > 0 else 'lower'} in {names[1]} than in {names[0]}"
    seen = f"the yield is {points} {words} ({span(size, share=True).removesuffix(' %')})"
    none = f"no difference of yields seen between {names[1]} and {names[0]} (it is less than {least})"
    return YieldPair(test, *names, n, only_a, only_b, p, found, seen if p < SURE and found.certain else none)


def yield_difference(only_a: int, only_b: int, n: int) -> Estimate:
    """See `YieldPair.difference`."""
    more, less = (only_b + 1.0) / (n + 2.0), (only_a + 1.0) / (n + 2.0)
    half = Z * math.sqrt((more + less - (more - less) ** 2) / (n + 2.0))
    return Estimate((only_b - only_a) / n, max(more - less - half, -1.0), min(more - less + half, 1.0))


def _same(a: Drives, b: Drives) -> tuple[np.ndarray, np.ndarray]:
    """Where the samples are that both have."""
    _, at_a, at_b = np.intersect1d(a.sample, b.sample, assume_unique=True, return_indices=True)
    return at_a, at_b


def value_pairs(a: Drives, b: Drives, names: Sequence[str]) -> list[ValuePair]:
    """Of these measurements, those that `LEAST` drives or more have in both designs."""
    at_a, at_b = _same(a, b)
    found = []
    for name in names:
        in_a, in_b = a.each(name)[at_a], b.each(name)[at_b]
        both = np.isfinite(in_a) & np.isfinite(in_b)
        if both.sum() >= LEAST:
            found.append(_value_pair(name, a, b, in_a[both], in_b[both]))
    return found


def _value_pair(name: str, a: Drives, b: Drives, in_a: F64, in_b: F64) -> ValuePair:
    limits, names = a.rows.limits.get(name), (a.rows.designs[a.design], b.rows.designs[b.design])
    off = in_b - in_a
    off[np.abs(off) <= 1e-12 * np.abs(in_a)] = 0.0
    unit, alike, n = limits.unit if limits else "", not off.any(), len(off)
    found = Estimate(0.0, 0.0, 0.0) if alike else mean(off)
    p = 1.0 if alike else float(stats.wilcoxon(off).pvalue)
    words = f"the same in all {n} drives" if alike else _words(found, p, names[1], unit)
    better = _better(limits, in_a, in_b) if limits else None
    ratio = None if alike else spread(in_a, in_b)
    return ValuePair(name, *names, unit, n, float(in_a.std(ddof=1)), found, p, ratio, better, words)


def _words(found: Estimate, p: float, b: str, unit: str) -> str:
    way, end = "lower" if found.value < 0 else "higher", f" {unit}" if unit else ""
    if found.certain:
        words = f"{b} is {way} by {plus_minus(found)}{end}"
        return words if p < SURE else f"{words} in the mean, but signs and ranks of the drives do not show it"
    if p < SURE:
        return f"{b} is {way} in most drives, but the mean tells no difference ({span(found, unit)})"
    return f"no difference seen (it is less than {figure(max(-found.lo, found.hi))}{end})"


def spread(in_a: F64, in_b: F64) -> Estimate | None:
    """See `ValuePair.spread`."""
    if not (varies(in_a) and varies(in_b)) or not_normal(in_a) or not_normal(in_b):
        return None
    n, ratio = len(in_a), float(in_b.var() / in_a.var())
    r = float(np.corrcoef(in_a, in_b)[0, 1])
    t = float(special.stdtrit(n - 2, 0.975))
    k = 1.0 + 2.0 * max(1.0 - r * r, 0.0) * t * t / (n - 2)
    wide = k + math.sqrt(k * k - 1.0)
    return Estimate(*(math.sqrt(value) for value in (ratio, ratio / wide, ratio * wide)))


def _better(limits: Limits, in_a: F64, in_b: F64) -> Estimate | None:
    lo, hi = (-math.inf if limits.lo is None else limits.lo), (math.inf if limits.hi is None else limits.hi)
    if math.isinf(lo) and math.isinf(hi):
        return None
    margin_a, margin_b = (np.minimum(values - lo, hi - values) for values in (in_a, in_b))
    better, n = int((margin_b > margin_a).sum()), int((margin_b != margin_a).sum())
    return share(better, n) if n else None
