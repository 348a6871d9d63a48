"""A file gone through once before anything is made of it: its clock, its values, and what its Hall inputs say.

A time that goes back, or that stands still, is refused here, with the line. Memory does not grow with the file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.importer.plan import TURNING, Plan
from bench.importer.source import TICK_HZ, Arrays, Source, Table, numbers
from bench.signal.position import wrap
from protocol.signals import SECTOR_OF_CODE, Unit
from protocol.text import counted

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

KEPT = 200_000
"""Differences of times that are kept to tell the period from."""
GAP = 1.5
"""Periods from one row to the next, from which on rows are missing between them."""
SAME = 0.01
"""Share of rows that may have the time of the row before: more, and the column does not tell the time."""
SURE = 36
"""Sectors passed from which on the pole pairs are told from them."""
_SECTOR = np.array(SECTOR_OF_CODE)
Progress = Callable[[str], None]


@dataclass
class Clock:
    """Times of a table's rows, in ticks."""

    rows: int = 0
    first: int = 0
    last: int | None = None
    same: int = 0
    """Rows with the time of the row before,"""
    same_at: int = -1
    """the first one of them."""
    leap: int = 0
    """The longest step from one row to the next, in ticks,"""
    leap_at: int = -1
    """and the row that it goes to."""
    untimed: int = 0
    """Rows without a time."""
    _usual: float = 0.0
    _sums: F64 = field(default_factory=lambda: np.zeros(3))  # of usual steps: how many, their sum, that of squares
    _steps: list[I64] = field(default_factory=list)
    _kept: int = 0
    _every: int = 1

    def add(self, ticks: I64, row: int) -> None:
        """Add times of rows in a row, the first of them number `row`; they do not go back."""
        steps = np.diff(ticks) if self.last is None else np.diff(ticks, prepend=self.last)
        if self.last is None:
            self.first = int(ticks[0])
        self.last = int(ticks[-1])
        self.rows += len(ticks)
        if len(steps) and (leap := int(steps.max())) > self.leap:
            self.leap, self.leap_at = leap, row + int(np.argmax(steps)) + (len(ticks) - len(steps))
        still = steps == 0
        if still.any() and self.same_at < 0:
            self.same_at = row + int(np.argmax(still)) + (len(ticks) - len(steps))
        self.same += int(still.sum())
        steps = steps[~still]
        if len(steps) and not self._usual:
            self._usual = float(np.median(steps))
        near = steps[steps < GAP * self._usual].astype(np.float64) - self._usual
        self._sums += [len(near), near.sum(), near @ near]
        self._steps.append(steps[:: self._every])
        self._kept += len(self._steps[-1])
        while self._kept > KEPT:
            self._every *= 2
            self._steps = [np.concatenate(self._steps)[::2]]
            self._kept = len(self._steps[0])

    @property
    def steps(self) -> F64:
        """Some of the differences of times, in ticks."""
        if not self._steps or not self._kept:
            return np.ones(1)
        return np.concatenate(self._steps).astype(np.float64)

    @property
    def period(self) -> float:
        """Ticks from one row to the next, where none is missing."""
        return self._spread[0]

    @property
    def jitter(self) -> float:
        """Standard deviation of that, in ticks."""
        return self._spread[1]

    @property
    def _spread(self) -> tuple[float, float]:
        """Mean and standard deviation of steps between which no row is missing."""
        steps = self.steps
        usual = float(np.median(steps))
        if self._sums[0] and abs(usual - self._usual) < 0.2 * usual:  # all of them were counted
            mean, square = self._sums[1] / self._sums[0], self._sums[2] / self._sums[0]
            return float(self._usual + mean), math.sqrt(max(0.0, square - mean**2))
        near = steps[steps < GAP * usual]
        return float(near.mean()), float(near.std())

    @property
    def regular(self) -> bool:
        """Whether rows come at one rate: but for gaps, each half a period before or after its time at most."""
        steps, period = self.steps, self.period
        return bool(np.mean(np.abs(steps / period - np.maximum(1.0, np.rint(steps / period))) < 0.5 - 1e-9) > 0.98
                    and np.mean(steps > 0.5 * period) > 0.98 and np.mean(steps < GAP * period) > 0.8)  # fmt: skip


@dataclass
class Values:
    """What a column has."""

    n: int = 0
    missing: int = 0
    least: float = math.inf
    most: float = -math.inf
    whole: bool = True
    dtype: np.dtype[Any] | None = None

    def add(self, values: NDArray[Any]) -> None:
        """Add some."""
        self.dtype = values.dtype if self.dtype is None else np.promote_types(self.dtype, values.dtype)
        self.n += len(values)
        if values.dtype.kind == "f":
            known = values[np.isfinite(values)]
            self.missing += len(values) - len(known)
            self.whole = self.whole and bool((known == np.rint(known)).all())
            values = known
        if len(values):
            self.least, self.most = min(self.least, float(values.min())), max(self.most, float(values.max()))

    @property
    def constant(self) -> bool:
        """Whether it never changes."""
        return self.n > 1 and not self.least < self.most


class HallCodes:
    """Makes Hall codes of the inputs' columns, row by row; a code that is not known is -1."""

    def __init__(self, plan: Plan, thresholds: tuple[float, ...] = ()) -> None:
        self._columns = [column for _, column in plan.lines]
        self._bits = plan.hall.bits
        self._one = bool(plan.hall.column)
        self._thresholds = thresholds  # low and high of each line; empty for lines that are 0 or 1
        self._state = [-1, -1, -1]

    def of(self, columns: Mapping[str, NDArray[Any]]) -> I64:
        """Codes of rows, (n,)."""
        if self._one:
            values = numbers(columns[self._columns[0]])
            known = (np.abs(values) < 2.0**53) & (values == np.rint(values))  # what is no whole number is no code
            word = np.where(known, values, 0).astype(np.int64)
            code = sum((word >> bit & 1) << k for k, bit in enumerate(self._bits))
            return np.where(known, code, -1)
        return self.together([self.level(k, columns[name]) for k, name in enumerate(self._columns)])

    def level(self, k: int, values: NDArray[Any]) -> I64:
        """0 or 1 of line k, (n,); -1 where it is not known yet."""
        values = numbers(values).astype(np.float64)
        low, high = self._thresholds[2 * k : 2 * k + 2] if self._thresholds else (0.5, 0.5)
        told = np.where(values > high, 1, np.where(values < low, 0, 2))
        told = np.where(np.isfinite(values), told, 3)  # a missing one is not known, and none follows from it
        told = np.r_[self._state[k] if self._state[k] >= 0 else 3, told]
        last = np.maximum.accumulate(np.where(told != 2, np.arange(len(told)), 0))
        levels = told[last][1:]
        if len(levels):
            self._state[k] = int(levels[-1]) if levels[-1] < 2 else -1
        return np.where(levels < 2, levels, -1)

    @staticmethod
    def together(levels: list[I64]) -> I64:
        """The code of three levels, (n,) each."""
        a, b, c = levels
        return np.where((a < 0) | (b < 0) | (c < 0), -1, a | b << 1 | c << 2)


class _Slope:
    """Electrical turns by the sectors for each turn of an angle, least squares."""

    def __init__(self) -> None:
        self._sum = np.zeros(6)
        self._at = 0.0, 0.0

    def add(self, x: F64, y: F64) -> None:
        """Add what both went from row to row, turns."""
        x, y = self._at[0] + np.cumsum(x), self._at[1] + np.cumsum(y)
        if len(x):
            self._at = float(x[-1]), float(y[-1])
        self._sum += [len(x), x.sum(), y.sum(), x @ x, x @ y, y @ y]

    @property
    def ratio(self) -> float:
        """NaN where they do not go together."""
        n, x, y, xx, xy, yy = self._sum
        if not n:
            return math.nan
        var_x, var_y, cov = xx - x * x / n, yy - y * y / n, xy - x * y / n
        return cov / var_x if var_x > 0.0 and var_y > 0.0 and cov**2 > 0.998 * var_x * var_y else math.nan


@dataclass
class Survey:
    """What was seen of a file."""

    clocks: dict[str, Clock]
    values: dict[tuple[str, str], Values]
    tick_hz: int
    origin: float
    """What time 0 is in the file's own time, s."""
    sectors: int = 0
    """Hall sectors passed to a neighbour,"""
    leaps: int = 0
    """and changes to a code that is none."""
    turns: dict[str, float] = field(default_factory=dict)
    """Electrical turns by the sectors for each turn of a channel's angle; NaN where it is not clear."""
    thresholds: tuple[float, ...] = ()

    def pole_pairs(self, plan: Plan) -> Plan:
        """The plan with what the Hall sensors tell of angles of which nobody has said whose they are."""
        n_p, electrical = plan.n_p, {}
        for one in plan.inputs:
            ratio = abs(self.turns.get(one.name, math.nan))
            near = round(ratio) if math.isfinite(ratio) else 0
            if near < 1 or abs(ratio - near) > 0.05 * near or self.sectors < SURE:
                continue
            if one.electrical is None:
                electrical[one.name] = near == 1 and n_p != 1
            if not electrical.get(one.name, one.electrical):
                n_p = n_p or near
        return plan.with_n_p(n_p, electrical)


def ticks_of(table: Table, columns: Arrays, row: int, factor: float, tick_hz: int, origin: float) -> tuple[I64, Any]:
    """Ticks of rows, the first of them number `row`, and which rows have a time, (n,)."""
    n = max(map(len, columns.values()))
    if table.time is None:
        at = np.arange(row, row + n, dtype=np.int64)
        rate = Fraction(table.rate).limit_denominator(1000)
        return _scaled(at, tick_hz * rate.denominator, rate.numerator), np.ones(n, bool)
    values = numbers(columns[table.time])
    if values.dtype.kind in "iu":
        if table.tick_hz:
            if table.tick_hz == tick_hz:
                return values.astype(np.int64) - round(origin * tick_hz), np.ones(n, bool)
            return _scaled(values.astype(np.int64), tick_hz, table.tick_hz) - round(origin * tick_hz), np.ones(n, bool)
        per = Fraction(factor).limit_denominator(10**12) * tick_hz
        return _scaled(values.astype(np.int64) - round(origin / factor), per.numerator, per.denominator), np.ones(
            n, bool
        )
    known = np.isfinite(values)
    with np.errstate(over="ignore"):
        seconds = (np.where(known, values, 0.0) - origin / factor) * factor
        return np.rint(np.clip(seconds * tick_hz, -(2.0**62), 2.0**62)).astype(np.int64), known


def _scaled(values: I64, up: int, down: int) -> I64:
    """values * up / down, rounded, without an overflow of what fits."""
    whole, rest = np.divmod(values, down)
    return whole * up + (rest.astype(np.float64) * up / down + 0.5).astype(np.int64)


def tick_hz_of(plan: Plan) -> int:
    """Ticks a second that times of all tables are told in."""
    own = {table.tick_hz for table in plan.tables.values() if table.tick_hz}
    if len(own) == 1 and all(table.tick_hz for table in plan.tables.values()):
        return own.pop()
    rates = {table.rate for table in plan.tables.values()}
    if len(rates) == 1 and (rate := rates.pop()):
        numerator = Fraction(rate).limit_denominator(1000).numerator
        return next(numerator * k for k in (1000, 100, 10, 1) if numerator * k <= 2 * TICK_HZ or k == 1)
    return TICK_HZ


def survey(source: Source, plan: Plan, progress: Progress = lambda _: None) -> Survey:
    """Go through a file. Raises BenchError for a time that is none."""
    seen = Survey({name: Clock() for name in plan.tables}, {}, tick_hz_of(plan), 0.0)
    seen.origin = _origin(source, plan)
    _pass(source, plan, seen, plan.wanted, progress)
    for name, clock in seen.clocks.items():
        if clock.rows < 2:
            raise BenchError(
                f"{name + ': ' if name else ''}{counted(clock.rows, 'row')} with a time: nothing to import"
            )
        if clock.same > SAME * clock.rows and not plan.tables[name].held:
            raise BenchError(
                f"{clock.same} of {clock.rows} rows have the time of the row before, first "
                f"{source.line(name, clock.same_at)}: column {plan.tables[name].time} is too coarse, or is no time: "
                "choose another (--time), or give --rate HZ and --time ''"
            )
    if plan.lines and (thresholds := _thresholds(plan, seen)):
        seen.thresholds, seen.sectors, seen.leaps = thresholds, 0, 0
        _pass(source, plan, seen, {table: plan.wanted[table] for table, _ in plan.lines}, progress)
    return seen


def _origin(source: Source, plan: Plan) -> float:
    """The first time of all, s."""
    first: list[float] = []
    for name, table in plan.tables.items():
        if table.time is None:
            return 0.0
        for batch in source.batches({name: [table.time]}):
            values = numbers(batch[name][table.time]) if name in batch else np.empty(0)
            known = values[np.isfinite(values)] if values.dtype.kind == "f" else values
            if len(known):
                first.append(float(known[0]) * plan.time_factor[name])
                break
    return min(first, default=0.0)


def each(source: Source, wanted: Mapping[str, list[str]]) -> Iterator[tuple[str, Arrays]]:
    """Rows of all tables, each in its order."""
    if source.together:
        for batch in source.batches(wanted):
            yield from batch.items()
        return
    for name, columns in wanted.items():
        for batch in source.batches({name: columns}):
            yield from batch.items()


def _pass(source: Source, plan: Plan, seen: Survey, wanted: Mapping[str, list[str]], progress: Progress) -> None:
    """Go through rows: their clock and values the first time, and what the Hall inputs say."""
    rows = dict.fromkeys(plan.tables, 0)
    slopes = {one.name: _Slope() for one in plan.inputs if one.unit in TURNING and not one.own}
    last: dict[str, Any] = {}
    again = bool(seen.thresholds)
    hall = {table for table, _ in plan.lines}
    codes = HallCodes(plan, seen.thresholds)
    for name, columns in each(source, wanted):
        ticks, known = ticks_of(
            plan.tables[name], columns, rows[name], plan.time_factor[name], seen.tick_hz, seen.origin
        )  # fmt: skip
        if not again:
            _look(source, plan, seen, name, columns, ticks, known, rows[name])
        if hall == {name}:
            _turn(plan, seen, name, columns, ticks, codes.of(columns), slopes, last)
        rows[name] += len(ticks)
        progress(f"{sum(rows.values())} rows looked at")
    seen.turns = {name: slope.ratio for name, slope in slopes.items()}


def _look(
    source: Source, plan: Plan, seen: Survey, name: str, columns: Arrays, ticks: I64, known: Any, row: int
) -> None:
    clock = seen.clocks[name]
    at = np.flatnonzero(known)
    clock.untimed += len(ticks) - len(at)
    if len(at):
        before = int(ticks[at[0]]) if clock.last is None else clock.last
        back = np.flatnonzero(np.diff(ticks[at], prepend=before) < 0)
        if len(back):
            k = int(at[back[0]])
            was = before if not back[0] else int(ticks[at[back[0] - 1]])
            raise BenchError(
                f"time goes back {source.line(name, row + k)}: from {was / seen.tick_hz + seen.origin:.9g} to "
                f"{int(ticks[k]) / seen.tick_hz + seen.origin:.9g} s: cut the file there, or choose another time "
                "column (--time)"
            )
        clock.add(ticks[at], row + int(at[0]))
    for column, values in columns.items():
        if column != plan.tables[name].time:
            seen.values.setdefault((name, column), Values()).add(numbers(values))


def _turn(
    plan: Plan, seen: Survey, name: str, columns: Arrays, ticks: I64, code: I64,
    slopes: Mapping[str, _Slope], last: dict[str, Any],
) -> None:  # fmt: skip
    """Count how the sectors follow each other, and how far they turn for each turn of an angle."""
    code = np.r_[last.get("code", code[:1]), code]
    time = np.r_[last.get("time", ticks[:1]), ticks]
    last["code"], last["time"] = code[-1:], time[-1:]
    sector = np.where(code >= 0, _SECTOR[np.clip(code, 0, 7)], -1)
    step = (np.diff(sector) + 3) % 6 - 3
    sure = (sector[1:] >= 0) & (sector[:-1] >= 0)
    step = np.where(sure, step, 0)
    changed = np.diff(code) != 0
    seen.sectors += int(np.count_nonzero(changed & sure & (np.abs(step) == 1)))
    seen.leaps += int(np.count_nonzero(changed & (code[1:] >= 0) & (code[:-1] >= 0) & ~(sure & (np.abs(step) == 1))))
    step = np.where(np.abs(step) == 1, step, 0)
    for one in plan.inputs:
        if one.name in slopes and one.table == name:
            values = numbers(columns[one.column]).astype(np.float64) * one.factor
            values = np.r_[last.get(one.name, values[:1]), values]
            last[one.name] = values[-1:]
            went = wrap(np.diff(values)) if one.unit == Unit.RAD else values[1:] * np.diff(time) / seen.tick_hz
            usable = np.isfinite(went)
            slopes[one.name].add(went[usable] / math.tau, step[usable] / 6.0)


def _thresholds(plan: Plan, seen: Survey) -> tuple[float, ...]:
    """Low and high threshold of each line; empty where all are 0 and 1. BenchError for a line that is always alike."""
    lines = [seen.values[line] for line in plan.lines]
    if plan.hall.column:
        return ()
    if all(line.whole and {line.least, line.most} <= {0.0, 1.0} for line in lines):
        return ()
    found: list[float] = []
    for (_, name), line in zip(plan.lines, lines, strict=True):
        if not line.least < line.most:
            raise BenchError(f"Hall input {name} is always {line.least:g}: is it the right column?")
        middle = (line.least + line.most) / 2.0 if plan.hall.threshold is None else plan.hall.threshold
        if not line.least < middle < line.most:
            raise BenchError(
                f"Hall input {name} goes from {line.least:g} to {line.most:g}, never through the threshold {middle:g}"
            )
        around = 0.1 * (line.most - line.least)
        found += [middle - around, middle + around]
    return tuple(found)
