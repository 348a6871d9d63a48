"""The device's end of a CAN bus in C (protocol/c/hbp_can.c) behind a `DeviceApp`. See `protocol.device.compiled`."""

from __future__ import annotations

import ctypes

import numpy as np

from protocol.canmap.frame import BRS, CAN_RECORD, ERROR, FDF, RECORD, REMOTE, BusRates
from protocol.device.app import DeviceApp, Identity
from protocol.device.compiled import CompiledSession, host_options, library, structure

POOL = 1 << 16  # bytes of samples that may wait in a stream


class CompiledCan:
    """One node on a CAN bus; see `canmap.device.CanDevice`. `options`: see `protocol.device.compiled.library`."""

    def __init__(
        self, app: DeviceApp, identity: Identity, rates: BusRates, extended: bool = False,
        options: str = host_options(POOL, 1024),
    ) -> None:  # fmt: skip
        self._lib = library(options)
        self._memory = ctypes.create_string_buffer(self._lib.shim_can_bytes())
        self._at = ctypes.addressof(self._memory)
        self._tick = 0
        self._bus = structure("hbp_can_bus")(rates.bitrate, rates.data_bitrate or 0, extended)
        self._flags = FDF | BRS if rates.fd else 0
        self.session = CompiledSession(self._lib, app, identity)
        code = self._lib.shim_can_init(self._at, ctypes.byref(self._bus))
        code = code or self._lib.shim_can_add(self._at, self.session.at, self.session.config, identity.boot_id)
        if code:
            raise ValueError(f"node {identity.node}: hbp_can_add returns {code:#x}")

    def receive(self, frames: bytes) -> None:
        """Take CAN_RECORDs from the bus, those of others too."""
        self.session.look()
        for record in np.frombuffer(frames, CAN_RECORD):
            number = int(record["id"])
            if number & (ERROR | REMOTE):  # no data frame of anybody's
                continue
            data = record["data"][: record["length"]].tobytes()
            self._lib.hbp_can_rx(self._at, self._tick, number, data, len(data))
        self.session.check()

    def advance(self, tick: int) -> None:
        """Let time pass up to the device's 64-bit `tick`."""
        self.session.look()
        self._tick = tick
        self._lib.hbp_can_poll(self._at, tick)
        self.session.check()

    def take(self) -> bytes:
        """Return and forget the next CAN_RECORD that is to be sent, nothing if there is none."""
        number, data = ctypes.c_uint32(), ctypes.create_string_buffer(64)
        length = self._lib.shim_can_take(self._at, ctypes.byref(number), data)
        if length < 0:
            self._lib.hbp_can_poll(self._at, self._tick)  # what waits in the pools moves up
            length = self._lib.shim_can_take(self._at, ctypes.byref(number), data)
        if length < 0:
            return b""
        return RECORD.pack(number.value, length, self._flags, 0, 0.0, data.raw[:length])

    def gave_up(self) -> None:
        """A stream frame was taken back from the controller's mailbox."""
        self._lib.hbp_can_gave_up(self._at)
