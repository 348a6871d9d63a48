"""Text in columns: any separator, decimal comma, lines before the header, a line of units, wide or long; by pyarrow.

How it is written is told from its first 256 KiB; a cell further on that is no number is an error with its line.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv as arrow_csv

from bench.errors import BenchError
from bench.importer.files import HEAD, Utf8, encoding_of, head, reading, stream
from bench.importer.mapping import Text
from bench.importer.source import Batch, Column, Table, Wanted, time_column
from bench.importer.units import quantity, scale_of, split
from protocol.signals import Unit
from protocol.text import counted, printable

SEPARATORS = (",", ";", "\t", "|", " ")
MISSING = ("", "nan", "NaN", "NAN", "NA", "N/A", "n/a", "null", "NULL", "None", "-", "--", "---", "?")
MOST_COLUMNS = 5000
LOOKED_AT = 200
"""Lines from which types are told."""
RAGGED = 0.1
"""Share of lines with another number of columns, from which on the separator is in doubt."""
_FITTING = {"number": ("number", "digits", "integer"), "integer": ("digits", "integer")}
"""Kinds of cells that a column may have, where it is not its own alone."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf|Inf|INF|infinity)")
_COMMA_NUMBER = re.compile(r"[+-]?(\d+,?\d*|,\d+)([eE][+-]?\d+)?")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d{1,9})?)?(Z|[+-]\d\d:?\d\d)?")
_ZONE = re.compile(r":\d\d(\.\d+)?(Z|[+-]\d\d:?\d\d)$")
_RATE = re.compile(
    r"(?:(sampl\w*[ _]*rate)|\b(?:sampl\w*[ _]*(?:interval|period)|increment|time[ _]*base[ _]*step)|^dt)\b"
    r"\s*(?:[\[(]([^\])]*)[\])])?\s*[:=]?(.*)",
    re.IGNORECASE | re.DOTALL,
)
_COUNTS = ("sequence", "counter")
"""What stands in place of a unit where a column counts rows."""
_CLOCK = re.compile(r"\d\d:\d\d:\d\d(\.\d{1,9})?")


@dataclass(frozen=True)
class Written:
    """How a text is written."""

    encoding: str
    separator: str
    decimal: str
    first: int
    """Lines before the first one with values."""
    names: tuple[str, ...]
    units: tuple[str, ...]
    types: tuple[str, ...]
    """number, integer, bool, date, zoned date, clock, text or empty, of each column."""
    rows: tuple[tuple[str, ...], ...]
    """Some of the first ones."""
    rate: float
    """Rows a second that the lines above tell; 0 where they do not."""

    @property
    def squeeze(self) -> bool:
        """Whether columns are set apart by any number of spaces."""
        return self.separator == " "


class CsvFile:
    """A text in columns. Raises BenchError where it is none."""

    format = "csv"
    together = True

    def __init__(self, path: Path, told: Text) -> None:
        self._path = path
        self._written = written(path, told)
        self.about: Mapping[str, Any] = {"separator": self._written.separator, "decimal": self._written.decimal}
        self._long = told.layout == "long" or (not told.layout and _seems_long(self._written))
        self.left_out: list[str] = []
        self.tables = self._long_tables() if self._long else (self._wide_table(),)

    def _wide_table(self) -> Table:
        written = self._written
        columns = [Column(*pair) for pair in zip(written.names, written.units, strict=True)]
        usable = tuple(c for c, kind in zip(columns, written.types, strict=True) if kind not in ("text", "empty"))
        self.left_out += [
            f"{printable(column.name)}: '{printable(cell)[:30]}' is no number"
            for k, (column, kind) in enumerate(zip(columns, written.types, strict=True))
            if kind == "text" and (cell := next((row[k].strip() for row in written.rows if row[k].strip()), ""))
        ]
        if not usable:
            first = ", ".join(written.rows[0][:5]) if written.rows else ""
            raise BenchError(f"{self._path}: no column has numbers ({printable(first)[:60]} …): is the separator "
                             "right? (--separator, --decimal)")  # fmt: skip
        time = time_column(usable, dict(zip(written.names, written.types, strict=True)))
        time = time or _even_column(written, [column.name for column in usable])
        if written.rate and time and _counts_rows(written, time):
            self.left_out.append(f"{printable(time)}: it counts rows")
            usable, time = tuple(column for column in usable if column.name != time), None
        table = Table("", tuple(_dated(column, time, written) for column in usable), time)
        if time is None:
            return replace(table, rate=written.rate)
        return replace(table, held=_are_changes(written, time))

    def _long_tables(self) -> tuple[Table, ...]:
        """One for each name."""
        self._time, self._name, self._value = _roles(self._written)
        names: dict[str, None] = {}
        for batch in self._batches([self._name], {self._name: pa.string()}):
            names.update(dict.fromkeys(pc.unique(batch.column(0)).to_pylist()))
            if len(names) > MOST_COLUMNS:
                raise BenchError(f"{self._path}: more than {MOST_COLUMNS} names in column {self._name}: is it a name?")
        written = self._written
        unit = written.units[written.names.index(self._time)]
        time = Column(self._time, unit)
        return tuple(Table(name or "", (self._valued(name or "no name"), time), self._time) for name in names)

    def _valued(self, name: str) -> Column:
        """The column of a name's values."""
        plain, unit = split(name)
        return Column(plain if plain != self._time else f"{plain} value", unit)

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `bench.importer.source.Source`."""
        if self._long:
            yield from self._long_batches(wanted)
            return
        for table, names in wanted.items():
            for batch in self._batches(list(names)):
                yield {table: {name: array_of(column) for name, column in zip(batch.schema.names, batch, strict=True)}}

    def _long_batches(self, wanted: Wanted) -> Iterator[Batch]:
        value = {table.name: next(c.name for c in table.columns if c.name != self._time) for table in self.tables}
        for batch in self._batches([self._time, self._name, self._value], {self._name: pa.string()}):
            names = np.asarray(batch.column(self._name).to_pylist(), object)
            time, values = array_of(batch.column(self._time)), array_of(batch.column(self._value))
            found: Batch = {}
            for table in wanted:
                of = names == table
                if of.any():
                    found[table] = {self._time: time[of], value[table]: values[of]}
            yield found

    def line(self, table: str, row: int) -> str:
        """See `bench.importer.source.Source`."""
        at = self._written.names.index(self._name) if self._long else 0
        of_table = (number for number, cells in self._lines() if not self._long or cells[at].strip() == table)
        return f"in line {next(islice(of_table, row, None), 0)}"

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        """Lines with values, those of another number of columns left out: number from 1, cells."""
        written = self._written
        with stream(self._path) as file:
            lines = io.TextIOWrapper(io.BufferedReader(Utf8(file, written.encoding, False)), "utf-8")
            for number, line in enumerate(lines, 1):
                if number > written.first and line.strip("\r\n"):
                    cells = _cells(line, written.separator)
                    if len(cells) == len(written.names):
                        yield number, cells

    def _batches(self, names: list[str], types: Mapping[str, Any] | None = None) -> Iterator[Any]:
        written, width = self._written, len(self._written.names)
        ragged: list[Any] = []

        def invalid(row: Any) -> str:
            ragged.append(row)
            return "skip"

        kinds = {
            "number": pa.float64(), "integer": pa.int64(), "bool": pa.bool_(), "date": pa.timestamp("ns"),
            "zoned date": pa.timestamp("ns", "UTC"),
            "clock": pa.time64("ns"), "text": pa.string(), "empty": pa.null(),
        }  # fmt: skip
        chosen = {name: kinds[kind] for name, kind in zip(written.names, written.types, strict=True) if name in names}
        rows = 0
        with reading(self._path, "text in columns", UnicodeError), stream(self._path) as file:
            text = Utf8(file, written.encoding, written.squeeze)
            text.skip_lines(written.first)
            try:
                reader = arrow_csv.open_csv(
                    io.BufferedReader(text, 1 << 20),
                    arrow_csv.ReadOptions(column_names=list(written.names), block_size=1 << 20),
                    arrow_csv.ParseOptions(delimiter=written.separator, invalid_row_handler=invalid),
                    arrow_csv.ConvertOptions(
                        column_types=chosen | dict(types or {}), include_columns=names, null_values=list(MISSING),
                        strings_can_be_null=False, decimal_point=written.decimal,
                    ),
                )  # fmt: skip
                for batch in reader:
                    rows += len(batch)
                    yield batch
            except pa.ArrowInvalid as error:
                raise BenchError(f"{self._path}: {self._wrong(str(error))}") from None
        if len(ragged) > RAGGED * (rows + len(ragged)):
            raise BenchError(
                f"{self._path}: {len(ragged)} of {rows + len(ragged)} lines do not have {counted(width, 'column')}, "
                f"such as '{printable(ragged[0].text)[:60]}': is the separator '{printable(written.separator)}'? "
                "(--separator)"
            )
        if ragged:
            words = f"{counted(len(ragged), 'line')} with another number of columns, such as "
            self.left_out[:] = dict.fromkeys([*self.left_out, f"{words}'{printable(ragged[0].text)[:40]}'"])

    def _wrong(self, words: str) -> str:
        """What is wrong with a cell that is no number, with its line."""
        found = re.search(r"column #(\d+)", words)
        written = self._written
        if found and int(found[1]) < len(written.names):
            at = int(found[1])
            for number, cells in self._lines():
                kind, usual = _cell_kind(cells[at], written.decimal), written.types[at]
                if kind not in ("missing", *_FITTING.get(usual, (usual,))):
                    return (
                        f"line {number}, column {printable(written.names[at])}: '{printable(cells[at].strip())[:40]}' "
                        f"is no {usual}: mend or remove that line, or leave the column out (--only-named)"
                    )
        return printable(words)[:200]


def written(path: Path, told: Text) -> Written:
    """How a text is written. Raises BenchError where it is no text in columns."""
    data = head(path)
    encoding = told.encoding or encoding_of(data)
    if b"\0" in data and not encoding.startswith("utf-16"):
        raise BenchError(f"{path} is no text: give --format")
    try:
        text = data.decode(encoding, "replace")
    except LookupError:
        raise BenchError(f"--encoding {encoding}: there is no such encoding") from None
    if not text.strip():
        raise BenchError(f"{path} is empty")
    lines = list(io.StringIO(text, newline=None))  # ends of lines as pyarrow takes them, and no others
    if len(data) >= HEAD and len(lines) > 1:
        lines.pop()  # it is cut
    if max(map(len, lines)) > HEAD - 16 and len(data) >= HEAD:
        raise BenchError(
            f"{path}: a line is longer than {HEAD >> 10} KiB: is a row a sample? (a table lying on its side)"
        )
    separator, decimal = _separator(lines, told)
    rows = [_cells(line, separator) for line in lines]
    width, first = _data(rows, decimal)
    if width > MOST_COLUMNS:
        raise BenchError(f"{path} has {width} columns: is a row a sample? (a table lying on its side)")
    values = [tuple(row) for row in rows[first:] if len(row) == width][:LOOKED_AT]
    names, units = _header(rows, first, width, decimal, told.names)
    if not values:
        raise BenchError(f"{path}: no line has numbers: is the separator right? (--separator, --decimal)")
    types = tuple(_usual_kind([row[k] for row in values], decimal) for k in range(width))
    return Written(
        encoding, separator, decimal, first, names, units, types, tuple(values), _rate(rows[:first], decimal)
    )


def _separator(lines: list[str], told: Text) -> tuple[str, str]:
    """The separator and the decimal point with which most cells are numbers."""
    last = [line for line in lines if line.strip()][-LOOKED_AT:]
    if len(last) > 4:
        last = last[len(last) // 4 :]
    choices = [
        (separator, decimal)
        for separator in ([_named_separator(told.separator)] if told.separator else SEPARATORS)
        for decimal in ([told.decimal] if told.decimal else ".,")
        if separator != decimal
    ]

    def fitting(choice: tuple[str, str]) -> int:
        cells = [_cells(line, choice[0]) for line in last]
        usual = max(set(map(len, cells)), key=[len(row) for row in cells].count)
        found = [_cell_kind(cell, choice[1]) for row in cells if len(row) == usual for cell in row]
        return sum(1 if kind != "text" else -1 for kind in found) - sum(len(row) != usual for row in cells)

    if not choices:
        raise BenchError(f"--separator {told.separator}: it is the decimal sign, too")
    return max(choices, key=fitting)


def _named_separator(word: str) -> str:
    named = {"tab": "\t", "\\t": "\t", "space": " ", "comma": ",", "semicolon": ";"}.get(word.lower(), word)
    if len(named) != 1 or named in "\"'\r\n":
        raise BenchError(f"--separator {word}: give one character, or tab, space, comma, semicolon")
    return named


def _cells(line: str, separator: str) -> list[str]:
    line = line.rstrip("\r\n")
    if separator == " ":
        return line.split()
    if '"' in line:
        try:
            return next(csv.reader([line], delimiter=separator), [""])
        except csv.Error:
            pass
    return line.split(separator)


@lru_cache(maxsize=1 << 16)
def _cell_kind(cell: str, decimal: str) -> str:
    """What a cell is; missing where it says so, integer where no float64 has all its digits."""
    cell = cell.strip()
    if cell in MISSING:
        return "missing"
    if (_NUMBER if decimal == "." else _COMMA_NUMBER).fullmatch(cell):
        digits = cell.lstrip("+-")
        return "number" if not digits.isdigit() else "integer" if len(digits) > 15 else "digits"
    if _DATE.fullmatch(cell):
        return "zoned date" if _ZONE.search(cell) else "date"
    if _CLOCK.fullmatch(cell):
        return "clock"
    return "bool" if cell.lower() in ("true", "false") else "text"


def _kind(cells: Iterable[str], decimal: str) -> str:
    """What a column's cells are."""
    kinds = {_cell_kind(cell, decimal) for cell in cells} - {"missing"}
    if kinds <= {"number", "digits", "integer"}:
        return "integer" if "integer" in kinds and "number" not in kinds else "number"
    if kinds == {"date", "zoned date"}:
        return "date"
    return kinds.pop() if len(kinds) == 1 else "text"


def _usual_kind(cells: list[str], decimal: str) -> str:
    """What most of a column's cells are; empty where it has none."""
    known = [cell for cell in cells if _cell_kind(cell, decimal) != "missing"]
    numbers = [cell for cell in known if _cell_kind(cell, decimal) != "text"]
    return "empty" if not known else _kind(numbers if 2 * len(numbers) > len(known) else known, decimal)


def _data(rows: list[list[str]], decimal: str) -> tuple[int, int]:
    """Number of columns, and of lines before the first one with values."""
    full = [k for k, row in enumerate(rows) if any(cell.strip() for cell in row)]
    widths = [len(rows[k]) for k in full]
    tail = widths[len(widths) // 2 :]
    width = max(set(tail), key=tail.count, default=0)
    if not width:
        return 1, len(rows)
    last = rows[full[-1]] if len(rows[full[-1]]) == width else []
    numeric = [_cell_kind(cell, decimal) not in ("missing", "text") for cell in last]
    for k in full:
        row = rows[k]
        if len(row) == width and _values(row, numeric, decimal):
            return width, k
    return width, full[-1] + 1


def _values(row: list[str], numeric: list[bool], decimal: str) -> bool:
    """Whether a line has values: numbers where the last line has them, some at least."""
    cells = [cell for cell, number in zip(row, numeric or [True] * len(row), strict=False) if number and cell.strip()]
    kinds = {_cell_kind(cell, decimal) for cell in cells}
    return "text" not in kinds and bool(kinds - {"missing"})


def _header(
    rows: list[list[str]], first: int, width: int, decimal: str, told: tuple[str, ...]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns."""
    above = [row for row in rows[:first] if any(cell.strip() for cell in row)][-2:]
    above = _without_start([_trimmed(row, width) for row in above], width)
    units = [""] * width
    names: list[str] = []
    if told:
        if len(told) > width:
            raise BenchError(f"{len(told)} names for {counted(width, 'column')}")
        names = [*told, *(f"column {k + 1}" for k in range(len(told), width))]
    elif above and len(above[-1]) == width:
        if len(above) == 2 and len(above[0]) == width and _are_units(above[1]):
            units = [cell if (cell := word.strip().strip("[]()")).lower() not in _COUNTS else "" for word in above[1]]
            above.pop()
        names = [cell.strip() for cell in above[-1]]
        names[0] = names[0].lstrip("#%; ").strip() or names[0]
    split_names = (
        [split(name) if not unit else (name, unit) for name, unit in zip(names, units, strict=True)] if names else []
    )
    pairs = split_names or [(f"column {k + 1}", "") for k in range(width)]
    taken: dict[str, int] = {}
    found = []
    for k, (name, _) in enumerate(pairs):
        name = name or f"column {k + 1}"
        taken[name] = taken.get(name, 0) + 1
        found.append(name if taken[name] == 1 else f"{name} ({taken[name]})")
    return tuple(found), tuple(unit for _, unit in pairs)


def _rate(above: list[list[str]], decimal: str) -> float:
    """Rows a second, told behind, beside or below words such as sample rate or increment; 0 for none."""
    above = [row for row in above if any(cell.strip() for cell in row)]
    for row, below in pairwise([*above, []]):
        for k, cell in enumerate(row):
            if not (told := _RATE.search(cell)):
                continue
            beside = row[k + 1 : k + 3] if row is not above[-1] else []  # the last line may have names
            places = [told[3]] if told[3].strip() else [" ".join(beside), *below[k : k + 1]]
            for place in places:
                value = quantity(place.replace(decimal, "."), Unit.HZ if told[1] else Unit.S, told[2] or "")
                if value and 0.0 < value < math.inf:
                    return value if told[1] else 1.0 / value
    return 0.0


def _trimmed(row: list[str], width: int) -> list[str]:
    """A header without the comment sign before it, and the empty cells behind it."""
    if row and row[0].strip() in ("#", "%", "//") and len(row) == width + 1:
        row = row[1:]
    while len(row) > width and not row[-1].strip():
        row = row[:-1]
    return row


def _without_start(above: list[list[str]], width: int) -> list[list[str]]:
    """The lines above a table without the cells that tell its start and increment, as Rigol's scopes write them."""
    words = [cell.strip().lower() for row in above[:1] for cell in row]
    at = next((k for k, pair in enumerate(pairwise(words)) if pair == ("start", "increment")), None)
    return above if at is None else [[*row[:at], *[""] * width][:width] for row in above]


def _are_units(row: list[str]) -> bool:
    cells = [cell for word in row if (cell := word.strip().strip("[]()")).lower() not in _COUNTS]
    return (
        any(cells) and all(scale_of(cell) is not None for cell in cells) and not any(cell.isdigit() for cell in cells)
    )


def _seems_long(written: Written) -> bool:
    """Whether each row has a time, a name and a value."""
    if len(written.names) != 3 or sorted(written.types) not in (
        ["number", "number", "text"],
        ["date", "number", "text"],
    ):
        return False
    names = [row[written.types.index("text")] for row in written.rows]
    return 2 * len(set(names)) <= len(names)


def _roles(written: Written) -> tuple[str, str, str]:
    """Columns of the time, the name and the value."""
    texts = [name for name, kind in zip(written.names, written.types, strict=True) if kind == "text"]
    others = [name for name, kind in zip(written.names, written.types, strict=True) if kind != "text"]
    if len(texts) != 1 or len(others) != 2:
        raise BenchError("a long table has three columns: time, name, value")
    kinds = dict(zip(written.names, written.types, strict=True))
    time = time_column(tuple(Column(name) for name in others), kinds) or others[0]
    return time, texts[0], next(name for name in others if name != time)


def _dated(column: Column, time: str | None, written: Written) -> Column:
    """Dates are in ns; and some names tell the unit of the time."""
    kind = written.types[written.names.index(column.name)]
    if kind in ("date", "zoned date", "clock"):
        return replace(column, unit="ns")
    if column.name == time and not column.unit:
        found = re.search(r"(?:^|_)(ms|us|ns|s)(?:_|$)", column.name)
        return replace(column, unit=found[1]) if found else column
    return column


def _even_column(written: Written, usable: list[str]) -> str | None:
    """Of a text without a header the one column that grows evenly, but for one that counts rows."""
    if not written.names[0].startswith("column 1"):
        return None
    even = []
    for k, name in enumerate(written.names):
        cells = [row[k].strip() for row in written.rows]
        if name in usable and all(_cell_kind(cell, written.decimal) in ("number", "digits") for cell in cells):
            values = np.array([float(cell.replace(written.decimal, ".")) for cell in cells])
            steps = np.diff(values) if np.isfinite(values).all() else np.empty(0)
            if len(steps) > 2 and steps.min() > 0.0 and np.ptp(steps) < 0.1 * steps.mean() and steps.mean() != 1.0:
                even.append(name)
    return even[0] if len(even) == 1 else None


def _counts_rows(written: Written, name: str) -> bool:
    """Whether a column without a unit goes up by 1 from row to row."""
    k = written.names.index(name)
    cells = [row[k].strip().replace(written.decimal, ".") for row in written.rows]
    whole = all(_cell_kind(cell, ".") in ("number", "digits") and float(cell).is_integer() for cell in cells)
    return not written.units[k] and whole and all(float(b) - float(a) == 1.0 for a, b in pairwise(cells))


def _are_changes(written: Written, time: str) -> bool:
    """Whether rows are changes of lines that are 0 or 1, as logic analysers export them."""
    at = written.names.index(time)
    rows = [[cell.strip() for k, cell in enumerate(row) if k != at] for row in written.rows]
    if len(rows) < 3 or not rows[0] or any(cell not in ("0", "1") for row in rows for cell in row):
        return False
    changed = sum(a != b for a, b in pairwise(rows))
    return changed >= len(rows) - 1 - max(1, len(rows) // 20)


def array_of(column: Any) -> Any:
    """A column of pyarrow as numbers; what is missing is NaN, or 0 with a mask where it is a whole number."""
    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_time(kind):
        column = column.cast(pa.int64())
    if pa.types.is_boolean(kind):
        column = column.cast(pa.uint8())
    if column.null_count:
        column = column.cast(pa.float64(), safe=False)
    return column.to_numpy(zero_copy_only=False)
