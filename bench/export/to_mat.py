"""MATLAB's .mat, version 5: a struct for each table, `samples.i_q`; `units` of the same shape; `about` is JSON.

A name that MATLAB does not take as a field's has _ for what it does not take; `about` lists these.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bench.errors import BenchError
from bench.export.content import Content, Table
from bench.export.memory import WAY_OUT, check_memory, whole

MOST_BYTES = (1 << 31) - 1  # of a variable, a struct with all in it
MOST_CHARACTERS = 63  # of a name
_HEADERS = 1 << 16  # bytes of a struct beside its values


def files(content: Content, out: Path) -> dict[str, Path]:
    """The one file. Raises BenchError where a table is more than the format or the memory holds."""
    for table in content.streams:
        size = content.bytes_at_most(table) + _HEADERS
        if size > MOST_BYTES:
            raise BenchError(
                f"{content.run.path}: {table.name} would take {size / 1e9:.3g} GB, and a variable in a .mat file at "
                f"most {MOST_BYTES / 1e9:.3g} GB: {WAY_OUT}"
            )
        _fields(table)
    check_memory(content)
    return {"all": out}


def write(content: Content, paths: Mapping[str, Path]) -> None:
    """Write it to `paths`. Raises OSError."""
    from scipy.io import savemat

    found: dict[str, Any] = {}
    units: dict[str, Any] = {}
    for table, struct in zip(content.tables, _structs(content).values(), strict=True):
        names = _fields(table)
        found[struct] = {names[name]: values for name, values in whole(content, table).items()}
        units[struct] = {names[column.name]: column.unit for column in table.columns}
    found |= {"units": units, "about": json.dumps({**content.about(), "renamed": _renamed(content)})}
    with paths["all"].open("wb") as file:
        savemat(file, found, long_field_names=True, oned_as="column")


def fields(names: Iterable[str]) -> dict[str, str]:
    """Names that MATLAB takes for fields, by name. Raises BenchError for one that is too long."""
    made: dict[str, str] = {}
    for name in names:
        word = re.sub(r"[^A-Za-z0-9_]", "_", name)
        word = word if word[:1].isalpha() else f"x{word}"
        while word in made.values():
            word += "_"
        if len(word) > MOST_CHARACTERS:
            raise BenchError(f"a name in a .mat file has at most {MOST_CHARACTERS} characters, '{name}' has more: "
                             "omit it with --channels, or choose another --format")  # fmt: skip
        made[name] = word
    return made


def notes(content: Content) -> list[str]:
    """Which names MATLAB does not take."""
    return [f"{name} holds the channel {channel}" for name, channel in _renamed(content).items()]


def _structs(content: Content) -> dict[str, str]:
    return fields(table.name for table in content.tables)


def _fields(table: Table) -> dict[str, str]:
    return fields(column.name for column in table.columns)


def _renamed(content: Content) -> dict[str, str]:
    """By struct and field: the name of the channel that has another there."""
    structs = _structs(content)
    pairs = ((structs[table.name], old, new) for table in content.tables for old, new in _fields(table).items())
    return {f"{struct}.{new}": old for struct, old, new in pairs if new != old}
