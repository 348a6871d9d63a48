"""The simulated bench on python-can's virtual bus, which several hosts of this process can join."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can

from protocol.canmap.frame import BusRates
from protocol.links.can_message import to_messages, to_record
from protocol.links.target import CanTarget
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import CanNetwork
from sim.ports.server import STEP, Server

PATIENT = {"firmware.watchdog": 1.0, "load.watchdog": 1.0}
CLASSIC = BusRates()


class VirtualPort:
    """A port of `Server` whose bytes are CAN_RECORDs on a virtual bus."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)

    def read(self) -> bytes:
        rows = bytearray()
        while (message := self.bus.recv(0.0)) is not None:
            rows += to_record(message, 0.0)
        return bytes(rows)

    def write(self, data: bytes) -> int:
        for message in to_messages(data):
            self.bus.send(message)
        return len(data)


@contextmanager
def on_virtual_bus(channel: str, rates: BusRates = CLASSIC, extended: bool = False) -> Iterator[str]:
    """Run it in real time in a thread, with a watchdog of 1 s; gives its target string."""
    device = SimulatedDevice(load_params(None, PATIENT), network=CanNetwork(rates, extended))
    device.advance(32)  # compiles, or loads what was compiled
    port = VirtualPort(channel)
    server = Server(device, port, time.monotonic())  # type: ignore[arg-type]
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(STEP):
            server.step(time.monotonic())

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    options = [("bitrate", str(rates.bitrate))]
    if rates.data_bitrate is not None:
        options += [("fd", "1"), ("data_bitrate", str(rates.data_bitrate))]
    try:
        yield str(CanTarget("virtual", channel, tuple(options), extended=extended))
    finally:
        stop.set()
        thread.join()
        port.bus.shutdown()
