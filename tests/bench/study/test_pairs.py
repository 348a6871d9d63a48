"""Two designs on the same drives: tests and intervals against scipy, exact coverage and the truth they were made of."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bench.signal.limits import Limits
from bench.study.answers import Answers, answer, lines
from bench.study.pairs import spread, yield_difference
from tests.bench.study.made import about, picked, rows_of

LIMITS = Limits("t.m", "deg", None, 12.0)


def compared(in_a: np.ndarray, in_b: np.ndarray, limits: Limits = LIMITS) -> Answers:
    """Both (n,) or (n, repetitions)."""
    n = len(in_a)
    values = np.stack([in_a.reshape(n, -1), in_b.reshape(n, -1)], axis=2)
    rows = rows_of({"x": np.arange(float(n))}, {"t.m": values}, [limits], ("a", "b"))
    return answer(rows, about(rows))


def test_a_difference_is_of_the_same_drives() -> None:
    """Drives differ by 5 deg, designs by 0.3: only in pairs is that seen."""
    random = np.random.default_rng(1)
    drive = random.normal(0.0, 5.0, (200, 1))
    in_a, in_b = (drive + shift + random.normal(0.0, 0.5, (200, 2)) for shift in (0.0, -0.3))
    (pair,) = compared(in_a, in_b).value_pairs
    off = in_b.mean(axis=1) - in_a.mean(axis=1)
    exact = stats.ttest_1samp(off, 0.0).confidence_interval(0.95)
    assert pair.difference == pytest.approx((off.mean(), exact.low, exact.high))
    assert pair.p == pytest.approx(stats.wilcoxon(off).pvalue)
    assert pair.better is not None
    assert pair.better.value == np.mean(off < 0.0)
    assert pair.verdict.startswith("b is lower by 0.")
    assert pair.verdict.endswith(" deg")


def test_no_difference_says_how_small_it_is() -> None:
    random = np.random.default_rng(2)
    drive = random.normal(0.0, 5.0, 300)
    found = compared(drive + random.normal(0.0, 0.1, 300), drive + random.normal(0.0, 0.1, 300))
    (pair,) = found.value_pairs
    assert pair.verdict.startswith("no difference seen (it is less than 0.0")
    assert compared(drive, drive.copy()).value_pairs[0].verdict == "the same in all 300 drives"


def test_a_mean_that_few_drives_make_is_told_as_such() -> None:
    """Of 300 drives the difference is symmetric, but for 20 that are far off: the mean moves, the ranks do not."""
    random = np.random.default_rng(3)
    drive, off = random.normal(0.0, 5.0, 300), random.normal(-0.02, 0.1, 300)
    off[:20] = 2.0
    (pair,) = compared(drive, drive + off).value_pairs
    assert pair.difference.lo > 0.0
    assert pair.p > 0.05
    assert "signs and ranks of the drives do not show it" in pair.verdict


@pytest.mark.parametrize(("limits", "wanted"), [
    (Limits("t.m", "", None, 12.0), 0.0), (Limits("t.m", "", -12.0, None), 1.0), (Limits("t.m", "", -2.0, 2.0), 0.0),
])  # fmt: skip
def test_better_is_further_from_the_limits(limits: Limits, wanted: float) -> None:
    in_a = np.linspace(0.5, 1.5, 30)
    (pair,) = compared(in_a, in_a + 0.1, limits).value_pairs
    assert pair.better is not None
    assert pair.better.value == wanted
    assert compared(in_a, in_a + 0.1, Limits("t.m")).value_pairs[0].better is None


def test_drives_that_one_design_lacks_are_left_out() -> None:
    random = np.random.default_rng(4)
    values = random.normal(size=(40, 1, 2))
    rows = rows_of({"x": np.arange(40.0)}, {"t.m": values}, [LIMITS], ("a", "b"))
    kept = picked(rows, np.flatnonzero((rows.design == 0) | (rows.sample >= 10)))
    kept.measured["t.m"][:3] = np.nan  # of a: drives 0, 1, 2, which b lacks too
    kept.measured["t.m"][-2] = np.nan  # of a: drive 39
    found = answer(kept, about(rows))
    assert found.value_pairs[0].n == 29
    off = values[10:39, 0, 1] - values[10:39, 0, 0]
    assert found.value_pairs[0].difference.value == pytest.approx(off.mean())
    apart = picked(rows, np.flatnonzero((rows.design == 0) == (rows.sample < 20)))
    assert answer(apart, about(rows)).value_pairs == []


def test_verdicts_are_compared_by_drives_that_differ() -> None:
    """McNemar: 25 drives pass in b only, 5 in a only, of 400."""
    passed = np.ones((400, 1, 2), bool)
    passed[:25, 0, 0], passed[25:30, 0, 1], passed[30:50] = False, False, False
    verdicts = np.where(passed, "PASS", "FAIL")
    verdicts[50] = "INVALID"
    rows = rows_of({"x": np.arange(400.0)}, {"m": np.zeros((400, 1, 2))}, (), ("a", "b"), {"t": verdicts})
    (pair,) = answer(rows, about(rows)).yield_pairs
    assert (pair.n, pair.only_a, pair.only_b) == (399, 5, 25)
    assert pair.p == pytest.approx(2.0 * stats.binom.cdf(5, 30, 0.5))
    assert pair.difference.value == pytest.approx(20 / 399)
    assert "t: the yield is 5.0 points higher in b than in a (2." in lines(rows, about(rows))[-1]
    turned = rows_of({"x": np.arange(400.0)}, {"m": np.zeros((400, 1, 2))}, (), ("b", "a"), {"t": verdicts[:, :, ::-1]})
    assert answer(turned, about(rows)).yield_pairs[0].difference.value == pytest.approx(-20 / 399)


@pytest.mark.parametrize(("n", "p_a", "p_b"), [(30, 0.1, 0.1), (60, 0.02, 0.1), (200, 0.05, 0.15), (200, 0.005, 0.01)])
def test_the_difference_of_yields_is_within_its_interval(n: int, p_a: float, p_b: float) -> None:
    """Over all that can be seen, each with its probability."""
    covered = 0.0
    for only_a in range(n + 1):
        first = stats.binom.pmf(only_a, n, p_a)
        if first < 1e-7:
            continue
        rest = stats.binom.pmf(np.arange(n - only_a + 1), n - only_a, p_b / (1.0 - p_a))
        for only_b in np.flatnonzero(rest > 1e-7):
            found = yield_difference(only_a, int(only_b), n)
            covered += first * rest[only_b] * (found.lo <= p_b - p_a <= found.hi)
    assert covered >= 0.94


def test_the_ratio_of_sd_is_within_its_interval() -> None:
    random = np.random.default_rng(5)
    inside, told = [], 0
    for _ in range(600):
        common = random.normal(size=50)
        in_a, in_b = common + 0.5 * random.normal(size=50), 1.5 * common + random.normal(size=50)
        found = spread(in_a, in_b)
        if found is not None:
            told += 1
            inside.append(found.lo <= np.sqrt((1.5**2 + 1.0) / 1.25) <= found.hi)
    assert told > 580
    assert np.mean(inside) == pytest.approx(0.95, abs=0.03)
    assert spread(random.standard_exponential(200), random.standard_exponential(200)) is None
    assert spread(np.ones(9), np.arange(9.0)) is None
