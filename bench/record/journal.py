"""The newest part of a run, as it comes: frames appended one after the other, each with a length and a CRC-32.

A process that is killed leaves whole frames and perhaps one that is cut; what was written is the kernel's to keep. A
damaged frame costs itself only: the next is found by its magic number. Rows are stored as they are in memory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.streams import EdgeChunk, Gap, SampleChunk, StreamConfig

MAGIC = b"HBJ1"
_FRAME = struct.Struct("<4sIII")  # magic, CRC-32 of the rest, number of the stream, bytes that follow
_CRC, _REST = struct.Struct("<I"), struct.Struct("<II")  # of it
_COUNTS = struct.Struct("<III")  # rows, runs, gaps
_RUN_FIELDS, _GAP_FIELDS = struct.Struct("<qqq"), struct.Struct("<qqqq")
_CHECKED = 8  # where what the CRC covers begins
_RUN = np.dtype([("row", "<i8"), ("index", "<i8"), ("tick", "<i8")])
_GAP = np.dtype([("position", "<i8"), ("lost", "<i8"), ("frames", "<i8"), ("overrun", "<i8")])
_EDGE = np.dtype(
    [("tick", "<i8"), ("index", "<i8"), ("hall_old", "u1"), ("hall_new", "u1"), ("illegal", "?"), ("encoder", "<u2")]
)
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Journalled:
    """What a journal holds: chunks by number of stream, in order; and what is wrong with it, in bytes from … to."""

    chunks: tuple[tuple[int, SampleChunk | EdgeChunk], ...]
    damage: tuple[tuple[int, int, int], ...]
    """First and last byte, and the number of chunks before."""


def frame(number: int, chunk: SampleChunk | EdgeChunk) -> bytes:
    """A chunk of stream `number`, with one row or more, as a frame."""
    if isinstance(chunk, SampleChunk):
        runs, rows = _runs(chunk), chunk.raw.tobytes()
    else:
        edges = np.empty(len(chunk), _EDGE)
        for name in _EDGE.names or ():
            edges[name] = getattr(chunk, name)
        runs, rows = b"", edges.tobytes()
    gaps = b"".join(_GAP_FIELDS.pack(g.position, g.lost_samples, g.lost_frames, g.overrun) for g in chunk.gaps)
    counts = _COUNTS.pack(len(chunk), len(runs) // _RUN.itemsize, len(chunk.gaps))
    body = counts + runs + gaps
    rest = _REST.pack(number, len(body) + len(rows)) + body
    return b"".join((MAGIC, _CRC.pack(zlib.crc32(rows, zlib.crc32(rest))), rest, rows))


def read(data: bytes, streams: Mapping[int, StreamConfig]) -> Journalled:
    """What a journal's bytes hold, of these streams. A frame that is cut at the end is no damage."""
    chunks: list[tuple[int, SampleChunk | EdgeChunk]] = []
    damage: list[tuple[int, int, int]] = []
    at, view = 0, memoryview(data)
    while at + _FRAME.size <= len(data):
        magic, crc, number, length = _FRAME.unpack_from(data, at)
        end = at + _FRAME.size + length
        if magic == MAGIC and end <= len(data) and zlib.crc32(view[at + _CHECKED : end]) == crc and number in streams:
            chunks.append((number, _chunk(streams[number], data, at + _FRAME.size)))
            at = end
            continue
        following = _next_whole(data, at + 1)
        if following is None:
            if magic == MAGIC and end > len(data):  # the last one, cut
                break
            following = len(data)
        damage.append((at, following, len(chunks)))
        at = following
    return Journalled(tuple(chunks), tuple(damage))


def _next_whole(data: bytes, start: int) -> int | None:
    """Where the next frame begins that is whole."""
    view = memoryview(data)
    while (start := data.find(MAGIC, start)) >= 0:
        if start + _FRAME.size <= len(data):
            _, crc, _, length = _FRAME.unpack_from(data, start)
            end = start + _FRAME.size + length
            if end <= len(data) and zlib.crc32(view[start + _CHECKED : end]) == crc:
                return start
        start += 1
    return None


def _runs(chunk: SampleChunk) -> bytes:
    """Where index or tick do not go on as before: row, index, tick."""
    step, ticks = _steps(chunk.config)
    index, tick = chunk.index, chunk.tick
    new = (index[1:] - index[:-1] != step) | (tick[1:] - tick[:-1] != ticks)
    rows = [0, *(new.nonzero()[0] + 1).tolist()]
    return b"".join(_RUN_FIELDS.pack(row, int(index[row]), int(tick[row])) for row in rows)


def _steps(config: StreamConfig) -> tuple[int, int]:
    return config.index_step, config.period_ticks * config.decimation


def _chunk(config: StreamConfig, data: bytes, at: int) -> SampleChunk | EdgeChunk:
    n, n_runs, n_gaps = _COUNTS.unpack_from(data, at)
    at += _COUNTS.size
    runs = np.frombuffer(data, _RUN, n_runs, at)
    at += runs.nbytes
    found = np.frombuffer(data, _GAP, n_gaps, at)
    at += found.nbytes
    gaps = tuple(Gap(position, lost, frames, bool(overrun)) for position, lost, frames, overrun in found.tolist())
    if not config.channels:
        edges = np.frombuffer(data, _EDGE, n, at)
        return EdgeChunk(config, gaps=gaps, **{name: edges[name] for name in _EDGE.names or ()})
    step, ticks = _steps(config)
    lengths = np.diff(np.append(runs["row"], n))
    since = np.arange(n) - np.repeat(runs["row"], lengths)
    index: I64 = np.repeat(runs["index"], lengths) + since * step
    tick: I64 = np.repeat(runs["tick"], lengths) + since * ticks
    return SampleChunk(config, index, tick, np.frombuffer(data, config.dtype, n, at), gaps)
