"""What a measurement may be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real

RATED_SPEED, RATED_CURRENT = "rated speed", "rated current"
"""What limits can be shares of: the drive's rated speed (mechanical r/min) and current (A, peak)."""
YES_NO = "yes/no"
"""The unit of an answer, which is 1 for yes and 0 for no."""
LOAD_ANGLE = "load angle"
"""What limits can be wider by a share of, in electrical degrees: by how much the back-EMF of the rated current's flux
turns the motor's, so that a tenth of it is what an inductance wrong by a tenth does to an estimated angle.
"""
UNITS = {RATED_SPEED: "r/min", RATED_CURRENT: "A", LOAD_ANGLE: "deg"}


@dataclass(frozen=True, slots=True)
class Limits:
    """What a measurement may be: from `lo` to `hi`, in `unit`; None is no limit on that side.

    With `of` they are shares of that rating until `resolved`, and with `plus` without what they are wider by. Raises
    ValueError for limits that are not numbers or leave no room, and for what is no rating.
    """

    name: str
    unit: str = ""
    lo: float | None = None
    hi: float | None = None
    about: str = ""
    overridden: bool = False
    """The limits come from bench.toml, not from the test."""
    of: str = ""
    """The rating that `lo` and `hi` are shares of; empty: they are in `unit`."""
    plus: float = 0.0
    """The share of `LOAD_ANGLE` that both sides are wider by; such limits are in degrees."""
    scaled: str = ""
    """Where limits in `unit` come from, if they were shares or are wider."""
    tells: str = ""
    """What of the drive it tells, where that matters: a report says how small a deviation of it is still seen."""
    chance: bool = False
    """It is a matter of chance, such as where the rotor came to rest: no band is learned of good drives."""

    def __post_init__(self) -> None:
        for side in ("lo", "hi"):
            limit: object = getattr(self, side)
            if limit is None:
                continue
            if isinstance(limit, bool) or not isinstance(limit, Real) or not math.isfinite(limit):
                raise ValueError(f"{self.name}: a limit must be a finite number, got {limit!r}")
            object.__setattr__(self, side, float(limit))  # JSON takes no number of numpy's
            if self.unit == YES_NO and limit not in (0, 1):
                raise ValueError(f"{self.name}: the answer is 1 for yes or 0 for no, and the limit is {limit:.4g}")
        if self.of not in ("", RATED_SPEED, RATED_CURRENT):
            raise ValueError(f"{self.name}: no rating '{self.of}': use '{RATED_SPEED}' or '{RATED_CURRENT}'")
        if self.of and self.plus:
            raise ValueError(f"{self.name}: limits are shares of the {self.of} or widened by {LOAD_ANGLE}, not both")
        if self.lo is not None and self.hi is not None and self.lo > self.hi:
            raise ValueError(f"{self.name}: the lower limit {self.lo:.4g} is above the upper one, {self.hi:.4g}")

    def resolved(self, ratings: Mapping[str, float]) -> Limits:
        """The limits in `unit`; as they are where they are no shares, or of what is not known."""
        if self.of in ratings:
            lo, hi = (None if share is None else share * ratings[self.of] for share in (self.lo, self.hi))
            return replace(self, lo=lo, hi=hi, of="", scaled=replace(self, unit="")._words())
        if wider := self.plus * ratings.get(LOAD_ANGLE, 0.0):
            lo = None if self.lo is None else self.lo - wider
            hi = None if self.hi is None else self.hi + wider
            return replace(self, lo=lo, hi=hi, plus=0.0, scaled=self._words())
        return self

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

    @property
    def width(self) -> float:
        """Between the limits, or the size of the one there is: what a margin is a share of."""
        one = self.hi if self.hi is not None else self.lo or 0.0
        return self.hi - self.lo if self.hi is not None and self.lo is not None else abs(one)

    def told(self, value: float) -> str:
        """`value` with its unit, to four digits; an answer in words."""
        if self.unit == YES_NO:
            return {1.0: "yes", 0.0: "no"}.get(value, f"{value:.4g}")
        return f"{value:.4g} {self.unit}".rstrip()

    def __str__(self) -> str:
        return f"{self._words()} ({self.scaled})" if self.scaled and not self.overridden else self._words()

    def _words(self) -> str:
        if self.unit == YES_NO and (self.lo, self.hi) != (None, None):
            return " or ".join(self.told(answer) for answer in (1.0, 0.0) if self.allow(answer))
        unit = f" × {self.of}" if self.of else f" {self.unit}" if self.unit else ""
        unit += f", widened by {self.plus:.4g} × {LOAD_ANGLE}" if self.plus else ""
        if self.lo is not None and self.hi is not None:
            return f"= {self.lo:.4g}{unit}" if self.lo == self.hi else f"{self.lo:.4g} … {self.hi:.4g}{unit}"
        if self.hi is not None:
            return f"≤ {self.hi:.4g}{unit}"
        return f"≥ {self.lo:.4g}{unit}" if self.lo is not None else "for information"
