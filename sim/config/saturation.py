"""How much the axes of a motor may saturate one another before a current has more than one flux linkage, or none.

The law is that of `sim.plant.pmsm`: the gradient of an energy, which has one flux linkage for each current where that
energy bends upwards in all directions.
"""

from __future__ import annotations

import math

BEND = 0.25  # of what it is without crossing: what must be left of the determinant
REACH = 2.0  # i_max: the currents that are looked at, the usual i_trip
DIRECTIONS, STEPS, HALVINGS = 24, 60, 40


def _shares(L_d: float, L_q: float, psi_f: float, i_cross: float, i_d: float, i_q: float) -> tuple[float, float]:
    """The current, A, and how much the energy is bent: the lesser of the shares of 1/L_q and of the determinant of 1/L.

    In H, V s and A; `i_d`, `i_q`: the flux linkage of the winding over L_d and L_q.
    """
    magnet, salient = psi_f / L_d, L_q / L_d
    along = 1.0 + i_d / i_cross * (1.0 + 0.5 * i_d / magnet)
    square = salient * (i_q / i_cross) ** 2
    bend = (1.0 + 0.5 * square * i_cross / magnet) * along - square * (1.0 + i_d / magnet) ** 2
    return math.hypot(i_d + 0.5 * square * i_cross * (1.0 + i_d / magnet), i_q * along), min(along, bend)


def _bends(L_d: float, L_q: float, psi_f: float, i_cross: float, most: float) -> bool:
    """Whether the energy is bent upwards wherever the current is below `most` (A)."""
    for way in range(DIRECTIONS):
        x, y = math.cos(math.tau * way / DIRECTIONS), math.sin(math.tau * way / DIRECTIONS)
        for step in range(1, STEPS + 1):
            r = 4.0 * most * step / STEPS
            current, bend = _shares(L_d, L_q, psi_f, i_cross, r * x, r * y)
            if bend < BEND:
                return False
            if current >= most:
                break
        else:
            return False
    return True


def least_i_cross(L_d: float, L_q: float, psi_f: float, i_max: float) -> float:
    """The least i_cross (A) with which every current up to twice `i_max` (A) has one flux linkage."""
    low, high = 0.0, 1e3 * (i_max + psi_f / L_d)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if _bends(L_d, L_q, psi_f, middle, REACH * i_max):
            high = middle
        else:
            low = middle
    return high
