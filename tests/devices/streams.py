"""Streams of a device, chapter 11: configured, filled with records, taken out in blocks."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from tests.devices.motor import Edge, Samples
from tests.devices.spec import Code, Feature, Refusal, Source, Type
from tests.devices.vocabulary import Channel, Vocabulary

HEADER = struct.Struct("<BBHHHII")
EDGE = struct.Struct("<IBBH")
OVERRUN, DISCONTINUITY = 1, 2
Record = tuple[int, int, bytes]
"""Index, tick and bytes."""


@dataclass
class Stream:
    """A stream that is configured, with what waits in it."""

    number: int
    event: int
    decimation: int
    latency_ms: int
    channels: tuple[Channel, ...]
    cfg_id: int = 0
    tx_max: int = 1024
    block: int = 1
    """Most records in a frame; with slot and load filled in by the carrier."""
    slot: int = 0
    load: float = 0.0
    total: float = 0.0
    """With the load of all others."""
    running: bool = False
    seq: int = 0
    overrun: bool = False
    jumped: bool = False
    waiting: deque[Record] = field(default_factory=deque)

    @classmethod
    def asked(
        cls, number: int, event: int, decimation: int, latency_ms: int, ids: tuple[int, ...], vocabulary: Vocabulary
    ) -> Stream:
        """Checked as far as that needs no link; raises Refusal."""
        by_id = {channel.id: channel for channel in vocabulary.channels}
        if event not in (Source.PWM, Source.EDGES) or (
            event == Source.EDGES and not vocabulary.features & Feature.EDGES
        ):
            raise Refusal(Code.NOT_SUPPORTED, event)
        if event == Source.EDGES:
            if ids:
                raise Refusal(Code.BAD_VALUE, len(ids))
            return cls(number, event, decimation, latency_ms, ())
        if not decimation or not ids:
            raise Refusal(Code.BAD_VALUE, 0)
        for place, one in enumerate(ids):
            if one not in by_id:
                raise Refusal(Code.UNKNOWN_ID, one)
            if one in ids[:place]:
                raise Refusal(Code.BAD_VALUE, one)
        return cls(number, event, decimation, latency_ms, tuple(by_id[one] for one in ids))

    @property
    def edges(self) -> bool:
        return self.event == Source.EDGES

    @property
    def sizes(self) -> list[int]:
        """Bytes of each channel."""
        return [np.dtype(channel.raw.dtype).itemsize for channel in self.channels]

    @property
    def sample_bytes(self) -> int:
        return EDGE.size if self.edges else sum(self.sizes)

    def most_in(self, room: int, pwm_hz: float) -> int:
        """Records in a frame with `room` bytes for them: what fits, and what comes within `latency_ms`."""
        fits = room // self.sample_bytes
        if not self.edges:
            fits = min(fits, int(self.latency_ms / 1e3 * pwm_hz / self.decimation))
        return max(1, fits)

    def put_edges(self, edges: Iterable[Edge], count: int) -> None:
        """`count`: edges since boot, before these."""
        for index, edge in enumerate(edges, count):
            codes = edge.before | edge.after << 3
            self.waiting.append((index, edge.tick, EDGE.pack(edge.tick & 0xFFFFFFFF, codes, 0, edge.encoder)))

    def put_samples(self, samples: Samples) -> None:
        """Take the periods whose index is divisible by `decimation`."""
        chosen = self.taken(samples.index)
        if not chosen.any():
            return
        rows = np.empty(len(samples.index), [(f"c{n}", channel.raw.dtype) for n, channel in enumerate(self.channels)])
        for n, channel in enumerate(self.channels):
            rows[f"c{n}"] = channel.sampled(samples)
        packed, size = rows[chosen].tobytes(), rows.itemsize
        for n, (index, tick) in enumerate(zip(samples.index[chosen], samples.tick[chosen], strict=True)):
            self.waiting.append((int(index), int(tick), packed[n * size : (n + 1) * size]))

    def taken(self, index: np.ndarray) -> np.ndarray:
        """Which periods of these are."""
        return index % self.decimation == 0

    def take(self, now: int, everything: bool, whole: bool, tick_hz: int = 1_000_000) -> Iterator[list[Record]]:
        """Blocks that are full or late at the tick `now`, or all; only full ones where they are to be `whole`."""
        if whole:
            while len(self.waiting) >= self.block:
                yield [self.waiting.popleft() for _ in range(self.block)]
            return
        late = now - self.latency_ms * tick_hz // 1000
        while self.waiting and (everything or len(self.waiting) >= self.block or self.waiting[0][1] <= late):
            yield [self.waiting.popleft() for _ in range(min(self.block, len(self.waiting)))]

    def frame(self, records: list[Record]) -> tuple[Type, bytes]:
        """Type and payload of a frame on a byte link; counts it."""
        flags = OVERRUN * self.overrun | DISCONTINUITY * self.jumped
        self.jumped = False
        index, tick, _ = records[0]
        header = HEADER.pack(
            self.number, flags, len(records), self.cfg_id, self.seq, index & 0xFFFFFFFF, tick & 0xFFFFFFFF
        )
        self.seq = (self.seq + 1) & 0xFFFF
        return Type.EDGES if self.edges else Type.DATA, header + b"".join(row for _, _, row in records)
