"""A UART in virtual time: the bytes of the simulated drive come as fast as its baud rate lets them."""

from __future__ import annotations

from protocol.device.session import DeviceLink
from protocol.device.tx import TxQueue
from protocol.wire import ByteWire, HostWire
from sim.ports.networks import ByteNetwork

BURST = 0.02  # s of silence that are made up for at once: a step of virtual time


class Uart(ByteNetwork):
    """A `ByteNetwork` of `baud`; a character has ten bits."""

    def __init__(self, baud: int) -> None:
        super().__init__(DeviceLink(TxQueue(capacity=baud / 10)))
        self._baud, self._now, self._room, self._carried = baud, 0.0, 0.0, b""

    def carry(self, now: float) -> None:
        per_second = self._baud / 10
        self._room = self._room + (now - self._now) * per_second
        self._now = now
        data = super().data_to_send(int(self._room))
        idle = len(data) < int(self._room)
        self._room = min(self._room - len(data), BURST * per_second if idle else self._room)
        self._carried += data

    @property
    def waiting(self) -> int:
        return len(self._carried)

    def data_to_send(self, limit: int | None = None) -> bytes:
        data, self._carried = self._carried[:limit], self._carried[len(self._carried[:limit]) :]
        return data

    def wire(self) -> HostWire:
        return ByteWire(baud=self._baud)
