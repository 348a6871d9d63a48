"""The average-speed estimate (1)-(2) as an observer like the others: the front end has made it (`average_speed`).

Never computes anything.
"""

from __future__ import annotations

from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.sample import Sample
from sim.observers.sector_centre import Params, Settings, State, init, make_params

__all__ = ["Estimate", "Params", "Settings", "State", "init", "make_params", "step"]


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample; 0: no sector known yet
    omega: float  # omega_h, electrical rad/s


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    return state, Estimate(sample.theta_avg, sample.hall.omega)
