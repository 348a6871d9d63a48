"""`bench conform` in virtual time, on the test device and on the simulated bench."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from virtual_run import RecordingScreen

from bench.conforming.checks import Verdict
from bench.conforming.run import Options, Run, conform
from protocol.device.tx import TxQueue
from protocol.links import Link
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import ByteNetwork
from sim.ports.virtual import VirtualLink
from tests.devices import FULL, serving
from tests.devices.device import Device
from tests.devices.spec import Flag
from tests.devices.vocabulary import Parameter, Vocabulary

TARGET = "serial:/dev/ttyTEST"
WATCHDOG = 0.1875  # s, a float32
RICH = replace(
    FULL.without("watchdog"),
    parameters=(
        *FULL.without("watchdog").parameters,
        Parameter(125, "watchdog", WATCHDOG, 2.0**-4, 1, flags=Flag.IDLE_ONLY),
        Parameter(129, "i_range", 32, 0, 64, flags=Flag.READ_ONLY),
    ),
)
"""With a parameter of each kind, and a short watchdog."""


def options(level: int, **given: object) -> Options:
    return Options(**({"target": TARGET, "level": level, "yes": True} | given))  # type: ignore[arg-type]


def run_on(link: Link, level: int, **given: object) -> Run:
    return conform(link, options(level, **given), RecordingScreen(), None, lambda result: None)


def on_device(
    level: int, faults: Sequence[str] = (), vocabulary: str | Vocabulary = RICH, carrier: str = "bytes"
) -> tuple[Run, Device]:
    """The run, and the device as it is after it."""
    with serving(vocabulary, faults, carrier) as device:
        return run_on(device.link, level, idle=device.link.idle), device


def on_simulated(level: int, device: SimulatedDevice) -> Run:
    return run_on(VirtualLink(device), level, idle=lambda seconds: device.advance(round(seconds * device.pwm_hz)))


def narrow() -> SimulatedDevice:
    """A simulated bench behind a byte link that is full after 64 KiB, as a real one is."""
    return SimulatedDevice(load_params(), 1, network=ByteNetwork(TxQueue()))


def ended(run: Run, verdict: Verdict) -> list[str]:
    """The ids of the checks that ended like this."""
    return [result.check.id for result in run.results if result.verdict is verdict]
