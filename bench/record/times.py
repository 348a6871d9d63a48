"""Times that a user gives, as device ticks of a run, and what lies between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.errors import BenchError
from bench.record.reader import Run
from bench.signal.chunks import BEGIN, END


@dataclass(frozen=True)
class Side:
    """One of two runs: its ticks `first` to `last` are compared; `zero` is time 0."""

    run: Run
    zero: int
    first: int
    last: int

    def seconds(self, tick: int) -> float:
        """Time of a tick after time 0."""
        return (tick - self.zero) / self.run.info.tick_hz


def ticks_of(run: Run, begin: float | None, end: float | None) -> tuple[int, int]:
    """First and last tick of the part of a run from `begin` to `end`, s of device time; None is its begin, or its end.

    Raises BenchError for a run that holds nothing, and for a part of it that does.
    """
    if not run.segments:
        raise BenchError(f"{run.path} has no samples and no Hall edges")
    if given := [at for at in (begin, end) if at is not None and not math.isfinite(at)]:
        raise BenchError(f"{given[0]} is no time: give seconds of device time")
    first, last = run.span
    hz = run.info.tick_hz
    wanted = first if begin is None else round(begin * hz), last if end is None else round(end * hz)
    if wanted[0] > wanted[1] or wanted[0] > last or wanted[1] < first:
        asked = f"{wanted[0] / hz:g} to {wanted[1] / hz:g} s"
        raise BenchError(f"{run.path} has no data from {asked}: it covers {first / hz:.3f} to {last / hz:.3f} s")
    return max(first, wanted[0]), min(last, wanted[1])


def ticks_between(run: Run, begin: float | None, end: float | None) -> tuple[int, int]:
    """The same, but `BEGIN` and `END` for all of a run, also of one that holds nothing: its reader says why."""
    return (BEGIN, END) if begin is None and end is None else ticks_of(run, begin, end)
