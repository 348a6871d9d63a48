"""Units that people use beside SI, and what it takes to convert them."""

from __future__ import annotations

import math
from collections.abc import Mapping

RPM = math.tau / 60  # mechanical rad/s of one r/min


def pole_pairs(parameters: Mapping[str, float]) -> int | None:
    """Pole pairs by the drive's parameter `n_p`; None where it has none that a motor can have."""
    n_p = parameters.get("n_p", math.nan)
    return int(n_p) if math.isfinite(n_p) and n_p >= 1 and n_p == int(n_p) else None
