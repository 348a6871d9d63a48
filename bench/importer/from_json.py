"""JSON lines: an object a line, numbers by their path such as `servo.position`; by pyarrow, a part at a time."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import json as arrow_json

from bench.errors import BenchError
from bench.importer.files import HEAD, head, reading, stream
from bench.importer.from_csv import array_of
from bench.importer.source import Batch, Column, Table, Wanted, time_column
from bench.importer.units import split
from protocol.text import printable

BLOCK = 1 << 22
MOST_LINE = 1 << 20
MOST_COLUMNS = 5000


class JsonLines:
    """One table; keys that a line lacks are missing there. Raises BenchError."""

    format = "json"
    together = True

    def __init__(self, path: Path) -> None:
        self._path = path
        data = head(path)
        whole = data if len(data) < HEAD else data[: data.rfind(b"\n") + 1]
        if not whole.strip():
            raise BenchError(f"{path} has no lines of JSON" if data.strip() else f"{path} is empty")
        first = self._flat(whole, 0)
        split_names = {key: split(key) for key, values in first.items() if values is not None}
        self._keys = {name: key for key, (name, _) in split_names.items()}
        self.left_out = [f"{printable(name)}: no number" for name, values in first.items() if values is None]
        if len(first) > MOST_COLUMNS or not self._keys:
            raise BenchError(f"{path}: {len(self._keys)} keys have numbers")
        columns = tuple(Column(name, split_names[key][1]) for name, key in self._keys.items())
        self.tables = (Table("", columns, time_column(columns)),)
        self.about: Mapping[str, Any] = {}

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `Source`."""
        row, rest = 0, b""
        with reading(self._path, "file of JSON lines"), stream(self._path) as file:
            while block := file.read(BLOCK):
                block = rest + block
                end = block.rfind(b"\n") + 1
                block, rest = block[:end], block[end:]
                if len(rest) > MOST_LINE:
                    raise BenchError(f"{self._path}: a line is longer than {MOST_LINE >> 20} MiB")
                yield from self._of(block, row, wanted)
                row += block.count(b"\n")
            yield from self._of(rest, row, wanted)

    def _of(self, block: bytes, row: int, wanted: Wanted) -> Iterator[Batch]:
        if block.strip():
            flat = self._flat(block, row)
            n = max((len(values) for values in flat.values() if values is not None), default=0)
            of = ((table, name, flat.get(self._keys[name])) for table, names in wanted.items() for name in names)
            found: Batch = {}
            for table, name, values in of:
                found.setdefault(table, {})[name] = np.full(n, np.nan) if values is None else values
            yield found

    def _flat(self, block: bytes, row: int) -> dict[str, Any]:
        """Columns by path; None for what has no numbers."""
        try:
            table = arrow_json.read_json(io.BytesIO(block), arrow_json.ReadOptions(block_size=len(block) + 64))
            while any(pa.types.is_struct(field.type) for field in table.schema):
                table = table.flatten()
            return {name: _numbers(column) for name, column in zip(table.column_names, table.columns, strict=True)}
        except (pa.ArrowException, ValueError, RecursionError) as error:
            lines = f"lines {row + 1} to {row + block.count(10) + 1}"
            why = printable(str(error))[:150]
            raise BenchError(f"{self._path}: {lines} are no lines of JSON objects: {why}") from None

    def line(self, table: str, row: int) -> str:
        """See `Source`."""
        return f"in line {row + 1}"


def _numbers(column: Any) -> Any:
    """A column's numbers; None where it has others."""
    types, kind = pa.types, column.type
    usable = types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind) or types.is_timestamp(kind)
    return array_of(column.combine_chunks()) if usable else None
