"""Arrays in memory, made a capture by the same way as a file: see `bench.capture`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bench.errors import BenchError
from bench.importer import importer
from bench.importer.guess import complete
from bench.importer.mapping import mapping_of
from bench.importer.source import Arrays, Column, Memory, Table
from bench.signal.capture import Capture

EDGES = "edges"


def capture(
    time: Any, values: Mapping[str, Any], edges: Any, units: Mapping[str, str], n_p: int | None
) -> Capture:  # fmt: skip
    """See `bench.capture`."""
    arrays = {name: _array(name, column) for name, column in values.items()}
    columns: Arrays = dict(arrays)
    rate, timed = 0.0, None
    if np.ndim(time) == 0:
        rate = float(time)
        if not 0.0 < rate < 1e9:
            raise BenchError(f"time: {time!r} is no rate: give an array in s, or samples a second")
    else:
        columns["time"], timed = _array("time", time), "time"
    if len({len(column) for column in columns.values()}) > 1:
        raise BenchError(f"columns differ in length: {', '.join(f'{n}: {len(c)}' for n, c in columns.items())}")
    tables, contents = [], {}
    if arrays:
        named = tuple(Column(name, "s" if name == timed else units.get(name, "")) for name in columns)
        tables.append(Table("", named, timed, rate))
        contents[""] = columns
    plain: dict[str, Any] = {"motor": {} if n_p is None else {"n_p": n_p}}
    if edges is not None:
        at, codes = (_array(EDGES, one) for one in edges)
        if len(at) != len(codes):
            raise BenchError(f"edges: {len(at)} times and {len(codes)} codes: give the code from each time on")
        contents[EDGES] = {"time": at, "code": codes}
        tables.append(Table(EDGES, (Column("time", "s"), Column("code")), "time", held=True))
        plain["hall"] = {"column": f"{EDGES}/code"}
        if rate and not arrays:
            plain["time"] = {"rate_hz": rate}
    source = Memory(contents, tuple(tables))
    guess = complete(source, mapping_of(plain, "capture"))
    return importer.capture_of(importer.prepare(source, guess.mapping, guess.guessed))


def _array(name: str, values: Any) -> Any:
    try:
        found = np.asarray(values)
    except ValueError as error:
        raise BenchError(f"{name}: {error}") from None
    if found.ndim != 1 or found.dtype.kind not in "iufbmM":
        raise BenchError(f"{name}: one number a sample is needed, got {found.dtype} of shape {found.shape}")
    return found
