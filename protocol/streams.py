"""DATA and EDGES on the host: from frames to numpy columns, with every loss counted.

A decoder takes the frames of one stream as they came and gives one chunk: samples (or edges) with their
unwrapped index and tick, and a `Gap` wherever something is missing. Loss is counted by index (records), by
seq (frames) and by the device's overrun flag, so that the three can be reconciled. A frame that does not
fit the stream, or that goes back in time, is counted and never delivered. This module knows no link, no
session and no observers.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from protocol.descriptor import Channel, Descriptor, sample_dtype
from protocol.errors import RemoteProtocolError
from protocol.framing import HEADER_BYTES
from protocol.messages import StreamEvent, StreamReply, StreamSet
from protocol.signals import Signal

STREAM_HEADER = struct.Struct("<BBHHHII")  # stream, flags, n, cfg_id, seq, index, tick
STREAM_OFFSET = HEADER_BYTES + STREAM_HEADER.size  # of the first record in header + payload
OVERRUN = 1  # stream flag: the device dropped a frame of this stream before this one
DISCONTINUITY = 2  # stream flag: the index jumps although no frame was dropped

EDGE_RECORD = np.dtype([("tick", "<u4"), ("codes", "u1"), ("flags", "u1"), ("encoder", "<u2")])
EDGE_ILLEGAL = 0x40  # bit of `codes`: old and new are not neighbours, or new is 000 or 111

_HEAD = np.dtype(
    [
        ("frame", "V8"),
        ("stream", "u1"),
        ("flags", "u1"),
        ("n", "<u2"),
        ("cfg_id", "<u2"),
        ("seq", "<u2"),
        ("index", "<u4"),
        ("tick", "<u4"),
    ]
)

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


@dataclass(slots=True)
class TickReference:
    """The newest 64-bit tick known of a device; 32-bit ticks are unwrapped to the value nearest to it.

    Heartbeats (10 Hz) and TIME_SYNC keep it fresh. Sound as long as it is within 2^31 ticks (107 s at 20
    MHz).
    """

    tick: int = 0

    def unwrap(self, ticks: NDArray[np.uint32]) -> I64:
        """Return 64-bit ticks for 32-bit ones, without changing the reference."""
        base = np.uint32(self.tick & 0xFFFFFFFF)
        return self.tick + (ticks - base).astype(np.int32).astype(np.int64)


@dataclass(frozen=True)
class StreamConfig:
    """A stream as the device configured it. `block`: most records in a frame; edges have no channels."""

    node: int
    stream: int
    cfg_id: int
    event: StreamEvent
    decimation: int
    channels: tuple[Channel | Signal, ...]
    block: int

    @classmethod
    def of(cls, node: int, request: StreamSet, reply: StreamReply, descriptor: Descriptor) -> Self:
        """Return the stream that `reply` configured for `request`; RemoteProtocolError if they disagree."""
        by_id = {channel.id: channel for channel in descriptor.channels}
        config = cls(
            node=node,
            stream=request.stream,
            cfg_id=reply.cfg_id,
            event=request.event,
            decimation=request.decimation,
            channels=tuple(by_id[number] for number in request.channels),
            block=reply.block,
        )
        if reply.stream != request.stream or reply.sample_bytes != config.dtype.itemsize or reply.block < 1:
            raise RemoteProtocolError(
                f"stream {request.stream}: {reply.sample_bytes} bytes a sample, {reply.block} a frame by the "
                f"device, {config.dtype.itemsize} bytes by its descriptor"
            )
        return config

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Packed dtype of a record, with a field per channel."""
        return EDGE_RECORD if self.event == StreamEvent.EDGES else sample_dtype(self.channels)

    def channel(self, name: str) -> Channel | Signal:
        """Return the channel of that name; KeyError, naming what there is, if it is not in the stream."""
        for channel in self.channels:
            if channel.name == name:
                return channel
        raise KeyError(
            f"no channel {name!r} in the stream; there are: {', '.join(c.name for c in self.channels)}"
        )


@dataclass(frozen=True, slots=True)
class Gap:
    """Something is missing before record `position` of a chunk.

    `overrun`: the device says that it dropped frames itself. `lost_frames` is 0 where the device skipped
    records without dropping a frame.
    """

    position: int
    lost_samples: int
    lost_frames: int
    overrun: bool


@dataclass(frozen=True)
class SampleChunk:
    """n samples of a stream: PWM-period `index`, device `tick`, and `raw` with a field per channel."""

    config: StreamConfig
    index: I64
    tick: I64
    raw: NDArray[np.void]
    gaps: tuple[Gap, ...]

    def __len__(self) -> int:
        return len(self.index)

    def physical(self, name: str) -> NDArray[np.float64]:
        """Return a channel in its unit: raw * scale + offset in float64, shape (n,)."""
        channel = self.config.channel(name)
        values: NDArray[np.float64] = self.raw[name].astype(np.float64) * channel.scale
        return values + channel.offset if channel.offset else values


@dataclass(frozen=True)
class EdgeChunk:
    """n Hall edges: `tick` of capture, code before and after, latched encoder, running `index` since boot."""

    config: StreamConfig
    tick: I64
    hall_old: U8
    hall_new: U8
    illegal: NDArray[np.bool_]
    encoder: NDArray[np.uint16]
    index: I64
    gaps: tuple[Gap, ...]

    def __len__(self) -> int:
        return len(self.index)


@dataclass(slots=True)
class LossCounters:
    """Account of one stream since its configuration.

    `lost_by_index` counts records, `lost_by_seq` frames; `overruns` frames that carried the flag. The last
    four count frames that were rejected.
    """

    samples: int = 0
    lost_by_index: int = 0
    frames: int = 0
    lost_by_seq: int = 0
    overruns: int = 0
    stale: int = 0  # of another configuration
    out_of_order: int = 0  # repeated, or older than what was delivered
    malformed: int = 0  # length and number of records disagree


@dataclass(slots=True)
class _Accepted:
    """Frames that were accepted: fields per frame, all records joined."""

    index: I64  # of each frame's first record, unwrapped
    n: I64
    tick: I64  # of each frame's first record, unwrapped
    records: NDArray[np.void]
    gaps: tuple[Gap, ...]


class _Sequence:
    """Checks that the frames of one stream follow each other; shared by both decoders."""

    def __init__(self, config: StreamConfig, step: int, reference: TickReference) -> None:
        self.config = config
        self.counters = LossCounters()
        self.reference = reference
        self._step = step  # of the index from record to record
        self._next_index: int | None = None
        self._next_seq = 0

    def accept(self, frames: Sequence[bytes]) -> _Accepted | None:
        """Return what is delivered of `frames` (header + payload each), or None."""
        whole = [raw for raw in frames if len(raw) >= STREAM_OFFSET]
        self.counters.malformed += len(frames) - len(whole)
        if not whole:
            return None
        heads = np.frombuffer(b"".join([raw[:STREAM_OFFSET] for raw in whole]), _HEAD)
        lengths = np.fromiter(map(len, whole), np.int64, len(whole))
        gaps: tuple[Gap, ...] = ()
        n = heads["n"].astype(np.int64)
        index = self._follow_on(heads, n, lengths)
        if index is None:
            accepted, index, gaps = self._one_by_one(heads, n, lengths)
            if not accepted:
                return None
            whole = [whole[i] for i in accepted]
            heads, n = heads[accepted], n[accepted]
        records = np.frombuffer(b"".join([raw[STREAM_OFFSET:] for raw in whole]), self.config.dtype)
        self._next_index = int(index[-1] + n[-1] * self._step)
        self._next_seq = (int(heads["seq"][-1]) + 1) & 0xFFFF
        self.counters.frames += len(whole)
        self.counters.samples += len(records)
        tick = self.reference.unwrap(heads["tick"])
        return _Accepted(index, n, tick, records, gaps)

    def _follow_on(self, heads: NDArray[np.void], n: I64, lengths: I64) -> I64 | None:
        """Return the unwrapped index of each frame if nothing at all is amiss, else None."""
        if self._next_index is None:
            if heads["seq"][0] != 0:
                return None
            start = int(heads["index"][0])
        else:
            start = self._next_index
        index = np.empty(len(n), np.int64)
        index[0] = start
        np.cumsum(n[:-1] * self._step, out=index[1:])
        index[1:] += start
        seq = (self._next_seq + np.arange(len(n))) & 0xFFFF
        fine = (
            (heads["stream"] == self.config.stream)
            & (heads["cfg_id"] == self.config.cfg_id)
            & (heads["flags"] == 0)
            & (n > 0)
            & (lengths == STREAM_OFFSET + n * self.config.dtype.itemsize)
            & (heads["seq"] == seq)
            & (heads["index"] == (index & 0xFFFFFFFF))
        )
        return index if fine.all() else None

    def _one_by_one(
        self, heads: NDArray[np.void], n: I64, lengths: I64
    ) -> tuple[list[int], I64, tuple[Gap, ...]]:
        """Return positions of the accepted frames, their unwrapped index, and the gaps."""
        config, counters, step = self.config, self.counters, self._step
        accepted: list[int] = []
        indices: list[int] = []
        gaps: list[Gap] = []
        next_index, next_seq, position = self._next_index, self._next_seq, 0
        for i, (_, stream, flags, _, cfg_id, seq, index32, _) in enumerate(heads.tolist()):
            count = int(n[i])
            if stream != config.stream or cfg_id != config.cfg_id:
                counters.stale += 1
                continue
            if count == 0 or int(lengths[i]) != STREAM_OFFSET + count * config.dtype.itemsize:
                counters.malformed += 1
                continue
            lost_frames = (seq - next_seq) & 0xFFFF
            if next_index is None:
                # seq starts at 0: the frames before the first one that came are lost
                index = index32
                lost = lost_frames * config.block if config.event != StreamEvent.EDGES else lost_frames
            else:
                ahead = _signed32(index32 - next_index)
                if ahead < 0:
                    counters.out_of_order += 1
                    continue
                index = next_index + ahead
                lost = ahead // step
                lost_frames += _whole_wraps(lost, lost_frames, config.block)
            overrun = bool(flags & OVERRUN)
            counters.overruns += overrun
            if lost or lost_frames or overrun or flags & DISCONTINUITY:
                counters.lost_by_index += lost
                counters.lost_by_seq += lost_frames
                gaps.append(Gap(position, lost, lost_frames, overrun))
            accepted.append(i)
            indices.append(index)
            position += count
            next_index = index + count * step
            next_seq = (seq + 1) & 0xFFFF
        return accepted, np.array(indices, np.int64), tuple(gaps)


class SampleDecoder:
    """Decodes the DATA frames of one configured stream.

    `ticks_per_period`: device ticks in a PWM period (HELLO's tick_hz / pwm_hz).
    """

    def __init__(self, config: StreamConfig, ticks_per_period: int, reference: TickReference) -> None:
        self.config = config
        self._sequence = _Sequence(config, config.decimation, reference)
        self._ticks_per_sample = ticks_per_period * config.decimation

    @property
    def counters(self) -> LossCounters:
        """The stream's account."""
        return self._sequence.counters

    def decode(self, frames: Sequence[bytes]) -> SampleChunk | None:
        """Return the samples of `frames` (header + payload each, in order), or None if there are none."""
        accepted = self._sequence.accept(frames)
        if accepted is None:
            return None
        within = _within(accepted.n)
        index = np.repeat(accepted.index, accepted.n) + within * self.config.decimation
        tick = np.repeat(accepted.tick, accepted.n) + within * self._ticks_per_sample
        self._sequence.reference.tick = int(tick[-1])
        return SampleChunk(self.config, index, tick, accepted.records, accepted.gaps)


class EdgeDecoder:
    """Decodes the EDGES frames of one configured stream."""

    def __init__(self, config: StreamConfig, reference: TickReference) -> None:
        self.config = config
        self._sequence = _Sequence(config, 1, reference)

    @property
    def counters(self) -> LossCounters:
        """The stream's account; its samples are edges."""
        return self._sequence.counters

    def decode(self, frames: Sequence[bytes]) -> EdgeChunk | None:
        """Return the edges of `frames` (header + payload each, in order), or None if there are none."""
        accepted = self._sequence.accept(frames)
        if accepted is None:
            return None
        records = accepted.records
        codes = records["codes"]
        tick = self._sequence.reference.unwrap(records["tick"])
        self._sequence.reference.tick = max(self._sequence.reference.tick, int(tick[-1]))
        return EdgeChunk(
            config=self.config,
            tick=tick,
            hall_old=(codes & 7).astype(np.uint8),
            hall_new=(codes >> 3 & 7).astype(np.uint8),
            illegal=(codes & EDGE_ILLEGAL) != 0,
            encoder=records["encoder"].copy(),
            index=np.repeat(accepted.index, accepted.n) + _within(accepted.n),
            gaps=accepted.gaps,
        )


def pack_edges(
    tick: I64, hall_old: U8, hall_new: U8, illegal: NDArray[np.bool_], encoder: I64
) -> NDArray[np.void]:
    """Return edges as wire records (EDGE_RECORD): ticks and encoder counts are cut to 32 and 16 bits."""
    records = np.zeros(len(tick), EDGE_RECORD)
    records["tick"] = tick & 0xFFFFFFFF
    records["codes"] = hall_old | hall_new << 3 | np.where(illegal, EDGE_ILLEGAL, 0).astype(np.uint8)
    records["encoder"] = encoder & 0xFFFF
    return records


def _within(n: I64) -> I64:
    """Return 0..n-1 for each n, joined."""
    starts = np.cumsum(n) - n
    return np.arange(int(n.sum()), dtype=np.int64) - np.repeat(starts, n)


def _signed32(value: int) -> int:
    value &= 0xFFFFFFFF
    return value - (1 << 32) if value >= 1 << 31 else value


def _whole_wraps(lost_samples: int, lost_frames: int, block: int) -> int:
    """Return the frames that a 16-bit seq cannot see in a long gap, from the samples that are missing."""
    return max(0, round((lost_samples / block - lost_frames) / 65536)) * 65536
