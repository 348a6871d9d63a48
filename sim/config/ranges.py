"""What a number in a configuration may be, and the error that says so in one line.

This module knows no parameter by name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["ConfigError", "Range", "check"]


class ConfigError(Exception):
    """A configuration that cannot be used. `str(error)` is one line for the user."""


@dataclass(frozen=True, slots=True)
class Range:
    """What a key may hold: a number (or `length` numbers) in `unit` between two limits."""

    unit: str = ""
    lo: float = -math.inf
    hi: float = math.inf
    open_lo: bool = False  # `lo` itself is not allowed
    whole: bool = False
    length: int = 0  # 0: one number; otherwise a list of so many

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        what = "a whole number " if self.whole else ""
        if self.hi == math.inf:
            if self.lo == -math.inf:
                return f"{what or 'a number'}{unit}"
            return f"{what}{'>' if self.open_lo else '>='} {self.lo:g}{unit}"
        if self.open_lo:
            return f"{what}> {self.lo:g} and <= {self.hi:g}{unit}"
        return f"{what}between {self.lo:g} and {self.hi:g}{unit}"

    def holds(self, value: float) -> bool:
        """Whether `value` is allowed; never for nan and infinities."""
        try:
            finite = math.isfinite(value)
        except OverflowError:  # an integer of hundreds of digits
            return False
        if not finite or (self.whole and value != int(value)):
            return False
        return (value > self.lo if self.open_lo else value >= self.lo) and value <= self.hi


def check(name: str, value: object, allowed: Range, where: str = "") -> float | int | tuple[float, ...]:
    """The value as a float (an int where whole, a tuple of floats where a list), or `ConfigError`."""
    suffix = f" ({where})" if where else ""
    if allowed.length:
        if not isinstance(value, list | tuple) or len(value) != allowed.length:
            raise ConfigError(f"{name} must be a list of {allowed.length} numbers, got {value!r}{suffix}")
        one = Range(allowed.unit, allowed.lo, allowed.hi, allowed.open_lo)
        return tuple(float(_scalar(f"{name}[{k}]", item, one, suffix)) for k, item in enumerate(value))
    return _scalar(name, value, allowed, suffix)


def _scalar(name: str, value: object, allowed: Range, suffix: str) -> float | int:
    if isinstance(value, bool) or not isinstance(value, int | float) or not allowed.holds(value):
        got = f"{value:g}" if isinstance(value, float) else repr(value)
        raise ConfigError(f"{name} must be {allowed}, got {got}{suffix}")
    return int(value) if allowed.whole else float(value)
