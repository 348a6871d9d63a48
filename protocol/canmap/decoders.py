"""Stream frames on the host: from rows of CAN_RECORDs to chunks, with every loss counted.

A frame carries only the low bits of its number: it is the one that lies nearest to the heartbeat (`Beat`) with which
the frame comes. `protocol.canmap.host` sees to it that there is one, not old, and holds frames back where there is not.
A frame that is repeated, late, too far ahead or of another length is counted and never delivered. This module knows
no link, no session and no transfers.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.canmap.ids import STREAM_SLOTS, CanClass, CanId, stream_id
from protocol.canmap.layout import EDGE_BYTES, StreamLayout
from protocol.streams import (
    EDGE_RECORD,
    I64,
    Beat,
    EdgeChunk,
    Gap,
    LossCounters,
    SampleChunk,
    StreamConfig,
    TickReference,
    missing_edges,
    unpack_edges,
)

WAIT = 256  # samples for which a silent group of channels is waited for
AHEAD = 0.5  # s that a sample or edge may be ahead of the heartbeat before it
FRESH = 0.11  # s before and after a heartbeat for which its count of edges alone places an edge
EDGE_RANGE = 256  # of the counter in a frame of an edge

Bools = NDArray[np.bool_]


class CanFrames(NamedTuple):
    """CAN_RECORDs of one stream as they came, with the last heartbeats, newest last.

    They came after the newest one; if they were `held` back for it, before it and after the one before.
    """

    records: NDArray[np.void]
    beats: tuple[Beat, ...]
    held: bool = False


def _from(start: I64 | int, low: I64, bits: int) -> I64:
    """Return the numbers with these low `bits` in [start, start + 2**bits)."""
    return np.asarray(start + (low - start & (1 << bits) - 1))


class _Order:
    """Lets numbers pass that are beyond all before them; each stands for `step` records."""

    def __init__(self, step: int) -> None:
        self.expected: int | None = None
        self._step = step

    def follow(self, numbers: I64) -> tuple[Bools, I64]:
        """Return which numbers pass, and what was expected before each of them."""
        if not len(numbers):
            return np.ones(0, bool), numbers
        if self.expected is None:
            self.expected = int(numbers[0])
        reached = np.maximum(np.maximum.accumulate(numbers + self._step), self.expected)
        before = np.concatenate([[self.expected], reached[:-1]])
        self.expected = int(reached[-1])
        return numbers >= before, before


class _CanDecoder:
    """What both decoders have: `ids` of the frames, and the account of those that are not delivered."""

    def __init__(self, config: StreamConfig, reference: TickReference, ids: Iterable[CanId], extended: bool) -> None:
        self.config = config
        self.counters = LossCounters()
        self.ids = tuple(each.pack(extended) for each in ids)
        self._reference = reference

    def _keep(self, good: Bools, *columns: NDArray[Any], malformed: bool = False) -> tuple[NDArray[Any], ...]:
        """Return the good rows of these columns; the others come again, late or too early, or are malformed."""
        if good.all():
            return columns
        bad = int(len(good) - good.sum())
        if malformed:
            self.counters.malformed += bad
        else:
            self.counters.out_of_order += bad
        return tuple(column[good] for column in columns)


class CanSampleDecoder(_CanDecoder):
    """Decodes the frames of one configured stream of samples."""

    def __init__(self, config: StreamConfig, layout: StreamLayout, reference: TickReference, extended: bool) -> None:
        slots = ((config.slot + n) % STREAM_SLOTS for n in range(len(layout.groups)))
        super().__init__(config, reference, (stream_id(config.node, slot) for slot in slots), extended)
        self._layout = layout
        self._ticks_per_sample = config.period_ticks * config.decimation
        self._ahead = max(layout.samples, round(AHEAD * config.tick_hz / self._ticks_per_sample))
        self._unit = config.decimation if layout.fd else 1  # what frames count, in samples
        self._bits = 8 * layout.counter
        self._orders = [_Order(layout.samples * self._unit) for _ in layout.groups]
        self._waiting = [(np.empty(0, np.int64), np.empty((0, b - a), np.uint8)) for a, b in layout.groups]
        self._next: int | None = None  # number of the sample that is delivered next

    def decode(self, frames: CanFrames) -> SampleChunk | None:
        """Return the samples of `frames`, or None if there are none."""
        near = self._number(frames.beats[-1].tick) * self._unit
        if frames.held and len(frames.beats) > 1:
            between = near - self._number(frames.beats[-2].tick) * self._unit
            if between >= 1 << self._bits - 1:  # nobody can tell when they were made
                self.counters.out_of_order += len(frames.records)
                return None
        for group, part in enumerate(self._sorted(frames.records)):
            if len(part):
                self._take(group, part, near)
        return self._deliver()

    def missing(self, first: Beat | None, last: Beat) -> int:
        """See `Decoder.missing`: of whole frames only, because STREAM_STOP sends no others."""
        if self._next is not None:
            start = self._next
        elif first is not None:
            start = self._number(first.tick) + 1
        else:
            return 0
        came = [order.expected // self._unit for order in self._orders if order.expected is not None]
        reached = max(came, default=start)  # of the group that got furthest: what waits for the others is lost
        frames = max(0, (self._number(last.tick) + 1 - reached) // self._layout.samples)
        return max(0, reached + frames * self._layout.samples - start)

    def _number(self, tick: int) -> int:
        """Number of the sample that is taken at a tick."""
        return (tick - self.config.tick0) // self._ticks_per_sample

    def _sorted(self, frames: NDArray[np.void]) -> list[NDArray[np.void]]:
        """Return the frames of each group, those of a wrong length left out."""
        parts: list[NDArray[Any]] = []
        for group, can_id in enumerate(self.ids):
            part = frames if len(self.ids) == 1 else frames[frames["id"] == can_id]
            parts += self._keep(part["length"] == self._layout.length(group), part, malformed=True)
        return parts

    def _low(self, frames: NDArray[np.void]) -> I64:
        data = np.ascontiguousarray(frames["data"][:, : self._layout.counter])
        return data.view("<u4" if self._layout.fd else "<u2")[:, 0].astype(np.int64)

    def _take(self, group: int, frames: NDArray[np.void], near: int) -> None:
        """Add what a group's frames hold to what waits; `near` as frames count."""
        layout, unit = self._layout, self._unit
        numbers = _from(near - (1 << self._bits - 1), self._low(frames), self._bits)
        frames, numbers = self._keep(numbers % unit == 0, frames, numbers, malformed=True)
        frames, numbers = self._keep(numbers <= near + self._ahead * unit, frames, numbers)
        passed, before = self._orders[group].follow(numbers)
        frames, numbers, before = self._keep(passed, frames, numbers // unit, before // unit)
        samples = layout.samples
        self.counters.frames += len(frames)
        self.counters.lost_by_seq += int((-(-(numbers - before) // samples)).sum())
        first, last = layout.groups[group]
        data = frames["data"][:, layout.counter : layout.used(group)].reshape(-1, last - first)
        if samples > 1:
            numbers = (numbers[:, None] + np.arange(samples)).reshape(-1)
        waiting, old = self._waiting[group]
        if len(waiting):
            numbers, data = np.concatenate([waiting, numbers]), np.concatenate([old, data])
        self._waiting[group] = numbers, data

    def _deliver(self) -> SampleChunk | None:
        """Return the samples of which every group has come."""
        waiting = self._waiting
        if len(waiting) == 1:
            numbers, packed = waiting[0]
            waiting[0] = numbers[:0], packed[:0]
        else:
            numbers, packed = self._complete()
        if not len(numbers):
            return None
        expected = int(numbers[0]) if self._next is None else self._next
        missing = np.diff(numbers, prepend=expected - 1) - 1
        gaps = tuple(
            Gap(int(at), int(missing[at]), -(-int(missing[at]) // self._layout.samples), False)
            for at in np.flatnonzero(missing)
        )
        self._next = int(numbers[-1]) + 1
        self.counters.samples += len(numbers)
        self.counters.lost_by_index += int(missing.sum())
        tick = self.config.tick0 + numbers * self._ticks_per_sample
        self._reference.sampled, self._reference.used = int(tick[-1]), True
        raw = np.ascontiguousarray(packed).view(self.config.dtype)[:, 0]
        return SampleChunk(self.config, numbers * self.config.decimation, tick, raw, gaps)

    def _complete(self) -> tuple[I64, NDArray[np.uint8]]:
        """Take the samples out of what waits that are whole, or will not become whole."""
        waiting = self._waiting
        reached = [int(numbers[-1]) if len(numbers) else -1 for numbers, _ in waiting]
        horizon = max(min(reached), max(reached) - WAIT)
        numbers = reduce(lambda a, b: np.intersect1d(a, b, assume_unique=True), (n for n, _ in waiting))
        numbers = numbers[numbers <= horizon]
        packed = np.empty((len(numbers), self.config.dtype.itemsize), np.uint8)
        for group, ((first, last), (all_numbers, data)) in enumerate(zip(self._layout.groups, waiting, strict=True)):
            packed[:, first:last] = data[np.searchsorted(all_numbers, numbers)]
            rest = all_numbers > horizon
            waiting[group] = all_numbers[rest], data[rest]
        return numbers, packed


class CanEdgeDecoder(_CanDecoder):
    """Decodes the frames of one configured stream of edges."""

    def __init__(self, config: StreamConfig, reference: TickReference, extended: bool) -> None:
        super().__init__(config, reference, [CanId(CanClass.EDGES, config.node, config.slot)], extended)
        self._order = _Order(1)
        self._last_tick = -1

    def decode(self, frames: CanFrames) -> EdgeChunk | None:
        """Return the edges of `frames`, or None if there are none."""
        counters, beat = self.counters, frames.beats[-1]
        fits = frames.records["length"] == EDGE_BYTES
        (data,) = self._keep(fits, frames.records["data"][:, :EDGE_BYTES], malformed=True)
        records = np.ascontiguousarray(data).view(EDGE_RECORD)[:, 0]
        for shift in dict.fromkeys((self._reference.shift, 0)):  # perhaps only heartbeats have jumped
            tick = TickReference(beat.tick, shift=shift).unwrap(records["tick"])
            newest = np.maximum.accumulate(np.concatenate([[self._last_tick], tick]))[:-1]
            believed = (tick >= newest) & (tick <= beat.tick + AHEAD * self.config.tick_hz)
            if believed.any():
                break
        off = tick[~believed] - beat.tick
        if self._reference.tick_hz and (np.abs(off) > AHEAD * 2 * self.config.tick_hz).any():
            self._reference.doubt(beat.tick, "Hall edges, which are left out,", float(off[np.abs(off).argmax()]))
        records, tick = self._keep(believed, records, tick)
        numbers, sure = self._place(records["flags"].astype(np.int64), tick, frames.beats)
        records, tick, numbers = self._keep(sure, records, tick, numbers)
        passed, before = self._order.follow(numbers)
        records, tick, numbers, before = self._keep(passed, records, tick, numbers, before)
        if not len(records):
            return None
        self._last_tick, self._reference.used = int(tick[-1]), True
        missing = numbers - before
        late = tick <= self._reference.sampled
        lost = int(missing.sum())
        counters.frames += len(records)
        counters.samples += len(records)
        counters.lost_by_index += lost
        counters.lost_by_seq += lost
        counters.late += int(late.sum())
        gaps = tuple(
            Gap(int(at), int(missing[at]), int(missing[at]), False) for at in np.flatnonzero((missing > 0) | late)
        )
        return unpack_edges(self.config, records, tick, numbers, gaps)

    def missing(self, first: Beat | None, last: Beat) -> int:
        """See `Decoder.missing`."""
        return missing_edges(self._order.expected, first, last)

    def _place(self, low: I64, tick: I64, beats: tuple[Beat, ...]) -> tuple[I64, Bools]:
        """Return the edges' numbers, and where they are sure.

        A heartbeat counts the edges up to its tick, so that two of them bound the numbers of those between.
        """
        ticks, edges = (np.array(column, np.int64) for column in zip(*beats, strict=True))
        after = np.searchsorted(ticks, tick, side="left")  # heartbeats before each edge
        fresh = round(FRESH * self.config.tick_hz)
        least = np.concatenate([[edges[0] - EDGE_RANGE], edges])[after]
        most = np.concatenate([edges, [edges[-1] + EDGE_RANGE]])[after]
        sure = (after > 0) | (tick > ticks[0] - fresh)
        stale = (after == len(beats)) & (tick > ticks[-1] + fresh)
        if stale.any():  # the last heartbeat is old: go on from the edge before, if there was one
            expected = self._order.expected
            sure &= ~stale | (expected is not None)
            least = np.where(stale, max(int(edges[-1]), expected or 0), least)
            most = np.where(stale, least + EDGE_RANGE, most)
        numbers = _from(least, low, 8)
        return numbers, sure & (most - least <= EDGE_RANGE) & (numbers < most)
