"""The simulated bench in real time in a thread; on python-can's virtual bus several hosts of this process can join."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import can

from protocol.canmap.frame import BusRates
from protocol.links.can_message import to_messages, to_record
from protocol.links.target import CanTarget
from sim.config.params import load_params
from sim.ports.byte_ports import Port
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

    def close(self) -> None:
        self.bus.shutdown()


@contextmanager
def in_real_time(
    device: SimulatedDevice, port: Port | VirtualPort, after_step: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Serve the device at the port."""
    server = Server(device, port, time.monotonic())  # type: ignore[arg-type]
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(STEP):
            server.step(time.monotonic())
            after_step()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def on_virtual_bus(channel: str, rates: BusRates = CLASSIC, extended: bool = False) -> Iterator[str]:
    """Run it with a watchdog of 1 s; gives its target string."""
    device = SimulatedDevice(load_params(None, PATIENT), network=CanNetwork(rates, extended))
    device.advance(32)  # compiles, or loads what was compiled
    port = VirtualPort(channel)
    options = [("bitrate", str(rates.bitrate))]
    if rates.data_bitrate is not None:
        options += [("fd", "1"), ("data_bitrate", str(rates.data_bitrate))]
    with closing(port), in_real_time(device, port):
        yield str(CanTarget("virtual", channel, tuple(options), extended=extended))
