"""Figures of errors made from formulas, phases of speeds made from straight lines: what is told is what was put in."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.score.metrics import Changes, LagBySpeed, LagInTime, reach
from bench.score.phases import phases_of, speed_bin, speed_numbers, speed_of
from bench.score.tally import Envelope
from bench.signal.error_bins import BINS, ErrorByAngle, Errors
from bench.signal.percentiles import Percentiles

RATE = 16_000.0
N_P = 6
TO_RPM = 60 / (2 * math.pi) / N_P


def lag_by_speed(omega: np.ndarray, error: np.ndarray) -> float | None:
    lag = LagBySpeed()
    lag.add(omega, error)
    return lag.lag()


def lag_in_time(*stretches: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float | None:
    """Of stretches (actual, estimate, where)."""
    lag = LagInTime()
    for actual, estimate, where in stretches:
        changes = Changes(actual, where, RATE)
        lag.add(changes, changes.against(estimate))
    return lag.lag()


def test_no_lag_is_told_from_one_speed() -> None:
    assert lag_by_speed(np.linspace(300.0, 330.0, 100), np.ones(100)) is None
    assert lag_by_speed(np.zeros(100), np.zeros(100)) is None
    assert lag_by_speed(np.empty(0), np.empty(0)) is None


@pytest.mark.parametrize("n", [10, 5000, 8192, 100_000, 700_000])
@pytest.mark.parametrize("cuts", [1, 7])
def test_percentiles_of_any_number_are_those_of_numpy(n: int, cuts: int) -> None:
    """Exact up to 8192 numbers and for 99 % of up to a hundred times as many; else within 0.2 %."""
    values = np.abs(np.random.default_rng(4).standard_cauchy(n))
    parts = np.array_split(values, cuts)
    whole, merged = Percentiles(), Percentiles()
    for k, part in enumerate(parts):
        whole.add(part)
        one = Percentiles()
        one.add(part)
        merged.merge(one)
        if k == 2:
            merged.merge(Percentiles())
    for sizes in (whole, merged):
        assert (sizes.n, sizes.at(99.0)) == (n, pytest.approx(np.percentile(values, 99.0), rel=1e-12))
        assert sizes.at(99.9) == pytest.approx(np.percentile(values, 99.9), rel=1e-12)
        for percent in (1.0, 50.0, 90.0):
            exact = np.percentile(values, percent)
            assert sizes.at(percent) == pytest.approx(exact, rel=1e-12 if n <= 8192 else 0.002 + 1e-3)
    assert math.isnan(Percentiles().at(99.0))


def test_errors_and_lags_of_parts_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(6)
    omega, error = 300.0 + 200.0 * rng.random(30_000), 5.0 + rng.standard_normal(30_000)
    errors, lag = Errors(), LagBySpeed()
    for part in (slice(0, 1), slice(1, 1), slice(1, 9000), slice(9000, None)):
        one, late = Errors(), LagBySpeed()
        one.add(error[part])
        late.add(omega[part], error[part])
        errors.merge(one)
        lag.merge(late)
    assert errors.figures() == pytest.approx(
        {
            "n": 30_000,
            "bias": error.mean(),
            "std": error.std(),
            "rms": np.sqrt((error**2).mean()),
            "max": np.abs(error).max(),
            "p99": np.percentile(np.abs(error), 99.0),
        },
        rel=1e-12,
    )
    assert lag.lag() == pytest.approx(np.polyfit(omega, error, 1)[0], rel=1e-9)


def by_interpolation(actual: np.ndarray, estimate: np.ndarray, where: np.ndarray) -> float:
    """The lag by what it is defined by, on all samples at once: Gauss and Newton's iteration on interpolated values."""
    at, index, slope, tau = np.flatnonzero(where), np.arange(len(actual)), np.gradient(actual) * RATE, 0.0
    for _ in range(12):
        shifted, change = (np.interp(at - tau * RATE, index, values) for values in (actual, slope))
        tau += float(change @ (shifted - estimate[at]) / (change @ change))
    return tau


@pytest.mark.parametrize("tau", [0.4e-3, -12e-3, 30e-3])
def test_a_delay_told_from_parts_is_that_of_all_samples(tau: float) -> None:
    t = np.arange(40_000) / RATE
    actual = speed(t - 0.5) + speed(t - 1.6)
    estimate = speed(t - 0.5 - tau) + speed(t - 1.6 - tau) + np.random.default_rng(7).standard_normal(len(t))
    where = np.abs(np.gradient(actual)) > 0.02
    where[:50] = where[-50:] = True  # at the ends the speed is taken to stay
    lag, size, far = LagInTime(), 6000, reach(RATE)
    for first in range(0, len(t), size):
        part = slice(max(0, first - far - 1), min(len(t), first + size + far + 1))
        own = where & (np.arange(len(t)) >= first) & (np.arange(len(t)) < first + size)
        changes = Changes(actual[part], own[part], RATE)
        lag.add(changes, changes.against(estimate[part]))
    expected = by_interpolation(actual, estimate, where)
    assert (expected, lag.lag()) == (pytest.approx(tau, abs=1e-4), pytest.approx(expected, abs=1e-10))
    assert lag_in_time((actual, estimate, where)) == pytest.approx(expected, abs=1e-10)


def speed(t: np.ndarray) -> np.ndarray:
    return 300.0 + 200.0 * np.tanh((t - 0.3) / 0.05) - 80.0 * np.exp(-(((t - 0.7) / 0.03) ** 2))


def test_no_delay_is_told_without_a_change_or_beyond_reason() -> None:
    t = np.arange(16_000) / RATE
    still, everywhere = np.full(len(t), 300.0), np.ones(len(t), bool)
    assert lag_in_time((still, still, everywhere)) is None
    assert lag_in_time((speed(t), speed(t), np.zeros(len(t), bool))) is None
    assert lag_in_time((1000.0 * t, 1000.0 * (t - 0.2), everywhere)) is None
    assert lag_in_time() is None


def test_the_speed_is_that_of_a_wrapped_angle() -> None:
    t = np.arange(8000) / RATE
    theta = np.mod(400.0 * t + 100.0 * t * t + np.pi, 2 * np.pi) - np.pi
    assert speed_of(theta, RATE)[200:-200] == pytest.approx(400.0 + 200.0 * t[200:-200], abs=1e-6)


def profile(points: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Electrical speed along straight lines between (s, r/min), at RATE."""
    times, rpm = zip(*points, strict=True)
    t = np.arange(round(times[-1] * RATE)) / RATE
    return t, np.interp(t, times, rpm) / TO_RPM


def test_phases_are_where_the_speed_says() -> None:
    t, omega = profile([(0, 0), (0.5, 0), (0.9, 800), (1.5, 800), (1.7, 300), (2.2, 300), (2.4, -300), (3, -300)])
    found = phases_of(omega, np.ones(len(t), bool), RATE, N_P)
    begin = 0.5 + 10 / 2000  # at 10 r/min
    assert (found.starts, found.reversals) == (1, 1)
    zero = 2.3 + 10 / 3000
    expected = {
        "start_up": [(begin - 0.01, begin + 0.3)],
        "transient": [(begin + 0.3, 1.0), (1.5, 1.8), (2.2, zero - 0.1), (zero + 0.1, 2.5)],
        "steady": [(1.0, 1.5), (1.8, 2.2), (2.5, 3.0)],
        "reversal": [(zero - 0.1, zero + 0.1)],
    }
    for name, spans in expected.items():
        mask = getattr(found, name)
        seconds = sum(b - a for a, b in spans)
        assert mask.sum() / RATE == pytest.approx(seconds, abs=0.03 * len(spans)), name
        for a, b in spans:
            assert mask[(t > a + 0.02) & (t < b - 0.02)].all(), (name, a, b)
    assert np.array_equal(found.moving, np.abs(omega * TO_RPM) > 10.0)
    together = sum(getattr(found, name).astype(int) for name in expected)
    assert together.max() == 1
    assert (together[found.moving] == 1).all()


def test_a_pause_ends_a_motion_and_a_short_one_does_not() -> None:
    _, pause = profile([(0, 400), (0.3, 400), (0.31, 0), (0.5, 0), (0.51, -400), (1, -400)])
    found = phases_of(pause, np.ones(len(pause), bool), RATE, N_P)
    assert (found.starts, found.reversals) == (1, 0)
    _, short = profile([(0, 400), (0.3, 400), (0.31, 0), (0.35, 0), (0.36, -400), (1, -400)])
    found = phases_of(short, np.ones(len(short), bool), RATE, N_P)
    assert (found.starts, found.reversals) == (0, 1)


def test_a_recording_may_begin_just_before_the_shaft_starts() -> None:
    t, omega = profile([(0, 0), (0.02, 0), (0.4, 800), (1, 800)])
    found = phases_of(omega, np.ones(len(t), bool), RATE, N_P)
    assert (found.starts, found.reversals) == (1, 0)
    assert found.start_up[(t > 0.03) & (t < 0.3)].all()
    _, running = profile([(0, 400), (1, 400)])
    assert phases_of(running, np.ones(len(running), bool), RATE, N_P).starts == 0


def test_what_is_not_usable_counts_for_nothing() -> None:
    t, omega = profile([(0, 0), (0.5, 0), (0.9, 800), (2, 800)])
    found = phases_of(omega, t > 1.2, RATE, N_P)
    assert (found.starts, found.reversals) == (0, 0)
    for name in ("moving", "steady", "transient", "start_up", "reversal"):
        assert not getattr(found, name)[t <= 1.2].any()
    assert found.steady[t > 1.2].all()


def test_a_speed_that_is_held_falls_into_one_bin() -> None:
    rng = np.random.default_rng(3)
    for held, name in ((50, "0_to_75"), (500, "350_to_750"), (-1000, "-1500_to_-750"), (3000, "2500_to_4000")):
        rpm = held + 0.02 * abs(held) * rng.standard_normal(1000)
        assert {speed_bin(k) for k in speed_numbers(rpm).tolist()} == {name}
    *both, rest = speed_numbers(np.array([-200.0, 200.0, 210.0, 1e6, 0.0])).tolist()
    assert ([speed_bin(k) for k in both], rest) == (["-350_to_-150", "150_to_350", "150_to_350", "75000_to_up"], 0)


def test_extremes_stay_those_of_all_that_was_added() -> None:
    rng = np.random.default_rng(1)
    bins, values = rng.integers(0, BINS, 5000), rng.normal(size=5000)
    whole, one, other = ErrorByAngle(), ErrorByAngle(), ErrorByAngle()
    reverse = rng.integers(0, 2, 5000) > 0
    for sums, part in ((whole, slice(None)), (one, slice(0, 2000)), (other, slice(2000, None))):
        sums.add(bins[part], values[part], reverse[part])
    one.merge(other)
    envelope = Envelope(50)
    for part in np.split(np.arange(5000), [1, 99, 101, 3000]):
        envelope.add(part // 100, values[part])
    for sums in (whole, one):
        assert sums.both()[1] == pytest.approx([values[bins == k].std() for k in range(BINS)])
        for way in (0, 1):
            there = [values[(bins == k) & (reverse == way)] for k in range(BINS)]
            assert sums.n[way].tolist() == [len(of) for of in there]
            assert sums.hi[way].tolist() == [of.max() for of in there]
            assert sums.lo[way].tolist() == [of.min() for of in there]
    assert envelope.hi.tolist() == values.reshape(-1, 100).max(1).tolist()
