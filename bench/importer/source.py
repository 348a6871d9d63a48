"""What a file holds, as every reader gives it: tables whose rows have a time, handed out in batches of bounded size."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bench.importer.units import scale_of
from protocol.signals import Unit
from protocol.text import printable

BATCH = 65_536
"""Rows that are handed out at once, at most."""
RATES = 1e-3, 1e11
"""Rows a second that a file may tell, least and most."""
TICK_HZ = 1_000_000_000
"""Ticks a second of a time that the file has not in ticks of its own."""
Arrays = dict[str, NDArray[Any]]
"""Columns by name, (rows,) each: numbers, of which those that are missing are NaN."""
Batch = dict[str, Arrays]
"""Rows by the name of their table, of one stretch of time where all tables come together."""
Wanted = Mapping[str, Collection[str]]
"""Names of columns by the name of their table."""


@dataclass(frozen=True)
class Column:
    """A column: `unit` as the file has it, empty where it has none."""

    name: str
    unit: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of one time line.

    `time`: name of the column that has it, None where the file tells none. `rate`: rows a second where the file tells
    those instead. `tick_hz`: the column `time` counts these, exactly. `held`: a row is a change, and holds until the
    next one.
    """

    name: str
    columns: tuple[Column, ...]
    time: str | None = None
    rate: float = 0.0
    tick_hz: int = 0
    held: bool = False

    @property
    def names(self) -> list[str]:
        """Of the columns."""
        return [column.name for column in self.columns]


class Source(Protocol):
    """A file that was opened."""

    @property
    def format(self) -> str:
        """One of `bench.importer.FORMATS`."""

    @property
    def tables(self) -> tuple[Table, ...]:
        """All that have numbers."""

    @property
    def about(self) -> Mapping[str, Any]:
        """What else the file says of itself, as plain JSON."""

    @property
    def together(self) -> bool:
        """Whether rows of all tables come in the order of their time."""

    @property
    def left_out(self) -> Sequence[str]:
        """What of it cannot come along, and why."""

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """Rows of the tables that are wanted, in their order, as often as it is called.

        Raises BenchError.
        """

    def line(self, table: str, row: int) -> str:
        """Where a row, from 0, stands in the file, in words."""


@dataclass
class Memory:
    """Tables whose columns are in memory, (rows,) each, by name."""

    contents: Mapping[str, Arrays]
    """By the name of their table."""
    tables: tuple[Table, ...]
    format: str = "arrays"
    about: Mapping[str, Any] = field(default_factory=dict)
    together: bool = False
    left_out: Sequence[str] = ()

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `Source`."""
        for table, names in wanted.items():
            chosen = {name: self.contents[table][name] for name in names}
            for first in range(0, max(map(len, chosen.values()), default=0), BATCH):
                yield {table: {name: values[first : first + BATCH] for name, values in chosen.items()}}

    def line(self, table: str, row: int) -> str:
        """See `Source`."""
        return f"in row {row}"


class Apart:
    """Another source, of which columns that have a value in some rows only are tables of their own."""

    def __init__(self, source: Source, columns: Sequence[tuple[str, str]]) -> None:
        self._source, self._columns = source, {f"{table}/{name}".strip("/"): (table, name) for table, name in columns}
        self.format, self.about, self.together = source.format, source.about, source.together
        self.left_out = source.left_out
        by_name = {table.name: table for table in source.tables}
        rest = [
            replace(table, columns=tuple(c for c in table.columns if (table.name, c.name) not in columns))
            for table in source.tables
        ]
        apart = [
            replace(
                by_name[table],
                name=own,
                columns=tuple(c for c in by_name[table].columns if c.name in (name, by_name[table].time)),
            )
            for own, (table, name) in self._columns.items()
        ]
        self.tables = (*rest, *apart)

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `Source`."""
        of: dict[str, list[str]] = {}
        for table, names in wanted.items():
            origin, value = self._columns.get(table, (table, ""))
            of.setdefault(origin, []).extend([*names, value] if value else names)
        for batch in self._source.batches({name: list(dict.fromkeys(names)) for name, names in of.items()}):
            found: Batch = {}
            for own, names in wanted.items():
                origin, value = self._columns.get(own, (own, ""))
                if origin not in batch:
                    continue
                rows = {name: batch[origin][name] for name in names}
                if value:
                    known = np.isfinite(numbers(batch[origin][value]))
                    rows = {name: values[known] for name, values in rows.items()}
                if len(next(iter(rows.values()))):
                    found[own] = rows
            yield found

    def line(self, table: str, row: int) -> str:
        """See `Source`."""
        return self._source.line(self._columns.get(table, (table, ""))[0], row)


@dataclass(frozen=True)
class Leaf:
    """An array (n,) somewhere in a file that has many: `read` gives rows [first, last) of it."""

    parent: str
    name: str
    n: int
    read: Callable[[int, int], NDArray[Any]]
    unit: str = ""
    rate: float = 0.0
    """Rows a second, where it tells them."""


class Leaves:
    """Arrays, put together to tables: those of one place that are alike long."""

    together = False

    def __init__(self, format: str, leaves: Iterable[Leaf], about: Mapping[str, Any], left_out: Sequence[str]) -> None:
        self.format, self.about, self.left_out = format, about, left_out
        groups: dict[tuple[str, int, float], dict[str, Leaf]] = {}
        for leaf in leaves:
            groups.setdefault((leaf.parent, leaf.n, leaf.rate), {})[leaf.name] = leaf
        parents = [parent for parent, _, _ in groups]
        self._leaves: dict[str, dict[str, Leaf]] = {}
        tables = []
        for (parent, n, rate), group in groups.items():
            of = f"({n} at {rate:g} Hz)" if rate else f"({n})"
            plain = parent if parents.count(parent) == 1 else f"{parent}{of}"
            name = next(one for one in chain([plain], (f"{plain} {k}" for k in count(2))) if one not in self._leaves)
            columns = tuple(Column(leaf.name, printable(leaf.unit)[:40]) for leaf in group.values())
            tables.append(Table(name, columns, None if rate else time_column(columns), rate))
            self._leaves[name] = group
        self.tables = tuple(_with_shared_time(tables, self._leaves))

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `Source`."""
        for table, names in wanted.items():
            leaves = [self._leaves[table][name] for name in names]
            for first in range(0, max((leaf.n for leaf in leaves), default=0), BATCH):
                yield {table: {leaf.name: leaf.read(first, min(first + BATCH, leaf.n)) for leaf in leaves}}

    def line(self, table: str, row: int) -> str:
        """See `Source`."""
        return f"in row {row + 1}{f' of {printable(table)}' if table else ''}"


def _with_shared_time(tables: list[Table], leaves: dict[str, dict[str, Leaf]]) -> Iterator[Table]:
    """Tables, those without a time with that of another which is alike long, where there is one and only one."""
    timed = [table for table in tables if table.time]
    for table in tables:
        n = next(iter(leaves[table.name].values())).n
        alike = [t for t in timed if leaves[t.name][t.time or ""].n == n]
        if table.time is None and not table.rate and len(alike) == 1:
            time = leaves[alike[0].name][alike[0].time or ""]
            leaves[table.name][time.name] = time
            table = replace(table, columns=(*table.columns, Column(time.name, time.unit)), time=time.name)
        yield table


_TIMES = re.compile(
    r"^(t|time|times|timestamps?|zeit|ms_today|__time|elapsed|x|sekunden|seconds?|tout)\b|"
    r"^time[ _(\[]|_time$|time_?(s|ms|us|ns)$",
    re.IGNORECASE,
)


def time_column(columns: Sequence[Column], kinds: Mapping[str, str] | None = None) -> str | None:
    """Which column is the time, by its name, its unit, or what its cells are; None where none seems so."""
    kinds = kinds or {}
    dated = [column.name for column in columns if kinds.get(column.name) in ("date", "zoned date", "clock")]
    of_unit = [c.name for c in columns if c.unit and (scale := scale_of(c.unit)) and scale.unit == Unit.S]
    named = [column.name for column in columns if _TIMES.search(column.name)]
    both = [name for name in named if name in of_unit]
    return next(iter((*both, *named, *dated, *of_unit[:1])), None)


def numbers(values: NDArray[Any]) -> NDArray[Any]:
    """Values (n,) as numbers: bool as 0 and 1, dates as ns since 1970, float16 wider, infinity as NaN.

    Raises ValueError for others.
    """
    kind = values.dtype.kind
    if kind == "M":
        return values.astype("datetime64[ns]").astype(np.int64)
    if kind == "m":
        return values.astype("timedelta64[ns]").astype(np.int64)
    if kind == "b":
        return values.astype(np.uint8)
    if kind not in "iuf" or values.dtype.itemsize > 8:
        raise ValueError(f"{values.dtype} is no number")
    if kind != "f":
        return values
    unknown = ~np.isfinite(values)  # with NaN that signals, of which numpy would warn
    values = np.where(unknown, values.dtype.type(np.nan), values) if unknown.any() else values
    return values.astype(np.float32) if values.dtype.itemsize == 2 else values
