"""The figures of an observer, from one pass over blocks, are those that numpy finds in all samples at once."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.replay.estimators import Estimate
from bench.score.phases import Phases
from bench.score.tally import Block, OverTime, Tally
from bench.signal.error_bins import BINS
from bench.signal.position import unwrapped, wrap
from sim.observers.against import PORTION

RATE, POLE_PAIRS, OFFSET, EVERY = 16_000.0, 5, 0.3, 700
RPM_BY = 60.0 / math.tau / POLE_PAIRS
NAMES = ("error", "transient", "start_up", "reversal")


class Samples:
    """n samples of a shaft that turns both ways, in phases drawn at random, and an estimate, at times far off."""

    def __init__(self, n: int, seed: int = 1, unknown: bool = False) -> None:
        chance = np.random.default_rng(seed)
        self.n = n
        self.omega = 2000.0 * np.sin(np.arange(n) / 3000.0) + chance.normal(0.0, 5.0, n)
        self.theta = (np.cumsum(self.omega / RATE) + math.pi) % math.tau - math.pi
        late = 40e-6 * self.omega + chance.standard_t(2, n) * 0.03
        records = np.zeros(n, [("theta", "f8"), ("omega", "f8"), ("on", "i8")])  # as observers give them
        records["theta"] = (self.theta - late + math.pi) % math.tau - math.pi
        records["omega"] = self.omega - chance.normal(3.0, 2.0, n)
        if unknown:
            records["omega"][chance.random(n) < 0.3] = math.nan
        self.estimate = Estimate(records["theta"], records["omega"])
        self.phase = chance.integers(0, 5, n)  # steady, transient, start-up, reversal, at rest
        self.moving = np.where(self.phase < 2, True, (self.phase < 4) & (chance.random(n) < 0.5))
        self.degrees = np.degrees((self.theta - self.estimate.theta + math.pi) % math.tau - math.pi)

    def block(self, first: int, last: int) -> Block:
        rows = slice(first, last)
        steady, transient, start_up, reversal = (self.phase[rows] == k for k in range(4))
        phases = Phases(self.moving[rows], steady, transient, start_up, reversal, 0, 0)
        own, points = slice(0, last - first), np.arange(first, last) // EVERY
        t = first / RATE
        return Block(self.theta[rows], self.omega[rows], phases, own, RATE, POLE_PAIRS, OFFSET, t, points)

    def tallied(self, *cuts: int) -> tuple[Tally, OverTime]:
        tally, over = Tally(), OverTime(-(-self.n // EVERY))
        for first, last in zip((0, *cuts), (*cuts, self.n), strict=True):
            part = Estimate(*(values[first:last] for values in self.estimate))
            tally.add(self.block(first, last), part, over)
        return tally, over


def of(values: np.ndarray) -> dict[str, float | int | None]:
    """By numpy; more than 8192 magnitudes have their 99th percentile to 0.2 % where they are too many to be kept."""
    if not len(values):
        return {"n": 0, **dict.fromkeys(("bias", "std", "rms", "max", "p99"))}
    size = np.abs(values)
    figures = (values.mean(), values.std(), np.sqrt((values**2).mean()), size.max(), np.percentile(size, 99.0))
    return {"n": len(values)} | dict(zip(("bias", "std", "rms", "max", "p99"), map(float, figures), strict=True))


def near(figures: dict[str, float | int | None]) -> object:
    return pytest.approx(figures, rel=1e-11, abs=1e-11) if figures["n"] else figures


@pytest.mark.parametrize(
    ("n", "cuts", "unknown"),
    [
        (1, (), False), (PORTION, (), False), (PORTION + 1, (1,), True),
        (60_000, (5, 20_000, 20_001), False), (60_000, (), True),
    ],
)  # fmt: skip
def test_figures_are_those_of_all_samples_at_once(n: int, cuts: tuple[int, ...], unknown: bool) -> None:
    samples = Samples(n, unknown=unknown)
    tally, over = samples.tallied(*cuts)
    found, degrees, steady = tally.figures(0, 0), samples.degrees, samples.phase == 0
    assert found["moving"] == near(of(degrees[samples.moving]))
    for k, name in enumerate(NAMES):
        assert {key: found[name][key] for key in of(degrees)} == near(of(degrees[samples.phase == k])), name
    slip = ((samples.omega - samples.estimate.omega) * RPM_BY)[steady]
    assert found["speed"] == near(of(slip[np.isfinite(slip)]))
    sector = np.floor((samples.theta - OFFSET) / (math.pi / 3)).astype(int) % 6
    for k in range(6):
        assert found["by_sector"][str(k + 1)] == near(of(degrees[steady & (sector == k)]))
    rpm = samples.omega * RPM_BY
    for name, figures in found["by_speed"].items():
        lo, hi = (float(x.replace("up", "inf")) for x in name.replace("-up", "-inf").split("_to_"))
        there = (rpm >= lo) & (rpm < hi) if hi > 0 else (rpm > lo) & (rpm <= hi)
        assert figures == near(of(degrees[steady & there])), name
    assert sum(figures["n"] for figures in found["by_speed"].values()) == steady.sum()
    if steady.sum() > 1000:
        slope = np.polyfit(samples.omega[steady], np.radians(degrees[steady]), 1)[0]
        assert found["lag"]["angle_us"] == pytest.approx(1e6 * slope, rel=1e-9)
    ends = np.arange(0, n, EVERY)
    assert over.error.lo.tolist() == np.minimum.reduceat(degrees, ends).tolist()
    assert over.error.hi.tolist() == np.maximum.reduceat(degrees, ends).tolist()
    speed = np.maximum.reduceat(samples.estimate.omega * RPM_BY, ends)
    assert np.array_equal(over.speed.hi, speed, equal_nan=True)
    assert (over.peak, over.peak_t) == (np.abs(degrees).max(), pytest.approx(np.abs(degrees).argmax() / RATE))


def test_errors_by_the_angle_are_those_of_the_steady_samples() -> None:
    samples = Samples(30_000)
    tally, _ = samples.tallied(12_345)
    bins = np.floor(samples.theta % math.tau * BINS / math.tau).astype(int) % BINS
    for way, there in enumerate((samples.omega >= 0.0, samples.omega < 0.0)):
        for k in range(0, BINS, 7):
            errors = samples.degrees[(samples.phase == 0) & there & (bins == k)]
            assert tally.by_angle.n[way, k] == len(errors)
            if len(errors):
                assert (tally.by_angle.lo[way, k], tally.by_angle.hi[way, k]) == (errors.min(), errors.max())
                assert tally.by_angle.band()[0][way, k] == pytest.approx(errors.mean(), rel=1e-11)


def test_recordings_pooled_are_as_one() -> None:
    samples = Samples(50_000)
    whole, _ = samples.tallied()
    pooled = Tally()
    for first, last in ((0, 17), (17, 30_000), (30_000, 50_000)):
        one = Tally()
        part = Estimate(*(values[first:last] for values in samples.estimate))
        one.add(samples.block(first, last), part, OverTime(-(-50_000 // EVERY)))
        pooled.merge(one)
    expected, found = whole.figures(2, 1), pooled.figures(2, 1)
    for name in ("moving", "speed", *NAMES):
        assert found[name] == near(expected[name])


def test_an_estimate_that_is_not_known_spoils_what_it_is_in_and_no_more() -> None:
    samples = Samples(5000)
    at = int(np.flatnonzero(samples.phase == 1)[10])
    samples.estimate.theta[at] = math.nan
    tally, over = samples.tallied()
    found = tally.figures(0, 0)
    assert math.isnan(found["transient"]["bias"])
    assert found["error"] == near(of(samples.degrees[samples.phase == 0]))
    assert math.isnan(over.error.lo[at // EVERY])
    assert np.isfinite(np.delete(over.error.lo, at // EVERY)).all()


@pytest.mark.parametrize("step", [0.01, 1.0, 3.0, math.pi, 3.3])
def test_an_angle_is_followed_as_numpy_does(step: float) -> None:
    way = np.random.default_rng(2).choice([-1.0, 1.0], 3000) * step
    for n in (1, 2, 3000):
        angle = (np.cumsum(way[:n]) + math.pi) % math.tau - math.pi
        assert np.array_equal(unwrapped(angle), np.unwrap(angle))
        angle[n // 2] = math.nan
        assert np.array_equal(unwrapped(angle), np.unwrap(angle), equal_nan=True)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("most", [0.1, math.pi, 6.2, 9.5, 100.0])
def test_angles_are_wrapped_to_the_last_bit_as_by_the_remainder(dtype: type[np.floating], most: float) -> None:
    angle = np.random.default_rng(3).uniform(-most, most, 5000).astype(dtype)
    edge = dtype(math.pi)
    angle[:6] = (
        0.0,
        edge,
        -edge,
        np.nextafter(edge, dtype(4)),
        np.nextafter(-edge, dtype(-4)),
        np.nextafter(-edge, dtype(0)),
    )
    remainder = (angle + math.pi) % math.tau - math.pi
    assert wrap(angle).tobytes() == remainder.tobytes()
    angle[7] = math.inf
    assert np.isnan(wrap(angle)[7])
