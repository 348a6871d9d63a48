"""The tables of a run as Arrow tables, for formats that hold one table in a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa

from bench.export.content import MARKS, Arrays, Column, Content, Table, beside
from bench.record.layout import SAMPLES


def table_files(content: Content, out: Path) -> dict[str, Path]:
    """By table: the file that it goes to. The drive's samples go to `out`, or the first stream where there are none."""
    names = [table.name for table in content.streams]
    main = SAMPLES if SAMPLES in names else names[0]
    return {name: out if name == main else beside(out, name) for name in (*names, MARKS)}


def schema(table: Table, unit_in_name: bool = False) -> pa.Schema:
    """The schema of a table: the unit in the metadata of each field, or behind its name, as `i_q [A]`."""
    return pa.schema([_field(column, unit_in_name) for column in table.columns])


def arrow(arrays: Arrays, columns: pa.Schema) -> pa.Table:
    """Rows of a table, in the order of its columns."""
    return pa.table([pa.array(array, field.type) for array, field in zip(arrays.values(), columns, strict=True)],
                    schema=columns)  # fmt: skip


def _field(column: Column, unit_in_name: bool) -> pa.Field:
    kind: Any = pa.string() if column.dtype == object else pa.from_numpy_dtype(column.dtype)
    if unit_in_name:
        return pa.field(f"{column.name} [{column.unit}]" if column.unit else column.name, kind, False)
    return pa.field(column.name, kind, False, {"unit": column.unit})
