"""`bench.signal.waveforms.frequency_response` and `excitation`: against loops whose transfer functions are formulas.

The loop is stepped sample by sample here, and its open loop written down in z beside it; neither knows the code under
test.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.signal.waveforms import excitation
from bench.signal.waveforms.frequency_response import FrequencyResponse, frequency_response

RATE = 16_000.0


class Loop(NamedTuple):
    """A PI controller on a winding R, L behind one period of delay, sampled at RATE with a zero-order hold."""

    bandwidth: float
    R: float = 0.4
    L: float = 0.6e-3
    error: float = 1.0  # L assumed over L

    @property
    def decay(self) -> float:
        return math.exp(-self.R / (self.L * RATE))

    @property
    def gains(self) -> tuple[float, float]:
        alpha = 2.0 * math.pi * self.bandwidth
        return alpha * self.L * self.error, alpha * self.R / RATE

    def open(self, f: np.ndarray) -> np.ndarray:
        z = np.exp(2j * np.pi * f / RATE)
        k_p, k_i = self.gains
        plant = (1.0 - self.decay) / self.R / (z - self.decay)
        return (k_p + k_i * z / (z - 1.0)) * plant / z

    def answer(self, r: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """The measured current at each sample; `noise` is in the measurement, and so in the loop."""
        k_p, k_i = self.gains
        i = integral = waiting = 0.0
        found = np.empty(len(r))
        for k, reference in enumerate(r):
            found[k] = i + noise[k]
            error = reference - found[k]
            integral += k_i * error
            voltage, waiting = waiting, k_p * error + integral
            i = self.decay * i + (1.0 - self.decay) / self.R * voltage
        return found

    def margins(self) -> tuple[float, float]:
        """Crossover (Hz) and phase margin (deg), by bisection on the formula."""
        lo, hi = 1.0, RATE / 2
        for _ in range(80):
            mid = math.sqrt(lo * hi)
            lo, hi = (mid, hi) if abs(self.open(np.array([mid]))[0]) > 1.0 else (lo, mid)
        phase = math.degrees(float(np.angle(self.open(np.array([lo]))[0])))
        return lo, 180.0 + (phase if phase < 0 else phase - 360.0)


LINES = excitation.spread(2, 900, 60)


def measured(loop: Loop, sd: float = 0.0, periods: int = 8, seed: int = 0) -> FrequencyResponse:
    wave = excitation.multisine(2048, LINES, seed)
    r = 0.5 + 0.2 * np.tile(wave.values, periods + 2)
    y = loop.answer(r, np.random.default_rng(seed).normal(0.0, sd, len(r)) if sd else np.zeros(len(r)))
    return frequency_response(r[4096:], y[4096:], 2048, wave.lines, RATE)


@pytest.mark.parametrize("loop", [Loop(300.0), Loop(800.0), Loop(1400.0), Loop(800.0, error=1.7), Loop(500.0, R=0.05)])
def test_open_loop_and_phase_margin_are_those_of_the_formula(loop: Loop) -> None:
    found = measured(loop)
    assert found.open == pytest.approx(loop.open(found.f), rel=2e-3)
    crossover, margin = loop.margins()
    got = found.margins()
    assert got.crossover.value == pytest.approx(crossover, rel=0.01)
    assert got.phase_margin.value == pytest.approx(margin, abs=0.5)


def test_the_gain_margin_is_where_the_loop_lags_by_half_a_turn() -> None:
    loop = Loop(800.0)
    f = np.linspace(100.0, 7900.0, 200_000)
    phase = np.unwrap(np.angle(loop.open(f)))
    expected = -20.0 * math.log10(abs(loop.open(f[[int(np.argmax(phase < -np.pi))]])[0]))
    assert measured(loop).margins().gain_margin.value == pytest.approx(expected, abs=0.2)


def test_the_intervals_hold_the_truth() -> None:
    loop = Loop(800.0)
    _, margin = loop.margins()
    inside, widths = 0, []
    for seed in range(40):
        found = measured(loop, sd=0.05, seed=seed).margins().phase_margin
        assert found.value is not None
        assert found.half_width is not None
        inside += abs(found.value - margin) <= found.half_width + 0.3
        widths.append(found.half_width)
    assert inside >= 36
    assert 0.5 < float(np.median(widths)) < 15.0


@pytest.mark.parametrize("sd", [0.005, 0.02, 0.1, 0.3, 1.0, 3.0])
def test_however_noisy_a_margin_is_near_or_not_known(sd: float) -> None:
    """Never a margin that is far from the truth with an interval that does not say so."""
    loop = Loop(600.0)
    crossover, margin = loop.margins()
    f = np.linspace(100.0, 7900.0, 100_000)
    lag = f[int(np.argmax(np.unwrap(np.angle(loop.open(f))) < -np.pi))]
    gain = -20.0 * math.log10(abs(loop.open(np.array([lag]))[0]))
    t = loop.open(f) / (1.0 + loop.open(f))
    band = float(f[int(np.argmax(np.abs(t) < math.sqrt(0.5)))])
    truth = {"crossover": crossover, "phase_margin": margin, "gain_margin": gain, "bandwidth": band}
    said = wrong = 0
    for seed in range(12):
        found = measured(loop, sd=sd, seed=seed).margins()
        for name, true in truth.items():
            value, width = getattr(found, name)
            said += value is not None
            if value is not None:
                assert width is not None
                wrong += abs(value - true) > 2.0 * width + 0.02 * abs(true)
    assert wrong <= 0.06 * max(said, 1) + 1
    assert said >= (40 if sd <= 0.02 else 20 if sd <= 0.1 else 0)


def test_deviation_is_the_scatter_of_repetitions() -> None:
    loop = Loop(600.0)
    many = [measured(loop, sd=0.05, seed=seed) for seed in range(30)]
    closed = np.array([each.closed for each in many])
    scatter = np.sqrt(np.mean(np.abs(closed - closed.mean(axis=0)) ** 2, axis=0) / 2.0)
    stated = np.sqrt(np.mean([each.deviation**2 for each in many], axis=0))
    assert np.median(stated / scatter) == pytest.approx(1.0, abs=0.15)


def test_coherence_falls_where_the_output_is_noise() -> None:
    found = measured(Loop(150.0), sd=0.05, periods=16)
    assert np.all(found.coherence[found.f < 100] > 0.97)
    assert np.median(found.coherence[found.f > 5000]) < 0.5
    silent = measured(Loop(150.0), periods=16)
    assert np.all(silent.coherence > 0.999)


def test_a_reference_recorded_one_sample_late_is_put_right() -> None:
    loop = Loop(800.0)
    wave = excitation.multisine(2048, LINES)
    r = np.tile(wave.values, 8)
    y = loop.answer(r, np.zeros(len(r)))
    late = np.concatenate([[0.0], r[:-1]])
    found = frequency_response(late[4096:], y[4096:], 2048, wave.lines, RATE, late=1.0)
    assert found.open == pytest.approx(loop.open(found.f), rel=2e-3)


def test_what_cannot_be_measured_is_refused() -> None:
    zeros = np.zeros(8192)
    with pytest.raises(ValueError, match="no power at"):
        frequency_response(zeros + np.tile(excitation.sine(1024, 3).values, 8), zeros, 1024, [3, 4], RATE)
    with pytest.raises(ValueError, match="3 periods"):
        frequency_response(zeros[:3500], zeros[:3500], 1024, [3], RATE)


def test_margins_that_the_lines_do_not_reach_are_none() -> None:
    wave = excitation.multisine(2048, excitation.spread(2, 30, 10))
    r = np.tile(wave.values, 8)
    y = Loop(800.0).answer(r, np.zeros(len(r)))
    got = frequency_response(r[4096:], y[4096:], 2048, wave.lines, RATE).margins()
    assert got.crossover.value is None
    assert got.phase_margin.value is None
    assert got.bandwidth.value is None


@settings(deadline=None, max_examples=60)
@given(st.sampled_from([64, 250, 1024, 4096]), st.data())
def test_every_waveform_is_periodic_has_a_peak_of_one_and_keeps_its_lines(n: int, data: st.DataObject) -> None:
    first = data.draw(st.integers(1, n // 4))
    last = data.draw(st.integers(first, n // 2 - 1))
    made = {
        "multisine": excitation.multisine(n, excitation.spread(first, last, 20), data.draw(st.integers(0, 9))),
        "noise": excitation.noise(n, first, last),
        "chirp": excitation.chirp(n, first, last),
        "sine": excitation.sine(n, first),
        "square": excitation.square(n),
        "table": excitation.table(np.arange(n) - 3.0),
    }
    for name, wave in made.items():
        assert len(wave.values) == n
        assert np.abs(wave.values).max() <= 1.0 + 1e-12
        raw = wave.raw()
        assert np.abs(raw.astype(int)).max() <= 32767
        if wave.lines and name != "square":
            spectrum = np.abs(np.fft.rfft(wave.values))
            off = np.delete(spectrum, list(wave.lines))
            assert off.max() < 1e-9 * n
    step = np.abs(np.diff(np.append(made["chirp"].values, made["chirp"].values[0])))
    assert step.max() <= 2.0 * np.pi * (last + 1) / n + 1e-9  # nothing jumps where a chirp begins again


def test_a_multisine_has_a_small_peak() -> None:
    wave = excitation.multisine(4096, excitation.spread(4, 512, 30))
    assert 1.0 / wave.values.std() < 3.0  # crest factor
