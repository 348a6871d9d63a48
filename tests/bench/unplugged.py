"""A link in virtual time whose cable is pulled for some seconds, once so many bytes have come."""

from __future__ import annotations

from protocol.errors import LinkClosed
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink

OUT = 0.15  # s that pass at each attempt while the cable is out: more than a client waits between two


class UnpluggedLink(VirtualLink):
    """`at`: bytes to the host after which the cable is out, for `seconds`; `silent`: the port stays, nothing comes.

    What the device sends meanwhile, and what is sent to it, is lost.
    """

    def __init__(self, device: SimulatedDevice, at: int, seconds: float, silent: bool) -> None:
        super().__init__(device)
        self.came, self.outages = 0, 0
        self._at, self._seconds, self._silent = at, seconds, silent
        self._until = 0.0

    @property
    def out(self) -> bool:
        """Whether the cable is out."""
        return self.clock() < self._until

    def pull(self, at: int) -> None:
        """Once so many more bytes have come."""
        self._at = self.came + at

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        if self.out and not self._silent:
            raise LinkClosed(f"{self.name} is gone")
        out, data = self.out, super().read(timeout, settle)
        if out:
            return b""
        self.came += len(data)
        if self.came >= self._at and not self.outages:
            self.outages, self._until = 1, self.clock() + self._seconds
            self._lose()
            return b"" if self._silent else data
        return data

    def write(self, data: bytes) -> None:
        if self.out and not self._silent:
            raise LinkClosed(f"{self.name} is gone")
        if not self.out:
            super().write(data)

    def reopen(self) -> None:
        if self.out:
            self._lose(OUT)
            raise LinkClosed(f"{self.name} is gone")
        super().reopen()

    def _lose(self, seconds: float = 0.0) -> None:
        if seconds:
            self.device.advance(self._periods(seconds))
        self.device.data_to_send(1 << 30)
