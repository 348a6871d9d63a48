"""Where a capture's records and Hall edges lie while it waits, and blob 1, which is made of them.

Records have numbers: the index of their PWM period over the decimation. They are taken in slices of what is pushed,
never one by one. This module knows no triggers and no messages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from protocol.device.records import Rows, Run
from protocol.streams import EDGE_RECORD

EDGE_BYTES = EDGE_RECORD.itemsize


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


class Ring:
    """The records and edges of one capture.

    Args:
        size: what it holds.
        runs: bytes of its channels in a full sample.
        period: ticks of a PWM period.
        tick0: tick of PWM period 0; what is pushed tells it anew.
        edges_seen: Hall edges since boot.
    """

    def __init__(self, size: Size, runs: list[Run], period: int, tick0: int, edges_seen: int) -> None:
        self._size = size
        self._runs = runs
        self._capacity = size.before + size.after
        self._rows = np.empty((self._capacity, sum(run.stop - run.start for run in runs)), np.uint8)
        self._counts = np.zeros(self._capacity, np.int64)  # edges since boot before each record
        self._period = period
        self._origin = tick0
        self._begun = False
        self._low = self._high = 0  # numbers of the first record that was taken, and of the one that comes next
        self._next = 0  # index of the period that comes next
        self._at: int | None = None  # number of the trigger's record
        self._edges: list[tuple[NDArray[np.int64], NDArray[np.void]]] = []  # whole ticks, and as they came
        self._edges_before = edges_seen  # edges since boot before those

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
        self._begun = False
        return True

    def trigger(self, index: int) -> None:
        """The trigger has come in the period `index`, which may have been taken already, or before there were any."""
        self._at = -(-index // self._size.decimation)
        if self._begun:
            self._at = max(self._at, self._oldest)

    def period_from(self, tick: int) -> int:
        """Return the index of the first period that is not before a tick."""
        return max(0, -((self._origin - tick) // self._period))

    def push_edges(self, ticks: NDArray[np.int64], records: NDArray[np.void]) -> None:
        """Take edges in order of time, EDGE_RECORDs, and their whole ticks."""
        self._edges.append((ticks, records.copy()))

    def push(self, index0: int, tick0: int, rows: Rows) -> None:
        """Take consecutive periods, in rows of the device's full samples."""
        decimation = self._size.decimation
        self._origin = tick0 - index0 * self._period
        self._next = index0 + len(rows)
        if not self._begun:
            self._begun = True
            self._low = self._high = -(-index0 // decimation)
            if self._at is not None:
                self._at = max(self._at, self._low)
        end = -(-self._next // decimation)
        if self._at is not None:
            end = min(end, self._at + self._size.after)
        for first, last in self._around(max(self._high, end - self._capacity), end):
            place = self._place(first, last)
            chosen = rows[first * decimation - index0 : (last - 1) * decimation - index0 + 1 : decimation]
            at = 0
            for run in self._runs:
                width = run.stop - run.start
                self._rows[place, at : at + width] = chosen[:, run]
                at += width
            self._counts[place] = (
                self._edges_up_to(np.arange(first, last), "left") if self._edges else self._edges_before
            )
        self._high = max(self._high, end)
        if self._edges:
            self._forget_edges()

    def freeze(self) -> Blob:
        """Make blob 1 of what there is around the trigger's record."""
        assert self._at is not None
        size = self._size
        begin, end = max(self._oldest, self._at - size.before), min(self._high, self._at + size.after)
        parts = [self._rows[self._place(*part)].tobytes() for part in self._around(begin, end)]
        before = int(self._counts[begin % self._capacity])
        upto = int(self._edges_up_to(np.array([end - 1]), "right")[0])
        kept = max(0, min(size.edges, upto - max(before, self._edges_before)))
        first_edge = upto - kept if kept else 0
        if kept:
            records = np.concatenate([each for _, each in self._edges])
            parts.append(records[first_edge - self._edges_before :][:kept].tobytes())
        data, index = b"".join(parts), self._at * size.decimation
        return Blob(
            data=data,
            crc=crc32(data),
            first=self._at - begin,
            records=end - begin,
            edges=kept,
            edges_lost=upto - before - kept,
            first_edge=first_edge,
            tick=self._origin + index * self._period,
            index=index,
        )

    @property
    def _oldest(self) -> int:
        """Number of the oldest record that is still there."""
        return max(self._low, self._high - self._capacity)

    def _place(self, first: int, last: int) -> slice:
        """Where records lie, in one piece: see `_around`."""
        return slice(first % self._capacity, first % self._capacity + last - first)

    def _around(self, begin: int, end: int) -> list[tuple[int, int]]:
        """Return the parts of the numbers from `begin` up to `end` that lie in one piece."""
        turn = begin - begin % self._capacity + self._capacity
        return [(a, b) for a, b in ((begin, min(end, turn)), (turn, end)) if a < b]

    def _edges_up_to(self, records: NDArray[np.int64], side: Literal["left", "right"]) -> NDArray[np.int64]:
        """Return how many edges since boot came before (`left`) or up to (`right`) each record."""
        ticks = self._origin + records * (self._size.decimation * self._period)
        known = [each for each, _ in self._edges]
        found = np.searchsorted(np.concatenate(known), ticks, side) if known else np.zeros(len(records), np.int64)
        return self._edges_before + found

    def _forget_edges(self) -> None:
        """Give up edges that no capture can have: the newest up to the last record are enough."""
        last = self._origin + (self._high - 1) * self._size.decimation * self._period
        old = sum(int(np.searchsorted(ticks, last, "right")) for ticks, _ in self._edges)
        while self._edges and old - len(self._edges[0][0]) >= self._size.edges:
            gone = len(self._edges.pop(0)[0])
            old -= gone
            self._edges_before += gone
