"""A link to devices in virtual time whose frames may be changed on their way to the host."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from small_drive import CHANNELS, TICKS, SmallDrive, edges_at, identity, samples, small_link

from protocol.canmap.device import CanDevice
from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.canmap.host import CanWire
from protocol.device.session import DeviceLink, TxQueue
from protocol.framing import Deframer, Frame, encode_frame, parse_frame
from protocol.wire import ByteWire, HostWire

Lie = Callable[[Frame], Frame]

PERIOD = TICKS / 20_000_000  # s
CAN_FD = BusRates(1_000_000, 5_000_000)


class LyingLink:
    """Sound devices in virtual time, by default one small drive, whose frames `lie` changes."""

    name = "lying:1"

    def __init__(self, lie: Lie = lambda frame: frame, device: DeviceLink | None = None) -> None:
        self.device = small_link(TxQueue(1 << 22, capacity=100_000.0))[0] if device is None else device
        self.session = self.device.sessions[1]
        self._lie = lie
        self._deframer = Deframer()
        self._deframer.feed(b"\0")
        self._now = 0.0
        self._periods = 0

    def clock(self) -> float:
        return self._now

    def wire(self) -> HostWire:
        return ByteWire()

    def write(self, data: bytes) -> None:
        self.device.receive(data)

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        data = self._sent()
        if not data:
            self._now += max(timeout, 1e-3)
            n = int(self._now / PERIOD) - self._periods
            if self.session.app.channels is CHANNELS:
                self._push(n)
            self._periods += n
            self.device.advance(self._periods * TICKS)
            data = self._sent()
        return data

    def reopen(self) -> None:
        """Never lost."""

    def close(self) -> None:
        """Nothing to close."""

    def _push(self, n: int) -> None:
        self.session.push_edges(edges_at([self._periods * TICKS]))
        self.session.push_samples(self._periods, self._periods * TICKS, samples(self._periods, n))

    def _sent(self) -> bytes:
        frames = [parse_frame(raw) for raw in self._deframer.feed(self.device.data_to_send())]
        return b"".join(encode_frame(self._lie(frame)) for frame in frames)


class LyingCanLink(LyingLink):
    """A sound small drive on a CAN FD bus, whose messages `lie` changes; its stream frames are as they should be."""

    def __init__(self, lie: Lie = lambda frame: frame) -> None:
        self._can = CanDevice(SmallDrive(), identity(boot_id=0xB0071D), CAN_FD)
        self._can.advance(0)
        link = DeviceLink(self._can.tx)
        link.sessions[1] = session = self._can.session
        super().__init__(lie, link)
        encode = session._encode
        session._encode = lambda frame: encode(lie(frame))

    def wire(self) -> HostWire:
        return CanWire(CAN_FD)

    def write(self, data: bytes) -> None:
        self._can.receive(data)

    def _sent(self) -> bytes:
        records = np.frombuffer(self._can.tx.take(), CAN_RECORD).copy()
        records["time"] = self._now
        return records.tobytes()
