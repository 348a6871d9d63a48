"""Minima and maxima of every channel over 50 ms, and of every position error: how hours are looked at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from bench.record import layout
from bench.record.info import AnyChannel, RunInfo
from bench.signal.position import position_error
from protocol.streams import SampleChunk

BIN = 0.05  # s of device time
ERROR = "error_deg."  # before the name of an estimate: its error, actual minus estimated, electrical degrees
F32 = NDArray[np.float32]


class Overview:
    """Makes the overview of the drive's samples, as a table with the columns `columns`."""

    def __init__(self, run: RunInfo, channels: Sequence[AnyChannel] | None = None) -> None:
        """`channels`: those that are looked at, without a column for the time; None: all, with it."""
        self._run = run
        self._channels = run.channels if channels is None else tuple(channels)
        self._timed = channels is None
        self._ticks = round(BIN * run.tick_hz)
        time = pa.field("tick", pa.int64(), False, {"unit": "s", "scale": repr(1 / run.tick_hz)})
        fields = [time] if self._timed else []
        for channel in self._channels:
            fields += [layout.channel_field(channel, f"{channel.name}.{end}") for end in ("min", "max")]
        about = {"unit": "deg", "scale": "1.0", "offset": "0.0"}
        names = {channel.name for channel in self._channels}
        estimates = run.position_estimates if run.position_reference else ()
        self._estimates = [name for name in estimates if name in names]
        for name in self._estimates:
            fields += [pa.field(f"{ERROR}{name}.{end}", pa.float32(), False, about) for end in ("min", "max")]
        self.columns = layout.columns_of(fields, {"run": run.to_json(), "bin_s": BIN})

    def table(self, chunk: SampleChunk, beside: Sequence[NDArray[np.generic]] = ()) -> pa.Table:
        """Of samples, one or more, whose ticks rise; each bin at its first sample. Floats may be anything.

        `beside`: raw values of the channels that are looked at, (n,) each, where the chunk does not have them.
        """
        raw = {channel.name: values for channel, values in zip(self._channels, beside, strict=False)}
        raw = raw or {channel.name: np.ascontiguousarray(chunk.raw[channel.name]) for channel in self._channels}
        with np.errstate(invalid="ignore", over="ignore"):
            return self._table(chunk, raw)

    def _table(self, chunk: SampleChunk, raw: Mapping[str, NDArray[Any]]) -> pa.Table:
        starts = np.concatenate([[0], np.flatnonzero(np.diff(chunk.tick // self._ticks)) + 1])
        columns: list[NDArray[Any]] = [chunk.tick[starts]] if self._timed else []
        for values in (*raw.values(), *self._errors(chunk, raw)):
            columns += [np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)]
        return layout.table_of(self.columns, columns)

    def _errors(self, chunk: SampleChunk, raw: Mapping[str, NDArray[Any]]) -> Iterator[F32]:
        """Each estimate's error in degrees."""
        reference = self._run.position_reference
        if self._estimates and reference is not None:
            actual = _single(chunk.config.channel(reference), chunk.raw[reference])
            channels = {channel.name: channel for channel in self._channels}
            for name in self._estimates:
                yield position_error(actual, _single(channels[name], raw[name])) * np.float32(180 / np.pi)


def coarser(table: pa.Table, bins: int) -> pa.Table:
    """An overview with `bins` bins as one; the last may be of fewer."""
    if bins <= 1 or not table.num_rows:
        return table
    starts = np.arange(0, table.num_rows, bins)
    columns: list[NDArray[Any]] = []
    for name in table.column_names:
        values = layout.numbers(table.column(name))
        of = {"min": np.minimum, "max": np.maximum}.get(name.rpartition(".")[2])
        columns.append(values[starts] if of is None else of.reduceat(values, starts))
    return pa.table([pa.array(column) for column in columns], schema=table.schema)


def _single(channel: AnyChannel, raw: NDArray[Any]) -> F32:
    """Raw values of a channel in its unit, as a picture needs them."""
    values: F32 = np.multiply(raw, np.float32(channel.scale), dtype=np.float32)
    return values + np.float32(channel.offset)
