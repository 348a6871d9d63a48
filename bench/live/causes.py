"""What a run shows of why it went wrong: wires of the Hall sensors, and the flux linkage that the firmware assumes.

Each keeps sums of the samples that it is given, and at the end names what does not fit, with the numbers. Bounds are
wide, as those of `bench.live.plausible`; `bench hall check` looks closer.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bench.analysis.wiring import AS_SPECIFIED, NONE_KNOWN, explained, tally

PSI_OFF = 0.25  # of psi_f_hat, by which it may be off; likewise of R_s_hat
LOST = 0.3  # V that dead time and noise may add to a back-EMF
LEAST_SEEN = 100  # samples in each sector with which wires are judged


class Wires:
    """The Hall codes over the encoder's angle."""

    def __init__(self) -> None:
        self._counts = np.zeros((6, 8), np.int64)

    def add(self, theta: NDArray[np.float64], hall: NDArray[np.uint8]) -> None:
        """Samples: electrical angle, rad, and code. One that is not finite, or no code, tells nothing of the wires."""
        told = np.isfinite(theta) & (hall < 8)
        self._counts += tally(theta[told], hall[told])

    def finding(self) -> str:
        """The wiring, where it is a known fault; else empty."""
        if self._counts.sum(axis=1).min() < LEAST_SEEN:
            return ""
        best, share, _, _ = explained(self._counts)
        if best in (AS_SPECIFIED, NONE_KNOWN):
            return ""
        return f"by the encoder's angle the Hall codes are those of {best} ({100 * share:.0f} % of the samples)"


class BackEmf:
    """The size of the back-EMF over the speed, where it is strong beside what else may be in it."""

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self._psi, self._R = (parameters.get(name, np.nan) for name in ("psi_f_hat", "R_s_hat"))
        self._seconds = self._turned = self._emf = self._other = 0.0

    def add(self, seconds: float, emf: float, omega: float, current: float) -> None:
        """Means over a time: V, electrical rad/s, A."""
        other = LOST + PSI_OFF * self._R * current
        if other < PSI_OFF * max(emf, self._psi * omega):
            self._seconds += seconds
            self._turned += seconds * omega
            self._emf += seconds * emf
            self._other += seconds * other

    def finding(self, least: float) -> str:
        """What is wrong with psi_f_hat, if anything is and `least` seconds showed it; else empty."""
        expected = self._psi * self._turned
        if self._seconds < least or not abs(self._emf - expected) > PSI_OFF * expected + self._other:
            return ""
        return (
            f"psi_f_hat = {1e3 * self._psi:.3g} mV s, but by back-EMF and encoder it is "
            f"{1e3 * self._emf / self._turned:.3g} mV s: psi_f_hat is wrong, or R_s_hat or n_p"
        )
