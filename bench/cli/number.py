"""Numbers on the command line: finite, and above a lower limit if there is one."""

from __future__ import annotations

import math
import re
from typing import Any

import click


class Number(click.ParamType[float]):
    """A finite number, greater than `above`."""

    name = "number"

    def __init__(self, above: float = -math.inf) -> None:
        self._above = above

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read it, or say why not."""
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            self.fail(f"'{value}' is not a finite number", param, ctx)
        if number <= self._above:
            self.fail(f"must be above {self._above:g}, got {value}", param, ctx)
        return number


class Moment(click.ParamType[float | str]):
    """A finite number of seconds, or the name of a moment."""

    name = "moment"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Read it, or say why not."""
        try:
            float(value)
        except ValueError:
            return str(value)
        return Number().convert(value, param, ctx)


_SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}


class Duration(click.ParamType[float]):
    """A time as `90`, `90s`, `30min` or `2h`, in s, of `least` s or more."""

    name = "duration"

    def __init__(self, least: float) -> None:
        self._least = least

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read it, or say why not."""
        found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|m|min|h|d)?\s*", str(value))
        if found is None:
            self.fail(f"'{value}' is not a duration: give a number with s, min, h or d, such as 2h", param, ctx)
        seconds = float(found[1]) * _SECONDS[found[2] or ""]
        if not self._least <= seconds < math.inf:
            self.fail(f"must be {self._least:g} s or more, got {value}", param, ctx)
        return seconds
