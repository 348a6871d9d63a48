"""Position held at the centre of the Hall sector: what a six-step drive knows of its rotor.

At constant speed and with well-placed sensors the error is a sawtooth of +-30 deg, 17.3 deg rms. It is none of the
methods that the paper names: the zeroth-order algorithm of [14] and [15] holds a speed over a sector, not an angle, and
is `average_speed` here. The paper only starts from this angle where no speed is known.

Never interpolates, and remembers nothing. The speed is omega_h of (1), which the front end makes from the edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.average_speed import centre
from sim.observers.sample import Sample
from sim.observers.transforms import wrap


@dataclass(frozen=True, kw_only=True)
class Settings:
    """It takes no parameter of the drive."""


class Params(NamedTuple):
    """No constants."""


class State(NamedTuple):
    """Nothing is remembered."""


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample; 0: no sector known yet
    omega: float  # omega_h, electrical rad/s


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """No constants; the arguments are taken because every observer takes them."""
    return Params()


@kernel
def init() -> State:
    """Nothing to know."""
    return State()


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    hall = sample.hall
    theta = 0.0 if hall.sector < 0 else wrap(centre(hall.sector, sample.hall_offset))
    return state, Estimate(theta, hall.omega)
