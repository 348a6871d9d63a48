"""Numbers on the command line: finite, above a bound where one is given."""

from __future__ import annotations

import math
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
