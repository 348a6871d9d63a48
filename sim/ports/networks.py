"""How the simulated bench's devices are wired to the host: one byte link for both, or a CAN bus with a controller each.

A network moves bytes in virtual time: those of a byte link, or whole CAN_RECORDs. It does no I/O and knows no motor.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from protocol.canmap.compiled import POOL, CompiledCan
from protocol.canmap.device import MAX_AGE, CanDevice
from protocol.canmap.frame import CAN_RECORD, ERROR, ERROR_CONTROLLER, ERROR_OVERFLOW, RECORD_BYTES, BusRates
from protocol.canmap.host import CanWire
from protocol.device.compiled import CompiledLink, CompiledSession, host_options
from protocol.device.session import DeviceApp, DeviceLink, DeviceSession, Identity
from protocol.device.tx import TxQueue
from protocol.wire import ByteWire, HostWire
from sim.ports.can_bus import Controller, SimulatedBus

ADAPTER_FRAMES = 8192  # that the host's CAN adapter holds for it
_OVERFLOW = np.zeros(1, CAN_RECORD)
_OVERFLOW["id"], _OVERFLOW["length"] = ERROR | ERROR_CONTROLLER, 8
_OVERFLOW["data"][0, 1] = ERROR_OVERFLOW


class ByteNetwork:
    """A serial cable or a TCP connection; it takes no time of its own. It has the methods of `CanNetwork`."""

    def __init__(self, link: DeviceLink | CompiledLink) -> None:
        self._link = link
        self._delimiters = 0

    def add(self, app: DeviceApp, identity: Identity) -> Session:
        """See `CanNetwork`."""
        return self._link.add(app, identity)

    def receive(self, data: bytes) -> None:
        """See `CanNetwork`."""
        self._link.receive(data)

    def advance(self, tick: int) -> None:
        """See `CanNetwork`."""
        self._link.advance(tick)

    @property
    def frames_sent(self) -> int:
        """See `CanNetwork`: each frame lies between two zero bytes, and there are no others."""
        return self._delimiters // 2

    def carry(self, now: float) -> None:
        """See `CanNetwork`: nothing happens."""

    @property
    def waiting(self) -> int:
        """See `CanNetwork`."""
        return len(self._link)

    def data_to_send(self, limit: int | None = None) -> bytes:
        """See `CanNetwork`."""
        data = self._link.data_to_send(limit)
        self._delimiters += len(data) - int(np.count_nonzero(np.frombuffer(data, np.uint8)))
        return data

    def wire(self) -> HostWire:
        """See `CanNetwork`."""
        return ByteWire()

    def account(self) -> str:
        """See `CanNetwork`."""
        return ""


class CanNetwork:
    """A CAN bus: a controller a device, and the adapter through which the host is on it.

    Args:
        rates: bit rates; they decide the frame format.
        extended: 29-bit identifiers.
        tx_frames: stream frames that may wait in a device, for `compiled` a power of two.
        seed: of the bus's faults.
        compiled: the devices' side of HBP is the one in C.
    """

    def __init__(
        self, rates: BusRates, extended: bool = False, tx_frames: int = 1024, seed: int = 0, compiled: bool = False
    ) -> None:
        self.bus = SimulatedBus(rates, seed)
        self.devices: dict[int, CanDevice | CompiledCan] = {}
        self._compiled = compiled
        self._controllers: dict[int, Controller] = {}
        self.adapter = self.bus.attach(self._next_from_host, self._to_host, "adapter", self._to_host)
        self.overflows = 0
        """Frames for which the adapter had no room."""
        self._overflowing = False
        self.frames_sent = 0
        """Frames handed to the host's side."""
        self._extended = extended
        self._tx_frames = tx_frames
        self._from_host: deque[bytes] = deque()
        self._for_host: deque[bytes] = deque()

    def add(self, app: DeviceApp, identity: Identity) -> Session:
        """Return the session of one more device."""
        device: CanDevice | CompiledCan
        rates, extended, frames = self.bus.rates, self._extended, self._tx_frames
        if self._compiled:
            device = CompiledCan(app, identity, rates, extended, host_options(POOL, frames))
        else:
            device = CanDevice(app, identity, rates, extended, TxQueue(frames * RECORD_BYTES, control_limit=1 << 16))
        controller = self.bus.attach(device.take, device.receive, identity.name, device.receive)
        self._controllers[identity.node] = controller
        self.devices[identity.node] = device
        for each in self.devices.values():
            each.session.nodes = len(self.devices)
        return device.session

    def receive(self, data: bytes) -> None:
        """Take bytes from the host: whole records."""
        self._from_host += [data[at : at + RECORD_BYTES] for at in range(0, len(data), RECORD_BYTES)]

    def carry(self, now: float) -> None:
        """Let time pass on the wire up to `now`, in s since boot, before the devices make anything new."""
        self.bus.advance(now)
        for node, controller in self._controllers.items():
            if controller.waits > MAX_AGE and controller.abort():
                self.devices[node].gave_up()

    def advance(self, tick: int) -> None:
        """Let time pass up to the 64-bit `tick` in every device."""
        for device in self.devices.values():
            device.advance(tick)

    @property
    def waiting(self) -> int:
        """Bytes that wait for the host."""
        return len(self._for_host) * RECORD_BYTES

    def data_to_send(self, limit: int | None = None) -> bytes:
        """Return and forget bytes that wait for the host, at most `limit`: whole records."""
        n = len(self._for_host) if limit is None else min(len(self._for_host), limit // RECORD_BYTES)
        self.frames_sent += n
        return b"".join(self._for_host.popleft() for _ in range(n))

    def wire(self) -> HostWire:
        """Return a new host's end of the language spoken here."""
        return CanWire(self.bus.rates, 1, self._extended)

    def account(self) -> str:
        """Return what there is to say at the end."""
        bus = self.bus
        load = bus.busy_seconds / bus.time if bus.time else 0.0
        lost = f", {self.overflows} lost in the adapter" if self.overflows else ""
        return f"; the bus carried {bus.frames} frames, {load:.0%} busy, {bus.error_frames} error frames{lost}"

    def _next_from_host(self) -> bytes:
        return self._from_host.popleft() if self._from_host else b""

    def _to_host(self, record: bytes) -> None:
        if len(self._for_host) < ADAPTER_FRAMES:
            self._for_host.append(record)
            self._overflowing = False
            return
        if not self._overflowing:
            self._for_host.append(_OVERFLOW.tobytes())
        self._overflowing = True
        self.overflows += 1


Session = DeviceSession | CompiledSession
"""A device's end of HBP."""

Network = ByteNetwork | CanNetwork
"""How the devices of a `SimulatedDevice` are wired."""
