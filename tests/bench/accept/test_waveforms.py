"""Measurements on waveforms against formulas, scipy and waveforms made with known properties."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import signal
from scipy.optimize import brentq

from bench.signal.waveforms import (
    FORWARD,
    REVERSE,
    edge_offsets,
    fundamental,
    sector_of_angle,
    settled,
    sine_response,
    spectrum,
    step_response,
    thd,
    thd_by_angle,
)

Floats = NDArray[np.float64]
TABLE_I = (-1.2, -3.0, 7.2, -3.3, 0.6, 5.6)  # deg, Kim et al. 2011
CODES = np.array([1, 3, 2, 6, 4, 5])  # SPEC.md, sectors 0..5


def times(seconds: float, rate: float, start: float = 0.0) -> Floats:
    return start + np.arange(round(seconds * rate)) / rate


def wave(phase: Floats, amplitudes: list[float], phases: list[float] | None = None) -> Floats:
    """Sum of sines of 1, 2, ... times `phase`."""
    phases = phases or [0.3 * n for n in range(len(amplitudes))]
    total = np.zeros_like(phase)
    for n, (amplitude, shift) in enumerate(zip(amplitudes, phases, strict=True), 1):
        total += amplitude * np.sin(n * phase + shift)
    return total


# --- settling ---------------------------------------------------------------------------------------------------------


def test_settling_counts_the_last_time_in_the_band() -> None:
    t = times(1.0, 10.0, start=5.0)
    y = np.array([0.0, 1.0, 1.0, 1.3, 1.1, 1.0, 0.9, 1.0, 1.0, 1.0])
    assert settled(t, y, 1.0, 0.1000001) == pytest.approx((0.4, 0.5))
    assert settled(t, y, 1.0, 0.05) == pytest.approx((0.7, 0.2))
    assert settled(t, y, 1.0, 1.0) == pytest.approx((0.0, 0.9))


def test_what_leaves_the_band_at_the_end_or_stays_too_short_has_not_settled() -> None:
    t = times(1.0, 10.0)
    y = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    assert settled(t, y, 1.0, 0.1) == (None, 0.0)
    assert settled(t, y[::-1], 1.0, 0.1, hold=0.3).time is None
    y[-1] = 1.0
    assert settled(t, y, 1.0, 0.1, hold=0.79).time == pytest.approx(0.1)
    assert settled(t, y, 1.0, 0.1, hold=0.81).time is None


# --- steps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("zeta", [0.2, 0.5, 0.707])
@pytest.mark.parametrize(("y0", "height"), [(0.0, 1.0), (1000.0, -500.0)])
def test_second_order_system(zeta: float, y0: float, height: float) -> None:
    w, gain, rate, t_step = 2.0 * math.pi * 50.0, 1.03, 20e3, 0.05  # settles 3 % beside what was commanded
    system = signal.TransferFunction([gain * w * w], [1.0, 2.0 * zeta * w, w * w])
    t = times(0.4, rate)
    y = np.concatenate([np.zeros(round(t_step * rate)), system.step(T=t)[1]])
    damped = w * math.sqrt(1.0 - zeta**2)

    def exact(x: float) -> float:
        decay = math.exp(-zeta * w * x)
        return gain * (1.0 - decay * (math.cos(damped * x) + zeta * w / damped * math.sin(damped * x)))

    start = 0.02
    response = step_response(times(0.45, rate, start), y0 + height * y, start + t_step, y0, y0 + height, band=0.05)
    t10, t90 = (brentq(lambda x, level=level: exact(x) - level, 0.0, math.pi / damped) for level in (0.1, 0.9))
    peak = gain * (1.0 + math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)))
    assert (response.delay, response.rise) == (pytest.approx(t10, abs=1e-6), pytest.approx(t90 - t10, abs=1e-6))
    assert response.peak == pytest.approx(y0 + height * peak, abs=1e-4 * abs(height))
    assert response.overshoot == pytest.approx(peak - 1.0, abs=1e-4)
    assert response.steady_error == pytest.approx(height * 0.03, abs=1e-5 * abs(height))
    assert response.settling is not None
    assert abs(exact(response.settling - 1.5 / rate) - 1.0) > 0.05
    assert all(abs(exact(x) - 1.0) <= 0.05 for x in np.linspace(response.settling, 0.4, 2000))


def test_a_step_that_stops_half_way_has_no_rise_and_never_settles() -> None:
    t = times(1.0, 1e3)
    response = step_response(t, np.where(t >= 0.2, 0.5, 0.0), 0.2, 0.0, 1.0)
    assert response.delay is not None
    assert (response.rise, response.settling, response.overshoot) == (None, None, 0.0)
    assert response.steady_error == pytest.approx(-0.5)


def test_moving_mean_makes_a_sharp_step_as_long_as_it_says_and_takes_noise_off() -> None:
    t = times(1.0, 10e3)
    y = np.where(t >= 0.5, 1.0, 0.0)
    assert step_response(t, y, 0.4, 0.0, 1.0).rise == pytest.approx(0.8e-4)
    clean = step_response(t, y, 0.4, 0.0, 1.0, smooth=0.1)
    assert (clean.delay, clean.rise) == pytest.approx((0.06, 0.08), abs=3e-4)
    noisy = y + np.random.default_rng(3).normal(0.0, 0.1, len(t))
    smooth, rough = (step_response(t, noisy, 0.4, 0.0, 1.0, band=0.05, smooth=length) for length in (0.1, 0.0))
    assert (smooth.delay, smooth.rise, smooth.settling) == pytest.approx((0.06, 0.08, 0.145), abs=2e-3)
    assert smooth.overshoot < 0.016 < 0.25 < rough.overshoot  # 0.1 / sqrt(1000 samples), five times


# --- harmonics --------------------------------------------------------------------------------------------------------

harmonics = st.lists(st.floats(0.0, 0.4), min_size=19, max_size=19)


@settings(max_examples=15, deadline=None)
@given(
    rest=harmonics,
    seed=st.integers(0, 2**31),
    f=st.floats(5.0, 300.0),
    samples_a_period=st.floats(40.5, 200.0),
    periods=st.floats(3.1, 15.0),
    offset=st.floats(-5.0, 5.0),
)
def test_thd_of_known_harmonics(rest, seed, f, samples_a_period, periods, offset) -> None:
    rate = f * samples_a_period
    t = times(periods / f, rate, start=12.5)
    phases = list(np.random.default_rng(seed).uniform(-3.0, 3.0, 20))
    y = offset + 2.0 * wave(2 * math.pi * f * t, [1.0, *rest], phases)
    exact = math.sqrt(sum(a * a for a in rest))
    known = thd(t, y, f)
    assert known.value == pytest.approx(exact, abs=1e-8)
    assert known.amplitudes == pytest.approx(2.0 * np.array([1.0, *rest]), abs=1e-8)
    assert periods - 1.0 < known.periods <= periods + 1.5 / samples_a_period  # one sample may lack, half is rounded


def test_thd_is_the_fft_over_whole_periods() -> None:
    rate, f = 10e3, 50.0
    t = times(0.2149, rate)  # 10 periods of 200 samples, and part of one more
    y = np.clip(wave(2 * math.pi * f * t, [4.0, 0.3]), -3.0, 3.5) + np.random.default_rng(4).normal(0.0, 0.2, len(t))
    lines = np.abs(np.fft.rfft(y[:2000]))[10::10]
    for order in (20, 7):
        exact = math.sqrt((lines[1:order] ** 2).sum()) / lines[0]
        assert thd(t, y, f, order).value == pytest.approx(exact, rel=1e-9)


def test_thd_takes_every_rounding_of_a_timer_tick() -> None:
    t = np.round(times(0.5, 16e3) * 1e6) / 1e6
    assert thd(t, wave(2 * math.pi * 77.0 * t, [3.0, 0.0, 0.3])).value == pytest.approx(0.1, abs=1e-8)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_thd_by_angle_is_not_smeared_by_a_speed_that_varies(direction: float) -> None:
    t = times(0.5, 16e3)
    theta = direction * (2 * math.pi * 50.0 * t + 0.3 * np.sin(2 * math.pi * 4.0 * t)) + 11.0
    y = 0.5 + wave(theta, [4.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.1])
    exact = math.hypot(0.2, 0.1) / 4.0
    found = thd_by_angle(theta, y)
    assert found.value == pytest.approx(exact, abs=1e-9)
    assert (found.amplitudes[[0, 4, 6]], (found.periods, found.f)) == (pytest.approx([4.0, 0.2, 0.1]), (25, None))
    assert abs(thd(t, y, 50.0).value - exact) > 0.2 * exact


@pytest.mark.parametrize("guess", [None, 45.0, 60.0])
def test_fundamental_under_harmonics_and_noise(guess: float | None) -> None:
    t = times(0.2345, 16e3, start=50.0)
    f, phase = 53.217, -2.5
    y = 1.0 + wave(2 * math.pi * f * (t - t[0]), [2.0, 0.3, 0.3], [phase, 1.0, 2.0])
    assert fundamental(t, y, guess) == pytest.approx((f, 2.0, phase), rel=1e-9)
    noisy = fundamental(t, y + np.random.default_rng(7).normal(0.0, 0.05, len(t)), guess)
    assert noisy.f == pytest.approx(f, abs=5 * _frequency_bound(0.05, 2.0, len(t), 16e3))
    assert noisy.amplitude == pytest.approx(2.0, abs=5 * 0.05 * math.sqrt(2.0 / len(t)))
    assert noisy.phase == pytest.approx(phase, abs=5 * 0.05 / 2.0 * math.sqrt(8.0 / len(t)))


def _frequency_bound(sigma: float, amplitude: float, n: int, rate: float) -> float:
    """Cramer-Rao bound in Hz for one sine (Rife and Boorstyn 1974)."""
    return math.sqrt(24.0 * (sigma / amplitude) ** 2 / n**3) * rate / (2 * math.pi)


# --- frequencies ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("window", ["hann", "rectangular"])
@pytest.mark.parametrize("n", [1000, 1001])
def test_a_sine_on_a_line_shows_its_amplitude(window: str, n: int) -> None:
    t = np.arange(n) / 1e3
    line = 1e3 / n
    found = spectrum(t, -7.0 + 3.0 * np.sin(2 * math.pi * 50 * line * t + 0.4), window)
    assert (found.f[50], found.f) == (pytest.approx(50 * line), pytest.approx(np.fft.rfftfreq(n, 1e-3)))
    assert (found.amplitude[50], found.amplitude[0]) == (pytest.approx(3.0), pytest.approx(7.0))
    assert found.amplitude[53:].max() < 1e-9
    assert found.amplitude[1:48].max() < 1e-9


def test_spectrum_at_half_the_sample_rate_and_against_scipy() -> None:
    t = times(1.0, 100.0)
    assert spectrum(t, np.tile([1.5, -1.5], 50)).amplitude[-1] == pytest.approx(1.5)
    y = np.random.default_rng(9).normal(0.0, 1.0, 501)
    t = times(0.501, 1e3)
    _, power = signal.periodogram(y, 1e3, "hann", detrend="constant", scaling="spectrum")
    assert spectrum(t, y).amplitude[1:] == pytest.approx(np.sqrt(2.0 * power[1:]))


def test_sine_response_of_a_known_filter() -> None:
    rate = 16e3
    t = times(0.5, rate, start=9.0)
    b, a = signal.butter(2, 300.0, fs=rate)
    for f in (20.0, 123.4, 900.0):
        phase = 2 * math.pi * f * t + 0.8
        _, (exact,) = signal.freqz(b, a, [f], fs=rate)
        y = 2.0 + np.imag(exact * np.exp(1j * phase))
        assert sine_response(t, y, f, phase) == pytest.approx(exact, rel=1e-9)
        wrapped = (phase + math.pi) % (2 * math.pi) - math.pi
        filtered = signal.lfilter(b, a, np.sin(phase))[2000:]  # the start has died away
        assert sine_response(t[2000:], filtered, f, wrapped[2000:]) == pytest.approx(exact, rel=1e-6)


def test_sine_response_leaves_disturbing_frequencies_out() -> None:
    t = times(0.1, 16e3)
    phase = 2 * math.pi * 111.0 * t
    gain = 0.5 * np.exp(-0.7j)
    y = np.imag(gain * np.exp(1j * phase)) + wave(2 * math.pi * 127.0 * t, [3.0]) + wave(2 * math.pi * 150.0 * t, [1.0])
    assert abs(sine_response(t, y, 111.0, phase) - gain) > 0.05
    assert sine_response(t, y, 111.0, phase, also=[127.0, 150.0]) == pytest.approx(gain, rel=1e-9)


# --- sectors and edges ------------------------------------------------------------------------------------------------


def test_sectors_open_at_their_lower_edge_and_go_round() -> None:
    edges = np.arange(-12, 12) * math.pi / 3.0
    assert sector_of_angle(edges + 1e-9).tolist() == list(range(6)) * 4
    assert sector_of_angle(edges - 1e-9).tolist() == [5, *list(range(6)) * 3, *range(5)]
    assert sector_of_angle(np.array([0.0, -1e-300])).tolist() == [0, 5]
    for ring in (math.radians(30.0), -2.0, math.pi):
        assert sector_of_angle(edges + ring + 1e-9, ring).tolist() == list(range(6)) * 4


def edges_of_turns(delta_deg: tuple[float, ...], hysteresis_deg: float, turns: int) -> tuple[Floats, ...]:
    """True angle, code before and code after of every edge, `turns` forwards and as many back; angles wrapped."""
    number = np.arange(6 * turns)
    ideal = number * 60.0 - np.tile(delta_deg, turns)
    forwards = ideal + hysteresis_deg / 2.0, CODES[(number - 1) % 6], CODES[number % 6]
    backwards = (ideal - hysteresis_deg / 2.0)[::-1], forwards[2][::-1], forwards[1][::-1]
    degrees, old, new = (np.concatenate(pair) for pair in zip(forwards, backwards, strict=True))
    return np.radians((degrees + 180.0) % 360.0 - 180.0), old, new


@pytest.mark.parametrize("ring_deg", [0.0, 30.0, 17.0, -75.0, 180.0])
def test_edge_offsets_are_those_of_table_one(ring_deg: float) -> None:
    theta, old, new = edges_of_turns(TABLE_I, 2.0, 5)
    found = edge_offsets(theta + math.radians(ring_deg), old, new, math.radians(ring_deg))
    assert np.degrees(found.mean[:, FORWARD]) == pytest.approx(np.array(TABLE_I) - 1.0)
    assert np.degrees(found.mean[:, REVERSE]) == pytest.approx(np.array(TABLE_I) + 1.0)
    assert (found.std, found.n.tolist()) == (pytest.approx(np.zeros((6, 2)), abs=1e-12), [[5, 5]] * 6)
    assert found.dropped == 0


def test_the_mean_of_an_edge_is_circular_and_its_spread_is_that_of_the_jitter() -> None:
    theta, old, new = edges_of_turns((179.0,) * 6, 0.0, 2000)  # half of them beyond 180 deg
    jitter = np.random.default_rng(10).normal(0.0, math.radians(2.0), len(theta))
    found = edge_offsets(theta + jitter, old, new)
    assert np.abs(np.exp(1j * found.mean) - np.exp(1j * math.radians(179.0))).max() < math.radians(0.25)
    assert np.degrees(found.std) == pytest.approx(np.full((6, 2), 2.0), rel=0.1)


def test_edges_between_no_neighbours_are_dropped_and_counted() -> None:
    theta = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    found = edge_offsets(theta, np.array([5, 1, 1, 0, 3]), np.array([1, 7, 2, 3, 3]))
    assert found.dropped == 4
    assert found.n.sum() == found.n[0, FORWARD] == 1
    assert np.isnan(found.mean).sum() == np.isnan(found.std).sum() == 11
    none = edge_offsets(np.empty(0), np.empty(0, np.uint8), np.empty(0, np.uint8))
    assert none.n.sum() == none.dropped == 0


# --- what is refused --------------------------------------------------------------------------------------------------

T = times(1.0, 1e3)
TURNS = 2 * math.pi * times(10.0, 100.0)
NO_FUNDAMENTAL = "no fundamental: at 20 Hz"


def sine(f: float) -> Floats:
    return np.sin(2 * math.pi * f * T)


def short(f: float, advancing: float, *also: float) -> complex:
    phase = 2 * math.pi * advancing * T[:100]
    return sine_response(T[:100], np.sin(phase), f, phase, also)


@pytest.mark.parametrize(("measure", "why"), [
    (lambda: step_response(T, T, 0.5, 2.0, 2.0), "no step"),
    (lambda: step_response(T, T, -0.1, 0.0, 1.0), "not among the samples"),
    (lambda: step_response(T, T, 1.0, 0.0, 1.0), "not among the samples"),
    (lambda: step_response(T, T, 0.5, 0.0, 1.0, -0.1), "must be >= 0"),
    (lambda: thd(T, sine(2.9), 2.9), r"^2\.9 periods are too few: record at least 3$"),
    (lambda: thd(T, sine(25.0), 25.0), "harmonic 20 of 25 Hz is not between 0 and half the sample rate, 500 Hz"),
    *((lambda still=still: thd(T, np.full_like(T, still), 20.0), NO_FUNDAMENTAL) for still in (0.0, 0.1, 0.5, 1e6)),
    (lambda: thd(T, sine(40.0), 20.0), NO_FUNDAMENTAL),
    (lambda: thd(T, np.zeros_like(T)), "no fundamental"),
    (lambda: thd(T, np.random.default_rng(6).normal(0.0, 1.0, len(T))), "no fundamental"),
    (lambda: thd(T, sine(20.0), 20.0, order=1), "order must be >= 2"),
    (lambda: thd_by_angle(TURNS % (2 * math.pi), np.sin(TURNS)), "unwrap theta"),
    (lambda: thd_by_angle(TURNS[::3], np.sin(TURNS[::3])), "unwrap theta"),  # 33 samples a turn
    (lambda: thd_by_angle(TURNS[:200], np.sin(TURNS[:200])), "2 periods are too few"),
    (lambda: fundamental(T, sine(50.0), 200.0), "no fundamental"),
    (lambda: fundamental(T, sine(50.0), 2.0), "2 periods are too few"),
    (lambda: fundamental(T, sine(50.0), 500.0), "not between 0 and half the sample rate"),
    (lambda: short(50.0, 50.0, 55.0), "too short to resolve 50 Hz from 55 Hz"),
    (lambda: short(5.0, 5.0), "too short to resolve 0 Hz from 5 Hz"),
    (lambda: short(60.0, 50.0), "advances at 50 Hz, not at 60 Hz"),
    (lambda: short(50.0, 50.0, 500.0), "500 Hz is not between"),
    (lambda: edge_offsets(np.zeros(2), np.array([8, 5]), np.array([1, 1])), r"0\.\.7, got 5 to 8"),
    (lambda: edge_offsets(np.array([0.0, math.nan]), np.full(2, 5), np.full(2, 1)), "1 of 2 edges"),
    (lambda: edge_offsets(np.zeros(5), np.array([5]), np.array([1])), "one shape"),
])  # fmt: skip
def test_what_cannot_be_measured_is_refused_with_the_reason(measure: Callable[[], object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        measure()


MEASURES: dict[str, Callable[[Floats, Floats], object]] = {
    "settled": lambda t, y: settled(t, y, 0.0, 1.0),
    "step_response": lambda t, y: step_response(t, y, 0.1, 0.0, 1.0),
    "fundamental": lambda t, y: fundamental(t, y, 50.0),
    "thd": lambda t, y: thd(t, y, 20.0),
    "spectrum": lambda t, y: spectrum(t, y),
    "sine_response": lambda t, y: sine_response(t, y, 50.0, 2 * math.pi * 50.0 * t),
}


@pytest.mark.parametrize("measure", MEASURES.values(), ids=MEASURES)
def test_samples_that_are_not_fit_are_refused(measure: Callable[[Floats, Floats], object]) -> None:
    t = times(1.0, 1e3)
    y = np.sin(2 * math.pi * 50.0 * t) + np.sin(2 * math.pi * 20.0 * t)
    measure(t, y)
    with pytest.raises(ValueError, match="t is not uniform"):
        measure(np.delete(t, 500), np.delete(y, 500))
    with pytest.raises(ValueError, match="t is not uniform"):
        measure(t[::-1], y)
    with pytest.raises(ValueError, match="y: 999 samples, but t has 1000"):
        measure(t, y[1:])
    broken = y.copy()
    broken[[3, 7]] = math.nan, math.inf
    with pytest.raises(ValueError, match="y: 2 of 1000 samples are NaN or infinite"):
        measure(t, broken)
    with pytest.raises(ValueError, match=r"shape \(n,\) with n >= 2"):
        measure(t[:1], y[:1])
