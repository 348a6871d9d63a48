"""What is measured of one channel, window by window, in bounded memory: of a quantity, an angle that wraps, a code."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.measure.frequency import COHERENT, FEW, NONE, PERIODS, UNSTEADY, Tone, Tones
from bench.record.info import AnyChannel
from bench.signal.batches import BATCHES, DRIFT, LEAST, LEAST_BATCHES, batch_of, slope, slope_error, student
from bench.signal.chunks import breaks
from bench.signal.pieces import FOLLOWED
from bench.signal.position import Moments, wrap
from protocol.signals import Flag, RawType, Unit
from protocol.streams import SampleChunk

F64 = NDArray[np.float64]

WRAPS = "it wraps"
TURNS = "it turns through a revolution or more"
TOO_FAST = "it turns too far from sample to sample, or in a gap, to be followed"
NO_LINE = "no straight line"
MOST_CODES = 64
"""Values of a code that are listed."""


@dataclass(frozen=True)
class Span:
    """From tick `first` to `last`, both included, in windows of `window` samples."""

    first: int
    last: int
    tick_hz: int
    window: int

    @property
    def seconds(self) -> float:
        """From cursor to cursor."""
        return (self.last - self.first) / self.tick_hz


@dataclass
class Row:
    """What was measured of a channel, in its unit; NaN for what is undefined, and `why` by the name of the field."""

    channel: str
    unit: str
    kind: str
    """quantity, angle or code."""
    n: int = 0
    """Samples that are finite."""
    not_finite: int = 0
    at_begin: float = math.nan
    """The first sample, and the last; NaN where that is not at the cursor."""
    at_end: float = math.nan
    difference: float = math.nan
    """At the end less at the begin; of an angle, how far it turned."""
    mean: float = math.nan
    """Of an angle the circular mean, rad in [-pi, pi)."""
    rms: float = math.nan
    std: float = math.nan
    """Of the population; of an angle the circular one."""
    min: float = math.nan
    max: float = math.nan
    peak_to_peak: float = math.nan
    slope: float = math.nan
    """Of the least-squares line, per s; of an angle that of the unwrapped one."""
    slope_error: float = math.nan
    """Its standard error."""
    frequency: float = math.nan
    """Hz, of the fundamental; of an angle, revolutions a second."""
    frequency_half_width: float = math.nan
    """Of its 95 % confidence interval."""
    changes: int | None = None
    """Samples that differ from the one before, of a code."""
    values: dict[int, int] | None = None
    """Samples of each value of a code, the smallest first; None for more than `MOST_CODES` of them."""
    why: dict[str, str] = field(default_factory=dict)


class Line:
    """A least-squares line over time, batch by batch."""

    def __init__(self, span: Span) -> None:
        self._span, self._middle = span, (span.first + span.last) // 2
        self._origin: float | None = None
        self._sums = np.zeros((5, BATCHES))

    def add(self, tick: NDArray[np.int64], y: F64) -> None:
        """Add samples (n,)."""
        if not len(y):
            return
        self._origin = float(y[0]) if self._origin is None else self._origin
        x, y = (tick - self._middle) / self._span.tick_hz, y - self._origin
        batch = batch_of(tick, self._span.first, self._span.last - self._span.first + 1)
        for row, weights in zip(self._sums, (None, x, y, x * x, x * y), strict=True):
            row += np.bincount(batch, weights, BATCHES)

    def off(self) -> F64:
        """What the means of the batches (k,) are off the line."""
        n, x, y, *_ = self._sums[:, self._sums[0] > 0]
        means = y / n - slope(self._sums.sum(axis=1)) * x / n
        rest: F64 = means - means.mean()
        return rest

    def into(self, row: Row, step: float) -> None:
        """Put slope and error into a row; `step`: of the values, 0 for floats. A step may hide a slope of one in all.

        What is known of each end of a line to step / sqrt(12) is known of its slope to sqrt(2) of that over the time.
        """
        used = self._sums[:, self._sums[0] > 0]
        n = used[0].sum() if used.size else 0.0
        if n < 2:
            row.why["slope"] = row.why["slope_error"] = FEW
            return
        enough = used.shape[1] >= LEAST_BATCHES and n >= LEAST * used.shape[1]
        row.slope = float(slope(used.sum(axis=1)))
        error, alike = slope_error(used, 2.0 / used.shape[1]) if enough else (math.nan, 0.0)
        if enough and alike <= DRIFT:
            row.slope_error = math.hypot(error, step / math.sqrt(6.0) / self._span.seconds)
        else:
            row.why["slope_error"] = NO_LINE if enough else FEW


class Measured:
    """What is common to all channels."""

    def __init__(self, channel: AnyChannel, span: Span) -> None:
        self._channel, self._span = channel, span
        self._not_finite = self._n = 0
        self._ends = [math.nan, math.nan]

    @property
    def _step(self) -> float:
        return 0.0 if self._channel.raw == RawType.F32 else abs(self._channel.scale)

    def add(self, window: SampleChunk) -> None:
        """Add a window of samples, one or more, that follows those before."""
        values = window.physical(self._channel.name)
        self._ends = [self._ends[0] if self._n + self._not_finite else float(values[0]), float(values[-1])]
        known = np.isfinite(values)
        self._n += int(known.sum())
        self._not_finite += int((~known).sum())
        if known.all():
            self._add(window.config.index_step, window.config.rate, window.index, window.tick, values)
        elif known.any():
            rest = (window.index[known], window.tick[known], values[known])
            self._add(window.config.index_step, window.config.rate, *rest)

    def _add(self, step: int, rate: float, index: NDArray[np.int64], tick: NDArray[np.int64], values: F64) -> None:
        """Add those (n,), n >= 1, that are finite."""
        raise NotImplementedError

    def row(self, kept: tuple[bool, bool]) -> Row:
        """What was measured; `kept`: whether the first and the last sample are at the cursors."""
        row = Row(self._channel.name, self._channel.unit.symbol, self.kind, self._n, self._not_finite)
        row.at_begin, row.at_end = (
            end if at and math.isfinite(end) else math.nan for end, at in zip(self._ends, kept, strict=True)
        )
        if self._n:
            self._into(row)
        return row

    kind = ""

    def _into(self, row: Row) -> None:
        raise NotImplementedError


class Quantity(Measured):
    """A channel with a mean."""

    kind = "quantity"

    def __init__(self, channel: AnyChannel, span: Span) -> None:
        super().__init__(channel, span)
        self._moments, self._line, self._tones = Moments(), Line(span), Tones()
        self._low, self._high = math.inf, -math.inf

    def _add(self, step: int, rate: float, index: NDArray[np.int64], tick: NDArray[np.int64], values: F64) -> None:
        self._moments.add(values)
        self._low, self._high = min(self._low, float(values.min())), max(self._high, float(values.max()))
        self._line.add(tick, values)
        bounds = np.concatenate([[0], breaks(index, step), [len(index)]])
        longest = int(np.argmax(np.diff(bounds)))
        y = values[bounds[longest] : bounds[longest + 1]]
        self._tones.add(y, rate, 2 * len(y) >= self._span.window)

    def _into(self, row: Row) -> None:
        row.mean, row.rms, row.std = self._moments.mean, self._moments.rms, self._moments.std
        row.min, row.max, row.peak_to_peak = self._low, self._high, self._high - self._low
        row.difference = row.at_end - row.at_begin
        self._line.into(row, self._step)
        tone = self._tones.result()
        if isinstance(tone, Tone):
            row.frequency, row.frequency_half_width = tone.f, tone.half_width
        else:
            row.why["frequency"] = tone


class Angle(Measured):
    """An angle that wraps: followed from sample to sample."""

    kind = "angle"

    def __init__(self, channel: AnyChannel, span: Span) -> None:
        super().__init__(channel, span)
        self._line, self._sum = Line(span), 0j
        self._index, self._last, self._from = -1, 0.0, 0.0
        self._low, self._high = math.inf, -math.inf
        self._fastest, self._longest = 0.0, 1.0  # rad a sample, and samples from one to the next

    def _add(self, step: int, rate: float, index: NDArray[np.int64], tick: NDArray[np.int64], values: F64) -> None:
        new = self._index < 0
        before = (index[0] - step, values[0]) if new else (self._index, self._last)
        gone = np.diff(index, prepend=before[0]) / step
        steps = wrap(np.diff(values, prepend=before[1]))
        self._fastest = max(self._fastest, float(np.abs(steps[gone == 1.0]).max(initial=0.0)))
        self._longest = max(self._longest, float(gone.max()))
        unwrapped = before[1] + np.cumsum(steps)
        self._from = float(unwrapped[0]) if new else self._from
        self._index, self._last = int(index[-1]), float(unwrapped[-1])
        self._low, self._high = min(self._low, float(unwrapped.min())), max(self._high, float(unwrapped.max()))
        self._line.add(tick, unwrapped)
        self._sum += complex(np.exp(1j * values).sum())

    @property
    def turned(self) -> float:
        """rad from the first sample to the last; NaN where it cannot be followed."""
        return self._last - self._from if self._fastest * self._longest <= FOLLOWED else math.nan

    def _into(self, row: Row) -> None:
        row.why |= dict.fromkeys(("rms", "min", "max", "peak_to_peak"), WRAPS)
        followed = not math.isnan(self.turned)
        if not followed or self._high - self._low >= math.tau:
            row.why |= dict.fromkeys(("mean", "std"), TURNS if followed else TOO_FAST)
        else:
            share = min(abs(self._sum) / self._n, 1.0)
            row.mean = float(wrap(np.array(np.angle(self._sum))))
            row.std = math.sqrt(abs(2.0 * math.log(share))) if share else math.inf
        if not followed:
            row.why |= dict.fromkeys(("difference", "slope", "slope_error", "frequency"), TOO_FAST)
            return
        if not math.isnan(row.at_begin + row.at_end):
            row.difference = self.turned
        self._line.into(row, self._step)
        if abs(self.turned) < math.tau * PERIODS:
            row.why["frequency"] = NONE
        elif math.isnan(row.slope_error) or abs(np.exp(1j * self._line.off()).mean()) < COHERENT:
            row.why["frequency"] = FEW if row.why.get("slope_error") == FEW else UNSTEADY
        else:
            row.frequency = abs(row.slope) / math.tau
            row.frequency_half_width = student(LEAST_BATCHES - 2) * row.slope_error / math.tau


class Code(Measured):
    """Bits, which have no mean."""

    kind = "code"

    def __init__(self, channel: AnyChannel, span: Span) -> None:
        super().__init__(channel, span)
        self._values: Counter[int] = Counter()
        self._last: float | None = None
        self._changes = 0

    def _add(self, step: int, rate: float, index: NDArray[np.int64], tick: NDArray[np.int64], values: F64) -> None:
        before = values[0] if self._last is None else self._last
        self._changes += int(np.count_nonzero(np.diff(values, prepend=before)))
        self._last = float(values[-1])
        if len(self._values) <= MOST_CODES:
            found = np.unique(values, return_counts=True)
            self._values.update(dict(zip(*(each.astype(np.int64).tolist() for each in found), strict=True)))

    def _into(self, row: Row) -> None:
        row.changes = self._changes
        row.values = dict(sorted(self._values.items())) if len(self._values) <= MOST_CODES else None


def of_channel(channel: AnyChannel, span: Span) -> Any:
    """What measures a channel, by what its descriptor says that it is."""
    if channel.flags & Flag.WRAPS:
        return Angle(channel, span)
    whole = channel.raw != RawType.F32 and (channel.scale, channel.offset) == (1.0, 0.0)
    return Code(channel, span) if whole and channel.unit == Unit.NONE else Quantity(channel, span)
