"""DATA and EDGES on the host: from frames to numpy columns, with every loss counted.

A decoder takes the frames of one stream as they came and gives one chunk: samples (or edges) with their
unwrapped index and tick, and a `Gap` wherever something is missing. Loss is counted by index (records), by
seq (frames) and by the device's overrun flag, so that the three can be reconciled. A frame that does not
fit the stream, or that goes back in time, is counted and never delivered. What was lost after the last frame
that came, heartbeats tell (`missing`). This module knows no link, no session and no observers.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from protocol.descriptor import Channel, Descriptor, sample_dtype
from protocol.errors import RemoteProtocolError
from protocol.frames import data_frame
from protocol.framing import HEADER_BYTES
from protocol.messages import HelloReply, StreamEvent, StreamReply, StreamSet
from protocol.signals import RawType, Signal

if TYPE_CHECKING:
    import pandas as pd

STREAM_HEADER = struct.Struct("<BBHHHII")  # stream, flags, n, cfg_id, seq, index, tick
STREAM_OFFSET = HEADER_BYTES + STREAM_HEADER.size  # of the first record in header + payload
OVERRUN = 1  # stream flag: the device dropped a frame of this stream before this one
DISCONTINUITY = 2  # stream flag: the index jumps although no frame was dropped

MAX_STREAMS = 4  # of a device
MAX_DECIMATION = 0xFFFF

EDGE_RECORD = np.dtype([("tick", "<u4"), ("codes", "u1"), ("flags", "u1"), ("encoder", "<u2")])
EDGE_ILLEGAL = 0x40  # bit of `codes`: old and new are not neighbours, or new is 000 or 111

_CODE, _NEXT = np.uint8(7), np.uint8(3)  # bits of a Hall code, and how far the next one is away

AHEAD, BEHIND = 1.0, 1.0
"""s by which a tick may be later than the host's clock makes it, and earlier than the newest."""
DRIFT, RECENT = 0.1, 5.0
"""By which the two clocks may differ, as a share, and s over which what came the soonest tells how they stand."""
FRESH = 0.15
"""s for which the newest tick stands for one that cannot be: until the next heartbeat, and some."""
QUEUED = 30.0
"""s that edges may have waited in the device before the first one comes, and the heartbeats have gone on."""
JUMPED = 3
"""Ticks in a row that are wrong alike, with which the counter has jumped."""
OFF, OFF_SHARE = 0.1, 0.2
"""s by which a sample's tick may be away from where its index puts it, and share of what was lost before it."""

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


class Beat(NamedTuple):
    """A heartbeat's device time and count of edges."""

    tick: int
    edges: int


class WrongTime(NamedTuple):
    """`what` was dated `by` s away from `tick`, the time that it can have, and by which it goes on; NaN: cannot be."""

    tick: int
    what: str
    by: float


@dataclass(slots=True)
class TickReference:
    """The newest 64-bit tick known of a device; 32-bit ticks are unwrapped to the value nearest to it.

    Heartbeats (10 Hz) and TIME_SYNC keep it fresh. Sound as long as it is within 2^31 ticks (107 s at 20
    MHz). `sampled`: tick of the newest sample delivered of a stream on CAN.

    With `tick_hz` and the host's time `now`, s, of what is being received, a tick that cannot be is put right, and told
    in `wrong`. A counter that has jumped for good is followed with a `shift`, so that time goes on, once records have
    been dated (`used`); before that, what came first may have been wrong.
    """

    tick: int = 0
    sampled: int = -1
    tick_hz: int = 0
    now: float = 0.0
    shift: int = 0
    used: bool = False
    wrong: list[WrongTime] = field(default_factory=list)
    _zero: tuple[float, float] | None = None  # ticks at host time 0, by what came the soonest of late, and before that
    _since: float = 0.0  # of late: since then
    _heard: float = 0.0
    _doubted: tuple[int, int] = (0, 0)  # how far off the last ones were, and how many in a row, alike

    def restart(self) -> None:
        """The device has rebooted: its counter begins anew."""
        self.tick, self.sampled, self.shift, self.used, self._zero, self._doubted = 0, -1, 0, False, None, (0, 0)

    @property
    def latest(self) -> float:
        """The latest tick that something which has come by now can have; inf where that is not known."""
        if self._zero is None:
            return math.inf
        return max(self._zero) + (self.now + AHEAD + DRIFT * (self.now - self._heard)) * self.tick_hz

    def as_it_can_be(self, told: int, behind: float = BEHIND) -> int:
        """Return a whole tick as the device's time goes on, or what it can be instead; `behind` as for `hear`."""
        tick, hz = told - self.shift, self.tick_hz
        if not hz or self._zero is None or self.tick - behind * hz <= tick <= self.latest:
            return tick
        expected = round(max(self._zero) + self.now * hz)
        return self.tick if expected - self.tick < FRESH * hz else expected  # what came just now is sure

    def hear(self, told: int, what: str, behind: float = BEHIND) -> int:
        """Take a whole tick that the device tells; return it as the device's time goes on.

        `behind`: s by which it may be older than the newest.
        """
        tick, hz = told - self.shift, self.tick_hz
        expected = self.as_it_can_be(told, behind)
        if expected == tick:
            self._believe(tick if behind == BEHIND else max(tick, self.tick))
            return tick
        off, alike = self._doubted
        alike = alike + 1 if alike and abs(tick - expected - off) < hz else 1
        self._doubted = tick - expected, alike
        if alike == 1:
            self.wrong.append(WrongTime(expected, what, (tick - expected) / hz))
        if alike == JUMPED:
            self.wrong.append(WrongTime(expected, "the clock has jumped: all since then", (tick - expected) / hz))
            if self.used:
                self.shift += tick - expected
            else:
                self._zero, expected = None, tick
            self._believe(expected)
        self.tick = expected
        return expected

    def _believe(self, tick: int) -> None:
        self.tick, self._doubted = tick, (0, 0)
        if not self.tick_hz:
            return
        zero = tick - self.now * self.tick_hz
        late, before = self._zero or (zero, zero)
        if self.now - self._since > RECENT:
            late, before, self._since = zero, late, self.now
        self._zero, self._heard = (max(late, zero), before), self.now

    def unwrap(self, ticks: NDArray[np.uint32]) -> I64:
        """Return 64-bit ticks for 32-bit ones, without changing the reference."""
        base = np.uint32(self.tick + self.shift & 0xFFFFFFFF)
        return np.add((ticks - base).view(np.int32), self.tick, dtype=np.int64)

    def unwrap_one(self, tick: int, near: int | None = None) -> int:
        """Return the 64-bit tick for one 32-bit one, `near` another than the reference; that is not changed."""
        near = self.tick if near is None else near
        return near + _signed32(tick - self.shift - near)

    def cannot_be(self, what: str) -> None:
        """Tell that `what` came whole, with what SPEC does not allow, such as a time."""
        self.wrong.append(WrongTime(self.tick, what, math.nan))

    def doubt(self, tick: int, what: str, by: float) -> None:
        """Tell that `what`, which belongs at `tick`, is dated `by` ticks away from it."""
        self.wrong.append(WrongTime(tick, what, by / self.tick_hz))


@dataclass(frozen=True)
class StreamConfig:
    """A stream as the device configured it. `block`: most records in a frame; edges have no channels.

    Channels are as they are in its records: in a stream of means their raw type is F32, whatever the descriptor says.

    `tick_hz`, `pwm_hz`: device ticks and PWM periods a second. On CAN: `slot`, the first one of its frames, and
    `tick0`, the tick of PWM period 0.
    """

    node: int
    stream: int
    cfg_id: int
    event: StreamEvent
    decimation: int
    channels: tuple[Channel | Signal, ...]
    block: int
    slot: int = 0
    tick0: int = 0
    tick_hz: int = field(kw_only=True)
    pwm_hz: int = field(kw_only=True)

    def __hash__(self) -> int:
        return hash((self.node, self.stream, self.cfg_id))  # all of it would take longer than what it is looked up for

    @property
    def index_step(self) -> int:
        """How far the index advances from record to record: PWM periods, or one edge."""
        return self.decimation if self.channels else 1

    @property
    def period_ticks(self) -> int:
        """Device ticks in a PWM period."""
        return self.tick_hz // self.pwm_hz

    @property
    def rate(self) -> float:
        """Samples a second."""
        return self.pwm_hz / self.decimation

    @classmethod
    def of(cls, hello: HelloReply, request: StreamSet, reply: StreamReply, descriptor: Descriptor) -> Self:
        """Return the stream that `reply` configured for `request` in the device that says `hello` of itself.

        RemoteProtocolError if they disagree.
        """
        by_id = {channel.id: channel for channel in descriptor.channels}
        if missing := [number for number in request.channels if number not in by_id]:
            raise RemoteProtocolError(f"stream {request.stream}: the device has no channels with the ids {missing}")
        channels = tuple(by_id[number] for number in request.channels)
        if request.event == StreamEvent.MEAN:
            channels = tuple(replace(channel, raw=RawType.F32) for channel in channels)
        config = cls(
            node=hello.node,
            stream=request.stream,
            cfg_id=reply.cfg_id,
            event=request.event,
            decimation=request.decimation,
            channels=channels,
            block=reply.block,
            slot=reply.slot,
            tick0=reply.tick0,
            tick_hz=hello.tick_hz,
            pwm_hz=hello.pwm_hz,
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
        if name not in self._by_name:
            raise KeyError(f"no channel {name!r} in the stream; there are: {', '.join(self._by_name)}")
        return self._by_name[name]

    @cached_property
    def _by_name(self) -> dict[str, Channel | Signal]:
        return {channel.name: channel for channel in self.channels}


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
        values: NDArray[np.float64] = np.multiply(self.raw[name], channel.scale, dtype=np.float64)
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

    def to_pandas(self) -> pd.DataFrame:
        """A row for each edge by the device time `t` in s: codes, whether that is illegal, encoder count, index."""
        names = ("hall_old", "hall_new", "illegal", "encoder", "index")
        return data_frame({name: getattr(self, name) for name in names}, self.tick / self.config.tick_hz)


@dataclass(slots=True)
class LossCounters:
    """Account of one stream since its configuration.

    `lost_by_index` counts records, `lost_by_seq` frames; `overruns` frames that carried the flag. The last
    four count frames that were rejected, or (`late`) edges that came after samples that they should precede.
    """

    samples: int = 0
    lost_by_index: int = 0
    frames: int = 0
    lost_by_seq: int = 0
    overruns: int = 0
    stale: int = 0  # of another configuration
    out_of_order: int = 0  # repeated, or older than what was delivered
    malformed: int = 0  # length and number of records disagree
    late: int = 0


@dataclass(slots=True)
class _Accepted:
    """What of some frames is delivered: their records joined, in runs without a gap."""

    runs: list[list[int]]  # unwrapped index of the first record, 32-bit tick of the frame, number of records
    records: NDArray[np.void]
    gaps: tuple[Gap, ...]

    def index(self, step: int) -> I64:
        """Return the index of every record."""
        return _progressions([(index, n) for index, _, n in self.runs], step)


class _Sequence:
    """Checks that the frames of one stream follow each other: what both decoders have in common.

    `step`, `ticks`: what index and tick grow by from record to record; `ticks` None where records have their own.
    """

    def __init__(self, config: StreamConfig, reference: TickReference, step: int, ticks: int | None) -> None:
        self.config = config
        self.counters = LossCounters()
        self._reference = reference
        self._step = step
        self._ticks = ticks
        self._next_index: int | None = None  # unwrapped, of the record that comes next; None before the first frame
        self._next_seq = 0

    def _accept(self, frames: Sequence[bytes]) -> _Accepted | None:
        """Return what is delivered of `frames` (header + payload each, also of several that were joined), or None."""
        config, counters, step, ticks = self.config, self.counters, self._step, self._ticks
        size, stream, cfg_id = config.dtype.itemsize, config.stream, config.cfg_id
        unpack = STREAM_HEADER.unpack_from
        payloads: list[bytes] = []
        runs: list[list[int]] = []
        gaps: list[Gap] = []
        position, count, next_tick = 0, 0, -1
        for raw in frames:
            if len(raw) < STREAM_OFFSET:
                counters.malformed += 1
                continue
            stream_, flags, n, cfg_id_, seq, index, tick = unpack(raw, HEADER_BYTES)
            joined = 1 + (raw[2] | raw[3] << 8)  # see `Deframer.join`
            if cfg_id_ != cfg_id or stream_ != stream:
                counters.stale += joined
                continue
            if not n or len(raw) != STREAM_OFFSET + n * size:
                counters.malformed += joined
                continue
            expected = self._next_index
            if expected is not None and index == expected & 0xFFFFFFFF and seq == self._next_seq and not flags:
                first = expected
            else:
                place = self._place(flags, seq, index, position, gaps)
                if place is None:
                    counters.out_of_order += joined
                    continue
                first = place
            if first == expected and runs and (ticks is None or tick == next_tick):
                runs[-1][2] += n
            else:
                runs.append([first, tick, n])
            payloads.append(raw[STREAM_OFFSET:])
            position += n
            self._next_index = first + n * step
            self._next_seq = (seq + joined) & 0xFFFF
            count += joined
            if ticks is not None:
                next_tick = (tick + n * ticks) & 0xFFFFFFFF
        if not payloads:
            return None
        counters.frames += count
        counters.samples += position
        return _Accepted(runs, np.frombuffer(b"".join(payloads), config.dtype), tuple(gaps))

    @property
    def steps(self) -> tuple[int, int, int, int]:
        """What `Deframer.join` has to know of the stream's frames."""
        config = self.config
        return config.cfg_id, config.dtype.itemsize, self._step, -1 if self._ticks is None else self._ticks

    def _place(self, flags: int, seq: int, index32: int, position: int, gaps: list[Gap]) -> int | None:
        """Return the unwrapped index of a frame that may not follow the last one; None if it is not newer.

        What is missing before it is counted, and added to `gaps`.
        """
        config, counters = self.config, self.counters
        lost_frames = (seq - self._next_seq) & 0xFFFF
        if self._next_index is None:  # seq starts at 0: the frames before the first one that came are lost
            index = index32
            lost = lost_frames if config.event == StreamEvent.EDGES else lost_frames * config.block
        else:
            ahead = _signed32(index32 - self._next_index)
            if ahead < 0:
                return None
            index = self._next_index + ahead
            lost = ahead // self._step
            lost_frames += _whole_wraps(lost, lost_frames, config.block)
        overrun = bool(flags & OVERRUN)
        if lost or lost_frames or overrun or flags & DISCONTINUITY:
            counters.overruns += overrun
            counters.lost_by_index += lost
            counters.lost_by_seq += lost_frames
            gaps.append(Gap(position, lost, lost_frames, overrun))
        return index


class SampleDecoder(_Sequence):
    """Decodes the DATA frames of one configured stream."""

    def __init__(self, config: StreamConfig, reference: TickReference) -> None:
        self._ticks_per_sample = config.period_ticks * config.decimation
        super().__init__(config, reference, config.decimation, self._ticks_per_sample)
        self._next_tick: int | None = None
        self._dated_index = 0  # of the sample at `_next_tick`
        self._off: int | None = None  # how far off the last frame's tick was, if it was
        self._shift = 0  # of the reference, with which the last frame was dated

    def _dated(self, index: int, tick32: int, n: int) -> int:
        """Return the tick of a frame's first sample: as it says, unless its index says that this cannot be."""
        reference, hz, period = self._reference, self.config.tick_hz, self.config.period_ticks
        if self._next_tick is not None:
            lost = (index - self._dated_index) * period
            expected, most = self._next_tick + lost, OFF * hz + OFF_SHARE * lost
        else:
            expected, most = reference.tick, math.inf
            if (
                not reference.tick - QUEUED * hz <= reference.unwrap_one(tick32) <= reference.latest
            ):  # by tick 0, if it can
                since = self.config.tick0 - reference.shift + index * period
                expected, most = since if abs(since - reference.tick) < BEHIND * hz else reference.tick, OFF * hz
        tick = reference.unwrap_one(tick32, expected)
        off = tick - expected
        if reference.shift != self._shift and abs(off) <= most < math.inf:  # known by a heartbeat: the index knows more
            reference.shift += off
            tick, off = expected, 0
        self._shift = reference.shift
        if abs(off) > most and abs(_signed32(off + reference.shift)) <= most:  # only heartbeats have jumped
            tick = expected + (off := _signed32(off + reference.shift))
        if abs(off) <= most or not reference.tick_hz:
            self._off = None
        else:
            if self._off is None or abs(off - self._off) > OFF * hz:
                reference.doubt(expected, "samples", off)
            self._off, tick = off, expected
        self._next_tick, self._dated_index = tick + n * self._ticks_per_sample, index + n * self.config.decimation
        return tick

    def missing(self, first: Beat | None, last: Beat) -> int:
        """See `Decoder.missing`: a sample is taken at its tick."""
        if self._next_tick is not None:
            return max(0, (last.tick - self._next_tick) // self._ticks_per_sample + 1)
        return 0 if first is None else max(0, (last.tick - first.tick) // self._ticks_per_sample)

    def decode(self, frames: Sequence[bytes]) -> SampleChunk | None:
        """Return the samples of `frames` (header + payload each, in order), or None if there are none."""
        accepted = self._accept(frames)
        if accepted is None:
            return None
        starts = [(self._dated(index, tick, n), n) for index, tick, n in accepted.runs]
        tick = _progressions(starts, self._ticks_per_sample)
        self._reference.tick, self._reference.used = int(tick[-1]), True
        index = accepted.index(self.config.decimation)
        return SampleChunk(self.config, index, tick, accepted.records, accepted.gaps)


class EdgeDecoder(_Sequence):
    """Decodes the EDGES frames of one configured stream. What its counters call samples are edges."""

    def __init__(self, config: StreamConfig, reference: TickReference) -> None:
        super().__init__(config, reference, 1, None)
        self._last_tick: int | None = None
        self._off = 0  # how far off the ticks of edges are that cannot be

    def missing(self, first: Beat | None, last: Beat) -> int:
        """See `Decoder.missing`."""
        return missing_edges(self._next_index, first, last)

    def _dated(self, ticks: I64) -> I64:
        """Return the ticks as edges can have them: none before the last one, and none later than now."""
        reference, last = self._reference, self._last_tick
        first = reference.tick - round(QUEUED * self.config.tick_hz) if last is None else last
        as_told = first <= ticks[0] and ticks[-1] <= reference.latest and bool((ticks[1:] >= ticks[:-1]).all())
        if as_told or not reference.tick_hz:
            return ticks
        dated = ticks.copy()
        newest = reference.tick if last is None else last
        for k, tick in enumerate(ticks.tolist()):
            if not first <= tick <= reference.latest:
                as_it_was = reference.tick + _signed32(tick + reference.shift - reference.tick)
                if first <= as_it_was <= reference.latest:  # only heartbeats have jumped
                    dated[k] = first = newest = as_it_was
                    continue
                if not first <= tick - self._off <= reference.latest:
                    self._off = tick - newest
                    reference.doubt(newest, "Hall edges", self._off)
                tick -= self._off
            dated[k] = first = newest = tick
        return dated

    def decode(self, frames: Sequence[bytes]) -> EdgeChunk | None:
        """Return the edges of `frames` (header + payload each, in order), or None if there are none."""
        accepted = self._accept(frames)
        if accepted is None:
            return None
        tick = self._dated(self._reference.unwrap(accepted.records["tick"]))
        self._last_tick, self._reference.used = int(tick[-1]), True
        self._reference.tick = max(self._reference.tick, self._last_tick)
        return unpack_edges(self.config, accepted.records, tick, accepted.index(1), accepted.gaps)


def missing_edges(expected: int | None, first: Beat | None, last: Beat) -> int:
    """Return the edges up to the heartbeat `last` from number `expected` on, or from `first` on if none has come."""
    if expected is None:
        expected = last.edges if first is None else first.edges
    return max(0, _signed32(last.edges - expected))


def unpack_edges(
    config: StreamConfig, records: NDArray[np.void], tick: I64, index: I64, gaps: tuple[Gap, ...]
) -> EdgeChunk:
    """Return wire records (EDGE_RECORD) as a chunk, with their whole ticks and indices."""
    codes = records["codes"]
    illegal = (codes & EDGE_ILLEGAL) != 0
    return EdgeChunk(
        config, tick, codes & _CODE, codes >> _NEXT & _CODE, illegal, records["encoder"].copy(), index, gaps
    )


def _progressions(starts: Sequence[tuple[int, int]], step: int) -> I64:
    """Return start, start + step, … with n members for each (start, n), joined."""
    if len(starts) == 1:
        (start, n) = starts[0]
        return np.arange(start, start + n * step, step, dtype=np.int64)
    return np.concatenate([np.arange(start, start + n * step, step, dtype=np.int64) for start, n in starts])


def _signed32(value: int) -> int:
    value &= 0xFFFFFFFF
    return value - (1 << 32) if value >= 1 << 31 else value


def _whole_wraps(lost_samples: int, lost_frames: int, block: int) -> int:
    """Return the frames that a 16-bit seq cannot see in a long gap, from the samples that are missing."""
    return max(0, round((lost_samples / block - lost_frames) / 65536)) * 65536
