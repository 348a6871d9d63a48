"""What a CAN bus carries: the load of a stream, and which streams fit. Loads are the largest that frames may come to.

This module asks no device: the device decides, by the same formulas (`protocol.canmap.device`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from protocol.canmap.frame import BusRates
from protocol.canmap.layout import edge_load, sample_layout
from protocol.device.streams import MAX_LOAD
from protocol.streams import MAX_DECIMATION


class Fit(NamedTuple):
    """A stream that fits: the first `channels` of those asked for, at `rate` in Hz, and the bus's load with edges."""

    channels: int
    rate: float
    load: float


@dataclass(frozen=True, slots=True)
class BusPlan:
    """Streams of one node on a bus: of samples and, always, of edges."""

    rates: BusRates
    extended: bool
    pwm_hz: int
    max_latency_ms: int = 20

    def load(self, widths: Sequence[int], decimation: int) -> float:
        """Return the share of the bus that channels of these widths (bytes) and the edges take."""
        in_time = self.max_latency_ms * self.pwm_hz // (1000 * decimation)
        layout = sample_layout(widths, self.rates.fd, in_time)
        samples = layout.load(self.rates, self.pwm_hz / decimation, self.extended)
        return samples + edge_load(self.rates, self.extended)

    def fastest(self, widths: Sequence[int]) -> Fit | None:
        """Return the highest rate at which all these channels fit, None if there is none."""
        first = bisect_left(range(1, MAX_DECIMATION + 1), True, key=lambda n: self.load(widths, n) <= MAX_LOAD) + 1
        if first > MAX_DECIMATION:
            return None
        return Fit(len(widths), self.pwm_hz / first, self.load(widths, first))

    def most(self, widths: Sequence[int], decimation: int) -> Fit | None:
        """Return how many of these channels, from the first on, fit at this decimation, None if not even one does."""
        for n in range(len(widths), 0, -1):
            load = self.load(widths[:n], decimation)
            if load <= MAX_LOAD:
                return Fit(n, self.pwm_hz / decimation, load)
        return None

    def choices(self, widths: Sequence[int], decimation: int = 1) -> list[Fit]:
        """Return what there is to choose: all channels as quick as can be, and fewer, up to this decimation's rate."""
        if not widths:
            return []
        found: dict[int, Fit] = {}
        counts = {len(widths), *(n for n in (1, 3, 7, 14) if n < len(widths))}
        for fit in [*(self.fastest(widths[:n]) for n in counts), self.most(widths, decimation)]:
            if fit is not None and fit.rate <= self.pwm_hz / decimation:
                found[fit.channels] = fit
        best: list[Fit] = []
        for n in sorted(found, reverse=True):
            if not best or found[n].rate > best[-1].rate:  # fewer channels are of use only if they are quicker
                best.append(found[n])
        return best
