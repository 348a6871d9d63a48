"""MDF 4.10, by asammdf: a channel group for each table; integers as they came, with the conversion to their unit.

The master of a group is the time. Where the device has rebooted its time starts again, and so does a group of the same
name. What the run is stands in an attachment, run.json. The file's start is when the device's clock was 0, as far as
the host's clock tells: a second or so.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import BenchError
from bench.export.content import Arrays, Column, Content, Table
from bench.record.reader import Run

VERSION = "4.10"
UNKNOWN = datetime.fromtimestamp(0, UTC)
"""The least that MDF has, which nobody takes for a date; asammdf would write the present."""


def files(content: Content, out: Path) -> dict[str, Path]:
    """The one file. Raises BenchError where asammdf is not installed."""
    _asammdf()
    return {"all": out}


def write(content: Content, paths: Mapping[str, Path]) -> None:
    """Write it to `paths`, piece by piece; as much again is taken beside it meanwhile. Raises OSError."""
    asammdf, path = _asammdf(), paths["all"]
    with closing(asammdf.MDF(version=VERSION, temporary_folder=path.parent)) as mdf:
        for table in content.tables:
            _write_table(mdf, table, _by_boot(content.pieces(table, raw=True)))
        about = content.about()
        mdf.attach(json.dumps(about, indent=2).encode(), file_name="run.json", mime="application/json",
                   comment="what was recorded")  # fmt: skip
        mdf.header.start_time = _start(content.run)
        mdf.header.comment = f"{about['run']}, exported by {about['exported_by']}"
        with path.open("wb+") as file:
            mdf.save(file)


def _asammdf() -> Any:
    try:
        import asammdf
    except ImportError:
        raise BenchError("--format mdf4 needs asammdf: pip install 'hallbench[export]'") from None
    return asammdf


def notes(content: Content) -> list[str]:
    """What the start time is where nobody knows it."""
    if _start(content.run) != UNKNOWN:
        return []
    return [f"when it was recorded is unknown: the start time of the file is {UNKNOWN:%Y-%m-%d}"]


def _start(run: Run) -> datetime:
    """When the device's clock was 0; `UNKNOWN` where no date was recorded, or none that MDF can hold."""
    try:
        start = datetime.fromisoformat(run.info.started) - timedelta(seconds=_began(run) / run.info.tick_hz)
        return max(start, UNKNOWN)
    except (ValueError, TypeError, OverflowError):  # a capture does not tell
        return UNKNOWN


def _began(run: Run) -> int:
    """Tick of the first that the log tells of, which is about when the run was started; of a ring its begin is gone."""
    ticks = (record.get("tick", 0) for record in run.records(()))
    return next((tick for tick in ticks if tick), run.span[0])


def _by_boot(pieces: Iterator[Arrays]) -> Iterator[tuple[bool, Arrays]]:
    """Pieces of a table, and whether each begins a new group: the first, and one whose time goes back."""
    last = None
    for piece in pieces:
        if "kind" in piece:  # marks come as they were set
            order = np.argsort(piece["tick"], kind="stable")
            piece = {name: values[order] for name, values in piece.items()}
        ticks = piece["tick"]
        first = int(ticks[0]) if len(ticks) else 0
        yield last is None or first < last, piece
        last = int(ticks[-1]) if len(ticks) else 0


def _write_table(mdf: Any, table: Table, pieces: Iterator[tuple[bool, Arrays]]) -> None:
    signal = _asammdf().Signal
    for new, piece in pieces:
        values = [_stored(piece[column.name]) for column in table.columns]
        if not new:
            mdf.extend(len(mdf.groups) - 1, [(array, None) for array in values])
            continue
        signals = [
            signal(
                array, values[0], unit=column.unit, name=column.name, conversion=_conversion(column, array),
                encoding="utf-8" if array.dtype.kind == "S" else None,
            )
            for column, array in zip(table.columns[1:], values[1:], strict=True)
        ]  # fmt: skip
        mdf.append(signals, acq_name=table.name, comment=table.name, common_timebase=True)


def _stored(values: Any) -> Any:
    """An array as MDF has it: a bool as a number, text as UTF-8."""
    if values.dtype == object:
        return np.array([text.encode() for text in values] or np.empty(0, "S1"))
    return values.view(np.uint8) if values.dtype == bool else values


def _conversion(column: Column, values: Any) -> dict[str, float] | None:
    channel = column.channel
    if channel is None or values.dtype.kind == "f" or (channel.scale, channel.offset) == (1, 0):
        return None
    return {"a": channel.scale, "b": channel.offset}
