"""The frequency of what is periodic in a stretch of samples, and how sure it is; or why there is none.

The strongest line of the spectrum is followed, or the lowest of which that is a harmonic: whole periods of it make
batches, and the phases of the batches lie on a line over time, whose slope is what the frequency is off by. Their
scatter about it tells the uncertainty, whatever the noise is: nothing is assumed of it, harmonics included.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.signal.batches import BATCHES, ROUNDING, slope, slope_error, standard_error, student
from bench.signal.waveforms import spectrum
from bench.signal.waveforms.harmonics import LEAST_SHARE, fit_harmonics

F64 = NDArray[np.float64]

PERIODS = 5
"""Fewest that are taken for a periodic waveform: a slow drift has two or three by chance."""
LEAST_SAMPLES = 32
SAMPLES = 32
"""Of a period, that are enough."""
CHANCE = 12.0
"""Of -ln of the chance that the strongest line of noise is taken for a tone."""
FLOOR = 0.01
"""Lines of the spectrum that an uncertainty is at least: a step lies somewhere between two samples."""
COHERENT = 0.9
"""Share of the batches' amplitudes that stands still at one frequency."""
MOST = 7
"""The highest harmonic that may be the strongest line."""
STEADY = 0.02
"""Share of the frequency that windows of a steady one may be apart."""
NONE, CONSTANT, FEW, UNSTEADY = "no periodic part", "constant", "too few samples", "not steady"


@dataclass(frozen=True)
class Tone:
    """A frequency in Hz; `half_width` of its 95 % confidence interval."""

    f: float
    half_width: float


def tone_of(y: F64, rate: float) -> Tone | str:
    """The fundamental of `y` (n,), finite, `rate` samples a second without a gap; or in words why there is none."""
    n = len(y)
    if n < LEAST_SAMPLES:
        return FEW
    x = np.arange(n) - (n - 1) / 2.0
    rest = y - y.mean()
    rest -= x * float(x @ rest) / float(x @ x)
    power = float(rest @ rest) / n
    if power <= (ROUNDING * float(np.abs(y).max())) ** 2:
        return CONSTANT
    lines = spectrum(np.arange(n), rest).amplitude ** 2
    k = int(np.argmax(lines[1:])) + 1
    if k < PERIODS or not _prominent(lines, k):
        return NONE
    for m in range(MOST, 1, -1):  # it may be a harmonic
        low = round(k / m) - 1
        lower = low + int(np.argmax(lines[low : low + 3])) if low >= PERIODS - 1 else 0
        if lower >= PERIODS and lines[lower] / 2.0 >= LEAST_SHARE * power and _prominent(lines, lower):
            k = lower
            break
    per_sample = k / n
    if (m := n // (k * SAMPLES)) > 1:  # their means have the same frequency, and take less time
        n //= m
        x, rest = np.arange(n) - (n - 1) / 2.0, rest[: n * m].reshape(n, m).mean(axis=1)
        rate, per_sample = rate / m, per_sample * m
    for _ in range(2):
        found, half_width, coherent, amplitude = _followed(x, rest, per_sample)
        if not abs(found - per_sample) * n <= 1.0:
            return UNSTEADY
        per_sample = found
    if amplitude**2 / 2.0 < LEAST_SHARE * power:
        return NONE
    if coherent < COHERENT:
        return UNSTEADY
    return Tone(per_sample * rate, half_width * rate)


def _prominent(lines: F64, k: int) -> bool:
    """Whether a line of the power spectrum stands out of those about it as none of noise does."""
    about = np.concatenate([lines[k // 2 : k - 2], lines[k + 3 : 2 * k + 1]])
    strong = (math.log(len(lines)) + CHANCE) / math.log(2.0)  # lines of noise have an exponential distribution
    return len(about) > 0 and bool(lines[k] >= strong * np.median(about))


def _followed(x: NDArray[Any], y: NDArray[Any], per_sample: float) -> tuple[float, float, float, float]:
    """Periods a sample by the phases of batches about `per_sample`, its half width, coherence and their amplitude.

    `x` (n,): the number of each sample, from the middle.
    """
    periods = math.floor((len(x) + 1) * per_sample)
    k = min(range(min(BATCHES, periods), min(BATCHES, periods) // 2, -1), key=lambda k: periods % k)
    size = periods // k / per_sample
    bounds = np.minimum(np.ceil(np.arange(k + 1) * size - 0.5), len(x)).astype(int)
    spans = [slice(a, b) for a, b in pairwise(bounds.tolist())]
    phasors = np.array([fit_harmonics(math.tau * per_sample * x[span], y[span], 1)[1] for span in spans])
    at = np.array([float(x[span].mean()) for span in spans])
    phase = np.unwrap(np.angle(phasors))
    sums = np.array([np.ones(k), at, phase, at * at, at * phase])
    off, error = float(slope(sums.sum(axis=1))), slope_error(sums)[0]
    still = phasors * np.exp(-1j * (off * at))
    coherent = float(abs(still.sum()) / max(float(np.abs(still).sum()), 1e-300))
    half_width = math.hypot(student(k - 2) * error / math.tau, FLOOR / len(x))
    return per_sample + off / math.tau, half_width, coherent, float(np.abs(still).mean())


class Tones:
    """The fundamental over windows that follow each other."""

    def __init__(self) -> None:
        self._tones: list[Tone] = []
        self._span = math.inf, 0.0  # Hz
        self._why: set[str] = set()

    def add(self, y: F64, rate: float, whole: bool) -> None:
        """Add the longest stretch of a window without a gap, (n,); `whole`: it is most of the window."""
        if self._unsteady:
            return  # what comes does not make it steady
        found = tone_of(y, rate)
        if isinstance(found, Tone):
            self._tones.append(found)
            self._span = min(self._span[0], found.f), max(self._span[1], found.f)
        else:
            self._why.add(found if whole else FEW)

    @property
    def _unsteady(self) -> bool:
        low, high = self._span
        return UNSTEADY in self._why or bool(self._tones and (self._why - {FEW} or high - low > STEADY * high))

    def result(self) -> Tone | str:
        """The mean over time, or in words why there is none."""
        if self._unsteady:
            return UNSTEADY
        if not self._tones:
            return next((why for why in (NONE, CONSTANT) if why in self._why), FEW)
        f = np.array([tone.f for tone in self._tones])
        own = math.sqrt(sum(tone.half_width**2 for tone in self._tones)) / len(f)
        between = student(len(f) - 1) * standard_error(f)[0] if len(f) > 1 else 0.0
        return Tone(float(f.mean()), max(own, between))
