"""The device in virtual time: a link of this process, on which time goes on only while somebody waits for it.

The device is the same as on a real link, byte for byte; only the clock is another. `VirtualLink` is what a test gives
to `bench` in the place of the link that it would open.
"""

from __future__ import annotations

import itertools
import os

import numpy as np

from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.canmap.host import CanWire
from protocol.links.base import MAX_READ
from protocol.wire import ByteWire, HostWire
from tests.devices.can_carriers import CanCarrier, Frame
from tests.devices.carriers import ByteCarrier
from tests.devices.device import Device

STEP = 0.005  # s that pass at most before the device looks again
ROOM = 16384  # bytes that a byte link holds for a host that does not read
_numbers = itertools.count()


def turn(device: Device) -> None:
    """Let the device take what has come, and do what is due."""
    carrier = device.carrier
    for message, host in carrier.receive():
        if message.type == 0:
            device.stop_frame()
        else:
            device.receive(message, host)
    device.advance()


class _InMemory:
    """What both carriers share: bytes that wait for either end; time passes elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.target = f"serial:/dev/ttyTEST-{os.getpid()}-{next(_numbers)}"  # its own: acceptance holds targets
        self.to_device = bytearray()
        self.to_host = bytearray()

    def wait(self, seconds: float) -> None:
        """Nothing happens."""

    def close(self) -> None:
        """Done."""

    def _taken(self) -> bytes:
        data = bytes(self.to_device)
        self.to_device.clear()
        return data


class Bytes(_InMemory, ByteCarrier):
    """Frames in memory."""

    def wire(self) -> HostWire:
        """The host's end of the language that is spoken here."""
        return ByteWire()

    def _descriptor(self) -> int:
        return 0  # always connected

    def _read(self) -> bytes:
        self._push()
        return self._taken()

    def _write(self, data: bytes) -> int:
        if len(self.to_host) >= ROOM:
            raise BlockingIOError
        self.to_host += data
        return len(data)


class Can(_InMemory, CanCarrier):
    """A classic bus in memory, with rows of CAN_RECORD for the host."""

    def wire(self) -> HostWire:
        """The host's end of the language that is spoken here."""
        return CanWire(BusRates(self.bitrate))

    def _frames(self) -> list[Frame]:
        rows = np.frombuffer(self._taken(), CAN_RECORD)
        return [(int(row["id"]), row["data"][: row["length"]].tobytes()) for row in rows]

    def _put(self, frames: list[Frame], stream: bool = False) -> bool:
        self.to_host += _records(frames)
        return True

    def foreign(self, number: int, data: bytes) -> None:
        record = _records([(number, data)])
        self.to_host += record
        self.to_device += record


def _records(frames: list[Frame]) -> bytes:
    rows = np.zeros(len(frames), CAN_RECORD)
    for row, (number, data) in zip(rows, frames, strict=True):
        row["id"], row["length"] = number, len(data)
        row["data"][: len(data)] = np.frombuffer(data, np.uint8)
    return rows.tobytes()


class VirtualLink:
    """A `protocol.links.Link` whose other end is a device."""

    def __init__(self, carrier: Bytes | Can) -> None:
        self.name = carrier.target.removeprefix("serial:")
        self.carrier = carrier
        self.device: Device  # set when it has been made with this link's clock
        self._now = 0.0

    def clock(self) -> float:
        """Virtual seconds."""
        return self._now

    def wire(self) -> HostWire:
        """See `Link.wire`."""
        return self.carrier.wire()

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """See `Link.read`."""
        end = self._now + timeout
        while not self.carrier.to_host and self._now < end:
            self._pass(min(STEP, end - self._now))
        if self.carrier.to_host and settle > 0.0:
            self._pass(settle)
        size = MAX_READ // CAN_RECORD.itemsize * CAN_RECORD.itemsize
        data = bytes(self.carrier.to_host[:size])
        del self.carrier.to_host[:size]
        return data

    def idle(self, seconds: float) -> None:
        """Time passes, and nobody reads."""
        end = self._now + seconds
        while self._now < end:
            self._pass(min(STEP, end - self._now))

    def _pass(self, seconds: float) -> None:
        self._now += seconds
        turn(self.device)

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self.carrier.to_device += data
        turn(self.device)

    def close(self) -> None:
        """Time then stands still."""

    def reopen(self) -> None:
        """It is there."""
