"""The device's transmit queue: bounded, replies before streams, whole frames or nothing.

Stream frames that find no room are refused, so that their stream can count them. Replies have room of their
own. A frame of which a part has gone out is always finished first. This module never looks into a frame.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence


class TxQueue:
    """Frames that wait for the link.

    `bulk_limit`, `control_limit`: bytes that may wait, of streams and of everything else. `capacity`:
    bytes/s that the link carries, None where it is unknown; `rates` holds what each stream, by (node,
    stream), is to need of it.
    """

    def __init__(self, bulk_limit: int = 1 << 16, control_limit: int = 1 << 13, capacity: float | None = None) -> None:
        self.bulk_limit = bulk_limit
        self.control_limit = control_limit
        self.capacity = capacity
        self.rates: dict[tuple[int, int], float] = {}
        self._bulk: deque[tuple[bytes, Sequence[int]]] = deque()  # frames that were queued at once, where each ends
        self._first = self._begin = 0  # the next of the first such batch, and where it begins
        self._stamps: deque[tuple[int, int]] = deque()  # how many stream frames had been queued when, by `expire`
        self._queued = self._gone = 0  # stream frames ever queued, and taken or given up
        self._control: deque[bytes] = deque()
        self._latest: dict[int, bytes] = {}
        self._rest = b""
        self._bulk_bytes = 0
        self._control_bytes = 0

    def __len__(self) -> int:
        """Bytes that wait."""
        latest = sum(map(len, self._latest.values()))
        return len(self._rest) + self._bulk_bytes + self._control_bytes + latest

    def put_bulk(self, wire: bytes, ends: Sequence[int]) -> int:
        """Queue a stream's frames, of which each ends where `ends` says; return how many found room, the first ones."""
        room = self.bulk_limit - self._bulk_bytes
        n = len(ends) if len(wire) <= room else bisect_right(ends, room)
        if n:
            self._bulk.append((wire, ends[:n]))
            self._bulk_bytes += ends[n - 1]
            self._queued += n
        return n

    def put_control(self, wire: bytes) -> bool:
        """Queue a reply; False, and nothing queued, if there is no room."""
        size = self._control_bytes + len(wire)
        if size > self.control_limit:
            return False
        self._control_bytes = size
        self._control.append(wire)
        return True

    def put_event(self, wire: bytes) -> bool:
        """Queue an event or a log, which must leave half of the room to replies; False if it cannot."""
        return self._control_bytes + len(wire) <= self.control_limit // 2 and self.put_control(wire)

    def put_latest(self, key: int, wire: bytes) -> None:
        """Queue a frame in place of the last one with this key, if that still waits (heartbeats)."""
        self._latest[key] = wire

    def take(self, limit: int | None = None) -> bytes:
        """Return and forget the next bytes, at most `limit`."""
        if limit is None:
            limit = len(self)
        parts = [self._rest]
        size = len(self._rest)
        while size < limit:
            wire = self._pop(limit - size)
            if not wire:
                break
            parts.append(wire)
            size += len(wire)
        data = b"".join(parts)
        self._rest = data[limit:]
        return data[:limit]

    def _pop(self, size: int) -> bytes:
        """Return and forget the next frame, of those of a stream as many as make `size` bytes, if they lie together."""
        if self._control:
            wire = self._control.popleft()
            self._control_bytes -= len(wire)
        elif self._latest:
            wire = self._latest.pop(next(iter(self._latest)))
        elif self._bulk:
            wire = self._pop_bulk(size)
        else:
            wire = b""
        return wire

    def _pop_bulk(self, size: int = 1) -> bytes:
        wire, ends = self._bulk[0]
        begin, first = self._begin, self._first
        n = min(bisect_left(ends, begin + size, first) + 1, len(ends))
        end = ends[n - 1]
        self._first, self._begin = n, end
        if n == len(ends):
            self._bulk.popleft()
            self._first = self._begin = 0
        self._bulk_bytes -= end - begin
        self._gone += n - first
        return wire[begin:end]

    def expire(self, now: int, age: int) -> int:
        """Give up stream frames that have waited longer than `age`; return how many.

        To be called at every step, with `now` and `age` in the device's ticks: a frame's age is counted from the
        call that follows its being queued.
        """
        old = 0
        while self._stamps and now - self._stamps[0][1] > age:
            old = self._stamps.popleft()[0]
        given_up = max(0, old - self._gone)
        for _ in range(given_up):
            self._pop_bulk()
        self._stamps.append((self._queued, now))
        return given_up
