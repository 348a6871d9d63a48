"""Stream frames on the host: from rows of CAN_RECORDs to chunks, with every loss counted.

A frame carries only the low bits of its number. They are continued from the frame before, which is sound as long as
heartbeats come in between; what comes after a silence is held back (see `protocol.canmap.host`) and comes with an
`Anchor`, the heartbeat that ended it: what does not agree with that is given up. A frame that is repeated, late or of
another length is counted and never delivered. This module knows no link, no session and no transfers.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.canmap.ids import STREAM_SLOTS, CanClass, CanId, stream_id
from protocol.canmap.layout import EDGE_BYTES, StreamLayout
from protocol.streams import (
    EDGE_ILLEGAL,
    EDGE_RECORD,
    I64,
    EdgeChunk,
    Gap,
    LossCounters,
    SampleChunk,
    StreamConfig,
    TickReference,
)

WAIT = 256  # samples for which a silent group of channels is waited for
AHEAD = 0.5  # s that a sample may be ahead of the newest heartbeat

Bools = NDArray[np.bool_]


class Anchor(NamedTuple):
    """A heartbeat's device time and count of edges: surely newer than the frames it comes with, but not by much."""

    tick: int
    edges: int


class CanFrames(NamedTuple):
    """CAN_RECORDs of one stream as they came; `anchor` if they were held back."""

    records: NDArray[np.void]
    anchor: Anchor | None = None


class _Counter:
    """Continues a number of which frames carry the low `bits`; each frame holds `step` records.

    Up to a quarter of the range back is late, all other is ahead.
    """

    def __init__(self, bits: int, step: int) -> None:
        self._range = 1 << bits
        self._step = step
        self._piece = max(1, (self._range >> 2) // step)
        self._expected: int | None = None
        self._base = 0
        self._continues = False

    def _ahead(self, low: NDArray[np.int64] | int, expected: int, behind: int) -> I64:
        return np.asarray((low - expected + behind & self._range - 1) - behind)

    def agrees(self, low: I64, near: int) -> bool:
        """Whether frames that continue what was before end about at `near`; if not, the next ones start anew there."""
        expected = self._expected
        if expected is None or not len(low):
            return True
        last = expected
        for value in (*low[:: self._piece].tolist(), int(low[-1])):
            last += int(self._ahead(value, last, self._range >> 2))
        self._continues = abs(near - last) < self._range >> 1
        return self._continues

    def restart(self) -> None:
        """Take the next number from where it should be about, not from the one before."""
        self._continues = False

    def place(self, low: I64, near: int, limit: int | None) -> tuple[I64, Bools, I64]:
        """Return the whole number of each frame, whether it is accepted, and what was expected before it.

        `near`: about where a first frame is. Numbers above `limit` are not accepted.
        """
        if not self._continues:
            start = near + int(self._ahead(int(low[0]), near, self._range >> 1))
            self._base = start if self._expected is None else max(start, self._expected)
            self._continues = True
            if self._expected is None:
                self._expected = start
        else:
            assert self._expected is not None
            self._base = self._expected
        pieces = [self._place(low[n : n + self._piece], limit) for n in range(0, len(low), self._piece)]
        if len(pieces) == 1:
            return pieces[0]
        numbers, accepted, before = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
        return numbers, accepted, before

    def _place(self, low: I64, limit: int | None) -> tuple[I64, Bools, I64]:
        assert self._expected is not None
        numbers = self._base + self._ahead(low, self._base, self._range >> 2)
        ends = numbers + self._step
        if limit is not None:
            ends = np.where(numbers <= limit, ends, self._expected)
        reached = np.maximum(np.maximum.accumulate(ends), self._expected)
        before = np.concatenate([[self._expected], reached[:-1]])
        accepted = numbers >= before
        if limit is not None:
            accepted &= numbers <= limit
        self._expected = self._base = int(reached[-1])
        return numbers, accepted, before


class CanSampleDecoder:
    """Decodes the frames of one configured stream of samples.

    `ticks_per_period`: device ticks in a PWM period (HELLO's tick_hz / pwm_hz).
    """

    def __init__(
        self,
        config: StreamConfig,
        layout: StreamLayout,
        tick_hz: int,
        ticks_per_period: int,
        reference: TickReference,
        extended: bool,
    ) -> None:
        self.config = config
        self.counters = LossCounters()
        slots = ((config.slot + n) % STREAM_SLOTS for n in range(len(layout.groups)))
        self.ids = tuple(stream_id(config.node, slot).pack(extended) for slot in slots)
        self._layout = layout
        self._ticks_per_sample = ticks_per_period * config.decimation
        self._ahead = max(layout.samples, round(AHEAD * tick_hz / self._ticks_per_sample))
        self._reference = reference
        self._unit = config.decimation if layout.fd else 1  # what frames count, in samples
        bits = 8 * layout.counter
        self._counters = [_Counter(bits, layout.samples * self._unit) for _ in layout.groups]
        self._waiting = [(np.empty(0, np.int64), np.empty((0, b - a), np.uint8)) for a, b in layout.groups]
        self._next: int | None = None  # number of the sample that is delivered next

    def decode(self, frames: CanFrames) -> SampleChunk | None:
        """Return the samples of `frames`, or None if there are none."""
        parts, anchor = self._sorted(frames.records), frames.anchor
        if anchor is not None:
            near = self._number(anchor.tick) * self._unit
            agreed = [
                counter.agrees(self._low(part), near) for counter, part in zip(self._counters, parts, strict=True)
            ]
            if not all(agreed):
                self.counters.out_of_order += sum(map(len, parts))
                for counter in self._counters:
                    counter.restart()
                self._waiting = [(numbers[:0], data[:0]) for numbers, data in self._waiting]
                return None
        for group, part in enumerate(parts):
            if len(part):
                self._take(group, part)
        return self._deliver()

    def _number(self, tick: int) -> int:
        """Number of the sample that is taken at a tick."""
        return (tick - self.config.tick0) // self._ticks_per_sample

    def _sorted(self, frames: NDArray[np.void]) -> list[NDArray[np.void]]:
        """Return the frames of each group, those of a wrong length left out."""
        parts = []
        for group, can_id in enumerate(self.ids):
            part = frames if len(self.ids) == 1 else frames[frames["id"] == can_id]
            fits = part["length"] == self._layout.length(group)
            if not fits.all():
                self.counters.malformed += int(len(fits) - fits.sum())
                part = part[fits]
            parts.append(part)
        return parts

    def _low(self, frames: NDArray[np.void]) -> I64:
        data = np.ascontiguousarray(frames["data"][:, : self._layout.counter])
        return data.view("<u4" if self._layout.fd else "<u2")[:, 0].astype(np.int64)

    def _take(self, group: int, frames: NDArray[np.void]) -> None:
        """Add what a group's frames hold to what waits."""
        layout, counters, unit = self._layout, self.counters, self._unit
        near = self._number(self._reference.tick)
        numbers, accepted, before = self._counters[group].place(
            self._low(frames), near * unit, (near + self._ahead) * unit
        )
        counters.out_of_order += int(len(accepted) - accepted.sum())
        if unit > 1:
            uneven = accepted & (numbers % unit != 0)
            counters.malformed += int(uneven.sum())
            accepted &= ~uneven
            numbers, before = numbers // unit, before // unit
        if not accepted.all():
            frames, numbers, before = frames[accepted], numbers[accepted], before[accepted]
        if not len(frames):
            return
        samples = layout.samples
        counters.frames += len(frames)
        counters.lost_by_seq += int((-(-(numbers - before) // samples)).sum())
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
        self._reference.sampled = int(tick[-1])
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


class CanEdgeDecoder:
    """Decodes the frames of one configured stream of edges."""

    def __init__(self, config: StreamConfig, reference: TickReference, extended: bool) -> None:
        self.config = config
        self.counters = LossCounters()
        self.ids = (CanId(CanClass.EDGES, config.node, config.slot).pack(extended),)
        self._reference = reference
        self._counter = _Counter(8, 1)
        self._last_tick = -1

    def decode(self, frames: CanFrames) -> EdgeChunk | None:
        """Return the edges of `frames`, or None if there are none."""
        counters, anchor = self.counters, frames.anchor
        fits = frames.records["length"] == EDGE_BYTES
        counters.malformed += int(len(fits) - fits.sum())
        records = np.ascontiguousarray(frames.records["data"][fits][:, :EDGE_BYTES]).view(EDGE_RECORD)[:, 0]
        if anchor is not None and not self._counter.agrees(records["flags"].astype(np.int64), anchor.edges):
            counters.out_of_order += len(records)
            self._counter.restart()
            return None
        tick = self._reference.unwrap(records["tick"])
        newest = np.maximum.accumulate(np.concatenate([[self._last_tick], tick]))
        fresh = self._counted(tick >= newest[:-1])
        records, tick = records[fresh], tick[fresh]
        if not len(records):
            return None
        low = records["flags"].astype(np.int64)
        numbers, accepted, before = self._counter.place(low, self._reference.edges, None)
        accepted = self._counted(accepted)
        records, tick, numbers, before = records[accepted], tick[accepted], numbers[accepted], before[accepted]
        if not len(records):
            return None
        self._last_tick = int(tick[-1])
        missing = numbers - before
        late = tick <= self._reference.sampled
        lost = int(missing.sum())
        counters.frames += len(records)
        counters.samples += len(records)
        counters.lost_by_index += lost
        counters.lost_by_seq += lost
        counters.late += int(late.sum())
        codes = records["codes"]
        return EdgeChunk(
            config=self.config,
            tick=tick,
            hall_old=(codes & 7).astype(np.uint8),
            hall_new=(codes >> 3 & 7).astype(np.uint8),
            illegal=(codes & EDGE_ILLEGAL) != 0,
            encoder=records["encoder"].copy(),
            index=numbers,
            gaps=tuple(
                Gap(int(at), int(missing[at]), int(missing[at]), False) for at in np.flatnonzero((missing > 0) | late)
            ),
        )

    def _counted(self, keep: Bools) -> Bools:
        """Count the frames that come again, or late."""
        self.counters.out_of_order += int(len(keep) - keep.sum())
        return keep
