"""The paper's vector-tracking observer with its load-angle compensation (18)-(19) always on.

The kernels are those of `vector_tracking`, which describes them; only the parameters differ. It runs beside the
uncompensated one, so that the two can be compared on the same signals. No test sine is ever added here.

Source: (18)-(19) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

from dataclasses import replace

from sim.observers import vector_tracking
from sim.observers.vector_tracking import Estimate, Params, Settings, State, init, step

__all__ = ["Estimate", "Params", "Settings", "State", "init", "make_params", "step"]


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    return vector_tracking.make_params(pwm_hz, replace(drive, load_angle_comp=1.0, inject=0.0))
