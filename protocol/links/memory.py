"""Two links joined in memory, with faults to order: for tests, and for a device in the same process.

On a `VirtualClock` a read that finds nothing moves the clock on instead of waiting, so that a test of
time-outs takes no time and comes out the same each time. Without one, the clock is the machine's and a read
waits for the other thread.
"""

from __future__ import annotations

import random
import threading
import time
from collections import deque
from dataclasses import dataclass, field

from protocol.errors import LinkClosed, LinkNotFound
from protocol.links.base import MAX_READ
from protocol.wire import ByteWire, HostWire


@dataclass(slots=True)
class VirtualClock:
    """A clock that moves only when told to; seconds."""

    now: float = 0.0


@dataclass(slots=True)
class Faults:
    """What a wire does to the bytes of one direction; may be changed while in use."""

    drop: float = 0.0
    """Probability that a byte is lost."""
    corrupt: float = 0.0
    """Probability that a byte arrives as another value."""
    delay: float = 0.0
    """Seconds from `write` until the bytes can be read."""


@dataclass(slots=True)
class _Wire:
    faults: Faults
    random: random.Random
    queue: deque[tuple[float, bytes]] = field(default_factory=deque)

    def spoil(self, data: bytes) -> bytes:
        drop, corrupt = self.faults.drop, self.faults.corrupt
        if drop <= 0.0 and corrupt <= 0.0:
            return data
        chance = self.random.random
        kept = bytearray()
        for byte in data:
            if chance() < drop:
                continue
            kept.append(byte ^ self.random.randrange(1, 256) if chance() < corrupt else byte)
        return bytes(kept)


@dataclass(slots=True)
class _Shared:
    clock: VirtualClock | None
    changed: threading.Condition = field(default_factory=threading.Condition)
    plugged: bool = True


class MemoryLink:
    """One end of a `memory_pair`."""

    def __init__(self, name: str, shared: _Shared, incoming: _Wire, outgoing: _Wire) -> None:
        self._name = name
        self._shared = shared
        self._in = incoming
        self._out = outgoing
        self._open = True

    @property
    def name(self) -> str:
        """The link as errors show it."""
        return self._name

    @property
    def faults(self) -> Faults:
        """What happens to the bytes that this end writes."""
        return self._out.faults

    def clock(self) -> float:
        """See `Link.clock`."""
        clock = self._shared.clock
        return time.monotonic() if clock is None else clock.now

    def wire(self) -> HostWire:
        """See `Link.wire`."""
        return ByteWire()

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """See `Link.read`."""
        with self._shared.changed:
            if not self._wait_for_byte(self.clock() + max(0.0, timeout)):
                return b""
            if settle > 0.0:
                self._pass_time(self.clock() + settle)
            return self._take()

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        with self._shared.changed:
            self._require_plugged()
            spoilt = self._out.spoil(bytes(data))
            if spoilt:
                self._out.queue.append((self.clock() + self._out.faults.delay, spoilt))
            self._shared.changed.notify_all()

    def unplug(self) -> None:
        """Pull the cable: both ends lose what is under way and fail until `plug` and their `reopen`."""
        with self._shared.changed:
            self._shared.plugged = False
            self._in.queue.clear()
            self._out.queue.clear()
            self._shared.changed.notify_all()

    def plug(self) -> None:
        """Put the cable back; each end has to `reopen`."""
        with self._shared.changed:
            self._shared.plugged = True

    def close(self) -> None:
        """See `Link.close`."""
        self._open = False

    def reopen(self) -> None:
        """See `Link.reopen`."""
        with self._shared.changed:
            if not self._shared.plugged:
                raise LinkNotFound(f"{self._name} is unplugged")
            self._open = True

    def _require_plugged(self) -> None:
        if not self._shared.plugged:
            self._open = False
            raise LinkClosed(f"{self._name} is gone: unplugged")
        if not self._open:
            raise LinkClosed(f"{self._name} is closed")

    def _wait_for_byte(self, deadline: float) -> bool:
        while True:
            self._require_plugged()
            queue = self._in.queue
            due = queue[0][0] if queue else deadline
            now = self.clock()
            if queue and due <= now:
                return True
            if now >= deadline:
                return False
            self._pass_time(min(due, deadline), any_change=True)

    def _pass_time(self, until: float, any_change: bool = False) -> None:
        clock = self._shared.clock
        if clock is not None:
            clock.now = max(clock.now, until)
            return
        while (left := until - time.monotonic()) > 0.0:
            if self._shared.changed.wait(left) and any_change:
                return

    def _take(self) -> bytes:
        queue, now = self._in.queue, self.clock()
        parts = bytearray()
        while queue and queue[0][0] <= now and len(parts) < MAX_READ:
            due, part = queue.popleft()
            free = MAX_READ - len(parts)
            if len(part) > free:
                queue.appendleft((due, part[free:]))
            parts += part[:free]
        return bytes(parts)


def memory_pair(clock: VirtualClock | None = None, seed: int = 0) -> tuple[MemoryLink, MemoryLink]:
    """Two ends of one cable, `memory:a` and `memory:b`, each with its own `faults` on what it writes."""
    shared = _Shared(clock)
    wires = [_Wire(Faults(), random.Random(seed + n)) for n in range(2)]
    return (
        MemoryLink("memory:a", shared, wires[1], wires[0]),
        MemoryLink("memory:b", shared, wires[0], wires[1]),
    )
