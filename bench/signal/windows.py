"""Captures that follow each other, cut anew, each with a little of those before and after it.

What looks at a sample's neighbours sees them so, and a recording of any length can be gone through in bounded memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

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

    def stretches(self) -> Iterator[tuple[slice, slice]]:
        """The stretches without a gap that have samples of its own: all of their rows here, and its own of them.

        One that goes on from the window before begins before its own rows.
        """
        for rows in contiguous(self.capture.samples):
            own = slice(max(rows.start, self.own.start), min(rows.stop, self.own.stop))
            if own.start < own.stop:
                yield rows, own


def windows(captures: Iterable[Capture], around: float, most: int = 0) -> Iterator[Window]:
    """Captures one after the other as windows, with the samples of `around` s and more, if there are, around their own.

    `most`: samples in one, about; 0: `PIECE`. Of no samples there is none.
    """
    before: Capture | None = None
    now: Capture | None = None
    for after in _cut(captures, around, most or PIECE):
        if now is not None:
            yield _window(before, now, after, around)
        before, now = now, after
    if now is not None:
        yield _window(before, now, None, around)


def _cut(captures: Iterable[Capture], least: float, most: int) -> Iterator[Capture]:
    """The same in pieces of `least` s or longer, but for the last, and of about `most` samples at most."""
    held: Capture | None = None
    for capture in captures:
        held = capture if held is None else joined([held, capture])
        few = _samples(held, least)
        most = max(most, few)
        while len(held) >= most + few:
            first, held = _parted(held, most)
            yield first
        if len(held) >= few:
            yield held
            held = None
    if held is not None and len(held):
        yield held


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
