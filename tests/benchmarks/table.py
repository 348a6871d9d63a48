"""What the parts of the benchmark return, how its figures are written, and how they time what they time."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

KERNEL = 0.026
"""s that the reference kernel takes on the machine for which goals of speed are given."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. `goal` is the least it may be, or with `at_most`, where less is better, the most.

    `timed`: it goes with the speed of the machine; `ratio` puts that beside the reference kernel, once it has run. Its
    goal is one for a machine on which the kernel takes `KERNEL`, and is judged by the ratio.
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
        if self.goal is None or (self.timed and self.ratio is None):
            return False
        found = self.measured
        if self.timed and self.ratio is not None:
            found = self.ratio * KERNEL if self.at_most else self.ratio / KERNEL
        return found > self.goal if self.at_most else found < self.goal

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
            goal = f"{'at most' if self.at_most else 'at least'} {number(self.goal)}"
            goal += f" at {1000 * KERNEL:g} ms" * self.timed
            verdict = "MISSED" if self.missed else "reached"
        return self.what, f"{number(self.measured)} {self.unit}".rstrip(), goal, verdict


def speed(what: str, measured: float, unit: str, goal: float | None = None) -> Row:
    """How much is done in a time: more is better."""
    return Row(what, measured, unit, goal, timed=True)


def cost(what: str, measured: float, unit: str, goal: float | None = None) -> Row:
    """How long something takes, or what share of a core: less is better."""
    return Row(what, measured, unit, goal, at_most=True, timed=True)


def number(x: float) -> str:
    """A figure for people, with four digits."""
    return f"{x:,.0f}" if float(x).is_integer() or abs(x) >= 1000 else f"{x:.4g}"


class Quickest(dict[str, float]):
    """CPU seconds of the quickest of several runs, by what was timed: other load on the machine only slows them."""

    @contextmanager
    def timed(self, what: str = "") -> Iterator[None]:
        """Time what is done in the block."""
        started = time.process_time()
        yield
        self[what] = min(self.get(what, math.inf), time.process_time() - started)
