"""How far a drive may be made to go."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Envelope:
    """The most that is asked of a drive: mechanical r/min and A of peak phase current; inf is the drive's limit."""

    speed_rpm: float = math.inf
    current: float = math.inf
    load: float = 0.0
    """A of q current that the load torque takes."""

    def join(self, other: Envelope) -> Envelope:
        """What covers both."""
        return Envelope(
            max(self.speed_rpm, other.speed_rpm), max(self.current, other.current), max(self.load, other.load)
        )
