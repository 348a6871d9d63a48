"""Chunks of samples and of Hall edges: cut, joined, and where something is missing between their records."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from protocol.messages import StreamEvent
from protocol.streams import EdgeChunk, Gap, SampleChunk, StreamConfig
from protocol.text import counted

I64 = NDArray[np.int64]
Chunk = TypeVar("Chunk", bound=SampleChunk | EdgeChunk)

BEGIN, END = -1, 1 << 62
"""Ticks before and after all that a device reaches."""
_SAMPLE_FIELDS = ("index", "tick", "raw")
_EDGE_FIELDS = ("index", "tick", "hall_old", "hall_new", "illegal", "encoder")


def part(chunk: Chunk, first: int, last: int) -> Chunk:
    """Records [first, last) of a chunk, with the gaps between them and the one before the first."""
    gaps = tuple(replace(gap, position=gap.position - first) for gap in chunk.gaps if first <= gap.position < last)
    return replace(chunk, gaps=gaps, **{name: getattr(chunk, name)[first:last] for name in _fields(chunk)})


def between(chunk: Chunk, first: int, last: int) -> Chunk:
    """Records with ticks from `first` to `last`, both included."""
    a, b = np.searchsorted(chunk.tick, first, "left"), np.searchsorted(chunk.tick, last, "right")
    return part(chunk, int(a), int(b))


def join(chunks: Sequence[Chunk]) -> Chunk:
    """Join chunks of one stream, one or more, into one, with the gaps in their places."""
    if len(chunks) == 1:
        return chunks[0]
    gaps: list[Gap] = []
    start = 0
    for chunk in chunks:
        gaps += [replace(gap, position=start + gap.position) for gap in chunk.gaps]
        start += len(chunk)
    joined: dict[str, Any] = {
        name: _concatenated([getattr(chunk, name) for chunk in chunks]) for name in _fields(chunks[0])
    }
    return replace(chunks[0], gaps=tuple(gaps), **joined)


def narrowed(config: StreamConfig, channels: Collection[str] | None) -> StreamConfig:
    """The stream with these of its channels only, in its own order; None: all, and for edges, which have none.

    BenchError for a channel that it does not have.
    """
    if channels is None or not config.channels:
        return config
    there = [channel.name for channel in config.channels]
    if not channels:
        raise BenchError(f"no channel named; the stream has {', '.join(there)}")
    if lacking := [name for name in channels if name not in there]:
        raise BenchError(f"channel '{lacking[0]}' is not in the stream; it has {', '.join(there)}")
    return replace(config, channels=tuple(channel for channel in config.channels if channel.name in channels))


def of_channels(chunk: Chunk, config: StreamConfig) -> Chunk:
    """A chunk as `config`, one of `narrowed`, has it."""
    if config is chunk.config or not isinstance(chunk, SampleChunk):
        return chunk
    raw = np.empty(len(chunk), config.dtype)
    for channel in config.channels:
        raw[channel.name] = chunk.raw[channel.name]
    return replace(chunk, config=config, raw=raw)


def with_columns(chunk: SampleChunk, config: StreamConfig, columns: Iterable[NDArray[np.generic]]) -> SampleChunk:
    """A chunk with further channels, the last ones of `config`, whose raw values (n,) are `columns`."""
    n, width = len(chunk), chunk.raw.dtype.itemsize
    raw = np.empty(n, config.dtype)
    # Records as bytes: numpy copies field by field otherwise.
    raw.view(np.uint8).reshape(n, -1)[:, :width] = np.ascontiguousarray(chunk.raw).view(np.uint8).reshape(n, width)
    for channel, column in zip(config.channels[len(chunk.config.channels) :], columns, strict=True):
        raw[channel.name] = column
    return replace(chunk, config=config, raw=raw)


def no_edges(config: StreamConfig) -> EdgeChunk:
    """What a shaft at rest streams."""
    ticks, codes = np.empty(0, np.int64), np.empty(0, np.uint8)
    return EdgeChunk(config, ticks, codes, codes, np.empty(0, np.bool_), np.empty(0, np.uint16), ticks, ())


def no_edge_stream(node: int, tick_hz: int, pwm_hz: int) -> StreamConfig:
    """What stands for the edges of a drive that streams none: no frame holds one."""
    return StreamConfig(node, 0, 0, StreamEvent.EDGES, 1, (), 0, tick_hz=tick_hz, pwm_hz=pwm_hz)


def streams_none(edges: StreamConfig) -> bool:
    """Whether this is `no_edge_stream`."""
    return not edges.block


# -- what is missing ------------------------------------------------------------------------------------------------


def breaks(index: I64, step: int = 1, expected: int | None = None) -> I64:
    """Positions before which records are missing, of an index (n,) that grows by `step`, n > 0.

    `expected`: what it should begin with; None is anything.
    """
    first = [] if expected is None or index[0] == expected else [0]
    return np.concatenate([np.array(first, np.int64), np.flatnonzero(np.diff(index) != step) + 1])


def contiguous(chunk: SampleChunk) -> list[slice]:
    """The stretches of a chunk without a gap."""
    bounds = [0, *breaks(chunk.index, chunk.config.index_step).tolist(), len(chunk)]
    return [slice(a, b) for a, b in pairwise(bounds)]


def lost_stretches(chunk: SampleChunk | EdgeChunk, before: int) -> list[tuple[int, int, str]]:
    """The gaps of a chunk as (tick, tick, words), each from the record before it to the one after it.

    `before`: tick of the newest record before the chunk.
    """
    noun = "samples" if isinstance(chunk, SampleChunk) else "Hall edges"
    found = []
    for gap in chunk.gaps:
        first = int(chunk.tick[gap.position - 1]) if gap.position else before
        last = int(chunk.tick[gap.position]) if gap.position < len(chunk) else first
        kept = f"{noun} before {last / chunk.config.tick_hz:.4f} s were not kept"
        lost = f"{gap.lost_samples} {noun} were lost before {last / chunk.config.tick_hz:.4f} s"
        found.append((first, last, lost if gap.lost_samples or gap.overrun else kept))
    return found


def edges_lost(dropped: Iterable[tuple[int, int, str]]) -> bool:
    """Whether Hall edges are among what was lost, as `LostStretches` tells it."""
    return any("Hall edge" in words for _, _, words in dropped)


class LostStretches:
    """What is lost of a drive's samples and edges as they come, as `lost_stretches` gives it."""

    def __init__(self) -> None:
        self.seen: dict[bool, tuple[int, int]] = {}
        """Ticks of the oldest and the newest sample (True) and edge (False) so far."""

    def before(self, chunk: SampleChunk | EdgeChunk) -> list[tuple[int, int, str]]:
        """Lost before the records of a chunk."""
        samples = isinstance(chunk, SampleChunk)
        oldest, newest = self.seen.get(samples, (None, int(chunk.tick[0]) if samples else -1))
        if len(chunk):
            self.seen[samples] = int(chunk.tick[0]) if oldest is None else oldest, int(chunk.tick[-1])
        return lost_stretches(chunk, newest)

    def at_the_end(self, samples: int, edges: int, tick_hz: int) -> list[tuple[int, int, str]]:
        """So many did not come after those that did."""
        found = []
        for n, noun, of_samples in ((samples, "sample", True), (edges, "Hall edge", False)):
            _, newest = self.seen.get(of_samples, (-1, -1))
            if n:
                after = "" if newest < 0 else f" after {newest / tick_hz:.4f} s"
                found.append((newest, END, f"{counted(n, noun)}{after} were lost"))
        return found


def _fields(chunk: SampleChunk | EdgeChunk) -> tuple[str, ...]:
    return _SAMPLE_FIELDS if isinstance(chunk, SampleChunk) else _EDGE_FIELDS


def _concatenated(parts: Sequence[NDArray[np.generic]]) -> NDArray[np.generic]:
    """Records as plain bytes: numpy would compare and promote every field of theirs (13 us a part)."""
    dtype = parts[0].dtype
    if dtype.names is None:
        return np.concatenate(parts)
    return np.concatenate([as_bytes(part) for part in parts]).view(dtype)


def as_bytes(records: NDArray[np.generic]) -> NDArray[np.void]:
    """Records (n,) as plain bytes, which numpy moves at once; a view where they are contiguous."""
    return np.ascontiguousarray(records).view(np.dtype((np.void, records.dtype.itemsize)))
