"""A client with both machines of a simulated bench in virtual time, in any commit."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import probe

from protocol.streams import EdgeChunk, SampleChunk

RPM = 500.0
OMEGA_M = RPM * math.tau / 60  # rad/s
TORQUE = 0.236  # N m: 4 A
POLL = 0.075  # s, virtual

load_params: Any = probe.newest("sim.config.params", "sim.params").load_params
VirtualLink: Any = probe.newest("sim.ports.virtual", "sim.drive.virtual").VirtualLink
client: Any = probe.newest("bench.device.client", "bench.client")
node: Any = probe.newest("bench.device.node", "bench.node")


class Count:
    """A sink that only counts."""

    def __init__(self) -> None:
        self.samples_seen = self.edges_seen = 0

    def take(self, item: object) -> None:
        if isinstance(item, SampleChunk):
            self.samples_seen += len(item)
        elif isinstance(item, EdgeChunk):
            self.edges_seen += len(item)

    samples = edges = take  # before there was `take`

    def heartbeat(self, *_: object) -> None: ...
    def event(self, *_: object) -> None: ...
    def note(self, *_: object) -> None: ...
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *_: None


def connected(sink: Any) -> SimpleNamespace:
    """A client of a new simulated bench, with `sink`, and its two machines."""
    c = client.Client(VirtualLink.of(load_params()))
    c.sinks = [sink]
    hello = c.connect()
    return SimpleNamespace(client=c, hello=hello, drive=node.Node(c, node.DRIVE), load=node.Node(c, node.LOAD))


def stream(rig: Any, everything: bool) -> int:
    """Stream edges and the default channels, or all, at full rate; how many channels."""
    drive = rig.drive
    if not probe.there("bench.rig.streams"):  # c9185aa: what there was, was streamed
        drive.set_samples(drive.descriptor.channels, 1)
        drive.set_edges()
        drive.start_streams()
        return len(drive.descriptor.channels)
    names = tuple(channel.name for channel in drive.descriptor.channels) if everything else None
    drive.stop_streams()
    drive.set_edges()
    channels = drive.channels(names)
    config = probe.newest("bench.rig.streams").configure(drive, [channels], 1, slower=True)
    if config.decimation != 1:
        raise SystemExit(f"streamed at a {config.decimation}th of the rate")
    drive.start_streams()
    return len(channels)


def turn(rig: Any, torque: float = TORQUE) -> None:
    """Both machines on; the load at a torque in N m."""
    for machine in (rig.load, rig.drive):
        machine.arm()
        machine.start()
    rig.load.torque(torque)
    rig.drive.speed(OMEGA_M)
