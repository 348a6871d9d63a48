"""Whether the encoder can be believed: its pole pairs by the Hall edges, its zero and direction by the back-EMF.

Hall sensors that work turn once as often as the rotor flux, whatever their wires are exchanged with; `theta_enc` is the
shaft's angle times the pole pairs that the firmware assumes. So electrical turns by the Hall inputs for each by the
encoder are the motor's pole pairs over the firmware's.

The back-EMF of a motor whose outputs are on, e = u - (R_s + j omega L_s) i, leads the rotor flux by 90 deg in the
direction of rotation: it knows neither Hall sensors nor encoder. Where it stands in the encoder's frame tells how far
the encoder's zero is off, to a few degrees. Nothing here judges Hall sensors.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np

from bench.signal.hall_inputs import Inputs
from bench.signal.trace import SLOW, Trace

CLEAR = 0.8
"""Share of the back-EMF that must stand still in the frame of a reference for its angle to be believed."""
LEAST_SAMPLES = 200
LEAST_EMF = 0.15
"""V, mean size of the back-EMF from which on it is believed: dead time and drops cost some tenths of a volt."""


@dataclass(frozen=True)
class Turns:
    """How far the shaft turned, and the pole pairs that follow."""

    up: float
    """Electrical turns by the encoder; by the Hall edges, in both directions alike, without one."""
    down: float
    by_hall: float
    """Electrical turns by the sectors, with their sign, in both directions together."""
    per_hall: float
    """Electrical turns by the encoder for each by the sectors, in the mean; NaN where that is not known."""
    n_p: int | None
    """Pole pairs that the firmware assumes; None if the drive does not say."""

    @property
    def total(self) -> float:
        """Electrical turns, both directions together."""
        return self.up + self.down

    @property
    def ratio(self) -> float:
        """Electrical turns by the Hall inputs for each by the encoder; NaN where that is not known."""
        return 1.0 / abs(self.per_hall) if self.per_hall else math.nan


@dataclass(frozen=True)
class BackEmf:
    """Where the back-EMF stands in the encoder's frame."""

    zero: float
    """rad in [-pi, pi) by which `theta_enc` is ahead of the rotor flux."""
    reversed: bool
    """Whether the encoder counts down when the rotor flux turns up; `zero` is then the sum of both angles."""
    clear: float
    """0..1, share of the back-EMF that stands still in that frame."""
    spread: float
    """rad, half the difference of `zero` turning up and turning down; NaN unless both were seen."""
    n: int
    """Samples used."""


def turns(trace: Trace, inputs: Inputs) -> Turns:
    """How far the shaft turned."""
    n_p = trace.parameters.get("n_p")
    pole_pairs = None if n_p is None else round(n_p)
    up, down = inputs.turns
    by_encoder = (trace.up, trace.down) if trace.encoder else (up, down)
    return Turns(*by_encoder, up + down, inputs.ratio, pole_pairs)


def back_emf(trace: Trace, since: int = 0) -> BackEmf | None:
    """Where the back-EMF stands, from the tick `since` on.

    None where the outputs were off, too little is known, or it has no clear angle.
    """
    some = trace.some
    fast = np.abs(some.omega) > 0.5 * np.abs(some.omega[some.settled]).max(initial=0.0)
    use = some.settled & fast & (np.abs(some.omega) > SLOW) & (some.tick >= since)
    if not trace.encoder or np.count_nonzero(use) < LEAST_SAMPLES:
        return None
    way = np.sign(some.omega[use])
    best: BackEmf | None = None
    for backwards in (False, True):
        still = trace.back_emf(use, backwards)
        if still is None:
            return None
        size = float(np.abs(still).mean())
        mean = complex(still.mean())
        if size < LEAST_EMF or abs(mean) < CLEAR * size:
            continue
        sides = [still[way == side] for side in (1.0, -1.0)]
        spread = math.nan
        if all(len(side) for side in sides):
            spread = abs(cmath.phase(sides[0].mean() / sides[1].mean())) / 2.0
        zero = -cmath.phase(mean) if not backwards else cmath.phase(mean)
        found = BackEmf(zero, backwards, abs(mean) / size, spread, int(np.count_nonzero(use)))
        if best is None or found.clear > best.clear:
            best = found
    return best
