"""The frequency response of a loop from its answer to a test signal that repeats, with coherence and margins.

Each period of the test signal gives one response; their mean is the response, their scatter its uncertainty. Of the
closed loop T from reference to output follows the open loop L = T / (1 - T), and with it the margins. Frequencies in
Hz, phases in degrees. Nothing here talks to a drive.

Source: R. Pintelon, J. Schoukens, "System Identification: A Frequency Domain Approach", 2nd ed., Wiley 2012, section
2.5; coherence: J. S. Bendat, A. G. Piersol, "Random Data", 4th ed., Wiley 2010, chapter 9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from bench.signal.waveforms.samples import Floats, checked

Complexes = NDArray[np.complex128]

LEAST_PERIODS = 4
"""Periods without which a scatter tells nothing."""

BELIEVED = 0.15
"""Standard deviation of a response, as a share of it, up to which margins are read from a line."""


class Value(NamedTuple):
    """A value and the half width of its 95 % confidence interval, None where there is no such value."""

    value: float | None
    half_width: float | None


class Margins(NamedTuple):
    """How far a loop is from oscillating; None where the lines do not reach what it is read at, or are uncertain."""

    crossover: Value
    """Hz, where the open loop's gain is 1; of several places the one with the smallest phase margin."""
    phase_margin: Value
    """Degrees by which the open loop lags less than 180 there."""
    gain_margin: Value
    """dB that the open loop is below 1 where it lags by 180 degrees."""
    bandwidth: Value
    """Hz, where the closed loop's gain falls through 1 / sqrt 2; None where it does so more than once."""
    peak: Value
    """dB, the largest gain of the closed loop at a line."""


@dataclass(frozen=True)
class FrequencyResponse:
    """Closed-loop responses of P periods at K lines."""

    f: Floats
    """Hz, shape (K,), ascending."""
    references: Complexes
    """Amplitudes of the reference, shape (P, K)."""
    outputs: Complexes
    """Amplitudes of the output, shape (P, K)."""

    @property
    def closed(self) -> Complexes:
        """T, output over reference, shape (K,)."""
        return _closed(self.references, self.outputs)

    @property
    def open(self) -> Complexes:
        """L = T / (1 - T), shape (K,)."""
        return self.closed / (1.0 - self.closed)

    @property
    def coherence(self) -> Floats:
        """Share of the output's power that the reference explains, 0 to 1, shape (K,)."""
        cross = np.abs(np.sum(self.outputs * self.references.conj(), axis=0)) ** 2
        powers = np.sum(np.abs(self.references) ** 2, axis=0) * np.sum(np.abs(self.outputs) ** 2, axis=0)
        return np.asarray(np.divide(cross, powers, out=np.zeros(len(self.f)), where=powers > 0))

    @property
    def deviation(self) -> Floats:
        """Standard deviation of T in each of two directions at right angles, shape (K,), by the periods' scatter."""
        n = len(self.references)
        left = self.outputs - self.closed * self.references
        power = np.mean(np.abs(self.references) ** 2, axis=0)
        return np.asarray(np.sqrt(np.sum(np.abs(left) ** 2, axis=0) / (2.0 * n * (n - 1) * power)))

    def margins(self) -> Margins:
        """Margins with their intervals, by leaving out one period at a time (jackknife).

        A margin is read from lines that are known well enough only, and is not known itself where it is not there
        without one of the periods.
        """
        closed = self.closed
        sure = self.deviation <= BELIEVED * np.abs(closed)
        sure_open = sure & (self.deviation <= BELIEVED * np.abs(closed * (1.0 - closed)))  # of L: dT / (1 - T)
        known = _longest(sure), _longest(sure_open)
        whole = _margins(self.f, closed, *known)
        n = len(self.references)
        parts = [_margins(self.f, _closed(*_without(k, self.references, self.outputs)), *known) for k in range(n)]
        factor = float(stats.t.ppf(0.975, n - 1)) * math.sqrt((n - 1) / n)
        found = []
        for value, others in zip(whole, zip(*parts, strict=True), strict=True):
            each = [other for other in others if other is not None]
            if value is None or len(each) < n:
                found.append(Value(None, None))
            else:
                found.append(Value(value, factor * float(np.linalg.norm(np.array(each) - np.mean(each)))))
        return Margins(*found)


def frequency_response(
    reference: ArrayLike, output: ArrayLike, period: int, lines: Sequence[int], rate: float, late: float = 0.0
) -> FrequencyResponse:
    """The response of `output` (n,) to `reference` (n,), sampled at `rate` Hz, to a test signal of `period` samples.

    `lines`: harmonics of the period at which it has power. `late`: samples by which `reference` is recorded later than
    it acts. What is left of a last period is not used. ValueError for unfit samples, for fewer than LEAST_PERIODS, and
    for lines at which the reference has no power.
    """
    reference, output = checked(reference=reference, output=output)
    count = len(reference) // period
    if count < LEAST_PERIODS:
        raise ValueError(f"{count} periods of the test signal of {period} samples: needs {LEAST_PERIODS} or more")
    chosen = np.array(sorted(lines), dtype=int)
    if not len(chosen) or chosen[0] < 1 or chosen[-1] >= period / 2:
        raise ValueError(f"lines must lie between 1 and {period // 2}, got {chosen[:1]} to {chosen[-1:]}")
    shaped = [x[: count * period].reshape(count, period) for x in (reference, output)]
    # a drift over the periods leaks into all lines: the straight part of it is taken out
    slope = (np.arange(period) - (period - 1) / 2) / period
    drifts = [np.gradient(x.mean(axis=1)) if count > 1 else np.zeros(count) for x in shaped]
    level = [x - np.outer(drift, slope) for x, drift in zip(shaped, drifts, strict=True)]
    amplitudes = [2.0 / period * np.fft.rfft(x, axis=1)[:, chosen] for x in level]
    power = np.mean(np.abs(amplitudes[0]) ** 2, axis=0)
    if np.any(weak := power < 1e-12 * power.max()):
        f = chosen[int(np.argmax(weak))] * rate / period
        raise ValueError(f"the reference has no power at {f:g} Hz: the test signal did not reach the loop")
    shift = np.exp(2j * np.pi * chosen * late / period)
    return FrequencyResponse(chosen * (rate / period), amplitudes[0] * shift, amplitudes[1])


def _closed(references: Complexes, outputs: Complexes) -> Complexes:
    found: Complexes = np.sum(outputs * references.conj(), axis=0) / np.sum(np.abs(references) ** 2, axis=0)
    return found


def _without(k: int, *arrays: Complexes) -> list[Complexes]:
    return [np.delete(array, k, axis=0) for array in arrays]


def _margins(
    f: Floats, closed: Complexes, sure: NDArray[np.bool_], sure_open: NDArray[np.bool_]
) -> tuple[float | None, ...]:
    """In the order of `Margins`; `sure`, `sure_open`: lines at which T and L are known. The worst crossover counts."""
    opened = closed / (1.0 - closed)
    gain, x = np.log(np.abs(opened)), np.log(f)
    phase = np.unwrap(np.angle(opened))
    phase -= 2.0 * np.pi * round((phase[0] + np.pi / 2) / (2.0 * np.pi))  # a loop with an integral begins near -90
    crossovers = [(math.pi + float(np.interp(at, x, phase)), at) for at in _crossings(x, gain, sure_open)]
    margin, crossover = min(crossovers, default=(None, None))
    lags = [float(np.interp(at, x, gain)) for at in _crossings(x, phase + np.pi, sure_open)]
    bands = _crossings(x, np.log(np.abs(closed)) + 0.5 * math.log(2.0), sure)
    decibel = 20.0 / math.log(10.0)
    return (
        None if crossover is None else math.exp(crossover),
        None if margin is None else math.degrees(margin),
        -decibel * max(lags) if lags else None,
        math.exp(bands[0]) if len(bands) == 1 else None,
        decibel * float(np.max(np.log(np.abs(closed[sure])))) if sure.any() else None,
    )


def _longest(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Only the longest row of neighbours that are known: beyond a gap a curve may have gone through anything."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]])))
    rows = edges.reshape(-1, 2)
    kept = np.zeros(len(known), dtype=bool)
    if len(rows):
        first, end = rows[int(np.argmax(rows[:, 1] - rows[:, 0]))]
        kept[first:end] = True
    return kept


def _crossings(x: Floats, y: Floats, known: NDArray[np.bool_]) -> list[float]:
    """Where `y` goes through 0, on straight lines between neighbours that are known, ascending."""
    at = np.flatnonzero(((y[:-1] >= 0.0) != (y[1:] >= 0.0)) & known[:-1] & known[1:])
    return [float(x[k] + (x[k + 1] - x[k]) * y[k] / (y[k] - y[k + 1])) for k in at]
