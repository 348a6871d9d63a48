"""Harmonics of the back-EMF at speed, and what torque a current makes with them.

A current loop lets the 5th and 7th harmonic of the back-EMF drive currents of their own. In the rotor's frame both
turn six times an electrical turn, and their product is a torque that does not swing: up to 1 % of that of i_q, which a
mean of i_q does not show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.commission.analysis.flux import ALONG_D, SETTLE, Flux
from bench.commission.analysis.stretches import merged, parts
from bench.commission.window import Complexes, Floats, Window
from bench.signal.position import unwrapped

ORDERS = np.array([-12, -6, 6, 12])
"""Turns in the rotor's frame per electrical turn: of the 11th, 5th, 7th and 13th harmonic of a phase."""


@dataclass(frozen=True)
class Harmonics:
    """What the voltage per electrical speed has beside its fundamental, in the rotor's frame."""

    share: Complexes
    """Shape (4,), by `ORDERS`: of psi."""

    def torque_current(self, theta: Floats, i: Complexes) -> Floats:
        """A, shape (n,): the q current that makes the torque of `i`, i_d + j i_q, at these angles (rad, electrical)."""
        flux = 1j + np.exp(1j * np.multiply.outer(theta, ORDERS)) @ self.share
        return np.asarray((flux * np.conj(i)).real)


NONE = Harmonics(np.zeros(len(ORDERS), complex))


def harmonics(windows: Sequence[Window], found: Flux, R: float, L_q: float) -> Harmonics:
    """Of windows of the kinds "d+" and "d-" with an encoder; `found`: where the flux is; R in ohm, L_q in H.

    What dead time leaves lies along the current, whose two signs cancel it. `NONE` where there are too few samples.
    """
    rows, across = [], []
    for window in merged(windows):
        if window.kind not in ALONG_D or window.theta is None:
            continue
        begin = round(SETTLE / window.T)
        theta, current, u = unwrapped(window.theta)[begin:], window.current[begin:], window.u[begin:]
        for part in parts(theta, window.T) if len(theta) > 1 else ():
            w = float(theta[part][-1] - theta[part][0]) / (window.T * (part.stop - part.start - 1))
            at = theta[part] - found.error(w)
            middle = 0.5 * (at[1:] + at[:-1])
            i = current[part] * np.exp(-1j * at)
            slope, mean = np.diff(i) / window.T, 0.5 * (i[1:] + i[:-1])
            along = (u[part][1:] - 0.5 * R * (current[part][1:] + current[part][:-1])) * np.exp(-1j * middle)
            L_d = found.L_d.value
            across.append(
                along - L_d * slope.real - 1j * L_q * slope.imag - w * (1j * L_d * mean.real - L_q * mean.imag)
            )
            orders = np.append(ORDERS, 0)
            shrink = np.sinc((orders + 1) * 0.5 * w * window.T / math.pi)
            rows.append(w * shrink * np.exp(1j * np.multiply.outer(middle, orders)))
    if sum(map(len, across)) < 4 * (len(ORDERS) + 1):
        return NONE
    told = np.linalg.lstsq(np.concatenate(rows), np.concatenate(across), rcond=None)[0]
    return Harmonics(told[:-1] / found.psi.value)
