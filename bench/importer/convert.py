"""Tables become samples and Hall edges: rows as they are, or on a grid that the rates do not give.

Samples are those of the table with the most rows a second, as they are where they come at one rate; where they do not,
and of all other tables, they are interpolated between the rows before and after: linearly, angles the short way round,
what is held as it was. Nothing is interpolated over a gap: rows of the fastest table are missing there, a value of
another is NaN. Hall edges are those of all rows, at the time of the row that has the new code first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.importer.plan import Input, Plan
from bench.importer.source import Arrays, Source, numbers
from bench.importer.survey import F64, GAP, I64, HallCodes, Progress, Survey, Values, ticks_of
from bench.record.info import AnyChannel
from bench.signal.position import wrap
from protocol.descriptor import Channel
from protocol.messages import StreamEvent
from protocol.signals import DRIVE_CHANNELS, SECTOR_OF_CODE, Flag, RawType, Unit
from protocol.streams import EdgeChunk, Gap, SampleChunk, StreamConfig

MOST_RATE = 100_000.0
"""Samples a second from which on not all rows of a long recording become samples."""
MOST_ROWS = 1_000_000
"""Rows that become samples each, however many come a second."""
MOST_MADE = 100_000_000
"""Samples that are made on a grid of their own without having been asked for."""
OF_EDGES = 10_000.0
"""Samples a second where there are edges alone."""
HELD_OVER = 3.0
"""Periods of its own table over which a value is interpolated."""
_END = 1 << 62
_MOST_FLOAT = float(np.finfo(np.float32).max)
_SECTOR = np.array(SECTOR_OF_CODE)
_WHOLE = (RawType.U8, RawType.I16, RawType.U16, RawType.I32, RawType.U32)
_HALL = next(signal for signal in DRIVE_CHANNELS if signal.name == "hall")


@dataclass(frozen=True)
class Timing:
    """When samples are made. `main`: the table whose rows they are; None for a grid of their own."""

    main: str | None
    tick_hz: int
    pwm_hz: int
    decimation: int
    every: int = 1
    """Rows of the main table to a sample."""

    @property
    def rate(self) -> float:
        """Samples a second."""
        return self.pwm_hz / self.decimation


@dataclass
class Rejected:
    """Rows that did not become samples, by the reason."""

    counts: dict[str, int] = field(default_factory=dict)

    def add(self, why: str, n: int) -> None:
        """So many more."""
        if n:
            self.counts[why] = self.counts.get(why, 0) + n


def timing(source: Source, plan: Plan, seen: Survey, rate_hz: float) -> Timing:
    """When samples are made of what was seen; `rate_hz`: the rate that was asked for, 0: none. Raises BenchError."""
    sampled = {name: clock for name, clock in seen.clocks.items() if not plan.tables[name].held}
    hz = seen.tick_hz
    if sampled:
        main = min(sampled, key=lambda name: sampled[name].period)
        rate = plan.tables[main].rate or hz / sampled[main].period
        if rate_hz in (0.0, plan.tables[main].rate) and sampled[main].regular:
            every = max(1, math.ceil(rate / MOST_RATE - 1e-9)) if sampled[main].rows > MOST_ROWS else 1
            fraction = nice(rate)
            return Timing(main, hz, fraction.numerator, fraction.denominator * every, every)
        usual = min(rate, MOST_RATE)
    else:
        usual = OF_EDGES
    name, longest = max(seen.clocks.items(), key=lambda item: item[1].leap)
    span = max(clock.last or 0 for clock in seen.clocks.values()) / hz
    if not rate_hz and span * usual > MOST_MADE:
        raise BenchError(
            f"{span:.6g} s at {usual:.6g} samples a second are more than {MOST_MADE:,}; the longest step of time, "
            f"{longest.leap / hz:.6g} s, ends {source.line(name, longest.leap_at)}: cut the file there, or give --rate "
            "HZ"
        )
    fraction = nice(rate_hz or usual)
    if fraction > hz:
        raise BenchError(f"--rate {rate_hz:g}: the file's times go by 1/{hz} s")
    return Timing(None, hz, fraction.numerator, fraction.denominator)


def nice(rate: float) -> Fraction:
    """A rate as a fraction whose parts are whole, as near as it is known."""
    whole = Fraction(max(1, round(rate)))
    near = whole if abs(rate - whole) < 1e-3 * rate else Fraction(rate).limit_denominator(1000)
    return near if near > 0 else Fraction(rate).limit_denominator(10**6)


def channels(plan: Plan, seen: Survey, when: Timing) -> tuple[AnyChannel, ...]:
    """The channels of the run: `hall` first."""
    made: list[AnyChannel] = [_HALL] if plan.lines else []
    for k, one in enumerate(plan.inputs):
        raw, scale, offset = _format(one, seen.values[one.table, one.column], one.table == when.main)
        made.append(Channel(100 + k, one.name, one.unit, raw, scale, one.flags, offset))
    return tuple(made)


def _format(one: Input, values: Values, as_they_are: bool) -> tuple[RawType, float, float]:
    """How a channel is kept: exactly where it can be, else to 2^-31 of its largest value, or as float32 with NaN."""
    if not as_they_are or values.missing or values.dtype is None or not values.n:
        return RawType.F32, 1.0, 0.0
    if one.wraps:
        return RawType.I32, math.pi * 2.0**-31, 0.0
    if values.whole:
        for raw in _WHOLE:
            info = np.iinfo(raw.dtype)
            if info.min + (info.min < 0) <= values.least and values.most <= info.max - (raw != RawType.U8):
                return raw, one.factor, one.offset
    if values.dtype == np.float32 and (one.factor, one.offset) == (1.0, 0.0):
        return RawType.F32, 1.0, 0.0
    largest = max(abs(values.least * one.factor + one.offset), abs(values.most * one.factor + one.offset))
    if largest == 0.0 or not 1e-30 < largest < 1e30:
        return RawType.F32, 1.0, 0.0
    return RawType.I32, 2.0 ** (math.frexp(largest)[1] - 30), 0.0


class _Rows:
    """Rows of a table that are still needed."""

    def __init__(self, plan: Plan, seen: Survey, name: str, rejected: Rejected) -> None:
        self.name, self._table, self._seen = name, plan.tables[name], seen
        self._factor, self._rejected = plan.time_factor[name], rejected
        self.ticks: I64 = np.empty(0, np.int64)
        self.columns: Arrays = {}
        self.reached, self._row, self._last = -_END, 0, -_END
        clock = seen.clocks[name]
        self._rows = clock.rows + clock.untimed
        self.held = self._table.held
        self.gap = _END if self.held else math.ceil((GAP if clock.regular else HELD_OVER) * clock.period)
        """Ticks from row to row, from which on rows are missing between them."""

    def add(self, columns: Arrays) -> None:
        """Take more rows. BenchError if they cannot be those of the survey."""
        ticks, known = ticks_of(
            self._table, columns, self._row, self._factor, self._seen.tick_hz, self._seen.origin
        )  # fmt: skip
        self._row += len(ticks)
        steps = np.diff(ticks[known], prepend=self._last)
        _require_as_seen(bool((steps >= 0).all() and not (ticks[known] < 0).any() and self._row <= self._rows))
        fresh = known.copy()
        fresh[known] = steps > 0
        if self.held:  # of several changes at one time the last one holds
            fresh = known & np.r_[ticks[1:] != ticks[:-1], True]
            if len(self.ticks) and len(ticks) and ticks[0] == self.ticks[-1]:
                self.ticks = self.ticks[:-1]
                self.columns = {name: values[:-1] for name, values in self.columns.items()}
        self._rejected.add("rows without a time", len(ticks) - int(known.sum()))
        if not self.held:
            self._rejected.add("rows with the time of the row before", int(known.sum()) - int(fresh.sum()))
        ticks = ticks[fresh]
        new = {name: numbers(values)[fresh] for name, values in columns.items() if name != self._table.time}
        self.columns = {n: np.concatenate([self.columns[n], v]) for n, v in new.items()} if len(self.ticks) else new
        self.ticks = np.concatenate([self.ticks, ticks])
        if len(self.ticks):
            self.reached = self._last = int(self.ticks[-1])

    def end(self) -> None:
        """BenchError unless all rows of the survey have come."""
        _require_as_seen(self._row == self._rows)

    def until(self, horizon: int) -> slice:
        """Those of the rows that lie at it or before."""
        return slice(0, int(np.searchsorted(self.ticks, horizon, "right")))

    def let_go(self, horizon: int) -> None:
        """Forget all before the last one at it or before."""
        first = max(0, self.until(horizon).stop - 1)
        self.ticks = self.ticks[first:]
        self.columns = {name: values[first:] for name, values in self.columns.items()}

    def at(self, grid: I64) -> tuple[I64, I64, F64, NDArray[np.bool_]]:
        """Rows before and after each time, the share of the later one, and whether it is known, (n,) each."""
        n = len(self.ticks)
        if not n:
            none = np.zeros(len(grid), np.int64)
            return none, none, np.zeros(len(grid)), np.zeros(len(grid), bool)
        after = np.searchsorted(self.ticks, grid, "left")
        exact = self.ticks[np.minimum(after, n - 1)] == grid
        before = np.where(exact, after, after - 1)
        known = before >= 0
        before, after = np.clip(before, 0, n - 1), np.clip(after, 0, n - 1)
        apart = self.ticks[after] - self.ticks[before]
        if not self.held:
            known &= exact | ((apart > 0) & (apart < self.gap))
        share = np.where(exact | self.held, 0.0, (grid - self.ticks[before]) / np.maximum(apart, 1))
        return before, after, share, known


def _require_as_seen(true: bool) -> None:
    if not true:
        raise BenchError("it is not what it was when it was looked at: is it still written to, or is it damaged?")


def blocks(source: Source, plan: Plan, tables: Mapping[str, _Rows]) -> Iterator[int]:
    """Reads on, and gives ticks up to which all tables have come; the last one lies after all of them."""
    wanted = plan.wanted
    groups = [wanted] if source.together else [{name: columns} for name, columns in wanted.items()]
    streams = [(list(group), source.batches(group)) for group in groups]
    horizon = -_END
    while streams:
        names, stream = min(streams, key=lambda one: min(tables[name].reached for name in one[0]))
        try:
            batch = next(stream)
        except StopIteration:
            streams.remove((names, stream))
            for name in names:
                tables[name].reached = _END
            continue
        for name, columns in batch.items():
            tables[name].add(columns)
        reached = max((tables[name].reached for name in batch), default=-_END)
        for other in names:  # of one stream: it comes in the order of time, and what has not come for long is missing
            rows = tables[other]
            rows.reached = max(rows.reached, reached - (0 if rows.held else rows.gap))
        ahead = min(rows.reached for rows in tables.values())
        if ahead > horizon and ahead < _END:
            horizon = ahead
            yield horizon - 1  # more may come at this very time
    yield _END


class _Hall:
    """The Hall inputs: levels of their lines at every change, and edges."""

    def __init__(self, plan: Plan, seen: Survey, tables: Mapping[str, _Rows], config: StreamConfig) -> None:
        self._codes = HallCodes(plan, seen.thresholds)
        self._lines = plan.lines
        self._names = list(dict.fromkeys(table for table, _ in plan.lines))
        self._tables, self._config = tables, config
        self._last = -_END
        self._code, self._at, self._index, self._gap = -1, 0, 0, False
        self._kept: tuple[I64, I64, int] = (np.empty(0, np.int64), np.empty(0, np.int64), -1)  # and the code before

    def take(self, horizon: int) -> EdgeChunk | None:
        """Edges up to a time; codes up to it are known then."""
        times: list[I64] = []
        for name in self._names:
            ticks = self._tables[name].ticks[self._tables[name].until(horizon)]
            times.append(ticks[ticks > self._last])
        events = times[0] if len(times) == 1 else np.unique(np.concatenate(times))
        if not len(events):
            return None
        self._last = int(events[-1])
        if len(self._names) == 1:
            rows = self._tables[self._names[0]]
            at = np.searchsorted(rows.ticks, events)
            code = self._codes.of({column: rows.columns[column][at] for _, column in self._lines})
            gaps = np.diff(events, prepend=self._at if self._index or self._code >= 0 else events[0]) >= rows.gap
        else:
            levels = []
            for k, (table, column) in enumerate(self._lines):
                before, _, _, known = self._tables[table].at(events)
                values = self._tables[table].columns.get(column, np.full(1, math.nan))[before].astype(np.float64)
                levels.append(self._codes.level(k, np.where(known, values, math.nan)))
            code, gaps = HallCodes.together(levels), np.zeros(len(events), bool)
        self._kept = events, code, self._code
        return self._edges(events, code, gaps)

    def _edges(self, events: I64, code: I64, gaps: NDArray[np.bool_]) -> EdgeChunk | None:
        old = np.r_[self._code, code[:-1]]
        lost = gaps | (code < 0) | (old < 0)  # what changed there is not known
        lost[0] |= self._gap
        if self._code < 0 and not self._index:
            lost[: int(np.argmax(code >= 0)) + 1] = False  # before the first one nothing is lost
        changed = (code != old) & ~gaps & (code >= 0) & (old >= 0)
        at = np.flatnonzero(changed)
        after = np.cumsum(lost)
        found = [
            Gap(k, 0, 0, False) for k, (a, b) in enumerate(pairwise([0, *after[at]])) if b > a
        ]  # fmt: skip
        self._gap = bool(after[-1] > (after[at[-1]] if len(at) else 0))
        self._code, self._at = int(code[-1]), int(events[-1])
        if not len(at):
            return None
        new_codes, old_codes = code[at].astype(np.uint8), old[at].astype(np.uint8)
        sector = _SECTOR[old_codes & 7], _SECTOR[new_codes & 7]
        legal = (sector[0] >= 0) & (sector[1] >= 0) & (np.isin((sector[1] - sector[0]) % 6, (1, 5)))
        index = np.arange(self._index, self._index + len(at), dtype=np.int64)
        self._index += len(at)
        return EdgeChunk(
            self._config, events[at], old_codes, new_codes, ~legal, np.zeros(len(at), np.uint16), index, tuple(found)
        )

    def at(self, grid: I64) -> I64:
        """Codes at times, (n,); -1 where none is known."""
        rows = self._tables[self._names[0]]
        events, code, earlier = self._kept
        if not len(events):
            return np.full(len(grid), earlier)
        before = np.searchsorted(events, grid, "right") - 1
        found = np.where(before >= 0, code[np.maximum(before, 0)], earlier)
        if len(self._names) == 1 and not rows.held:
            _, _, _, known = rows.at(grid)
            found = np.where(known, found, -1)
        return found


class Converter:
    """Makes chunks of a file, piece by piece: edges before the samples of their time."""

    def __init__(self, source: Source, plan: Plan, seen: Survey, when: Timing) -> None:
        self._source, self._plan, self._seen, self._when = source, plan, seen, when
        self.channels = channels(plan, seen, when)
        clock = {"tick_hz": when.tick_hz, "pwm_hz": when.pwm_hz}
        self.config = StreamConfig(1, 0, 1, StreamEvent.PWM, when.decimation, self.channels, 32, **clock)
        self.edge_config = StreamConfig(1, 1, 2, StreamEvent.EDGES, 1, (), 32, **clock)
        self.rejected = Rejected()
        self.samples = self.edges = self.gaps = 0
        self._next: int | None = None  # index of the sample that comes next
        self._tick, self._base, self._period = -_END, 0, 1.0
        self._grid = 0

    def chunks(self, progress: Progress = lambda _: None) -> Iterator[SampleChunk | EdgeChunk]:
        """All of it. Raises BenchError."""
        tables = {name: _Rows(self._plan, self._seen, name, self.rejected) for name in self._plan.tables}
        hall = _Hall(self._plan, self._seen, tables, self.edge_config) if self._plan.lines else None
        if self._when.main is not None:
            self._period = self._seen.clocks[self._when.main].period
        for horizon in blocks(self._source, self._plan, tables):
            edges = hall.take(horizon) if hall else None
            if edges is not None:
                self.edges += len(edges)
                yield edges
            for grid, index in self._times(tables, horizon):
                samples = self._sampled(tables, hall, grid, index)
                if samples is not None:
                    self.samples += len(samples)
                    yield samples
            for rows in tables.values():
                rows.let_go(horizon)
            progress(f"{self.samples} samples, {self.edges} Hall edges")
        for rows in tables.values():
            rows.end()

    def _times(self, tables: Mapping[str, _Rows], horizon: int) -> Iterator[tuple[I64, I64]]:
        """Times of samples up to `horizon`, and their index."""
        when = self._when
        if when.main is not None:
            rows = tables[when.main]
            ticks = rows.ticks[rows.until(horizon)]
            ticks = ticks[ticks > self._tick]
            if len(ticks):
                start = ticks[0] if self._tick == -_END else self._tick
                steps = np.maximum(1, np.rint(np.diff(ticks, prepend=start) / self._period)).astype(np.int64)
                if self._tick == -_END:
                    steps[0] = 0
                base = self._base + np.cumsum(steps)
                self._tick, self._base = int(ticks[-1]), int(base[-1])
                chosen = base % when.every == 0
                if chosen.any():
                    yield ticks[chosen], base[chosen] * (when.decimation // when.every)
            return
        last = max(int(rows.ticks[-1]) for rows in tables.values() if len(rows.ticks)) if horizon == _END else horizon
        until = last * when.pwm_hz // (when.tick_hz * when.decimation) + 1
        while self._grid < until:
            k = np.arange(self._grid, min(until, self._grid + 65_536), dtype=np.int64)
            self._grid = int(k[-1]) + 1
            whole, rest = np.divmod(k * when.decimation, when.pwm_hz)
            yield whole * when.tick_hz + rest * when.tick_hz // when.pwm_hz, k * when.decimation

    def _sampled(self, tables: Mapping[str, _Rows], hall: _Hall | None, grid: I64, index: I64) -> SampleChunk | None:
        """The samples at these times; None for none."""
        keep = np.ones(len(grid), bool)
        code = None
        if hall is not None:
            code = hall.at(grid)
            self.rejected.add("rows without a Hall code", int(np.count_nonzero(code < 0)))
            keep &= code >= 0
        found: dict[str, F64] = {}
        places = {
            name: rows.at(grid) for name, rows in tables.items() if any(i.table == name for i in self._plan.inputs)
        }
        seen_any = np.zeros(len(grid), bool)
        for one in self._plan.inputs:
            values = _values(one, tables[one.table], places[one.table])
            seen_any |= np.isfinite(values)
            if one.flags & Flag.REFERENCE and one.unit == Unit.RAD:
                lacking = keep & ~np.isfinite(values)
                self.rejected.add(f"rows without {one.name}", int(lacking.sum()))
                keep &= ~lacking
            found[one.name] = values
        if self._plan.inputs and hall is None:
            self.rejected.add("rows without any value", int(np.count_nonzero(keep & ~seen_any)))
            keep &= seen_any
        if not keep.any():
            return None
        grid, index = grid[keep], index[keep]
        raw = np.empty(len(grid), self.config.dtype)
        if code is not None:
            raw["hall"] = code[keep] & 7
        for channel in self.channels[code is not None :]:
            raw[channel.name] = _raw(channel, found[channel.name][keep])
        step = self.config.index_step
        lost = np.diff(index, prepend=index[0] - step if self._next is None else self._next - step) // step - 1
        self._next = int(index[-1]) + step
        gaps = tuple(Gap(int(k), int(lost[k]), 0, False) for k in np.flatnonzero(lost > 0))
        self.gaps += len(gaps)
        return SampleChunk(self.config, index, grid, raw, gaps)


def _values(one: Input, rows: _Rows, place: tuple[I64, I64, F64, NDArray[np.bool_]]) -> F64:
    """A channel in its unit at times, (n,); NaN where it is not known."""
    before, after, share, known = place
    if one.column not in rows.columns or not len(rows.ticks):
        return np.full(len(before), math.nan)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is not known
        values = rows.columns[one.column].astype(np.float64) * one.factor + one.offset
        first = values[before]
        between = share > 0.0
        if between.any():
            way = values[after] - first
            way = wrap(way) if one.wraps else way
            first = np.where(between, first + share * way, first)
        if one.wraps:
            first = wrap(first)
    return np.where(known & np.isfinite(first), first, math.nan)


def _raw(channel: AnyChannel, values: F64) -> NDArray[Any]:
    """Raw values, the nearest ones."""
    dtype = np.dtype(channel.raw.dtype)
    if channel.raw == RawType.F32:
        return np.where(np.abs(values) <= _MOST_FLOAT, values, math.nan).astype(dtype)
    counts = np.rint((values - channel.offset) / channel.scale)
    if channel.flags & Flag.WRAPS:
        return counts.astype(np.int64).astype(dtype)
    return counts.astype(dtype)
