"""Reads a recorded run back: every sample and every edge as it came over the wire, exactly.

Also reads files that were cut short (kill -9, disk full, still being written): everything up to the cut. Never writes.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from bench.analysis.capture import Capture
from bench.analysis.chunks import lost_stretches, no_edge_stream, no_edges
from bench.analysis.verdict import Verdict
from bench.errors import BenchError
from bench.rerunio import schema
from bench.rerunio.salvage import readable
from protocol.messages import DeviceEvent, StreamEvent
from protocol.streams import EdgeChunk, Gap, SampleChunk, StreamConfig

I64 = NDArray[np.int64]
SLICE = 1 << 14  # rows that are converted at a time: they stay in the processor's cache
_TO_LOOK_AT = (schema.TREND, schema.DRIVE, schema.HALL_LANES, schema.HEALTH, "stator")
_NOT_READ = [f"/{entity}/**" for entity in _TO_LOOK_AT]  # only to look at


class NotARecordingError(BenchError):
    """A file that is no recording of a run, or of a newer version than this program reads."""


@dataclass(frozen=True)
class Run:
    """A recorded run. `streams` and `edge_streams` by entity; `summary` is markdown."""

    path: Path
    info: schema.RunInfo
    streams: dict[str, SampleChunk]
    edge_streams: dict[str, EdgeChunk]
    events: tuple[DeviceEvent, ...]
    notes: tuple[tuple[int, str], ...]
    """Device tick and text of the log's lines, those of `marks` among them."""
    levels: tuple[str, ...]
    """Of the notes: INFO, WARN, ERROR."""
    summary: str
    marks: tuple[schema.Mark, ...]
    """Stretches that an acceptance run marked, in the order in which it did."""

    @property
    def samples(self) -> SampleChunk:
        """The drive's samples. KeyError if none were recorded."""
        return self.streams[schema.FAST]

    @property
    def edges(self) -> EdgeChunk:
        """The drive's Hall edges. KeyError if none were recorded."""
        return self.edge_streams[schema.HALL]


def read_run(path: str | Path) -> Run:
    """Read a recording. Raises NotARecordingError if `path` is not one."""
    path = Path(path)
    recording_id, tables = _tables(path)
    meta = tables.get(f"/{schema.META}", [])
    if not meta:
        raise NotARecordingError(f"{path} holds no run: it was cut before its first second, or it is not of this bench")
    described = json.loads(_last_text(meta, schema.RUN_JSON))
    if described["schema"] > schema.SCHEMA:
        raise NotARecordingError(
            f"{path} was written by a newer version (schema {described['schema']}, this one reads "
            f"{schema.SCHEMA}): update hallbench"
        )
    info = schema.RunInfo.from_json(described, recording_id)
    streams: dict[str, SampleChunk] = {}
    edge_streams: dict[str, EdgeChunk] = {}
    for name, rows in tables.items():
        if not name.startswith(f"/{schema.STREAMS}/"):
            continue
        data = json.loads(_last_text(rows, schema.STREAM_JSON))
        config, entity = schema.stream_from_json(data, info), data["entity"]
        parts = [part for part in tables.get(f"/{entity}", []) if schema.TIMELINE in part.schema.names]
        if config.event == StreamEvent.EDGES:
            edge_streams[entity] = _edges(config, parts)
        else:
            streams[entity] = _samples(config, parts)
    events, notes, marks, summaries = (
        tables.get(f"/{entity}", []) for entity in (schema.EVENTS, schema.NOTES, schema.ACCEPTANCE, schema.SUMMARY)
    )
    marks = [part for part in marks if schema.MARK_FIELDS[0] in part.schema.names]
    return Run(
        path=path,
        info=info,
        streams=streams,
        edge_streams=edge_streams,
        events=tuple(DeviceEvent(*row) for row in _rows(events, schema.EVENT_FIELDS, (int, int, int, float))),
        notes=tuple(zip(_ticks(notes, info.tick_hz).tolist(), _texts(notes, "TextLog:text"), strict=True)),
        levels=tuple(_texts(notes, "TextLog:level")),
        summary=_last_text(summaries, "TextDocument:text") if summaries else "",
        marks=tuple(schema.Mark(*row) for row in _rows(marks, schema.MARK_FIELDS, (str, int, int, Verdict))),
    )


def capture_of(run: Run) -> Capture:
    """The whole of a recording as a capture. BenchError where it holds no samples of the drive."""
    samples = run.streams.get(schema.FAST)
    if samples is None or not len(samples):
        raise BenchError(f"{run.path} holds no samples: record a run in which the shaft turns")
    info = run.info
    edges = run.edge_streams.get(schema.HALL, no_edges(no_edge_stream(info.node, info.tick_hz, info.pwm_hz)))
    before = int(samples.tick[0])
    lost = (*lost_stretches(samples, before), *lost_stretches(edges, -1))
    return Capture(samples, edges, info.parameters, lost)


def _tables(path: Path) -> tuple[str, dict[str, list[pa.RecordBatch]]]:
    """The recording's id, and its chunks by entity, in the order in which they were written."""
    if not path.is_file():
        raise NotARecordingError(f"{path}: no such file")
    try:
        with readable(path) as whole, warnings.catch_warnings():
            warnings.simplefilter("ignore", rr.error_utils.RerunWarning)  # it warns of a missing footer
            reader = RrdReader(whole)
            ours = [entry for entry in reader.recordings() if entry.application_id == schema.APPLICATION]
            chunks = reader.stream(store=ours[0]).drop(content=_NOT_READ).to_chunks() if ours else []
    except (ValueError, RuntimeError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise NotARecordingError(f"{path} is not a rerun recording: {reason}") from None
    if not ours:
        raise NotARecordingError(f"{path} is a rerun recording, but not of this bench")
    tables: dict[str, list[pa.RecordBatch]] = {}
    for chunk in chunks:
        tables.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return str(ours[0].recording_id), tables


def _samples(config: StreamConfig, parts: list[pa.RecordBatch]) -> SampleChunk:
    tick = _ticks(parts, config.tick_hz)
    raw = np.empty(len(tick), config.dtype)
    columns = [_column(parts, schema.value_component(c.name), schema.storage(c)) for c in config.channels]
    for start in range(0, len(tick), SLICE):
        rows = slice(start, start + SLICE)
        for channel, values in zip(config.channels, columns, strict=True):
            raw[channel.name][rows] = schema.raw_from_physical(channel, values[rows])
    index = _index(parts, config.decimation)
    return SampleChunk(config, index, tick, raw, _gaps(parts))


def _edges(config: StreamConfig, parts: list[pa.RecordBatch]) -> EdgeChunk:
    fields = {name: _column(parts, f"edge:{name}", dtype) for name, dtype in schema.EDGE_FIELDS.items()}
    return EdgeChunk(config, _ticks(parts, config.tick_hz), index=_index(parts, 1), gaps=_gaps(parts), **fields)


def _ticks(parts: list[pa.RecordBatch], tick_hz: int) -> I64:
    times = [part.column(schema.TIMELINE).cast(pa.int64()).to_numpy() for part in parts]
    return schema.tick_from_ns(np.concatenate([np.empty(0, np.int64), *times]), tick_hz)


def _column(parts: list[pa.RecordBatch], name: str, dtype: Any) -> NDArray[Any]:
    """A component with one value in every row, shape (rows,)."""
    if not parts:
        return np.empty(0, dtype)
    joined = pa.chunked_array([part.column(name) for part in parts]).combine_chunks().flatten()
    values: NDArray[Any] = joined.to_numpy(zero_copy_only=False).astype(dtype, copy=False)
    return values


def _sparse(parts: list[pa.RecordBatch], name: str) -> tuple[I64, I64]:
    """Rows that have a value of a component, and the values."""
    rows, values, start = [np.empty(0, np.int64)], [np.empty(0, np.int64)], 0
    for part in parts:
        if name in part.schema.names:
            column = part.column(name)
            rows.append(start + np.flatnonzero(column.is_valid().to_numpy(zero_copy_only=False)))
            values.append(column.flatten().to_numpy(zero_copy_only=False).astype(np.int64))
        start += part.num_rows
    return np.concatenate(rows), np.concatenate(values)


def _index(parts: list[pa.RecordBatch], step: int) -> I64:
    rows, first = _sparse(parts, schema.INDEX)
    n = sum(part.num_rows for part in parts)
    lengths = np.diff(np.append(rows, n))
    index: I64 = np.repeat(first - rows * step, lengths) + np.arange(n, dtype=np.int64) * step
    return index


def _gaps(parts: list[pa.RecordBatch]) -> tuple[Gap, ...]:
    rows, samples = _sparse(parts, schema.GAP_FIELDS[0])
    frames, overrun = (_sparse(parts, name)[1] for name in schema.GAP_FIELDS[1:])
    return tuple(
        Gap(position, lost, lost_frames, bool(flag))
        for position, lost, lost_frames, flag in zip(
            rows.tolist(), samples.tolist(), frames.tolist(), overrun.tolist(), strict=True
        )
    )


def _rows(
    parts: list[pa.RecordBatch], names: Sequence[str], kinds: Sequence[Callable[[Any], Any]]
) -> Iterator[tuple[Any, ...]]:
    """The values of components that have one in every row, each of its kind."""
    columns = [map(kind, _column(parts, name, object)) for name, kind in zip(names, kinds, strict=True)]
    return zip(*columns, strict=True)


def _texts(parts: list[pa.RecordBatch], name: str) -> list[str]:
    return [str(text) for text in _column(parts, name, object)]


def _last_text(parts: list[pa.RecordBatch], component: str) -> str:
    texts = [part.column(component) for part in parts if component in part.schema.names]
    return str(texts[-1].flatten()[-1].as_py())
