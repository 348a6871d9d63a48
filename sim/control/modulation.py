"""From a reference voltage to duties: space-vector modulation by min-max injection.

Duty d of a phase puts d * u_dc between its terminal and the link's minus over a period. Half the spread of
the three phases is added to all of them, which centres them in the link and makes the linear range u_dc /
sqrt(3), the circle inside the hexagon of space-vector modulation.

Never knows of dead time (that is `dead_time`'s).
"""

from __future__ import annotations

import math

from sim.control.transforms import inverse_clarke
from sim.numba_cache import kernel

LINEAR = 1.0 / math.sqrt(3.0)


@kernel
def linear_limit(u_dc: float) -> float:
    """Longest voltage vector of the linear range, V, on a link of `u_dc` V."""
    return LINEAR * u_dc


@kernel
def duties(u_alpha: float, u_beta: float, u_dc: float) -> tuple[float, float, float]:
    """Duties of phases a, b, c, each in [0, 1], for a voltage vector in V; all 0.5 without a link voltage."""
    if u_dc <= 0.0:
        return 0.5, 0.5, 0.5
    u_a, u_b, u_c = inverse_clarke(u_alpha, u_beta)
    middle = 0.5 * (max(u_a, u_b, u_c) + min(u_a, u_b, u_c))
    share = 1.0 / u_dc
    return (
        min(max(0.5 + (u_a - middle) * share, 0.0), 1.0),
        min(max(0.5 + (u_b - middle) * share, 0.0), 1.0),
        min(max(0.5 + (u_c - middle) * share, 0.0), 1.0),
    )
