"""A measured quantity with what is known of it: its value in the drive's own volts and amperes, and two intervals.

A drive knows volts by its measurement of the DC link, and amperes by its current sensors. Loops and observers compute
in these units, so the gains of the converters do not matter to them. They do to ohms, henries and newton metres, and
cannot be measured from inside: `absolute` adds them. Instruments beside the drive can (`bench.commission.meters`), and
then an absolute value may be another than the drive's own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

COVERAGE = 1.959963984540054
"""Standard deviations to each side of an interval of 95 %."""


@dataclass(frozen=True)
class Converters:
    """Gains of a drive's converters, its units over true ones, and their standard deviations, relative."""

    volts: float = 0.005
    """Of the measurement of the DC link."""
    amperes: float = 0.005
    """Of the current sensor of one phase; the three are independent."""
    volts_gain: float = 1.0
    amperes_gain: float = 1.0
    """Of the mean of the three phases. Both are 1 as long as nobody has measured them."""
    measured_amperes: float | None = None
    """Standard deviation of that gain, once it was measured."""

    @property
    def common_amperes(self) -> float:
        """Of the mean of the three phases: what the magnitude of a current vector has."""
        return self.amperes / math.sqrt(3.0) if self.measured_amperes is None else self.measured_amperes


USUAL = Converters()
"""What is assumed of a drive whose maker tells nothing."""


@dataclass(frozen=True)
class Quantity:
    """What was found of one quantity, in SI units, by the drive's own volts and amperes.

    `parts`: standard deviations by cause, such as `noise` and `method`, in `unit`, independent of each other. `volts`
    and `amperes`: the powers with which the gains of the converters enter; a resistance has 1 and -1.
    """

    name: str
    unit: str
    value: float
    parts: Mapping[str, float] = field(default_factory=dict)
    volts: float = 0.0
    amperes: float = 0.0

    @property
    def sd(self) -> float:
        """Standard deviation in the drive's units."""
        return math.hypot(*self.parts.values())

    @property
    def half_width(self) -> float:
        """Of the 95 % interval in the drive's units."""
        return COVERAGE * self.sd

    def absolute_value(self, converters: Converters = USUAL) -> float:
        """The value in true volts and amperes, as far as the gains are known."""
        return self.value / self._gain(converters)

    def absolute(self, converters: Converters = USUAL) -> float:
        """Standard deviation of the value as one in SI units, with the converters' gains."""
        return math.hypot(self.sd / self._gain(converters), *self._gains(converters).values())

    def absolute_half_width(self, converters: Converters = USUAL) -> float:
        """Of the 95 % interval in SI units."""
        return COVERAGE * self.absolute(converters)

    def _gain(self, converters: Converters) -> float:
        gain: float = converters.volts_gain**self.volts * converters.amperes_gain**self.amperes
        return gain

    def _gains(self, converters: Converters) -> dict[str, float]:
        value = abs(self.absolute_value(converters))
        return {
            "gain of the DC link voltage": value * abs(self.volts) * converters.volts,
            "gain of the currents": value * abs(self.amperes) * converters.common_amperes,
        }

    @property
    def dominated_by(self) -> str:
        """The largest part in the drive's units; empty where there is none."""
        return _largest(self.parts)

    def absolutely_dominated_by(self, converters: Converters = USUAL) -> str:
        """The largest part of the absolute interval, gains among them."""
        return _largest({**self.parts, **self._gains(converters)})

    def covers(self, truth: float) -> bool:
        """Whether the 95 % interval in the drive's units has `truth` in it."""
        return abs(self.value - truth) <= self.half_width


def _largest(parts: Mapping[str, float]) -> str:
    return max(parts, key=lambda name: parts[name]) if any(parts.values()) else ""
