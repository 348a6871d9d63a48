"""Statistics of an error, and by how long an estimate is late: put together piece by piece, in bounded memory.

Samples may come in any pieces, and what was found of some can be merged with what was found of others: the result is
that of all of them at once. Undefined values are None: a statistic of no samples, a lag without a change of speed.
Nothing here knows a unit.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]
Spectra = NDArray[np.complex128]

LAG_SPAN = 0.2  # the least range of speeds, as a share of the largest, that a lag is measured from
MAX_LAG = 0.05  # s, the longest that is looked for
ITERATIONS = 12


class LagBySpeed:
    """By how many seconds an angle is late: the slope of its error in rad over the speed in rad/s.

    An angle that is tau late errs by omega tau, so the slope of the straight line nearest to the samples is tau; what
    does not depend on speed, such as a misplaced zero, drops out.
    """

    def __init__(self) -> None:
        self._n = 0
        self._mean = np.zeros(2)  # of speed and error
        self._square = self._product = 0.0  # about the means: speed by speed, speed by error
        self._span = math.inf, -math.inf

    def add(self, omega: F64, error: F64) -> None:
        """Add samples, (n,) each."""
        if len(omega):
            part = LagBySpeed()
            part._n = len(omega)
            part._mean = np.array([omega.mean(), error.mean()])
            off = omega - part._mean[0]
            part._square, part._product = float((off * off).sum()), float((off * (error - part._mean[1])).sum())
            part._span = float(omega.min()), float(omega.max())
            self.merge(part)

    @classmethod
    def of(cls, n: float, omega: float, error: float, square: float, product: float, *span: float) -> Self:
        """That of n samples: means, sums about them of speed by speed and speed by error, slowest and fastest."""
        made = cls()
        made._n, made._mean, made._square, made._product = int(n), np.array([omega, error]), square, product
        made._span = span[0], span[1]
        return made

    def merge(self, other: LagBySpeed) -> None:
        """Add those that another has."""
        total = self._n + other._n
        if not other._n:
            return
        delta = other._mean - self._mean
        weight = self._n * other._n / total
        self._square += other._square + weight * float(delta[0] ** 2)
        self._product += other._product + weight * float(delta[0] * delta[1])
        self._mean = self._mean + delta * other._n / total
        self._n = total
        self._span = min(self._span[0], other._span[0]), max(self._span[1], other._span[1])

    def lag(self) -> float | None:
        """s; None where the speeds span too little."""
        lo, hi = self._span
        if self._n < 2 or hi - lo < LAG_SPAN * max(abs(lo), abs(hi)):
            return None
        return self._product / self._square if self._square > 0.0 else None


class Changes:
    """A stretch of a quantity that changes: what the lag of any estimate of it is told from.

    `actual` (n,): `rate` samples a second without a gap. `where` (n,): those whose estimates count; on either side of
    them are `reach(rate)` samples more, or the quantity stays as it is at the ends.
    """

    def __init__(self, actual: F64, where: Flags, rate: float) -> None:
        self.rate, self.where = rate, where
        slope = np.gradient(actual) * rate if len(actual) > 1 else np.zeros(len(actual))
        rows = self._rows(where.astype(np.float64))
        self._used = rows.any(axis=1)
        count = np.conj(self._spectra(rows[self._used]))
        a, s, b, t = (self._windows(of, ahead)[self._used] for ahead in (0, 1) for of in (actual, slope))
        self._slope = self._spectra(s)
        self._own = [(count * self._spectra(of)).sum(axis=0) for of in (s * a, s * b + t * a, s * s, s * t)]

    def against(self, estimate: F64) -> Spectra:
        """What `LagInTime` takes of an estimate (n,), finite `where` it counts."""
        weighted = np.zeros(len(estimate))
        weighted[self.where] = estimate[self.where]
        found = np.conj(self._spectra(self._rows(weighted)[self._used])) * self._slope
        return np.stack([*self._own, found.sum(axis=0)])

    def _windows(self, values: F64, ahead: int) -> F64:
        """Stretches of `values`, `ahead` samples later, each with all that a hop of estimates is compared with."""
        far, _, hop = sizes(self.rate)
        n = -(-len(values) // hop) * hop
        padded = np.pad(values, (far, n - len(values) + far + 2), "edge")[ahead:]
        return np.lib.stride_tricks.sliding_window_view(padded, hop + 2 * far)[:n:hop]

    def _rows(self, values: F64) -> F64:
        """Values by the stretch that they are compared with."""
        _, _, hop = sizes(self.rate)
        return np.pad(values, (0, -len(values) % hop)).reshape(-1, hop)

    def _spectra(self, rows: F64) -> Spectra:
        """Spectra of rows; weights' conjugate times values' is that of the sums over t of weights[t] values[t + m]."""
        return np.fft.rfft(rows, sizes(self.rate)[1])


def reach(rate: float) -> int:
    """Samples on either side that a lag is looked for in, one more included."""
    return math.ceil(MAX_LAG * rate) + 2


def sizes(rate: float) -> tuple[int, int, int]:
    """`reach`, length of a transform, and how many estimates are compared in one."""
    far = reach(rate)
    size = 1 << (4 * 2 * far - 1).bit_length()
    return far, size, size - 2 * far


class LagInTime:
    """By how many seconds estimates are late behind the actual quantity.

    The shift tau that makes the sum of (estimate(t) - actual(t - tau))^2 least, which is where their cross-correlation
    is largest; found between samples, by Gauss and Newton's iteration. All its sums are quadratic in the share of a
    sample that is left, with coefficients that are correlations at whole samples: these are what is kept, as spectra.
    """

    def __init__(self) -> None:
        self._spectra: dict[float, Spectra] = {}  # by rate

    def add(self, changes: Changes, spectra: Spectra) -> None:
        """Add what `changes.against` an estimate has told."""
        known = self._spectra.get(changes.rate)
        self._spectra[changes.rate] = spectra if known is None else known + spectra

    def merge(self, other: LagInTime) -> None:
        """Add what another has."""
        for rate, spectra in other._spectra.items():
            self._spectra[rate] = spectra + self._spectra.get(rate, 0.0)

    def lag(self) -> float | None:
        """s; None where nothing changes, and for a shift beyond `MAX_LAG`."""
        known = [(rate, reach(rate), np.fft.irfft(spectra)) for rate, spectra in self._spectra.items()]
        tau = 0.0
        for _ in range(ITERATIONS):
            square = product = 0.0
            for rate, far, (sa, mixed, ss, next_s, se) in known:
                whole = math.floor(-tau * rate)
                m, f = whole + far, -tau * rate - whole
                g = 1.0 - f
                square += g * g * ss[m] + 2.0 * f * g * next_s[m] + f * f * ss[m + 1]
                product += g * g * sa[m] + f * g * mixed[m] + f * f * sa[m + 1] - g * se[m] - f * se[m + 1]
            if not square > 0.0:
                return None
            tau += float(product / square)
            if abs(tau) > MAX_LAG:
                return None
        return tau
