"""Captures that follow each other, cut anew, each with a little of those before and after it.

What looks at a sample's neighbours sees them so, and a recording of any length can be gone through in bounded memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.signal.capture import Capture, joined
from bench.signal.chunks import contiguous, join, part
from protocol.streams import SampleChunk

PIECE = 1 << 17
"""Samples that are looked at at a time, about: what bounds the memory."""


@dataclass(frozen=True)
class Window:
    """Samples of its `own`, and those around them; the Hall edges of `capture` are those up to its own last sample."""

    capture: Capture
    own: slice

    @property
    def samples(self) -> SampleChunk:
        """Its own samples."""
        return part(self.capture.samples, self.own.start, self.own.stop)

    def stretches(self, known: NDArray[np.bool_] | None = None) -> Iterator[tuple[slice, slice]]:
        """The stretches without a gap, of samples that are all `known` (n,), that have samples of its own: all of their
        rows here, and its own of them. None: all are known.

        One that goes on from the window before begins before its own rows.
        """
        known = np.ones(len(self.capture), bool) if known is None else known
        for whole in contiguous(self.capture.samples):
            turned = np.diff(known[whole].astype(np.int8), prepend=0, append=0)
            begins, ends = (whole.start + np.flatnonzero(turned == way) for way in (1, -1))
            for rows in map(slice, begins.tolist(), ends.tolist()):
                own = slice(max(rows.start, self.own.start), min(rows.stop, self.own.stop))
                if own.start < own.stop:
                    yield rows, own


def windows(captures: Iterable[Capture], around: float, most: int = 0) -> Iterator[Window]:
    """Captures one after the other as windows, see `Windows`. Of no samples there is none."""
    made = Windows(around, most)
    for capture in captures:
        yield from made.add(capture)
    yield from made.end()


class Windows:
    """Makes windows of captures as they come, with the samples of `around` s and more, if there are, around their own.

    `most`: samples in one, about; 0: `PIECE`.
    """

    def __init__(self, around: float, most: int = 0) -> None:
        self._around, self._most = around, most or PIECE
        self._held: Capture | None = None  # too short for a window
        self._before: Capture | None = None
        self._now: Capture | None = None

    def add(self, capture: Capture) -> Iterator[Window]:
        """Take a capture that follows those before; the windows that are complete by it. All are to be taken."""
        held = capture if self._held is None else joined([self._held, capture])
        few = _samples(held, self._around)
        self._most = max(self._most, few)
        while len(held) >= self._most + few:
            first, held = _parted(held, self._most)
            yield from self._next(first)
        self._held = held
        if len(held) >= few:
            self._held = None
            yield from self._next(held)

    def end(self) -> Iterator[Window]:
        """The windows that are left."""
        held, self._held = self._held, None
        if held is not None and len(held):
            yield from self._next(held)
        if self._now is not None:
            yield _window(self._before, self._now, None, self._around)
        self._before = self._now = None

    def _next(self, after: Capture) -> Iterator[Window]:
        if self._now is not None:
            yield _window(self._before, self._now, after, self._around)
        self._before, self._now = self._now, after


def _parted(capture: Capture, n: int) -> tuple[Capture, Capture]:
    """The first n samples, with the edges up to the last of them, and the rest."""
    samples, edges = capture.samples, capture.edges
    last = samples.tick[n - 1]
    m = int(np.searchsorted(edges.tick, last, "right"))
    early = tuple(stretch for stretch in capture.dropped if stretch[1] <= last)
    late = tuple(stretch for stretch in capture.dropped if stretch[1] > last)
    return (
        replace(capture, samples=part(samples, 0, n), edges=part(edges, 0, m), dropped=early),
        replace(capture, samples=part(samples, n, len(samples)), edges=part(edges, m, len(edges)), dropped=late),
    )


def _window(before: Capture | None, now: Capture, after: Capture | None, around: float) -> Window:
    n = _samples(now, around)
    head = [] if before is None else [part(before.samples, max(0, len(before) - n), len(before))]
    tail = [] if after is None else [part(after.samples, 0, n)]
    first = sum(map(len, head))
    whole = replace(now, samples=join([*head, now.samples, *tail]))
    return Window(whole, slice(first, first + len(now)))


def _samples(capture: Capture, seconds: float) -> int:
    return max(1, math.ceil(seconds * capture.rate))
