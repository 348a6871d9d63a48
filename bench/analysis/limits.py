"""What a measurement may be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real


@dataclass(frozen=True, slots=True)
class Limits:
    """What a measurement may be: from `lo` to `hi`, in `unit`; None is no limit on that side.

    Raises ValueError for limits that are not numbers or leave no room.
    """

    name: str
    unit: str = ""
    lo: float | None = None
    hi: float | None = None
    about: str = ""
    overridden: bool = False
    """The limits come from bench.toml, not from the test."""

    def __post_init__(self) -> None:
        for side in ("lo", "hi"):
            limit: object = getattr(self, side)
            if limit is None:
                continue
            if isinstance(limit, bool) or not isinstance(limit, Real) or not math.isfinite(limit):
                raise ValueError(f"{self.name}: a limit must be a finite number, got {limit!r}")
            object.__setattr__(self, side, float(limit))  # JSON takes no number of numpy's
        if self.lo is not None and self.hi is not None and self.lo > self.hi:
            raise ValueError(f"{self.name}: the lower limit {self.lo:g} is above the upper one, {self.hi:g}")

    def allow(self, value: float) -> bool:
        """Whether `value` is within them; NaN is not."""
        if math.isnan(value):
            return False
        return (self.lo is None or value >= self.lo) and (self.hi is None or value <= self.hi)

    def margin(self, value: float) -> float | None:
        """Distance in `unit` from `value` to the nearer limit, negative outside; None where there is no limit."""
        distances = [value - self.lo] if self.lo is not None else []
        if self.hi is not None:
            distances.append(self.hi - value)
        return min(distances, default=None)

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.lo is not None and self.hi is not None:
            return f"= {self.lo:g}{unit}" if self.lo == self.hi else f"{self.lo:g} … {self.hi:g}{unit}"
        if self.hi is not None:
            return f"≤ {self.hi:g}{unit}"
        return f"≥ {self.lo:g}{unit}" if self.lo is not None else "for information"
