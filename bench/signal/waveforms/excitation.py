"""Test signals that repeat: one period as the samples of a waveform, each held for some PWM periods.

All have a peak of 1 and are periodic, so that a response to them has no leakage. Nothing here talks to a drive.

Source of the multisine and its phases: R. Pintelon, J. Schoukens, "System Identification: A Frequency Domain
Approach", 2nd ed., Wiley 2012, chapter 5; M. R. Schroeder, "Synthesis of low-peak-factor signals and binary sequences
with low autocorrelation", IEEE Trans. Inf. Theory, vol. 16, 1970, pp. 85-89.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.signal.waveforms.samples import Floats
from protocol.text import counted

FULL_SCALE = 32767
"""The sample of a waveform on the wire that is the amplitude."""
_TRIES = 50  # sets of phases of which the one with the smallest peak is taken


class Waveform(NamedTuple):
    """One period of a test signal: `values` (n,) from -1 to 1, each held for `hold` PWM periods.

    `lines`: which harmonics of the period (1 = once a period) carry it, ascending; empty where that is not by design.
    """

    values: Floats
    hold: int = 1
    lines: tuple[int, ...] = ()

    @property
    def periods(self) -> int:
        """PWM periods of one cycle."""
        return len(self.values) * self.hold

    def raw(self) -> np.ndarray[tuple[int, ...], np.dtype[np.int16]]:
        """The values (n,) as i16, of which 32767 is 1."""
        return np.rint(self.values * FULL_SCALE).astype("<i2")


def spread(first: int, last: int, count: int) -> tuple[int, ...]:
    """At most `count` harmonics from `first` to `last`, both included, evenly on a logarithmic scale, each once."""
    if not 1 <= first <= last:
        raise ValueError(f"harmonics from {first} to {last}: they begin at 1 and ascend")
    return tuple(np.unique(np.rint(np.geomspace(first, last, max(count, 1))).astype(int)).tolist())


def multisine(n: int, lines: Sequence[int], seed: int = 0, hold: int = 1) -> Waveform:
    """Sines of equal amplitude at these harmonics of n samples, with phases that keep the peak small."""
    chosen = _checked_lines(n, lines)
    rng, best = np.random.default_rng(seed), None
    k = np.arange(1, len(chosen) + 1)
    for attempt in range(_TRIES):
        phases = -np.pi * k * (k - 1) / len(k) if attempt == 0 else rng.uniform(0.0, 2.0 * np.pi, len(k))
        spectrum = np.zeros(n // 2 + 1, dtype=complex)
        spectrum[list(chosen)] = np.exp(1j * phases)
        values = np.fft.irfft(spectrum, n)
        values /= np.abs(values).max()
        if best is None or values.std() > best.std():  # of one peak, the most power
            best = values
    assert best is not None
    return Waveform(best, hold, chosen)


def sine(n: int, harmonic: int = 1, hold: int = 1) -> Waveform:
    """A sine, `harmonic` times in n samples."""
    (line,) = _checked_lines(n, [harmonic])
    return Waveform(np.sin(2.0 * np.pi * line * np.arange(n) / n), hold, (line,))


def noise(n: int, first: int, last: int, seed: int = 0, hold: int = 1) -> Waveform:
    """Noise that repeats: every harmonic from `first` to `last` alike, with random phases."""
    return multisine(n, range(first, last + 1), seed, hold)


def chirp(n: int, first: int, last: int, hold: int = 1) -> Waveform:
    """A sine whose frequency rises from harmonic `first` to `last` of n samples, and that ends as it begins."""
    _checked_lines(n, [first, last])
    t = np.arange(n) / n
    turns, whole = first * t + 0.5 * (last - first) * t * t, 0.5 * (first + last)
    return Waveform(np.sin(2.0 * np.pi * turns * max(1, math.floor(whole)) / whole), hold)


def square(n: int, hold: int = 1) -> Waveform:
    """High in the first half of n samples, low in the second; n even."""
    if n < 2 or n % 2:
        raise ValueError(f"a square wave of {n} samples: the number must be even, at least 2")
    return Waveform(np.repeat([1.0, -1.0], n // 2), hold, tuple(range(1, n // 2, 2)))


def table(values: ArrayLike, hold: int = 1) -> Waveform:
    """Any values (n,), scaled to a peak of 1. ValueError for none, for what is not finite and for zeros only."""
    given = np.asarray(values, dtype=np.float64)
    if given.ndim != 1 or not len(given) or not np.all(np.isfinite(given)):
        raise ValueError(f"a table needs the shape (n,) and finite values, got {given.shape}")
    if not (peak := np.abs(given).max()):
        raise ValueError(f"a table of {counted(len(given), 'zero')} excites nothing")
    return Waveform(given / peak, hold)


def _checked_lines(n: int, lines: Sequence[int]) -> tuple[int, ...]:
    chosen = tuple(sorted(set(lines)))
    if not chosen or chosen[0] < 1 or chosen[-1] >= n / 2:
        raise ValueError(f"harmonics {list(chosen)[:5]} … of {n} samples: at least one, from 1 to below {n / 2:g}")
    return chosen
