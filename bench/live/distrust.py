"""What the drive's Kalman filter on edges doubts, by the channel `sensors_ek`: Hall sensors, and its own angle.

It is said, and counted; of the angle while the drive runs, as it has no back-EMF to know it by with its outputs off.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.device.heard import ClockRestarted, Heard
from bench.signal.position import running
from bench.signal.trace import INPUTS
from protocol.streams import SampleChunk, StreamConfig

CHANNEL = "sensors_ek"
SETTLED = 1.0
"""s of device time for which a bit is clear before that is said: with a loose contact one changes every 12 ms."""
MOVED, LOST = len(INPUTS), 2 * len(INPUTS)
"""The first bit of sensors that have moved, and the bit of the angle."""
WORDS = (
    *((f"the drive distrusts Hall sensor {name}", f"the drive trusts Hall sensor {name} again") for name in INPUTS),
    *((f"the drive finds that Hall sensor {name} has moved", "") for name in INPUTS),
    ("the drive does not know the rotor's angle", "the drive knows the rotor's angle again"),
)
"""By bit: as it is set, and as it has been cleared, where that means anything."""

Say = Callable[[str, int, bool], object]


class Distrust:
    """Sink that calls `say` with words, device tick and True where node `drive` sets a bit.

    With False, and the last tick at which it was set, once it has been clear for a second.
    """

    def __init__(self, drive: int, say: Say) -> None:
        self._drive, self._say = drive, say
        self._samples = 0
        self._set = [0] * len(WORDS)  # samples
        self._last: dict[int, int] = {}  # of bits that it was said of: the last tick

    @property
    def shares(self) -> dict[str, float] | None:
        """Share of the time, by sensor, of those that it distrusted; None where the drive does not tell."""
        return (
            {name: share for bit, name in enumerate(INPUTS) if (share := self._share(bit))} if self._samples else None
        )

    @property
    def moved(self) -> list[str] | None:
        """The sensors that it found to have moved; None where it does not tell."""
        return [name for bit, name in enumerate(INPUTS, MOVED) if self._set[bit]] if self._samples else None

    @property
    def lost(self) -> float | None:
        """Share of the time for which it did not know the rotor's angle; None where it does not tell."""
        return self._share(LOST) if self._samples else None

    def _share(self, bit: int) -> float:
        return self._set[bit] / self._samples

    def take(self, item: Heard) -> None:
        """Look at samples of the drive, if they have the channel. After a reboot it doubts nothing."""
        match item:
            case SampleChunk(config=StreamConfig(node=self._drive)) if CHANNEL in (item.raw.dtype.names or ()):
                self._look(item)
            case ClockRestarted(node=self._drive):
                self._last.clear()

    def _look(self, chunk: SampleChunk) -> None:
        self._samples += len(chunk)
        bits = np.where(running(chunk), chunk.raw[CHANNEL], chunk.raw[CHANNEL] & (1 << LOST) - 1)
        for bit, (now, again) in enumerate(WORDS):
            rows = np.flatnonzero(bits >> bit & 1)
            self._set[bit] += len(rows)
            if len(rows):
                if bit not in self._last:
                    self._say(now, int(chunk.tick[rows[0]]), True)
                self._last[bit] = int(chunk.tick[rows[-1]])
            elif bit in self._last and chunk.tick[-1] - self._last[bit] >= SETTLED * chunk.config.tick_hz:
                last = self._last.pop(bit)
                if again:
                    self._say(again, last, False)
