"""What is exported of a run: its streams as tables in SI units, what was said meanwhile, and what the run is.

A table of samples or edges has `time` (s of device time, float64), `tick` (the device's clock) and `index`, the values,
and what is missing before a row: `gap`, `lost`, `lost_frames`, as `bench.record.layout` has them. The table `marks`
is the run's log: a row for each mark, event, note, parameter that was set, heartbeat that told anything new, and count
of records that are missing at the end.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.record import layout
from bench.record.info import AnyChannel, stream_to_json
from bench.record.reader import Run
from bench.record.times import ticks_of
from bench.signal.chunks import BEGIN, END, no_edges
from bench.signal.versions import PROGRAM
from protocol import __version__
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig
from protocol.text import did_you_mean

MARKS = "marks"
Arrays = dict[str, NDArray[Any]]
"""The columns of a table by name, (rows,) each."""

_SAID = ("mark", "event", "note", "parameter", "heartbeat", "missing", "misdated")


@dataclass(frozen=True)
class Column:
    """A column: `unit` is empty for a pure number, `dtype` object for text."""

    name: str
    unit: str
    dtype: np.dtype[Any]
    channel: AnyChannel | None = None
    """What it holds: raw * scale + offset of this channel; None: it is no channel."""


@dataclass(frozen=True)
class Table:
    """A stream, or the table `marks`, which has no `config`."""

    name: str
    columns: tuple[Column, ...]
    config: StreamConfig | None = None


def _columns(*described: tuple[str, str, type]) -> tuple[Column, ...]:
    return tuple(Column(name, unit, np.dtype(kind)) for name, unit, kind in described)


_BEFORE = _columns(("time", "s", np.float64), ("tick", "", np.int64), ("index", "", np.int64))
_EDGE = _columns(*((name, "", kind) for name, kind in layout.EDGE_FIELDS.items()))
_GAP = _columns(*((name, "", kind) for name, kind in layout.GAP_FIELDS.items()))
_MARKS = Table(
    MARKS,
    _columns(
        ("time", "s", np.float64), ("tick", "", np.int64), ("until", "s", np.float64), ("until_tick", "", np.int64),
        ("kind", "", object), ("node", "", np.int64), ("name", "", object), ("value", "", np.float64),
        ("detail", "", np.float64), ("text", "", object),
    ),
)  # fmt: skip
_RESERVED = {column.name for column in (*_BEFORE, *_GAP)}


class Content:
    """The part of a run from `begin` to `end`, s of device time; None is its begin, or its end.

    `channels`: those that are wanted; None: all. Raises BenchError for a part that holds nothing, and for names that
    no stream has.
    """

    def __init__(
        self, run: Run, begin: float | None = None, end: float | None = None, channels: Sequence[str] | None = None
    ) -> None:
        self.run = run
        self.first, self.last = ticks_of(run, begin, end)
        self._part = (BEGIN, END) if begin is None and end is None else (self.first, self.last)
        hz = run.info.tick_hz
        self.said = (BEGIN if begin is None else round(begin * hz), END if end is None else round(end * hz))
        """First and last tick of what was said that belongs to it: it may lie before the samples, or after them."""
        _check_names(run, channels)
        names = sorted(run.names, key=lambda name: name != layout.SAMPLES)  # those first, the others as they began
        made = [_table(name, run.config(name), channels) for name in names]
        self.streams = tuple(table for table in made if table is not None)
        self.rows: dict[str, int] = {}
        """By table: the rows that have been handed out."""
        if all(next(run.pieces(table.name, *self._part), None) is None for table in self.streams):
            why = "; ".join(run.damage) or "records are missing there"
            raise BenchError(f"{run.path} has no data from {run.at(self.first)} to {run.at(self.last)}: {why}")

    @property
    def tables(self) -> tuple[Table, ...]:
        """All of them; `marks` is the last."""
        return (*self.streams, _MARKS)

    def pieces(self, table: Table, raw: bool = False) -> Iterator[Arrays]:
        """A table's rows in order, ten seconds or less at a time, one piece or more; `marks` in one.

        Channels are in their units, float64; with `raw`, those that came as integers are as they came.
        """
        self.rows[table.name] = 0
        if table.config is None:
            marks = self._marks()
            self.rows[table.name] = len(marks["tick"])
            yield marks
            return
        for chunk in self.run.pieces(table.name, *self._part):
            self.rows[table.name] += len(chunk)
            yield _arrays(table, chunk, raw)
        if not self.rows[table.name]:
            yield _arrays(table, _no_rows(table.config), raw)

    def rows_at_most(self, table: Table) -> int:
        """Rows of a stream, or some more."""
        return self.run.rows(table.name, *self._part)

    def bytes_at_most(self, table: Table) -> int:
        """Bytes that a stream's columns take in memory."""
        return self.rows_at_most(table) * sum(column.dtype.itemsize for column in table.columns)

    def about(self) -> dict[str, Any]:
        """What the run is, and how its streams came, as plain JSON; `damage` is complete when all has been read.

        Numbers that JSON has not are strings: "nan", "inf".
        """
        run = self.run
        told = {
            "run": run.path.name,
            "id": run.info.recording_id,
            **run.info.to_json(),
            "first_tick": self.first,
            "last_tick": self.last,
            "streams": [stream_to_json(table.config, table.name) for table in self.streams if table.config is not None],
            "ended": run.ended,
            "lost": run.lost,
            "summary": run.summary,
            "damage": list(run.damage),
            "exported_by": f"{PROGRAM} {__version__}",
        }
        record = layout.record_of(layout.line_of(told).rstrip("\n"))  # as the log has such numbers
        assert record is not None
        return record

    def _marks(self) -> Arrays:
        """The rows of the table `marks`, as the log has them."""
        first, last = self.said
        rows = [
            row
            for record in self.run.records(())
            if record["kind"] in _SAID
            for row in _rows(record)
            if row["tick"] <= last and (row["until_tick"] >= first or row["kind"] == "parameter")
        ]
        hz = self.run.info.tick_hz
        ends = {"time": "tick", "until": "until_tick"}
        return {
            column.name: np.array([row[name] for row in rows], np.int64) / hz
            if (name := ends.get(column.name))
            else np.array([row[column.name] for row in rows], column.dtype)
            for column in _MARKS.columns
        }


def beside(path: Path, name: str, ending: str | None = None) -> Path:
    """The file that holds a table which has no room in `path`: `a-edges.csv` beside `a.csv`."""
    return path.with_name(f"{path.stem}-{name}{path.suffix if ending is None else ending}")


def _check_names(run: Run, channels: Sequence[str] | None) -> None:
    known = list(dict.fromkeys(channel.name for name in run.names for channel in run.config(name).channels))
    for name in channels or ():
        if name not in known:
            hint = did_you_mean(name, known, f"there are: {', '.join(known)}")
            raise BenchError(f"{run.path} has no channel '{name}'; {hint}")


def _table(name: str, config: StreamConfig, channels: Sequence[str] | None) -> Table | None:
    """A stream's table; None where none of its channels is wanted."""
    if not config.channels:
        return Table(name, (*_BEFORE, *_EDGE, *_GAP), config)
    wanted = [channel for channel in config.channels if channels is None or channel.name in channels]
    kind = np.dtype(np.float64)
    values = [Column(_free(channel.name), channel.unit.symbol, kind, channel) for channel in wanted]
    return Table(name, (*_BEFORE, *values, *_GAP), config) if wanted else None


def _free(name: str) -> str:
    """A channel's name, where that is no other column's."""
    return f"{name}_" if name in _RESERVED else name


def _no_rows(config: StreamConfig) -> SampleChunk | EdgeChunk:
    none = np.empty(0, np.int64)
    return SampleChunk(config, none, none, np.empty(0, config.dtype), ()) if config.channels else no_edges(config)


def _arrays(table: Table, chunk: SampleChunk | EdgeChunk, raw: bool) -> Arrays:
    found: Arrays = {"time": chunk.tick / chunk.config.tick_hz, "tick": chunk.tick, "index": chunk.index}
    if isinstance(chunk, SampleChunk):
        for column in table.columns:
            if column.channel is not None:
                name = column.channel.name
                as_it_came = raw and chunk.raw[name].dtype.kind in "iu"
                found[column.name] = np.ascontiguousarray(chunk.raw[name]) if as_it_came else chunk.physical(name)
    else:
        found |= {name: getattr(chunk, name) for name in layout.EDGE_FIELDS}
    return found | layout.gap_columns(chunk)


def _rows(record: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """A record of the log as rows of the table `marks`: one, or two for what is missing."""
    tick, node = record["tick"], record.get("node", record.get("from", 0))
    row = {
        "tick": tick, "until_tick": record.get("last", tick), "kind": record["kind"], "node": node, "name": "",
        "value": np.nan, "detail": np.nan, "text": "",
    }  # fmt: skip
    match record["kind"]:
        case "mark":
            yield row | {"name": record["name"], "text": record["verdict"] or ""}
        case "event":
            yield row | {"name": record["name"], "value": float(record["arg"]), "detail": float(record["detail"])}
        case "misdated":
            yield row | {"text": record["text"]}
        case "note":
            yield row | {"name": record["level"], "text": record["text"]}
        case "parameter":
            yield row | {"name": record["name"], "value": float(record["value"])}
        case "heartbeat":
            told = {name: value for name, value in record.items() if name not in ("kind", "tick", "from")}
            yield row | {"text": json.dumps(told)}
        case "missing":
            for name in ("samples", "edges"):
                yield row | {"name": name, "value": float(record[name])}
