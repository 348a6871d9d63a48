"""How a recording is kept that goes on for long, and which segments of a ring are let go: decided once for each."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

BEFORE, AFTER = 60.0, 10.0  # s around a fault, a trigger or a mark that are kept
SHORTEST = 10.0  # s of a part
LEAST = BEFORE  # s that a ring holds at least, so that what comes before a mark is still there


@dataclass(frozen=True)
class Stored:
    """How a recording is kept that goes on for long; s of device time."""

    keep: float | None = None
    """A ring: what is older goes, but for what led to a fault, a trigger or a mark."""
    split: float | None = None
    """A new run, a part, is begun after this time: `a-001.run`, `a-002.run`, …"""


FOR_EVER = Stored()
"""All of it is kept, in one run."""


class Ring:
    """Lets a segment go when it ended more than `keep` s ago, unless it has what led to a moment worth keeping.

    `keep` is `LEAST` or more, in s of the device's time, of which `hz` ticks are a second. That time may begin
    anew, see `restarted`.
    """

    def __init__(self, keep: float, hz: int) -> None:
        self._keep, self._before, self._after = (round(seconds * hz) for seconds in (keep, BEFORE, AFTER))
        self._restarted = False  # since the last segment
        self._shift = 0  # from device ticks to ticks that go on over a reboot
        self._newest = 0  # of those that go on
        self._told: list[tuple[int, int]] = []  # moments of the segment that is being written, device ticks
        self._moments: list[tuple[int, int]] = []
        self._segments: deque[tuple[int, int, int]] = deque()  # number, first and last tick

    def moment(self, first: int, last: int) -> None:
        """Keep what is around the device ticks `first` to `last`, in the segment that is being written or before."""
        self._told.append((first, last))

    def restarted(self) -> None:
        """The device's time begins anew after the last segment."""
        self._restarted = bool(self._segments)

    def ended(self, number: int, first: int, last: int) -> list[int]:
        """A segment has ended, of the device ticks `first` to `last`. Returns the numbers of those that can go."""
        if self._restarted:
            self._shift, self._restarted = self._newest - first, False
        self._moments += [(a + self._shift, b + self._shift) for a, b in self._told]
        self._told.clear()
        self._newest = last + self._shift
        self._segments.append((number, first + self._shift, self._newest))
        gone = []
        while self._segments and self._segments[0][2] < self._newest - self._keep:
            old, begin, end = self._segments.popleft()
            if not any(a - self._before <= end and b + self._after >= begin for a, b in self._moments):
                gone.append(old)
        oldest = self._segments[0][1] if self._segments else self._newest
        self._moments = [moment for moment in self._moments if moment[1] + self._after >= oldest]
        return gone
