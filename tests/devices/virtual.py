"""The device in virtual time: a link of this process, on which time goes on only while somebody waits for it.

The device is the same as on a real link, byte for byte; only the clock is another. `VirtualLink` is what a test gives
to `bench` in the place of the link that it would open.
"""

from __future__ import annotations

import itertools
import os

import numpy as np

from protocol.canmap.frame import CAN_RECORD
from protocol.canmap.host import CanWire
from protocol.links.base import MAX_READ
from protocol.wire import PATIENCE, ByteWire, HostWire
from tests.devices.carriers import CLASSIC, STOP_FRAME, ByteCarrier, CanCarrier
from tests.devices.device import Device

STEP = 0.005  # s that pass at most before the device looks again
ROOM = 16384  # bytes that a byte link holds for a host that does not read
_numbers = itertools.count()


def turn(device: Device) -> None:
    """Let the device take what has come, and do what is due."""
    for message, host in device.carrier.receive():
        if message.type == STOP_FRAME:
            device.stop_frame()
        else:
            device.receive(message, host)
    device.advance()


class MemoryPort:
    """Bytes that wait for either end; time passes elsewhere."""

    def __init__(self, bounded: bool) -> None:
        self.target = f"serial:/dev/ttyTEST-{os.getpid()}-{next(_numbers)}"  # its own: acceptance holds targets
        self.to_device = bytearray()
        self.to_host = bytearray()
        self._bounded = bounded

    def read(self) -> bytes:
        data = bytes(self.to_device)
        self.to_device.clear()
        return data

    def write(self, data: bytes) -> int:
        if self._bounded and len(self.to_host) >= ROOM:
            return 0
        self.to_host += data
        return len(data)


class VirtualLink:
    """A `protocol.links.Link` whose other end is a device."""

    def __init__(self, can: bool) -> None:
        self.port = MemoryPort(bounded=not can)
        self.carrier: ByteCarrier | CanCarrier = (CanCarrier if can else ByteCarrier)(self.port)  # type: ignore[arg-type]
        self.name = self.port.target.removeprefix("serial:")
        self.device: Device  # set when it has been made with this link's clock
        self._now = 0.0
        self._can = can
        self.patience, self.delay = PATIENCE, 0.0  # of a byte link: those of a serial port are its own

    def clock(self) -> float:
        """Virtual seconds."""
        return self._now

    def wire(self) -> HostWire:
        """See `Link.wire`."""
        return CanWire(CLASSIC) if self._can else ByteWire(patience=self.patience, delay=self.delay)

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """See `Link.read`."""
        self._pass_until(self._now + timeout, self.port.to_host)
        if self.port.to_host and settle > 0.0:
            self._pass(settle)
        size = MAX_READ // CAN_RECORD.itemsize * CAN_RECORD.itemsize
        data = bytes(self.port.to_host[:size])
        del self.port.to_host[:size]
        if self._can:
            records = np.frombuffer(data, CAN_RECORD).copy()
            records["time"] = self._now
            data = records.tobytes()
        return data

    def idle(self, seconds: float) -> None:
        """Time passes, and nobody reads."""
        self._pass_until(self._now + seconds)

    def _pass_until(self, end: float, come: bytes | bytearray = b"") -> None:
        while not come and self._now < end:
            self._pass(min(STEP, end - self._now))

    def _pass(self, seconds: float) -> None:
        self._now += seconds
        self._turn()

    def _turn(self) -> None:
        turn(self.device)

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self.port.to_device += data
        self._turn()

    def close(self) -> None:
        """Time then stands still."""

    def reopen(self) -> None:
        """It is there."""


class SharedLink(VirtualLink):
    """Several devices on one link: each takes what the host writes, and the host gets what each of them sends.

    Messages of different devices do not overlap in time, but on a CAN bus with `interleaved` their frames take turns.
    """

    def __init__(self, can: bool, interleaved: bool = False) -> None:
        super().__init__(can)
        self._interleaved = interleaved
        self.ports: list[MemoryPort] = []
        self.devices: list[Device] = []

    def carrier_of(self) -> ByteCarrier | CanCarrier:
        """What the next device works on."""
        self.ports.append(MemoryPort(bounded=not self._can))
        return (CanCarrier if self._can else ByteCarrier)(self.ports[-1])  # type: ignore[arg-type]

    def _turn(self) -> None:
        for device, port in zip(self.devices, self.ports, strict=True):
            port.to_device += self.port.to_device
            turn(device)
        self.port.to_device.clear()
        size = CAN_RECORD.itemsize if self._interleaved else 1 << 20
        while any(port.to_host for port in self.ports):
            for port in self.ports:
                self.port.to_host += port.to_host[:size]
                del port.to_host[:size]
