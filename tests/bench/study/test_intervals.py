"""Intervals of shares, quantiles, distances and means: against tables, scipy's tests, formulas, and by coverage."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.stats import qmc

from bench.study.statistics import (
    Estimate,
    beyond,
    clopper_pearson,
    cp,
    cpk,
    distance,
    drives_for,
    mean,
    not_normal,
    percent,
    plus_minus,
    quantile,
    share,
    span,
)


@pytest.mark.parametrize(("k", "n", "lo", "hi"), [  # C. J. Clopper, E. S. Pearson, Biometrika 26 (1934)
    (0, 10, 0.0, 0.3085), (1, 10, 0.0025, 0.4450), (5, 10, 0.1871, 0.8129), (10, 10, 0.6915, 1.0), (0, 1, 0.0, 0.975),
    (950, 1000, 0.9346, 0.9627),
])  # fmt: skip
def test_shares_have_the_intervals_of_the_table(k: int, n: int, lo: float, hi: float) -> None:
    assert share(k, n) == pytest.approx((k / n, lo, hi), abs=6e-5)


@given(n=st.integers(1, 100_000), part=st.floats(0, 1))
def test_shares_have_the_intervals_of_scipy_and_shrink_with_n(n: int, part: float) -> None:
    k = round(part * n)
    exact = stats.binomtest(k, n).proportion_ci(0.95, "exact")
    assert share(k, n)[1:] == pytest.approx((exact.low, exact.high), abs=1e-9)
    wider, narrower = share(k, n), share(4 * k, 4 * n)
    assert narrower.hi - narrower.lo < wider.hi - wider.lo
    lo, hi = clopper_pearson([k, 0], [n, n])
    assert (lo[0], hi[0], lo[1]) == (*share(k, n)[1:], 0.0)


def test_a_quantile_is_within_its_interval_whatever_the_distribution() -> None:
    random = np.random.default_rng(3)
    for draw, inverse in ((random.standard_exponential, stats.expon), (random.standard_cauchy, stats.cauchy)):
        found = [quantile(draw(500), 0.99) for _ in range(1500)]
        truth = float(inverse.ppf(0.99))
        below, above = np.mean([(each.lo > truth, each.hi < truth) for each in found], axis=0)
        assert below <= 0.035
        assert above <= 0.035
        assert below + above > 0.0  # it is no wider than it must be by far


@pytest.mark.parametrize(("n", "known"), [(367, False), (368, True)])
def test_the_upper_end_of_a_quantile_takes_enough_drives(n: int, known: bool) -> None:
    assert drives_for(0.99) == 368  # 0.99 ** 368 = 0.0248
    found = quantile(np.arange(float(n)), 0.99)
    assert math.isfinite(found.hi) is known
    assert found.lo < found.value <= n - 1


@pytest.mark.parametrize(("n", "d"), [(8, 3.0), (8, 0.3), (30, -1.0), (200, 3.0)])
def test_the_distance_of_a_limit_is_within_its_interval(n: int, d: float) -> None:
    values = np.random.default_rng(n).normal(size=(2000, n))
    limit = d
    found = [distance((limit - row.mean()) / row.std(ddof=1), n) for row in values]
    assert np.mean([each.lo <= d <= each.hi for each in found]) == pytest.approx(0.95, abs=0.016)
    if n <= 60:  # the noncentral t distribution, by scipy's own
        root, (value, lo, hi) = math.sqrt(n), found[0]
        assert stats.nct.cdf(value * root, n - 1, lo * root) == pytest.approx(0.975, abs=1e-4)
        assert stats.nct.cdf(value * root, n - 1, hi * root) == pytest.approx(0.025, abs=1e-4)


def test_cpk_of_two_sides_is_bissells() -> None:
    """Bissell's formula by hand, and by the coverage that it is known for, of a mean off the middle."""
    assert cpk(1.0, 100) == pytest.approx((1.0, 1 - 1.96 * 0.0785, 1 + 1.96 * 0.0785), abs=1e-3)
    values = np.random.default_rng(5).normal(0.5, 1.0, (2000, 50))
    off, sd = values.mean(axis=1), values.std(axis=1, ddof=1)
    found = [cpk(min(4.0 - m, m + 4.0) / (3.0 * s), 50) for m, s in zip(off, sd, strict=True)]
    assert np.mean([each.lo <= 3.5 / 3.0 <= each.hi for each in found]) == pytest.approx(0.95, abs=0.016)
    found = [cp(8.0 / (6.0 * s), 50) for s in sd]
    assert np.mean([each.lo <= 8.0 / 6.0 <= each.hi for each in found]) == pytest.approx(0.95, abs=0.016)


def test_means_and_shares_by_theory() -> None:
    values = np.random.default_rng(7).normal(3.0, 2.0, 40)
    exact = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert mean(values) == pytest.approx((values.mean(), exact.low, exact.high))
    assert beyond(Estimate(3.0, 2.0, 4.0)) == pytest.approx((0.00135, 3.167e-5, 0.02275), rel=1e-3)


def test_only_what_is_plainly_not_normal_is_called_so() -> None:
    random = np.random.default_rng(9)
    for n in (8, 50, 500):
        assert np.mean([bool(not_normal(random.normal(size=n))) for _ in range(400)]) < 0.02
    assert not not_normal(random.standard_t(30, 20_000))  # the test sees it, and it does not matter
    assert not_normal(random.standard_exponential(100)).startswith("skew")
    assert "kurtosis -1.2" in not_normal(random.uniform(size=2000))
    assert not_normal(random.integers(0, 3, 100).astype(float)) == "3 different values only"


@pytest.mark.parametrize(("words", "wanted"), [
    ([percent(share) for share in (0.0, 1e-9, 0.00001, 0.934)], ["0 %", "< 0.0001 %", "0.0010 %", "93.4 %"]),
    ([percent(share) for share in (0.9963, 0.9999, 1.0, math.nan)], ["99.63 %", "99.990 %", "100 %", "–"]),
    (span(Estimate(1, 0.5, math.inf), "deg"), "at least 0.5 deg"),
    (span(Estimate(1, -math.inf, 2)), "at most 2"),
    (span(Estimate(1, -math.inf, math.inf)), "not known"),
    (span(Estimate(0.5, 0.25, 0.75), share=True), "25.0 … 75.0 %"),
    (plus_minus(Estimate(-0.08054, -0.10654, -0.05454)), "0.081 ± 0.026"),
    (plus_minus(Estimate(1234.0, 1000.0, 1468.0)), "1234 ± 234"),
])  # fmt: skip
def test_numbers_in_words(words: object, wanted: object) -> None:
    assert words == wanted


@pytest.mark.parametrize("draw", [qmc.Sobol, qmc.LatinHypercube])
def test_of_drives_that_are_drawn_evenly_intervals_are_wide_enough(draw: type[qmc.QMCEngine]) -> None:
    """The report says so; the figure grows with each of its four inputs."""
    weights = np.array([1.0, 0.7, 0.5, 0.3])
    limit = stats.norm.ppf(0.9, scale=np.sqrt((weights**2).sum()))
    found = []
    for seed in range(150):
        values = stats.norm.ppf(draw(4, seed=seed).random(128)) @ weights
        found.append((share(int((values <= limit).sum()), 128), quantile(values, 0.9)))
    assert np.mean([each.lo <= 0.9 <= each.hi for each, _ in found]) >= 0.95
    assert np.mean([each.lo <= limit <= each.hi for _, each in found]) >= 0.95
