"""Cosine and sine together: the same bits compiled and not, on every machine, and without a call.

By minimax polynomials within an eighth of a turn, as in FreeBSD's msun (`k_sin.c`, `k_cos.c`), summed in pairs; within
2e-16 of the true values, further out those of the C library.
"""

from __future__ import annotations

import math

import numpy as np

from sim.numba_cache import kernel

FAR = 1e5  # rad, up to which quarters are taken off exactly
PER_QUARTER = 2.0 / math.pi
QUARTER = float.fromhex("0x1.921fb544p+0")  # rad, its upper 33 bits
REST = 6.07710050650619224932e-11
S_1, S_2, S_3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
S_4, S_5, S_6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
C_1, C_2, C_3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
C_4, C_5, C_6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@kernel
def cos_sin(angle: float) -> tuple[float, float]:
    """cos and sin of an angle (rad)."""
    if not abs(angle) < FAR:
        return math.cos(angle), math.sin(angle)
    quarters = float(np.rint(angle * PER_QUARTER))
    r = (angle - quarters * QUARTER) - quarters * REST
    z = r * r
    w = z * z
    sin = r + r * z * ((S_1 + z * S_2) + w * ((S_3 + z * S_4) + w * (S_5 + z * S_6)))
    cos = 1.0 - (0.5 * z - w * ((C_1 + z * C_2) + w * ((C_3 + z * C_4) + w * (C_5 + z * C_6))))
    n = int(quarters)
    if n & 1 != 0:
        cos, sin = -sin, cos
    if n & 2 != 0:
        cos, sin = -cos, -sin
    return cos, sin
