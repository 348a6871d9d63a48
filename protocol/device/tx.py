"""The device's transmit queue: bounded, replies before streams, whole frames or nothing.

Stream frames that find no room are refused, so that their stream can count them. Replies have room of their
own. A frame of which a part has gone out is always finished first. This module never looks into a frame.
"""

from __future__ import annotations

from collections import deque


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
        self._bulk: deque[bytes] = deque()
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

    def put_bulk(self, wire: bytes) -> bool:
        """Queue a stream's frame; False, and nothing queued, if there is no room."""
        size = self._bulk_bytes + len(wire)
        if size > self.bulk_limit:
            return False
        self._bulk_bytes = size
        self._bulk.append(wire)
        self._queued += 1
        return True

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
            parts = [self._rest, *self._control, *self._latest.values(), *self._bulk]
            self._rest = b""
            self._control.clear()
            self._latest.clear()
            self._gone += len(self._bulk)
            self._bulk.clear()
            self._control_bytes = self._bulk_bytes = 0
            return b"".join(parts)
        parts = [self._rest]
        size = len(self._rest)
        while size < limit:
            wire = self._pop()
            if not wire:
                break
            parts.append(wire)
            size += len(wire)
        data = b"".join(parts)
        self._rest = data[limit:]
        return data[:limit]

    def _pop(self) -> bytes:
        if self._control:
            wire = self._control.popleft()
            self._control_bytes -= len(wire)
        elif self._latest:
            wire = self._latest.pop(next(iter(self._latest)))
        elif self._bulk:
            wire = self._pop_bulk()
        else:
            wire = b""
        return wire

    def _pop_bulk(self) -> bytes:
        wire = self._bulk.popleft()
        self._bulk_bytes -= len(wire)
        self._gone += 1
        return wire

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
