"""Names of a run's files, schemas of its columns, and checksums: what writer and reader have to agree on.

    RUN/run.jsonl                  the log: one JSON object a line, each with its CRC-32
    RUN/samples-000001.parquet     a minute of the drive's samples: raw integers; unit, scale and role in the schema
    RUN/edges-000001.parquet       its Hall edges
    RUN/overview-000001.parquet    minima and maxima of the samples over 50 ms
    RUN/node2-stream0-000001.parquet   samples of another node
    RUN/journal-000002             what is in no Parquet file yet
    RUN/asked.jsonl                marks that another terminal asks for, while it is being recorded

Raw values are what came over the wire; the value in `unit` is raw * scale + offset. `tick` is the device's clock,
`tick_hz` of which are a second; `index` counts PWM periods, or edges. Where records are missing before a row, `gap` is
not 0 (1, or 3 where the device says that it dropped them itself), and `lost` and `lost_frames` say how many. A channel
that is itself called `tick` has the column `tick_`.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bench.files import RUN_LOG, finite
from bench.record.info import AnyChannel, Mark, RunInfo, stream_to_json
from bench.signal.channels import role
from protocol.streams import EdgeChunk, Gap, SampleChunk, StreamConfig

FORMAT = 1
"""Version of all of this; a reader refuses a newer one."""
LOG = RUN_LOG
JOURNAL = "journal-"
ASKED = "asked.jsonl"
SAMPLES, EDGES, OVERVIEW = "samples", "edges", "overview"
"""Streams of the drive, and what is made of them."""

GAP_FIELDS = {"gap": np.uint8, "lost": np.int64, "lost_frames": np.int64}
EDGE_FIELDS = {"hall_old": np.uint8, "hall_new": np.uint8, "illegal": np.bool_, "encoder": np.uint16}
_OTHERS = {"tick", "index", *GAP_FIELDS}
HERE, OVERRUN = 1, 2  # bits of `gap`
_CRC = ',"crc":"'
_CRC_CHARS = len(_CRC) + 8 + len('"}')


def file_name(stream: str, number: int) -> str:
    """Name of the Parquet file of a stream's segment."""
    return f"{stream}-{number:06d}.parquet"


def stream_key(config: StreamConfig) -> tuple[object, ...]:
    """What makes two configurations one stream: all but the number that the device gave them."""
    return config.node, config.stream, config.event, config.decimation, config.channels


def stream_name(config: StreamConfig, node: int, taken: Collection[str]) -> str:
    """Name of a stream in a run of the drive `node`, where those that are `taken` are others."""
    own = SAMPLES if config.channels else EDGES
    name = own if config.node == node else f"node{config.node}-stream{config.stream}"
    others = (f"{name}.{number}" for number in count(2))  # no dash: samples-* is of one stream
    return name if name not in taken else next(other for other in others if other not in taken)


def journal_name(number: int) -> str:
    """Name of the journal of a segment."""
    return f"{JOURNAL}{number:06d}"


def part_name(path: Path, number: int) -> Path:
    """The folder of a part of a run that is split."""
    return path.with_name(f"{path.stem}-{number:03d}{path.suffix}")


def fault_run(path: Path) -> Path:
    """The folder of what a drive held at a fault of the run that is recorded to `path`."""
    return path.with_name(f"{path.stem}-fault{path.suffix}")


def parts_of(path: Path) -> list[Path]:
    """What there is of the parts of a run that is split, in no order."""
    name = re.compile(rf"{re.escape(path.stem)}-\d{{3,}}{re.escape(path.suffix)}")
    return [found for found in path.parent.glob("*") if name.fullmatch(found.name)]


# -- lines of the log -----------------------------------------------------------------------------------------------


def mark_record(mark: Mark) -> dict[str, Any]:
    """A mark as a record of the log."""
    verdict = None if mark.verdict is None else mark.verdict.value
    asked = {} if mark.asked is None else {"id": mark.asked}
    return {
        "kind": "mark", "tick": mark.first_tick, "last": mark.last_tick, "name": mark.name, "verdict": verdict, **asked
    }  # fmt: skip


def line_of(record: Mapping[str, Any]) -> str:
    """A record as a line of the log, its checksum last. Numbers that JSON has not are strings: "nan", "inf"."""
    body = json.dumps(finite(record, text=True), separators=(",", ":"), allow_nan=False)[:-1]
    return f'{body}{_CRC}{zlib.crc32(body.encode()):08x}"}}\n'


def record_of(line: str) -> dict[str, Any] | None:
    """The record of a line without its line break; None where it is damaged."""
    body, crc = line[:-_CRC_CHARS], line[-_CRC_CHARS:]
    if crc != f'{_CRC}{zlib.crc32(body.encode(errors="surrogateescape")):08x}"}}':
        return None
    record: dict[str, Any] = json.loads(body + "}")
    return record


# -- columns --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Columns:
    """The columns of a stream: schema, and how each is encoded."""

    schema: pa.Schema
    encodings: dict[str, str]

    def writer(self, sink: Any) -> Any:
        """A Parquet writer to a file object."""
        return pq.ParquetWriter(
            sink,
            self.schema,
            compression="zstd",
            compression_level=3,
            use_dictionary=False,
            column_encoding=self.encodings,
            write_statistics=True,
        )


def columns_of(fields: Sequence[pa.Field], metadata: Mapping[str, Any]) -> Columns:
    """Columns of these fields; `metadata` becomes JSON, by name."""
    told = {f"hallbench:{name}": json.dumps(finite(value, text=True)) for name, value in metadata.items()}
    encodings = {field.name: _encoding(field.type) for field in fields}
    return Columns(pa.schema(fields, told), encodings)


def stream_columns(config: StreamConfig, stream: str, run: RunInfo) -> Columns:
    """Columns of a stream of samples or edges."""
    fields = [pa.field("tick", pa.int64(), False, {"unit": "s", "scale": repr(1 / config.tick_hz)})]
    fields.append(pa.field("index", pa.int64(), False))
    if config.channels:
        fields += [channel_field(channel, column_of(channel.name)) for channel in config.channels]
    else:
        fields += [pa.field(name, pa.from_numpy_dtype(dtype), False) for name, dtype in EDGE_FIELDS.items()]
    fields += [pa.field(name, pa.from_numpy_dtype(dtype), False) for name, dtype in GAP_FIELDS.items()]
    return columns_of(fields, {"run": run.to_json(), "stream": stream_to_json(config, stream)})


def column_of(channel: str) -> str:
    """Name of a channel's column: its own, with _ at the end where that would be taken for one of the others'."""
    return f"{channel}_" if channel.rstrip("_") in _OTHERS else channel


def column_names(config: StreamConfig) -> frozenset[str]:
    """Columns of samples that `to_chunk` needs."""
    return frozenset((*_OTHERS, *(column_of(channel.name) for channel in config.channels)))


def channel_field(channel: AnyChannel, name: str) -> pa.Field:
    """A column of a channel's raw values."""
    about = {"unit": channel.unit.symbol, "scale": repr(channel.scale), "offset": repr(channel.offset)}
    return pa.field(name, pa.from_numpy_dtype(channel.raw.dtype), False, {**about, "role": role(channel)})


def _encoding(kind: pa.DataType) -> str:
    if pa.types.is_integer(kind):
        return "DELTA_BINARY_PACKED"
    return "RLE" if pa.types.is_boolean(kind) else "BYTE_STREAM_SPLIT"


def to_table(chunk: SampleChunk | EdgeChunk, columns: Columns) -> pa.Table:
    """A chunk as rows of its stream's columns."""
    arrays: dict[str, NDArray[Any]] = {"tick": chunk.tick, "index": chunk.index}
    if isinstance(chunk, SampleChunk):
        arrays |= {column_of(name): np.ascontiguousarray(chunk.raw[name]) for name in chunk.raw.dtype.names or ()}
    else:
        arrays |= {name: getattr(chunk, name) for name in EDGE_FIELDS}
    return table_of(columns, list((arrays | gap_columns(chunk)).values()))


def gap_columns(chunk: SampleChunk | EdgeChunk) -> dict[str, NDArray[Any]]:
    """What is missing before each record of a chunk, by name as in `GAP_FIELDS`, (n,) each."""
    gaps = {name: np.zeros(len(chunk), dtype) for name, dtype in GAP_FIELDS.items()}
    for gap in chunk.gaps:
        gaps["gap"][gap.position] = HERE | (OVERRUN if gap.overrun else 0)
        gaps["lost"][gap.position] = gap.lost_samples
        gaps["lost_frames"][gap.position] = gap.lost_frames
    return gaps


def table_of(columns: Columns, arrays: Sequence[NDArray[Any]]) -> pa.Table:
    """Arrays of one length as a table; what is contiguous and no bool is not copied.

    By their buffers, since `pyarrow.array` (26) imports pandas where it is installed: half a second, in mid-recording.
    """
    found = []
    for field, array in zip(columns.schema, arrays, strict=True):
        bits = np.packbits(array, bitorder="little") if array.dtype == np.bool_ else np.ascontiguousarray(array)
        found.append(pa.Array.from_buffers(field.type, len(array), [None, pa.py_buffer(bits)]))
    return pa.Table.from_arrays(found, schema=columns.schema)


def joined(tables: Sequence[pa.Table]) -> pa.Table:
    """Tables of the same columns, one after the other; nothing is copied."""
    return pa.concat_tables(tables)


def to_chunk(table: pa.Table, config: StreamConfig) -> SampleChunk | EdgeChunk:
    """The inverse of `to_table`. A bool column of edges and all of samples are copied, once."""
    arrays = {name: numbers(table.column(name)) for name in table.column_names}
    rows = np.flatnonzero(arrays["gap"])
    told = zip(*(arrays[name][rows].tolist() for name in GAP_FIELDS), strict=True)
    gaps = tuple(
        Gap(int(row), lost, frames, bool(flags & OVERRUN))
        for row, (flags, lost, frames) in zip(rows, told, strict=True)
    )
    if not config.channels:
        edges = {name: arrays[name] for name in EDGE_FIELDS}
        return EdgeChunk(config, arrays["tick"], index=arrays["index"], gaps=gaps, **edges)
    raw = np.empty(table.num_rows, config.dtype)
    for channel in config.channels:
        raw[channel.name] = arrays[column_of(channel.name)]
    return SampleChunk(config, arrays["index"], arrays["tick"], raw, gaps)


_FLOATS = {"halffloat": "f2", "float": "f4", "double": "f8"}  # what pyarrow calls them


def numbers(column: pa.ChunkedArray) -> NDArray[Any]:
    """A column of numbers or bools as an array, (rows,).

    By its buffer, since pyarrow's own `to_numpy` (26) imports pandas where it is installed, which takes half a second.
    """
    whole = column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()  # which copies even one
    if whole.null_count:  # no recording of ours has any
        values: NDArray[Any] = whole.to_numpy(zero_copy_only=False)
        return values
    data, first, n = whole.buffers()[1] or b"", whole.offset, len(whole)
    if pa.types.is_boolean(whole.type):
        return np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")[first : first + n].astype(bool)
    dtype = np.dtype(_FLOATS.get(str(whole.type), str(whole.type)))
    return np.frombuffer(data, dtype, n, first * dtype.itemsize) if n else np.empty(0, dtype)


# -- checksums ------------------------------------------------------------------------------------------------------


class CheckedFile:
    """A file object for a Parquet writer that notes a CRC-32 of each block: `end_block` ends one."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._crc = 0
        self.size = 0
        self.blocks: list[tuple[int, int]] = []
        """Where each block ends, and its CRC-32."""
        self.closed = False

    def write(self, data: Any) -> int:
        """Write it all."""
        view = memoryview(data)
        self._file.write(view)
        self._crc = zlib.crc32(view, self._crc)
        self.size += view.nbytes
        return view.nbytes

    def end_block(self) -> None:
        """What comes next belongs to another block."""
        self.blocks.append((self.size, self._crc))
        self._crc = 0

    def tell(self) -> int:
        """Bytes so far."""
        return self.size

    def flush(self) -> None:
        """Nothing is held back here."""

    def close(self) -> None:
        """The file itself is its owner's to close."""
        self.closed = True

    def writable(self) -> bool:
        """It is written."""
        return True

    def readable(self) -> bool:
        """Not here."""
        return False

    def seekable(self) -> bool:
        """It only grows."""
        return False


def damaged(data: memoryview, start: int, end: int, crc: int) -> bool:
    """Whether the block of a file from byte `start` to `end` is not as it was written."""
    return end > len(data) or zlib.crc32(data[start:end]) != crc
