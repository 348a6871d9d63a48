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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.signal.trace import INPUTS, SLOW, Edges, Trace

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
    """Electrical turns by the Hall inputs that change at all, in both directions together; NaN where none does."""
    n_p: int | None
    """Pole pairs that the firmware assumes; None if the drive does not say."""

    @property
    def total(self) -> float:
        """Electrical turns, both directions together."""
        return self.up + self.down

    @property
    def ratio(self) -> float:
        """Electrical turns by the Hall inputs for each by the encoder; NaN where that is not known."""
        return self.by_hall / self.total if self.total > 0 else math.nan


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


def turns(trace: Trace) -> Turns:
    """How far the shaft turned."""
    n_p = trace.parameters.get("n_p")
    pole_pairs = None if n_p is None else round(n_p)
    by_hall = _hall_turns(trace.changes())
    if not trace.encoder:
        half = by_hall / 2.0
        return Turns(half, half, by_hall, pole_pairs)
    return Turns(trace.up, trace.down, by_hall, pole_pairs)


def _hall_turns(changes: Sequence[int]) -> float:
    """Half the changes of an input, in the mean over those that change."""
    alive = [n for n in changes if n > 0.2 * max(changes)]
    return float(np.mean(alive)) / 2.0 if alive else math.nan


def repeats(edges: Edges, factor: float) -> float:
    """How well edges repeat with `factor` times the encoder's angle: 0 for not at all, 1 for perfectly.

    The mean length of the mean unit vector of an input's rises to a shaft that turns up, and of its falls.
    """
    lengths = []
    for number in range(len(INPUTS)):
        for rises in (True, False):
            met = ((edges.old ^ edges.new) >> number & 1 == 1) & ((edges.new >> number & 1 == 1) == (
                (edges.omega > 0) == rises
            ))  # fmt: skip
            theta = edges.theta[met & np.isfinite(edges.theta)]
            if len(theta) > 2:
                lengths.append(abs(np.exp(1j * factor * theta).mean()))
    return float(np.mean(lengths)) if lengths else 0.0


def back_emf(trace: Trace) -> BackEmf | None:
    """Where the back-EMF stands; None where the outputs were off, too little is known, or it has no clear angle."""
    some = trace.some
    fast = np.abs(some.omega) > 0.5 * np.abs(some.omega[some.settled]).max(initial=0.0)
    use = some.settled & fast & (np.abs(some.omega) > SLOW)
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
