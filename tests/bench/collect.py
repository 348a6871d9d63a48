"""A sink that keeps everything, and whole runs put together from it or cut up anew."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.device.client import Client
from bench.device.heard import ClockRestarted, Heard, Misdated, Missing, Note, ParameterSet
from bench.device.node import DRIVE, LOAD, Node
from bench.record.info import RunInfo
from bench.rig.streams import configure
from bench.signal.chunks import join, part
from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.links import Link
from protocol.messages import DriveState
from protocol.streams import EdgeChunk, SampleChunk

if TYPE_CHECKING:
    from bench.replay.estimators import HostObservers


class Collector:
    def __init__(self) -> None:
        self.chunks: list[SampleChunk | EdgeChunk] = []  # in the order in which they came
        self.events: list[DeviceEventReceived] = []
        self.heartbeats: list[HeartbeatReceived] = []
        self.restarts: list[ClockRestarted] = []
        self.misdated: list[Misdated] = []
        self.parameters: list[ParameterSet] = []
        self.notes: list[str] = []
        self.lost = (0, 0)  # samples and edges, at the end of the streams

    def take(self, item: Heard) -> None:
        match item:
            case SampleChunk() | EdgeChunk():
                self.chunks.append(item)
            case DeviceEventReceived():
                self.events.append(item)
            case HeartbeatReceived():
                self.heartbeats.append(item)
            case Missing():
                self.lost = (self.lost[0] + item.samples, self.lost[1] + item.edges)
            case ParameterSet():
                self.parameters.append(item)
            case ClockRestarted():
                self.restarts.append(item)
            case Misdated():
                self.misdated.append(item)
            case Note():
                self.notes.append(item.text)

    def all_samples(self) -> SampleChunk:
        chunks = [chunk for chunk in self.chunks if isinstance(chunk, SampleChunk)]
        assert not any(chunk.gaps for chunk in chunks)
        return join(chunks)

    def all_edges(self) -> EdgeChunk:
        chunks = [chunk for chunk in self.chunks if isinstance(chunk, EdgeChunk)]
        assert not any(chunk.gaps for chunk in chunks)
        return join(chunks)


def feed(observers: HostObservers, samples: SampleChunk, edges: EdgeChunk, cuts: np.ndarray) -> tuple[int, int]:
    """Give a run to the observers in pieces: each piece's edges first, as a client delivers them."""
    compared = differ = sent = 0
    for first, last in zip([0, *cuts], [*cuts, len(samples)], strict=True):
        if first == last:
            continue
        piece = part(samples, first, last)
        due = int(np.searchsorted(edges.tick, piece.tick[-1], side="right"))
        if due > sent:
            observers.edges(part(edges, sent, due))
            sent = due
        n, bad = observers.compare(piece)
        compared += n
        differ += bad
    return compared, differ


class Bench:
    """Client, drive and load machine on one link, with a collector."""

    def __init__(self, link: Link) -> None:
        self.client = Client(link)
        self.collector = Collector()
        self.client.sinks = [self.collector]
        self.hello = self.client.connect()
        self.drive, self.load = Node(self.client, DRIVE), Node(self.client, LOAD)

    def stream(self, names: tuple[str, ...] | None = None, decimation: int = 1) -> int:
        """Stream edges and samples; returns the decimation, which is a larger one where the link carries no more."""
        self.drive.stop_streams()
        self.drive.set_edges()
        config = configure(self.drive, [self.drive.channels(names)], decimation, slower=True)
        self.drive.start_streams()
        return config.decimation

    def info(self, names: tuple[str, ...] | None = None) -> RunInfo:
        """What a recording of these channels of the drive begins with."""
        hello, channels = self.hello, self.drive.channels(names)
        return RunInfo(hello.tick_hz, hello.pwm_hz, channels, self.drive.parameters(), node=hello.node)

    def rest(self) -> None:
        """Leave both machines as the next host expects to find them."""
        for node in (self.drive, self.load):
            if node.state in (DriveState.ARMED, DriveState.RUNNING):
                node.stop()
            node.clear_faults()
        self.drive.stop_streams()

    def turn(self, omega_m: float) -> None:
        self.drive.arm()
        self.drive.start()
        self.drive.speed(omega_m)
