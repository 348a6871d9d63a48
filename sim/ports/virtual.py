"""A link to a simulated bench in the same process, in virtual time: for tests and batch work.

Waiting moves the simulation on instead of the clock: a run takes as long as it takes to compute, and the same
seed and the same calls give the same bytes. It never waits and never reads a real clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from protocol.errors import LinkClosed
from protocol.links.base import MAX_READ
from protocol.wire import HostWire
from sim.config.params import BenchParams, ConfigError, Value, load_params
from sim.ports.device import PORTION, SimulatedDevice

__all__ = ["ConfigError", "VirtualLink", "open_virtual"]

STEP = PORTION  # s: sessions cost as much as 5 ms of simulation each time they look


def open_virtual(config: Path | None, overrides: Mapping[str, Value], seed: int) -> VirtualLink:
    """A link to a new simulated bench, as `load_params` makes it from a file and dotted keys. Raises `ConfigError`."""
    return VirtualLink.of(load_params(config, overrides), seed)


class VirtualLink:
    """A `Link` whose other end is `device`.

    Args:
        device: the simulated bench, of which this link becomes the only driver.
        step: seconds that the simulation moves on at most before a waiting `read` looks for bytes; never more than
            its time-out. Small steps bring bytes sooner in virtual time, large ones save computing time.
    """

    name = "virtual:"

    def __init__(self, device: SimulatedDevice, step: float = STEP) -> None:
        self.device = device
        self._step = max(1, round(step * device.pwm_hz))
        self._open = True

    @classmethod
    def of(cls, params: BenchParams, seed: int = 0, step: float = STEP) -> VirtualLink:
        """A link to a new bench."""
        return cls(SimulatedDevice(params, seed), step)

    def clock(self) -> float:
        """Virtual seconds since boot."""
        return self.device.periods / self.device.pwm_hz

    def wire(self) -> HostWire:
        """See `Link.wire`."""
        return self.device.network.wire()

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """See `Link.read`; seconds are virtual."""
        self._require_open()
        device = self.device
        left, settling = self._periods(timeout), self._periods(settle)
        while left > 0 and not device.network.waiting:
            n = min(left, self._step)
            device.advance(n)
            left -= n
            settling = max(0, self._periods(settle) - n)  # bytes may have come at the start of the step
        if settling > 0 and device.network.waiting:
            device.advance(settling)
        return device.data_to_send(MAX_READ)

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._require_open()
        self.device.receive(data)

    def close(self) -> None:
        """See `Link.close`; virtual time then stands still."""
        self._open = False

    def reopen(self) -> None:
        """See `Link.reopen`; the bench is as it was left."""
        self._open = True

    def _periods(self, seconds: float) -> int:
        """Periods that take `seconds`, rounded up: a wait of any length moves the time on."""
        return max(1, math.ceil(seconds * self.device.pwm_hz - 1e-6)) if seconds > 0.0 else 0

    def _require_open(self) -> None:
        if not self._open:
            raise LinkClosed(f"{self.name} is closed")
