"""Telemetry in larger pieces, for sinks that count and judge: what they do for a chunk costs more than its samples."""

from __future__ import annotations

from collections.abc import Sequence

from bench.device.heard import Chunk, Heard, Sink
from bench.signal.chunks import join
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

PERIOD = 0.2  # s of device time


class Gathered:
    """Sink that hands samples and edges on to `sinks` every 0.2 s, edges first, joined by stream; all else as it comes.

    `flush` hands on what is held back: before something is asked of the sinks, or told to them.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = sinks
        self._held: dict[StreamConfig, list[Chunk]] = {}
        self._handed: int | None = None  # tick of the newest record when something was last handed on

    def take(self, item: Heard) -> None:
        """Hold back chunks, but the very first; they are due when the clock has restarted, too.

        Samples say when, so that edges always lag behind them alike; edges do where no samples come.
        """
        if not isinstance(item, SampleChunk | EdgeChunk):
            self._hand_on(item)
            return
        self._held.setdefault(item.config, []).append(item)
        newest = int(item.tick[-1])
        period = PERIOD if item.config.channels else 2 * PERIOD
        if self._handed is None or abs(newest - self._handed) >= period * item.config.tick_hz:
            self._handed = newest
            self.flush()

    def flush(self) -> None:
        """Hand on what is held back."""
        held, self._held = self._held, {}
        for _, chunks in sorted(held.items(), key=lambda pair: bool(pair[0].channels)):
            self._hand_on(join(chunks))

    def _hand_on(self, item: Heard) -> None:
        for sink in self._sinks:
            sink.take(item)
