"""Tables whole in memory, for formats that are written in one go."""

from __future__ import annotations

import numpy as np

from bench.errors import BenchError
from bench.export.content import Arrays, Content, Table
from bench.record.memory import available

WAY_OUT = "export less with --from, --to or --channels, or use --format mdf4 or parquet, which have no such limit"
_SPARE = 1.1  # of memory: what a writer copies while it writes


def check_memory(content: Content) -> None:
    """Raise BenchError where the tables take more memory than there is."""
    needed = sum(content.bytes_at_most(table) for table in content.streams) * _SPARE
    if needed > (free := available()):
        raise BenchError(
            f"{content.run.path}: this format is built in memory and needs {needed / 1e9:.3g} GB where "
            f"{free / 1e9:.3g} GB are available: {WAY_OUT}"
        )


def whole(content: Content, table: Table) -> Arrays:
    """A table in one piece."""
    if table.config is None:
        return next(content.pieces(table))
    room = content.rows_at_most(table)
    arrays: Arrays = {column.name: np.empty(room, column.dtype) for column in table.columns}
    at = 0
    for piece in content.pieces(table):
        n = len(piece["tick"])
        for name, values in piece.items():
            arrays[name][at : at + n] = values
        at += n
    return {name: values[:at] for name, values in arrays.items()}
