"""Vector-tracking observer on the Hall vector with the harmonics of its quantisation decoupled.

The kernels are those of `hall_vector`, which describes them; only `omega_decouple` differs. With ideal sensors the Hall
vector's harmonics are known functions of the rotor's angle. Those of order -5, 7, -11 and 13, at the observer's own
angle, are subtracted, so that the cross product becomes

    (pi/3) sin(theta_q - theta) - (1/5 + 1/7) sin 6 theta - (1/11 + 1/13) sin 12 theta

and what is left of the ripple begins at 18 times omega, a ninth of the other's: (1/17 + 1/19) / 18 to (1/5 + 1/7) / 6.
Misplaced sensors do not switch where the series takes them to: their ripple, at omega and 2 omega, stays.

What the source leaves open: the subtracted terms are a feedback too. They turn the loop's gain into one that swings
between -1.3 and 5.1 within a sector, the mean being 1. That does no harm while the sectors pass faster than the loop
moves; below |omega_h| = 2 pi bw misplaced sensors would throw it out of lock, so there nothing is subtracted.

Never measures a harmonic: the coefficients are those of ideal sensors.

Source: M. C. Harke, G. De Donato, F. Giulii Capponi, T. R. A. Tesch, R. D. Lorenz, "Implementation issues and
performance evaluation of sinusoidal, surface-mounted PM machine drives with Hall-effect position sensors and a
vector-tracking observer", IEEE Trans. Ind. Appl., vol. 44, no. 1, pp. 161-173, 2008.
"""

from __future__ import annotations

from sim.observers import hall_vector
from sim.observers.hall_vector import Estimate, Params, Settings, State, init, step

__all__ = ["Estimate", "Params", "Settings", "State", "init", "make_params", "step"]


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    return hall_vector.make_params(pwm_hz, drive, decouple=True)
