"""Units that people use beside SI, and what it takes to convert them."""

from __future__ import annotations

import math
from collections.abc import Mapping

RPM = math.tau / 60  # mechanical rad/s of one r/min


def shaft_speed(rpm: float | None, rad_s: float | None) -> float:
    """A speed of the shaft in mechanical rad/s, given in r/min or in rad/s. TypeError unless just one is given."""
    if (rpm is None) == (rad_s is None):
        raise TypeError("give a speed either as rpm=… or as rad_s=…, mechanical")
    return rpm * RPM if rpm is not None else rad_s or 0.0


def pole_pairs(parameters: Mapping[str, float]) -> int | None:
    """Pole pairs by the drive's parameter `n_p`; None where it has none that a motor can have."""
    n_p = parameters.get("n_p", math.nan)
    return int(n_p) if math.isfinite(n_p) and n_p >= 1 and n_p == int(n_p) else None
