"""What a score puts together of a recording, block by block, against numpy on all of it."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from bench.replay.estimators import Estimate
from bench.score.phases import phases_of
from bench.score.tally import Block, Envelope, OverTime, Tally, error_of
from bench.signal.error_bins import BINS, ErrorByAngle

RATE, N_P, N = 1000.0, 6, 4000
OMEGA = 120.0  # electrical rad/s
THETA = OMEGA * np.arange(N) / RATE
WAVE = 3.0 * np.cos(THETA - 1.0) + 1.0  # degrees


def block(first: int, last: int) -> Block:
    omega = np.full(N, OMEGA)
    phases = phases_of(omega, np.ones(N, bool), RATE, N_P)
    return Block(
        THETA, omega, phases, slice(first, last), RATE, N_P, 10.0 + first / RATE, np.arange(first, last) // 100
    )


def tallied(*cuts: int) -> tuple[Tally, OverTime]:
    tally, over_time, bounds = Tally(), OverTime(N // 100), [0, *cuts, N]
    for first, last in pairwise(bounds):
        own, part = block(first, last), Tally()
        estimate = Estimate(THETA[first:last] - np.radians(WAVE[first:last]), np.full(last - first, OMEGA - 10.0))
        part.add(own, estimate, error_of(own, estimate))
        tally.merge(part)
        over_time.add(own, estimate, error_of(own, estimate))
    return tally, over_time


@pytest.mark.parametrize("cuts", [(), (1, 700, 3999)])
def test_figures_are_those_of_the_whole_however_it_is_cut(cuts: tuple[int, ...]) -> None:
    tally, over_time = tallied(*cuts)
    found = tally.figures(1, 2)
    assert (found["start_up"]["events"], found["reversal"]["events"]) == (1, 2)
    assert found["error"] == found["moving"]
    steady = {"n": N, "bias": WAVE.mean(), "std": WAVE.std(), "rms": np.sqrt(np.mean(WAVE**2)), "max": WAVE.max()}
    assert {key: found["error"][key] for key in steady} == pytest.approx(steady, rel=1e-6)
    assert found["speed"]["bias"] == pytest.approx(10.0 * 60 / math.tau / N_P)
    assert list(found["by_speed"]) == ["150_to_350"]
    sector = (np.mod(THETA, math.tau) // (math.pi / 3)).astype(int)
    for k in range(6):
        there = found["by_sector"][str(k + 1)]
        assert (there["n"], there["bias"]) == ((sector == k).sum(), pytest.approx(WAVE[sector == k].mean()))
    bins = (np.mod(THETA, math.tau) // (math.tau / BINS)).astype(int)
    assert tally.by_angle.n.tolist() == [np.bincount(bins, minlength=BINS).tolist(), [0] * BINS]
    assert tally.by_angle.band()[0][0] == pytest.approx(np.bincount(bins, WAVE, BINS) / np.bincount(bins))
    parts = WAVE.reshape(-1, 100)
    assert (over_time.error.lo, over_time.error.hi) == (pytest.approx(parts.min(1)), pytest.approx(parts.max(1)))
    assert over_time.speed.lo == pytest.approx(np.full(N // 100, (OMEGA - 10.0) * 60 / math.tau / N_P))
    assert (over_time.peak, over_time.peak_t) == pytest.approx((WAVE.max(), 10.0 + WAVE.argmax() / RATE))


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
