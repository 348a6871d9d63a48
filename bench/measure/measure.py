"""All channels of a run between two cursors, in one pass and bounded memory, and what lies between besides."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.errors import BenchError
from bench.files import finite
from bench.measure.channel import Angle, Row, Span, of_channel
from bench.record.layout import SAMPLES
from bench.record.reader import Run, ahead, captures
from bench.record.recording import readable
from bench.record.times import ticks_of
from bench.signal.capture import Capture
from bench.signal.channels import reference_angle
from bench.signal.chunks import breaks, join, narrowed, part, streams_none
from bench.signal.waveforms.sectors import SECTORS, steps_between
from protocol.frames import data_frame
from protocol.streams import SampleChunk

if TYPE_CHECKING:
    import pandas as pd

WINDOW = 1 << 16
"""Samples that are looked at at a time, at most."""


@dataclass
class Between:
    """What lies between the cursors; None for what was not recorded, NaN for what cannot be followed."""

    samples: int = 0
    gaps: int = 0
    missing: int = 0
    """Samples that are missing in the gaps."""
    edges: int | None = None
    """Hall edges, of which so many lead to the next sector forward, and in reverse; the others are illegal."""
    forward: int = 0
    reverse: int = 0
    edge_gaps: int = 0
    revolutions: float | None = None
    """Electrical ones, by the encoder, forward less reverse."""
    revolutions_by_hall: float | None = None
    """By the Hall edges, to a sixth or so; NaN where some are illegal or missing."""
    n_p: int | None = None
    """Pole pairs by the drive's parameter."""


@dataclass(frozen=True)
class Statistics:
    """What was measured from cursor to cursor, s of device time."""

    run: Run
    begin: float
    end: float
    between: Between
    rows: tuple[Row, ...]
    """A row for each channel."""

    @property
    def seconds(self) -> float:
        """From cursor to cursor."""
        return self.end - self.begin

    def to_pandas(self) -> pd.DataFrame:
        """A row for each channel; NaN for what is undefined."""
        return data_frame([asdict(row) for row in self.rows]).set_index("channel")

    def as_json(self) -> dict[str, Any]:
        """Plain data; None for what is undefined, and `why`."""
        told: dict[str, Any] = finite({
            "run": str(self.run.path), "from_s": self.begin, "to_s": self.end, "seconds": self.seconds,
            "per_second": 1.0 / self.seconds if self.seconds else math.nan, "between": asdict(self.between),
            "rows": [asdict(row) for row in self.rows], "damage": list(self.run.damage),
        })  # fmt: skip
        return told


def measure(
    run: Run, channels: Sequence[str] | None = None, begin: float | None = None, end: float | None = None
) -> Statistics:
    """Measure `channels`, None for all, from `begin` to `end`, s of device time; None: the first sample, the last.

    BenchError without samples there, for a drive that rebooted meanwhile, and for a channel that there is not.
    """
    config = readable(run).config(SAMPLES)
    reference = reference_angle(config.channels)
    names = [channel.name for channel in narrowed(config, channels).channels]
    first, last = _cursors(run, begin, end, names[0])
    period = config.decimation * config.period_ticks
    windows = math.ceil(((last - first) // period + 1) / WINDOW)
    length = -(-(last - first + 1) // windows)
    span, between = Span(first, last, config.tick_hz, max(1, length // period)), Between(n_p=run.info.n_p)
    wanted = [channel for channel in config.channels if channel.name in (*names, reference)]
    measured = {channel.name: of_channel(channel, span) for channel in wanted}
    ends: list[int] = []
    parts = _counted(ahead(captures(run, first, last, set(measured))), between)
    for window in _windows(parts, first, length):
        ends = [*ends[:1], int(window.tick[0]), int(window.tick[-1])]
        for each in measured.values():
            each.add(window)
    turning = measured.get(reference)
    between.revolutions = turning.turned / math.tau if isinstance(turning, Angle) else None
    kept = ends[0] - first < period, last - ends[-1] < period
    rows = tuple(measured[name].row(kept) for name in names)
    return Statistics(run, first / config.tick_hz, last / config.tick_hz, between, rows)


def _cursors(run: Run, begin: float | None, end: float | None, channel: str) -> tuple[int, int]:
    """First and last tick: those of samples, where none are given. BenchError where there are none between."""
    asked = ticks_of(run, begin, end)
    spans = [span for segment in run.segments if (span := segment.span_of(SAMPLES)) is not None]
    first, last = max(asked[0], spans[0][0]), min(asked[1], spans[-1][1])
    if first > last or next(run.pieces(SAMPLES, first, last, [channel]), None) is None:
        why = "; ".join(run.damage) or f"they cover {run.at(spans[0][0])} to {run.at(spans[-1][1])}, less gaps"
        raise BenchError(f"{run.path} has no samples from {run.at(asked[0])} to {run.at(asked[1])}: {why}")
    return first, last


def _counted(parts: Iterable[Capture], between: Between) -> Iterator[SampleChunk]:
    """The samples of captures that follow each other; counts them and their Hall edges."""
    sample = edge = None  # index that would go on
    for capture in parts:
        samples, edges = capture.samples, capture.edges
        step = samples.config.index_step
        gone = np.diff(samples.index, prepend=samples.index[0] if sample is None else sample - step) // step
        between.samples += len(samples)
        between.gaps += int(np.count_nonzero(gone > 1))
        between.missing += int((gone[gone > 1] - 1).sum())
        sample = int(samples.index[-1]) + step
        if not streams_none(edges.config):
            between.edges = (between.edges or 0) + len(edges)
        if len(edges):
            steps = steps_between(edges.hall_old, edges.hall_new)
            between.forward += int(np.count_nonzero(steps == 1.0))
            between.reverse += int(np.count_nonzero(steps == -1.0))
            between.edge_gaps += len(breaks(edges.index, 1, edge))
            edge = int(edges.index[-1]) + 1
        yield samples
    if between.edges is not None:
        legal = between.edges == between.forward + between.reverse and not between.edge_gaps
        between.revolutions_by_hall = (between.forward - between.reverse) / SECTORS if legal else math.nan


def _windows(chunks: Iterable[SampleChunk], first: int, length: int) -> Iterator[SampleChunk]:
    """Chunks that follow each other, cut anew where `length` ticks from `first` on are full: however they came."""
    held: list[SampleChunk] = []
    until = first
    for chunk in chunks:
        while len(chunk):
            if held and chunk.tick[0] >= until:
                yield join(held)
                held = []
            until = first + ((int(chunk.tick[0]) - first) // length + 1) * length
            n = int(np.searchsorted(chunk.tick, until))
            held.append(part(chunk, 0, n))
            chunk = part(chunk, n, len(chunk))
    yield join(held)
