"""CSV: a file for each table, `NAME [UNIT]` in the header; what the run is stands in a JSON file beside them.

Numbers have as many digits as give the same float64 back. Text is UTF-8; whether an edge is illegal is 0 or 1.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow.csv import CSVWriter

from bench.export.arrow import arrow, schema, table_files
from bench.export.content import Content, beside

ABOUT = "run"


def files(content: Content, out: Path) -> dict[str, Path]:
    """The files, by what they hold."""
    return table_files(content, out) | {ABOUT: beside(out, ABOUT, ".json")}


def write(content: Content, paths: Mapping[str, Path]) -> None:
    """Write them to `paths`, piece by piece. Raises OSError."""
    for table in content.tables:
        columns = schema(table, unit_in_name=True)
        for number, field in enumerate(columns):
            if pa.types.is_boolean(field.type):
                columns = columns.set(number, pa.field(field.name, pa.uint8(), False))
        with pa.OSFile(str(paths[table.name]), "wb") as file, CSVWriter(file, columns) as writer:
            for piece in content.pieces(table):
                numbers = {name: a.astype(np.uint8) if a.dtype == bool else a for name, a in piece.items()}
                writer.write_table(arrow(numbers, columns))
    paths[ABOUT].write_text(json.dumps(content.about(), indent=2) + "\n", encoding="utf-8")
