"""Conditions on channels that mark a run: `i_q>8`, `abs(error)>=0.2`, and the sink that looks for them."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.device.heard import ClockRestarted, Heard
from bench.errors import BenchError
from protocol.streams import SampleChunk
from protocol.text import did_you_mean

QUIET = 1.0  # s of device time after a trigger in which it does not trigger again
_FORM = re.compile(r"\s*(?:(abs)\(\s*([^\s()<>]+)\s*\)|([^\s()<>]+))\s*(<=|>=|<|>)\s*(\S+)\s*")
_COMPARE: dict[str, Callable[[Any, Any], Any]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


@dataclass(frozen=True)
class Condition:
    """`text`: a channel, or its magnitude where `absolute`, compared with a value in the channel's unit."""

    text: str
    channel: str
    absolute: bool
    comparison: str
    value: float

    @classmethod
    def parse(cls, text: str) -> Condition:
        """Read `i_q>8` or `abs(i_q) >= 8`. Raises BenchError."""
        found = _FORM.fullmatch(text)
        try:
            value = float(found[5]) if found else float("nan")
        except ValueError:
            value = float("nan")
        if found is None or not np.isfinite(value):
            raise BenchError(f"'{text}' is no trigger: give a channel, <, <=, > or >=, and a number, such as 'i_q>8'")
        return cls(text.strip(), found[2] or found[3], bool(found[1]), found[4], value)

    def check(self, channels: Collection[str]) -> None:
        """Raise BenchError if the channel is not among these."""
        if self.channel not in channels:
            hint = did_you_mean(self.channel, sorted(channels), f"there are {', '.join(sorted(channels))}")
            raise BenchError(f"--trigger '{self.text}': {self.channel} is not streamed; {hint}")

    def holds(self, chunk: SampleChunk) -> tuple[NDArray[np.bool_], NDArray[Any]]:
        """Where it holds, (n,), and the channel's values in its unit, (n,)."""
        values = chunk.physical(self.channel)
        with np.errstate(invalid="ignore"):
            true: NDArray[np.bool_] = _COMPARE[self.comparison](abs(values) if self.absolute else values, self.value)
        return true, values


Hit = Callable[[Condition, int, float], object]


class Triggers:
    """Sink that calls `hit` with condition, device tick and value where a condition of node `drive` begins to hold.

    A condition that holds in the first sample has begun there. One that has triggered does not again for a second.
    """

    def __init__(self, conditions: Sequence[Condition], drive: int, hit: Hit) -> None:
        self._drive, self._hit = drive, hit
        self._held = dict.fromkeys(conditions, False)
        self._until = dict.fromkeys(conditions, -1)

    def take(self, item: Heard) -> None:
        """Look for them in samples."""
        if isinstance(item, SampleChunk) and item.config.node == self._drive:
            self._look(item)
        elif isinstance(item, ClockRestarted) and item.node == self._drive:
            self._until = dict.fromkeys(self._until, -1)

    def _look(self, chunk: SampleChunk) -> None:
        quiet = round(QUIET * chunk.config.tick_hz)
        for condition, before in self._held.items():
            true, values = condition.holds(chunk)
            self._held[condition] = bool(true[-1])
            for row in np.flatnonzero(true & ~np.concatenate([[before], true[:-1]])).tolist():
                tick = int(chunk.tick[row])
                if tick >= self._until[condition]:
                    self._until[condition] = tick + quiet
                    self._hit(condition, tick, float(values[row]))
