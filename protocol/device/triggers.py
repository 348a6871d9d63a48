"""When a capture's trigger comes: conditions on a channel and on Hall edges, judged over whole pushes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.messages import CaptureTrigger
from protocol.signals import Signal
from protocol.streams import EDGE_ILLEGAL

BY_CHANNEL = frozenset(
    {
        CaptureTrigger.ABOVE,
        CaptureTrigger.BELOW,
        CaptureTrigger.RISES,
        CaptureTrigger.FALLS,
        CaptureTrigger.CHANGES,
    }
)
BY_EDGE = frozenset({CaptureTrigger.ILLEGAL, CaptureTrigger.PULSE})

Bools = NDArray[np.bool_]

_NO_CODE = 8  # that no edge leads to


class ChannelTrigger:
    """A condition on one channel; `level` in its unit. RISES, FALLS and CHANGES compare with the period before."""

    def __init__(self, kind: CaptureTrigger, channel: Signal, level: float) -> None:
        self._kind = kind
        self._name = channel.name
        self._scale, self._offset = float(np.float32(channel.scale)), float(np.float32(channel.offset))
        self._level = level
        self._bits = f"<u{np.dtype(channel.raw.dtype).itemsize}"
        self._last: Any = None  # what is compared with, of the period before

    def forget(self) -> None:
        """The next period has none before it."""
        self._last = None

    def find(self, raw: NDArray[np.void]) -> int | None:
        """Return the first of these periods that fulfils the condition, None if none does."""
        met = self._met(raw[self._name])
        first = int(met.argmax())
        return first if met[first] else None

    def _met(self, values: NDArray[Any]) -> Bools:
        if self._kind is CaptureTrigger.CHANGES:
            bits = np.ascontiguousarray(values).view(self._bits)
            changed: Bools = bits != self._shifted(bits)
            return changed
        physical = np.multiply(values, self._scale, dtype=np.float64) + self._offset
        rising = self._kind in (CaptureTrigger.ABOVE, CaptureTrigger.RISES)
        beyond: Bools = physical > self._level if rising else physical < self._level
        if self._kind in (CaptureTrigger.ABOVE, CaptureTrigger.BELOW):
            return beyond
        crossed: Bools = beyond & ~self._shifted(beyond, none=True)
        return crossed

    def _shifted(self, values: NDArray[Any], none: Any = None) -> NDArray[Any]:
        """Return what each value is compared with; the first period of all has `none`, or itself, before it."""
        first = (values[0] if none is None else none) if self._last is None else self._last
        self._last = values[-1]
        return np.concatenate([[first], values[:-1]])


class EdgeTrigger:
    """A condition on Hall edges: one that is illegal, or one that takes back the one before within `most` ticks."""

    def __init__(self, kind: CaptureTrigger, most: float) -> None:
        self._kind = kind
        self._most = most
        self._last: tuple[int, int] | None = None  # tick of the edge before, and the code before it

    def find(self, ticks: NDArray[np.int64], codes: NDArray[np.uint8]) -> int | None:
        """Return the tick of the first of these edges that fulfils the condition, None if none does."""
        if self._kind is CaptureTrigger.ILLEGAL:
            met = codes & EDGE_ILLEGAL != 0
        else:
            tick, code = self._last or (int(ticks[0]), _NO_CODE)
            before = np.concatenate([[code], codes[:-1] & 7])
            met = (codes >> 3 & 7 == before) & (np.diff(ticks, prepend=tick) <= self._most)
            self._last = int(ticks[-1]), int(codes[-1]) & 7
        first = int(met.argmax())
        return int(ticks[first]) if met[first] else None
