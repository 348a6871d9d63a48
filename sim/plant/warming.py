"""What changes slowly: winding and magnet get warm, and the current sensors drift as their electronics do.

    C_w dT_w/dt = 3/2 R_s i^2 - (T_w - T_h) / R_th_winding
    C_h dT_h/dt = (T_w - T_h) / R_th_winding - (T_h - T_ambient) / R_th_housing

with C_w = tau_winding / R_th_winding and C_h = tau_housing / R_th_housing, as data sheets give them. The magnet has the
housing's temperature. R_s rises with the winding's temperature, psi_f falls with the magnet's; what the drive assumes
stays as it is. Offset and gain of the current sensors go to their drift with one time constant from switching on.

Everything here moves within seconds, so it is worked out every `EVERY` control periods, exactly for the mean loss
in between, and the kernels take its results as constants.

Source: maxon's catalogue, "Thermal behaviour", for the two bodies; IEC 60034-1 for the resistance of copper.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

EVERY = 4096
COPPER = 1.0 / 255.0  # 1/K, of the resistance at 20 degrees C: 1 / (235 + 20), IEC 60034-1


class Params(NamedTuple):
    """As data sheets give them; temperatures in degrees C."""

    ambient: float
    R_th_winding: float  # K/W, winding to housing; 0: the motor stays as it is
    R_th_housing: float  # K/W, housing to ambient
    tau_winding: float  # s
    tau_housing: float  # s
    magnet: float  # 1/K, of psi_f
    drift_offset: Sequence[float]  # A, of the phases' current sensors once their electronics are warm
    drift_gain: Sequence[float]
    tau_drift: float  # s


class State(NamedTuple):
    """Temperatures above the ambient's, K, and s since switching on."""

    winding: float
    housing: float
    since: float


class Factors(NamedTuple):
    """By what the motor's constants have changed."""

    R_s: float
    psi_f: float


COLD = Factors(1.0, 1.0)


class Warming:
    """The temperatures of a motor and of its current sensors' electronics.

    Args:
        params: the figures.
        seconds: between two calls of `heat`.
    """

    def __init__(self, params: Params, seconds: float) -> None:
        self._params, self._seconds = params, seconds
        self.state = State(0.0, 0.0, 0.0)
        self._heats = params.R_th_winding > 0.0
        if self._heats:
            c_w = params.tau_winding / params.R_th_winding
            c_h = params.tau_housing / params.R_th_housing
            across, out = 1.0 / params.R_th_winding, 1.0 / params.R_th_housing
            rates = np.array([[-across / c_w, across / c_w], [across / c_h, -(across + out) / c_h]])
            values, vectors = np.linalg.eig(rates)
            self._after = ((vectors * np.exp(values * seconds)) @ np.linalg.inv(vectors)).real
            self._at_last = np.array([params.R_th_winding + params.R_th_housing, params.R_th_housing])  # K/W

    def heat(self, R_s: float, square: float) -> None:
        """The next stretch, with a mean square (A2) of the current's amplitude, in a winding (ohm) as warm as it is."""
        winding, housing, since = self.state
        if self._heats:
            end = 1.5 * R_s * square * self._at_last
            winding, housing = end + self._after @ (np.array([winding, housing]) - end)
        self.state = State(float(winding), float(housing), since + self._seconds)

    @property
    def factors(self) -> Factors:
        """Of the motor as warm as it is now."""
        if not self._heats:
            return COLD
        ambient = self._params.ambient - 20.0
        return Factors(
            1.0 + COPPER * (ambient + self.state.winding),
            1.0 + self._params.magnet * self.magnet,
        )

    @property
    def magnet(self) -> float:
        """By how much, K, the housing and the magnet are warmer than 20 degrees C."""
        return self._params.ambient - 20.0 + self.state.housing if self._heats else 0.0

    def drifted(self, offset: Sequence[float], gain_error: Sequence[float]) -> dict[str, tuple[float, ...]]:
        """Offsets (A) and gain errors of the current sensors now, by these names, from those at switching on."""
        share = -math.expm1(-self.state.since / self._params.tau_drift)
        return {
            "offset": _moved(offset, self._params.drift_offset, share),
            "gain_error": _moved(gain_error, self._params.drift_gain, share),
        }


def _moved(first: Sequence[float], by: Sequence[float], share: float) -> tuple[float, ...]:
    return tuple(one + share * more for one, more in zip(first, by, strict=True))
