"""`bench.live.run.run` on a simulated bench in virtual time, in this process: its options, its screen, its link."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import patch

from bench.device.client import Client
from bench.device.node import Node
from bench.live import run as live
from bench.live.summary import Summary
from protocol.canmap.frame import BusRates
from protocol.device.compiled import CompiledLink
from protocol.links import Link
from protocol.messages import DriveState, Feature
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import ByteNetwork, CanNetwork, Network
from sim.ports.virtual import VirtualLink

TARGET = f"serial:/dev/ttyTEST{os.getpid()}"  # a target is locked: no two processes of the tests have one


NETWORKS = ("bytes", "CAN", "CAN FD")


def simulated(
    seed: int = 1, network: str = "bytes", compiled: bool = False, config: Path | None = None, **settings: float
) -> SimulatedDevice:
    """A bench in virtual time; settings as `section__name=value`. `compiled`: behind the device side in C."""
    overrides = {key.replace("__", "."): value for key, value in settings.items()}
    bus = {"CAN": BusRates(1_000_000), "CAN FD": BusRates(1_000_000, 5_000_000)}.get(network)
    wired: Network | None = None
    if bus is not None:
        wired = CanNetwork(bus, compiled=compiled)
    elif compiled:
        wired = ByteNetwork(CompiledLink())
    return SimulatedDevice(load_params(config, overrides), seed, network=wired)


def physical(seed: int = 1) -> SimulatedDevice:
    """The same, but it does not say that it is simulated: for all that a host can know, there is a motor."""
    device = simulated(seed)
    for session in device.sessions:
        session.identity = replace(session.identity, features=session.identity.features & ~Feature.SIMULATED)
    return device


def of_another_host(streams: bool = True) -> SimulatedDevice:
    """A drive that another host has started, and whose samples come to it."""
    device = simulated(firmware__watchdog=1.0)
    node = Node(Client(VirtualLink(device)), 1)
    if streams:
        node.set_samples(node.channels(["i_q"]), 1)
        node.start_streams()
    node.arm()
    node.start()
    return device


def seen_in(device: SimulatedDevice) -> tuple[object, ...]:
    """State, streams and parameters of the drive."""
    drive = device.drive
    return drive.state, drive.streams.channels, drive.streams.running, dict(device.bench.parameters)


@dataclass
class RecordingScreen:
    """Keeps what a person would have seen; it is never in a person's way."""

    notes: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        self.notes.append(text)

    def progress(self, text: str) -> None:
        self.lines.append(text)

    def listed(self, name: str, limits: object, specified: object = None) -> None:
        self.notes.append(f"{name}: {limits}")

    def pause(self) -> None: ...

    def resume(self) -> None: ...


class WatchedLink(VirtualLink):
    """A virtual link that calls `on_call(number)` before each read and write, and keeps the drive's states."""

    def __init__(self, device: SimulatedDevice, on_call: Callable[[int], None] = lambda number: None) -> None:
        super().__init__(device)
        self.calls = 0
        self.states: list[DriveState] = []  # at each call
        self._on_call = on_call

    def _count(self) -> None:
        self.calls += 1
        self.states.append(self.device.drive.state)
        self._on_call(self.calls)

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        self._count()
        return super().read(timeout, settle)

    def write(self, data: bytes) -> None:
        self._count()
        super().write(data)


def never_armed(*links: WatchedLink) -> bool:
    """No drive on these links was ever armed."""
    return not any({DriveState.ARMED, DriveState.RUNNING} & set(link.states) for link in links)


def raising(kind: signal.Signals, at: int) -> Callable[[int], None]:
    """For `WatchedLink`: this signal comes at that call."""
    return lambda number: signal.raise_signal(kind) if number == at else None


@contextmanager
def reached_by(link: Link) -> Iterator[None]:
    """Whatever target is opened, it is this link."""
    with (
        patch("bench.live.run.open_link", lambda target: link),
        patch("bench.device.description.open_link", lambda target: link),
    ):
        yield


def run(
    link: Link, confirm: Callable[[str], bool] | None = None, screen: RecordingScreen | None = None, **options: object
) -> live.LiveOutcome:
    """Run `bench live` on `link`: 0.3 virtual seconds at 500 r/min unless told otherwise."""
    given = live.LiveOptions(
        **({"target": TARGET, "viewer": "none", "speed_rpm": 500.0, "duration": 0.3} | options)  # type: ignore[arg-type]
    )

    def report(summary: Summary) -> None:
        pass

    with reached_by(link):
        return live.run(given, screen or RecordingScreen(), confirm, report)


def at_rest(device: SimulatedDevice) -> bool:
    """No outputs on, and none armed."""
    return not any(
        session.app.outputs_on or session.state in (DriveState.ARMED, DriveState.RUNNING) for session in device.sessions
    )
