"""What the parts of the benchmark return, how its figures are written, and how they time what they time."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. `goal` is the least it may be, or with `at_most`, where less is better, the most.

    `timed`: it goes with the speed of the machine; `ratio` puts that beside the reference kernel, once it has run.
    """

    what: str
    measured: float
    unit: str = ""
    goal: float | None = None
    at_most: bool = False
    timed: bool = False
    ratio: float | None = None

    @property
    def missed(self) -> bool:
        """Whether there is a goal and it is not reached."""
        return self.goal is not None and (self.measured > self.goal if self.at_most else self.measured < self.goal)

    def beside(self, reference: float) -> Row:
        """With its ratio: what is done while the reference kernel runs once, or how many of its runs this takes."""
        if not self.timed:
            return self
        return replace(self, ratio=self.measured / reference if self.at_most else self.measured * reference)

    def cells(self) -> tuple[str, str, str, str]:
        """What, how much, the goal, and whether it is reached, for people."""
        if self.goal is None:
            goal = verdict = ""
        else:
            goal = f"{'at most' if self.at_most else 'at least'} {_number(self.goal)}"
            verdict = "MISSED" if self.missed else "reached"
        return self.what, f"{_number(self.measured)} {self.unit}".rstrip(), goal, verdict


def speed(what: str, measured: float, unit: str, goal: float | None = None) -> Row:
    """How much is done in a time: more is better."""
    return Row(what, measured, unit, goal, timed=True)


def cost(what: str, measured: float, unit: str, goal: float | None = None) -> Row:
    """How long something takes, or what share of a core: less is better."""
    return Row(what, measured, unit, goal, at_most=True, timed=True)


def _number(x: float) -> str:
    return f"{x:,.0f}" if float(x).is_integer() or abs(x) >= 1000 else f"{x:.4g}"


class Quickest(dict[str, float]):
    """Seconds of the quickest of several runs, by what was timed: other load on the machine only slows them."""

    @contextmanager
    def timed(self, what: str = "") -> Iterator[None]:
        """Time what is done in the block."""
        started = time.perf_counter()
        yield
        self[what] = min(self.get(what, math.inf), time.perf_counter() - started)
