"""Parquet in SI units: a file for each table; the unit in each field's metadata, what the run is in the file's.

A run itself is Parquet already, with the raw integers (`bench.record.layout`): this is for readers that would rather
not multiply.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

from pyarrow.parquet import ParquetWriter

from bench.export.arrow import arrow, schema, table_files
from bench.export.content import Content

ABOUT = "hallbench"
"""Key of the file's metadata."""


def files(content: Content, out: Path) -> dict[str, Path]:
    """The files, by what they hold."""
    return table_files(content, out)


def write(content: Content, paths: Mapping[str, Path]) -> None:
    """Write them to `paths`, piece by piece. Raises OSError."""
    with ExitStack() as opened:
        writers = []
        for table in content.tables:
            columns = schema(table)
            writer = opened.enter_context(ParquetWriter(paths[table.name], columns, compression="zstd"))
            for piece in content.pieces(table):
                writer.write_table(arrow(piece, columns))
            writers.append(writer)
        told = json.dumps(content.about())  # what was damaged is known by now
        for writer in writers:
            writer.add_key_value_metadata({ABOUT: told})
