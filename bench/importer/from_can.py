"""Logs of a CAN bus (candump, ASC, BLF, TRC) by python-can, their signals by a DBC with cantools.

A message is a table; of one that is multiplexed each signal. Values are kept in memory, 8 bytes each.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import BenchError
from bench.importer.files import reading, told_by
from bench.importer.source import Column, Memory, Table
from protocol.text import counted, printable

_ENDLESS = re.compile(rb"LOBJ.{4}\0{4}", re.DOTALL)
"""An object of a BLF that says that it has no bytes."""
ENDINGS = {"asc": ".asc", "blf": ".blf", "candump": ".log", "trc": ".trc"}


class _Signals:
    """Values of messages as they come."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}
        self.values: dict[str, dict[str, list[float]]] = {}
        self.units: dict[str, dict[str, str]] = {}

    def add(self, table: str, time: float, found: dict[str, float], units: dict[str, str]) -> None:
        """A message's."""
        if table not in self.times:
            self.times[table], self.values[table] = [], {name: [] for name in found}
            self.units[table] = units
        self.times[table].append(time)
        for name, column in self.values[table].items():
            column.append(found.get(name, np.nan))


def log(path: Path, format: str, dbc: Path | None) -> Memory:
    """What the DBC knows of a log. Raises BenchError."""
    import can
    import cantools

    if dbc is None:
        raise BenchError(f"{path}: a CAN log needs a DBC that names its signals: --dbc FILE")
    with reading(dbc, "DBC", cantools.Error, ValueError, KeyError, AttributeError, RecursionError, TypeError):
        database: Any = cantools.database.load_file(dbc)

    class Blf(can.BLFReader):
        """Of an object of no bytes python-can would look for the next one for ever."""

        def _parse_data(self, data: bytes) -> Iterator[can.Message]:
            if _ENDLESS.search(data):
                raise ValueError("an object has no bytes")
            return super()._parse_data(data)

    readers: dict[str, Any] = {
        "asc": can.ASCReader, "blf": Blf, "candump": can.CanutilsLogReader, "trc": can.TRCReader,
    }  # fmt: skip
    by_id = {(m.frame_id, m.is_extended_frame): m for m in getattr(database, "messages", ())}
    signals, unknown, wrong = _Signals(), Counter[int](), Counter[str]()
    logged: list[str] = []
    with reading(path, f"{format} log", Exception), told_by("can", logged), readers[format](path) as reader:
        for frame in reader:
            if frame.is_error_frame or frame.is_remote_frame:
                continue
            message = by_id.get((frame.arbitration_id, frame.is_extended_id))
            if message is None:
                unknown[frame.arbitration_id] += 1
                continue
            try:
                decoded = message.decode(bytes(frame.data), decode_choices=False)
            except (cantools.Error, ValueError, KeyError, struct.error, OverflowError):
                wrong[message.name] += 1
                continue
            _take(signals, message, frame.timestamp, decoded)
    return _tables(path, format, signals, unknown, wrong, logged)


def _take(signals: _Signals, message: Any, time: float, decoded: Any) -> None:
    units = {signal.name: signal.unit or "" for signal in message.signals}
    found = {name: float(value) for name, value in decoded.items() if isinstance(value, int | float)}
    if message.is_multiplexed():
        for name, value in found.items():
            signals.add(f"{message.name}.{name}", time, {name: value}, {name: units[name]})
    elif found:
        signals.add(message.name, time, found, units)


def _tables(
    path: Path, format: str, signals: _Signals, unknown: Counter[int], wrong: Counter[str], logged: list[str]
) -> Memory:
    left_out = [*logged, *(f"{n} frames of {name} do not fit the DBC" for name, n in wrong.items())]
    if unknown:
        ids = ", ".join(f"0x{number:x}" for number in list(unknown)[:5])
        left_out.append(f"{unknown.total()} frames of {counted(len(unknown), 'identifier')} the DBC has not ({ids})")
    kept = {name: times for name, times in signals.times.items() if len(times) > 1}
    left_out += [f"{printable(name)}: came once" for name in signals.times if name not in kept]
    if not kept:
        raise BenchError(f"{path} has no signal of the DBC: {'; '.join(left_out) or 'it has no frames'}")
    contents, tables = {}, []
    for name, times in kept.items():
        order = np.argsort(times, kind="stable")
        contents[name] = {"time": np.array(times)[order]}
        contents[name] |= {column: np.array(values)[order] for column, values in signals.values[name].items()}
        columns = tuple(Column(column, signals.units[name][column]) for column in signals.values[name])
        tables.append(Table(name, (Column("time", "s"), *columns), "time"))
    return Memory(contents, tuple(tables), format, {}, left_out=left_out)
