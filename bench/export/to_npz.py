"""NumPy's .npz: an array for each column, `samples/i_q`; JSON as text under `about` and `units`; nothing pickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.export.content import Content
from bench.export.memory import check_memory, whole


def files(content: Content, out: Path) -> dict[str, Path]:
    """The one file. Raises BenchError where it does not fit into memory."""
    check_memory(content)
    return {"all": out}


def write(content: Content, paths: Mapping[str, Path]) -> None:
    """Write it to `paths`. Raises OSError."""
    found: dict[str, Any] = {}
    units: dict[str, str] = {}
    for table in content.tables:
        for column, values in zip(table.columns, whole(content, table).values(), strict=True):
            name = f"{table.name}/{column.name}"
            found[name] = values.astype(str) if column.dtype == object else values
            units[name] = column.unit
    found |= {"units": np.array(json.dumps(units)), "about": np.array(json.dumps(content.about()))}
    with paths["all"].open("wb") as file:
        np.savez(file, **found)
