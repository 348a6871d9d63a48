"""How a stream's samples lie in CAN frames: the same algorithm at both ends.

A sample frame stands alone: a counter, then whole channels. Classic: ctr u16 (number of the first sample, low bits)
and up to 6 bytes; FD: index u32 (PWM period of the first sample) and up to 60. Channels that fit in one frame together
make one group, and then a frame holds several samples; else each group has its own slot and a frame holds one sample's
share. This module knows no frames on a wire.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.canmap.frame import BusRates, padded_length

CLASSIC_COUNTER = 2  # bytes of ctr
FD_COUNTER = 4  # bytes of index
CLASSIC_ROOM = 8 - CLASSIC_COUNTER
FD_ROOM = 64 - FD_COUNTER
MAX_GROUPS = 16  # so that a new configuration never has a slot of the one before
EDGE_BYTES = 8
EDGES_PER_SECOND = 1000.0
"""What an edge stream is counted with when a link's load is planned."""


@dataclass(frozen=True)
class StreamLayout:
    """`groups`: byte range of each group in a packed sample; `samples`: samples in a frame."""

    fd: bool
    groups: tuple[tuple[int, int], ...]
    samples: int

    @property
    def counter(self) -> int:
        """Bytes before the samples."""
        return FD_COUNTER if self.fd else CLASSIC_COUNTER

    def used(self, group: int) -> int:
        """Bytes of a frame of this group that mean something."""
        first, last = self.groups[group]
        return self.counter + self.samples * (last - first)

    def length(self, group: int) -> int:
        """Data bytes of a frame of this group, padding included."""
        return padded_length(self.used(group)) if self.fd else self.used(group)

    def load(self, rates: BusRates, sample_rate: float, extended: bool = False) -> float:
        """Return the share of the bus that `sample_rate` samples/s take at most."""
        seconds = sum(
            rates.seconds(self.length(group), extended=extended, fd=self.fd, worst=True)
            for group in range(len(self.groups))
        )
        return seconds * sample_rate / self.samples


def sample_layout(widths: Sequence[int], fd: bool, most: int) -> StreamLayout:
    """Return the layout of samples whose channels have these `widths` in bytes.

    `most`: most samples in a frame, 1 at least; there are as many as fit where all channels fit in one.
    """
    room = FD_ROOM if fd else CLASSIC_ROOM
    groups: list[tuple[int, int]] = []
    first = last = 0
    for width in widths:
        if last + width - first > room:
            groups.append((first, last))
            first = last
        last += width
    groups.append((first, last))
    samples = max(1, min(room // last, most)) if len(groups) == 1 else 1
    return StreamLayout(fd, tuple(groups), samples)


def edge_load(rates: BusRates, extended: bool = False) -> float:
    """Return the share of the bus that an edge stream is counted with."""
    return EDGES_PER_SECOND * rates.seconds(EDGE_BYTES, extended=extended, worst=True)
