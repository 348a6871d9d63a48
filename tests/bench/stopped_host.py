"""A link in virtual time whose host is stopped at random moments: time jumps, and the device goes on."""

from __future__ import annotations

import random
from collections.abc import Callable

from protocol.links import Link
from protocol.wire import HostWire


class StoppedHost:
    """Passes all on to `link`; `stops` times so often that it happens all over `calls` calls, for 0.1 to 2 s each.

    `idle` lets so many s pass on the link without a look at it.
    """

    def __init__(self, link: Link, idle: Callable[[float], None], stops: int, calls: int, seed: int) -> None:
        self._link, self._idle = link, idle
        self._dice = random.Random(seed)
        self._at = set(self._dice.sample(range(calls), stops))
        self.calls = 0
        self.stopped: list[float] = []
        self.name = link.name

    def _call(self) -> None:
        self.calls += 1
        if self.calls in self._at:
            seconds = self._dice.uniform(0.1, 2.0)
            self.stopped.append(seconds)
            self._idle(seconds)

    def clock(self) -> float:
        self._call()
        return self._link.clock()

    def wire(self) -> HostWire:
        return self._link.wire()

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        self._call()
        return self._link.read(timeout, settle)

    def write(self, data: bytes) -> None:
        self._call()
        self._link.write(data)

    def close(self) -> None:
        self._link.close()

    def reopen(self) -> None:
        self._link.reopen()
