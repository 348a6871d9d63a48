"""Amplitudes over frequency, and the response to an injected sine.

Frequencies are in Hz, amplitudes are peak values in the unit of `y`. Nothing here looks for harmonics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.signal.waveforms.samples import Floats, checked, least_squares, sample_period

TWO_PI = 2.0 * np.pi


class Spectrum(NamedTuple):
    """Amplitude spectrum with n // 2 + 1 lines."""

    f: Floats
    """Hz, from 0 to half the sample rate."""
    amplitude: Floats
    """Peak values in the unit of y; at 0 Hz the magnitude of the mean."""


def spectrum(t: ArrayLike, y: ArrayLike, window: Literal["hann", "rectangular"] = "hann") -> Spectrum:
    """Amplitude spectrum of `y` (n,) at `t` (n,) s: a sine of amplitude A that falls on a line shows as A there.

    Between two lines it shows as at least 0.85 A with the Hann window and 0.64 A with the rectangular one. The mean is
    taken out first, so that the window does not spread it over its neighbours. Raises ValueError for unfit samples.
    """
    t, y = checked(t=t, y=y)
    n, period = len(y), sample_period(t)
    weights = np.ones(n) if window == "rectangular" else 0.5 - 0.5 * np.cos(TWO_PI * np.arange(n) / n)
    amplitude = 2.0 * np.abs(np.fft.rfft((y - y.mean()) * weights)) / weights.sum()
    if n % 2 == 0:
        amplitude[-1] /= 2.0  # half the sample rate has no mirror image
    amplitude[0] = abs(y.mean())
    return Spectrum(np.arange(n // 2 + 1) / (n * period), amplitude)


def sine_response(
    t: ArrayLike, y: ArrayLike, f: float, reference_phase: ArrayLike, also: Sequence[float] = ()
) -> complex:
    """Gain G with which `y` answers sin(reference_phase): y = |G| sin(reference_phase + arg G) + offset + the rest.

    `t` (n,) s uniform, `y` (n,), `reference_phase` (n,) rad, wrapped or not, advancing by 2 pi `f` a second; `f` in Hz.
    The unit of G is that of y for a reference of amplitude 1: divide by the amplitude that was injected. A lag is a
    negative angle. Sines at the frequencies `also` (Hz) are fitted along, so that a disturbance known by its frequency
    leaves the gain alone; all in one least-squares fit, so nothing need fit into the stretch a whole number of times.

    Raises ValueError for unfit samples, for less than one period of f, for a reference that does not advance at f to
    within a tenth of a period over the stretch, and for frequencies not below half the sample rate or less than one
    period over the stretch apart: such a fit could not tell them apart.
    """
    t, y, phase = checked(t=t, y=y, reference_phase=reference_phase)
    period = sample_period(t)
    span = len(t) * period
    fitted = (0.0, f, *also)  # 0 is the offset
    for frequency in fitted[1:]:
        if not 0 < frequency < 0.5 / period:
            raise ValueError(f"{frequency:g} Hz is not between 0 and half the sample rate, {0.5 / period:g} Hz")
    ordered = np.sort(fitted)
    nearest = int(np.argmin(np.diff(ordered)))
    if (ordered[nearest + 1] - ordered[nearest]) * span < 0.999:
        raise ValueError(
            f"{span:.4g} s are too short to resolve {ordered[nearest]:g} Hz from {ordered[nearest + 1]:g} Hz: "
            "record longer or omit one"
        )
    turns = float(np.unwrap(phase)[-1] - phase[0]) / TWO_PI
    if abs(turns - f * (t[-1] - t[0])) > 0.1:
        raise ValueError(f"reference_phase advances at {turns / (t[-1] - t[0]):.6g} Hz, not at {f:g} Hz")
    disturbing = TWO_PI * np.outer(t - t[0], also)
    columns = np.column_stack([np.sin(phase), np.cos(phase), np.ones(len(t)), np.sin(disturbing), np.cos(disturbing)])
    in_phase, quadrature = least_squares(columns, y)[:2]
    return complex(in_phase, quadrature)
