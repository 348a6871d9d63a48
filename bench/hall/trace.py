"""What was recorded, made ready for measuring Hall sensors.

A recording is gone through once, piece by piece; `bench.signal.trace` says what is kept of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from bench.errors import BenchError
from bench.signal.capture import Capture
from bench.signal.channels import reference_angle
from bench.signal.chunks import between
from bench.signal.trace import LOOKED_AT, Trace, trace_of

if TYPE_CHECKING:
    from bench.record.reader import Run


class Recorded:
    """A recording, or its part from `begin` to `end` in s of device time, as captures that follow each other.

    BenchError where it holds no samples or no Hall edges; `note` is told what of it is damaged, once it was read.
    """

    def __init__(
        self,
        run: Run,
        begin: float | None = None,
        end: float | None = None,
        note: Callable[[str], None] = lambda _: None,
    ) -> None:
        from bench.record import layout
        from bench.record.times import ticks_between

        self._run, self._note, self._told = run, note, 0
        self._part = ticks_between(run, begin, end)
        self.samples, self.edges = (run.rows(stream, *self._part) for stream in (layout.SAMPLES, layout.EDGES))
        self.parameters = run.info.parameters
        if not self.samples or not self.edges:
            raise self._nothing()

    def pieces(self, wanted: Iterable[str]) -> Iterator[Capture]:
        """Those of the channels `wanted` that there are, and the encoder's angle. Raises BenchError."""
        from bench.record.reader import ahead, captures

        config, _ = self._run.drive_streams
        there = [channel.name for channel in config.channels]
        chosen = [name for name in (*wanted, reference_angle(config.channels)) if name in there]
        edges, first = 0, None
        for capture in ahead(captures(self._run, *self._part, chosen or there[:1])):
            edges += len(capture.edges)
            tick = capture.samples.tick
            first = int(tick[0]) if first is None else first
            yield replace(capture, edges=between(capture.edges, first, int(tick[-1])))
        for words in self._run.damage[self._told :]:
            self._note(f"warning: {words}")
        self._told = len(self._run.damage)
        if not edges:
            raise self._nothing()

    def _nothing(self) -> BenchError:
        why = "; ".join(self._run.damage) or "record both"
        return BenchError(f"{self._run.path} holds no samples or no Hall edges of a drive: {why}")


def pieces_of(whole: Capture | Recorded, wanted: Iterable[str]) -> Iterable[Capture]:
    """What was captured or recorded, in pieces that follow each other."""
    return whole.pieces(wanted) if isinstance(whole, Recorded) else (whole,)


def trace(whole: Capture | Recorded) -> Trace:
    """Make ready what was captured or recorded. BenchError without the channel `hall`."""
    return trace_of(pieces_of(whole, LOOKED_AT))
