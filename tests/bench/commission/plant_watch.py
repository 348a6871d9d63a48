"""What the plant itself has done, period by period: the currents in the motor and the speed of its shaft."""

from __future__ import annotations

import math

import numpy as np

from sim.drive.machine import Recorded
from sim.ports.device import SimulatedDevice

AXES = {"a": 0.0, "b": 2.0 * math.pi / 3.0, "c": -2.0 * math.pi / 3.0}


class PlantWatch:
    """Looks at every period that a simulated device runs from now on."""

    def __init__(self, device: SimulatedDevice) -> None:
        self.largest, self.fastest, self.now, self.highest = 0.0, 0.0, 0j, 0.0
        """A, of a phase; rad/s of the shaft; A, the mean current vector of what it ran last; V of the DC link."""
        self._advance = device.bench.advance
        device.bench.advance = self._looked_at  # type: ignore[method-assign]

    def _looked_at(self, n: int) -> Recorded:
        recorded = self._advance(n)
        if n:
            vector = recorded["i_alpha_true"] + 1j * recorded["i_beta_true"]
            phases = [np.abs((vector * np.exp(-1j * axis)).real).max() for axis in AXES.values()]
            self.largest = max(self.largest, float(max(phases)))
            self.fastest = max(self.fastest, float(np.abs(recorded["omega_m"]).max()))
            self.highest = max(self.highest, float(recorded["u_dc"].max()))
            self.now = complex(vector.mean())
        return recorded

    def phase(self, name: str) -> float:
        """A, that flow in a phase now."""
        return (self.now * np.exp(-1j * AXES[name])).real
