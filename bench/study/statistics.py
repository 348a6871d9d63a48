"""Estimates with intervals of 95 %: shares, quantiles, means, distances in standard deviations. Pure numerics."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats

F64 = NDArray[np.float64]
TAIL = 0.025
"""On each side of an interval."""
Z = float(special.ndtri(1.0 - TAIL))
EXACT = 60
"""Values up to which the distance in standard deviations has its exact interval; beyond, the normal one is as good."""
ANDERSON_DARLING = 1.035
"""Of normal data with unknown mean and sd, exceeded in 1 % (M. A. Stephens, J. Amer. Stat. Assoc. 69 (1974), 730)."""
SKEW, KURTOSIS = 0.5, 1.0
"""From which on data that are not normal are so plainly: theory of the normal tail is then of no use."""


class Estimate(NamedTuple):
    """A figure and its interval of 95 %; an end that is not known is infinite."""

    value: float
    lo: float
    hi: float

    @property
    def certain(self) -> bool:
        """Whether the interval excludes 0."""
        return self.lo > 0.0 or self.hi < 0.0


def around(value: float, half: float) -> Estimate:
    """`value` ± `half`."""
    return Estimate(value, value - half, value + half)


def clopper_pearson(k: ArrayLike, n: ArrayLike) -> tuple[F64, F64]:
    """Exact interval of the share of which `k` of `n` > 0 were seen; arrays of one shape, or numbers."""
    k, n = np.asarray(k, float), np.asarray(n, float)
    lo = np.where(k > 0, special.betaincinv(np.maximum(k, 1.0), n - k + 1.0, TAIL), 0.0)
    hi = np.where(k < n, special.betaincinv(k + 1.0, np.maximum(n - k, 1.0), 1.0 - TAIL), 1.0)
    return lo, hi


def share(k: int, n: int) -> Estimate:
    """Of `k` in `n` > 0."""
    lo, hi = clopper_pearson(k, n)
    return Estimate(k / n, float(lo), float(hi))


def quantile(values: F64, p: float) -> Estimate:
    """What the share `p` lies at or below, by order statistics, whatever the distribution; infinite: n is too small.

    H. A. David, Order Statistics, 2.5.
    """
    ordered, n = np.sort(values), len(values)
    first, last = int(stats.binom.ppf(TAIL, n, p)), int(stats.binom.ppf(1.0 - TAIL, n, p)) + 1
    return Estimate(
        float(ordered[max(math.ceil(p * n - 1e-9), 1) - 1]),
        float(ordered[first - 1]) if first >= 1 else -math.inf,
        float(ordered[last - 1]) if last <= n else math.inf,
    )


def drives_for(p: float) -> int:
    """How many values it takes for `quantile` to have an upper end."""
    return math.ceil(math.log(TAIL) / math.log(p))


def mean(values: F64) -> Estimate:
    """By Student's t; of n >= 2."""
    n = len(values)
    half = float(special.stdtrit(n - 1, 1.0 - TAIL)) * float(values.std(ddof=1)) / math.sqrt(n)
    return around(float(values.mean()), half)


def distance(d: float, n: int) -> Estimate:
    """How many sd a limit is from the mean, which lies `d` sample sd away in n >= 2 normal values.

    Exact by the noncentral t distribution up to `EXACT` values, then normal with the variance 1/n + d²/(2(n-1)). A
    third of it is the Cpk of one side (A. F. Bissell, Appl. Statist. 39 (1990), 331).
    """
    if n > EXACT:
        return around(d, Z * math.sqrt(1.0 / n + d * d / (2.0 * (n - 1))))
    root = math.sqrt(n)
    ends = [float(special.nctdtrinc(n - 1, p, abs(d) * root)) / root for p in (1.0 - TAIL, TAIL)]
    return Estimate(d, *ends) if d >= 0.0 else Estimate(d, -ends[1], -ends[0])


def cpk(value: float, n: int) -> Estimate:
    """Of limits on both sides: Bissell's normal interval, as above, (8)."""
    return around(value, Z * math.sqrt(1.0 / (9.0 * n) + value * value / (2.0 * (n - 1))))


def cp(value: float, n: int) -> Estimate:
    """Exact, by the chi-squared distribution of the variance."""
    lo, hi = (math.sqrt(float(stats.chi2.ppf(p, n - 1)) / (n - 1)) for p in (TAIL, 1.0 - TAIL))
    return Estimate(value, value * lo, value * hi)


def beyond(away: Estimate) -> Estimate:
    """The share of a normal population beyond a limit so many sd away."""
    return Estimate(*(float(special.ndtr(-d)) for d in (away.value, away.hi, away.lo)))


def not_normal(values: F64) -> str:
    """Why theory of the normal distribution must not be used on values that vary; empty where nothing speaks against.

    By Anderson and Darling's test at 1 %, where skew or kurtosis is large as well: of ten thousand values every
    distribution fails the test.
    """
    n, kinds = len(values), len(np.unique(values))
    if n >= 30 and kinds < 10:
        return f"{kinds} different values only"
    if n < 8:
        return ""
    z = np.sort((values - values.mean()) / values.std(ddof=1))
    weights = 2.0 * np.arange(1, n + 1) - 1.0
    statistic = -n - float(np.mean(weights * (special.log_ndtr(z) + special.log_ndtr(-z[::-1]))))
    skew, kurtosis = float(stats.skew(z)), float(stats.kurtosis(z))
    found = statistic * (1.0 + 0.75 / n + 2.25 / n**2) > ANDERSON_DARLING
    plainly = found and (abs(skew) > SKEW or abs(kurtosis) > KURTOSIS)
    return f"skew {skew:.2g}, kurtosis {kurtosis:.2g}" if plainly else ""


def varies(values: F64) -> bool:
    """Whether they differ by more than rounding does."""
    return len(values) > 1 and float(np.ptp(values)) > 1e-12 * float(np.abs(values).max())


def percent(value: float) -> str:
    """A share in words, with digits enough not to be 0 or 100 where it is not; an unknown one is an en dash."""
    near = min(value, 1.0 - value)
    if not math.isfinite(value) or 0.0 < near < 1e-6:
        return "–" if math.isnan(near) else "< 0.0001 %" if value < 0.5 else "> 99.9999 %"
    digits = 0 if near <= 0.0 else 1 if near >= 0.01 else 2 if near >= 5e-4 else 3 if near >= 5e-5 else 4
    return f"{100.0 * value:.{digits}f} %"


def figure(value: float | None) -> str:
    """Four digits; an unknown one is an en dash."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


def plus_minus(found: Estimate) -> str:
    """Size and half the interval, to two digits of the latter."""
    half = (found.hi - found.lo) / 2.0
    digits = max(1 - math.floor(math.log10(half)), 0) if half > 0.0 else 4
    form, rest = (f".{digits}f", f".{digits}f") if digits < 8 else (".3g", ".2g")
    return f"{abs(found.value):{form}} ± {half:{rest}}"


def span(found: Estimate, unit: str = "", share: bool = False) -> str:
    """The interval in words; open where an end is not known."""
    lo, hi = (percent(end) if share else figure(end) for end in found[1:])
    unit = f" {unit}" if unit else ""
    if math.isinf(found.hi):
        return f"at least {lo}{unit}" if math.isfinite(found.lo) else "not known"
    return f"{lo.removesuffix(' %')} … {hi}{unit}" if math.isfinite(found.lo) else f"at most {hi}{unit}"
