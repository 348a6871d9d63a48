"""Collects what arrives from the drive into blocks, so that rerun gets few and large messages.

A block closes when it holds `period` seconds of device time, or when its first item is `period` seconds old by the
host's clock: a drive that only sends heartbeats is logged too. Adding costs a list append; nothing is copied, and
nothing is decided here about queues, threads or rerun. Losses are counted here, as chunks arrive, so that blocks that
a live view has to drop do not spoil the account.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from bench.record.losses import LossAccount
from protocol.messages import DeviceEvent, Heartbeat
from protocol.streams import EdgeChunk, SampleChunk


@dataclass(slots=True)
class Block:
    """What arrived during one period.

    `arrivals`: host time of each chunk of samples; `taken`: that of its first sample, None where it is not known.
    `losses`: counters of the run so far. `notes`: device tick, text, level.
    """

    samples: list[SampleChunk] = field(default_factory=list)
    edges: list[EdgeChunk] = field(default_factory=list)
    heartbeats: list[tuple[int, Heartbeat]] = field(default_factory=list)
    events: list[tuple[int, DeviceEvent]] = field(default_factory=list)
    notes: list[tuple[int, str, str]] = field(default_factory=list)
    arrivals: list[float] = field(default_factory=list)
    taken: list[float | None] = field(default_factory=list)
    losses: dict[str, int] = field(default_factory=dict)

    @property
    def n_samples(self) -> int:
        """Samples of all streams."""
        return sum(len(chunk) for chunk in self.samples)

    @property
    def n_edges(self) -> int:
        """Edges of all streams."""
        return sum(len(chunk) for chunk in self.edges)

    @property
    def nbytes(self) -> int:
        """Memory that its arrays hold, roughly."""
        samples = sum(chunk.raw.nbytes + chunk.index.nbytes + chunk.tick.nbytes for chunk in self.samples)
        return samples + 21 * self.n_edges + 100 * (len(self.heartbeats) + len(self.events) + len(self.notes))


class BlockBuilder:
    """Fills one block after the other. `take(now)` gives the block once it is due, else None."""

    def __init__(self, period: float, tick_hz: float) -> None:
        self.account = LossAccount()
        self._period = period
        self._ticks = period * tick_hz
        self._tick_hz = tick_hz
        self._block = Block()
        self._opened: float | None = None
        self._first_tick: int | None = None
        self._last_tick = 0
        self._newest = 0  # tick

    def samples(self, chunk: SampleChunk, now: float, taken: float | None = None) -> None:
        """Add samples that arrived at `now`, the first one of which was `taken` then, in s of the host's clock."""
        if len(chunk) == 0:
            return
        self._touch(now)
        self._block.samples.append(self.account.chunk(chunk))
        self._block.arrivals.append(now)
        self._block.taken.append(taken)
        if self._first_tick is None:
            self._first_tick = int(chunk.tick[0])
        self._last_tick = int(chunk.tick[-1])
        self._seen(self._last_tick)

    def edges(self, chunk: EdgeChunk, now: float) -> None:
        """Add Hall edges."""
        if len(chunk):
            self._touch(now)
            self._block.edges.append(self.account.chunk(chunk))

    def missing(self, samples: int, edges: int, now: float) -> None:
        """Add what was lost at the end of the streams."""
        self._touch(now)
        self.account.missing(samples, edges)

    def heartbeat(self, node: int, heartbeat: Heartbeat, now: float) -> None:
        """Add a heartbeat."""
        self._touch(now)
        self._seen(heartbeat.tick)
        self.account.heartbeat(node, heartbeat)
        self._block.heartbeats.append((node, heartbeat))

    def event(self, node: int, event: DeviceEvent, now: float) -> None:
        """Add an event of the drive."""
        self._touch(now)
        self._seen(event.tick)
        self._block.events.append((node, event))

    def note(self, text: str, level: str, now: float, tick: int | None = None) -> None:
        """Add a line of the host's, at the newest device time seen if no `tick` is given."""
        self._touch(now)
        self._block.notes.append((self._newest if tick is None else tick, text, level))

    def _seen(self, tick: int) -> None:
        if tick > self._newest or tick + self._tick_hz < self._newest:  # going back: the drive has rebooted
            self._newest = tick

    def _touch(self, now: float) -> None:
        if self._opened is None:
            self._opened = now

    def take(self, now: float, everything: bool = False) -> Block | None:
        """Return the block if it is due (or `everything` is asked for and there is something), and start the next."""
        if self._opened is None:
            return None
        span = 0 if self._first_tick is None else self._last_tick - self._first_tick
        if not everything and span < self._ticks and now - self._opened < self._period:
            return None
        block, self._block = self._block, Block()
        block.losses = {f"lost:{name}": n for name, n in self.account.counters.items()}
        self._opened = self._first_tick = None
        return block
