"""Collects what arrives from the drive into blocks, so that rerun gets few and large messages.

A block closes when it holds `period` seconds of device time, or when its first item is `period` seconds old by the
host's clock: a drive that only sends heartbeats is logged too. Adding costs a list append; nothing is copied, and
nothing is decided here about queues, threads or rerun. Losses are counted here, as items arrive, so that blocks that
a live view has to drop do not spoil the account.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

from bench.device.heard import Heard
from bench.device.losses import LossAccount
from protocol.streams import EdgeChunk, SampleChunk

Kind = TypeVar("Kind", bound=Heard)


@dataclass(slots=True)
class Block:
    """What arrived during one period, in order; a clock that has restarted did so before all of it.

    `arrivals`: host time of each chunk of samples, that of its first sample (None where it is not known), and samples.
    `losses`: counters of the run so far.
    """

    items: list[Heard] = field(default_factory=list)
    arrivals: list[tuple[float, float | None, int]] = field(default_factory=list)
    losses: dict[str, int] = field(default_factory=dict)

    def of(self, kind: type[Kind]) -> list[Kind]:
        """Its items of this kind."""
        return [item for item in self.items if isinstance(item, kind)]

    @property
    def n_samples(self) -> int:
        """Samples of all streams."""
        return sum(map(len, self.of(SampleChunk)))

    @property
    def n_edges(self) -> int:
        """Edges of all streams."""
        return sum(map(len, self.of(EdgeChunk)))


class BlockBuilder:
    """Fills one block after the other. `close(now)` gives the block once it is due, else None."""

    def __init__(self, period: float, tick_hz: float) -> None:
        self._account = LossAccount()
        self._period = period
        self._ticks = period * tick_hz
        self._block = Block()
        self._opened: float | None = None
        self._first_tick: int | None = None
        self._last_tick = 0

    def add(self, item: Heard, now: float, taken: float | None = None) -> None:
        """Add what arrived at `now`; of samples the first one was `taken` then, in s of the host's clock."""
        if self._opened is None:
            self._opened = now
        self._account.take(item)
        self._block.items.append(item)
        if isinstance(item, SampleChunk):
            self._block.arrivals.append((now, taken, len(item)))
            if self._first_tick is None:
                self._first_tick = int(item.tick[0])
            self._last_tick = int(item.tick[-1])

    def close(self, now: float, everything: bool = False) -> Block | None:
        """Return the block if it is due (or `everything` is asked for and there is something), and start the next."""
        if self._opened is None:
            return None
        span = 0 if self._first_tick is None else self._last_tick - self._first_tick
        if not everything and span < self._ticks and now - self._opened < self._period:
            return None
        block, self._block = self._block, Block()
        block.losses = lost_components(self._account)
        self._opened = self._first_tick = None
        return block


def lost_components(account: LossAccount) -> dict[str, int]:
    """What has been lost, by component."""
    return {f"lost:{name}": n for name, n in account.counters.items()}
