"""How a shaft goes while it is recorded, by formula: as `bench hall check` turns it, coasting, by hand, at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DWELL_TURNS, DWELL = 8.0, (1.0, 4.0)
"""Electrical turns at a speed, and the s that it takes at least and at most, as docs/hall.md has them."""
AGAIN = (0.5, 5.0, 0.5)
"""Share of the speed at which it turns forward once more, electrical turns, and s at least."""
STILL = 0.15  # s before and after


@dataclass(frozen=True)
class Way:
    """Speeds in r/min by the time in s, in line between; what trembles and ripples comes on top."""

    knots: tuple[tuple[float, float], ...]
    powered: tuple[tuple[float, float], ...] = ()
    """Stretches in s in which the outputs are on."""
    by_hand: float = 0.0
    """Share of its speed by which a hand's varies."""
    rocking: tuple[float, float] = (0.0, 1.0)
    """Amplitude in rad of the shaft, Hz."""
    tremble: float = 0.0
    """rad of the shaft, rms, of 5 to 60 Hz."""
    ripple: tuple[float, float] = (0.0, 0.0)
    """Share of the speed by which it varies once, and twice, in a turn of the shaft."""

    @property
    def seconds(self) -> float:
        return self.knots[-1][0]

    @property
    def top(self) -> float:
        """r/min."""
        return max(abs(rpm) for _, rpm in self.knots)

    def angle(self, t: Floats, rng: np.random.Generator) -> Floats:
        """Of the shaft, rad, from 0 on; `t` in even steps."""
        rpm = np.interp(t, *np.array(self.knots).T)
        if self.by_hand:
            swings = (0.6 * np.sin(math.tau * f * t + rng.uniform(0.0, math.tau)) for f in (0.9, 2.3))
            rpm = rpm * (1.0 + self.by_hand * sum(swings))
        speed = rpm * math.tau / 60.0
        angle = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) * (t[1] - t[0])
        size, hertz = self.rocking
        angle += size * np.sin(math.tau * hertz * t)
        if self.tremble:
            waves = ((f, rng.uniform(0.0, math.tau)) for f in rng.uniform(5.0, 60.0, 12))
            angle += self.tremble * math.sqrt(2.0 / 12.0) * sum(np.sin(math.tau * f * t + by) for f, by in waves)
        for times, share in enumerate(self.ripple, 1):
            angle += share / times * np.sin(times * angle + times)
        found: Floats = angle
        return found

    def on(self, t: Floats) -> NDArray[np.bool_]:
        """Whether the outputs are."""
        found = np.zeros(len(t), bool)
        for first, last in self.powered:
            found |= (t >= first) & (t < last)
        return found


def ways(*stretches: tuple[float, float], start: float = 0.0) -> tuple[tuple[float, float], ...]:
    """Knots of stretches that take so many s to reach so many r/min."""
    knots = [(0.0, start)]
    for seconds, rpm in stretches:
        knots.append((knots[-1][0] + seconds, rpm))
    return tuple(knots)


def check(top_rpm: float, n_p: int, again: bool = True) -> Way:
    """A quarter, half and all of a speed, both ways, and forward once more."""
    per_second = n_p * top_rpm / 60.0
    legs = [[(share, DWELL_TURNS, DWELL[0]) for share in (0.25, 0.5, 1.0)] for _ in range(2)]
    stretches = [(STILL, 0.0)]
    for sign, leg in zip((1.0, -1.0, 1.0), [*legs, [AGAIN]] if again else legs, strict=False):
        for share, turns, least in leg:
            rpm = sign * share * top_rpm
            stretches += [(0.1, rpm), (min(max(turns / (share * per_second), least), DWELL[1]), rpm)]
        stretches += [(0.2, 0.0), (STILL, 0.0)]
    knots = ways(*stretches)
    return Way(knots, ((0.0, knots[-1][0]),))


def coast(top_rpm: float, seconds: float = 2.5) -> Way:
    """Run up and let go, both ways."""
    one = [(0.5, 1.0), (0.5, 1.0), (0.4 * seconds, 0.45), (0.6 * seconds, 0.0), (STILL, 0.0)]
    knots = ways((STILL, 0.0), *((s, sign * share * top_rpm) for sign in (1.0, -1.0) for s, share in one))
    again = STILL + 1.0 + seconds + STILL
    return Way(knots, ((0.0, STILL + 1.0), (again, again + 1.0)))


def hand(rpm: float, turns: float) -> Way:
    """Turned by hand, both ways."""
    seconds = 60.0 * turns / rpm
    one = [(0.4, 1.0), (seconds, 1.0), (0.4, 0.0), (0.4, 0.0)]
    return Way(ways((STILL, 0.0), *((s, sign * share * rpm) for sign in (1.0, -1.0) for s, share in one)), by_hand=0.4)


def rest(seconds: float = 5.0) -> Way:
    """Not turned at all."""
    return Way(((0.0, 0.0), (seconds, 0.0)))
