"""What the parts of the benchmark return, and how it is printed."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. `goal` is the least it may be, or with `at_most` the most; None where there is none."""

    what: str
    measured: float
    unit: str = ""
    goal: float | None = None
    at_most: bool = False

    @property
    def ratio(self) -> float:
        """How many times better than the goal; below 1 the goal is missed."""
        if self.goal is None:
            return math.nan
        better, worse = (self.goal, self.measured) if self.at_most else (self.measured, self.goal)
        return better / worse if worse else (1.0 if better == 0 else math.inf)


class Quickest(dict[str, float]):
    """Seconds of the quickest of several runs, by what was timed: other load on the machine only slows them."""

    @contextmanager
    def timed(self, what: str = "") -> Iterator[None]:
        """Time what is done in the block."""
        started = time.perf_counter()
        yield
        self[what] = min(self.get(what, math.inf), time.perf_counter() - started)


def show(title: str, rows: Iterable[Row]) -> bool:
    """Print a part's rows; returns whether every goal was reached."""
    print(f"\n{title}")
    reached = True
    for row in rows:
        goal = "" if row.goal is None else f"{'at most' if row.at_most else 'at least'} {row.goal:,.6g}"
        ratio = "" if row.goal in (None, 0) else f"{row.ratio:.2f} x"
        missed = row.goal is not None and row.ratio < 1
        figure = f"{row.what:<44} {row.measured:>12,.5g} {row.unit:<12}"
        print(f"  {figure} {goal:<18} {ratio:>8}{'  MISSED' if missed else ''}")
        reached &= not missed
    return reached
