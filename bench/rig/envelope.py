"""How far a drive may be made to go."""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass

from bench.signal.units import RPM, shaft_speed


@dataclass(frozen=True, slots=True)
class Envelope:
    """The most that is asked of a drive: mechanical r/min and A of peak phase current; inf is the drive's limit.

    The speed may be given as `rad_s` instead; TypeError for both.
    """

    rpm: float = math.inf
    current: float = math.inf
    load: float = 0.0
    """A of q current that the load torque takes."""
    rad_s: InitVar[float | None] = None

    def __post_init__(self, rad_s: float | None) -> None:
        if rad_s is not None:
            rpm = None if self.rpm == math.inf else self.rpm
            object.__setattr__(self, "rpm", shaft_speed(rpm, rad_s) / RPM)

    def join(self, other: Envelope) -> Envelope:
        """What covers both."""
        return Envelope(max(self.rpm, other.rpm), max(self.current, other.current), max(self.load, other.load))
