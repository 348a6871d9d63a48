"""The motor that the firmware takes its motor to be: its flux linkage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from bench.findings.finding import Finding
from bench.findings.thresholds import LOST_VOLTAGE, PSI_OFF, SEEN_FOR


class FluxLinkage:
    """The size of the back-EMF over the speed, where it is strong beside what else may be in it."""

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self._psi, self._R = (parameters.get(name, np.nan) for name in ("psi_f_hat", "R_s_hat"))
        self._seconds = self._turned = self._emf = self._other = 0.0

    def add(self, seconds: float, emf: float, omega: float, current: float) -> None:
        """Means over a time: V, electrical rad/s, A."""
        other = LOST_VOLTAGE + PSI_OFF * self._R * current
        if other < PSI_OFF * max(emf, self._psi * omega):
            self._seconds += seconds
            self._turned += seconds * omega
            self._emf += seconds * emf
            self._other += seconds * other

    def findings(self) -> Iterator[Finding]:
        """What is wrong with psi_f_hat, if anything is."""
        expected = self._psi * self._turned
        if self._seconds < SEEN_FOR or not abs(self._emf - expected) > PSI_OFF * expected + self._other:
            return
        yield Finding(
            "flux_linkage",
            "psi_f_hat is wrong, or R_s_hat or n_p",
            (
                f"psi_f_hat = {1e3 * self._psi:.3g} mV s, but by back-EMF and encoder it is "
                f"{1e3 * self._emf / self._turned:.3g} mV s",
            ),
            "measure the flux linkage with bench accept, test back_emf_and_encoder",
        )
