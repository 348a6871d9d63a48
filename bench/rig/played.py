"""What is left of a profile that was played: all that came meanwhile, and when each step was."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from bench.errors import BenchError
from bench.signal.capture import Capture
from protocol.text import did_you_mean


class Span(NamedTuple):
    """A step that was played, from tick to tick."""

    name: str
    first: int
    last: int


@dataclass(frozen=True, repr=False)
class Played:
    """A profile that was played: `played["load step"]` is the step of that name, `played["reversal#2"]` its second."""

    capture: Capture
    """All of it."""
    spans: tuple[Span, ...]
    """Its steps, in the order in which they were played."""

    def __getitem__(self, name: str) -> Capture:
        """The samples of a step. BenchError where there is none of that name, or several and no number says which."""
        of, _, number = name.rpartition("#")
        if not number.isdigit() or not of:
            of, number = name, ""
        found = [span for span in self.spans if span.name == of]
        if not found:
            names = list(dict.fromkeys(span.name for span in self.spans))
            raise BenchError(f"no step '{name}' was played: {did_you_mean(name, names, f'there are {names}')}")
        if not number and len(found) > 1:
            raise BenchError(f"'{name}' was played {len(found)} times: choose one, such as {name}#1")
        if not 1 <= int(number or 1) <= len(found):
            raise BenchError(f"'{of}' was played {len(found)} times: there is no {name}")
        span = found[int(number or 1) - 1]
        return self.capture.ticks(span.first, span.last)

    def __repr__(self) -> str:
        return f"Played {len(self.spans)} steps, {self.capture!r}"
