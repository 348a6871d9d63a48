"""Where a capture's records and Hall edges lie while it waits, and blob 1, which is made of them.

Records have numbers: the index of their PWM period over the decimation. What is pushed is kept as it came, and packed
many periods at once, or, of the newest, not before the capture is complete: a capture that waits costs next to nothing.
This module knows no triggers and no messages.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from protocol.device.records import LateSamples, Rows, Samples, Values, made, rows_of
from protocol.signals import Signal
from protocol.streams import EDGE_RECORD

EDGE_BYTES = EDGE_RECORD.itemsize
AS_THEY_CAME = 8192  # periods that are kept as they were pushed
LOOK = 1024  # periods after which it looks for what is too old
MOST_EDGES = 1 << 16  # edges that are kept only to be counted


class Size(NamedTuple):
    """What a capture holds: records before the trigger's and from it on, and edges; `decimation` of the records."""

    before: int
    after: int
    edges: int
    decimation: int


@dataclass(frozen=True, slots=True)
class Blob:
    """Blob 1, and what CAPTURE_STATUS says of it."""

    data: bytes
    crc: int
    first: int
    records: int
    edges: int
    edges_lost: int
    first_edge: int
    tick: int
    index: int


class _Pushed(NamedTuple):
    """Consecutive periods as they came."""

    first: int  # index
    samples: Samples


class Ring:
    """The records and edges of one capture.

    Args:
        size: what it holds.
        dtype: of the device's samples.
        channels: those of its records.
        period: ticks of a PWM period.
        tick0: tick of PWM period 0; what is pushed tells it anew.
        edges_seen: Hall edges since boot.
    """

    def __init__(
        self, size: Size, dtype: np.dtype[np.void], channels: Sequence[Signal], period: int, tick0: int, edges_seen: int
    ) -> None:
        self._size = size
        self._dtype = dtype
        self._channels = channels
        self._names = frozenset(channel.name for channel in channels)
        self._period = period
        self._origin = tick0
        self._edges = _Edges(size.edges, edges_seen)
        self._at: int | None = None  # number of the trigger's record
        self._clear()

    def _clear(self) -> None:
        self._begun = False
        self._pushed: deque[_Pushed] = deque()
        self._periods = self._enough = 0  # in those, and with how many it looks for what is too old
        self._packed: deque[tuple[int, Rows]] = deque()  # number of the first record, and records
        self._oldest = self._high = 0  # numbers of the oldest record that is held, and of the one that comes next
        self._next = 0  # index of the period that comes next

    @property
    def complete(self) -> bool:
        """Whether the trigger has come, and all records that were to follow it."""
        return self._begun and self._at is not None and self._high >= self._at + self._size.after

    def continues(self, index0: int) -> bool:
        """Whether the period `index0` is the one that follows the last, or the first of all."""
        return not self._begun or index0 == self._next

    def restart(self) -> bool:
        """Periods are missing, so that all begins anew; False if the trigger's record has been taken already."""
        if self._at is not None and self._high > self._at:
            return False
        self._clear()
        return True

    def trigger(self, index: int) -> None:
        """The trigger has come in the period `index`, which may have been taken already, or before there were any."""
        self._at = -(-index // self._size.decimation)
        if self._begun:
            self._at = max(self._at, self._oldest)

    def period_from(self, tick: int) -> int:
        """Return the index of the first period that is not before a tick."""
        return max(0, -((self._origin - tick) // self._period))

    def push_edges(self, records: NDArray[np.void], ticks: NDArray[np.int64]) -> None:
        """Take edges in order of time, EDGE_RECORDs, and their 64-bit ticks."""
        self._edges.push(records, ticks)

    def push(self, index0: int, tick0: int, samples: Samples) -> None:
        """Take consecutive periods."""
        size = self._size
        self._origin = tick0 - index0 * self._period
        if not self._begun:
            self._begun = True
            self._oldest = -(-index0 // size.decimation)
            if self._at is not None:
                self._at = max(self._at, self._oldest)
        if isinstance(samples, LateSamples):
            samples = samples.kept(self._names)
        self._pushed.append(_Pushed(index0, samples))
        self._periods += len(samples)
        self._next = index0 + len(samples)
        self._high = -(-self._next // size.decimation)
        self._oldest = max(self._oldest, (self._high - size.after if self._at is None else self._at) - size.before)
        if self._periods > self._enough:
            self._forget()
            if self._periods > AS_THEY_CAME:
                self._pack()
            self._enough = self._periods + LOOK

    def freeze(self) -> Blob:
        """Make blob 1 of what there is around the trigger's record."""
        assert self._at is not None
        size = self._size
        begin, end = max(self._oldest, self._at - size.before), min(self._high, self._at + size.after)
        self._pack()
        parts = [rows[max(0, begin - first) : end - first].tobytes() for first, rows in self._packed if first < end]
        edges, first_edge, lost = self._edges.between(self._tick_of(begin), self._tick_of(end - 1))
        data = b"".join([*parts, edges])
        return Blob(
            data=data,
            crc=crc32(data),
            first=self._at - begin,
            records=end - begin,
            edges=len(edges) // EDGE_BYTES,
            edges_lost=lost,
            first_edge=first_edge,
            tick=self._tick_of(self._at),
            index=self._at * size.decimation,
        )

    def _tick_of(self, record: int) -> int:
        return self._origin + record * self._size.decimation * self._period

    def _forget(self) -> None:
        """Give up what is older than the oldest record."""
        oldest = self._oldest * self._size.decimation
        while self._pushed and self._pushed[0].first + len(self._pushed[0].samples) <= oldest:
            self._periods -= len(self._pushed.popleft().samples)
        while self._packed and self._packed[0][0] + len(self._packed[0][1]) <= self._oldest:
            self._packed.popleft()
        self._edges.forget(self._tick_of(self._oldest))

    def _pack(self) -> None:
        """Make records of the periods that are there as they came."""
        if not self._pushed:
            return
        values = Values(self._dtype, self._channels, self._size.decimation)
        taken = [
            values.take(index, rows_of(made(samples, self._names), self._dtype)) for index, samples in self._pushed
        ]
        rows = np.concatenate([each for _, each in taken])
        if len(rows):
            self._packed.append((taken[0][0] // self._size.decimation, rows))
        self._pushed.clear()
        self._periods = 0


class _Edges:
    """Hall edges that a capture may need: those of its time, the newest of which have `room`."""

    def __init__(self, room: int, seen: int) -> None:
        self._room = room
        self._before = seen  # edges since boot before those that are held
        self._held: deque[tuple[NDArray[np.int64], NDArray[np.void]]] = deque()  # ticks and edges, as they came
        self._n = 0
        self._crowded_out = (-1, 0)  # tick of the last that was given up for lack of room, and how many were

    def push(self, records: NDArray[np.void], ticks: NDArray[np.int64]) -> None:
        """Take edges in order of time, and their ticks."""
        self._held.append((ticks, records))
        self._n += len(records)
        while self._n > self._room + MOST_EDGES and len(self._held) > 1:
            self._crowded_out = int(self._held[0][0][-1]), self._crowded_out[1] + self._drop()

    def forget(self, tick: int) -> None:
        """Give up edges before a tick."""
        while self._held and self._held[0][0][-1] < tick:
            self._drop()
        if self._crowded_out[0] < tick:
            self._crowded_out = -1, 0

    def _drop(self) -> int:
        gone = len(self._held.popleft()[1])
        self._n -= gone
        self._before += gone
        return gone

    def between(self, first: int, last: int) -> tuple[bytes, int, int]:
        """Return the edges from one tick to another that have room, the first one's number, and how many have none."""
        last_lost, lost = self._crowded_out
        lost = lost if last_lost >= first else 0
        if not self._held:
            return b"", 0, lost
        ticks, records = (np.concatenate(each) for each in zip(*self._held, strict=True))
        begin, end = np.searchsorted(ticks, first, "left"), np.searchsorted(ticks, last, "right")
        kept = min(self._room, int(end - begin))
        number = self._before + int(end) - kept if kept else 0
        return records[end - kept : end].tobytes(), number, lost + int(end - begin) - kept
