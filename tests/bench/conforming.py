"""`bench conform` in virtual time, on the test device and on the simulated bench."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import patch

from shared import table
from virtual_run import RecordingScreen, simulated

from bench.conform import run as conforming
from bench.conform.catalogue import chosen
from bench.conform.checks import Check
from bench.conform.run import Options, Run, conform
from bench.signal.verdict import Verdict
from protocol.device.compiled import CompiledLink
from protocol.device.session import DeviceLink
from protocol.device.tx import TxQueue
from protocol.links import Link
from protocol.wire import ByteWire
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import ByteNetwork
from sim.ports.uart import BITS_PER_CHARACTER, Pacer
from sim.ports.virtual import VirtualLink
from tests.devices import FULL, carriers, serving, virtual
from tests.devices.device import Device
from tests.devices.spec import Flag, Unit
from tests.devices.vocabulary import Parameter, Vocabulary

TARGET = f"serial:/dev/ttyTEST{os.getpid()}"  # a target is locked: no two processes of the tests have one
WATCHDOG = 0.1875  # s, a float32
RICH = replace(
    FULL.without("watchdog"),
    parameters=(
        *FULL.without("watchdog").parameters,
        Parameter(125, "watchdog", WATCHDOG, 2.0**-4, 1, flags=Flag.IDLE_ONLY),
        Parameter(129, "i_range", 32, 0, 64, flags=Flag.READ_ONLY),
        Parameter(151, "hall_offset", 0, -(2.0**-1), 2.0**-1, Unit.RAD, Flag.IDLE_ONLY),
        Parameter(152, "hall_swap_hat", 0, 0, 5, flags=Flag.IDLE_ONLY | Flag.WHOLE),
        Parameter(153, "hall_invert_hat", 0, 0, 7, flags=Flag.IDLE_ONLY | Flag.WHOLE),
    ),
)
"""With a parameter of each kind, and a short watchdog."""


TO_STREAMS, TO_STATES, TO_MOTION, ON_CAN = table("conform_faults").values()
MEANT_FOR = TO_STREAMS | TO_STATES | TO_MOTION | ON_CAN
"""By fault, the check that must fail."""

OVERLOADED = ("stream.seq-counts-dropped", "stream.tx-dropped", "stream.overrun-flag")
"""Checks that cost a test as much as all others together."""


def options(level: int, **given: object) -> Options:
    return Options(**({"target": TARGET, "level": level, "yes": True} | given))  # type: ignore[arg-type]


def run_on(link: Link, level: int, **given: object) -> Run:
    return conform(lambda: link, options(level, **given), RecordingScreen(), None, lambda result: None)


def on_device(
    level: int,
    faults: Sequence[str] = (),
    vocabulary: str | Vocabulary = RICH,
    carrier: str = "bytes",
    without: Collection[str] = (),
    **options: float,
) -> tuple[Run, Device]:
    """The run, and the device as it is after it. It drops frames when 12 KiB of them wait; `without` these checks.

    `options` are those of the device.
    """

    def some(level: int, bus: bool) -> list[Check]:
        return [check for check in chosen(level, bus) if check.id not in without]

    with (
        patch.object(carriers, "MOST_WAITING", 8192),
        patch.object(virtual, "ROOM", 4096),
        patch.object(conforming, "chosen", some),
        serving(vocabulary, faults, carrier, **options) as device,
    ):
        return run_on(device.link, level, idle=device.link.idle), device


@contextmanager
def device_of(kind: str) -> Iterator[tuple[Link, Callable[[float], None]]]:
    """A healthy device by the kind of its link, or of itself: the link, and what lets time pass on it."""
    if kind in ("bytes", "CAN"):
        with serving(RICH, carrier=kind) as device:
            yield device.link, device.link.idle
    else:
        simulator = simulated(compiled=kind == "in C")
        yield VirtualLink(simulator), lambda seconds: simulator.advance(round(seconds * simulator.pwm_hz))


def on_simulated(level: int, device: SimulatedDevice) -> Run:
    return run_on(VirtualLink(device), level, idle=lambda seconds: device.advance(round(seconds * device.pwm_hz)))


class UartLink(VirtualLink):
    """To a simulated bench behind a UART of `baud`: bytes come when the line has had the time to send them."""

    def __init__(self, device: SimulatedDevice, baud: int) -> None:
        super().__init__(device, step=1e-3)
        self._baud = baud
        self._pacer = Pacer(baud)
        self._sent = b""

    def wire(self) -> ByteWire:
        return ByteWire(self._baud)

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        end = self.clock() + timeout
        while not (data := self._passed()) and self.clock() < end:
            self.device.advance(self._step)
        return data

    def _passed(self) -> bytes:
        free = self._pacer.allowance(self.clock())
        self._sent += self.device.data_to_send(max(0, free - len(self._sent)))
        data, self._sent = self._sent[:free], self._sent[free:]
        self._pacer.spend(len(data))
        return data


def on_uart(level: int, baud: int, compiled: bool = False) -> Run:
    """The run on a simulated bench that knows its UART's rate and has room for half a second of frames.

    `compiled`: behind the device side in C, which has a room of its own.
    """
    queue = TxQueue(bulk_limit=baud // 20, capacity=baud / BITS_PER_CHARACTER)
    network = ByteNetwork(CompiledLink(capacity=baud / BITS_PER_CHARACTER) if compiled else DeviceLink(queue))
    device = SimulatedDevice(load_params(), 1, network=network)
    return run_on(UartLink(device, baud), level, idle=lambda seconds: device.advance(round(seconds * device.pwm_hz)))


def narrow() -> SimulatedDevice:
    """A simulated bench behind a byte link that is full after 64 KiB, as a real one is."""
    return SimulatedDevice(load_params(), 1, network=ByteNetwork(DeviceLink(TxQueue())))


def ended(run: Run, verdict: Verdict) -> list[str]:
    """The ids of the checks that ended like this."""
    return [result.check.id for result in run.results if result.verdict is verdict]
