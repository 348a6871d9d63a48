"""The fundamental of a waveform, its harmonics, and its total harmonic distortion.

All by least squares on the samples over a whole number of periods, to within one sample: a period need not be a whole
number of samples, and nothing is resampled. Amplitudes are peak values in the unit of `y`, frequencies are in Hz.

Source of the distortion: (20) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.signal.position import wrap
from bench.signal.waveforms.frequency import TWO_PI, spectrum
from bench.signal.waveforms.samples import Floats, checked, least_squares, sample_period

ORDER = 20
"""Highest harmonic in (20)."""
PERIODS = 3
"""Fewest periods that are taken for a periodic waveform."""
LEAST_SHARE = 0.1
"""Of the power about the mean: with less of it the fundamental is none. It stands for a distortion of 300 %."""
ROUNDING = 1e-12
"""Of the largest value: an amplitude below it is none."""


class Fundamental(NamedTuple):
    """y = amplitude sin(2 pi f (t - t[0]) + phase) + offset + harmonics."""

    f: float
    amplitude: float
    phase: float
    """rad in [-pi, pi), at the first sample."""


class Thd(NamedTuple):
    """Total harmonic distortion, and what it was made of."""

    value: float
    """sqrt(I_2^2 + ... + I_order^2) / I_1."""
    f: float | None
    """Hz of the fundamental; None over the angle."""
    amplitudes: Floats
    """(order,): I_1 first."""
    periods: int
    """Whole periods, or turns, that it was measured over."""


def fundamental(t: ArrayLike, y: ArrayLike, guess: float | None = None) -> Fundamental:
    """The fundamental of `y` (n,) at `t` (n,) s uniform, its frequency refined by least squares.

    It is looked for from 2/3 to 4/3 of `guess` (Hz); without a guess it is the strongest line of the spectrum. Up to
    20 harmonics below half the sample rate are fitted along, so that they do not pull at it where the stretch is no
    whole number of periods.

    Raises ValueError for unfit samples, for fewer than 3 periods, and where there is no fundamental: less than a tenth
    of the power about the mean is at that frequency.
    """
    t, y = checked(t=t, y=y)
    period = sample_period(t)
    if guess is not None and not 0 < guess < 0.5 / period:
        raise ValueError(f"guess: {guess:g} Hz is not between 0 and half the sample rate, {0.5 / period:g} Hz")
    lines = spectrum(t, y)
    inside = lines.f > 0 if guess is None else np.abs(lines.f / guess - 1.0) <= 1.0 / 3.0
    if guess is not None:
        _whole_periods(len(t), guess * period)
    line = float(lines.f[inside][np.argmax(lines.amplitude[inside])])
    _refuse_weak(abs(fit_harmonics(TWO_PI * line * (t - t[0]), y, 1)[1]), y, f"{line:.4g} Hz")
    _whole_periods(len(t), line * period)
    f = _refined(t, y, line, period)
    amplitude = fit_harmonics(TWO_PI * f * (t - t[0]), y, _order_below(0.5 / (f * period), ORDER))[1]
    phase = wrap(np.angle(amplitude) + np.array(math.pi / 2.0))  # cosine to sine
    return Fundamental(f, float(abs(amplitude)), float(phase))


def thd(t: ArrayLike, y: ArrayLike, f: float | None = None, order: int = ORDER) -> Thd:
    """Total harmonic distortion (20), sqrt(sum of I_n^2 for n = 2..order) / I_1, of `y` (n,) at `t` (n,) s uniform.

    `f` (Hz) is taken as it is; without it, it is that of `fundamental(t, y)`. The mean is no part of the distortion,
    nor is anything between the harmonics: `periodic` tells how much that is. With a speed that varies the harmonics
    smear, the high ones first: see `thd_by_angle`.

    Raises ValueError for unfit samples, for fewer than 3 periods, where `order` times f is not below half the sample
    rate, and where there is no fundamental (see `fundamental`).
    """
    t, y = checked(t=t, y=y)
    period = sample_period(t)
    f = fundamental(t, y).f if f is None else f
    if not (f > 0 and order * f < 0.5 / period):
        raise ValueError(
            f"harmonic {order} of {f:.4g} Hz is not between 0 and half the sample rate, {0.5 / period:g} Hz: "
            "sample faster or take a lower order"
        )
    return _distortion(TWO_PI * f * (t - t[0]), y, order, f"{f:.4g} Hz")._replace(f=f)


def thd_by_angle(theta: ArrayLike, y: ArrayLike, order: int = ORDER) -> Thd:
    """Total harmonic distortion (20) over the electrical angle `theta` (n,) rad, unwrapped, in place of the time.

    Harmonic n is what goes through n periods in one electrical turn, so a speed that varies does not smear it; the
    samples need not be uniform in the angle, and the rotor may turn backwards. Each sample counts alike.

    Raises ValueError for unfit samples, for fewer than 3 turns, where a step of the angle from sample to sample is half
    a period of harmonic `order` or more (a wrapped angle is such a one), and where there is no fundamental.
    """
    theta, y = checked(theta=theta, y=y)
    widest = float(np.abs(np.diff(theta)).max())
    if order * widest >= math.pi:
        raise ValueError(
            f"theta steps by {widest:.4g} rad, harmonic {order} takes steps below {math.pi / order:.4g} rad: "
            "unwrap theta, sample faster or take a lower order"
        )
    return _distortion(theta - theta[0], y, order, "one period a turn")


def _distortion(phase: Floats, y: Floats, order: int, where: str) -> Thd:
    """(20) over `phase` (n,) rad from 0; `where` is the fundamental in words."""
    if order < 2:
        raise ValueError(f"order must be >= 2, got {order}")
    phase, y, periods = _trimmed(phase, y)
    amplitudes = np.abs(fit_harmonics(phase, y, order)[1:])
    _refuse_weak(float(amplitudes[0]), y, where)
    return Thd(float(np.sqrt(np.sum(amplitudes[1:] ** 2)) / amplitudes[0]), None, amplitudes, periods)


def _refuse_weak(amplitude: float, y: Floats, where: str) -> None:
    if not (amplitude > ROUNDING * np.abs(y).max() and amplitude**2 / 2.0 >= LEAST_SHARE * y.var()):
        raise ValueError(f"no fundamental: at {where} the amplitude is {amplitude:.3g}, the rms of all {y.std():.3g}")


def _whole_periods(n: int, per_sample: float) -> int:
    """How many whole periods n samples have, of `per_sample` periods each; one sample may lack."""
    if (periods := math.floor((n + 1) * per_sample)) < PERIODS:
        raise ValueError(f"{n * per_sample:.3g} periods are too few: record at least {PERIODS}")
    return periods


def _trimmed(phase: Floats, y: Floats) -> tuple[Floats, Floats, int]:
    """The first samples of `phase` (rad, from 0) and `y`, as many as make up whole periods; and how many periods."""
    step = abs(float(phase[-1])) / (len(phase) - 1)
    periods = _whole_periods(len(phase), step / TWO_PI)
    beyond = np.flatnonzero(np.abs(phase) >= TWO_PI * periods - step / 2.0)
    end = int(beyond[0]) if len(beyond) else len(phase)
    return phase[:end], y[:end], periods


def _order_below(limit: float, order: int) -> int:
    """`order`, or the highest one below `limit`, at least 1."""
    return max(1, min(order, math.ceil(limit) - 1))


def _columns(phase: Floats, order: int) -> Floats:
    """(n, 1 + 2 order): 1, the cosines and the sines of 1..order times `phase`."""
    turning = np.outer(phase, np.arange(1, order + 1))
    return np.concatenate([np.ones((len(phase), 1)), np.cos(turning), np.sin(turning)], axis=1)


def fit_harmonics(phase: Floats, y: Floats, order: int) -> NDArray[np.complex128]:
    """(order + 1,) amplitudes c with y = Re(sum of c_n exp(j n phase))."""
    mean, cosines, sines = np.split(least_squares(_columns(phase, order), y), [1, order + 1])
    return np.concatenate([mean + 0j, cosines - 1j * sines])


def _refined(t: Floats, y: Floats, line: float, period: float) -> float:
    """The frequency near a `line` of the spectrum, by Gauss-Newton steps: of the fundamental alone, then of all.

    Half a line is as far as it can be off; steps beyond a whole one are cut.
    """
    f, span = line, len(t) * period
    tau = (t - (t[0] + t[-1]) / 2.0) / span  # from the middle, where frequency and phase do not pull at one another
    for order in (1, 3, ORDER):
        order = _order_below(0.5 / (f * period), order)
        numbers = np.arange(1, order + 1)
        for _ in range(20):
            columns = _columns(TWO_PI * f * span * tau, order)
            coefficients = least_squares(columns, y)
            cosines, sines = coefficients[1 : order + 1], coefficients[order + 1 :]
            slope = TWO_PI * tau * (columns[:, 1:] @ np.concatenate([numbers * sines, -numbers * cosines]))
            scale = math.hypot(cosines[0], sines[0])
            step = float(least_squares(np.column_stack([columns, slope / scale]), y)[-1]) / scale
            f = min(line + 1.0 / span, max(line - 1.0 / span, f + step / span))
            if abs(step) < 1e-10:
                break
    return f
