"""Which Hall sensors the drive's Kalman filter on edges distrusts, by the channel `sensors_ek`: said, and counted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.device.heard import ClockRestarted, Heard
from bench.signal.trace import INPUTS
from protocol.streams import SampleChunk, StreamConfig

CHANNEL = "sensors_ek"
SETTLED = 1.0
"""s of device time for which a sensor is trusted before that is said: with a loose contact it changes every 12 ms."""

Say = Callable[[str, int, bool], object]


class Distrust:
    """Sink that calls `say` with sensor, device tick and True where node `drive` begins to distrust a Hall sensor.

    With False, and the last tick at which it did, once it has trusted the sensor again for a second.
    """

    def __init__(self, drive: int, say: Say) -> None:
        self._drive, self._say = drive, say
        self._samples = 0
        self._distrusted = dict.fromkeys(INPUTS, 0)  # samples
        self._last: dict[str, int] = {}  # of sensors that it was said of: the last tick

    @property
    def shares(self) -> dict[str, float] | None:
        """Share of the time, by sensor, of those that it distrusted; None where the drive does not tell."""
        return {name: n / self._samples for name, n in self._distrusted.items() if n} if self._samples else None

    def take(self, item: Heard) -> None:
        """Look at samples of the drive, if they have the channel. After a reboot it trusts all sensors."""
        match item:
            case SampleChunk(config=StreamConfig(node=self._drive)) if CHANNEL in (item.raw.dtype.names or ()):
                self._look(item)
            case ClockRestarted(node=self._drive):
                self._last.clear()

    def _look(self, chunk: SampleChunk) -> None:
        self._samples += len(chunk)
        for bit, name in enumerate(INPUTS):
            rows = np.flatnonzero(chunk.raw[CHANNEL] >> bit & 1)
            self._distrusted[name] += len(rows)
            if len(rows):
                if name not in self._last:
                    self._say(name, int(chunk.tick[rows[0]]), True)
                self._last[name] = int(chunk.tick[rows[-1]])
            elif name in self._last and chunk.tick[-1] - self._last[name] >= SETTLED * chunk.config.tick_hz:
                self._say(name, self._last.pop(name), False)
